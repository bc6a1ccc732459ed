// Double-precision twins of the fixed-point laws, written from their equations: what the tests compare the firmware
// with. A twin knows no formats, no rounding and no saturation but those that are part of the law.
#ifndef TESTS_UNIT_TWINS_H
#define TESTS_UNIT_TWINS_H

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

namespace twins {

constexpr double PI = 3.14159265358979323846;
constexpr double TURN = 4294967296.0; // 2^-32 turn or pitch
constexpr double Q9 = 512.0;
constexpr double Q12 = 4096.0;
constexpr double Q15 = 32768.0;
constexpr double Q16 = 65536.0;
constexpr double Q20 = 1048576.0;
constexpr double Q22 = 4194304.0;
constexpr double Q23 = 8388608.0;
constexpr double Q24 = 16777216.0;
constexpr double Q27 = 134217728.0;
constexpr double Q28 = 268435456.0;
constexpr double Q30 = 1073741824.0;
constexpr double Q31 = 2147483648.0;
constexpr double Q32 = 4294967296.0;

// Nearest number of a format, saturated as int32_t.
inline int32_t to_fixed(double value, double one) {
    return int32_t(std::clamp(std::floor(value * one + 0.5), -2147483648.0, 2147483647.0));
}

inline double rad_s(double rpm) {
    return rpm * 2.0 * PI / 60.0;
}

// H k x / |x| of the mended reaching law, rad/s^2 for rad/s.
inline double reaching_rad_s2(double gain_1_s, double epsilon, double delta_s, double x) {
    const double magnitude = std::fabs(x);
    return gain_1_s * x / (epsilon * magnitude + ((1.0 - epsilon) * magnitude + 1.0) * std::exp(-delta_s * magnitude));
}

// H sgn(x) of the paper's (10) as printed.
inline double printed_reaching_rad_s2(double x) {
    if (x == 0.0) {
        return 0.0;
    }
    const double magnitude = std::fabs(x);
    return std::copysign(1.0 / (0.5 + (0.5 + 1.0 / magnitude) * std::exp(magnitude)), x);
}

// Proportional and integral with the anti-windup of speed_pi.h.
struct pi_t {
    double kp, ki_step, low, high;
    double integral = 0.0;

    double step(double error) {
        const double sum = kp * error + integral;
        const double limited = std::clamp(sum, low, high);
        const bool pushes_further = (sum > limited && error > 0.0) || (sum < limited && error < 0.0);
        if (!pushes_further) {
            integral = std::clamp(integral + ki_step * error, low, high);
        }
        return limited;
    }
};

// Angle, speed and load torque from encoder and torque; angle in turns, unbounded.
struct observer_t {
    double angle_gain, speed_gain, torque_gain; // per turn of innovation
    double acceleration;                        // rad/s per N m
    double friction;                            // N m s
    double angle_step;                          // turns per rad/s
    double angle = 0.0, speed = 0.0, load_torque = 0.0;
    double correction = 0.0; // of the speed, in the last step

    // The same estimate with other gains.
    void tune(const observer_t &gains) {
        angle_gain = gains.angle_gain;
        speed_gain = gains.speed_gain;
        torque_gain = gains.torque_gain;
    }

    // Modulo a turn.
    double innovation(double measured_turn) const {
        const double difference = measured_turn - angle;
        return difference - std::round(difference);
    }

    static observer_t ideal(double bandwidth_rad_s, double rate_hz, double inertia_kg_m2, double friction_Nm_s) {
        const double q = std::exp(-bandwidth_rad_s / rate_hz);
        const double p = 1.0 - q;
        observer_t observer{};
        observer.angle_gain = 1.0 - q * q * q;
        observer.speed_gain = 1.5 * p * p * (1.0 + q) * rate_hz * 2.0 * PI;
        observer.torque_gain = inertia_kg_m2 * p * p * p * rate_hz * rate_hz * 2.0 * PI;
        observer.acceleration = 1.0 / (inertia_kg_m2 * rate_hz);
        observer.friction = friction_Nm_s;
        observer.angle_step = 1.0 / (2.0 * PI * rate_hz);
        return observer;
    }

