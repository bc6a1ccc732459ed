#include "rig/supply.h"

#include <math.h>

/* For a sine with the same bits on any computer. */
#include "plant/magnetics_kernel.h"

#define RIPPLE_DEFAULT_HZ 300.0
#define TWO_PI (2.0 * 3.14159265358979323846)
#define S_PER_NS 1e-9

static double ripple_V(const rig_t *rig) {
    const supply_t *supply = &rig->supply;
    if (supply->ripple_V == 0.0) {
        return 0.0;
    }
    const uint64_t middle_ns = rig->board.time_ns - supply->ripple_start_ns + SUPPLY_STEP_NS / 2;
    const double periods = supply->ripple_Hz * (double)middle_ns * S_PER_NS;
    double sine, cosine;
    magnetics_kernel_sine_cosine(TWO_PI * (periods - floor(periods + 0.5)), &sine, &cosine);
    return supply->ripple_V * sine;
}

static void apply(rig_t *rig) {
    const supply_t *supply = &rig->supply;
    plant_advance(&rig->plant, rig->board.time_ns);
    plant_set_supply_voltage(&rig->plant, fmax(supply->voltage_V * supply->factor + ripple_V(rig), 0.0));
    rig->scheduler.due_ns[EVENT_SUPPLY] =
        supply->ripple_V != 0.0 ? rig->board.time_ns + SUPPLY_STEP_NS : SCHEDULER_NEVER;
}

void supply_init(rig_t *rig) {
    rig->supply =
        (supply_t){.voltage_V = rig->plant.machine->supply_voltage_V, .factor = 1.0, .ripple_Hz = RIPPLE_DEFAULT_HZ};
}

void supply_set_voltage(rig_t *rig, double voltage_V) {
    rig->supply.voltage_V = voltage_V;
    apply(rig);
}

void supply_set_ripple_frequency(rig_t *rig, double frequency_Hz) {
    rig->supply.ripple_Hz = frequency_Hz;
    rig->supply.ripple_start_ns = rig->board.time_ns;
    apply(rig);
}

void supply_set_fault(rig_t *rig, double factor, double ripple_V) {
    if (rig->supply.ripple_V == 0.0) {
        rig->supply.ripple_start_ns = rig->board.time_ns;
    }
    rig->supply.factor = factor;
    rig->supply.ripple_V = ripple_V;
    apply(rig);
}

void supply_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    apply(context);
}
