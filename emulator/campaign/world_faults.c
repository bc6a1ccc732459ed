#include "campaign/world_faults.h"

#include <math.h>
#include <stddef.h>

#include "bench_variables.h"
#include "campaign/seeded.h"
#include "campaign/world_streams.h"
#include "fault_kinds.h"

#define FAULT_DRAWS 8     /* random numbers of a kind of fault */
#define FAULT_SHARE 0.065 /* of the kinds, on average, that a seed has */
#define FAULTS_MAX 6

/* Shares of the seeds. */
#define FAULTLESS_SHARE 0.15  /* no fault of the bench */
#define LASTING_SHARE 0.06    /* one fault alone, to the end of a long world */
#define SLOW_SHARE 0.6        /* of them: of a kind that takes long to be noticed */
#define SECOND_LOSS_SHARE 0.4 /* of the worlds with one lost phase */
#define REMAINING_SHARE 0.3   /* of the faults: until all are over */

/* --- Attributes: a function of the kind, from a number of 0..1 --- */

static double short_percent(const world_t *world, double unit) {
    (void)world;
    return 2.0 + 48.0 * unit;
}

static double counts_of_adc(const world_t *world, double unit) {
    return floor(unit * (double)(1u << world->adc_bits));
}

static double gain_of_current(const world_t *world, double unit) {
    (void)world;
    return unit < 0.5 ? unit : 2.0 + 4.0 * (unit - 0.5);
}

static double offset_of_current(const world_t *world, double unit) {
    return (unit - 0.5) * 0.8 * world->machine->image.machine.ranges.current_A;
}

static double other_phase(const world_t *world, double unit) {
    return floor(unit * world->machine->image.machine.phases);
}

static double gain_of_voltage(const world_t *world, double unit) {
    (void)world;
    return unit < 0.5 ? unit : 1.3 + 2.0 * (unit - 0.5);
}

static double offset_of_voltage(const world_t *world, double unit) {
    return (unit - 0.5) * world->machine->image.machine.ranges.dc_link_V;
}

static double jump_deg(const world_t *world, double unit) {
    (void)world;
    return (unit < 0.5 ? -1.0 : 1.0) * exp(log(0.2) + (log(180.0) - log(0.2)) * fabs(2.0 * unit - 1.0));
}

static double lost_counts(const world_t *world, double unit) {
    return floor(exp(log(0.005) * unit) * (double)(1u << world->encoder_bits) * 0.2) + 1.0;
}

static double noise_deg(const world_t *world, double unit) {
    (void)world;
    return 0.3 + 9.0 * unit;
}

static double slip_deg_s(const world_t *world, double unit) {
    (void)world;
    return (unit - 0.5) * 700.0;
}

static double friction_Nm(const world_t *world, double unit) {
    return fmin(500.0, world->machine->torque_max_Nm * (0.3 + unit));
}

static double sag_percent(const world_t *world, double unit) {
    (void)world;
    return 100.0 * unit;
}

static double surge_percent(const world_t *world, double unit) {
    (void)world;
    return 10.0 + 90.0 * unit;
}

static double ripple_V(const world_t *world, double unit) {
    return fmin(500.0, world->machine->image.machine.supply_voltage_V * 0.6 * unit);
}

static double earth_ohm(const world_t *world, double unit) {
    (void)world;
    return 0.001 * exp(log(1000.0) * unit);
}

static double offset_K(const world_t *world, double unit) {
    (void)world;
    return (unit - 0.5) * 400.0;
}

static double late_us(const world_t *world, double unit) {
    (void)world;
    return exp(log(5.0) + log(1e4) * unit);
}

static double drift_percent(const world_t *world, double unit) {
    (void)world;
    return (unit - 0.5) * 200.0;
}

/* Kinds without a function and with an attribute have a bit of memory: any of their range. */
static double (*const attributes[FAULT_COUNT])(const world_t *world, double unit) = {
    [FAULT_WINDING_SHORTED] = short_percent,
    [FAULT_WINDING_TO_EARTH] = earth_ohm,
    [FAULT_CURRENT_SENSOR_STUCK] = counts_of_adc,
    [FAULT_CURRENT_SENSOR_GAIN] = gain_of_current,
    [FAULT_CURRENT_SENSOR_OFFSET] = offset_of_current,
    [FAULT_CURRENT_SENSOR_SWAPPED] = other_phase,
    [FAULT_DC_LINK_SENSOR_STUCK] = counts_of_adc,
    [FAULT_DC_LINK_SENSOR_GAIN] = gain_of_voltage,
    [FAULT_DC_LINK_SENSOR_OFFSET] = offset_of_voltage,
    [FAULT_ENCODER_JUMP] = jump_deg,
    [FAULT_ENCODER_LOST_COUNTS] = lost_counts,
    [FAULT_ENCODER_NOISE] = noise_deg,
    [FAULT_ENCODER_SLIP] = slip_deg_s,
    [FAULT_COULOMB_FRICTION] = friction_Nm,
    [FAULT_STATIC_FRICTION] = friction_Nm,
    [FAULT_SUPPLY_SAGGED] = sag_percent,
    [FAULT_SUPPLY_SURGED] = surge_percent,
    [FAULT_SUPPLY_RIPPLE] = ripple_V,
    [FAULT_INTERRUPT_LATE] = late_us,
    [FAULT_WINDING_TEMPERATURE_SENSOR_STUCK] = counts_of_adc,
    [FAULT_WINDING_TEMPERATURE_SENSOR_OFFSET] = offset_K,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_STUCK] = counts_of_adc,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET] = offset_K,
    [FAULT_CLOCK_DRIFT] = drift_percent,
};

