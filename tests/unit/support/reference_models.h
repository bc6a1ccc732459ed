// Reference models: the control laws in double precision, written from their equations, which the tests compare the
// firmware with. A model has no formats, no rounding and no saturation other than the law's own.
#ifndef TESTS_UNIT_REFERENCE_MODELS_H
#define TESTS_UNIT_REFERENCE_MODELS_H

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "hal.h"
#include "support/fixed_point.h"

namespace reference_model {

using fixed_point::PI;

// H sgn(x) of the corrected reaching law, rad/s^2 for rad/s.
inline double reaching_rad_s2(double gain_1_s, double epsilon, double delta_s, double x) {
    const double magnitude = std::fabs(x);
    return gain_1_s * x / (epsilon * magnitude + ((1.0 - epsilon) * magnitude + 1.0) * std::exp(-delta_s * magnitude));
}

// H sgn(x) of the paper's (10) as published.
inline double published_reaching_rad_s2(double x) {
    if (x == 0.0) {
        return 0.0;
    }
    const double magnitude = std::fabs(x);
    return std::copysign(1.0 / (0.5 + (0.5 + 1.0 / magnitude) * std::exp(magnitude)), x);
}

// PI with the anti-windup of speed_pi.h.
struct pi_t {
    double kp, ki_step, low, high;
    double integral = 0.0;

    double step(double error) {
        const double sum = kp * error + integral;
        const double limited = std::clamp(sum, low, high);
        const bool winds_up = (sum > limited && error > 0.0) || (sum < limited && error < 0.0);
        if (!winds_up) {
            integral = std::clamp(integral + ki_step * error, low, high);
        }
        return limited;
    }
};

// Load observer; angle in revolutions, unbounded.
struct observer_t {
    double angle_gain, speed_gain, torque_gain; // per revolution of innovation
    double acceleration;                        // rad/s per N m
    double friction;                            // N m s
    double angle_step;                          // revolutions per rad/s
    double angle = 0.0, speed = 0.0, load_torque = 0.0;
    double speed_correction = 0.0; // of the last step

    // Changes the gains and keeps the estimate.
    void set_gains(const observer_t &gains) {
        angle_gain = gains.angle_gain;
        speed_gain = gains.speed_gain;
        torque_gain = gains.torque_gain;
    }

    // Modulo a revolution.
    double innovation(double measured_rev) const {
        const double difference = measured_rev - angle;
        return difference - std::round(difference);
    }

    // speed_unit_rad_s: unit of the speed, and with it of the torque of inertia and friction.
    static observer_t ideal(double bandwidth_rad_s, double rate_hz, double inertia_kg_m2, double friction_Nm_s,
                            double speed_unit_rad_s = 1.0) {
        const double revolution = 2.0 * PI / speed_unit_rad_s; // speed times seconds
        const double q = std::exp(-bandwidth_rad_s / rate_hz);
        const double p = 1.0 - q;
        observer_t observer{};
        observer.angle_gain = 1.0 - q * q * q;
        observer.speed_gain = 1.5 * p * p * (1.0 + q) * rate_hz * revolution;
        observer.torque_gain = inertia_kg_m2 * p * p * p * rate_hz * rate_hz * revolution;
        observer.acceleration = 1.0 / (inertia_kg_m2 * rate_hz);
        observer.friction = friction_Nm_s;
        observer.angle_step = 1.0 / (revolution * rate_hz);
        return observer;
    }

