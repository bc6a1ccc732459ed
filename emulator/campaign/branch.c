#define _DEFAULT_SOURCE

#include "campaign/branch.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "campaign/drive_numbers.h"
#include "fault_kinds.h"
#include "rig/faults.h"

#define SLOW_TICKS 50                      /* a slow fault begins at every 50th tick, */
#define SLOW_POSITIONS 10                  /* or at every tenth position */
#define SLOW_NS UINT64_C(100000000)        /* of a reaction; the drive of a slower one runs on for many periods */
#define UNANSWERED_NS UINT64_C(1000000000) /* without a reaction until then: none */
#define AFTER_NS UINT64_C(1000000)         /* watched after a reaction, at least */
#define VARIANTS_MAX 80

typedef struct {
    unsigned kind, phase, leg;
    double value; /* of its attribute */
} variant_t;

/* Shared with the children. */
typedef struct {
    uint64_t branches, detected, violations;
    uint64_t longest_ns, longest_tick, virtual_ns;
    uint64_t causes; /* bit: first cause seen */
    char rule[32];   /* of the first violation */
    uint64_t violation_tick;
} tally_t;

/* Attributes of the kinds that have one: strong enough for the drive to have a reason to act. */
static const struct {
    unsigned kind;
    double value;
} attributes[] = {
    {FAULT_WINDING_SHORTED, 20.0},
    {FAULT_CURRENT_SENSOR_STUCK, 1500.0},
    {FAULT_CURRENT_SENSOR_GAIN, 0.3},
    {FAULT_CURRENT_SENSOR_OFFSET, 20.0},
    {FAULT_CURRENT_SENSOR_SWAPPED, 1.0},
    {FAULT_DC_LINK_SENSOR_STUCK, 0.0},
    {FAULT_DC_LINK_SENSOR_GAIN, 0.5},
    {FAULT_DC_LINK_SENSOR_OFFSET, 100.0},
    {FAULT_ENCODER_JUMP, 5.0},
    {FAULT_ENCODER_LOST_COUNTS, 5000.0},
    {FAULT_ENCODER_NOISE, 1.0},
    {FAULT_ENCODER_SLIP, 60.0},
    {FAULT_COULOMB_FRICTION, 30.0},
    {FAULT_STATIC_FRICTION, 30.0},
    {FAULT_SUPPLY_SAGGED, 60.0},
    {FAULT_SUPPLY_SURGED, 50.0},
    {FAULT_SUPPLY_RIPPLE, 100.0},
    {FAULT_WINDING_TO_EARTH, 0.001},
    {FAULT_INTERRUPT_LATE, 5000.0},
    {FAULT_LIMIT_FLIPPED, 12.0},
    {FAULT_CONSTANT_FLIPPED, 1000.0},
    {FAULT_STATE_FLIPPED, 0.0},
    {FAULT_FAULT_LATCH_FLIPPED, 0.0},
    {FAULT_CLOCK_DRIFT, 6.0},
    {FAULT_PERIOD_REGISTER_FLIPPED, 3.0},
    {FAULT_WINDING_TEMPERATURE_SENSOR_STUCK, 2000.0},
    {FAULT_INVERTER_TEMPERATURE_SENSOR_STUCK, 2000.0},
    {FAULT_WINDING_TEMPERATURE_SENSOR_OFFSET, -50.0},
    {FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET, -50.0},
};

static double attribute_of(unsigned kind) {
    for (unsigned i = 0; i < sizeof attributes / sizeof *attributes; i++) {
        if (attributes[i].kind == kind) {
            return attributes[i].value;
        }
    }
    return 0.0;
}

static unsigned list_variants(variant_t variants[VARIANTS_MAX], const machine_t *machine) {
    unsigned count = 0;
    for (unsigned kind = 1; kind < FAULT_COUNT; kind++) {
        const bool of_target = kind == FAULT_CODE_FLIPPED || kind == FAULT_STACK_GUARD_FLIPPED; /* not of the host */
        if (!fault_kinds[kind].name || of_target ||
            (kind == FAULT_CHOPPER_OPEN && machine->dc_link.chopper_resistance_ohm == 0.0)) {
            continue;
        }
        for (unsigned leg = 0; leg <= fault_kinds[kind].has_leg; leg++) {
            variants[count++] = (variant_t){.kind = kind, .leg = leg, .value = attribute_of(kind)};
        }
    }
    return count;
}

