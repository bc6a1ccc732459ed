// Double-precision twin of the whole salient controller: the laws of twins.h in the order of the control interrupt,
// with the machine's own functions and Newton's inverses of them in the place of tables. It sees the same samples; what
// differs from the firmware is arithmetic, the tables and the stages of the observer's bandwidth.
#ifndef TESTS_UNIT_SALIENT_TWIN_H
#define TESTS_UNIT_SALIENT_TWIN_H

#include <algorithm>
#include <array>
#include <cmath>

extern "C" {
#include "drive/control.h"
#include "plant/machine.h"
}

#include "support/reference_models.h"

namespace twins {

// A phase of the emulated machine; angles in pitches, 0 aligned.
class exact_machine_t {
  public:
    explicit exact_machine_t(const machine_t &machine) : pitch_rad(2.0 * PI / machine.rotor_poles) {
        magnetics_prepare(&model, &machine.magnetics, machine.rotor_poles);
    }

    double torque(double angle, double current_A) const {
        return current_A > 0.0 ? at(angle, current_A).torque_Nm : 0.0;
    }
    double flux(double angle, double current_A) const {
        return current_A > 0.0 ? at(angle, current_A).flux_linkage_Wb : 0.0;
    }

    // The map's end where that does not reach the torque.
    double current_of_torque(double angle, double torque_Nm) const {
        return inverse(torque_Nm, [&](double current_A) {
            const magnetics_point_t point = at(angle, current_A);
            return std::array<double, 2>{point.torque_Nm, point.flux_gradient_Wb_rad};
        });
    }
    double current_of_flux(double angle, double flux_Wb) const {
        return inverse(flux_Wb, [&](double current_A) {
            const magnetics_point_t point = at(angle, current_A);
            return std::array<double, 2>{point.flux_linkage_Wb, point.incremental_inductance_H};
        });
    }

  private:
    static constexpr double END_A = 79.998;
    magnetics_model_t model;
    double pitch_rad;

    magnetics_point_t at(double angle, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle * pitch_rad, current_A, &point);
        return point;
    }

    // Newton's method on a rising function (value, slope), held within a bracket.
    template <typename function_t> static double inverse(double wanted, const function_t &function) {
        if (wanted <= 0.0) {
            return 0.0;
        }
        double low = 0.0, high = END_A, current_A = 10.0;
        if (function(high)[0] <= wanted) {
            return high;
        }
        for (int n = 0; n < 60; n++) {
            const auto [value, slope] = function(current_A);
            (value > wanted ? high : low) = current_A;
            double next_A = current_A - (value - wanted) / slope;
            if (!(next_A > low && next_A < high)) {
                next_A = 0.5 * (low + high);
            }
            if (std::fabs(next_A - current_A) < 1e-7) {
                return next_A;
            }
            current_A = next_A;
        }
        return current_A;
    }
};

class salient_t {
  public:
    using predict_t = predictive_t<exact_machine_t>;

    // The parameters of a drive, as numbers.
    salient_t(const control_parameters_t &p, const machine_t &plant, double control_rate_hz)
        : machine(plant), phases(plant.phases), poles(plant.rotor_poles), rate_hz(control_rate_hz),
          inertia_kg_m2(plant.inertia_kg_m2), friction_Nm_s(plant.friction_Nm_s), encoder_bits(32 - p.encoder_shift),
          adc_bits(p.adc_bits), epsilon(std::ldexp(p.speed_smc.epsilon_q31, -31)),
          delta_s(std::ldexp(p.speed_smc.delta_q27, -27) * std::log(2.0)), gain_Nm_s(p.speed_smc.gain_q24 / Q24),
          torque_max_Nm(p.speed_smc.torque_max_q24 / Q24) {
        const observer_bandwidth_parameters_t &b = p.bandwidth;
        bandwidth.steady_rad_s = b.bandwidth_rad_s[OBSERVER_BANDWIDTH_STAGES - 1];
        bandwidth.first_count_rad_s = b.bandwidth_rad_s[b.first_stage_count];
        bandwidth.first_edge_rad_s = b.bandwidth_rad_s[0];
        bandwidth.rate_hz = rate_hz;
        bandwidth.threshold_count = b.threshold_count / TURN;
        bandwidth.threshold_edge = b.threshold_edge / TURN;
        bandwidth.pause_s = b.pause_ticks / rate_hz;
        bandwidth.kept = b.forget_q32 / Q32;

        const predictive_torque_parameters_t &t = p.predictive;
        predictive.phases = phases;
        predictive.period_s = 1.0 / rate_hz;
        predictive.resistance_ohm = plant.resistance_ohm;
        predictive.flux_gain = t.flux.gain_q15 / Q15;
        predictive.current_limit_A = t.current_limit_q9 / Q9;
        predictive.reserve_Nm = t.reserve_q24 / Q24;
        predictive.sharing = t.share.sharing;
        const double stroke = 1.0 / phases, on = t.share.turn_on / TURN, off = t.share.turn_off / TURN;
        const double early_on = on - t.share.turn_on_early / TURN, early_off = off - t.share.turn_off_early / TURN;
        predictive.late = {on, stroke, predictive.sharing ? off - on - stroke : 0.0};
        predictive.early = {early_on, stroke, early_off - early_on - stroke};

        const double turn_rate_hz = rate_hz / phases;
        misalignment.phases = phases;
        misalignment.rate_hz = rate_hz;
        misalignment.rate_1_s = p.misalignment.rate_q30 / Q30 * turn_rate_hz;
        misalignment.filter_1_s = p.misalignment.filter_q16 / Q16 * turn_rate_hz;
        misalignment.mean_1_s = p.misalignment.mean_q16 / Q16 * turn_rate_hz;
        misalignment.settle_s = p.misalignment.settle_ticks / rate_hz;
    }