    void step(double measured_rev, double torque) {
        const double error = std::clamp(innovation(measured_rev), -1.0 / 32.0, 1.0 / 32.0);
        angle += angle_gain * error;
        speed_correction = speed_gain * error;
        const double corrected = speed + speed_correction;
        load_torque = std::clamp(load_torque - torque_gain * error, -64.0, 64.0);
        speed = corrected + acceleration * (torque - friction * corrected - load_torque);
        angle += angle_step * 0.5 * (corrected + speed);
    }
};

// Largest trend that rounding causes in a low-pass, in counts: the sawtooth of q samples has 1 / (2 q) counts.
inline double rounding_counts(double counts_per_period, double time_constant_periods) {
    double most = 0.0;
    for (int q = 1; q <= 6; q++) {
        const double distance = std::fabs(q * counts_per_period - std::round(q * counts_per_period));
        most = std::max(most, 0.5 / q / (1.0 + std::floor(4.0 * distance * time_constant_periods)));
    }
    return most;
}

// Trend of the innovation, in revolutions: stages of the bandwidth that are withheld while the load moves.
struct moving_load_t {
    double rate_hz, threshold;
    unsigned stages;
    double settling_s; // after a trigger
    double time_constant_s = 1.6e-3, hold_min_s = 0.025, hold_max_s = 0.8, release_s = 0.005;
    double trend = 0.0, hold_s = 0.0, remaining_s = 0.0, settled_s = 0.0, time_s = 0.0;
    unsigned withheld = 0;
    bool releasing = false;

    // rounding: added to the threshold; kept: stages that the present bandwidth does not reach, 0 in the beat's.
    unsigned step(double innovation, double rounding, bool triggered, unsigned kept) {
        const double magnitude = time_s < settled_s ? 0.0 : std::fabs(trend);
        time_s += 1.0 / rate_hz;
        remaining_s -= 1.0 / rate_hz;
        trend += (innovation - trend) / (time_constant_s * rate_hz);
        if (triggered) {
            settled_s = time_s + settling_s;
        }
        if (magnitude > threshold + rounding) {
            const unsigned wanted = std::min(stages, kept == 0 ? 1 : kept + 4);
            if (withheld < wanted) {
                settled_s = time_s + time_constant_s;
                hold_s *= withheld == 0 || releasing ? 2.0 : 1.0;
            }
            releasing = false;
            hold_s = std::clamp(hold_s, hold_min_s, hold_max_s);
            withheld = std::max(withheld, wanted);
            remaining_s = hold_s;
        } else if (remaining_s <= 0.0 && withheld > 0) {
            withheld--;
            releasing = true;
            remaining_s = withheld > 0 ? release_s : hold_s;
        } else if (remaining_s <= 0.0) {
            hold_s /= 2.0;
            remaining_s = hold_s;
        }
        return withheld;
    }
};

// Bandwidth schedule of the load observer: 5 / t since the last trigger, between steady and transient bandwidth.
// Angles in revolutions. The thresholds are the firmware's.
struct bandwidth_t {
    double steady_rad_s, beat_rad_s, count_trigger_rad_s, edge_trigger_rad_s, rate_hz;
    double threshold_count, threshold_edge;
    double holdoff_s, holdoff_decay; // minimum hold-off; decay factor of its extension per period
    double bandwidth_rad_s = 0.0;    // 0 before the first step, which is transient
    double since_s = 0.0, holdoff_extension = 0.0, mean_innovation = 0.0;
    unsigned triggers = 0;

    bool steady() const { return bandwidth_rad_s <= steady_rad_s; }

    // least_rad_s: while the load moves; beat: the rotation per period is nearly a ratio of counts.
    double step(double innovation, bool from_edge, double least_rad_s = 0.0, bool beat = false) {
        const double transient_rad_s = edge_trigger_rad_s;
        since_s += 1.0 / rate_hz;
        if (bandwidth_rad_s == 0.0) {
            start_rad_s = transient_rad_s;
        }
        bandwidth_rad_s =
            std::max(std::min(start_rad_s, 5.0 / since_s), std::max(beat ? beat_rad_s : steady_rad_s, least_rad_s));
        const double threshold = std::max(4.0 * mean_innovation, from_edge ? threshold_edge : threshold_count);
        const double magnitude = std::fabs(innovation);
        if (steady()) {
            mean_innovation += 40.0 / rate_hz * (std::min(magnitude, threshold) - mean_innovation);
        }
        holdoff_extension *= holdoff_decay;
        if (magnitude > threshold && since_s >= holdoff_s * (1.0 + holdoff_extension)) {
            holdoff_extension =
                std::min(holdoff_extension + (steady() ? holdoff_extension : holdoff_extension / 4.0) + 0.25, 255.0);
            start_rad_s = from_edge ? edge_trigger_rad_s : count_trigger_rad_s;
            since_s = 0.0;
            bandwidth_rad_s = start_rad_s;
            triggers++;
        }
        return bandwidth_rad_s;
    }

