#include "campaign/world_motion.h"

#include <math.h>

#include "bench_variables.h"
#include "campaign/seeded.h"
#include "campaign/world_draw.h"
#include "campaign/world_faults.h"
#include "campaign/world_streams.h"

/* Shares of the seeds. */
#define CANOPEN_SHARE 0.75
#define ONE_QUADRANT_SHARE 0.1 /* with a controller that has no modes of position */
#define LOADED_SHARE 0.4
#define FAULTY_SHARE 0.15     /* with faults of the bench */
#define LIMITED_SHARE 0.4     /* with limits of the position */
#define CHANGING_SHARE 0.35   /* of the masters: another mode in the run */
#define CONTROLLING_SHARE 0.4 /* a controlword of the stops, or of halt */
#define NMT_SHARE 0.12
#define LOST_SHARE 0.25
#define NOISE_SHARE 0.1
#define RIVAL_SHARE 0.08
#define RELATIVE_SHARE 0.3
#define IMMEDIATE_SHARE 0.5
#define HOSTILE_SHARE 0.1 /* of the clients of drive.dbc */

#define TARGETS_MAX 5
#define FIRST_US 120000  /* by then a client has started the drive */
#define AFTER_US 1300000 /* a ramp and the second after which a lost master's run ends */
#define LOAD_MAX 0.4     /* of the rated torque */

static double unit(const world_t *world, unsigned index) {
    return seeded_unit(world->seed, STREAM_MOTION, index);
}

/* Largest acceleration, r/min/s. */
static double acceleration_max(const world_t *world) {
    const machine_t *machine = &world->machine->image.machine;
    return world->machine->torque_max_Nm / (machine->inertia_kg_m2 * world->inertia_gain) / WORLD_RAD_S_PER_RPM;
}

static uint64_t time_us(const world_t *world, unsigned index, uint64_t last_us) {
    return (uint64_t)seeded_between(world->seed, STREAM_MOTION_EVENT, index, FIRST_US, (double)last_us);
}

/* Ways of which the longest takes some tenths of a second. */
static double draw_way_rev(const world_t *world, unsigned index) {
    const double base_rev_s = world->machine->speed_base_rpm / 60.0;
    const double way = seeded_logarithmic(world->seed, STREAM_MOTION_TARGET, index, 3e-5, 0.2 * base_rev_s + 0.1);
    return seeded_unit(world->seed, STREAM_MOTION_TARGET, 100 + index) < 0.5 ? -way : way;
}

static void draw_targets(world_t *world, uint64_t last_us) {
    const uint64_t seed = world->seed;
    const unsigned targets = seeded_below(seed, STREAM_MOTION_TARGET, 90, TARGETS_MAX + 1);
    double at_rev = 0.0;
    for (unsigned i = 0; i < targets; i++) {
        const uint64_t begin_us = FIRST_US + (last_us - FIRST_US) * i / targets +
                                  seeded_below(seed, STREAM_MOTION_TARGET, 80 + i, (unsigned)(last_us / targets));
        world_event_t *event = world_add(world, WORLD_TARGET, begin_us, 0);
        at_rev += draw_way_rev(world, i);
        const bool relative =
            world->client == WORLD_CLIENT_CANOPEN && seeded_unit(seed, STREAM_MOTION_TARGET, 20 + i) < RELATIVE_SHARE;
        event->what =
            (seeded_unit(seed, STREAM_MOTION_TARGET, 40 + i) < IMMEDIATE_SHARE ? WORLD_TARGET_IMMEDIATELY : 0) |
            (relative ? WORLD_TARGET_RELATIVE : 0);
        event->value = relative ? draw_way_rev(world, i) : at_rev;
    }
}