    void step(double measured_turn, double torque) {
        const double error = std::clamp(innovation(measured_turn), -1.0 / 32.0, 1.0 / 32.0);
        angle += angle_gain * error;
        correction = speed_gain * error;
        const double corrected = speed + correction;
        load_torque = std::clamp(load_torque - torque_gain * error, -64.0, 64.0);
        speed = corrected + acceleration * (torque - friction * corrected - load_torque);
        angle += angle_step * 0.5 * (corrected + speed);
    }
};

// Schedule of the observer's bandwidth: 3.5 / t since the last waking, between the steady one and the widest. Angles in
// turns. The thresholds are the drive's.
struct bandwidth_t {
    double steady_rad_s, first_count_rad_s, first_edge_rad_s, rate_hz;
    double threshold_count, threshold_edge;
    double pause_s, kept;         // least pause; what a period leaves of a longer one
    double bandwidth_rad_s = 0.0; // 0 before the first step, which is awake
    double since_s = 0.0, pauses = 0.0, usual = 0.0;
    unsigned wakings = 0;

    bool steady() const { return bandwidth_rad_s <= steady_rad_s; }

    double step(double innovation, bool from_edge) {
        const double widest_rad_s = first_edge_rad_s;
        since_s += 1.0 / rate_hz;
        if (bandwidth_rad_s == 0.0) {
            start_rad_s = widest_rad_s;
        }
        bandwidth_rad_s = std::max(std::min(start_rad_s, 3.5 / since_s), steady_rad_s);
        const double threshold = std::max(4.0 * usual, from_edge ? threshold_edge : threshold_count);
        const double size = std::fabs(innovation);
        if (steady()) {
            usual += 40.0 / rate_hz * (std::min(size, threshold) - usual);
        }
        pauses *= kept;
        if (size > threshold && since_s >= pause_s * (1.0 + pauses)) {
            pauses = std::min(pauses + (steady() ? pauses : pauses / 4.0) + 0.25, 255.0);
            start_rad_s = from_edge ? first_edge_rad_s : first_count_rad_s;
            since_s = 0.0;
            bandwidth_rad_s = start_rad_s;
            wakings++;
        }
        return bandwidth_rad_s;
    }

