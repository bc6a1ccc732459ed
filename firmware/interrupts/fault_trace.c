#include "interrupts/fault_trace.h"

#include <stddef.h>

#include "fixed/compiler.h"

NOINLINE void fault_trace_stand(fault_trace_t *trace, const fault_trace_values_t *values, drive_state_t state) {
    fault_trace_run(trace, values);
    if (state == DRIVE_STATE_FAULT) {
        trace->next |= FAULT_TRACE_KEPT;
    }
}

COLD const fault_trace_period_t *fault_trace_period(const fault_trace_t *trace, unsigned period) {
    const bool known = fault_trace_kept(trace) && period < FAULT_TRACE_PERIODS;
    return known ? &trace->period[(trace->next + period) % FAULT_TRACE_PERIODS] : NULL;
}