static void draw_load(world_t *world, uint64_t last_us) {
    if (unit(world, 20) >= LOADED_SHARE) {
        return;
    }
    const bool coarse = world->machine->torque_max_Nm > 150.0;
    const double torque_Nm = LOAD_MAX * world->machine->torque_rated_Nm * (2.0 * unit(world, 21) - 1.0);
    world_add_set(world, coarse ? BENCH_VARIABLE_LOAD_TORQUE_COARSE_NM : BENCH_VARIABLE_LOAD_TORQUE_NM, torque_Nm, 0.0,
                  time_us(world, 0, last_us), 0);
}

static unsigned draw_mode(const world_t *world, unsigned index) {
    static const unsigned modes[] = {1, 1, 1, 8, 8, 3, 9, 4, 10, 6};
    return modes[seeded_below(world->seed, STREAM_MOTION_EVENT, index, sizeof modes / sizeof *modes)];
}

static void draw_setting(world_t *world) {
    static const unsigned cycles_ms[] = {1, 2, 4, 10}, quick_stops[] = {2, 2, 2, 0, 1, 5, 6}, aborts[] = {3, 3, 1, 2};
    const uint64_t seed = world->seed;
    world_master_t *master = &world->master;
    master->mode = draw_mode(world, 200);
    master->cycle_ms = cycles_ms[seeded_below(seed, STREAM_MOTION, 30, 4)];
    master->synchronous = unit(world, 31) < 0.4;
    master->watch = (world_watch_t)seeded_below(seed, STREAM_MOTION, 32, 4);
    master->watch_ms = (unsigned)seeded_logarithmic(seed, STREAM_MOTION, 33, 4.0 * master->cycle_ms + 16.0, 400.0);
    master->quick_stop_option = quick_stops[seeded_below(seed, STREAM_MOTION, 34, 7)];
    master->abort_option = aborts[seeded_below(seed, STREAM_MOTION, 35, 4)];
    master->halt_option = 1 + seeded_below(seed, STREAM_MOTION, 36, 2);
    master->speed_rpm =
        fmax(1.0, floor(world->machine->speed_base_rpm * seeded_logarithmic(seed, STREAM_MOTION, 37, 0.05, 0.9)));
    master->acceleration_rpm_s =
        fmin(1e6, fmax(1.0, floor(acceleration_max(world) * seeded_logarithmic(seed, STREAM_MOTION, 38, 0.1, 0.8))));
    master->torque = seeded_between(seed, STREAM_MOTION, 39, -0.3, 0.3);
    master->limited = unit(world, 40) < LIMITED_SHARE;
    master->lowest_rev = -fabs(draw_way_rev(world, 60)) - 0.05;
    master->highest_rev = 1.0 + fabs(draw_way_rev(world, 61)) + 0.05; /* the drive begins in its first turn */
}

