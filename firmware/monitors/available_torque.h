/* Available torque of each sign, and what limits it: for telemetry. A load beyond it drives the rotor.
 *
 * Limits that hold at once are looked at in this order, and the first one of the smallest is named:
 *
 * current: torque_max_Nm, which is the torque of the current limit;
 * voltage: at this speed (control/conduction.h), not known to controllers of one quadrant;
 * DC link: braking torque whose energy the link takes, by a brake chopper, a supply that takes energy back, or the
 * losses of the windings alone;
 * heat: of windings and switches, by thermal models and sensors;
 * degraded: mean torque of the phases that are left;
 * controller: one quadrant has no torque backwards.
 */
#ifndef MONITORS_AVAILABLE_TORQUE_H
#define MONITORS_AVAILABLE_TORQUE_H

#include <stdbool.h>
#include <stdint.h>

#include "drive_enumerations.h"

/* Part of the largest torque by which the estimate of the load may exceed what is available: its own error. */
#define AVAILABLE_TORQUE_ERROR 16

typedef struct {
    bool run;                  /* state RUN */
    bool four_quadrant;        /* false: no torque backwards */
    int32_t speed_q22;         /* rad/s, Q9.22 */
    int32_t load_torque_q24;   /* estimate, N m, Q7.24 */
    int32_t largest_q24;       /* torque_max_Nm, N m, Q7.24, > 0 */
    int32_t by_voltage_q24[2]; /* magnitudes, forwards and backwards, N m, Q7.24, >= 0; */
    bool link_fills;           /* that against the speed is less because the DC link fills up, */
    int32_t by_link_q24;       /* and is at most this: N m, Q7.24, INT32_MAX where the link has room */
    int32_t by_heat_q24;       /* N m, Q7.24, >= 0 */
    int32_t by_degraded_q24;   /* likewise; INT32_MAX with all phases */
} available_torque_input_t;

typedef struct {
    int32_t torque_q24; /* magnitude, N m, Q7.24 */
    torque_limit_t limited_by;
} available_torque_side_t;

typedef struct {
    available_torque_side_t forward, backward;
    bool load_exceeds; /* in a run: the load's estimate is beyond them by a sixteenth of the largest torque */
} available_torque_t;

/* Exact: comparisons only. [background] */
available_torque_t available_torque(const available_torque_input_t *input);

#endif
