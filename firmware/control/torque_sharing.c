#include "control/torque_sharing.h"

#include "fixed/formats.h"

torque_sharing_window_t torque_sharing_window(const torque_sharing_parameters_t *parameters, int32_t advance_q15) {
    const uint32_t advance = (uint32_t)advance_q15;
    const uint32_t on_advance = (uint32_t)(((uint64_t)parameters->turn_on_advance * advance) >> 15);
    const uint32_t off_advance = (uint32_t)(((uint64_t)parameters->turn_off_advance * advance) >> 15);
    torque_sharing_window_t window = {.turn_on = parameters->turn_on - on_advance, .stroke = parameters->stroke};
    if (parameters->overlapping) {
        window.overlap = parameters->turn_off - off_advance - window.turn_on - parameters->stroke;
        /* 2^32 / (overlap / 2^15) by a 32-bit division: the overlap is truncated to 2^-17 electrical rev. */
        window.reciprocal = UINT32_MAX / (window.overlap >> 15);
    }
    return window;
}

/* 3 x^2 - 2 x^3 in Q1.15 for x in Q1.15, 0..32768. */
static int32_t cubic_q15(int32_t x_q15) {
    const int32_t square_q15 = (x_q15 * x_q15) >> 15;
    return (square_q15 * (3 * ONE_Q15 - 2 * x_q15)) >> 15; /* the product is the result in Q30: at most 2^30 */
}

/* Rising share at an angle within the overlap, Q1.15. */
static int32_t rising_share_q15(const torque_sharing_window_t *window, uint32_t inside) {
    const uint32_t x_q15 = (uint32_t)(((uint64_t)inside * window->reciprocal) >> 32);
    return cubic_q15(x_q15 < ONE_Q15 ? (int32_t)x_q15 : ONE_Q15);
}

int32_t torque_sharing_q15(const torque_sharing_window_t *window, uint32_t angle) {
    const uint32_t since_on = angle - window->turn_on; /* from 2^31 before turn-on: beyond the window */
    if (since_on < window->overlap) {
        return rising_share_q15(window, since_on);
    }
    if (since_on < window->stroke) {
        return ONE_Q15;
    }
    const uint32_t since_end = since_on - window->stroke;
    return since_end < window->overlap ? ONE_Q15 - rising_share_q15(window, since_end) : 0;
}
