// Conduction angles against a model in double precision, written from the equations of conduction.h in electrical
// revolutions, N m and volts; over both directions, both signs of the torque, sagging and high DC-link voltages.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <random>
#include <string>

#include <gtest/gtest.h>

extern "C" {
#include "control/conduction.h"
}

#include "support/fixed_point.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;

constexpr unsigned PHASES = 3;
constexpr double SPEED_MAX_RAD_S = 320.0, SUPPLY_V = 240.0; // of the last point
constexpr double OVER_VOLTAGE_V = 300.0, FOLD_BACK_V = 7.0, TORQUE_MAX_NM = 40.0;
constexpr double BASE_INDEX = 6.0;
constexpr double SHARING_TORQUE_NM = 24.0;
constexpr double GAIN_PER_STEP = 2.5;

double signed_rev(uint32_t angle) {
    return int32_t(angle) / REV;
}

uint32_t angle_of(double rev) {
    return angle_from_rev(rev);
}

// Tables that fall or rise gently, of no machine.
machine_tables_t tables_of() {
    machine_tables_t tables{};
    tables.phases = PHASES;
    tables.flux_format.result_shift = 3;
    tables.pulse_base_index = uint16_t(BASE_INDEX * Q8);
    // index = |w| / w_max * 16 * V_supply / V, in Q8.
    tables.pulse_index_scale = uint32_t(16 * Q8 / (SPEED_MAX_RAD_S * Q22) * (SUPPLY_V * Q6) * Q32);
    tables.sharing_torque = uint16_t(SHARING_TORQUE_NM * Q8);
    for (unsigned braking = 0; braking < 2; braking++) {
        for (unsigned speed = 0; speed < MACHINE_SHARING_SPEEDS; speed++) {
            for (unsigned part = 0; part < MACHINE_SHARING_PARTS; part++) {
                tables.sharing[braking][speed][part] = {
                    .on = int16_t(6000 - 900 * int(part) - 3000 * int(speed) - 500 * int(braking)),
                    .off = int16_t(30000 + 500 * int(part) - 2000 * int(speed) - 800 * int(braking))};
            }
        }
    }
    for (unsigned k = 0; k < MACHINE_PULSE_POINTS; k++) {
        for (unsigned braking = 0; braking < 2; braking++) {
            tables.pulse[braking][k] = {.lead = uint16_t(400 * k + 500 * braking),
                                        .end = uint16_t(30000 - 300 * k - 200 * braking),
                                        .smooth_torque = uint16_t((30 - 1.4 * k + braking) * Q8),
                                        .mean_torque = uint16_t((36 - 1.2 * k + braking) * Q8),
                                        .peak_torque = uint16_t((50 - 1.5 * k) * Q8)};
        }
        for (unsigned braking = 0; braking < 2; braking++) {
            for (unsigned part = 0; part < MACHINE_PULSE_PARTS; part++) {
                tables.partial_pulse[braking][part][k] = {.on = int8_t(30 - k - 8 * int(part)),
                                                          .end = uint8_t(84 + k + 4 * part - 2 * braking),
                                                          .ripple = uint8_t(20 + 8 * part + k)};
            }
        }
        tables.braking_end[k] = uint16_t(3000 + 500 * k);
        tables.braking_flux[k] = uint16_t(2000 - 50 * k);
    }
    return tables;
}

conduction_parameters_t parameters_of() {
    const torque_sharing_parameters_t sharing{.overlapping = true,
                                              .stroke = uint32_t(REV / PHASES),
                                              .turn_on = angle_of(184.0 / 360.0),
                                              .turn_off = angle_of(356.0 / 360.0),
                                              .turn_on_advance = angle_of(24.0 / 360.0),
                                              .turn_off_advance = angle_of(16.0 / 360.0)};
    const torque_sharing_window_t window = torque_sharing_window(&sharing, 0);
    return {.sharing = sharing,
            .initial = conduction_initial(&window),
            .single_pulse = true,
            .torque_min_q24 = to_fixed(-TORQUE_MAX_NM, Q24),
            .torque_max_q24 = to_fixed(TORQUE_MAX_NM, Q24),
            .advance_step_q30 = to_fixed(1.0 / 50.0, Q30),
            .retract_step_q30 = to_fixed(1.0 / 400.0, Q30),
            .braking_end_q6 = to_fixed(OVER_VOLTAGE_V, Q6),
            .gain_per_step_q16 = uint32_t(GAIN_PER_STEP * Q16),
            .fold_back_range_q6 = to_fixed(FOLD_BACK_V, Q6)};
}

struct sample_t {
    double torque, estimate, shortfall, speed, voltage, step;
};

conduction_sample_t fixed(const sample_t &s) {
    return {.torque_q24 = to_fixed(s.torque, Q24),
            .torque_sum_q24 = to_fixed(s.estimate, Q24),
            .torque_shortfall_q24 = to_fixed(s.shortfall, Q24),
            .speed_q22 = to_fixed(s.speed, Q22),
            .angle_step = uint32_t(s.step * REV),
            .dc_link_voltage_q6 = to_fixed(s.voltage, Q6)};
}

