#include "drive/protection.h"

#include <stdbool.h>

#include "drive/fault.h"
#include "fixed/fixed.h"

/* Below this speed a still encoder says nothing: 1 rad/s. */
#define STANDSTILL_Q22 (1 << 22)

/* Beyond any limit. */
#define UNMOVED_HELD (1 << 30)

void protection_reset(protection_t *protection, uint32_t angle) {
    *protection = (protection_t){.angle = angle};
}

/* An encoder that stands still while the rotor moves: what is left to the limit, negative beyond it. The observer alone
 * cannot tell: a fast one follows a frozen encoder to standstill before the rotor went far. No torque stops the rotor
 * as quickly, so its speed at the last count, less what torque can have taken off since, is believed as well. */
static int32_t left_to_move(const protection_parameters_t *parameters, protection_t *protection, int32_t step,
                            int32_t observed_q22) {
    if (__builtin_expect(step != 0, 1)) {
        protection->moving_q22 = observed_q22;
        protection->unmoved = 0;
        return 0;
    }
    const int32_t slowed_q22 = fixed_subtract(protection->moving_q22, parameters->slowing_q22);
    const int32_t speed_q22 = observed_q22 > slowed_q22 ? observed_q22 : slowed_q22;
    protection->moving_q22 = speed_q22;
    if (speed_q22 < STANDSTILL_Q22) {
        protection->unmoved = 0;
    } else if (protection->unmoved < UNMOVED_HELD) {
        /* A period at the highest speed and 20 kHz is below 2^25. */
        protection->unmoved += fixed_multiply_high(speed_q22, parameters->angle_step_q32);
    }
    return parameters->angle_unmoved_max - protection->unmoved;
}

/* What is left to each limit, negative beyond it. */
typedef struct {
    int32_t current_q9;
    int32_t over_voltage_q6;
    int32_t under_voltage_q6;
    int32_t over_speed_q22;
    int32_t jump;
    int32_t still;
    int32_t late; /* or -1 */
    int32_t lost;
} margins_t;

static uint16_t bit_if(bool fails, fault_t fault) {
    return (uint16_t)(fails ? FAULT_BIT(fault) : 0);
}

__attribute__((cold)) static uint16_t failed_checks(margins_t left) {
    uint16_t checks = 0;
    checks |= bit_if(left.current_q9 < 0, FAULT_OVER_CURRENT);
    checks |= bit_if(left.over_voltage_q6 < 0, FAULT_OVER_VOLTAGE);
    checks |= bit_if(left.under_voltage_q6 < 0, FAULT_UNDER_VOLTAGE);
    checks |= bit_if(left.over_speed_q22 < 0, FAULT_OVER_SPEED);
    checks |= bit_if((left.jump | left.still) < 0, FAULT_ENCODER);
    checks |= bit_if(left.late < 0, FAULT_COMMAND_TIMEOUT);
    checks |= bit_if(left.lost < 0, FAULT_INTERRUPT_OVERRUN);
    return checks;
}

uint16_t protection_check(const protection_parameters_t *parameters, protection_t *protection,
                          const protection_sample_t *sample) {
    const int32_t speed_q22 = fixed_abs(sample->speed_q22);
    const int32_t step = (int32_t)(sample->angle - protection->angle); /* modulo a turn */
    protection->angle = sample->angle;
    int32_t step_max = parameters->angle_step_max;
    int32_t overruns = 0;
    int32_t lost = 0;
    if (__builtin_expect(sample->missed_interrupts != 0, 0)) {
        overruns = fixed_saturate((int64_t)protection->overruns + sample->missed_interrupts);
        step_max = fixed_saturate(step_max * ((int64_t)sample->missed_interrupts + 1));
        lost = PROTECTION_OVERRUNS_MAX - 1 - overruns;
    }
    protection->overruns = overruns;
    /* None overflows: limits and what they limit are not negative. */
    const margins_t left = {
        .current_q9 = parameters->current_trip_q9 - sample->current_max_q9,
        .over_voltage_q6 = parameters->bus_over_voltage_q6 - sample->bus_voltage_q6,
        .under_voltage_q6 = sample->bus_voltage_q6 - parameters->bus_under_voltage_q6,
        .over_speed_q22 = parameters->over_speed_q22 - speed_q22,
        .jump = step_max - fixed_abs(step),
        .still = left_to_move(parameters, protection, step, speed_q22),
        .late = -(int32_t)(sample->command_age_us > parameters->command_timeout_us),
        .lost = lost,
    };
    /* That none fails, nearly always, shows in the sign of them all. */
    const int32_t any = left.current_q9 | left.over_voltage_q6 | left.under_voltage_q6 | left.over_speed_q22 |
                        left.jump | left.still | left.late | left.lost;
    return any < 0 ? failed_checks(left) : 0;
}
