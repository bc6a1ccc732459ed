/* Checks that end a run. */
#include "hal_pwm.h"
#include "monitors/protection.c"
#include "monitors/sto_monitor.c"
#include "monitors/watchdog_monitor.c"
#include "proof.h"

/* Every immediate check, of any sample: each is found in the same period, and nothing else is. */
void prove_protection(protection_parameters_t parameters, protection_t protection, protection_input_t input) {
    /* configure.c: 3/2 of a step at the over-speed limit, below 2^27.8 (the next proof), and two counts of 2^24. */
    ASSUME(parameters.angle_step_max > 0 && parameters.angle_step_max < 1 << 29);
    ASSUME(protection.overruns <= INT32_MAX);   /* protection.h: saturates */
    ASSUME(input.missed_interrupts < 1u << 31); /* sampler.c: triggers within a day at 20 kHz */
    const protection_t before = protection;
    const uint64_t failed = protection_check(&parameters, &protection, &input);
    const uint32_t lost = HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2;
    CLAIM(protection.overruns <= INT32_MAX && protection.encoder_angle == input.encoder_angle);
    CLAIM(((failed & FAULT_BIT(FAULT_OVER_CURRENT)) != 0) == (input.current_max_q9 > parameters.current_trip_q9));
    CLAIM(((failed & FAULT_BIT(FAULT_OVER_VOLTAGE)) != 0) ==
          (input.dc_link_voltage_q6 > parameters.dc_link_over_voltage_q6));
    CLAIM(((failed & FAULT_BIT(FAULT_STO)) != 0) == ((input.break_causes & lost) != 0));
    CLAIM(((failed & FAULT_BIT(FAULT_HARDWARE_OVER_CURRENT)) != 0) ==
          ((input.break_causes & HAL_PWM_BREAK_OVER_CURRENT) != 0));
    CLAIM(IMPLIES(input.missed_interrupts >= PROTECTION_OVERRUNS_MAX, failed & FAULT_BIT(FAULT_INTERRUPT_OVERRUN)));
    CLAIM(IMPLIES(input.skipped_deferred >= PROTECTION_SKIPPED_DEFERRED_MAX,
                  failed & FAULT_BIT(FAULT_INTERRUPT_OVERRUN)));
    if (input.missed_interrupts == 0) {
        const int64_t step = (int32_t)(input.encoder_angle - before.encoder_angle);
        CLAIM(((failed & FAULT_BIT(FAULT_ENCODER)) != 0) ==
              (step > parameters.angle_step_max || step < -(int64_t)parameters.angle_step_max));
        CLAIM(protection.overruns == 0 && protection.late_interrupts == before.late_interrupts);
    }
    CLAIM(IMPLIES(before.overruns >= PROTECTION_OVERRUNS_MAX && input.missed_interrupts != 0,
                  failed & FAULT_BIT(FAULT_INTERRUPT_OVERRUN)));
    protection_reset(&protection, input.encoder_angle);
    CLAIM(protection.overruns == 0 && protection.encoder_angle == input.encoder_angle);
}

/* The deferred checks, of any sample; the sum of the undetected travel stays within its bound. */
void prove_protection_deferred(protection_parameters_t parameters, protection_deferred_t protection,
                               protection_deferred_input_t input) {
    ASSUME(parameters.deceleration_max_q22 >= 0 && parameters.deceleration_max_q22 <= PROTECTION_DECELERATION_MAX_Q22);
    ASSUME(parameters.undetected_travel_max >= 0 && parameters.undetected_travel_max <= 1 << 28); /* protection.h */
    /* load_observer.c: eight periods at the highest speed of the fastest machine at 20 kHz are below 2^30.1. */
    ASSUME(parameters.angle_step_q32 >= 0 && parameters.angle_step_q32 <= 280 << 20);
    ASSUME(protection.undetected_travel >= 0);
    ASSUME(protection.frozen || protection.undetected_travel <= parameters.undetected_travel_max);
    const uint64_t failed = protection_check_deferred(&parameters, &protection, &input);
    CLAIM(protection.undetected_travel >= 0);
    CLAIM(protection.frozen || protection.undetected_travel <= parameters.undetected_travel_max);
    CLAIM(((failed & FAULT_BIT(FAULT_ENCODER)) != 0) == protection.frozen);
    CLAIM(((failed & FAULT_BIT(FAULT_UNDER_VOLTAGE)) != 0) ==
          (input.dc_link_voltage_q6 < parameters.dc_link_under_voltage_q6));
    CLAIM(((failed & FAULT_BIT(FAULT_COMMAND_TIMEOUT)) != 0) == (input.command_age_us > parameters.command_timeout_us));
    protection_deferred_reset(&protection, input.encoder_angle);
    CLAIM(protection.undetected_travel == 0 && !protection.frozen);
}

/* Lines that differ are a fault after the time, and it ends by both without energy alone. */
void prove_sto(sto_monitor_t monitor, uint32_t causes, uint32_t time_us) {
    const sto_monitor_t before = monitor;
    const bool failed = sto_monitor_failed(&monitor, causes, time_us);
    const bool one = (causes & HAL_PWM_BREAK_STO_1) != 0, two = (causes & HAL_PWM_BREAK_STO_2) != 0;
    CLAIM(failed == monitor.failed);
    CLAIM(IMPLIES(one && two, !failed));
    CLAIM(IMPLIES(before.failed && !(one && two), failed));
    CLAIM(IMPLIES(one != two && time_us - before.agreed_us > STO_DISCREPANCY_US, failed));
    CLAIM(IMPLIES(failed && !before.failed, one != two));
}

/* No kick unless all three have advanced in order, for ever after one disorder. */
void prove_watchdog(watchdog_monitor_t monitor, uint32_t periods, uint32_t requests, uint32_t completed,
                    uint32_t time_us) {
    const watchdog_monitor_t before = monitor;
    const bool kicks = watchdog_monitor_kick(&monitor, periods, requests, completed, time_us);
    if (kicks) {
        CLAIM(!before.disordered && before.passed == 0x1B); /* 1, 2, 3 in pairs of bits */
        CLAIM(periods != before.periods && completed != before.completed && requests - completed <= 1);
        CLAIM(time_us - before.kicked_us >= WATCHDOG_KICK_US);
        CLAIM(monitor.periods == periods && monitor.completed == completed && monitor.kicked_us == time_us);
    }
    CLAIM(IMPLIES(before.disordered || before.passed != 0x1B, monitor.disordered && !kicks));
    CLAIM(monitor.passed == 0);
    watchdog_monitor_pass(&monitor, WATCHDOG_CHECKED);
    watchdog_monitor_pass(&monitor, WATCHDOG_STORED);
    watchdog_monitor_pass(&monitor, WATCHDOG_SERVED);
    CLAIM(monitor.passed == 0x1B);
}