struct model_t {
    const machine_tables_t &tables;
    double sharing_on = 4.0 / 360.0, sharing_off = 176.0 / 360.0; // past the unaligned position
    double advance = 0.0, trim = 0.0, level = 0.0, torque = 0.0, part = 0.0, partial = 0.0;
    bool braking = false, first = true, single_pulse = false, at_threshold = false;
    double lead = 0.0, end = 0.0, smooth = 0.0, mean = 0.0, peak = 0.0;
    double torque_min = 0.0, torque_max = 0.0, gain_excess = 0.0, ripple = 0.0;
    double link = 1.0;
    bool longer = false; // pulses where the link limits
    bool own_windows = false;
    double turn_on_lead = 0.0, enter = 0.0, leave = 0.0, envelope_end = 0.0, envelope_flux_Wb = 0.0;

    template <typename value_of_t> double at(double index, value_of_t value_of) const {
        const double place = std::min(index, 16.0);
        const unsigned low = std::min(unsigned(place), 15u);
        return value_of(low) + (place - low) * (value_of(low + 1) - value_of(low));
    }

    double largest(bool of_braking, double index) const {
        return at(index, [&](unsigned k) { return tables.pulse[of_braking][k].mean_torque / 256.0; });
    }

    // Turn-on, turn-off and ripple over the part of the largest torque.
    std::array<double, 3> pulse_for(double index) const {
        const auto table = [&](unsigned knot) -> std::array<double, 3> {
            if (knot == MACHINE_PULSE_PARTS) {
                return {-lead, end, peak - mean};
            }
            const machine_partial_pulse_t *of = tables.partial_pulse[braking][knot];
            return {at(index, [&](unsigned k) { return of[k].on / 256.0; }),
                    at(index, [&](unsigned k) { return of[k].end / 256.0; }),
                    at(index, [&](unsigned k) { return of[k].ripple / 128.0 - 0.25; }) * mean};
        };
        const unsigned knot = std::min(unsigned(part * 4.0), MACHINE_PULSE_PARTS + 0u);
        std::array<double, 3> low = table(knot == 0 ? 0 : knot - 1), high = table(knot);
        if (knot == 0) {
            low[2] = 0.0;
        }
        for (unsigned k = 0; k < 3; k++) {
            low[k] += (4.0 * part - knot) * (high[k] - low[k]);
        }
        return low;
    }

