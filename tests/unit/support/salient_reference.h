// Reference model of the whole salient controller: the laws of reference_models.h in the order of the control
// interrupt, with the exact functions of the machine and their inverses by Newton's method instead of tables. It gets
// the same samples; the differences to the firmware are arithmetic, tables and the stages of the bandwidth schedule.
#ifndef TESTS_UNIT_SALIENT_REFERENCE_H
#define TESTS_UNIT_SALIENT_REFERENCE_H

#include <algorithm>
#include <array>
#include <cmath>

extern "C" {
#include "drive/control.h"
#include "drive/deferred.h"
#include "plant/machine.h"
}

#include "support/reference_builders.h"

namespace reference_model {

using namespace fixed_point;

// A phase of the emulated machine; angles in electrical revolutions, 0 aligned.
class exact_machine_t {
  public:
    explicit exact_machine_t(const machine_t &machine) : electrical_rev_rad(2.0 * PI / machine.rotor_poles) {
        magnetics_prepare(&model, &machine.magnetics, machine.rotor_poles);
    }

    double torque(double angle, double current_A) const {
        return current_A > 0.0 ? at(angle, current_A).torque_Nm : 0.0;
    }
    double flux(double angle, double current_A) const {
        return current_A > 0.0 ? at(angle, current_A).flux_linkage_Wb : 0.0;
    }

    // The end of the map when no current of it makes the torque.
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
    double electrical_rev_rad;

    magnetics_point_t at(double angle, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle * electrical_rev_rad, current_A, &point);
        return point;
    }

