/* Time of an event within a step, from the distance to it: the Illinois variant of the false position method. */
#ifndef PLANT_EVENT_BRACKET_H
#define PLANT_EVENT_BRACKET_H

#include <math.h>

/* Accuracy of event times, and largest number of trials. */
#define EVENT_TOLERANCE_S 1e-13
#define EVENT_ITERATIONS 60

/* The event lies between both times: distance >= 0 before, < 0 after it. */
typedef struct {
    double before_s, before;
    double after_s, after;
    int last_side; /* 0 at the start */
} event_bracket_t;

/* The time to try next. */
static inline double event_bracket_time_s(const event_bracket_t *bracket) {
    /* False position makes no progress from a start exactly on a threshold, as after the previous event. */
    const double fraction = bracket->before > 0.0 ? bracket->before / (bracket->before - bracket->after) : 0.5;
    return fmax(bracket->before_s + (bracket->after_s - bracket->before_s) * fraction, EVENT_TOLERANCE_S);
}

/* Takes the distance, not 0, at a time within. */
static inline void event_bracket_narrow(event_bracket_t *bracket, double at_s, double at) {
    if (at > 0.0) {
        bracket->before_s = at_s;
        bracket->before = at;
        bracket->after *= bracket->last_side > 0 ? 0.5 : 1.0;
        bracket->last_side = 1;
    } else {
        bracket->after_s = at_s;
        bracket->after = at;
        bracket->before *= bracket->last_side < 0 ? 0.5 : 1.0;
        bracket->last_side = -1;
    }
}

#endif