    void update(const sample_t &s) {
        const double index = 16.0 * std::fabs(s.speed) / SPEED_MAX_RAD_S * SUPPLY_V / std::max(s.voltage, 1.0 / 64.0);
        const bool now = (s.torque < 0.0) != (s.speed < 0.0);
        trim = now == braking ? trim : 0.0;
        braking = now;
        const machine_pulse_t *pulse = tables.pulse[braking];
        lead = at(index, [&](unsigned k) { return pulse[k].lead / 65536.0; });
        end = at(index, [&](unsigned k) { return pulse[k].end / 65536.0; });
        smooth = at(index, [&](unsigned k) { return pulse[k].smooth_torque / 256.0; });
        mean = largest(braking, index);
        peak = at(index, [&](unsigned k) { return pulse[k].peak_torque / 256.0; });

        const auto above = [&](double range) {
            return std::clamp(range * (std::min(index, 16.0) / BASE_INDEX - 1.0), 0.0, 1.0);
        };
        const double magnitude = std::fabs(s.torque);
        const bool limited = std::fabs(s.shortfall) > 0.05 + magnitude / 64.0;
        torque = partial > 0.0 && !first ? torque + (magnitude - torque) * std::min(1.0, s.step * PHASES) : magnitude;
        first = false;
        const double forward = std::clamp((torque - smooth) / (mean - smooth), 0.0, 1.0);
        advance = forward == 0.0 ? advance : level == 0.0 ? 1.0 : std::min(1.0, advance + 1.0 / 50.0);
        const double fed = partial > 0.0 ? std::min(torque / mean, 1.0) : forward;
        const double missing = (s.torque < 0.0 ? -1.0 : 1.0) * (s.torque - s.estimate);
        const double step = 0.5 * s.step * std::clamp(missing / mean, -1.0, 1.0);
        if (forward == 1.0) {
            trim = 0.0;
        } else if (partial > 0.0) {
            trim += limited || single_pulse ? step / 4.0 : -std::clamp(trim, -1.0 / 50.0, 1.0 / 50.0);
        } else if (advance == 1.0 && (limited || level > 0.0)) {
            trim += step;
        }
        trim = std::clamp(trim, -fed, 1.0 - fed);
        part = std::floor((fed + trim) * 32768.0) / 32768.0;
        level = std::clamp(std::floor((forward + trim) * 32768.0) / 32768.0, 0.0, 1.0);
        if (level == 0.0) {
            const double retract = 1.0 / 400.0 / (partial > 0.0 ? 8.0 : 1.0);
            advance = std::clamp(advance + (limited ? 1.0 / 50.0 : -retract), 0.0, 1.0);
        }
        gain_excess = partial * (1.0 - std::min(1.0, s.step * GAIN_PER_STEP));
        partial = above(8.0); // from the level on

        const double free = std::clamp((OVER_VOLTAGE_V - s.voltage) / FOLD_BACK_V, 0.0, 8.0) - 1.0;
        link = std::clamp(link + 1.0 / 50.0 / 16.0 * (free < 0.0 ? 32.0 * free : free), 0.0, 1.0);
        const double room = std::min(free + 1.0, 1.0) * link;
        const double motoring_max = std::min(largest(false, index), TORQUE_MAX_NM);
        const bool at_rest = std::fabs(s.speed) < 2.0;
        const double kept = at_rest ? 1.0 : longer ? std::min(room * (1.0 + 3.0 * partial), 1.0) : room;
        const double braking_max = std::min(largest(true, index) * kept, TORQUE_MAX_NM);
        torque_max = s.speed < 0.0 ? braking_max : motoring_max;
        torque_min = -(s.speed < 0.0 ? motoring_max : braking_max);

        const auto blend = [](double from, double to, double part) { return from + part * (to - from); };
        if (own_windows) {
            const double place = std::clamp(4.0 * torque / SHARING_TORQUE_NM - 1.0, 0.0, 3.0);
            const unsigned low = std::min(unsigned(place), 2u);
            const double speed = std::min(index / BASE_INDEX, 1.0);
            const auto window = [&](auto angle_of) {
                const auto at_speed = [&](unsigned k) {
                    const machine_sharing_window_t *of = tables.sharing[braking][k];
                    return blend(angle_of(of[low]), angle_of(of[low + 1]), place - low) / 65536.0;
                };
                return blend(at_speed(0), at_speed(1), speed);
            };
            enter = window([](const machine_sharing_window_t &of) { return double(of.on); });
            leave = window([](const machine_sharing_window_t &of) { return double(of.off); });
        } else if (braking) {
            enter = 0.5 - sharing_off;
            leave = 0.5 - sharing_on;
        } else {
            enter = sharing_on - advance * 24.0 / 360.0;
            leave = sharing_off - advance * 16.0 / 360.0;
        }
        double on = enter;
        ripple = 0.0;
        if (level > 0.0) {
            on = blend(std::max(enter, 0.0), -lead, level);
            leave = blend(leave, end, level);
            ripple = level * level * (peak - mean);
        }
        single_pulse = level > 0.0;
        at_threshold = level < 0.001;
        if (partial > 0.0) {
            auto [pulse_on, pulse_end, pulse_ripple] = pulse_for(index);
            pulse_on -= longer && braking ? std::max(end - lead, 0.0) * (1.0 - room * room) * part : 0.0;
            on = blend(on, pulse_on, partial);
            leave = blend(leave, pulse_end, partial);
            ripple = blend(ripple, pulse_ripple + trim * mean, partial);
            single_pulse = torque > smooth || pulse_on < 0.0 || std::fabs(pulse_ripple) > mean / 64.0;
            at_threshold = std::fabs(torque - smooth) < 0.05 || std::fabs(std::fabs(pulse_ripple) - mean / 64.0) < 0.02;
        }
        if (level > 0.0 || partial > 0.0) {
            const double latest = partial > 0.0 ? 1.0 : enter;
            enter = std::max(std::clamp(on, -20.0 / 360.0, latest), leave - 0.5);
        } else {
            on = 0.0;
        }
        turn_on_lead = std::max(-on, 0.0);
        ripple *= s.torque < 0.0 ? -1.0 : 1.0;
        envelope_end = at(index, [&](unsigned k) { return tables.braking_end[k] / 65536.0; });
        envelope_flux_Wb = at(index, [&](unsigned k) { return tables.braking_flux[k] / 8192.0; });
    }

    double least() const { return (braking ? 2.0 : 8.0) / 360.0; }

    // In the window a pulse may be narrower than a stroke, and then its share falls over 8 degrees around its end.
    bool narrow() const { return partial > 0.0 && leave - enter - 1.0 / PHASES < least(); }
    double overlap() const { return narrow() ? least() : std::max(leave - enter - 1.0 / PHASES, 2.0 / 360.0); }
    double stroke() const { return narrow() ? leave - enter - least() / 2.0 : 1.0 / PHASES; }
    double window_end() const { return narrow() ? leave + least() / 2.0 : leave; }
};

class Conduction : public testing::Test {
  protected:
    Conduction() : tables(tables_of()), parameters(parameters_of()) {
        conduction_reset(&parameters, &state, &progress);
    }

    void update(const sample_t &s) {
        const conduction_sample_t sample = fixed(s);
        for (unsigned step = 0; step < CONDUCTION_STEPS; step++) {
            conduction_step(&parameters, &state, &progress, &tables, &sample);
        }
    }

    const conduction_t &angles() const { return *conduction_angles(&parameters, &state, state.latest); }

