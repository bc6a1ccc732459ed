#include "control/flux_observer.h"

#include "fixed/fixed.h"

int32_t flux_observer_step(const flux_observer_parameters_t *parameters, int32_t *flux_q29, int32_t table_q29,
                           int32_t applied_q29, int32_t current_q9) {
    const int32_t error_q29 = fixed_subtract(table_q29, *flux_q29);
    /* Q29 * Q30 to Q27; gain < 1: fits. */
    const int32_t correction_q29 = 4 * fixed_multiply_high(error_q29, parameters->gain_q30);
    /* Q9 * Q40 to Q29. */
    const int32_t resistive_drop_q29 = fixed_multiply_high(current_q9 << 12, parameters->resistance_period_q40);
    const int32_t next_q29 =
        fixed_add(fixed_add(*flux_q29, correction_q29), fixed_subtract(applied_q29, resistive_drop_q29));
    *flux_q29 = fixed_max(next_q29, 0);
    return resistive_drop_q29;
}