  private:
    double start_rad_s = 0.0;
};

// Torque sharing function over the angle in electrical revolutions, from 0.5 unaligned to 1 aligned.
struct torque_sharing_t {
    double turn_on, stroke, overlap; // electrical rev; overlap 0: one phase at a time

    static double cubic(double x) { return x * x * (3.0 - 2.0 * x); }

    double at(double angle) const {
        const double since_on = angle - turn_on;
        if (since_on < 0.0 || since_on >= stroke + overlap) {
            return 0.0;
        }
        if (since_on < overlap) {
            return cubic(since_on / overlap);
        }
        return since_on < stroke ? 1.0 : 1.0 - cubic((since_on - stroke) / overlap);
    }
};

// One sample of the flux observer of a phase; `drop` is R i Ts.
inline double flux_step(double flux, double gain, double table, double applied, double drop) {
    return std::max(flux + gain * (table - flux) + applied - drop, 0.0);
}

// Windows of torque sharing over torque and speed: motoring and braking, standstill and base speed, quarters of a
// torque.
struct own_windows_t {
    struct window_t {
        double on, off; // past the start of the half, electrical rev
    };
    std::array<std::array<std::array<window_t, 4>, 2>, 2> window{};
    double torque = 0.0, base_step_per_V = 0.0; // electrical rev per period and volt at the base speed

