#include "control/flux_observer.h"

#include "fixed/fixed.h"

int32_t flux_observer_step(const flux_observer_parameters_t *parameters, int32_t *flux_q29, int32_t table_q29,
                           int32_t applied_q29, int32_t current_q9) {
    const int32_t error_q29 = fixed_subtract(table_q29, *flux_q29);
    const int32_t corrected_q29 = fixed_add(*flux_q29, fixed_multiply(error_q29, parameters->gain_q15, 15));
    /* Q9 * Q40 to Q29. */
    const int32_t drop_q29 = fixed_multiply(current_q9, parameters->resistance_period_q40, 20);
    *flux_q29 = fixed_clamp(fixed_add(corrected_q29, fixed_subtract(applied_q29, drop_q29)), 0, INT32_MAX);
    return drop_q29;
}
