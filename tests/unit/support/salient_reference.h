// Reference model of the whole salient controller: the laws of reference_models.h in the order of the control
// interrupt, with the exact functions of the machine and their inverses by Newton's method instead of tables. It gets
// the same samples; the differences to the firmware are arithmetic, tables and the stages of the bandwidth schedule.
// Quantities are in the firmware's units of the machine, as the parameters are.
#ifndef TESTS_UNIT_SALIENT_REFERENCE_H
#define TESTS_UNIT_SALIENT_REFERENCE_H

#include <algorithm>
#include <array>
#include <cmath>

extern "C" {
#include "interrupts/control_step.h"
#include "interrupts/deferred.h"
#include "plant/machine.h"
#include "storage/parameters.h"
}

#include "support/reference_builders.h"

namespace reference_model {

using namespace fixed_point;

// Units of a machine's formats in SI units: powers of two (machine_tables.h).
struct units_t {
    double current_A = 1.0, voltage_V = 1.0, torque_Nm = 1.0, speed_rad_s = 1.0;
};

// From the scaling of the parameters that have these units; with SI units they have the fraction bits of their formats.
inline units_t units_of(const machine_tables_t &tables) {
    const auto unit = [&](parameter_index_t parameter, int fraction_bits) {
        return std::ldexp(1.0, fraction_bits - tables.parameter_fraction_bits[parameter]);
    };
    return {.current_A = unit(PARAMETER_CURRENT_LIMIT_A, 9),
            .voltage_V = unit(PARAMETER_OVER_VOLTAGE_V, 6),
            .torque_Nm = unit(PARAMETER_TORQUE_MAX_NM, 24),
            .speed_rad_s = std::ldexp(1.0, tables.speed_exponent)};
}

// A phase of the emulated machine, in units of its formats; angles in electrical revolutions, 0 aligned.
class exact_machine_t {
  public:
    exact_machine_t(const machine_t &machine, const units_t &units)
        : units(units), electrical_rev_rad(2.0 * PI / machine.rotor_poles) {
        magnetics_prepare(&model, &machine.magnetics, machine.rotor_poles);
    }

    double torque(double angle, double current) const { return current > 0.0 ? torque_of(at(angle, current)) : 0.0; }
    double flux(double angle, double current) const { return current > 0.0 ? flux_of(at(angle, current)) : 0.0; }

    // The end of the firmware's tables when no current of them makes the torque.
    double current_of_torque(double angle, double torque) const {
        return inverse(torque, [&](double current) {
            const magnetics_point_t point = at(angle, current);
            return std::array<double, 2>{torque_of(point),
                                         point.flux_gradient_Wb_rad * units.current_A / units.torque_Nm};
        });
    }
    double current_of_flux(double angle, double flux) const {
        return inverse(flux, [&](double current) {
            const magnetics_point_t point = at(angle, current);
            return std::array<double, 2>{flux_of(point),
                                         point.incremental_inductance_H * units.current_A / units.voltage_V};
        });
    }

  private:
    static constexpr double END = 79.998; // of current
    units_t units;
    magnetics_model_t model;
    double electrical_rev_rad;

    magnetics_point_t at(double angle, double current) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle * electrical_rev_rad, current * units.current_A, &point);
        return point;
    }
    double torque_of(const magnetics_point_t &point) const { return point.torque_Nm / units.torque_Nm; }
    double flux_of(const magnetics_point_t &point) const { return point.flux_linkage_Wb / units.voltage_V; }

    // Newton's method on a rising function (value, slope), safeguarded by a bracket.
    template <typename function_t> static double inverse(double target, const function_t &function) {
        if (target <= 0.0) {
            return 0.0;
        }
        double low = 0.0, high = END, current = 10.0;
        if (function(high)[0] <= target) {
            return high;
        }
        for (int n = 0; n < 60; n++) {
            const auto [value, slope] = function(current);
            (value > target ? high : low) = current;
            double next = current - (value - target) / slope;
            if (!(next > low && next < high)) {
                next = 0.5 * (low + high);
            }
            if (std::fabs(next - current) < 1e-7) {
                return next;
            }
            current = next;
        }
        return current;
    }
};