    void compare(const model_t &model, const std::string &of) const {
        // The place in the tables is rounded to 2^-8: 0.006 N m, of smooth and mean torque that are 6 N m or more from
        // each other. The trim loses up to 2^-8 of its step in every update.
        constexpr double LEVEL = 0.012, ANGLE = LEVEL * 0.6;
        EXPECT_NEAR(state.level_q15 / Q15, model.level, LEVEL) << of;
        EXPECT_NEAR(state.advance_q30 / Q30, model.advance, 1e-6) << of;
        EXPECT_NEAR(state.torque_max_q24 / Q24, model.torque_max, 0.02) << of;
        EXPECT_NEAR(state.torque_min_q24 / Q24, model.torque_min, 0.02) << of;
        EXPECT_NEAR(state.gain_excess_q31 / Q31, model.gain_excess, 0.01) << of;
        const conduction_half_t &half = angles().half[model.braking], &other = angles().half[!model.braking];
        EXPECT_NEAR(angles().ripple_q24 / Q24, model.ripple, LEVEL * 30.0) << of;
        EXPECT_NEAR(signed_rev(other.lead), model.turn_on_lead, ANGLE) << of;
        EXPECT_EQ(half.lead, 0u) << of;
        EXPECT_NEAR(signed_rev(half.window.overlap), model.overlap(), 2.0 * ANGLE) << of;
        EXPECT_NEAR(signed_rev(half.window.stroke), model.stroke(), 2.0 * ANGLE) << of;
        const double end = model.window_end();
        const double turn_on = model.braking ? 1.0 - end : 0.5 + end - model.stroke() - model.overlap();
        EXPECT_NEAR(half.window.turn_on / REV, turn_on, 2.0 * ANGLE) << of;
        EXPECT_EQ(angles().half[CONDUCTION_MOTORING].end, UINT32_MAX) << of;
        EXPECT_NEAR(state.part_q15 / Q15, model.part, LEVEL) << of;
        EXPECT_TRUE(state.single_pulse == model.single_pulse || model.at_threshold) << of;
        const bool bounded = model.partial > 0.0 || (state.level_q15 > 0 && !model.braking);
        EXPECT_EQ(half.width, bounded ? half.window.stroke + half.window.overlap : UINT32_MAX) << of;
        const bool envelope = (state.level_q15 > 0 || model.partial > 0.0) && model.braking;
        EXPECT_NEAR(1.0 - angles().half[CONDUCTION_BRAKING].end / REV, envelope ? model.envelope_end : 0.5, 1e-4) << of;
        EXPECT_NEAR(half.flux * 8 / Q29, envelope ? model.envelope_flux_Wb : 0.0, 1e-4) << of;
    }

    machine_tables_t tables;
    conduction_parameters_t parameters;
    conduction_state_t state{};
    conduction_update_t progress{};
};

TEST_F(Conduction, equals_its_model_in_every_quadrant_at_all_speeds_and_voltages) {
    unsigned sharing = 0, blended = 0, full = 0, longer = 0;
    for (const double direction :
         {1.0, -1.0, 2.0, -2.0, 3.0, -3.0}) { // 1 and -1: one pulse length; 3 and -3: own windows
        parameters.longer_pulses = std::fabs(direction) == 2.0 ? 3 : 0;
        parameters.own_windows = std::fabs(direction) == 3.0;
        for (const double sign : {1.0, -1.0}) {
            for (const double of_last : {0.0, 0.2, 0.41, 0.5, 0.75, 1.0, 1.4}) {
                for (const double voltage : {160.0, 240.0, 288.0, 296.0, 310.0}) {
                    for (const double torque : {0.0, 5.0, 14.0, 18.0, 22.0, 38.0}) {
                        conduction_reset(&parameters, &state, &progress);
                        model_t model{tables};
                        model.longer = parameters.longer_pulses > 0;
                        model.own_windows = parameters.own_windows;
                        const double speed = std::copysign(of_last * SPEED_MAX_RAD_S, direction);
                        const sample_t s{sign * torque, sign * 0.9 * torque, sign * 0.1 * torque, speed,
                                         voltage,       of_last * 0.1};
                        for (unsigned k = 0; k < 60; k++) {
                            update(s);
                            model.update(s);
                        }
                        compare(model, std::to_string(sign * torque) + " N m, " + std::to_string(speed) + " rad/s, " +
                                           std::to_string(voltage) + " V");
                        ++(state.level_q15 == 0 ? sharing : state.level_q15 < 32768 ? blended : full);
                        longer += model.braking && model.partial > 0.0 && progress.extension > 0;
                    }
                }
            }
        }
    }
    EXPECT_GT(sharing, 100u);
    EXPECT_GT(blended, 50u);
    EXPECT_GT(full, 50u);
    EXPECT_GT(longer, 50u);
}

