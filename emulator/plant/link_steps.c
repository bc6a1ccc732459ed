#include "plant/link_steps.h"

#include <math.h>
#include <stddef.h>

#include "plant/event_bracket.h"
#include "plant/hermite.h"
#include "plant/min_max.h"

/* Longest step, in time constants of the link. */
#define STEP_TIME_CONSTANTS 0.1
/* Fraction of the time to an event after which the phases begin new steps, so that the current is known better. */
#define APPROACH 0.9
/* A voltage that the half bridges' charge leads past a threshold by less than this has not passed it. */
#define THRESHOLD_TOLERANCE_V 1e-6

/* Books the time since the last decision to source and chopper. */
static void book_decided(link_t *link) {
    if (link->source_conducts) {
        link->source_s += link->at_s - link->decided_s;
        link->source_Vs += link->area_Vs - link->decided_Vs;
        link->source_V2s += link->square_V2s - link->decided_V2s;
    }
    if (link->chopper_on) {
        link->chopper_V2s += link->square_V2s - link->decided_V2s;
    }
    link->decided_s = link->at_s;
    link->decided_Vs = link->area_Vs;
    link->decided_V2s = link->square_V2s;
}

/* Determines the conduction states of source and chopper. At exactly the voltage at which the source begins to conduct,
 * the current of half bridges and chopper decides. */
static void decide(link_t *link) {
    const dc_link_t *machine = &link->plant->machine->dc_link;
    book_decided(link);
    const bool chopper = machine->chopper_resistance_ohm > 0.0;
    if (chopper) {
        if (link->voltage_V >= machine->chopper_on_V) {
            link->chopper_on = true;
        } else if (link->voltage_V <= machine->chopper_off_V) {
            link->chopper_on = false;
        }
    }
    link->conductance_S = link->chopper_on ? 1.0 / machine->chopper_resistance_ohm : 0.0;
    link->drawn_A -= link->source_A;
    link->source_A = 0.0;
    link->rising_V = INFINITY;
    link->falling_V = -INFINITY;
    const double taken_A = link->drawn_A + link->conductance_S * link->voltage_V;
    link->source_conducts = link->voltage_V < link->supply_V || (link->voltage_V == link->supply_V && taken_A >= 0.0);
    if (link->source_conducts) {
        link->conductance_S += link->source_S;
        link->source_A = -link->source_S * link->supply_V;
        link->drawn_A += link->source_A;
        link->rising_V = link->supply_V;
    } else {
        link->falling_V = link->supply_V;
    }
    if (link->chopper_on) {
        link->falling_V = max_double(link->falling_V, machine->chopper_off_V);
    } else if (chopper) {
        link->rising_V = min_double(link->rising_V, machine->chopper_on_V);
    }
    link->longest_s = link->plant->limits.factor * STEP_TIME_CONSTANTS / (link->conductance_S * -link->charge_1_F);
    link->step_max_s = link->record == NULL ? link->longest_s : 0.0;
}

void link_start(link_t *link, const plant_t *plant, link_record_t *record) {
    link->at_s = link->area_Vs = 0.0;
    link->drawn_A = link->drawn_A_s = link->drawn_A_s2 = link->source_A = 0.0;
    link->square_V2s = link->decided_s = link->decided_Vs = link->decided_V2s = 0.0;
    link->source_s = link->source_Vs = link->source_V2s = link->chopper_V2s = 0.0;
    link->source_conducts = false;
    link->voltage_V = plant->bus_voltage_V;
    link->supply_V = plant->supply_voltage_V;
    link->charge_1_F = -1.0 / plant->machine->dc_link.capacitance_F;
    link->source_S = 1.0 / plant->machine->dc_link.source_resistance_ohm;
    link->chopper_on = plant->chopper_on;
    link->near = false;
    link->plant = plant;
    link->record = record;
    decide(link);
}

static double distance_V(const link_t *link, double voltage_V) {
    return fmin(link->rising_V - voltage_V, voltage_V - link->falling_V);
}