    torque_sharing_t at(double magnitude, double step_per_V, bool braking, double stroke) const {
        const double place = std::clamp(4.0 * magnitude / torque - 1.0, 0.0, 3.0);
        const unsigned low = std::min(unsigned(place), 2u);
        const double speed = std::min(step_per_V / base_step_per_V, 1.0), part = place - low;
        const auto between = [&](double window_t::*angle) {
            const auto &still = window[braking][0], &base = window[braking][1];
            return (1.0 - speed) * ((1.0 - part) * (still[low].*angle) + part * (still[low + 1].*angle)) +
                   speed * ((1.0 - part) * (base[low].*angle) + part * (base[low + 1].*angle));
        };
        const double on = between(&window_t::on), off = between(&window_t::off);
        return {.turn_on = braking ? 1.0 - off : 0.5 + on, .stroke = stroke, .overlap = off - on - stroke};
    }
};

// Predictive torque control with exact inverses: no cell limits how far an operating point moves. machine_t models a
// phase, angles in electrical revolutions from 0.5 (unaligned) to 1:
// torque(angle, A), flux(angle, A), current_of_torque(angle, N m) and current_of_flux(angle, Wb).
template <typename machine_t> struct predictive_t {
    static constexpr unsigned PHASES_MAX = HAL_PHASES_MAX;
    const machine_t *machine;
    unsigned phases;
    double period_s, resistance_ohm, flux_gain, current_limit_A, reserve_Nm;
    torque_sharing_t base_window, advanced_window; // without and with full advance
    bool sharing = true, has_own_windows = false;
    own_windows_t own_windows{};
    std::array<double, PHASES_MAX> flux{}, duty{};
    double advance = 0.0, torque_shortfall = 0.0;

    struct sample_t {
        std::array<double, PHASES_MAX> current_A, table_Wb, angle; // angle two periods ahead, electrical rev, unbounded
        double bus_V, torque_Nm;
        bool reverse;
        double angle_step = 0.0; // magnitude per period, electrical rev
    };

    void step(const sample_t &sample) {
        const double flux_step_max = sample.bus_V * period_s;
        const double reference = sample.torque_Nm;
        const double opposed = std::max(reserve_Nm - std::fabs(reference), 0.0);
        move_windows(reference);
        std::array<double, PHASES_MAX> drop{};
        bool limited = false;
        for (unsigned phase = 0; phase < phases; phase++) {
            plan_t &p = plan[phase];
            drop[phase] = resistance_ohm * period_s * sample.current_A[phase];
            flux[phase] =
                flux_step(flux[phase], flux_gain, sample.table_Wb[phase], duty[phase] * flux_step_max, drop[phase]);
            p.flux_min = std::max(flux[phase] - drop[phase] - flux_step_max, 0.0);
            p.flux_max = std::max(flux[phase] - drop[phase] + flux_step_max, 0.0);
            const double angle = sample.angle[phase] - std::floor(sample.angle[phase]);
            p.positive = angle >= 0.5;
            p.angle = p.positive ? angle : 1.0 - angle;
            if (p.positive == sample.reverse && sample.angle_step > 0.0) {
                p.flux_max =
                    std::max(std::min(p.flux_max, flux_step_max * (p.angle - 0.5) / sample.angle_step), p.flux_min);
            }
            // Windows are advanced for motoring torque only.
            const bool braking = (reference < 0.0) != sample.reverse;
            const bool advanced = p.positive != sample.reverse && !braking;
            const bool own = has_own_windows && p.positive == (reference >= 0.0);
            const torque_sharing_t share = own ? own_windows.at(std::fabs(reference), sample.angle_step / sample.bus_V,
                                                                braking, base_window.stroke)
                                           : advanced ? window()
                                                      : base_window;
            p.since_on = p.angle - share.turn_on;
            const double side = p.positive ? reference : -reference;
            limited |= plan_torque(p, (std::max(side, 0.0) + opposed) * share.at(p.angle));
        }
        torque_shortfall = reference;
        for (unsigned phase = 0; phase < phases; phase++) {
            torque_shortfall -= plan[phase].positive ? plan[phase].torque : -plan[phase].torque;
        }
        if (limited || std::fabs(torque_shortfall) > 1.0 / 64.0) {
            correct_torque(reference >= 0.0, sample.reverse);
        }
        torque_shortfall = std::fabs(torque_shortfall) > 1.0 / 64.0 ? torque_shortfall : 0.0;
        for (unsigned phase = 0; phase < phases; phase++) {
            const double duty_max = sample.current_A[phase] > current_limit_A * 65.0 / 64.0 ? 0.0 : 1.0;
            const double unclamped = (plan[phase].flux - flux[phase] + drop[phase]) / flux_step_max;
            duty[phase] = plan[phase].flux > 0.0 ? std::clamp(unclamped, -1.0, duty_max) : -1.0;
        }
    }

  private:
    struct plan_t {
        double angle, since_on, torque, flux, flux_min, flux_max;
        int limit; // -1: minimum of the flux linkage, 1: maximum or current limit, 0: none
        bool positive;
    };
    std::array<plan_t, PHASES_MAX> plan{};

    torque_sharing_t window() const {
        const double turn_on = base_window.turn_on + advance * (advanced_window.turn_on - base_window.turn_on);
        return {turn_on, base_window.stroke,
                sharing ? base_window.overlap + advance * (advanced_window.overlap - base_window.overlap) : 0.0};
    }

    // Angle past turn-on within a revolution.
    static double order_of(const plan_t &p) { return p.since_on < 0.0 ? p.since_on + 1.0 : p.since_on; }

    // Shortfall that advances the windows: above 0.05 N m and 1/64 of the reference.
    void move_windows(double reference) {
        const bool voltage_limited = std::fabs(torque_shortfall) > 0.05 + std::fabs(reference) / 64.0;
        advance = std::clamp(advance + (voltage_limited ? 10.0 : -1.0) * period_s, 0.0, 1.0);
    }

    bool plan_torque(plan_t &p, double torque) const {
        torque = std::max(torque, 0.0);
        double current = torque > 0.0 ? machine->current_of_torque(p.angle, torque) : 0.0;
        bool limited = current > current_limit_A;
        p.limit = torque == 0.0 ? -1 : limited ? 1 : 0;
        current = std::min(current, current_limit_A);
        const double target = current > 0.0 ? machine->flux(p.angle, current) : 0.0;
        p.flux = std::clamp(target, p.flux_min, p.flux_max);
        if (p.flux != target) {
            limited = true;
            p.limit = p.flux > target ? -1 : 1;
            current = machine->current_of_flux(p.angle, p.flux);
        }
        p.torque = limited ? machine->torque(p.angle, current) : torque;
        return limited;
    }

    // One phase takes the shortfall or excess: of the half of the reference, the one that entered last or first and is
    // not at its limit; where it is the last, one before its turn-on when no other is; and then an opposed one may
    // reduce its torque.
    void correct_torque(bool positive, bool reverse) {
        const bool increase = (torque_shortfall > 0.0) == positive;
        const bool latest_is_least = positive != reverse;
        plan_t *corrected = nullptr, *opposed = nullptr;
        for (unsigned phase = 0; phase < phases; phase++) {
            plan_t &p = plan[phase];
            if (p.positive != positive) {
                opposed = p.limit >= 0 && p.torque > 0.0 ? &p : opposed;
            } else if (p.limit != (increase ? 1 : -1) && (p.since_on >= 0.0 || latest_is_least == increase) &&
                       (corrected == nullptr ||
                        (order_of(p) < order_of(*corrected)) == (latest_is_least == increase))) {
                corrected = &p;
            }
        }
        if (corrected == nullptr) {
            if (opposed == nullptr || !increase) {
                return;
            }
            corrected = opposed;
        }
        const double before = corrected->torque, sign = corrected->positive ? 1.0 : -1.0;
        plan_torque(*corrected, before + sign * torque_shortfall);
        torque_shortfall -= sign * (corrected->torque - before);
    }
};

// Misalignment of each phase from the disturbance that the load observer sees and the slope of the tables; one phase
// per period.
struct misalignment_t {
    static constexpr unsigned PHASES_MAX = HAL_PHASES_MAX;
    unsigned phases;
    double rate_1_s, filter_factor, rate_hz; // filters of 1 / (factor w0); updates in 1 s
    double settle_s = 0.15, mean_1_s = 10.0;
    std::array<double, PHASES_MAX> offset_rad{};