TEST_F(Conduction, follows_its_model_through_the_transition_on_a_sagging_dc_link) {
    model_t model{tables};
    int32_t before_q15 = 0, largest_step_q15 = 0;
    for (unsigned k = 0; k < 400; k++) {
        const double up = k < 200 ? k / 200.0 : (400 - k) / 200.0;
        const sample_t s{18.0, k < 200 ? 17.5 : 18.5, k < 200 ? 0.6 : 0.0, 300.0 * up, 240.0 - 50.0 * up, 0.1 * up};
        update(s);
        model.update(s);
        compare(model, "update " + std::to_string(k));
        largest_step_q15 = std::max(largest_step_q15, std::abs(state.level_q15 - before_q15));
        before_q15 = state.level_q15;
    }
    EXPECT_LT(largest_step_q15, 32768 / 16) << "without a switch";
    EXPECT_EQ(state.level_q15, 0);
}

// Between driving and braking below base speed, where each half has found a trim.
TEST_F(Conduction, a_torque_in_the_other_direction_begins_without_the_trim_of_the_one_before) {
    model_t model{tables};
    unsigned changes = 0;
    for (unsigned k = 0; k < 80; k++) {
        const double sign = k / 20 % 2 == 0 ? 1.0 : -1.0;
        const int32_t trim_q30 = state.trim_q30;
        const sample_t s{sign * 26.0, sign * 23.0, sign * 0.8, 100.0, SUPPLY_V, 0.08};
        update(s);
        model.update(s);
        compare(model, "update " + std::to_string(k));
        changes += k > 0 && k % 20 == 0 && std::abs(trim_q30) > 1 << 26 && std::abs(state.trim_q30) < 1 << 24;
    }
    EXPECT_EQ(changes, 3u);
}

TEST_F(Conduction, is_the_same_in_both_directions_but_for_signs) {
    conduction_state_t forward{};
    const sample_t ahead{20.0, 19.0, 0.5, 250.0, 230.0, 0.08};
    const sample_t back{-20.0, -19.0, -0.5, -250.0, 230.0, 0.08};
    for (unsigned k = 0; k < 30; k++) {
        update(ahead);
    }
    forward = state;
    conduction_reset(&parameters, &state, &progress);
    for (unsigned k = 0; k < 30; k++) {
        update(back);
    }
    EXPECT_NEAR(state.level_q15, forward.level_q15, 300); // roundings towards minus infinity
    EXPECT_GT(state.level_q15, 16384);
    EXPECT_EQ(state.torque_min_q24, -forward.torque_max_q24);
    EXPECT_EQ(state.torque_max_q24, -forward.torque_min_q24);
    EXPECT_LT(angles().ripple_q24, 0);
}

TEST_F(Conduction, without_single_pulses_windows_advance_and_no_phase_leads) {
    parameters.single_pulse = false;
    for (unsigned k = 0; k < 100; k++) {
        update({30.0, 20.0, 8.0, 300.0, 200.0, 0.1});
        ASSERT_EQ(state.level_q15, 0);
        ASSERT_EQ(angles().half[CONDUCTION_BRAKING].lead, 0u);
    }
    EXPECT_EQ(state.advance_q30, 1 << 30);
    EXPECT_NEAR(angles().half[CONDUCTION_MOTORING].window.turn_on / REV, 160.0 / 360.0, 1e-3);
}

TEST_F(Conduction, own_windows_follow_torque_and_speed_and_no_shortfall) {
    parameters.own_windows = true;
    const auto turn_on_deg = [&](double torque, double shortfall, double speed) {
        for (unsigned k = 0; k < 60; k++) {
            update({torque, torque - shortfall, shortfall, speed, SUPPLY_V, 0.0});
        }
        return (angles().half[CONDUCTION_MOTORING].window.turn_on / REV - 0.5) * 360.0;
    };
    const double still_deg = 6000.0 / 65536.0 * 360.0, part_deg = 900.0 / 65536.0 * 360.0;
    const double base_deg = 3000.0 / 65536.0 * 360.0, base_speed = BASE_INDEX / 16.0 * SPEED_MAX_RAD_S;
    EXPECT_NEAR(turn_on_deg(0.5, 0.0, 2.5), still_deg, 0.4);
    EXPECT_NEAR(turn_on_deg(6.0, 4.0, 2.5), still_deg, 0.4) << "a shortfall that no voltage causes";
    EXPECT_NEAR(turn_on_deg(12.0, 0.0, 2.5), still_deg - part_deg, 0.4);
    EXPECT_NEAR(turn_on_deg(12.0, 0.0, 0.5 * base_speed), still_deg - part_deg - 0.5 * base_deg, 0.3);
    EXPECT_NEAR(turn_on_deg(12.0, 0.0, 0.99 * base_speed), still_deg - part_deg - base_deg, 0.3);
}

TEST_F(Conduction, no_braking_torque_is_permitted_from_the_over_voltage_on) {
    for (const double direction : {1.0, -1.0}) {
        update({0.0, 0.0, 0.0, direction * 200.0, 300.0, 0.06});
        EXPECT_EQ(direction > 0.0 ? state.torque_min_q24 : state.torque_max_q24, 0);
        EXPECT_GT(direction > 0.0 ? state.torque_max_q24 : -state.torque_min_q24, 10 << 24);
    }
}

