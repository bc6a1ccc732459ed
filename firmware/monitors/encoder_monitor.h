/* Encoder against its own counts, over half a millisecond.
 *
 *   over_speed    a sixteenth above the limit; or from a thirty-second below it when the observer's speed, which is
 *                 finer, is above. The observer alone shows none: after an edge that came too early, or with a rotor
 *                 on which it has just begun, its speed is not the rotor's.
 *   turned_round  from one direction to the other faster than a rotor can, in the last quarter of a second
 *
 * Derived here.
 */
#ifndef MONITORS_ENCODER_MONITOR_H
#define MONITORS_ENCODER_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_residual.h"

typedef struct {
    uint32_t middle;        /* of a count, 2^-32 rev */
    uint32_t rate_hz;       /* of the control periods */
    int32_t over_speed_q22; /* limit of the speed's magnitude, rad/s, Q9.22 */
    int32_t travel;         /* of a period at that speed, 2^-32 rev */
    int32_t travel_change;  /* from period to period, the largest of a rotor, 2^-32 rev */
} encoder_monitor_parameters_t;

typedef struct {
    bool over_speed;
    bool turned_round; /* faster than a rotor, last in the period reversed_at, a short time ago */
    uint32_t reversed_at;
    bool started;           /* the next two are set */
    uint32_t window_period; /* of the start of the window for the speed */
    uint32_t window_angle;
    bool turned;    /* a window had a clear travel a short time ago */
    bool backwards; /* direction of the last one, which ended in the period turned_at */
    uint32_t turned_at;
} encoder_monitor_t;

/* Checks a sample. [background] */
void encoder_monitor_step(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                          const flux_residual_t *residual);

#endif