/* Shortens a step that passes a threshold to the time at which it reaches it, by the Illinois variant of the false
 * position method. */
static double step_to_event(const link_t *link, double step_s, link_result_t *result) {
    event_bracket_t bracket = {0.0, fmax(distance_V(link, link->voltage_V), 0.0), step_s,
                               distance_V(link, result->end_V), 0};
    double at_s = step_s;
    for (unsigned iteration = 0; iteration < EVENT_ITERATIONS; iteration++) {
        const double previous_s = at_s;
        at_s = event_bracket_time_s(&bracket);
        *result = link_step(link, at_s);
        const double at = distance_V(link, result->end_V);
        if (at == 0.0 || fabs(at_s - previous_s) < EVENT_TOLERANCE_S) {
            break;
        }
        event_bracket_narrow(&bracket, at_s, at);
    }
    const bool rises = link->rising_V - result->end_V < result->end_V - link->falling_V;
    result->end_V = rises ? link->rising_V : link->falling_V;
    return at_s;
}

bool link_advance_in_steps(link_t *link, double to_s) {
    while (link->at_s < to_s) {
        /* The half bridges' current may have changed its sign where the source begins to conduct, and their charge may
         * have led past a threshold. */
        if (link->voltage_V == link->supply_V || distance_V(link, link->voltage_V) < -THRESHOLD_TOLERANCE_V) {
            decide(link);
        }
        const double rest_s = to_s - link->at_s, from_s = link->at_s;
        const double start_V = link->voltage_V, start_V_s = link_slope_V_s(link);
        double step_s = min_double(rest_s, link->longest_s);
        link_result_t result = link_step(link, step_s);
        const bool event = result.end_V > link->rising_V || result.end_V < link->falling_V;
        if (event) {
            step_s = step_to_event(link, step_s, &result);
            if (!link->near) {
                step_s *= APPROACH;
                result = link_step(link, step_s);
            }
        }
        link_book(link, step_s, &result);
        link->at_s = step_s < rest_s ? from_s + step_s : to_s;
        if (link->record != NULL) {
            if (link->record->count < LINK_STEPS_MAX) {
                link->record->steps[link->record->count].from_s = from_s;
                link->record->steps[link->record->count].length_s = step_s;
                link->record->steps[link->record->count].start_V = start_V;
                link->record->steps[link->record->count].start_V_s = start_V_s;
                link->record->steps[link->record->count].end_V = link->voltage_V;
                link->record->steps[link->record->count].end_V_s = link_slope_V_s(link);
            }
            link->record->count++;
        }
        if (event) {
            link->near = !link->near;
            if (!link->near) {
                decide(link);
            }
            return false;
        }
    }
    link->near = false;
    return true;
}

double link_recorded_V(const link_record_t *record, double at_s) {
    unsigned n = 0;
    while (n + 1 < record->count && record->steps[n + 1].from_s <= at_s) {
        n++;
    }
    const double length_s = record->steps[n].length_s;
    return hermite((at_s - record->steps[n].from_s) / length_s, length_s, record->steps[n].start_V,
                   record->steps[n].start_V_s, record->steps[n].end_V, record->steps[n].end_V_s);
}

void link_finish(link_t *link, plant_t *plant) {
    const dc_link_t *machine = &plant->machine->dc_link;
    book_decided(link);
    const double supply_V = link->supply_V, over_Vs = supply_V * link->source_s - link->source_Vs;
    plant->energy_supplied_J += supply_V * over_Vs * link->source_S;
    plant->energy_source_J += (supply_V * (over_Vs - link->source_Vs) + link->source_V2s) * link->source_S;
    if (link->chopper_V2s != 0.0) {
        plant->energy_chopper_J += link->chopper_V2s / machine->chopper_resistance_ohm;
    }
    plant->chopper_on = link->chopper_on;
    plant->bus_voltage_V = link->voltage_V;
}
