#include "campaign/world_draw.h"

#include <math.h>

#include "bench_variables.h"
#include "campaign/seeded.h"
#include "campaign/world_faults.h"
#include "campaign/world_streams.h"

/* Shares of the seeds. */
#define FASTEST_SHARE 0.1        /* at the highest control rate */
#define TORQUE_SHARE 0.15        /* in torque mode for some time */
#define STOP_SHARE 0.1           /* stopped for some time, or off, */
#define FAULTLESS_STOP_SHARE 0.3 /* of those without a fault */
#define HOT_SHARE 0.05           /* with a heat sink that leaves a part of the torque */
#define LIMITED_SHARE 0.04       /* with another limit of the torque, */
#define SAVED_SHARE 0.5          /* which is saved, and there after a reset */
#define OVERHAULING_SHARE 0.1
#define RUNAWAY_SHARE 0.3        /* of the torque mode: the largest torque, to the end */
#define TORQUE_STOP_SHARE 0.3    /* of the torque mode: ends with a stop */
#define LONG_SHARE 0.08          /* long enough for what takes long to be noticed, */
#define FAULTLESS_LONG_SHARE 0.4 /* or to be followed */
#define WRONG_CHECK_SHARE 0.15   /* of the sets of parameters */
#define BEYOND_SHARE 0.04        /* a speed beyond the largest one is commanded for some time */
#define CLEARING_SHARE 0.03      /* the client sends nothing but clear_fault until all is over */
#define REVERSE_SHARE 0.4        /* of the speeds, with a controller of four quadrants, */
#define REFUSED_SHARE 0.05       /* and of one, which does not turn then */
#define KEEPING_SHARE 0.5        /* the reference stays in the frames of stop and off */

/* Resistance of copper at -40 and at 155 C, of that at 25 C. Temperatures that the drive measures limit its torque. */
#define COLD_GAIN 0.75
#define WARM_GAIN 1.5

/* Limits of the random number that selects the client's script. Below each: the client is silent; it is silent while a
 * hostile one is not; both send; it is silent while a second one is not; both send. */
#define SILENT_PART 0.12
#define DESERTED_PART 0.15
#define HOSTILE_PART 0.24
#define DESERTED_SECOND_PART 0.26
#define SECOND_PART 0.32

static void add_speed(world_t *world, double rpm, uint64_t begin_us) {
    world_event_t *event = world_add(world, WORLD_SPEED, begin_us, 0);
    if (event) {
        const double limit = world->machine->speed_command_max_rpm;
        event->value = fmax(fmin(rpm, limit), -limit);
    }
}

void world_draw_board(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed) {
    static const unsigned rates_hz[] = {20000, 40000, 40000, 50000};
    *world = (world_t){.seed = seed, .kept = UINT64_MAX};
    world->machine = &machines[seeded_below(seed, STREAM_BOARD, 0, count)];
    const machine_t *machine = &world->machine->image.machine;
    world->control_rate_hz = rates_hz[seeded_below(seed, STREAM_BOARD, 1, 4)];
    if (world->control_rate_hz < world->machine->rate_min_hz) {
        world->control_rate_hz = world->machine->rate_min_hz > 50000 ? 100000 : 50000;
    }
    if (seeded_unit(seed, STREAM_BOARD, 7) < FASTEST_SHARE) {
        world->control_rate_hz = 100000;
    }
    world->controller = seeded_below(seed, STREAM_BOARD, 2, 3);
    world->encoder_bits = 10 + seeded_below(seed, STREAM_BOARD, 3, 11);
    world->adc_bits = 12 + seeded_below(seed, STREAM_BOARD, 4, 3);
    world->encoder_edges = seeded_below(seed, STREAM_BOARD, 5, 2);
    world->initial_angle_deg = seeded_between(seed, STREAM_BOARD, 6, 0.0, 360.0);
    world->supply_V = machine->supply_voltage_V;
    world->inertia_gain = 1.0;
}

