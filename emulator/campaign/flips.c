#define _DEFAULT_SOURCE

#include "campaign/flips.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <unistd.h>

#include "bench_variables.h"
#include "campaign/drive_numbers.h"
#include "fault_kinds.h"

#define PROCESSOR_MAX_S 2 /* of a flip, which takes some hundredths of a second: then the drive no longer returns */
#define VIOLATIONS_MAX 4
#define SPEED_BASE 0.3     /* commanded, of the base speed */
#define LOAD_RATED 0.3     /* of the rated torque */
#define LIMITED 0.8        /* of the torque limit, by the set of parameters */
#define REVERSED_BASE 0.05 /* of the base speed, backwards by torque of the drive */
#define NEVER_US UINT64_C(0)

/* Times of the worlds, in us. */
enum {
    READY_AT = 10000,     /* the drive is in its state since some milliseconds */
    HEARD_AT = 12000,     /* the client begins */
    ARMED_AT = 60000,     /* armed for some milliseconds */
    SET_AT = 62000,       /* the client begins to configure */
    RELEASED_AT = 130000, /* the client runs the drive */
    LOADED_AT = 160000,
    STOPPED_AT = 230000,
    SETTLED_FOR = 150000,
    RUN_FOR = 50000,
    OFF_FOR = 20000,
    FAULT_AT = 120000,
    FAULT_FOR = 3000,
    FAULTY_AT = 340000, /* nothing shows the fault of the sensor any more */
    RECOVERY_AT = 350000,
    RECOVERED_AT = 650000,
};

/* Shared with the children. */
typedef struct {
    uint64_t hash, end_ns;
    unsigned signal, state, cause, violations, sets;
    uint64_t fault_us, run_us; /* start of the last fault, and of the last run; 0: since before the flip */
    bool reset, reversed;
    checkers_violation_t violation[VIOLATIONS_MAX]; /* rules are strings of the program, the same in every child */
} result_t;

/* State of the flipping; one thread, one run. */
static struct {
    const flips_setting_t *setting;
    uint8_t *memory;
    uint32_t bits;
    uint64_t at_us;
    bool flipped, child, reversed;
    uint64_t begin_us;
    result_t *results; /* [0] without a flip */
    result_t *result;
} flipping;

bool flips_parse(flips_setting_t *setting, char *const words[]) {
    *setting = (flips_setting_t){.controller = (unsigned)strtoul(words[0], NULL, 10),
                                 .state = (flips_state_t)strtoul(words[1], NULL, 10),
                                 .first = (uint32_t)strtoul(words[2], NULL, 10),
                                 .count = (uint32_t)strtoul(words[3], NULL, 10),
                                 .step = (uint32_t)strtoul(words[4], NULL, 10)};
    return setting->controller <= 2 && setting->state < FLIPS_STATES && setting->step > 0;
}

/* --- Child --- */

static void finish_child(run_t *run) {
    const checkers_t *checkers = &run->checkers;
    result_t *result = flipping.result;
    result->hash = run->sender.hash;
    result->end_ns = run->rig.board.time_ns;
    result->state = run->drive->view().state;
    result->cause = run->drive->view().fault;
    result->sets = checkers->seen.limit.applied;
    result->reset = checkers->seen.reset_ns > flipping.begin_us * 1000;
    result->reversed = flipping.reversed;
    for (unsigned i = 0; i < checkers->violations; i++) {
        if (checkers->violation[i].time_us >= flipping.begin_us && result->violations < VIOLATIONS_MAX) {
            result->violation[result->violations++] = checkers->violation[i];
        }
    }
    _exit(0);
}

/* All worlds command forwards. */
static void look_at_direction(const run_t *run) {
    const double base_rad_s = run->world->machine->speed_base_rpm / RPM_PER_RAD_S;
    const bool backwards = run->rig.plant.speed_rad_s < -REVERSED_BASE * base_rad_s;
    flipping.reversed = flipping.reversed || (backwards && plant_torque_Nm(&run->rig.plant) < 0.0);
}