    // One period: duty of every phase.
    std::array<double, HAL_PHASES_MAX> step(const control_sample_t &sample, const command_t &command) {
        const bool run = command.request == COMMAND_RUN;
        bool from_edge = false;
        const double measured = measure_turns(sample.encoder, &from_edge);
        if (!started) {
            started = true;
            observer = observer_t::ideal(bandwidth.steady_rad_s, rate_hz, inertia_kg_m2, friction_Nm_s);
            observer.angle = measured;
        }
        predict_t::sample_t seen{};
        std::array<double, HAL_PHASES_MAX> angle{};
        double torque_Nm = 0.0;
        for (unsigned phase = 0; phase < phases; phase++) {
            angle[phase] = (measured - misalignment.offset_rad[phase] / (2.0 * PI)) * poles - double(phase) / phases;
            const double current_A = sample.adc.phase_current_counts[phase] * std::ldexp(80.0, -int(adc_bits));
            seen.current_A[phase] = current_A;
            seen.table_Wb[phase] = machine.flux(angle[phase], current_A);
            torque_Nm += machine.torque(angle[phase], current_A);
        }
        const double now_rad_s = bandwidth.step(observer.innovation(measured), from_edge);
        observer.tune(observer_t::ideal(now_rad_s, rate_hz, inertia_kg_m2, friction_Nm_s));
        observer.step(measured, torque_Nm);
        if (!run) {
            return {-1.0, -1.0, -1.0, -1.0};
        }

        const double reference_rad_s = command.speed_reference_q22 / Q22;
        const double slip_rad_s = reference_rad_s - observer.speed;
        const double asked_Nm = std::clamp(gain_Nm_s * reaching_rad_s2(1.0, epsilon, delta_s, slip_rad_s) +
                                               observer.load_torque + friction_Nm_s * observer.speed,
                                           -torque_max_Nm, torque_max_Nm);

        const bool steady =
            bandwidth.steady() && std::fabs(slip_rad_s) < std::fabs(observer.speed) / 64.0 && predictive.missing == 0.0;
        const double disturbance_Nm = observer.load_torque - observer.correction * inertia_kg_m2 * rate_hz;
        misalignment.step(disturbance_Nm, steady, asked_Nm, [&](unsigned phase) {
            constexpr double PROBE_RAD = 0.01;
            const double probe = PROBE_RAD / (2.0 * PI) * poles, current_A = seen.current_A[phase];
            return (machine.torque(angle[phase] + probe, current_A) - machine.torque(angle[phase] - probe, current_A)) /
                   (2.0 * PROBE_RAD);
        });

        seen.bus_V = sample.adc.bus_voltage_counts * std::ldexp(512.0, -int(adc_bits));
        seen.torque_Nm = asked_Nm;
        seen.backwards = observer.speed < 0.0;
        const double step_turn = observer.speed * observer.angle_step;
        seen.turn = std::fabs(step_turn) * poles;
        double ahead = observer.angle + step_turn - measured;
        ahead -= std::round(ahead);
        for (unsigned phase = 0; phase < phases; phase++) {
            seen.angle[phase] = angle[phase] + ahead * poles;
        }
        predictive.machine = &machine; // a copy of this object has one of its own
        predictive.step(seen);
        return predictive.duty;
    }

  private:
    exact_machine_t machine;
    unsigned phases;
    double poles, rate_hz, inertia_kg_m2, friction_Nm_s;
    unsigned encoder_bits, adc_bits;
    double epsilon, delta_s, gain_Nm_s, torque_max_Nm;
    bool started = false;
    observer_t observer{};
    bandwidth_t bandwidth{};
    predict_t predictive{};
    misalignment_t misalignment{};

    // As control.c: the middle of the count, or the last edge and the way since.
    double measure_turns(const hal_encoder_sample_t &encoder, bool *from_edge) const {
        const double count = std::ldexp(1.0, -int(encoder_bits));
        *from_edge = encoder.edge_known && encoder.edge_age_ticks <= 20000;
        if (!*from_edge) {
            return (encoder.counts + (encoder_bits < 32 ? 0.5 : 0.0)) * count;
        }
        return (encoder.counts + (encoder.edge_forward ? 0.0 : 1.0)) * count +
               observer.speed * encoder.edge_age_ticks * 5e-9 / (2.0 * PI);
    }
};

} // namespace twins

#endif
