/* Pieces of the control laws without loops but over phases: nothing overflows for any sample, results are in range. */
#include "comms/frame_queue.h"
#include "control/flux_observer.c"
#include "control/modulator.c"
#include "control/speed_pi.c"
#include "control/speed_smc.c"
#include "control/torque_offset.c"
#include "control/torque_sharing.c"
#include "fixed/divide.c"
#include "fixed/exp2.c"
#include "proof.h"

/* 127 N m, the largest torque of parameters.def. */
#define TORQUE_MAX_Q24 (127 << 24)

static void claim_compared(int32_t duty_q15, uint16_t period_ticks, bool interleaved) {
    hal_pwm_compare_t compare = {.upper = {0, 7}};
    modulate(&duty_q15, 1, period_ticks, interleaved, &compare);
    CLAIM(compare.upper[0] <= period_ticks && compare.lower[0] <= period_ticks);
    CLAIM(IMPLIES(!interleaved && compare.upper[0] != 0, compare.lower[0] == period_ticks));
    CLAIM(IMPLIES(duty_q15 == -32768, compare.upper[0] == 0 && compare.lower[0] == 0));
    CLAIM(IMPLIES(duty_q15 == 32768, compare.upper[0] == period_ticks && compare.lower[0] == period_ticks));
    CLAIM(compare.upper[1] == 7); /* other phases keep theirs */
}

/* Nothing overflows with any period, and with some of them the compare values are within it. */
void prove_modulator(int32_t duty_q15, uint16_t period_ticks, bool interleaved) {
    ASSUME(period_ticks >= 1 && period_ticks <= 32767); /* the header */
    /* The duties of pwm_ditc.c, ditc_hysteresis.c and predictive_torque.c. */
    ASSUME(duty_q15 >= -32768 && duty_q15 <= 32768);
    hal_pwm_compare_t compare;
    modulate(&duty_q15, 1, period_ticks, interleaved, &compare);
    claim_compared(duty_q15, 1, interleaved);
    claim_compared(duty_q15, 2125, interleaved); /* 40 kHz of 170 MHz, up and down */
    claim_compared(duty_q15, 32767, interleaved);
}

/* The torque stays within its limits, and the integral too, whatever the error: a step of an induction. */
void prove_speed_pi(speed_pi_parameters_t parameters, speed_pi_t pi, int32_t speed_error_q22, int32_t torque_q24) {
    ASSUME(parameters.kp_q16 >= 0 && parameters.kp_q16 <= 1000 << 16 && parameters.ki_step_q32 >= 0); /* the header */
    ASSUME(parameters.torque_min_q24 < parameters.torque_max_q24);
    ASSUME(parameters.torque_min_q24 >= -TORQUE_MAX_Q24 && parameters.torque_max_q24 <= TORQUE_MAX_Q24);
    const int64_t least_q54 = (int64_t)parameters.torque_min_q24 * (1 << 30);
    const int64_t most_q54 = ((int64_t)parameters.torque_max_q24 + 1) * (1 << 30);
    ASSUME(pi.integral_q54 >= least_q54 && pi.integral_q54 < most_q54);
    const int32_t result_q24 = speed_pi_step(&parameters, &pi, speed_error_q22);
    CLAIM(result_q24 >= parameters.torque_min_q24 && result_q24 <= parameters.torque_max_q24);
    CLAIM(pi.integral_q54 >= least_q54 && pi.integral_q54 < most_q54);
    ASSUME(torque_q24 >= parameters.torque_min_q24 && torque_q24 <= parameters.torque_max_q24); /* the header */
    speed_pi_follow(&pi, torque_q24);
    CLAIM(integral_torque_q24(pi.integral_q54) == torque_q24);
    speed_pi_reset(&pi);
    CLAIM(pi.integral_q54 == 0);
}