class salient_t {
  public:
    using predict_t = predictive_t<exact_machine_t>;

    // Parameters of the firmware as doubles, in the units given.
    salient_t(const control_parameters_t &p, const machine_t &plant, const units_t &units, double control_rate_hz)
        : machine(plant, units), phases(plant.phases), poles(plant.rotor_poles), rate_hz(control_rate_hz),
          speed_unit_rad_s(units.speed_rad_s), inertia(plant.inertia_kg_m2 * units.speed_rad_s / units.torque_Nm),
          friction(plant.friction_Nm_s * units.speed_rad_s / units.torque_Nm), encoder_bits(32 - p.encoder_shift),
          current_count(std::ldexp(plant.ranges.current_A / units.current_A, -int(p.adc_bits))),
          voltage_count(std::ldexp(plant.ranges.dc_link_V / units.voltage_V, -int(p.adc_bits))),
          epsilon(std::ldexp(p.speed_smc.epsilon_q31, -31)),
          delta(std::ldexp(p.speed_smc.delta_q27, -27) * std::log(2.0)), gain(p.speed_smc.gain_q24 / Q24),
          torque_max(p.torque_mode.torque_max_q24 / Q24) {
        bandwidth = model_of(p.bandwidth, rate_hz);
        moving_load[0] = model_of(p.moving_load, false, rate_hz);
        moving_load[1] = model_of(p.moving_load, true, rate_hz);
        std::transform(std::begin(p.bandwidth.stage), std::end(p.bandwidth.stage), stage_rad_s.begin(),
                       [](const observer_bandwidth_stage_t &stage) { return stage.bandwidth_rad_s; });
        offset_limit = torque_max / 8.0;
        predictive = model_of(p.predictive, p.conduction, &machine, phases);
        predictive.period_s = 1.0 / rate_hz;
        predictive.resistance_ohm = plant.resistance_ohm * units.current_A / units.voltage_V;
        misalignment = model_of(p.misalignment, phases, rate_hz / DEFERRED_LEARNING_PERIODS);
    }

