#include "drive/protection.h"

#include "drive/fault.h"
#include "fixed/fixed.h"

/* Below this speed a still encoder says nothing: 1 rad/s. */
#define STANDSTILL_Q22 (1 << 22)

void protection_reset(protection_t *protection, uint32_t angle) {
    *protection = (protection_t){.angle = angle};
}

/* A jump, or an encoder that stands still while the rotor moves. The observer alone cannot tell: a fast one follows a
 * frozen encoder to standstill before the rotor went far. No torque stops the rotor as quickly, so its speed at the
 * last count, less what torque can have taken off since, is believed as well. */
static int encoder_fails(const protection_parameters_t *parameters, protection_t *protection,
                         const protection_sample_t *sample) {
    const int32_t step = (int32_t)(sample->angle - protection->angle); /* modulo a turn */
    protection->angle = sample->angle;
    const int32_t observed_q22 = fixed_abs(sample->speed_q22);
    const int32_t slowed_q22 = step != 0 ? 0 : fixed_subtract(protection->moving_q22, parameters->slowing_q22);
    const int32_t speed_q22 = observed_q22 > slowed_q22 ? observed_q22 : slowed_q22;
    protection->moving_q22 = speed_q22;
    if (step != 0 || speed_q22 < STANDSTILL_Q22) {
        protection->unmoved_q64 = 0;
    } else if (protection->unmoved_q64 < (int64_t)1 << 62) {
        /* 2^31 * 2^26 a period: a few dozen periods to 2^62. */
        protection->unmoved_q64 += (int64_t)speed_q22 * parameters->angle_step_q32;
    }
    const uint64_t step_limit = (uint64_t)parameters->angle_step_max * (sample->missed_interrupts + 1u);
    return (uint64_t)fixed_abs(step) > step_limit || (protection->unmoved_q64 >> 32) > parameters->angle_unmoved_max;
}

uint16_t protection_check(const protection_parameters_t *parameters, protection_t *protection,
                          const protection_sample_t *sample) {
    protection->overruns = sample->missed_interrupts == 0 ? 0 : protection->overruns + sample->missed_interrupts;

    uint16_t checks = 0;
    checks |= sample->current_max_q9 > parameters->current_trip_q9 ? FAULT_BIT(FAULT_OVER_CURRENT) : 0;
    checks |= sample->bus_voltage_q6 > parameters->bus_over_voltage_q6 ? FAULT_BIT(FAULT_OVER_VOLTAGE) : 0;
    checks |= sample->bus_voltage_q6 < parameters->bus_under_voltage_q6 ? FAULT_BIT(FAULT_UNDER_VOLTAGE) : 0;
    checks |= fixed_abs(sample->speed_q22) > parameters->over_speed_q22 ? FAULT_BIT(FAULT_OVER_SPEED) : 0;
    checks |= encoder_fails(parameters, protection, sample) ? FAULT_BIT(FAULT_ENCODER) : 0;
    checks |= sample->command_age_us > parameters->command_timeout_us ? FAULT_BIT(FAULT_COMMAND_TIMEOUT) : 0;
    checks |= protection->overruns >= PROTECTION_OVERRUNS_MAX ? FAULT_BIT(FAULT_INTERRUPT_OVERRUN) : 0;
    return checks;
}