TEST_F(Conduction, braking_torque_settles_at_what_a_dc_link_takes_whose_voltage_follows_late) {
    constexpr double CAPACITANCE_F = 2.2e-3, CHOPPER_OHM = 20.0, UPDATE_S = 4e-4, SPEED = 200.0;
    parameters.advance_step_q30 = to_fixed(10.0 * UPDATE_S, Q30);
    std::array<double, 6> power_W{}; // a delay by the fields of the phases
    double voltage = 240.0, least_V = 1e3, largest_V = 0.0;
    for (unsigned k = 0; k < 1500; k++) {
        const double torque = state.torque_min_q24 / Q24;
        update({torque, torque, 0.0, SPEED, voltage, 0.06});
        std::rotate(power_W.begin(), power_W.begin() + 1, power_W.end());
        power_W.back() = -torque * SPEED;
        voltage += (power_W.front() / voltage - voltage / CHOPPER_OHM) * UPDATE_S / CAPACITANCE_F;
        ASSERT_LT(voltage, OVER_VOLTAGE_V + 5.0) << k;
        if (k >= 500) {
            least_V = std::min(least_V, voltage);
            largest_V = std::max(largest_V, voltage);
        }
    }
    EXPECT_GT(least_V, OVER_VOLTAGE_V - FOLD_BACK_V - 1.0);
    EXPECT_LT(largest_V, OVER_VOLTAGE_V - FOLD_BACK_V + 1.0);
}

TEST_F(Conduction, stays_in_range_for_any_sample_and_any_tables) {
    std::mt19937 random(15);
    const auto any = [&] { return int32_t(random()) >> (random() % 32); };
    for (unsigned k = 0; k < 20000; k++) {
        if (k % 100 == 0) {
            for (auto &half : tables.pulse) {
                for (machine_pulse_t &pulse : half) {
                    pulse = {uint16_t(random()), uint16_t(random() % 32769), uint16_t(random()), uint16_t(random()),
                             uint16_t(random())};
                }
            }
            for (auto &half : tables.partial_pulse) {
                for (auto &part : half) {
                    for (machine_partial_pulse_t &pulse : part) {
                        pulse = {int8_t(random()), uint8_t(random() % 129), uint8_t(random())};
                    }
                }
            }
            for (auto &half : tables.sharing) {
                for (auto &speed : half) {
                    for (machine_sharing_window_t &window : speed) {
                        window = {int16_t(int(random() % 16000) - 4000), int16_t(16384 + random() % 16000)};
                    }
                }
            }
            tables.sharing_torque = uint16_t(1 + random() % 65535);
            parameters.own_windows = k % 300 != 0;
            tables.pulse_base_index = uint16_t(1 + random() % 4096);
            tables.pulse_index_scale = random() >> 1;
            parameters.longer_pulses = k % 200 == 0 ? 3 : 0;
            conduction_reset(&parameters, &state, &progress);
        }
        const conduction_sample_t sample{any(), any(), any(), any(), uint32_t(random()), any() >> 15};
        for (unsigned step = 0; step < CONDUCTION_STEPS; step++) {
            conduction_step(&parameters, &state, &progress, &tables, &sample);
        }
        ASSERT_GE(state.level_q15, 0);
        ASSERT_LE(state.level_q15, 32768);
        ASSERT_GE(state.advance_q30, 0);
        ASSERT_LE(state.advance_q30, 1 << 30);
        ASSERT_GE(state.link_q30, 0);
        ASSERT_LE(state.link_q30, 1 << 30);
        ASSERT_LE(state.room_q15, 32768);
        ASSERT_LT(progress.extension, parameters.longer_pulses > 0 ? 1u << 31 : 1u);
        ASSERT_GE(state.gain_excess_q31, 0);
        ASSERT_LE(state.torque_min_q24, 0);
        ASSERT_GE(state.torque_min_q24, parameters.torque_min_q24);
        ASSERT_GE(state.torque_max_q24, 0);
        ASSERT_LE(state.torque_max_q24, parameters.torque_max_q24);
        ASSERT_GE(angles().half[state.braking].window.overlap, 0x016C16C1u);
    }
}

// In whole numbers, by the roundings that conduction_step() states. After a reset and without a shortfall the level is
// the level of the torque alone.
class ConductionRounding : public Conduction {
  protected:
    static constexpr wide_integer::wide_t ONE_Q15 = 32768;

    // A part of the way between two values, to the nearest 4 LSB; `more`: what the ends add to that.
    static void expect_blend(uint32_t found, uint32_t from, uint32_t to, wide_integer::wide_t part_q15, const char *of,
                             int more = 0) {
        const wide_integer::wide_t way_q15 = int32_t(to - from) * part_q15;
        const wide_integer::wide_t difference_q15 = int32_t(found - from) * ONE_Q15 - way_q15;
        ASSERT_LE(std::llabs(int64_t(difference_q15)), (2 + more) * 32768) << of;
    }