static void begin_fault(run_t *run, const variant_t *variant) {
    const fault_kind_t *kind = &fault_kinds[variant->kind];
    const int32_t raw = kind->has_attribute ? (int32_t)floor(variant->value / kind->scale + 0.5) : 0;
    const uint32_t bits = fault_request_bits(&(fault_request_t){
        .kind = (uint8_t)variant->kind,
        .phase = (uint8_t)variant->phase,
        .leg = (uint8_t)variant->leg,
        .begins = true,
        .raw = raw,
    });
    const uint8_t data[8] = {(uint8_t)bits, (uint8_t)(bits >> 8), (uint8_t)(bits >> 16), (uint8_t)(bits >> 24)};
    faults_receive(&run->rig, data);
}

bool branch_parse(branch_setting_t *setting, char *const words[]) {
    *setting = (branch_setting_t){.controller = (unsigned)atoi(words[0]),
                                  .speed_rpm = atof(words[1]),
                                  .load_Nm = atof(words[2]),
                                  .first = (unsigned)atoi(words[3]),
                                  .ticks = (unsigned)atoi(words[4]),
                                  .every = (unsigned)atoi(words[5])};
    return setting->controller <= 2 && setting->speed_rpm >= 0.0 && setting->every > 0;
}

/* State of the branching; one thread, one run. */
static struct {
    const branch_setting_t *setting;
    variant_t variants[VARIANTS_MAX];
    unsigned count;
    tally_t *tallies;
    bool child;
    uint64_t settled_ns, tick, begin_ns, reaction_ns, watched_until_ns;
    tally_t *tally;
} branching;

static void finish_child(run_t *run) {
    tally_t *tally = branching.tally;
    tally->branches++;
    if (!branching.reaction_ns && run->checkers.seen.dark_ns && run->drive->view().state != STATE_RUN) {
        branching.reaction_ns = run->checkers.seen.dark_ns; /* reset by the watchdog, long after the gates were off */
    }
    tally->virtual_ns += run->rig.board.time_ns - branching.begin_ns;
    if (branching.reaction_ns) {
        const uint64_t took_ns =
            branching.reaction_ns > branching.begin_ns ? branching.reaction_ns - branching.begin_ns : 0;
        tally->detected++;
        tally->causes |=
            UINT64_C(1) << (run->checkers.seen.causes ? run->checkers.seen.cause[0] : run->drive->view().fault);
        if (took_ns >= tally->longest_ns) {
            tally->longest_ns = took_ns;
            tally->longest_tick = branching.tick;
        }
    }
    if (run->checkers.violations) {
        if (tally->violations++ == 0) {
            snprintf(tally->rule, sizeof tally->rule, "%s %u", run->checkers.violation[0].rule,
                     run->checkers.violation[0].number);
            tally->violation_tick = branching.tick;
        }
    }
    _exit(0);
}

static void before_interrupt_of_child(run_t *run) {
    const uint64_t now_ns = run->rig.board.time_ns;
    if (!branching.reaction_ns && run->checkers.seen.causes) {
        branching.reaction_ns = run->checkers.seen.cause_us * 1000;
    }
    const bool watched = now_ns > branching.reaction_ns + AFTER_NS && now_ns >= branching.watched_until_ns;
    if ((branching.reaction_ns && watched) || now_ns >= run->end_ns) {
        finish_child(run);
    }
}

/* By the places where it has begun so far. */
static bool is_slow(const tally_t *tally) {
    return tally->longest_ns > SLOW_NS || tally->detected < tally->branches;
}

static void branch_here(run_t *run) {
    const branch_setting_t *setting = branching.setting;
    const unsigned slow_every = setting->speed_rpm > 0.0 ? SLOW_TICKS : SLOW_POSITIONS;
    for (unsigned i = 0; i < branching.count; i++) {
        if (is_slow(&branching.tallies[i]) && (branching.tick - setting->first) % slow_every != 0) {
            continue;
        }
        unsigned signal;
        if (run_fork(&signal)) {
            branching.child = true;
            branching.tally = &branching.tallies[i];
            branching.begin_ns = run->rig.board.time_ns;
            branching.watched_until_ns = branching.begin_ns + branching.tally->longest_ns * 3 / 2;
            run->end_ns = branching.begin_ns + UNANSWERED_NS;
            run->before_interrupt = before_interrupt_of_child;
            begin_fault(run, &branching.variants[i]);
            return;
        }
        if (signal != 0) {
            branching.tallies[i].violations++;
            snprintf(branching.tallies[i].rule, sizeof branching.tallies[i].rule, "crash %u", signal);
        }
    }
}