  private:
    double start_rad_s = 0.0;
};

// Share of the torque over the angle in pitches, from 0.5 unaligned to 1 aligned.
struct share_t {
    double turn_on, stroke, overlap; // pitches; overlap 0: one phase at a time

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

// One sample of one phase's flux linkage; what R i takes in a period is `drop`.
inline double flux_step(double flux, double gain, double table, double applied, double drop) {
    return std::max(flux + gain * (table - flux) + applied - drop, 0.0);
}

// Flux linkages that give a torque at the end of the coming period. A machine_t says what its phases do, angles in
// pitches from 0.5 (unaligned) to 1: torque(angle, A), flux(angle, A), current_of_torque(angle, N m) and
// current_of_flux(angle, Wb).
template <typename machine_t> struct predictive_t {
    static constexpr unsigned MAX = 4;
    const machine_t *machine;
    unsigned phases;
    double period_s, resistance_ohm, flux_gain, current_limit_A, reserve_Nm;
    share_t late, early; // windows without and with full advance
    bool sharing = true;
    std::array<double, MAX> flux{}, duty{};
    double advance = 0.0, missing = 0.0;

    struct sample_t {
        std::array<double, MAX> current_A, table_Wb, angle; // angle two periods ahead, in pitches, any
        double bus_V, torque_Nm;
        bool backwards;
        double turn = 0.0; // of a period, pitch
    };

    void step(const sample_t &sample) {
        const double reach = sample.bus_V * period_s;
        const double asked = sample.torque_Nm;
        const double opposed = std::max(reserve_Nm - std::fabs(asked), 0.0);
        move_windows(asked);
        std::array<double, MAX> drop{};
        bool limited = false;
        for (unsigned phase = 0; phase < phases; phase++) {
            plan_t &p = plan[phase];
            drop[phase] = resistance_ohm * period_s * sample.current_A[phase];
            flux[phase] = flux_step(flux[phase], flux_gain, sample.table_Wb[phase], duty[phase] * reach, drop[phase]);
            p.lowest = std::max(flux[phase] - drop[phase] - reach, 0.0);
            p.highest = std::max(flux[phase] - drop[phase] + reach, 0.0);
            const double angle = sample.angle[phase] - std::floor(sample.angle[phase]);
            p.positive = angle >= 0.5;
            p.angle = p.positive ? angle : 1.0 - angle;
            if (p.positive == sample.backwards && sample.turn > 0.0) {
                p.highest = std::max(std::min(p.highest, reach * (p.angle - 0.5) / sample.turn), p.lowest);
            }
            const share_t share = p.positive != sample.backwards ? window() : late;
            p.since_on = p.angle - share.turn_on;
            const double side = p.positive ? asked : -asked;
            limited |= aim(p, (std::max(side, 0.0) + opposed) * share.at(p.angle));
        }
        missing = 0.0;
        if (limited) {
            const bool positive = asked >= 0.0;
            missing = asked;
            for (unsigned phase = 0; phase < phases; phase++) {
                missing -= plan[phase].positive ? plan[phase].torque : -plan[phase].torque;
            }
            hand_over(positive, sample.backwards, true);
            hand_over(!positive, sample.backwards, false);
        }
        for (unsigned phase = 0; phase < phases; phase++) {
            const double highest = sample.current_A[phase] > current_limit_A ? 0.0 : 1.0;
            const double wanted = (plan[phase].flux - flux[phase] + drop[phase]) / reach;
            duty[phase] = plan[phase].flux > 0.0 ? std::clamp(wanted, -1.0, highest) : -1.0;
        }
    }

  private:
    struct plan_t {
        double angle, since_on, torque, flux, lowest, highest;
        bool positive;
    };
    std::array<plan_t, MAX> plan{};

    share_t window() const {
        const double turn_on = late.turn_on + advance * (early.turn_on - late.turn_on);
        return {turn_on, late.stroke, sharing ? late.overlap + advance * (early.overlap - late.overlap) : 0.0};
    }

    // Torque that stays missing: 0.05 N m and a 64th of what is asked for.
    void move_windows(double asked) {
        const bool runs_out = std::fabs(missing) > 0.05 + std::fabs(asked) / 64.0;
        advance = std::clamp(advance + (runs_out ? 10.0 : -1.0) * period_s, 0.0, 1.0);
    }

    bool aim(plan_t &p, double torque) const {
        torque = std::max(torque, 0.0);
        double current = torque > 0.0 ? machine->current_of_torque(p.angle, torque) : 0.0;
        bool limited = current > current_limit_A;
        current = std::min(current, current_limit_A);
        const double wanted = current > 0.0 ? machine->flux(p.angle, current) : 0.0;
        p.flux = std::clamp(wanted, p.lowest, p.highest);
        if (p.flux != wanted) {
            limited = true;
            current = machine->current_of_flux(p.angle, p.flux);
        }
        p.torque = limited ? machine->torque(p.angle, current) : torque;
        return limited;
    }

    // The half of the reference may take more or less, the other one only lets go.
    void hand_over(bool positive, bool backwards, bool may_take) {
        std::array<unsigned, MAX> order{};
        unsigned count = 0;
        for (unsigned phase = 0; phase < phases; phase++) {
            if (plan[phase].positive == positive && plan[phase].since_on >= 0.0) {
                order[count++] = phase;
            }
        }
        const bool more = (missing > 0.0) == positive;
        if (more && !may_take) {
            return;
        }
        const bool incoming_is_least = positive != backwards;
        std::sort(order.begin(), order.begin() + count, [&](unsigned a, unsigned b) {
            const bool less = plan[a].since_on < plan[b].since_on;
            return less == (incoming_is_least == more);
        });
        for (unsigned n = 0; n < count && missing != 0.0; n++) {
            plan_t &p = plan[order[n]];
            const double before = p.torque;
            aim(p, before + (positive ? missing : -missing));
            missing -= positive ? p.torque - before : before - p.torque;
        }
    }
};

// Misalignment of each phase from the load that the observer sees and the tables' slope; one phase a period.
struct misalignment_t {
    static constexpr unsigned MAX = 4;
    unsigned phases;
    double rate_1_s, filter_1_s, rate_hz;
    double settle_s = 0.15, mean_1_s = 10.0;
    std::array<double, MAX> offset_rad{};

