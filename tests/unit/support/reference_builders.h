// Reference models with the parameters of the firmware, after their rounding.
#ifndef TESTS_UNIT_REFERENCE_BUILDERS_H
#define TESTS_UNIT_REFERENCE_BUILDERS_H

extern "C" {
#include "control/bp_pid.h"
#include "control/load_observer.h"
#include "control/machine_tables.h"
#include "control/misalignment.h"
#include "control/moving_load.h"
#include "control/observer_bandwidth.h"
#include "control/predictive_torque.h"
#include "control/speed_pi.h"
#include "control/torque_sharing.h"
}

#include "support/reference_models.h"

namespace reference_model {

inline pi_t model_of(const speed_pi_parameters_t &p) {
    using namespace fixed_point;
    return {.kp = p.kp_q16 / Q16,
            .ki_step = p.ki_step_q32 / Q32,
            .low = p.torque_min_q24 / Q24,
            .high = p.torque_max_q24 / Q24};
}

// J l3, N m Q7.24 per 2^-32 rev.
inline double load_gain(const load_observer_gains_t &gains) {
    return -gains.load_gain_q28 / fixed_point::Q28 * gains.load_factor_q4 / 16.0;
}

inline observer_t model_of(const load_observer_gains_t &gains, const load_observer_model_t &model) {
    using namespace fixed_point;
    observer_t observer{};
    observer.angle_gain = gains.angle_gain_q28 / Q28;
    observer.speed_gain = gains.speed_gain_q24 / Q24 * REV / Q22;
    observer.torque_gain = load_gain(gains) * REV / Q24;
    observer.acceleration = model.acceleration_q32 / Q32 * Q24 / Q22;
    observer.friction = model.friction_q30 / Q30;
    observer.angle_step = model.angle_step_q32 / Q32 * Q22 / REV;
    return observer;
}

inline bandwidth_t model_of(const observer_bandwidth_parameters_t &p, double rate_hz) {
    bandwidth_t bandwidth{};
    bandwidth.steady_rad_s = p.stage[OBSERVER_BANDWIDTH_STEADY_STAGE].bandwidth_rad_s;
    bandwidth.beat_rad_s = p.stage[OBSERVER_BANDWIDTH_STAGES - 1].bandwidth_rad_s;
    bandwidth.count_trigger_rad_s = p.stage[p.schedule.trigger_stage_count].bandwidth_rad_s;
    bandwidth.edge_trigger_rad_s = p.stage[0].bandwidth_rad_s;
    bandwidth.rate_hz = rate_hz;
    bandwidth.threshold_count = p.schedule.threshold_count / fixed_point::REV;
    bandwidth.threshold_edge = p.schedule.threshold_edge / fixed_point::REV;
    bandwidth.holdoff_s = p.schedule.retrigger_holdoff_ticks / rate_hz;
    bandwidth.holdoff_decay = p.schedule.holdoff_decay_q32 / fixed_point::Q32;
    return bandwidth;
}

inline moving_load_t model_of(const moving_load_parameters_t &p, bool edges, double rate_hz) {
    moving_load_t moving{};
    moving.rate_hz = rate_hz;
    // A count's rounding adds to the threshold only at low speeds.
    moving.threshold = (edges ? 7656.0 : p.threshold_count_q4) / 16.0 / fixed_point::REV;
    moving.stages = p.stages;
    moving.settling_s = p.settling_ticks / rate_hz;
    return moving;
}

inline misalignment_t model_of(const misalignment_parameters_t &p, unsigned phases, double update_rate_hz) {
    const double phase_rate_hz = update_rate_hz / phases;
    misalignment_t misalignment{};
    misalignment.phases = phases;
    misalignment.rate_hz = update_rate_hz;
    misalignment.rate_1_s = p.rate_q30 / fixed_point::Q30 * phase_rate_hz;
    misalignment.filter_factor = p.filter_q32 / fixed_point::Q32 * phase_rate_hz;
    misalignment.mean_1_s = p.mean_q16 / fixed_point::Q16 * phase_rate_hz;
    misalignment.settle_s = p.settle_updates / update_rate_hz;
    return misalignment;
}

inline torque_sharing_t model_of(const torque_sharing_parameters_t &p, double advance) {
    using fixed_point::REV;
    const double on = p.turn_on / REV - advance * p.turn_on_advance / REV;
    const double off = p.turn_off / REV - advance * p.turn_off_advance / REV;
    const double stroke = p.stroke / REV;
    return {.turn_on = on, .stroke = stroke, .overlap = p.overlapping ? off - on - stroke : 0.0};
}

// From the tables of a machine; control_rate_hz of the periods.
inline own_windows_t own_windows_of(const machine_tables_t &tables, double control_rate_hz) {
    using namespace fixed_point;
    own_windows_t model{};
    for (unsigned half = 0; half < 2; half++) {
        for (unsigned speed = 0; speed < MACHINE_SHARING_SPEEDS; speed++) {
            for (unsigned part = 0; part < MACHINE_SHARING_PARTS; part++) {
                const machine_sharing_window_t &of = tables.sharing[half][speed][part];
                model.window[half][speed][part] = {of.on / 65536.0, of.off / 65536.0};
            }
        }
    }
    model.torque = tables.sharing_torque / 256.0;
    const double base_rad_s_per_V =
        std::ldexp(double(tables.pulse_base_index), 32) / double(tables.pulse_index_scale) * 64.0 / Q22;
    model.base_step_per_V = base_rad_s_per_V / (2.0 * PI) * tables.rotor_poles / control_rate_hz;
    return model;
}

template <typename machine_t>
predictive_t<machine_t> model_of(const predictive_torque_parameters_t &p, const conduction_parameters_t &conduction,
                                 const machine_t *machine, unsigned phases) {
    using namespace fixed_point;
    predictive_t<machine_t> model{};
    model.machine = machine;
    model.phases = phases;
    model.period_s = p.period_q40 / Q40;
    model.resistance_ohm = p.flux.resistance_period_q40 / Q40 / model.period_s;
    model.flux_gain = p.flux.gain_q30 / Q30;
    model.current_limit_A = p.current_limit_q9 / Q9;
    model.reserve_Nm = p.reserve_q24 / Q24;
    model.sharing = conduction.sharing.overlapping;
    model.base_window = model_of(conduction.sharing, 0.0);
    model.advanced_window = model_of(conduction.sharing, 1.0);
    model.has_own_windows = conduction.own_windows;
    model.own_windows = own_windows_of(machine_tables, 1.0 / model.period_s);
    return model;
}

inline bp_pid_t model_of(const bp_pid_parameters_t &p) {
    using namespace fixed_point;
    bp_pid_t model{};
    model.mode = bp_pid_t::mode_t(p.mode);
    model.error_scale_inverse = p.error_scale_inverse_q24 / Q24;
    model.scale = {p.scale_q28[0] / Q28, p.scale_q28[1] / Q28, p.scale_q28[2] / Q28};
    model.eta = p.network.learning_rate_q15 / Q15;
    model.alpha = p.network.momentum_q32 / Q32;
    return model;
}

} // namespace reference_model

#endif
