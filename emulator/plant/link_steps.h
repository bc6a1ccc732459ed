/* Voltage of the DC-link capacitor while every phase has steps of its own (phase_steps.h).
 *
 * With the conductance g of source and chopper while they conduct, and a current i, the current of the half bridges
 * less the current of the source at 0 V:
 *
 *   C dVdc/dt = -(i + g Vdc)
 *
 * i is a parabola between two instants at which a phase begins or ends a step. A step of the link leads from one to the
 * next, by the Taylor series of this equation. The phases take the integral of the voltage from it; what their charge
 * was more than the parabola's is taken from the capacitor at the end of their steps.
 *
 * Where the source or the chopper starts or stops conducting, the steps of all phases connected to the link end, and
 * once before, shortly ahead of it: from there the parabola leads to the instant exactly. */
#ifndef PLANT_LINK_STEPS_H
#define PLANT_LINK_STEPS_H

#include <stdbool.h>

#include "plant/plant_state.h"

#define LINK_STEPS_MAX 256

/* Course of the voltage in the steps, for samples: its values and time derivatives at both ends. Steps beyond
 * LINK_STEPS_MAX are only counted. */
typedef struct {
    unsigned count;
    struct {
        double from_s, length_s;
        double start_V, start_V_s, end_V, end_V_s;
    } steps[LINK_STEPS_MAX];
} link_record_t;

typedef struct {
    double at_s; /* since the start of the rotor's step */
    double voltage_V;
    double drawn_A, drawn_A_s, drawn_A_s2; /* i, its slope and half of its second derivative */
    double area_Vs;                        /* integral of the voltage since the start of the rotor's step */
    double step_max_s;                     /* 0: every step is recorded */
    double charge_1_F, conductance_S;      /* change of the voltage by a charge drawn; g */
    double rising_V, falling_V;            /* at which source or chopper switch */
    double supply_V, source_S;
    bool source_conducts, chopper_on;
    bool near;                                 /* source or chopper are about to switch */
    double square_V2s;                         /* integral of its square */
    double decided_s, decided_Vs, decided_V2s; /* at_s and both integrals when the conduction states last changed */
    double source_s, source_Vs, source_V2s;    /* time and both integrals until then, while the source conducted */
    double chopper_V2s;                        /* the last one with the chopper on */
    double source_A;                           /* part of the source in drawn_A */
    double longest_s;
    const plant_t *plant;
    link_record_t *record; /* NULL: none */
} link_t;

/* Starts at the state of the plant, without current of the half bridges. */
void link_start(link_t *link, const plant_t *plant, link_record_t *record);

/* Writes voltage, chopper and energies to the plant. */
void link_finish(link_t *link, plant_t *plant);

/* Voltage `at_s` after the start of the rotor's step. */
double link_recorded_V(const link_record_t *record, double at_s);

/* As link_advance, in several steps. */
bool link_advance_in_steps(link_t *link, double to_s);

static inline double link_slope_V_s(const link_t *link) {
    return link->charge_1_F * (link->drawn_A + link->conductance_S * link->voltage_V);
}

/* Result of a step. */
typedef struct {
    double end_V, area_Vs, bend_A;
} link_result_t;

static inline link_result_t link_step(const link_t *link, double step_s) {
    const double charge_V = link->charge_1_F * step_s, decay = link->conductance_S * charge_V;
    const double bend_A = step_s * step_s * link->drawn_A_s2;
    /* Terms of the series. */
    const double c1_V = charge_V * link->drawn_A + decay * link->voltage_V;
    const double c2_V = 0.5 * (charge_V * (step_s * link->drawn_A_s) + decay * c1_V);
    const double c3_V = (1.0 / 3.0) * (charge_V * bend_A + decay * c2_V);
    const double c4_V = 0.25 * decay * c3_V;
    return (link_result_t){
        link->voltage_V + (c1_V + c2_V + c3_V + c4_V),
        step_s * (link->voltage_V + 0.5 * c1_V + (1.0 / 3.0) * c2_V + 0.25 * c3_V),
        bend_A,
    };
}

/* Books a step, whose end becomes the present state. */
static inline void link_book(link_t *link, double step_s, const link_result_t *result) {
    const double change_V = result->end_V - link->voltage_V;
    const double middle_V = link->voltage_V + 0.5 * change_V;
    /* Integral over a parabola. */
    link->square_V2s +=
        middle_V * (2.0 * result->area_Vs - middle_V * step_s) + (1.0 / 12.0) * step_s * (change_V * change_V);
    link->area_Vs += result->area_Vs;
    link->voltage_V = result->end_V;
    link->drawn_A += step_s * link->drawn_A_s + result->bend_A;
    link->drawn_A_s += 2.0 * step_s * link->drawn_A_s2;
}

/* Advances to `to_s`; false: only to at_s, where source or chopper switch. */
static inline bool link_advance(link_t *link, double to_s) {
    const double step_s = to_s - link->at_s;
    if (step_s <= 0.0) {
        return true;
    }
    const link_result_t result = link_step(link, step_s);
    if (step_s <= link->step_max_s && result.end_V <= link->rising_V && result.end_V >= link->falling_V) {
        link_book(link, step_s, &result);
        link->at_s = to_s;
        return true;
    }
    return link_advance_in_steps(link, to_s);
}

#endif
