#include "plant/phase_samples.h"

#include <math.h>
#include <string.h>

#include "plant/plant_switches.h"
#include "plant/units.h"

/* State of a phase within a step: its current, and its torque's impulse since the start. */
static void phase_within(const phase_record_t *record, double at_s, double *current_A, double *impulse_Nms) {
    *current_A = *impulse_Nms = 0.0;
    for (unsigned n = 0; n < record->count && record->steps[n].from_s <= at_s; n++) {
        const phase_step_t *step = &record->steps[n];
        const double x = fmin((at_s - step->from_s) / step->length_s, 1.0);
        *current_A = fmax(course_at(&step->current_A, step->length_s, x), 0.0);
        *impulse_Nms = step->impulse_Nms + course_integral_to(&step->torque_Nm, step->length_s, x);
    }
}

void phase_samples_take(plant_t *plant, const rotor_step_t *rotor, double correction_rad, const phase_record_t *records,
                        const link_record_t *link, uint64_t end_ns) {
    const uint64_t start_ns = plant->time_ns;
    double current_A[HAL_PHASES_MAX];
    memcpy(current_A, plant->current_A, sizeof current_A);
    while (plant->observation.next_ns < end_ns) {
        const double at_s = (double)(plant->observation.next_ns - start_ns) * S_PER_NS, x = at_s / rotor->length_s;
        double net_Nms = -plant->load_torque_Nm * at_s;
        for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
            double impulse_Nms;
            phase_within(&records[phase], at_s, &plant->current_A[phase], &impulse_Nms);
            net_Nms += impulse_Nms;
        }
        rotor_at(rotor, at_s, &plant->rotor_angle_rad, &plant->speed_rad_s);
        if (!plant->held) {
            net_Nms -= plant->friction_Nm_s * (plant->rotor_angle_rad - rotor->angle_rad);
            plant->speed_rad_s = rotor->speed_rad_s + net_Nms / plant->inertia_kg_m2;
        }
        plant->rotor_angle_rad += x * x * x * correction_rad;
        if (link->count > 0) {
            plant->bus_voltage_V = link_recorded_V(link, at_s);
        }
        plant->time_ns = plant->observation.next_ns;
        plant_follow_edges(plant, end_ns);
        plant_take_sample(plant);
    }
    plant->time_ns = start_ns;
    memcpy(plant->current_A, current_A, sizeof current_A);
}