    template <typename value_t> int32_t at_q8(value_t low, value_t high) const {
        return low * 256 + (high - low) * progress.place.fraction_q8;
    }

    void expect_place(const conduction_sample_t &s) const {
        using namespace wide_integer;
        const wide_t speed_q22 = std::abs(s.speed_q22);
        const wide_t index_q8 =
            rounded_down(speed_q22 * tables.pulse_index_scale, s.dc_link_voltage_q6 * power_of_2(32));
        const wide_t limited_q8 = std::min<wide_t>(index_q8, (MACHINE_PULSE_POINTS - 1) * 256);
        ASSERT_EQ(progress.place.k * 256 + unsigned(progress.place.fraction_q8), unsigned(limited_q8));
    }

    void expect_pulse() const {
        const machine_pulse_t *low = &tables.pulse[state.braking][progress.place.k], *high = low + 1;
        ASSERT_EQ(progress.pulse.lead, uint32_t(at_q8(low->lead, high->lead)) << 8);
        ASSERT_EQ(progress.pulse.end, uint32_t(at_q8(low->end, high->end)) << 8);
        ASSERT_EQ(progress.pulse.smooth_q24, at_q8(low->smooth_torque, high->smooth_torque) << 8);
        ASSERT_EQ(progress.pulse.mean_q24, at_q8(low->mean_torque, high->mean_torque) << 8);
        ASSERT_EQ(progress.pulse.peak_q24, at_q8(low->peak_torque, high->peak_torque) << 8);
    }

    // Torques to 2^-8 N m, their quotient to 2^-15.
    void expect_level_and_part(int32_t magnitude_q24) const {
        using namespace wide_integer;
        const conduction_pulse_t &pulse = progress.pulse;
        const auto q8 = [](int32_t torque_q24) { return rounded_down(torque_q24, 65536); };
        const auto of_q15 = [](wide_t part, wide_t whole) {
            return std::clamp<wide_t>(rounded_down(part * ONE_Q15, whole), 0, ONE_Q15);
        };
        ASSERT_EQ(state.level_q15,
                  int32_t(of_q15(q8(magnitude_q24 - pulse.smooth_q24), q8(pulse.mean_q24 - pulse.smooth_q24))));
        const wide_t part_q15 = of_q15(q8(magnitude_q24), q8(pulse.mean_q24));
        ASSERT_EQ(state.part_q15, state.partial_q15 > 0 ? int32_t(part_q15) : state.level_q15);
        const wide_t excess_q8 = 8 * (int32_t(index_q8()) - wide_t(tables.pulse_base_index));
        ASSERT_EQ(state.partial_q15, int32_t(of_q15(excess_q8, tables.pulse_base_index)));
    }

    unsigned index_q8() const { return progress.place.k * 256 + unsigned(progress.place.fraction_q8); }

    // Angles of the machine's windows, 2^-32 rev: to 2^-24.
    uint32_t window_angle(int32_t magnitude_q24, int16_t machine_sharing_window_t::*side) const {
        using namespace wide_integer;
        const wide_t quarters_q8 = rounded_down(magnitude_q24, 65536) * 4 * 256 / tables.sharing_torque;
        const auto place_q8 = int32_t(std::clamp<wide_t>(quarters_q8 - 256, 0, 3 * 256));
        const int32_t k = std::min(place_q8 / 256, 2), part_q8 = place_q8 - 256 * k;
        const auto at = [&](unsigned speed) {
            const machine_sharing_window_t *of = &tables.sharing[state.braking][speed][k];
            return of[0].*side * 256 + (of[1].*side - of[0].*side) * part_q8;
        };
        const wide_t speed_q8 = std::min(index_q8() * 256 / tables.pulse_base_index, 256u);
        return uint32_t(int32_t(at(0) + rounded_down((at(1) - at(0)) * speed_q8, 256))) << 8;
    }

    void expect_positions(int32_t magnitude_q24) const {
        const uint32_t on = window_angle(magnitude_q24, &machine_sharing_window_t::on);
        const uint32_t off = window_angle(magnitude_q24, &machine_sharing_window_t::off);
        const conduction_interval_t &found = progress.interval;
        if (state.partial_q15 > 0) {
            const uint32_t begin = int32_t(on) > 0 ? on : 0;
            uint32_t from = on, leave = off; // a blend of which more follows: its rounding adds up
            if (state.level_q15 > 0) {
                from = begin + uint32_t(int32_t(rounded(begin, -progress.pulse.lead)));
                leave = off + uint32_t(int32_t(rounded(off, progress.pulse.end)));
            }
            expect_blend(found.on, from, progress.partial.on, state.partial_q15, "turn-on above base speed", 3);
            expect_blend(found.leave, leave, progress.partial.end, state.partial_q15, "turn-off above base speed", 3);
        } else if (state.level_q15 > 0) {
            expect_blend(found.on, int32_t(on) > 0 ? on : 0, -progress.pulse.lead, state.level_q15, "turn-on");
            expect_blend(found.leave, off, progress.pulse.end, state.level_q15, "turn-off");
        } else {
            ASSERT_EQ(found.enter, on);
            ASSERT_EQ(found.leave, off);
        }
    }