static double attribute_of(const world_t *world, unsigned kind, double unit) {
    return !fault_kinds[kind].has_attribute ? 0.0
           : attributes[kind] != NULL       ? attributes[kind](world, unit)
                                            : floor(unit * (fault_kinds[kind].raw_maximum + 1.0));
}

/* --- Faults --- */

static bool possible(const world_t *world, unsigned kind) {
    const machine_t *machine = &world->machine->image.machine;
    /* The host has no program and no stack of the drive alone. */
    const bool of_target = kind == FAULT_CODE_FLIPPED || kind == FAULT_STACK_GUARD_FLIPPED;
    return fault_kinds[kind].name && !of_target &&
           !(kind == FAULT_CHOPPER_OPEN &&
             (machine->dc_link.capacitance_F == 0.0 || machine->dc_link.chopper_resistance_ohm == 0.0));
}

static void draw_fault(world_t *world, unsigned kind, uint64_t last_us) {
    const uint64_t seed = world->seed, base = (uint64_t)kind * FAULT_DRAWS;
    /* A fifth is there before the start. */
    const bool early = seeded_unit(seed, STREAM_FAULT, base) < 0.2;
    const uint64_t begin_us = early ? 0 : (uint64_t)seeded_between(seed, STREAM_FAULT, base + 1, 5e3, (double)last_us);
    uint64_t end_us = begin_us + 20 + (uint64_t)seeded_logarithmic(seed, STREAM_FAULT, base + 2, 30.0, 2e5);
    const bool remains = seeded_unit(seed, STREAM_FAULT, base + 6) < REMAINING_SHARE;
    end_us = end_us < last_us && !remains ? end_us : last_us;
    world_event_t *event = end_us > begin_us ? world_add(world, WORLD_FAULT, begin_us, end_us) : NULL;
    if (!event) {
        return;
    }
    event->what = kind;
    event->phase = fault_kinds[kind].has_phase
                       ? seeded_below(seed, STREAM_FAULT, base + 3, world->machine->image.machine.phases)
                       : 0;
    event->leg = fault_kinds[kind].has_leg ? seeded_below(seed, STREAM_FAULT, base + 4, 2) : 0;
    const double value = attribute_of(world, kind, seeded_unit(seed, STREAM_FAULT, base + 5));
    if (fault_kinds[kind].has_attribute) {
        event->raw = (int32_t)fmin(fmax(floor(value / fault_kinds[kind].scale + 0.5), fault_kinds[kind].raw_minimum),
                                   fault_kinds[kind].raw_maximum);
    }
    event->value = value;
}