    // disturbance: load with what the speed's correction adds, N m. slope: dT / dtheta of the phase whose turn it is.
    template <typename slope_t> void step(double disturbance, bool steady, double torque, const slope_t &slope) {
        const double turn_s = phases / rate_hz;
        const bool settled = steady_ticks >= std::floor(settle_s * rate_hz);
        steady_ticks = !steady || std::fabs(torque) <= 1.0 ? 0.0 : settled ? steady_ticks : steady_ticks + 1.0;
        const bool learns = steady_ticks > 0.0 && settled;
        const double share = std::max(mean_1_s * turn_s, 1.0 / (std::floor(steady_ticks / phases) + 1.0));
        const unsigned phase = turn;
        turn = (turn + 1) % phases;
        sum += disturbance;
        const double mean = (sum - last_sum[phase]) / phases;
        last_sum[phase] = sum;
        first[phase] += filter_1_s * turn_s * (slope(phase) - first[phase]);
        second[phase] += filter_1_s * turn_s * (first[phase] - second[phase]);
        slope_mean[phase] += share * (second[phase] - slope_mean[phase]);
        const double alternating = second[phase] - slope_mean[phase];
        power += share / phases * (alternating * alternating * phases - power);
        disturbance_mean += share / phases * (disturbance - disturbance_mean);
        if (learns) {
            offset_rad[phase] +=
                rate_1_s * turn_s * (mean - disturbance_mean) * alternating / (power + 0.05 * torque * torque);
            offset_rad[phase] = std::clamp(offset_rad[phase], -0.0175, 0.0175);
        }
    }

    double steady_ticks = 0.0;

  private:
    std::array<double, MAX> first{}, second{}, slope_mean{}, last_sum{};
    double sum = 0.0, power = 0.0, disturbance_mean = 0.0;
    unsigned turn = 0;
};

// (16) to (27), misprints mended.
struct network_t {
    static constexpr unsigned INPUTS = 3, HIDDEN = 6, OUTPUTS = 3;
    using inputs_t = std::array<double, INPUTS>;
    using outputs_t = std::array<double, OUTPUTS>;

    std::array<std::array<double, INPUTS>, HIDDEN> hidden_weight{}, hidden_change{};
    std::array<std::array<double, HIDDEN>, OUTPUTS> output_weight{}, output_change{};
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
                move(hidden_weight[i][j], hidden_change[i][j], eta * delta * input[j], alpha);
            }
        }
        for (unsigned l = 0; l < OUTPUTS; l++) {
            for (unsigned i = 0; i < HIDDEN; i++) {
                move(output_weight[l][i], output_change[l][i], eta * output_delta[l] * hidden[i], alpha);
            }
        }
    }

  private:
    void move(double &weight, double &change, double gradient, double alpha) const {
        change = gradient + alpha * change;
        weight = std::clamp(weight + change, -weight_limit, weight_limit);
    }
};

// Incremental PID with the network's gains, as bp_pid.h. `scaled_limit` is the largest scaled error.
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
    bool learned = false;

    double step(double torque_error) {
        const auto limited = [this](double value) { return std::clamp(value, -scaled_limit, scaled_limit); };
        const double e = limited(torque_error * error_scale_inverse);
        const network_t::outputs_t term = {limited(e - error), e, limited(e - 2.0 * error + previous)};
        if (mode != FIXED) {
            network.forward({e, term[0], term[2]});
        }
        double next = duty;
        for (unsigned l = 0; l < 3; l++) {
            gain[l] = scale[l] * (mode == FIXED ? 0.5 : network.output[l]);
            next += gain[l] * term[l];
        }
        learned = mode == LEARNING && std::fabs(next) <= 1.0 && std::fabs(e) < scaled_limit;
        if (learned) {
            network.learn(eta, alpha, e, term);
        }
        duty = std::clamp(next, -1.0, 1.0);
        previous = error;
        error = e;
        return duty;
    }
};

// The reference with what a BP-PID adds for the error of two samples ago.
struct trim_t {
    bp_pid_t pid;
    double limit_Nm;
    std::array<double, 2> reference_Nm{};
    double trim_Nm = 0.0;

    double step(double reference, double torque, bool hold) {
        const double due = reference_Nm[1];
        reference_Nm = {reference, reference_Nm[0]};
        if (!hold) {
            trim_Nm = limit_Nm * pid.step(due - torque);
        }
        return reference + trim_Nm;
    }
};

} // namespace twins

#endif