static void draw_masters_events(world_t *world, uint64_t last_us) {
    static const unsigned words[] = {0x00, 0x02, 0x02, 0x02, 0x06, 0x07, 0x10F, 0x10F, 0x8F},
                          commands[] = {2, 128, 129, 130};
    const uint64_t seed = world->seed;
    const unsigned changes = unit(world, 50) < CHANGING_SHARE ? 1 + seeded_below(seed, STREAM_MOTION, 51, 3) : 0;
    for (unsigned i = 0; i < changes; i++) {
        world_event_t *event = world_add(world, WORLD_MODE, time_us(world, 10 + i, last_us), 0);
        event->what = draw_mode(world, 210 + i);
    }
    const unsigned controls = unit(world, 52) < CONTROLLING_SHARE ? 1 + seeded_below(seed, STREAM_MOTION, 53, 2) : 0;
    for (unsigned i = 0; i < controls; i++) {
        const uint64_t begin_us = time_us(world, 20 + i, last_us);
        const bool lasts = seeded_unit(seed, STREAM_MOTION_EVENT, 230 + i) < 0.4;
        const uint64_t for_us = (uint64_t)seeded_logarithmic(seed, STREAM_MOTION_EVENT, 30 + i, 1e3, 3e5);
        world_event_t *event = world_add(world, WORLD_CONTROL, begin_us, lasts ? 0 : begin_us + for_us);
        event->what = words[seeded_below(seed, STREAM_MOTION_EVENT, 40 + i, sizeof words / sizeof *words)];
    }
    if (unit(world, 54) < NMT_SHARE) {
        world_event_t *event = world_add(world, WORLD_NMT, time_us(world, 50, last_us), 0);
        event->what = commands[seeded_below(seed, STREAM_MOTION_EVENT, 51, 4)];
    }
    if (unit(world, 55) < LOST_SHARE) {
        const uint64_t begin_us = time_us(world, 60, last_us);
        const uint64_t for_us = (uint64_t)seeded_logarithmic(seed, STREAM_MOTION_EVENT, 61, 2e3, 1e6);
        world_add(world, WORLD_LOST, begin_us,
                  seeded_unit(seed, STREAM_MOTION_EVENT, 62) < 0.6 ? 0 : begin_us + for_us);
    }
    if (unit(world, 56) < NOISE_SHARE) {
        world_add(world, WORLD_NOISE, time_us(world, 70, last_us), 0);
    }
    if (unit(world, 57) < RIVAL_SHARE) {
        world_event_t *event = world_add(world, WORLD_MASTER, time_us(world, 80, last_us), last_us);
        event->what = words[seeded_below(seed, STREAM_MOTION_EVENT, 81, sizeof words / sizeof *words)];
    }
    if (unit(world, 58) < 0.5) {
        world_add(world, WORLD_EAGER, 0, 0);
    }
}

/* Silence, requests and hostile frames of a client of drive.dbc. */
static void draw_clients_events(world_t *world, uint64_t last_us) {
    if (unit(world, 55) < LOST_SHARE) {
        const uint64_t begin_us = time_us(world, 60, last_us);
        const uint64_t for_us = (uint64_t)seeded_logarithmic(world->seed, STREAM_MOTION_EVENT, 61, 2e3, 1e6);
        world_add(world, WORLD_SILENT, begin_us, begin_us + for_us);
    }
    if (unit(world, 52) < CONTROLLING_SHARE) {
        const uint64_t begin_us = time_us(world, 20, last_us);
        const uint64_t for_us = (uint64_t)seeded_logarithmic(world->seed, STREAM_MOTION_EVENT, 30, 2e3, 5e5);
        world_event_t *event = world_add(world, WORLD_REQUEST, begin_us, begin_us + for_us);
        event->what = seeded_unit(world->seed, STREAM_MOTION_EVENT, 40) < 0.5 ? WORLD_REQUEST_STOP : WORLD_REQUEST_OFF;
    }
    if (unit(world, 56) < HOSTILE_SHARE) {
        world_event_t *event = world_add(world, WORLD_HOSTILE, time_us(world, 70, last_us), last_us);
        event->what = seeded_below(world->seed, STREAM_MOTION_EVENT, 71, WORLD_HOSTILE_SORTS);
    }
    if (unit(world, 58) < 0.5) {
        world_add(world, WORLD_EAGER, 0, 0);
    }
}

void world_draw_motion(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed) {
    world_draw_board(world, machines, count, seed);
    world->client = unit(world, 0) < CANOPEN_SHARE ? WORLD_CLIENT_CANOPEN : WORLD_CLIENT_POSITION;
    world->controller = unit(world, 1) < ONE_QUADRANT_SHARE ? world->controller : 2;
    world_draw_imperfections(world);
    draw_setting(world);
    const uint64_t last_us = FIRST_US + (uint64_t)seeded_logarithmic(seed, STREAM_MOTION, 2, 2e5, 9e5);
    draw_targets(world, last_us);
    draw_load(world, last_us);
    if (world->client == WORLD_CLIENT_CANOPEN) {
        draw_masters_events(world, last_us);
    } else {
        draw_clients_events(world, last_us);
    }
    if (unit(world, 3) < FAULTY_SHARE) {
        world_draw_faults(world, last_us);
    }
    world->healthy = false;
    world->duration_us = last_us + AFTER_US;
}