/* A step of an induction: the offset stays within an eighth of the limit. */
void prove_torque_offset(torque_offset_parameters_t parameters, torque_offset_t offset, int32_t reference_q24,
                         int32_t torque_q24, bool voltage_limited) {
    /* torque_offset_configure(): 20 Hz of an update rate of 1 kHz or more, an eighth of the largest torque. */
    ASSUME(parameters.gain_q32 >= 0 && parameters.gain_q32 <= 85899346);
    ASSUME(parameters.limit_q24 >= 0 && parameters.limit_q24 <= TORQUE_MAX_Q24 / 8);
    const int64_t limit_q56 = (int64_t)parameters.limit_q24 * (INT64_C(1) << 32);
    ASSUME(offset.offset_q56 >= -limit_q56 && offset.offset_q56 <= limit_q56);
    const int64_t before_q56 = offset.offset_q56;
    torque_offset_step(&parameters, &offset, reference_q24, torque_q24, voltage_limited);
    CLAIM(offset.offset_q56 >= -limit_q56 && offset.offset_q56 <= limit_q56);
    CLAIM(IMPLIES(voltage_limited, offset.offset_q56 == before_q56));
    CLAIM(torque_offset_q24(&offset) >= -parameters.limit_q24 && torque_offset_q24(&offset) <= parameters.limit_q24);
}

/* The flux linkage is never negative, whatever the sample. */
void prove_flux_observer(flux_observer_parameters_t parameters, int32_t flux_q29, int32_t table_q29,
                         int32_t applied_q29, int32_t current_q9) {
    ASSUME(parameters.gain_q30 >= 0 && parameters.gain_q30 < 1 << 30);                         /* configure_torque.c */
    ASSUME(parameters.resistance_period_q40 >= 0 && current_q9 >= 0 && current_q9 <= 1 << 18); /* the header */
    const int32_t drop_q29 = flux_observer_step(&parameters, &flux_q29, table_q29, applied_q29, current_q9);
    CLAIM(flux_q29 >= 0 && drop_q29 >= 0);
}

/* A ring whose index or count has changed in memory reaches no frame outside of it. */
void prove_frame_queue(frame_queue_t queue, hal_can_frame_t frame) {
    const hal_can_frame_t *oldest = frame_queue_peek(&queue);
    CLAIM((oldest == NULL) == (queue.count == 0));
    CLAIM(oldest == NULL || (oldest >= queue.frames && oldest < queue.frames + FRAME_QUEUE_CAPACITY));
    CLAIM(frame_queue_free(&queue) <= FRAME_QUEUE_CAPACITY);
    const unsigned before = frame_queue_free(&queue);
    if (before > 0) { /* its callers ask before */
        frame_queue_push(&queue, &frame);
        CLAIM(frame_queue_free(&queue) == before - 1);
        frame_queue_pop(&queue);
        CLAIM(frame_queue_free(&queue) == before && queue.first < FRAME_QUEUE_CAPACITY);
    }
}

/* Nothing is undefined for any speed error, and the torque has its sign. */
void prove_speed_smc(speed_smc_parameters_t parameters, int32_t x_q22, int32_t reaching_q24, int32_t load_q24,
                     int32_t min_q24, int32_t max_q24) {
    ASSUME(parameters.gain_q24 > 0 && parameters.friction_q30 >= 0); /* the header */
    ASSUME(parameters.epsilon_q31 >= SPEED_SMC_EPSILON_MIN_Q31);
    ASSUME(parameters.delta_q27 >= 0 && parameters.delta_q27 <= 1936370000); /* 10 / ln 2 in Q27 */
    const int32_t torque_q24 = speed_smc_reaching_torque_q24(&parameters, x_q22);
    CLAIM(IMPLIES(x_q22 >= 0, torque_q24 >= 0) && IMPLIES(x_q22 < 0, torque_q24 <= 0));
    ASSUME(min_q24 <= max_q24);
    const int32_t limited_q24 = speed_smc_torque_q24(&parameters, reaching_q24, x_q22, load_q24, min_q24, max_q24);
    CLAIM(limited_q24 >= min_q24 && limited_q24 <= max_q24);
}

/* A share is never outside of 0..1, of any window and angle: a flipped bit of one reaches no other range. */
void prove_torque_sharing(torque_sharing_window_t window, uint32_t angle, torque_sharing_parameters_t parameters,
                          int32_t advance_q15) {
    const int32_t share_q15 = torque_sharing_q15(&window, angle);
    CLAIM(share_q15 >= 0 && share_q15 <= ONE_Q15);
    ASSUME(advance_q15 >= 0 && advance_q15 <= ONE_Q15); /* conduction.c */
    ASSUME(!parameters.overlapping); /* with an overlap the header's distance of turn-off keeps the divisor above 0 */
    const torque_sharing_window_t single = torque_sharing_window(&parameters, advance_q15);
    CLAIM(single.overlap == 0 && single.stroke == parameters.stroke);
}