    wide_integer::wide_t rounded(uint32_t from, uint32_t to) const {
        return wide_integer::nearest(wide_integer::wide_t(int32_t(to - from)) * state.level_q15, 32768);
    }

    void expect_partial_pulse() const {
        const unsigned above = std::min(unsigned(state.part_q15) / 8192, MACHINE_PULSE_PARTS + 0u);
        const auto at = [&](unsigned part) -> std::array<uint32_t, 2> {
            if (part == MACHINE_PULSE_PARTS) {
                return {-progress.pulse.lead, progress.pulse.end};
            }
            const machine_partial_pulse_t *of = &tables.partial_pulse[state.braking][part][progress.place.k];
            return {uint32_t(at_q8(of[0].on, of[1].on)) << 16, uint32_t(at_q8(of[0].end, of[1].end)) << 16};
        };
        const auto low = at(above > 0 ? above - 1 : 0), high = at(above);
        const int32_t fraction_q15 = (state.part_q15 - int32_t(above) * 8192) * 4;
        expect_blend(progress.partial.on, low[0], high[0], fraction_q15, "turn-on of a part");
        expect_blend(progress.partial.end, low[1], high[1], fraction_q15, "turn-off of a part");
    }

    void expect_braking_limit(const conduction_sample_t &s) const {
        using namespace wide_integer;
        const int32_t found_q24 = s.speed_q22 < 0 ? state.torque_max_q24 : -state.torque_min_q24;
        const wide_t kept_q15 = conduction_at_rest(s.speed_q22) ? ONE_Q15 : wide_t(state.room_q15);
        const wide_t difference_q39 = found_q24 * ONE_Q15 - progress.braking_max_q24 * kept_q15;
        ASSERT_LE(std::llabs(int64_t(difference_q39)), 2 * 32768);
    }
};

TEST_F(ConductionRounding, everything_is_rounded_as_the_header_states_for_random_samples) {
    std::mt19937 random(18);
    const auto between = [&](double least, double most) {
        return std::uniform_real_distribution<double>(least, most)(random);
    };
    unsigned sharing = 0, blended = 0, above_base = 0, limited = 0;
    parameters.own_windows = true;
    for (unsigned k = 0; k < 20000; k++) {
        conduction_reset(&parameters, &state, &progress);
        const double torque = between(-40.0, 40.0), speed = between(-1.1, 1.1) * SPEED_MAX_RAD_S;
        const sample_t s{torque, torque, 0.0, speed, between(200.0, 300.0), 0.02};
        const conduction_sample_t sample = fixed(s);
        const int32_t magnitude_q24 = std::abs(sample.torque_q24);
        update(s);
        update(s); // by the law of the speed
        if (state.trim_q30 != 0 || progress.extension != 0) {
            ADD_FAILURE() << "more than the torque moves the angles";
            return;
        }
        expect_place(sample);
        expect_pulse();
        expect_level_and_part(magnitude_q24);
        if (state.partial_q15 > 0) {
            expect_partial_pulse();
        }
        expect_positions(magnitude_q24);
        expect_braking_limit(sample);
        if (HasFatalFailure()) {
            FAIL() << "sample " << k << ": " << torque << " N m, " << speed << " rad/s";
        }
        ++(state.partial_q15 > 0 ? above_base : state.level_q15 > 0 ? blended : sharing);
        limited += state.room_q15 < 32768;
    }
    EXPECT_GT(sharing, 500u);
    EXPECT_GT(blended, 500u);
    EXPECT_GT(above_base, 500u);
    EXPECT_GT(limited, 500u);
}

TEST(FullLink, limits_the_braking_torque_linearly_over_the_last_volts_and_to_zero_above) {
    conduction_parameters_t parameters{};
    parameters.full_link_q6 = to_fixed(295.0, Q6);
    parameters.full_link_range_q6 = to_fixed(5.0, Q6);
    parameters.full_link_slope_q18 = (20 << 24) / parameters.full_link_range_q6;
    EXPECT_EQ(conduction_braking_q24(&parameters, 0), INT32_MAX);
    EXPECT_EQ(conduction_braking_q24(&parameters, to_fixed(289.9, Q6)), INT32_MAX);
    for (const double room_V : {5.0, 4.0, 2.5, 1.0, 0.25}) {
        EXPECT_NEAR(conduction_braking_q24(&parameters, to_fixed(295.0 - room_V, Q6)) / 16777216.0, 4.0 * room_V,
                    0.001);
    }
    EXPECT_EQ(conduction_braking_q24(&parameters, to_fixed(295.0, Q6)), 0);
    EXPECT_EQ(conduction_braking_q24(&parameters, to_fixed(511.9, Q6)), 0);
}

} // namespace