    // disturbance: load torque less J / Ts times the speed correction, N m. slope(phase): dT / dtheta, N m / rad.
    template <typename slope_t>
    void step(double disturbance, double bandwidth_rad_s, bool steady, double torque, const slope_t &slope) {
        const double update_s = phases / rate_hz;
        const bool settled = steady_ticks >= std::floor(settle_s * rate_hz);
        const bool torque_suffices = std::fabs(torque) > 1.0;
        if (!steady) {
            steady_ticks = 0.0;
        } else if (torque_suffices && !settled) {
            steady_ticks += 1.0;
        }
        const bool learning = steady && torque_suffices && settled;
        const double mean_gain = std::max(mean_1_s * update_s, 1.0 / (std::floor(steady_ticks / phases) + 1.0));
        const unsigned phase = phase_index;
        phase_index = (phase_index + 1) % phases;
        sum += disturbance;
        const double mean = (sum - last_sum[phase]) / phases;
        last_sum[phase] = sum;
        const double filter = std::min(filter_factor * bandwidth_rad_s * update_s, 1.0);
        slope_lag1[phase] += filter * (slope(phase) - slope_lag1[phase]);
        slope_lag2[phase] += filter * (slope_lag1[phase] - slope_lag2[phase]);
        slope_mean[phase] += mean_gain * (slope_lag2[phase] - slope_mean[phase]);
        const double alternating = slope_lag2[phase] - slope_mean[phase];
        power += mean_gain / phases * (alternating * alternating * phases - power);
        disturbance_mean += mean_gain / phases * (disturbance - disturbance_mean);
        if (learning) {
            offset_rad[phase] +=
                rate_1_s * update_s * (mean - disturbance_mean) * alternating / (power + 0.05 * torque * torque);
            offset_rad[phase] = std::clamp(offset_rad[phase], -0.0175, 0.0175);
        }
    }

    double steady_ticks = 0.0;

  private:
    std::array<double, PHASES_MAX> slope_lag1{}, slope_lag2{}, slope_mean{}, last_sum{};
    double sum = 0.0, power = 0.0, disturbance_mean = 0.0;
    unsigned phase_index = 0;
};

// BP network, (16) to (27) of the paper with errata corrected.
struct network_t {
    static constexpr unsigned INPUTS = 3, HIDDEN = 6, OUTPUTS = 3;
    using inputs_t = std::array<double, INPUTS>;
    using outputs_t = std::array<double, OUTPUTS>;

