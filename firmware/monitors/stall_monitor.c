#include "monitors/stall_monitor.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Speed of three strokes in STALL_SWING_US, in 2^-22 rad/s, times the strokes of a revolution, without the unit of
 * speed: 3 * 2 pi rad / 0.225 s. */
#define THREE_STROKES_Q22 UINT32_C(351381190)

#define ONE_REV_Q24 (1 << 24)

/* Torque and speed of a stall. swings: the rotor has turned backwards a short time ago. [SR-24] */
static bool pushes_in_vain(const stall_input_t *input, bool swings) {
    const bool forward = input->speed_reference_q22 > 0;
    const int32_t limit_q24 = fixed_abs(forward ? input->torque_max_q24 : input->torque_min_q24);
    const int32_t torque_q24 = forward ? input->torque_reference_q24 : fixed_subtract(0, input->torque_reference_q24);
    const bool slow = fixed_abs(input->speed_q22) < fixed_abs(input->speed_reference_q22) / 2;
    return input->speed_mode && (slow || swings) && limit_q24 > 0 && torque_q24 >= limit_q24 - limit_q24 / 16;
}

/* Widens the range of the angles that the rotor has been at, of the last revolution, by at least half a stroke.
 * [SR-24] */
static bool widens_range(stall_monitor_t *monitor) {
    const int32_t half_stroke_q24 = ONE_REV_Q24 / 2 / machine_tables.phases;
    int32_t ahead_q24 = monitor->ahead_q24, lowest_q24 = monitor->lowest_ahead_q24;
    if (ahead_q24 > half_stroke_q24) {
        lowest_q24 -= ahead_q24;
        ahead_q24 = 0;
    } else if (ahead_q24 < lowest_q24 - half_stroke_q24) {
        ahead_q24 = ahead_q24 < -ONE_REV_Q24 ? -ONE_REV_Q24 : ahead_q24;
        lowest_q24 = ahead_q24;
    } else {
        return false;
    }
    monitor->ahead_q24 = ahead_q24;
    monitor->lowest_ahead_q24 = lowest_q24 < -ONE_REV_Q24 ? -ONE_REV_Q24 : lowest_q24;
    return true;
}

/* The rotor has come no further in either direction, nor turned backwards more slowly by change_q22, for STALL_SWING_US
 * and the time in which the reference turns by three strokes: r, of at most 4 f, and f have r f / (r + f), the speed of
 * three strokes in the sum of their times. Factors below 2^16. speed_q22: in the direction of the reference. [SR-24] */
static bool makes_no_progress(stall_monitor_t *monitor, const stall_input_t *input, int32_t speed_q22,
                              int32_t change_q22, bool begins, uint32_t time_us) {
    const uint32_t strokes = (uint32_t)machine_tables.rotor_poles * machine_tables.phases;
    const uint32_t swing_q10 = (THREE_STROKES_Q22 >> machine_tables.speed_exponent) / strokes >> 12;
    uint32_t reference_q10 = fixed_magnitude(input->speed_reference_q22) >> 12;
    reference_q10 = reference_q10 < 4 * swing_q10 ? reference_q10 : 4 * swing_q10;
    monitor->ahead_q24 += (int32_t)(input->electrical - monitor->electrical) / 256;
    monitor->travel +=
        (uint64_t)(reference_q10 * swing_q10 / (reference_q10 + swing_q10)) * (time_us - monitor->looked_us);
    monitor->electrical = input->electrical;
    monitor->looked_us = time_us;
    if (begins) {
        monitor->ahead_q24 = monitor->lowest_ahead_q24 = 0;
    }
    const bool slower = speed_q22 < 0 && speed_q22 > fixed_add(monitor->slowest_q22, change_q22);
    if (widens_range(monitor) || begins || slower) {
        monitor->slowest_q22 = speed_q22;
        monitor->travel = 0;
    }
    return monitor->travel > (uint64_t)swing_q10 * STALL_SWING_US;
}

/* [SR-24] */
COLD bool stall_monitor_failed(stall_monitor_t *monitor, const stall_input_t *input, uint32_t time_us) {
    const bool forward = input->speed_reference_q22 > 0; /* for a reference of 0 it has to be the same everywhere */
    const int32_t speed_q22 = forward ? input->speed_q22 : fixed_subtract(0, input->speed_q22);
    const int32_t change_q22 = fixed_abs(input->speed_reference_q22) / 128;
    const bool before = monitor->vain && monitor->forward == forward;
    if (speed_q22 < 0) {
        monitor->backwards_us = time_us;
    } else if (time_us - monitor->backwards_us > STALL_TIME_US) {
        monitor->backwards_us = time_us - STALL_TIME_US - 1u; /* its age does not wrap */
    }
    const bool backwards = time_us - monitor->backwards_us <= STALL_TIME_US;
    const bool begins = !input->speed_mode || monitor->forward != forward;
    if (makes_no_progress(monitor, input, speed_q22, change_q22, begins, time_us) && backwards) {
        return true;
    }
    monitor->forward = forward;
    monitor->vain = pushes_in_vain(input, before && backwards);
    if (!monitor->vain || !before) {
        monitor->lowest_q22 = monitor->highest_q22 = speed_q22;
    } else if (speed_q22 < fixed_subtract(monitor->lowest_q22, change_q22)) {
        monitor->lowest_q22 = speed_q22;
    } else if (speed_q22 > fixed_add(monitor->highest_q22, change_q22)) {
        monitor->highest_q22 = speed_q22;
    } else {
        return time_us - monitor->changed_us > STALL_TIME_US;
    }
    monitor->changed_us = time_us;
    return false;
}
