// Equality of control parameters: of every member, not of the padding between them.
#ifndef TESTS_UNIT_EQUAL_PARAMETERS_H
#define TESTS_UNIT_EQUAL_PARAMETERS_H

#include <cstring>
#include <type_traits>

extern "C" {
#include "interrupts/control_step.h"
}

template <typename member_t> bool equal_bytes(const member_t &a, const member_t &b) {
    static_assert(std::has_unique_object_representations_v<member_t>, "it has padding");
    return std::memcmp(&a, &b, sizeof a) == 0;
}

// The name of the first member that differs; empty: none.
inline const char *difference(const control_parameters_t &a, const control_parameters_t &b) {
#define COMPARE(member)                                                                                                \
    if (!equal_bytes(a.member, b.member)) {                                                                            \
        return #member;                                                                                                \
    }
    COMPARE(controller)
    COMPARE(speed_law)
    COMPARE(torque_law)
    COMPARE(edge_age_shift)
    COMPARE(speed_reference_min_q22)
    COMPARE(speed_reference_max_q22)
    COMPARE(interleaved_pwm)
    COMPARE(load_from_transducer)
    COMPARE(period_ticks)
    COMPARE(encoder_shift)
    COMPARE(adc_bits)
    COMPARE(edge_age_max_ticks)
    COMPARE(edge_angle_per_tick_q51)
    COMPARE(encoder_middle)
    COMPARE(current_scale_q18)
    COMPARE(voltage_scale_q18)
    COMPARE(initialise_ticks)
    COMPARE(speed_ramp_q22)
    COMPARE(observer)
    COMPARE(commutation)
    COMPARE(protection)
    COMPARE(speed_pi)
    COMPARE(speed_smc)
    COMPARE(hysteresis)
    COMPARE(duty.pid)
    COMPARE(duty.current_setpoints)
    COMPARE(duty.incoming_gain_q24)
    COMPARE(duty.band_outer_q24)
    COMPARE(duty.current_limit_q9)
    COMPARE(duty.torque_per_flux_q16)
    COMPARE(duty.duty_per_torque_q44)
    COMPARE(predictive)
    COMPARE(conduction.sharing.overlapping)
    COMPARE(conduction.sharing.stroke)
    COMPARE(conduction.sharing.turn_on)
    COMPARE(conduction.sharing.turn_off)
    COMPARE(conduction.sharing.turn_on_advance)
    COMPARE(conduction.sharing.turn_off_advance)
    COMPARE(conduction.initial)
    COMPARE(conduction.own_windows)
    COMPARE(conduction.single_pulse)
    COMPARE(conduction.torque_min_q24)
    COMPARE(conduction.torque_max_q24)
    COMPARE(conduction.advance_step_q30)
    COMPARE(conduction.retract_step_q30)
    COMPARE(conduction.braking_end_q6)
    COMPARE(conduction.gain_per_step_q16)
    COMPARE(conduction.fold_back_range_q6)
    COMPARE(misalignment)
    COMPARE(bandwidth.schedule)
    COMPARE(bandwidth.stage)
    COMPARE(moving_load)
    COMPARE(stroke_mean)
    COMPARE(torque_offset)
    COMPARE(periodic_load)
    COMPARE(torque_mode)
    COMPARE(inertia)
#undef COMPARE
    return "";
}

#endif
