#include "drive/stall_monitor.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Torque and speed of a stall. swings: the rotor has turned backwards a short time ago. */
static bool pushes_in_vain(const stall_input_t *input, bool swings) {
    const bool forward = input->speed_reference_q22 > 0;
    const int32_t limit_q24 = fixed_abs(forward ? input->torque_max_q24 : input->torque_min_q24);
    const int32_t torque_q24 = forward ? input->torque_reference_q24 : fixed_subtract(0, input->torque_reference_q24);
    const bool slow = fixed_abs(input->speed_q22) < fixed_abs(input->speed_reference_q22) / 2;
    return input->speed_mode && (slow || swings) && limit_q24 > 0 && torque_q24 >= limit_q24 - limit_q24 / 16;
}

COLD bool stall_monitor_failed(stall_monitor_t *monitor, const stall_input_t *input, uint32_t time_us) {
    const int32_t speed_q22 = input->speed_reference_q22 < 0 ? fixed_subtract(0, input->speed_q22) : input->speed_q22;
    const int32_t change_q22 = fixed_abs(input->speed_reference_q22) / 128;
    const bool forward = input->speed_reference_q22 > 0;
    const bool before = monitor->vain && monitor->forward == forward;
    if ((input->speed_q22 ^ input->speed_reference_q22) < 0) {
        monitor->backwards_us = time_us;
    }
    monitor->forward = forward;
    monitor->vain = pushes_in_vain(input, before && time_us - monitor->backwards_us <= STALL_TIME_US);
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
