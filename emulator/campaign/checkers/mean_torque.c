#include "campaign/checkers/mean_torque.h"

#include <math.h>

bool mean_torque_step(mean_torque_t *torque, const observation_t *seen, uint64_t min_ns, double *mean_Nm) {
    const plant_t *plant = seen->plant;
    if (torque->samples == 0) {
        *torque = (mean_torque_t){.begin_ns = seen->time_ns, .begin_angle_rad = plant->rotor_angle_rad};
    }
    torque->sum_Nm += plant_torque_Nm(plant);
    torque->samples++;
    const double turned_rad = fabs(plant->rotor_angle_rad - torque->begin_angle_rad);
    if (turned_rad < TWO_PI / plant->machine->rotor_poles || seen->time_ns < torque->begin_ns + min_ns) {
        return false;
    }
    *mean_Nm = torque->sum_Nm / torque->samples;
    torque->samples = 0;
    return true;
}