    // One period: duty of each phase.
    std::array<double, HAL_PHASES_MAX> step(const control_sample_t &sample, const command_t &command) {
        const bool run = command.request == COMMAND_RUN;
        bool from_edge = false;
        const double measured = measure_rev(sample.encoder, &from_edge);
        if (!initialised) {
            initialised = true;
            observer = observer_of(bandwidth.steady_rad_s);
            observer.angle = measured;
        }
        predict_t::sample_t seen{};
        std::array<double, HAL_PHASES_MAX> angle{};
        double torque = 0.0;
        for (unsigned phase = 0; phase < phases; phase++) {
            angle[phase] = (measured - misalignment.offset_rad[phase] / (2.0 * PI)) * poles - double(phase) / phases;
            const double current = sample.adc->phase_current_counts[phase] * current_count;
            seen.current_A[phase] = current;
            seen.table_Wb[phase] = machine.flux(angle[phase], current);
            torque += machine.torque(angle[phase], current);
        }
        const double innovation = observer.innovation(measured);
        const unsigned triggers = bandwidth.triggers;
        const double now_rad_s = bandwidth.step(innovation, from_edge, least_rad_s, beat);
        const double counts = std::ldexp(std::fabs(observer.speed * observer.angle_step), int(encoder_bits));
        unsigned kept = 0;
        while (kept < OBSERVER_BANDWIDTH_STAGES - 1 && stage_rad_s[OBSERVER_BANDWIDTH_STAGES - 1 - kept] < now_rad_s) {
            kept++;
        }
        const double rounding = from_edge ? 0.0 : rounding_counts(counts, moving_load[0].time_constant_s * rate_hz);
        // These act in the next period.
        beat = rounding >= 1.0 / 24.0 && counts >= 0.5;
        const unsigned withheld = moving_load[from_edge].step(innovation, std::ldexp(rounding, -int(encoder_bits)),
                                                              bandwidth.triggers > triggers, kept);
        least_rad_s = withheld > 0 ? stage_rad_s[OBSERVER_BANDWIDTH_STAGES - 1 - withheld] : 0.0;
        observer.set_gains(observer_of(now_rad_s));
        observer.step(measured, torque);
        if (!run) {
            reaching = 0.0;
            return {-1.0, -1.0, -1.0, -1.0};
        }

        const double reference_speed = command.speed_reference_q22 / Q22;
        const double slip = reference_speed - observer.speed;
        // The reaching torque of the previous period, of the deferred step; the feed-forward of this one.
        const double reference =
            std::clamp(reaching + offset + observer.load_torque + friction * observer.speed, -torque_max, torque_max);
        reaching = gain * reaching_rad_s2(1.0, epsilon, delta, slip);
        if (predictive.torque_shortfall == 0.0) {
            offset += 20.0 / rate_hz * (reference - offset - torque);
            offset = std::clamp(offset, -offset_limit, offset_limit);
        }

        // The common angle and the mean load of the strokes are left out: these runs are aligned, their load is
        // constant.
        const bool steady = bandwidth.steady() && std::fabs(slip) < std::fabs(observer.speed) / 64.0 &&
                            predictive.torque_shortfall == 0.0;
        const double disturbance = observer.load_torque - observer.speed_correction * inertia * rate_hz;
        const auto torque_slope = [&](unsigned phase) {
            constexpr double PROBE_RAD = 0.01;
            const double probe = PROBE_RAD / (2.0 * PI) * poles, current = seen.current_A[phase];
            return (machine.torque(angle[phase] + probe, current) - machine.torque(angle[phase] - probe, current)) /
                   (2.0 * PROBE_RAD);
        };
        if (++turn % DEFERRED_LEARNING_PERIODS == 0) {
            misalignment.step(disturbance, now_rad_s, steady, reference, torque_slope);
        }

        seen.bus_V = sample.adc->bus_voltage_counts * voltage_count;
        seen.torque_Nm = reference;
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
    double poles, rate_hz, speed_unit_rad_s, inertia, friction;
    unsigned encoder_bits;
    double current_count, voltage_count; // value of a count
    double epsilon, delta, gain, torque_max;
    bool initialised = false, beat = false;
    unsigned turn = 0;
    double reaching = 0.0; // acts in the next period
    observer_t observer{};
    bandwidth_t bandwidth{};
    std::array<moving_load_t, 2> moving_load{}; // of counts, of edges
    std::array<double, OBSERVER_BANDWIDTH_STAGES> stage_rad_s{};
    double least_rad_s = 0.0, offset = 0.0, offset_limit;
    predict_t predictive{};
    misalignment_t misalignment{};

    observer_t observer_of(double bandwidth_rad_s) const {
        return observer_t::ideal(bandwidth_rad_s, rate_hz, inertia, friction, speed_unit_rad_s);
    }

    // As control.c: the middle of the count, or the last edge and the rotation since.
    double measure_rev(const hal_encoder_sample_t &encoder, bool *from_edge) const {
        const double count = std::ldexp(1.0, -int(encoder_bits));
        *from_edge = encoder.edge_known && encoder.edge_age_ticks <= 20000;
        if (!*from_edge) {
            return (encoder.counts + (encoder_bits < 32 ? 0.5 : 0.0)) * count;
        }
        return (encoder.counts + (encoder.edge_forward ? 0.0 : 1.0)) * count +
               observer.speed * speed_unit_rad_s * encoder.edge_age_ticks * 5e-9 / (2.0 * PI);
    }
};

} // namespace reference_model

#endif