static void look_at_state(const run_t *run) {
    const observation_t *seen = &run->checkers.seen;
    if (seen->state_ns > flipping.begin_us * 1000) {
        flipping.result->fault_us =
            seen->drive.state == STATE_FAULT ? seen->state_ns / 1000 : flipping.result->fault_us;
        flipping.result->run_us = seen->drive.state == STATE_RUN ? seen->state_ns / 1000 : flipping.result->run_us;
    }
}

static void before_interrupt_of_child(run_t *run) {
    look_at_direction(run);
    look_at_state(run);
}

/* --- Parent --- */

static void flip_in_child(run_t *run, result_t *result, uint32_t bit, bool flips) {
    setrlimit(RLIMIT_CPU, &(struct rlimit){PROCESSOR_MAX_S, PROCESSOR_MAX_S});
    flipping.child = true;
    flipping.result = result;
    run->before_interrupt = before_interrupt_of_child;
    if (flips) {
        flipping.memory[bit / 8u] ^= (uint8_t)(1u << bit % 8u);
    }
}

/* True in the child. */
static bool branch(run_t *run, result_t *result, uint32_t bit, bool flips) {
    const bool child = run_fork(&result->signal);
    if (child) {
        flip_in_child(run, result, bit, flips);
    }
    return child;
}

static void before_interrupt(run_t *run) {
    static const unsigned states[FLIPS_STATES] = {STATE_READY, STATE_READY, STATE_RUN, STATE_FAULT};
    const flips_setting_t *setting = flipping.setting;
    const bool armed = setting->state != FLIPS_ARMED || run->sender.armed;
    if (run->rig.board.time_ns < flipping.at_us * 1000 || run->drive->view().state != states[setting->state] ||
        !armed) {
        return;
    }
    flipping.flipped = true;
    flipping.begin_us = run->rig.board.time_ns / 1000;
    if (branch(run, &flipping.results[0], 0, false)) {
        return;
    }
    for (uint32_t i = 0; i < setting->count; i++) {
        const uint32_t bit = setting->first + i * setting->step;
        if (bit < flipping.bits && branch(run, &flipping.results[1 + i], bit, true)) {
            return;
        }
    }
    run->before_interrupt = NULL;
    run->end_ns = run->rig.board.time_ns;
}

/* --- Worlds --- */

static void add(world_t *world, world_kind_t kind, unsigned what, double value, uint64_t begin_us, uint64_t end_us) {
    world_event_t *event = world_add(world, kind, begin_us, end_us);
    event->what = what;
    event->value = value;
}

/* A load that would turn a rotor without torque backwards begins when the drive runs. */
static void add_load(world_t *world, uint64_t begin_us) {
    world_add_set(world, BENCH_VARIABLE_LOAD_TORQUE_NM, LOAD_RATED * world->machine->torque_rated_Nm, 0.0, begin_us,
                  NEVER_US);
}

/* Until the client requests to run it requests off, with a set of parameters in between. */
static void draw_standstill(world_t *world, bool armed) {
    flipping.at_us = armed ? ARMED_AT : READY_AT;
    add(world, WORLD_SILENT, 0, 0.0, 0, HEARD_AT);
    add(world, WORLD_REQUEST, WORLD_REQUEST_OFF, 0.0, 0, RELEASED_AT);
    if (armed) {
        add(world, WORLD_ARMED, 0, 0.0, 0, RELEASED_AT);
    }
    add(world, WORLD_LIMITED, 0, LIMITED, armed ? SET_AT : HEARD_AT, NEVER_US);
    add_load(world, LOADED_AT);
    add(world, WORLD_REQUEST, WORLD_REQUEST_OFF, 0.0, STOPPED_AT, NEVER_US);
    world->duration_us = STOPPED_AT + OFF_FOR;
}