    // Newton's method on a rising function (value, slope), safeguarded by a bracket.
    template <typename function_t> static double inverse(double target, const function_t &function) {
        if (target <= 0.0) {
            return 0.0;
        }
        double low = 0.0, high = END_A, current_A = 10.0;
        if (function(high)[0] <= target) {
            return high;
        }
        for (int n = 0; n < 60; n++) {
            const auto [value, slope] = function(current_A);
            (value > target ? high : low) = current_A;
            double next_A = current_A - (value - target) / slope;
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

    // Parameters of the firmware as doubles.
    salient_t(const control_parameters_t &p, const machine_t &plant, double control_rate_hz)
        : machine(plant), phases(plant.phases), poles(plant.rotor_poles), rate_hz(control_rate_hz),
          inertia_kg_m2(plant.inertia_kg_m2), friction_Nm_s(plant.friction_Nm_s), encoder_bits(32 - p.encoder_shift),
          adc_bits(p.adc_bits), epsilon(std::ldexp(p.speed_smc.epsilon_q31, -31)),
          delta_s(std::ldexp(p.speed_smc.delta_q27, -27) * std::log(2.0)), gain_Nm_s(p.speed_smc.gain_q24 / Q24),
          torque_max_Nm(p.torque_mode.torque_max_q24 / Q24) {
        bandwidth = model_of(p.bandwidth, rate_hz);
        moving_load[0] = model_of(p.moving_load, false, rate_hz);
        moving_load[1] = model_of(p.moving_load, true, rate_hz);
        std::copy(std::begin(p.bandwidth.bandwidth_rad_s), std::end(p.bandwidth.bandwidth_rad_s), stage_rad_s.begin());
        offset_limit_Nm = torque_max_Nm / 8.0;
        predictive = model_of(p.predictive, &machine, phases);
        predictive.period_s = 1.0 / rate_hz;
        predictive.resistance_ohm = plant.resistance_ohm;
        misalignment = model_of(p.misalignment, phases, rate_hz / DEFERRED_LEARNING_PERIODS);
    }

    // One period: duty of each phase.
    std::array<double, HAL_PHASES_MAX> step(const control_sample_t &sample, const command_t &command) {
        const bool run = command.request == COMMAND_RUN;
        bool from_edge = false;
        const double measured = measure_rev(sample.encoder, &from_edge);
        if (!initialised) {
            initialised = true;
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
        const double innovation = observer.innovation(measured);
        const double now_rad_s = bandwidth.step(innovation, from_edge, least_rad_s);
        const unsigned withheld = moving_load[from_edge].step(innovation); // acts in the next period
        least_rad_s = withheld > 0 ? stage_rad_s[OBSERVER_BANDWIDTH_STAGES - 1 - withheld] : 0.0;
        observer.set_gains(observer_t::ideal(now_rad_s, rate_hz, inertia_kg_m2, friction_Nm_s));
        observer.step(measured, torque_Nm);
        if (!run) {
            reaching_Nm = 0.0;
            return {-1.0, -1.0, -1.0, -1.0};
        }

        const double reference_rad_s = command.speed_reference_q22 / Q22;
        const double slip_rad_s = reference_rad_s - observer.speed;
        // The reaching torque of the previous period, of the deferred step; the feed-forward of this one.
        const double reference_Nm =
            std::clamp(reaching_Nm + offset_Nm + observer.load_torque + friction_Nm_s * observer.speed, -torque_max_Nm,
                       torque_max_Nm);
        reaching_Nm = gain_Nm_s * reaching_rad_s2(1.0, epsilon, delta_s, slip_rad_s);
        if (predictive.torque_shortfall == 0.0) {
            offset_Nm += 20.0 / rate_hz * (reference_Nm - offset_Nm - torque_Nm);
            offset_Nm = std::clamp(offset_Nm, -offset_limit_Nm, offset_limit_Nm);
        }

        // The common angle and the mean load of the strokes are left out: these runs are aligned, their load is
        // constant.
        const bool steady = bandwidth.steady() && std::fabs(slip_rad_s) < std::fabs(observer.speed) / 64.0 &&
                            predictive.torque_shortfall == 0.0;
        const double disturbance_Nm = observer.load_torque - observer.speed_correction * inertia_kg_m2 * rate_hz;
        const auto torque_slope = [&](unsigned phase) {
            constexpr double PROBE_RAD = 0.01;
            const double probe = PROBE_RAD / (2.0 * PI) * poles, current_A = seen.current_A[phase];
            return (machine.torque(angle[phase] + probe, current_A) - machine.torque(angle[phase] - probe, current_A)) /
                   (2.0 * PROBE_RAD);
        };
        if (++turn % DEFERRED_LEARNING_PERIODS == 0) {
            misalignment.step(disturbance_Nm, now_rad_s, steady, reference_Nm, torque_slope);
        }

        seen.bus_V = sample.adc.bus_voltage_counts * std::ldexp(512.0, -int(adc_bits));
        seen.torque_Nm = reference_Nm;
        seen.reverse = observer.speed < 0.0;
        const double step_rev = observer.speed * observer.angle_step;
        seen.angle_step = std::fabs(step_rev) * poles;
        double ahead = observer.angle + step_rev - measured;
        ahead -= std::round(ahead);
        for (unsigned phase = 0; phase < phases; phase++) {
            seen.angle[phase] = angle[phase] + ahead * poles;
        }
        predictive.machine = &machine; // after a copy, the machine of this object
        predictive.step(seen);
        return predictive.duty;
    }

  private:
    exact_machine_t machine;
    unsigned phases;
    double poles, rate_hz, inertia_kg_m2, friction_Nm_s;
    unsigned encoder_bits, adc_bits;
    double epsilon, delta_s, gain_Nm_s, torque_max_Nm;
    bool initialised = false;
    unsigned turn = 0;
    double reaching_Nm = 0.0; // acts in the next period
    observer_t observer{};
    bandwidth_t bandwidth{};
    std::array<moving_load_t, 2> moving_load{}; // of counts, of edges
    std::array<double, OBSERVER_BANDWIDTH_STAGES> stage_rad_s{};
    double least_rad_s = 0.0, offset_Nm = 0.0, offset_limit_Nm;
    predict_t predictive{};
    misalignment_t misalignment{};

    // As control.c: the middle of the count, or the last edge and the rotation since.
    double measure_rev(const hal_encoder_sample_t &encoder, bool *from_edge) const {
        const double count = std::ldexp(1.0, -int(encoder_bits));
        *from_edge = encoder.edge_known && encoder.edge_age_ticks <= 20000;
        if (!*from_edge) {
            return (encoder.counts + (encoder_bits < 32 ? 0.5 : 0.0)) * count;
        }
        return (encoder.counts + (encoder.edge_forward ? 0.0 : 1.0)) * count +
               observer.speed * encoder.edge_age_ticks * 5e-9 / (2.0 * PI);
    }
};

} // namespace reference_model

#endif
