#include "monitors/protection.h"

#include <assert.h>
#include <stdbool.h>

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "hal_pwm.h"
#include "storage/fault.h"

/* An encoder that does not count is no evidence of a fault below this speed: 1 rad/s, of a fast machine up to 8 rad/s
 * (machine_tables.h), always less than 0.4 % of the range of speeds. */
#define STANDSTILL_Q22 (1 << 22)

/* That count of a step. */
#define PERIODS_MAX PROTECTION_SKIPPED_DEFERRED_MAX
static_assert((int64_t)PROTECTION_DECELERATION_MAX_Q22 * PERIODS_MAX <= INT32_MAX, "a product of 32 bits");

void protection_reset(protection_t *protection, uint32_t encoder_angle) {
    *protection = (protection_t){.encoder_angle = encoder_angle};
}

void protection_deferred_reset(protection_deferred_t *protection, uint32_t encoder_angle) {
    *protection = (protection_deferred_t){.encoder_angle = encoder_angle};
}

static_assert(FAULT_COUNT <= 32, "checks are collected in 32 bits, which saves the interrupt eight instructions");

static void fail_if(uint32_t *failed, bool condition, fault_t fault) {
    if (condition) {
        *failed |= (uint32_t)FAULT_BIT(fault);
    }
}

/* Triggers lost in consecutive periods, including this one; saturates to 2^31 - 1. [SR-46] */
static uint32_t count_overruns(protection_t *protection, uint32_t missed_interrupts) {
    uint32_t overruns = 0;
    if (missed_interrupts != 0) {
        protection->late_interrupts++; /* the previous one */
        overruns = (uint32_t)fixed_add((int32_t)protection->overruns, (int32_t)missed_interrupts);
    }
    protection->overruns = overruns;
    return overruns;
}

/* True when the angle changed by more than the rotor can turn, over the lost periods as well. More lost periods are the
 * fault interrupt_overrun, and no other one follows from what the rotor did meanwhile. [SR-19] */
static bool encoder_jumped(const protection_parameters_t *parameters, int32_t angle_step, uint32_t missed_interrupts) {
    const uint32_t step_max = (uint32_t)parameters->angle_step_max;
    const uint32_t limit = step_max * missed_interrupts + step_max;
    return ((uint32_t)angle_step + limit > 2 * limit) & (missed_interrupts < PROTECTION_OVERRUNS_MAX);
}

/* The encoder has counted. Not inlined, which saves the longer path three instructions. [SR-20] */
NOINLINE static void count(protection_deferred_t *protection, uint32_t encoder_angle, int32_t speed_q22) {
    const int32_t before_q22 = protection->speed_counted_q22;
    protection->encoder_angle = encoder_angle;
    protection->frozen = false;
    protection->speed_lower_bound_q22 = fixed_min(speed_q22, before_q22);
    protection->speed_counted_q22 = speed_q22;
    protection->undetected_travel = 0;
}

/* True when the encoder does not count although the rotor turns: it is no slower than at the slower one of the last two
 * counts less the largest possible deceleration since; what the observer makes of a first count after rest is no speed.
 * The observer cannot tell: with a high bandwidth it follows a frozen encoder to standstill before the rotor has turned
 * far, and of a locked rotor it predicts motion. A rotor that leaves standstill meanwhile is found by its flux linkage
 * (encoder_monitor.h). Frozen until the encoder counts: at standstill nothing else shows whether it could. [SR-20] */
static bool encoder_frozen(const protection_parameters_t *parameters, protection_deferred_t *protection,
                           const protection_deferred_input_t *input) {
    if (input->encoder_angle != protection->encoder_angle) {
        count(protection, input->encoder_angle, fixed_abs(input->speed_q22));
        return false;
    }
    const int32_t periods = (int32_t)fixed_min_u32(input->periods, PERIODS_MAX);
    const int32_t bound_q22 =
        fixed_subtract(protection->speed_lower_bound_q22, parameters->deceleration_max_q22 * periods);
    protection->speed_lower_bound_q22 = bound_q22;
    /* The sum cannot overflow: it is at most 16 counts of the coarsest encoder, 2^28, and a step adds less than 2^30.1:
     * eight periods at the highest speed at 20 kHz. */
    if (bound_q22 < STANDSTILL_Q22) {
        protection->undetected_travel = 0;
    } else if (!protection->frozen) {
        protection->undetected_travel += periods * fixed_multiply_high(bound_q22, parameters->angle_step_q32);
    }
    protection->frozen |= protection->undetected_travel > parameters->undetected_travel_max;
    return protection->frozen;
}

/* [SR-02] [SR-11] [SR-12] [SR-13] [SR-19] [SR-45] [SR-46] */
uint64_t protection_check(const protection_parameters_t *parameters, protection_t *protection,
                          const protection_input_t *input) {
    const int32_t angle_step = (int32_t)(input->encoder_angle - protection->encoder_angle); /* modulo one revolution */
    protection->encoder_angle = input->encoder_angle;
    const uint32_t overruns = count_overruns(protection, input->missed_interrupts);
    uint32_t failed = 0;
    /* This order takes four instructions less than the faults' order: a single bit, moved, initialises the mask. */
    fail_if(&failed, (input->break_causes & HAL_PWM_BREAK_OVER_CURRENT) != 0, FAULT_HARDWARE_OVER_CURRENT);
    fail_if(&failed, (input->break_causes & (HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2)) != 0, FAULT_STO);
    fail_if(&failed, input->current_max_q9 > parameters->current_trip_q9, FAULT_OVER_CURRENT);
    fail_if(&failed, input->dc_link_voltage_q6 > parameters->dc_link_over_voltage_q6, FAULT_OVER_VOLTAGE);
    fail_if(&failed, (input->break_causes & HAL_PWM_BREAK_NOT_RENEWED) != 0, FAULT_INTERRUPT_OVERRUN);
    fail_if(&failed, overruns >= PROTECTION_OVERRUNS_MAX, FAULT_INTERRUPT_OVERRUN);
    fail_if(&failed, input->skipped_deferred >= PROTECTION_SKIPPED_DEFERRED_MAX, FAULT_INTERRUPT_OVERRUN);
    fail_if(&failed, encoder_jumped(parameters, angle_step, input->missed_interrupts), FAULT_ENCODER);
    return failed;
}

/* [SR-05] [SR-15] [SR-20] */
uint64_t protection_check_deferred(const protection_parameters_t *parameters, protection_deferred_t *protection,
                                   const protection_deferred_input_t *input) {
    uint32_t failed = 0;
    fail_if(&failed, encoder_frozen(parameters, protection, input), FAULT_ENCODER);
    fail_if(&failed, input->dc_link_voltage_q6 < parameters->dc_link_under_voltage_q6, FAULT_UNDER_VOLTAGE);
    fail_if(&failed, input->command_age_us > parameters->command_timeout_us, FAULT_COMMAND_TIMEOUT);
    return failed;
}