static void draw_run(world_t *world, double speed_rpm) {
    flipping.at_us = (uint64_t)(world_settled_s(world->machine, speed_rpm) * 1e6);
    const uint64_t off_us = flipping.at_us + RUN_FOR;
    add_load(world, flipping.at_us - SETTLED_FOR);
    add(world, WORLD_REQUEST, WORLD_REQUEST_OFF, 0.0, off_us, NEVER_US);
    world->duration_us = off_us + OFF_FOR;
}

static void draw_fault(world_t *world) {
    flipping.at_us = FAULTY_AT;
    add(world, WORLD_FAULT, FAULT_DC_LINK_SENSOR_OPEN, 0.0, FAULT_AT, FAULT_AT + FAULT_FOR);
    world->recovery_us = RECOVERY_AT;
    world->duration_us = RECOVERED_AT;
}

static void draw_world(world_t *world, const world_machine_t *machine, const flips_setting_t *setting) {
    const double speed_rpm = SPEED_BASE * machine->speed_base_rpm;
    *world = world_plain(machine, setting->controller);
    add(world, WORLD_SPEED, 0, speed_rpm, 0, NEVER_US);
    switch (setting->state) {
    case FLIPS_READY:
    case FLIPS_ARMED:
        draw_standstill(world, setting->state == FLIPS_ARMED);
        break;
    case FLIPS_RUN:
        draw_run(world, speed_rpm);
        break;
    case FLIPS_FAULT:
    default:
        draw_fault(world);
        break;
    }
}

/* --- Results --- */

static void print_result(const result_t *result) {
    printf("\"signal\": %u, \"end_us\": %" PRIu64 ", \"state\": %u, \"cause\": %u, \"fault_us\": %" PRIu64
           ", \"run_us\": %" PRIu64 ", \"sets\": %u, \"reset\": %s, \"reversed\": %s, \"violations\": [",
           result->signal, result->end_ns / 1000, result->state, result->cause, result->fault_us, result->run_us,
           result->sets, result->reset ? "true" : "false", result->reversed ? "true" : "false");
    for (unsigned i = 0; i < result->violations; i++) {
        const checkers_violation_t *violation = &result->violation[i];
        printf("%s{\"rule\": \"%s\", \"number\": %u, \"at_us\": %" PRIu64 ", \"value\": %.6g}", i ? ", " : "",
               violation->rule, violation->number, violation->time_us, violation->value);
    }
    printf("]}\n");
}

static void print_results(const flips_setting_t *setting) {
    const result_t *without = &flipping.results[0];
    printf("{\"bits\": %" PRIu32 ", \"begin_us\": %" PRIu64 ", ", flipping.bits, flipping.begin_us);
    print_result(without);
    for (uint32_t i = 0; i < setting->count; i++) {
        const uint32_t bit = setting->first + i * setting->step;
        const result_t *result = &flipping.results[1 + i];
        if (bit < flipping.bits && (result->signal != 0 || result->hash != without->hash)) {
            printf("{\"bit\": %" PRIu32 ", ", bit);
            print_result(result);
        }
    }
}

int flips_all(const flips_setting_t *setting, run_t *run, world_t *world, const world_machine_t *machine,
              const run_drive_t *drive, void *memory, size_t bytes) {
    flipping.setting = setting;
    flipping.memory = memory;
    flipping.bits = 8u * (uint32_t)bytes;
    flipping.results =
        mmap(NULL, sizeof(result_t) * (setting->count + 1u), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (flipping.results == MAP_FAILED) {
        perror("salient: mmap");
        return 1;
    }
    draw_world(world, machine, setting);
    if (!run_begin(run, world, drive, NULL)) {
        fprintf(stderr, "salient: %s: the drive rejects the configuration\n", machine->name);
        return 1;
    }
    run->before_interrupt = before_interrupt;
    run_to_end(run);
    if (flipping.child) {
        finish_child(run);
    }
    if (!flipping.flipped) {
        fprintf(stderr, "salient: state %d: the drive has not reached it\n", (int)setting->state);
        return 1;
    }
    print_results(setting);
    return 0;
}
