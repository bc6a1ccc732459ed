#include "campaign/checkers/checkers.h"

#include <string.h>

#include "campaign/checkers/table.h"

struct checker_report {
    checkers_t *checkers;
    const char *rule;
};

void checker_violated(checker_report_t *report, unsigned number, double value) {
    checkers_t *checkers = report->checkers;
    for (unsigned i = 0; i < checkers->violations; i++) {
        if (strcmp(checkers->violation[i].rule, report->rule) == 0 && checkers->violation[i].number == number) {
            return;
        }
    }
    if (checkers->violations < CHECKERS_VIOLATIONS_MAX) {
        checkers->violation[checkers->violations++] = (checkers_violation_t){
            .rule = report->rule, .time_us = checkers->seen.time_ns / 1000, .number = number, .value = value};
    }
}

void checker_reached(checker_report_t *report, unsigned number) {
    report->checkers->cell[number / 8] |= (uint8_t)(1u << number % 8);
}

/* --- States: one after the other, each aligned for any type --- */

static size_t units_of(const checker_t *checker) {
    return (checker->state_size + sizeof(max_align_t) - 1) / sizeof(max_align_t);
}

/* A walk over the table with the state and the report of each checker. */
typedef struct {
    const checker_t *checker;
    void *state;
    checker_report_t report;
    unsigned next;
    size_t units;
} walk_t;

static bool advance(walk_t *walk, checkers_t *checkers) {
    const unsigned world = 1u << checkers->seen.world->client;
    while (walk->next < checkers_count && !(checkers_table[walk->next].worlds & world)) {
        walk->units += units_of(checkers_table[walk->next++].checker);
    }
    if (walk->next == checkers_count) {
        return false;
    }
    walk->checker = checkers_table[walk->next++].checker;
    walk->state = &checkers->state[walk->units];
    walk->report = (checker_report_t){checkers, walk->checker->name};
    walk->units += units_of(walk->checker);
    return true;
}

bool checkers_start(checkers_t *checkers, const world_t *world, const plant_t *plant, uint64_t period_ns) {
    memset(checkers, 0, sizeof *checkers);
    observation_start(&checkers->seen, world, plant, period_ns);
    size_t units = 0;
    for (unsigned i = 0; i < checkers_count; i++) {
        units += units_of(checkers_table[i].checker);
    }
    return units <= sizeof checkers->state / sizeof *checkers->state;
}

/* --- Events --- */

static void on_millisecond(checkers_t *checkers) {
    observation_on_millisecond(&checkers->seen);
    for (walk_t walk = {0}; advance(&walk, checkers);) {
        if (walk.checker->on_millisecond) {
            walk.checker->on_millisecond(&checkers->seen, walk.state, &walk.report);
        }
    }
}

void checkers_on_look(checkers_t *checkers) {
    observation_on_look(&checkers->seen);
    for (walk_t walk = {0}; advance(&walk, checkers);) {
        if (walk.checker->on_look) {
            walk.checker->on_look(&checkers->seen, walk.state, &walk.report);
        }
    }
    if (checkers->seen.time_ns >= checkers->millisecond_ns + MS_NS) {
        checkers->millisecond_ns = checkers->seen.time_ns;
        on_millisecond(checkers);
    }
}

void checkers_on_interrupt(checkers_t *checkers, observation_drive_t drive) {
    observation_on_interrupt(&checkers->seen, drive);
    for (walk_t walk = {0}; advance(&walk, checkers);) {
        if (walk.checker->on_interrupt) {
            walk.checker->on_interrupt(&checkers->seen, walk.state, &walk.report);
        }
    }
}

void checkers_on_reset(checkers_t *checkers, uint64_t time_ns, observation_drive_t drive) {
    observation_on_reset(&checkers->seen, time_ns, drive);
}

void checkers_on_command(checkers_t *checkers, uint64_t time_ns, const sender_meaning_t *meaning) {
    observation_on_command(&checkers->seen, time_ns, meaning);
}

void checkers_on_frame(checkers_t *checkers, uint64_t time_ns, unsigned identifier, const uint8_t data[8]) {
    const checker_frame_t frame = {identifier, data};
    observation_on_frame(&checkers->seen, time_ns, identifier, data);
    for (walk_t walk = {0}; advance(&walk, checkers);) {
        if (walk.checker->on_frame) {
            walk.checker->on_frame(&checkers->seen, walk.state, &walk.report, &frame);
        }
    }
}

void checkers_on_fault(checkers_t *checkers, unsigned kind, bool begins) {
    observation_on_fault(&checkers->seen, kind, begins);
    for (walk_t walk = {0}; begins && advance(&walk, checkers);) {
        if (walk.checker->on_fault) {
            walk.checker->on_fault(&checkers->seen, walk.state, &walk.report, kind);
        }
    }
}

void checkers_at_end(checkers_t *checkers, observation_heat_t heat) {
    observation_at_end(&checkers->seen, heat);
    for (walk_t walk = {0}; advance(&walk, checkers);) {
        if (walk.checker->at_end) {
            walk.checker->at_end(&checkers->seen, walk.state, &walk.report);
        }
    }
}