/* As built machines and boards scatter; the ranges of the robustness study, the encoder apart. */
void world_draw_imperfections(world_t *world) {
    const uint64_t seed = world->seed;
    const machine_t *machine = &world->machine->image.machine;
    const double range_A = machine->ranges.current_A;
    world->inertia_gain = seeded_logarithmic(seed, STREAM_IMPERFECTION, 2, 0.7, 2.0);
    const struct {
        unsigned variable;
        double value;
    } all[] = {
        {BENCH_VARIABLE_FLUX_LINKAGE_GAIN, seeded_between(seed, STREAM_IMPERFECTION, 0, 0.95, 1.05)},
        {BENCH_VARIABLE_RESISTANCE_GAIN, seeded_between(seed, STREAM_IMPERFECTION, 1, world->healthy ? COLD_GAIN : 0.8,
                                                        world->healthy ? WARM_GAIN : 1.4)},
        {BENCH_VARIABLE_INERTIA_GAIN, world->inertia_gain},
        {BENCH_VARIABLE_FRICTION_GAIN, seeded_between(seed, STREAM_IMPERFECTION, 3, 0.0, 3.0)},
        {BENCH_VARIABLE_ENCODER_OFFSET_DEG, seeded_between(seed, STREAM_IMPERFECTION, 4, -0.1, 0.1)},
        {BENCH_VARIABLE_CURRENT_NOISE_A, seeded_between(seed, STREAM_IMPERFECTION, 5, 0.0, 0.0005 * range_A)},
    };
    for (unsigned i = 0; i < sizeof all / sizeof *all; i++) {
        const bool always = world->healthy && all[i].variable == BENCH_VARIABLE_RESISTANCE_GAIN;
        if (seeded_unit(seed, STREAM_IMPERFECTION, 100 + i) < 0.5 || always) {
            world_add_set(world, all[i].variable, all[i].value, all[i].value, 0, 0);
        } else if (all[i].variable == BENCH_VARIABLE_INERTIA_GAIN) {
            world->inertia_gain = 1.0;
        }
    }
}

/* Largest load at a speed that leaves the drive a reserve. */
static double load_max_Nm(const world_t *world, double rpm) {
    const world_machine_t *machine = world->machine;
    const double part = fabs(rpm) / machine->speed_base_rpm;
    const double friction = machine->image.machine.friction_Nm_s * 3.0 * fabs(rpm) * WORLD_RAD_S_PER_RPM;
    return fmax(0.0, 0.6 * machine->torque_rated_Nm * (part < 0.8 ? 1.0 : 0.8 / part) - friction);
}

static double draw_speed_rpm(const world_t *world, unsigned index) {
    const double rpm = world->machine->speed_base_rpm * seeded_logarithmic(world->seed, STREAM_SPEED, index, 0.02, 1.0);
    const double share = world->controller == 2 ? REVERSE_SHARE : REFUSED_SHARE;
    const bool reverse = seeded_unit(world->seed, STREAM_SPEED, 50 + index) < share;
    return reverse ? -rpm : rpm;
}

/* Load of one of five sorts from begin_us on; an overhauling one drives the machine. */
static void draw_load(world_t *world, double rpm, uint64_t begin_us) {
    const uint64_t seed = world->seed;
    const bool overhauling = !world->healthy && seeded_unit(seed, STREAM_LOAD, 4) < OVERHAULING_SHARE;
    const bool backwards = rpm < 0.0 && world->controller == 2;
    const double sign = backwards != overhauling ? -1.0 : 1.0;
    const double torque_Nm = load_max_Nm(world, rpm) * seeded_unit(seed, STREAM_LOAD, 1);
    const bool coarse = world->machine->torque_max_Nm > 150.0;
    const unsigned step = coarse ? BENCH_VARIABLE_LOAD_TORQUE_COARSE_NM : BENCH_VARIABLE_LOAD_TORQUE_NM;
    const unsigned ramp = coarse ? BENCH_VARIABLE_LOAD_RAMP_COARSE_NM_S : BENCH_VARIABLE_LOAD_RAMP_NM_S;
    const unsigned sine = coarse ? BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_COARSE_NM : BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_NM;
    switch (seeded_below(seed, STREAM_LOAD, 0, 4)) {
    case 0:
        break;
    case 1:
        world_add_set(world, step, sign * torque_Nm, 0.0, begin_us, world->recovery_us);
        break;
    case 2:
        world_add_set(world, ramp, torque_Nm / seeded_logarithmic(seed, STREAM_LOAD, 2, 0.002, 0.2), 0.0,
                      begin_us - 1000, world->recovery_us);
        world_add_set(world, step, sign * torque_Nm, 0.0, begin_us, world->recovery_us ? world->recovery_us + 1000 : 0);
        break;
    default:
        world_add_set(world, BENCH_VARIABLE_LOAD_SINE_FREQUENCY_HZ,
                      seeded_logarithmic(seed, STREAM_LOAD, 3, 1.0, 100.0), 1.0, begin_us - 1000, 0);
        world_add_set(world, sine, 0.3 * torque_Nm, 0.0, begin_us, world->recovery_us);
        world_add_set(world, step, sign * 0.7 * torque_Nm, 0.0, begin_us, world->recovery_us);
        break;
    }
}

