/* Degraded running: with one phase lost, the drive goes on with the others.
 *
 * Of the faults of a phase that can be done without: phase_open, which is an open winding, an open switch, no gate
 * supply or a dead current sensor, and current_sensor, of one phase each. Its switches stay open from then on, until,
 * outside a run, `clear_fault` or a parameter that no longer allows it gives it back. With both of them open the
 * current falls to zero within a stroke; a sensor that then still reads one, or a current that flows, is still a
 * fault (monitors/phase_evidence.h), and so is any other failed check. A shorted switch is never run on with: its phase
 * cannot be switched off.
 *
 * The torque that remains is the sum of the torques of the other phases at the current limit, each in the window in
 * which its law uses it, at most torque_max_Nm: mean and minimum over an electrical revolution, and at the present
 * angle. At speed the voltage may leave less. Where it is 0 the rotor has to pass by its inertia; one that stands there
 * cannot start, which is the fault `stall`. Derived here.
 */
#ifndef MONITORS_DEGRADED_H
#define MONITORS_DEGRADED_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"

/* Angles of an electrical revolution at which the torque is summed up, one in a step. */
#define DEGRADED_ANGLES 64u

/* Window of a phase, in the half in which it makes positive torque, 2^-32 electrical rev. */
typedef struct {
    uint32_t turn_on, width;
} degraded_window_t;

typedef struct {
    bool allowed; /* parameter degraded_running */
    uint32_t stroke;
    degraded_window_t window;
    int32_t current_limit_q9; /* A, Q7.9 */
    int32_t torque_max_q24;   /* N m, Q7.24 */
} degraded_parameters_t;

typedef struct {
    uint32_t lost;  /* bit of the lost phase; 0: none */
    unsigned angle; /* angles summed up, up to DEGRADED_ANGLES: the torques are then of all */
    int64_t sum_q24;
    int32_t least_q24, most_q24; /* N m, Q7.24 */
    int32_t mean_q24;            /* N m, Q7.24; 0 before the sum is complete */
} degraded_t;

/* True when the failed checks, FAULT_BITs, of these phases, a bit each, are the loss of one phase that the drive can do
 * without; it is then lost. run: state RUN. [background] */
bool degraded_accepts(const degraded_parameters_t *parameters, degraded_t *degraded, bool run, uint64_t failed,
                      uint32_t phases);

/* One angle of the sum, while there is a lost phase. [background] */
void degraded_step(const degraded_parameters_t *parameters, degraded_t *degraded, const machine_tables_t *tables);

/* Torque that the remaining phases can make at an electrical angle of phase 0, N m, Q7.24. [background] */
int32_t degraded_torque_q24(const degraded_parameters_t *parameters, const degraded_t *degraded,
                            const machine_tables_t *tables, uint32_t electrical);

/* Limit of the magnitude of the torque reference: the largest torque of any angle, N m, Q7.24; INT32_MAX without a lost
 * phase. */
int32_t degraded_torque_limit_q24(const degraded_t *degraded);

#endif