    std::array<std::array<double, INPUTS>, HIDDEN> hidden_weight{}, hidden_increment{};
    std::array<std::array<double, HIDDEN>, OUTPUTS> output_weight{}, output_increment{};
    inputs_t input{};
    std::array<double, HIDDEN> hidden{};
    outputs_t output{};
    double weight_limit = 8.0;

    static double f(double x) { return std::tanh(0.5 * x); }
    static double g(double x) { return 1.0 / (1.0 + std::exp(-x)); }

    void forward(const inputs_t &x) {
        input = x;
        for (unsigned i = 0; i < HIDDEN; i++) {
            double sum = 0.0;
            for (unsigned j = 0; j < INPUTS; j++) {
                sum += hidden_weight[i][j] * input[j];
            }
            hidden[i] = f(sum);
        }
        for (unsigned l = 0; l < OUTPUTS; l++) {
            double sum = 0.0;
            for (unsigned i = 0; i < HIDDEN; i++) {
                sum += output_weight[l][i] * hidden[i];
            }
            output[l] = g(sum);
        }
    }

    void learn(double eta, double alpha, double error, const outputs_t &sensitivity) {
        outputs_t output_delta;
        for (unsigned l = 0; l < OUTPUTS; l++) {
            output_delta[l] = error * sensitivity[l] * output[l] * (1.0 - output[l]);
        }
        for (unsigned i = 0; i < HIDDEN; i++) {
            double back = 0.0;
            for (unsigned l = 0; l < OUTPUTS; l++) {
                back += output_delta[l] * output_weight[l][i];
            }
            const double delta = back * 0.5 * (1.0 - hidden[i] * hidden[i]);
            for (unsigned j = 0; j < INPUTS; j++) {
                update(hidden_weight[i][j], hidden_increment[i][j], eta * delta * input[j], alpha);
            }
        }
        for (unsigned l = 0; l < OUTPUTS; l++) {
            for (unsigned i = 0; i < HIDDEN; i++) {
                update(output_weight[l][i], output_increment[l][i], eta * output_delta[l] * hidden[i], alpha);
            }
        }
    }

  private:
    void update(double &weight, double &increment, double gradient, double alpha) const {
        increment = gradient + alpha * increment;
        weight = std::clamp(weight + increment, -weight_limit, weight_limit);
    }
};

// Incremental PID with the gains of the network, bp_pid.h and bp_tuner.h: the gains of a step are by the inputs of the
// step before. `scaled_limit`: largest scaled error.
struct bp_pid_t {
    enum mode_t { FIXED = 1, FROZEN = 2, LEARNING = 3 };
    mode_t mode;
    double error_scale_inverse;
    std::array<double, 3> scale; // kp, ki, kd
    double eta, alpha;
    double scaled_limit = 65535.0 / 65536.0;
    network_t network{};
    double error = 0.0, previous = 0.0, duty = 0.0;
    std::array<double, 3> gain{};
    bool passed = false, learned = false;

    double step(double torque_error) {
        const auto clamped = [this](double value) { return std::clamp(value, -scaled_limit, scaled_limit); };
        const double e = clamped(torque_error * error_scale_inverse);
        const network_t::outputs_t term = {clamped(e - error), e, clamped(e - 2.0 * error + previous)};
        double next = duty;
        for (unsigned l = 0; l < 3; l++) {
            gain[l] = scale[l] * (passed ? network.output[l] : 0.5);
            next += gain[l] * term[l];
        }
        learned = mode == LEARNING && passed && std::fabs(next) <= 1.0 && std::fabs(e) < scaled_limit;
        if (learned) {
            network.learn(eta, alpha, e, term);
        }
        if (mode != FIXED) {
            network.forward({e, term[0], term[2]});
            passed = true;
        }
        duty = std::clamp(next, -1.0, 1.0);
        previous = error;
        error = e;
        return duty;
    }
};

} // namespace reference_model

#endif