/* In a part of the worlds the client commands a torque for some time. */
static void draw_torque(world_t *world, uint64_t last_us) {
    const uint64_t seed = world->seed;
    if (seeded_unit(seed, STREAM_TORQUE, 0) >= TORQUE_SHARE) {
        return;
    }
    const uint64_t begin_us = (uint64_t)seeded_between(seed, STREAM_TORQUE, 1, 0.0, (double)last_us);
    const uint64_t end_us = begin_us + (uint64_t)seeded_logarithmic(seed, STREAM_TORQUE, 2, 5e3, 3e5);
    const bool runaway = seeded_unit(seed, STREAM_TORQUE, 4) < RUNAWAY_SHARE;
    world_event_t *event = world_add(world, WORLD_TORQUE, begin_us, end_us < last_us && !runaway ? end_us : last_us);
    const double part = seeded_between(seed, STREAM_TORQUE, 3, world->controller == 2 ? -1.0 : 0.0, 1.0);
    event->value = runaway ? copysign(world->machine->torque_max_Nm, part) : part * world->machine->torque_rated_Nm;
    if (!world->healthy && seeded_unit(seed, STREAM_TORQUE, 5) < TORQUE_STOP_SHARE) {
        world_event_t *stop = world_add(world, WORLD_REQUEST, begin_us + (event->end_us - begin_us) / 3, last_us);
        stop->what = WORLD_REQUEST_STOP;
        event->end_us = last_us;
    }
}

static double start_s(const world_t *world, double from_rpm, double to_rpm) {
    const machine_t *machine = &world->machine->image.machine;
    return machine->inertia_kg_m2 * world->inertia_gain * fabs(to_rpm - from_rpm) * WORLD_RAD_S_PER_RPM /
           world->machine->torque_max_Nm;
}

static void draw_script(world_t *world, uint64_t last_us) {
    const uint64_t seed = world->seed;
    const uint64_t begin_us = (uint64_t)seeded_between(seed, STREAM_SCRIPT, 1, 2e4, (double)last_us);
    const uint64_t end_us = begin_us + (uint64_t)seeded_logarithmic(seed, STREAM_SCRIPT, 2, 5e3, 1.5e6);
    const double sort = seeded_unit(seed, STREAM_SCRIPT, 0);
    if (sort < SILENT_PART) {
        world_add(world, WORLD_SILENT, begin_us, end_us < last_us ? end_us : last_us);
        const uint64_t again_us = end_us + (uint64_t)seeded_logarithmic(seed, STREAM_SCRIPT, 7, 1e4, 1e5);
        if (again_us < last_us) {
            world_add(world, WORLD_SILENT, again_us, last_us);
        }
    } else if (sort < HOSTILE_PART) {
        if (sort < DESERTED_PART) {
            world_add(world, WORLD_SILENT, begin_us, last_us);
        }
        world_event_t *event = world_add(world, WORLD_HOSTILE, begin_us, end_us < last_us ? end_us : last_us);
        event->what = seeded_below(seed, STREAM_SCRIPT, 3, WORLD_HOSTILE_SORTS);
    } else if (sort < SECOND_PART) {
        if (sort < DESERTED_SECOND_PART) { /* the second client alone */
            world_add(world, WORLD_SILENT, begin_us, last_us);
        }
        world_add(world, WORLD_SECOND, begin_us, end_us < last_us ? end_us : last_us);
    }
    if (seeded_unit(seed, STREAM_SCRIPT, 4) < 0.3) {
        world_add(world, WORLD_EAGER, 0, 0);
    }
    if (seeded_unit(seed, STREAM_SCRIPT, 5) < 0.05) {
        world_add(world, WORLD_UNARMED, (uint64_t)seeded_between(seed, STREAM_SCRIPT, 6, 0.0, (double)last_us),
                  last_us);
    }
}

static bool hot(uint64_t seed) {
    return seeded_unit(seed, STREAM_REQUEST, 22) < HOT_SHARE;
}

static bool limited(uint64_t seed) {
    return seeded_unit(seed, STREAM_REQUEST, 18) < LIMITED_SHARE;
}

