#include "rig/supply.h"

#include <math.h>

/* For a sine with the same bits on any computer. */
#include "plant/magnetics_kernel.h"
#include "plant/units.h"

#define RIPPLE_DEFAULT_HZ 300.0

static uint64_t now_ns(const supply_t *supply) {
    return *supply->scheduler->clock_ns;
}

static double ripple_V(const supply_t *supply) {
    if (supply->ripple_V == 0.0) {
        return 0.0;
    }
    const uint64_t middle_ns = now_ns(supply) - supply->ripple_start_ns + SUPPLY_STEP_NS / 2;
    const double periods = supply->ripple_Hz * (double)middle_ns * S_PER_NS;
    double sine, cosine;
    magnetics_kernel_sine_cosine(TWO_PI * (periods - floor(periods + 0.5)), &sine, &cosine);
    return supply->ripple_V * sine;
}

static void apply(supply_t *supply) {
    plant_advance(supply->plant, now_ns(supply));
    plant_set_supply_voltage(supply->plant, fmax(supply->voltage_V * supply->factor + ripple_V(supply), 0.0));
    supply->scheduler->due_ns[EVENT_SUPPLY] =
        supply->ripple_V != 0.0 ? now_ns(supply) + SUPPLY_STEP_NS : SCHEDULER_NEVER;
}

void supply_init(supply_t *supply, plant_t *plant, scheduler_t *scheduler) {
    *supply = (supply_t){.plant = plant,
                         .scheduler = scheduler,
                         .voltage_V = plant->machine->supply_voltage_V,
                         .factor = 1.0,
                         .ripple_Hz = RIPPLE_DEFAULT_HZ};
}

void supply_set_voltage(supply_t *supply, double voltage_V) {
    supply->voltage_V = voltage_V;
    apply(supply);
}

void supply_set_ripple_frequency(supply_t *supply, double frequency_Hz) {
    supply->ripple_Hz = frequency_Hz;
    supply->ripple_start_ns = now_ns(supply);
    apply(supply);
}

void supply_set_fault(supply_t *supply, double factor, double ripple_V) {
    if (supply->ripple_V == 0.0) {
        supply->ripple_start_ns = now_ns(supply);
    }
    supply->factor = factor;
    supply->ripple_V = ripple_V;
    apply(supply);
}

void supply_step(supply_t *supply) {
    apply(supply);
}