/* Faults of the bus, both lines of safe torque off, late interrupts and resets: bench variables. */
void world_draw_other_faults(world_t *world, uint64_t last_us) {
    const uint64_t seed = world->seed;
    const struct {
        unsigned variable;
        double value, after;
    } all[] = {
        {BENCH_VARIABLE_STO_1, 1, 0},
        {BENCH_VARIABLE_STO_2, 1, 0},
        {BENCH_VARIABLE_INTERRUPT_TIME_US, seeded_logarithmic(seed, STREAM_GATES, 90, 5.0, 5000.0), 0},
        {BENCH_VARIABLE_BABBLE_LOAD_PERCENT, seeded_between(seed, STREAM_BUS, 90, 20.0, 100.0), 0},
        {BENCH_VARIABLE_BUS_CONNECTION, 0, 1},
        {BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER, 256, 0},
        {BENCH_VARIABLE_FRAME_FAULT, 1 + seeded_below(seed, STREAM_BUS, 91, 4), 0},
        {BENCH_VARIABLE_DRIVE_RESET, 1, 0},
    };
    for (unsigned i = 0; i < sizeof all / sizeof *all; i++) {
        if (seeded_unit(seed, STREAM_GATES, i) >= 0.05) {
            continue;
        }
        const uint64_t begin_us = (uint64_t)seeded_between(seed, STREAM_GATES, 20 + i, 2e3, (double)last_us);
        uint64_t end_us = begin_us + (uint64_t)seeded_logarithmic(seed, STREAM_GATES, 40 + i, 100.0, 3e5);
        end_us = end_us < last_us ? end_us : last_us;
        if (all[i].variable == BENCH_VARIABLE_FRAME_FAULT) {
            world_add_set(world, BENCH_VARIABLE_FRAME_FAULT_PER_MILLE,
                          seeded_between(seed, STREAM_BUS, 92, 10.0, 1000.0), 0.0, begin_us, end_us);
            world_add_set(world, BENCH_VARIABLE_FRAME_DELAY_US, seeded_between(seed, STREAM_BUS, 93, 0.0, 1e5), 0.0,
                          begin_us, 0);
        }
        const bool once =
            all[i].variable == BENCH_VARIABLE_DRIVE_RESET || all[i].variable == BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER;
        world_add_set(world, all[i].variable, all[i].value, all[i].after, begin_us, once ? 0 : end_us);
        if (all[i].variable == BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER && seeded_unit(seed, STREAM_BUS, 94) < 0.5) {
            world_add_set(world, all[i].variable, all[i].value, all[i].after, end_us, 0); /* once more */
        }
    }
}

bool world_is_faultless(uint64_t seed) {
    return seeded_unit(seed, STREAM_REQUEST, 14) < FAULTLESS_SHARE;
}

/* Loss of two phases, one after the other. */
bool world_loses_two(uint64_t seed) {
    return seeded_unit(seed, STREAM_REQUEST, 4) < DEGRADED_SHARE / 2.0 &&
           seeded_unit(seed, STREAM_REQUEST, 12) < SECOND_LOSS_SHARE;
}

bool world_has_lasting_fault(uint64_t seed) {
    return seeded_unit(seed, STREAM_REQUEST, 11) < LASTING_SHARE;
}

/* Some of the kinds; in half of the worlds with degraded running one that such a drive runs on with, alone. */
void world_draw_faults(world_t *world, uint64_t last_us) {
    static const unsigned endured[] = {FAULT_WINDING_OPEN, FAULT_SWITCH_OPEN, FAULT_GATE_SUPPLY_LOST,
                                       FAULT_CURRENT_SENSOR_OPEN};
    static const unsigned slow[] = {FAULT_SHAFT_LOCKED,
                                    FAULT_SHAFT_LOCKED,
                                    FAULT_COULOMB_FRICTION,
                                    FAULT_STATIC_FRICTION,
                                    FAULT_CURRENT_SENSOR_GAIN,
                                    FAULT_ENCODER_STUCK,
                                    FAULT_ENCODER_SLIP,
                                    FAULT_ENCODER_LOST_COUNTS,
                                    FAULT_CHOPPER_OPEN,
                                    FAULT_WINDING_TEMPERATURE_SENSOR_OFFSET,
                                    FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET};
    const uint64_t seed = world->seed;
    if (seeded_unit(seed, STREAM_REQUEST, 4) < DEGRADED_SHARE / 2.0) {
        const unsigned first = seeded_below(seed, STREAM_REQUEST, 5, 4), from = world->events;
        draw_fault(world, endured[first], last_us);
        if (world_loses_two(seed)) {
            draw_fault(world, endured[(first + 1) % 4], last_us);
            for (unsigned i = from; i < world->events; i++) {
                world->event[i].end_us = last_us;
            }
        }
        return;
    }
    if (world_has_lasting_fault(seed)) {
        const bool slow_one = seeded_unit(seed, STREAM_REQUEST, 15) < SLOW_SHARE;
        const unsigned kind = slow_one ? slow[seeded_below(seed, STREAM_REQUEST, 13, sizeof slow / sizeof *slow)]
                                       : 1 + seeded_below(seed, STREAM_REQUEST, 13, FAULT_COUNT - 1);
        if (possible(world, kind)) {
            draw_fault(world, kind, last_us);
        }
        if (world->events > 0 && world->event[world->events - 1].kind == WORLD_FAULT) {
            world->event[world->events - 1].end_us = last_us;
        }
        return;
    }
    if (world_is_faultless(seed)) {
        return;
    }
    unsigned faults = 0;
    for (unsigned i = 1; i < FAULT_COUNT && faults < FAULTS_MAX; i++) {
        const unsigned kind = 1 + (i + (unsigned)(seed % (FAULT_COUNT - 1))) % (FAULT_COUNT - 1);
        if (possible(world, kind) && seeded_unit(seed, STREAM_FAULT_ON, kind) < FAULT_SHARE) {
            draw_fault(world, kind, last_us);
            faults++;
        }
    }
}
