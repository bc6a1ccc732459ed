/* The last control periods before a fault. The control interrupt records each period, up to the one that latches a
 * fault; the trace is then kept until the drive runs again, so that it can be read in peace. A reset forgets it. */
#ifndef INTERRUPTS_FAULT_TRACE_H
#define INTERRUPTS_FAULT_TRACE_H

#include <stdbool.h>
#include <stdint.h>

#include "drive_enumerations.h"
#include "fixed/compiler.h"
#include "fixed/dual16.h"
#include "hal_adc.h"
#include "hal_pwm.h"

#define FAULT_TRACE_PERIODS 64u /* a power of two */

/* A period: what was measured, and what was written for the next one. 32 bytes. */
typedef struct {
    hal_adc_sample_t adc;      /* in place of the load torque: rotor angle, 2^-16 rev */
    uint32_t motion;           /* speed, rad/s, Q9.6; in the upper half the torque reference, N m, Q7.8 */
    hal_pwm_compare_t compare; /* all 0 when every switch was opened */
} fault_trace_period_t;

typedef struct {
    fault_trace_period_t period[FAULT_TRACE_PERIODS]; /* zeros: before the start */
    uint32_t next; /* modulo FAULT_TRACE_PERIODS: place of the next period, the oldest; and FAULT_TRACE_KEPT or 0 */
} fault_trace_t;

#define FAULT_TRACE_KEPT (2u * FAULT_TRACE_PERIODS)

static inline bool fault_trace_kept(const fault_trace_t *trace) {
    return (trace->next & FAULT_TRACE_KEPT) != 0;
}

/* Values of a period, in the formats of the control laws. */
typedef struct {
    const hal_adc_sample_t *adc;
    const hal_pwm_compare_t *compare;
    uint32_t angle;
    int32_t speed_q22;
    int32_t torque_reference_q24;
} fault_trace_values_t;

/* Records a period in RUN. [control interrupt] */
ALWAYS_INLINE void fault_trace_run(fault_trace_t *trace, const fault_trace_values_t *values) {
    IN_REGISTER(trace); /* else the place is computed from the drive's address */
    const uint32_t place = trace->next % FAULT_TRACE_PERIODS;
    fault_trace_period_t *period = &trace->period[place];
    IN_REGISTER(period);
    period->adc = *values->adc;
    period->adc.load_torque_counts = (uint16_t)(values->angle >> 16);
    period->motion = dual16_pack_upper(values->speed_q22, values->torque_reference_q24);
    period->compare = *values->compare;
    trace->next = place + 1u;
}

/* Records a period in another state; not while the trace is kept. [control interrupt] */
void fault_trace_stand(fault_trace_t *trace, const fault_trace_values_t *values, drive_state_t state);

/* A period of a trace that is kept, the oldest first; NULL when none is kept or there is no such period. [background]
 */
const fault_trace_period_t *fault_trace_period(const fault_trace_t *trace, unsigned period);

#endif
