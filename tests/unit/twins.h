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
constexpr double Q24 = 16777216.0;
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
        double innovation = measured_turn - angle;
        innovation -= std::round(innovation); // modulo a turn
        innovation = std::clamp(innovation, -1.0 / 32.0, 1.0 / 32.0);
        angle += angle_gain * innovation;
        const double corrected = speed + speed_gain * innovation;
        load_torque = std::clamp(load_torque - torque_gain * innovation, -60.0, 60.0);
        speed = corrected + acceleration * (torque - friction * corrected - load_torque);
        angle += angle_step * 0.5 * (corrected + speed);
    }
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
    double scaled_limit = 32767.0 / 32768.0;
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

} // namespace twins

#endif