static void before_interrupt(run_t *run) {
    const branch_setting_t *setting = branching.setting;
    if (run->drive->view().state != STATE_RUN) {
        return;
    }
    if (setting->speed_rpm == 0.0) {
        run->before_interrupt = NULL; /* once; a child has another one */
        run->end_ns = run->rig.board.time_ns;
        branch_here(run);
        return;
    }
    if (run->rig.board.time_ns < branching.settled_ns) {
        return;
    }
    if (branching.tick >= setting->first + setting->ticks) {
        run->end_ns = run->rig.board.time_ns;
        return;
    }
    const uint64_t tick = branching.tick;
    if (tick >= setting->first && (tick - setting->first) % setting->every == 0) {
        branch_here(run);
    }
    if (!branching.child) {
        branching.tick++;
    }
}

static void draw_world(world_t *world, const world_machine_t *machine, const branch_setting_t *setting) {
    *world = world_plain(machine, setting->controller);
    branching.settled_ns = (uint64_t)(world_settled_s(machine, setting->speed_rpm) * 1e9);
    world->duration_us = branching.settled_ns / 1000 + 10000000;
    world->event[world->events++] =
        (world_event_t){.kind = WORLD_SPEED, .value = setting->speed_rpm > 0.0 ? setting->speed_rpm : 150.0};
    world->event[world->events++] =
        (world_event_t){.kind = WORLD_SET,
                        .what = 1, /* load_torque_Nm */
                        .raw = (int32_t)floor(setting->load_Nm * 1e4 + 0.5),
                        .begin_us = setting->speed_rpm > 0.0 ? branching.settled_ns / 1000 - 200000 : 0};
}

static void run_base(run_t *run, world_t *world, const run_drive_t *drive) {
    if (run_begin(run, world, drive, NULL)) {
        run->before_interrupt = before_interrupt;
        run_to_end(run);
        if (branching.child) {
            finish_child(run);
        }
    }
}

static void print_tallies(const branch_setting_t *setting) {
    static const char *const controllers[] = {"traditional", "paper", "salient"};
    for (unsigned i = 0; i < branching.count; i++) {
        const tally_t *tally = &branching.tallies[i];
        printf("{\"controller\": \"%s\", \"speed_rpm\": %g, \"load_Nm\": %g, \"fault\": \"%s\", \"leg\": %u, "
               "\"value\": %g, "
               "\"branches\": %" PRIu64 ", \"detected\": %" PRIu64 ", \"longest_us\": %" PRIu64 ", \"longest_tick\": "
               "%" PRIu64 ", \"causes\": [",
               controllers[setting->controller], setting->speed_rpm, setting->load_Nm,
               fault_kinds[branching.variants[i].kind].name, branching.variants[i].leg, branching.variants[i].value,
               tally->branches, tally->detected, tally->longest_ns / 1000, tally->longest_tick);
        const char *separator = "";
        for (unsigned cause = 0; cause < 64; cause++) {
            if (tally->causes >> cause & 1u) {
                printf("%s%u", separator, cause);
                separator = ", ";
            }
        }
        printf("], \"virtual_ms\": %" PRIu64 ", \"violations\": %" PRIu64
               ", \"rule\": \"%s\", \"violation_tick\": %" PRIu64 "}\n",
               tally->virtual_ns / 1000000, tally->violations, tally->rule, tally->violation_tick);
    }
}

int branch_all(const branch_setting_t *setting, run_t *run, world_t *world, const world_machine_t *machines,
               const run_drive_t *drive) {
    branching.setting = setting;
    branching.count = list_variants(branching.variants, &machines[0].image.machine);
    branching.tallies =
        mmap(NULL, sizeof(tally_t) * VARIANTS_MAX, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (branching.tallies == MAP_FAILED) {
        perror("salient: mmap");
        return 1;
    }
    draw_world(world, &machines[0], setting);
    if (setting->speed_rpm > 0.0) {
        run_base(run, world, drive);
    } else {
        for (unsigned position = setting->first; position < setting->first + setting->ticks;
             position += setting->every) {
            world->initial_angle_deg = position;
            branching.tick = position;
            run_base(run, world, drive);
        }
    }
    print_tallies(setting);
    return 0;
}