/* In a part of the worlds the client stops the drive for some time, or switches it off. */
static void draw_request(world_t *world, uint64_t last_us) {
    const uint64_t seed = world->seed;
    if (seeded_unit(seed, STREAM_REQUEST, 0) < (world_is_faultless(seed) ? FAULTLESS_STOP_SHARE : STOP_SHARE)) {
        const uint64_t begin_us = (uint64_t)seeded_between(seed, STREAM_REQUEST, 1, 1e4, (double)last_us);
        const uint64_t end_us = begin_us + (uint64_t)seeded_logarithmic(seed, STREAM_REQUEST, 2, 2e3, 1e6);
        world_event_t *event = world_add(world, WORLD_REQUEST, begin_us, end_us < last_us ? end_us : last_us);
        event->what = seeded_unit(seed, STREAM_REQUEST, 3) < 0.7 ? WORLD_REQUEST_STOP : WORLD_REQUEST_OFF;
    }
    if (seeded_unit(seed, STREAM_REQUEST, 4) < DEGRADED_SHARE) {
        world_event_t *event = world_add(world, WORLD_DEGRADED, 0, 0);
        event->what = seeded_unit(seed, STREAM_REQUEST, 16) < WRONG_CHECK_SHARE ? WORLD_DEGRADED_WRONG_CHECK
                                                                                : WORLD_DEGRADED_RIGHT_CHECK;
    }
    if (limited(seed)) {
        world_event_t *event = world_add(world, WORLD_LIMITED, 0, 0);
        event->value = seeded_between(seed, STREAM_REQUEST, 19, 0.6, 0.85);
        event->what = seeded_unit(seed, STREAM_REQUEST, 20) < SAVED_SHARE;
        if (event->what) {
            const uint64_t reset_us = (uint64_t)(seeded_between(seed, STREAM_REQUEST, 21, 0.4, 0.7) * (double)last_us);
            world_add_set(world, BENCH_VARIABLE_DRIVE_RESET, 1, 0, reset_us, 0);
        }
    }
    if (seeded_unit(seed, STREAM_REQUEST, 6) < BEYOND_SHARE) {
        const uint64_t begin_us = (uint64_t)seeded_between(seed, STREAM_REQUEST, 7, 1e4, (double)last_us);
        world_event_t *event = world_add(world, WORLD_BEYOND, begin_us, last_us);
        const double part = seeded_between(seed, STREAM_REQUEST, 8, 1.01, 2.0);
        event->value = seeded_unit(seed, STREAM_REQUEST, 9) < 0.5 ? -part : part;
    }
    if (seeded_unit(seed, STREAM_REQUEST, 10) < CLEARING_SHARE) {
        world_event_t *event = world_add(world, WORLD_REQUEST, 0, last_us);
        event->what = WORLD_REQUEST_CLEAR;
    }
}

void world_draw(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed) {
    world_draw_board(world, machines, count, seed);
    world->keeps_reference = seeded_unit(seed, STREAM_REQUEST, 17) < KEEPING_SHARE;
    world_draw_imperfections(world);
    const double first_rpm = draw_speed_rpm(world, 0);
    uint64_t last_us = (uint64_t)(1e6 * fmin(0.1 + 1.5 * start_s(world, 0.0, first_rpm),
                                             seeded_between(seed, STREAM_SCRIPT, 9, 0.1, 0.4)));
    const double sort = seeded_unit(seed, STREAM_SCRIPT, 0);
    const bool deserted =
        (sort >= SILENT_PART && sort < DESERTED_PART) || (sort >= HOSTILE_PART && sort < DESERTED_SECOND_PART);
    const bool is_long =
        sort < 0.04 || deserted || world_has_lasting_fault(seed) || world_loses_two(seed) || limited(seed) ||
        hot(seed) ||
        seeded_unit(seed, STREAM_SCRIPT, 8) < (world_is_faultless(seed) ? FAULTLESS_LONG_SHARE : LONG_SHARE);
    last_us = is_long ? 900000 : last_us;
    world->recovery_us = last_us + 25000;
    add_speed(world, first_rpm, 0);
    if (seeded_unit(seed, STREAM_SPEED, 90) < 0.4) {
        add_speed(world, draw_speed_rpm(world, 1),
                  (uint64_t)(seeded_between(seed, STREAM_SPEED, 91, 0.3, 1.0) * (double)last_us));
    }
    draw_load(world, first_rpm, (uint64_t)seeded_between(seed, STREAM_LOAD, 9, 1e4, (double)last_us));
    draw_script(world, last_us);
    draw_torque(world, last_us);
    draw_request(world, last_us);
    if (hot(seed)) {
        const double inverter_C = seeded_between(seed, STREAM_REQUEST, 23, 84.0, 90.0);
        world_add_set(world, BENCH_VARIABLE_HELD_INVERTER_C, inverter_C, 25.0, 0, last_us);
    }
    world_draw_faults(world, last_us);
    world_draw_other_faults(world, last_us);
    world->duration_us = world->recovery_us + 320000;
}

void world_draw_healthy(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed) {
    world_draw_board(world, machines, count, seed);
    world->healthy = true;
    world_draw_imperfections(world);
    double rpm = 0.0, at_s = 0.0;
    const unsigned changes = 1 + seeded_below(seed, STREAM_SPEED, 80, 3);
    for (unsigned i = 0; i < changes; i++) {
        const double next_rpm = draw_speed_rpm(world, i);
        add_speed(world, next_rpm, (uint64_t)(at_s * 1e6));
        at_s += fmin(2.0 * start_s(world, rpm, next_rpm) + 0.1, 3.0);
        rpm = next_rpm;
    }
    draw_load(world, rpm, (uint64_t)(at_s * 1e6));
    draw_torque(world, (uint64_t)(at_s * 1e6));
    world->duration_us = (uint64_t)((at_s + seeded_between(seed, STREAM_LOAD, 8, 0.3, 1.0)) * 1e6);
}
