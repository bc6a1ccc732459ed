// Learning of a load that repeats with every turn: the firmware against its equations in double precision, and what is
// learned and what is not.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <functional>
#include <numeric>

#include <gtest/gtest.h>

extern "C" {
#include "control/periodic_load.h"
}

#include "support/fixed_point.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000, UPDATE_PERIODS = 4, BANDWIDTH_RAD_S = 1700;
constexpr int VALUES = PERIODIC_LOAD_VALUES;
constexpr unsigned ROTOR_POLES = 6;
constexpr int PITCH = 11; // values of a pole pitch, 10.7
constexpr double TORQUE_MAX_NM = 19.1, LEAD_PERIODS = 4.0;
const double LAG_S = std::floor(2.2 / BANDWIDTH_RAD_S * RATE_HZ) / RATE_HZ;

using load_t = std::function<double(double time_s, double turns)>;

// The law in double precision, of periodic_load.h.
class Reference {
  public:
    void step(double turns, double turns_per_s, double y, bool moving) {
        const double lag = turns_per_s * LAG_S * VALUES;
        const int now = wrapped(int(std::floor(turns * VALUES - lag)));
        if (now != index) {
            if (updates > 0 && now == wrapped(index + (turns_per_s < 0.0 ? -1 : 1))) {
                end_value(lag);
            } else {
                mode = mode == CLEAR ? CLEAR : KEEP;
                window.clear();
                begin_turn();
            }
            index = now;
            updates = 0;
            sum = 0.0;
        }
        moved = moved || moving;
        updates++;
        sum += y;
        const double position = turns * VALUES + turns_per_s * LEAD_PERIODS / RATE_HZ * VALUES - 0.5;
        const double before = std::floor(position), fraction = position - before;
        const double from = profile[wrapped(int(before))], to = profile[wrapped(int(before) + 1)];
        torque = mode == CLEAR ? 0.0 : from + fraction * (to - from);
    }

    double torque = 0.0;

  private:
    enum mode_t { CLEAR, KEEP, LEARN, FORGET };
    static int wrapped(int n) { return ((n % VALUES) + VALUES) % VALUES; }

    void begin_turn() {
        count = 0;
        total = load = change = residual = slow = 0.0;
        moved = false;
    }

    void end_value(double lag) {
        const double y = sum / updates, z = y + (mode == CLEAR ? 0.0 : profile[index]);
        total += y;
        residual += std::fabs(y - mean);
        load += std::fabs(z - mean);
        change += std::fabs(z - estimate[index]);
        window.push_back(z);
        if (window.size() > PITCH) {
            window.pop_front();
        }
        slow += std::fabs(std::accumulate(window.begin(), window.end(), 0.0) / double(window.size()) - mean);
        estimate[index] = z;
        const int ahead = wrapped(index + (lag < 0.0 ? -VALUES / 4 : VALUES / 4));
        const double smooth =
            estimate[ahead] + std::fabs(lag) / 64.0 *
                                  (estimate[wrapped(ahead - 1)] - 2.0 * estimate[ahead] + estimate[wrapped(ahead + 1)]);
        const double learned = mode == CLEAR    ? 0.0
                               : mode == LEARN  ? profile[ahead] + (smooth - mean - profile[ahead]) / 4.0
                               : mode == FORGET ? profile[ahead] / 2.0
                                                : profile[ahead];
        profile[ahead] = std::clamp(learned, -TORQUE_MAX_NM, TORQUE_MAX_NM);
        if (++count == VALUES) {
            end_turn();
        }
    }

    void end_turn() {
        const double threshold = VALUES * TORQUE_MAX_NM / 256.0;
        if (load < threshold || load < residual / 4.0 || slow < load / 4.0) {
            mode = CLEAR;
        } else if (mode == CLEAR) {
            mode = KEEP;
        } else if (moved && residual >= threshold && change < residual / 2.0) {
            mode = LEARN;
        } else {
            mode = load < residual ? FORGET : KEEP;
        }
        mean = total / VALUES;
        begin_turn();
    }

    std::array<double, VALUES> profile{}, estimate{};
    mode_t mode = CLEAR;
    int index = 0, count = 0;
    unsigned updates = 0;
    double sum = 0.0, mean = 0.0, total = 0.0, load = 0.0, change = 0.0, residual = 0.0, slow = 0.0;
    std::deque<double> window;
    bool moved = false;
};

// Estimate of the load observer: three equal poles, of what the profile leaves.
class Observer {
  public:
    double step(double torque_Nm) {
        const double gain = 1.0 - std::exp(-double(BANDWIDTH_RAD_S) / RATE_HZ);
        double input = torque_Nm;
        for (double &stage : stages) {
            input = stage += gain * (input - stage);
        }
        return stages[2];
    }

  private:
    std::array<double, 3> stages{};
};

struct learned_t {
    double rest_Nm;      // RMS of load less profile, about its mean, in the last turn
    double load_Nm;      // RMS of the load there
    double torque_Nm;    // largest magnitude of the profile's torque there
    double error_Nm;     // largest difference from the reference in the whole run
    int32_t largest_q24; // largest magnitude of the torque in the whole run
    bool engaged;
};

// A step is left out in each of `strokes` equal parts of a turn.
learned_t learn(double rpm, const load_t &load_Nm, double run_s, bool moving = true, double strokes = 0.0,
                uint32_t review_periods = 24) {
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    periodic_load_t state{};
    Reference reference;
    Observer observer;
    learned_t result{};
    double sum = 0.0, square = 0.0, load_sum = 0.0, load_square = 0.0, n = 0.0;
    const double turns_per_s = rpm / 60.0, last_s = run_s - 1.0 / std::fabs(turns_per_s);
    for (uint32_t k = 0; k < uint32_t(run_s * RATE_HZ); k++) {
        const double time_s = double(k) / RATE_HZ, turns = 0.2 + turns_per_s * time_s;
        const double load = load_Nm(time_s, turns), rest = load - (state.torque_q24 / Q24);
        const double estimate = observer.step(rest);
        const double before = turns - turns_per_s * UPDATE_PERIODS / RATE_HZ;
        const bool left_out = std::floor(turns * strokes) != std::floor(before * strokes);
        if (k % UPDATE_PERIODS == 0 && !left_out) {
            const periodic_load_sample_t sample = {.angle = angle_from_rev(turns),
                                                   .angle_step = int32_t(std::lround(turns_per_s / RATE_HZ * 0x1p32)),
                                                   .load_torque_q24 = to_fixed(estimate, Q24),
                                                   .moving = moving};
            periodic_load_step(&parameters, &state, &sample);
            reference.step(turns, turns_per_s, estimate, moving);
            result.error_Nm = std::max(result.error_Nm, std::fabs((state.torque_q24 / Q24) - reference.torque));
            result.largest_q24 = std::max(result.largest_q24, std::abs(state.torque_q24));
        }
        if (k % review_periods == 0) {
            periodic_load_review(&state);
        }
        if (time_s >= last_s) {
            sum += rest;
            square += rest * rest;
            load_sum += load;
            load_square += load * load;
            n += 1.0;
            result.torque_Nm = std::max(result.torque_Nm, std::fabs((state.torque_q24 / Q24)));
        }
    }
    result.rest_Nm = std::sqrt(std::max(0.0, square / n - sum / n * sum / n));
    result.load_Nm = std::sqrt(std::max(0.0, load_square / n - load_sum / n * load_sum / n));
    result.engaged = state.engaged;
    return result;
}

double harmonics(double, double turns) {
    return 8.0 + 3.0 * std::sin(2.0 * PI * turns) + 2.0 * std::cos(4.0 * PI * turns) +
           1.0 * std::sin(10.0 * PI * turns + 1.0);
}

TEST(PeriodicLoad, follows_its_equations_within_50_mNm_at_any_speed_and_in_both_directions) {
    for (const double rpm : {10.0, 150.0, -150.0, 600.0, -1500.0, 3000.0}) {
        const learned_t learned = learn(rpm, harmonics, 12.0 * 60.0 / std::fabs(rpm));
        EXPECT_LT(learned.error_Nm, 0.05) << rpm;
        EXPECT_TRUE(learned.engaged) << rpm;
    }
}

TEST(PeriodicLoad, leaves_less_than_a_tenth_of_a_load_that_repeats_after_20_turns) {
    for (const double rpm : {10.0, 150.0, -600.0, 1500.0}) {
        const learned_t learned = learn(rpm, harmonics, 20.0 * 60.0 / std::fabs(rpm));
        EXPECT_LT(learned.rest_Nm, 0.1 * learned.load_Nm) << rpm;
        EXPECT_GT(learned.torque_Nm, 4.0) << rpm;
    }
    const learned_t fast = learn(3000.0, harmonics, 0.8);
    EXPECT_LT(fast.rest_Nm, 0.1 * fast.load_Nm) << "40 turns, with the low-pass wider";
}

TEST(PeriodicLoad, learns_as_well_with_a_step_left_out_in_each_stroke_up_to_the_highest_speed) {
    for (const double rpm : {150.0, -600.0, 1500.0, 4800.0}) {
        const double run_s = 60.0 * 60.0 / std::fabs(rpm);
        const learned_t all = learn(rpm, harmonics, run_s), fewer = learn(rpm, harmonics, run_s, true, 24.0);
        EXPECT_TRUE(fewer.engaged) << rpm;
        EXPECT_LT(fewer.rest_Nm, all.rest_Nm + 0.02 * all.load_Nm) << rpm;
        EXPECT_LT(fewer.rest_Nm, 0.5 * fewer.load_Nm) << rpm;
    }
}

TEST(PeriodicLoad, does_not_grow_within_1000_turns_at_the_highest_speed) {
    const auto corners = [](double, double turns) { return turns - std::floor(turns) < 0.3 ? 10.0 : 2.0; };
    for (const double rpm : {1500.0, 4800.0}) {
        const learned_t early = learn(rpm, corners, 60.0 * 60.0 / rpm), late = learn(rpm, corners, 1000.0 * 60.0 / rpm);
        EXPECT_LT(late.rest_Nm, 1.05 * early.rest_Nm) << rpm;
        EXPECT_LT(late.rest_Nm, 0.5 * late.load_Nm) << rpm;
        EXPECT_LT((late.largest_q24 / Q24), 12.0) << rpm;
    }
}

TEST(PeriodicLoad, learns_nothing_from_a_constant_load_a_step_or_a_ramp) {
    const load_t loads[] = {[](double, double) { return 8.0; },
                            [](double time_s, double) { return time_s < 1.03 ? 2.0 : 12.0; },
                            [](double time_s, double) { return 5.0 * time_s; }};
    for (const auto &load : loads) {
        for (const double rpm : {150.0, 600.0, 3000.0}) {
            const learned_t learned = learn(rpm, load, 3.0);
            EXPECT_EQ(learned.largest_q24, 0) << rpm;
            EXPECT_FALSE(learned.engaged) << rpm;
        }
    }
}

TEST(PeriodicLoad, ripple_that_repeats_with_every_pole_pitch_is_the_machine_s_own_and_is_not_learned) {
    for (const unsigned harmonic : {1u, 2u, 4u}) {
        const auto ripple = [=](double, double turns) {
            return 8.0 + 2.0 * std::sin(2.0 * PI * ROTOR_POLES * harmonic * turns);
        };
        for (const double rpm : {150.0, -600.0}) {
            EXPECT_EQ(learn(rpm, ripple, 20.0 * 60.0 / std::fabs(rpm)).torque_Nm, 0.0) << harmonic << " " << rpm;
        }
        const auto both = [=](double time_s, double turns) {
            return ripple(time_s, turns) + 2.0 * std::sin(2.0 * PI * turns);
        };
        EXPECT_TRUE(learn(150.0, both, 8.0).engaged) << "beside a load that repeats with every turn";
    }
}

// Turns with an observer that sees the load less the torque at once; from turn to turn, by the value.
double turn(periodic_load_t &state, double from, double to, const std::function<double(double)> &load_Nm) {
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    const double step = (to < from ? -5.0 : 5.0) / RATE_HZ; // 300 r/min
    double largest_Nm = 0.0;
    for (double turns = from; (to - turns) * step > 0.0; turns += step * UPDATE_PERIODS) {
        const periodic_load_sample_t sample = {.angle = angle_from_rev(turns),
                                               .angle_step = int32_t(std::lround(step * 0x1p32)),
                                               .load_torque_q24 =
                                                   to_fixed(load_Nm(turns) - (state.torque_q24 / Q24), Q24),
                                               .moving = true};
        periodic_load_step(&parameters, &state, &sample);
        largest_Nm = std::max(largest_Nm, std::fabs(state.torque_q24 / Q24));
    }
    return largest_Nm;
}

double one_cylinder(double turns) {
    return 8.0 + 3.0 * std::sin(2.0 * PI * turns);
}

TEST(PeriodicLoad, nothing_of_a_run_acts_in_the_next_one_which_begins_within_the_same_value) {
    for (const double end : {10.1, 10.5, 10.9}) {
        periodic_load_t state{};
        ASSERT_GT(turn(state, 0.0, end, one_cylinder), 1.0);
        periodic_load_reset(&state);
        EXPECT_EQ(turn(state, end, end + 3.0, [](double) { return 8.0; }), 0.0) << end;
    }
}

TEST(PeriodicLoad, learns_nothing_while_the_load_does_not_count_as_moving) {
    EXPECT_EQ(learn(600.0, harmonics, 2.0, false).largest_q24, 0);
}

TEST(PeriodicLoad, sine_between_the_harmonics_is_not_amplified_by_more_than_a_tenth) {
    for (double ratio = 0.25; ratio < 4.0; ratio += 0.07) {
        const auto sine = [&](double time_s, double) { return 8.0 + 4.0 * std::sin(2.0 * PI * 10.0 * ratio * time_s); };
        double worst = 0.0;
        for (const double run_s : {2.03, 2.51}) {
            const learned_t learned = learn(600.0, sine, run_s);
            worst = std::max(worst, learned.rest_Nm / learned.load_Nm);
        }
        EXPECT_LT(worst, 1.1) << ratio;
    }
}

TEST(PeriodicLoad, profile_is_gone_half_a_turn_after_the_load_stops_and_follows_half_of_it_within_10) {
    constexpr double END_S = 2.037;
    const auto stopping = [](double time_s, double turns) { return time_s < END_S ? harmonics(0.0, turns) : 6.0; };
    const auto halving = [](double time_s, double turns) {
        return time_s < END_S ? harmonics(0.0, turns) : 4.0 + 0.5 * harmonics(0.0, turns);
    };
    EXPECT_GT(learn(600.0, stopping, END_S).torque_Nm, 4.0);
    for (const double after_s : {0.15, 0.2, 0.41}) { /* a turn takes 0.1 s, and the last one is looked at */
        const learned_t stopped = learn(600.0, stopping, END_S + after_s);
        EXPECT_EQ(stopped.torque_Nm, 0.0) << after_s;
        EXPECT_FALSE(stopped.engaged) << after_s;
    }
    EXPECT_GT(learn(600.0, stopping, END_S + 0.2, true, 0.0, UINT32_MAX).torque_Nm, 4.0) << "without a review";
    const learned_t halved = learn(600.0, halving, END_S + 1.0);
    EXPECT_LT(halved.rest_Nm, 0.2 * halved.load_Nm);
}

TEST(PeriodicLoad, torque_is_bounded_by_the_largest_torque_of_the_drive) {
    const auto large = [](double, double turns) { return 50.0 * std::sin(2.0 * PI * turns); };
    const learned_t learned = learn(600.0, large, 4.0);
    EXPECT_LE((learned.largest_q24 / Q24), TORQUE_MAX_NM);
    EXPECT_GT((learned.largest_q24 / Q24), 0.99 * TORQUE_MAX_NM);
}

TEST(PeriodicLoad, without_a_bandwidth_or_beyond_a_delay_of_eight_values_nothing_is_learned) {
    const int32_t torque_max_q24 = to_fixed(TORQUE_MAX_NM, Q24);
    EXPECT_EQ(periodic_load_configure(RATE_HZ, 0, torque_max_q24, 4).lag_periods, 0);
    const periodic_load_parameters_t slow = periodic_load_configure(RATE_HZ, 250, torque_max_q24, 4);
    EXPECT_EQ(slow.lag_periods, 352);
    EXPECT_NEAR(slow.angle_step_max * 352.0, 0x1p29, 0x1p21);
    periodic_load_t state{};
    state.engaged = true;
    const periodic_load_sample_t sample = {
        .angle = 0, .angle_step = -slow.angle_step_max - 1, .load_torque_q24 = torque_max_q24, .moving = true};
    periodic_load_step(&slow, &state, &sample);
    EXPECT_FALSE(state.engaged);
    EXPECT_EQ(state.torque_q24, 0);
}

// The angle jumps by a third of a turn: values of before are no neighbours of those after it.
TEST(PeriodicLoad, the_mean_over_a_pole_pitch_begins_anew_where_the_angle_jumps) {
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    const int32_t angle_step = int32_t(REV * 150.0 / 60.0 / RATE_HZ);
    periodic_load_t load{};
    uint32_t angle = 0;
    const auto turn = [&](double turns) {
        for (int k = 0; k < int(turns * REV / angle_step); k++, angle += uint32_t(angle_step)) {
            const periodic_load_sample_t sample = {.angle = angle,
                                                   .angle_step = angle_step,
                                                   .load_torque_q24 = to_fixed(harmonics(0.0, angle / REV), Q24),
                                                   .moving = false};
            periodic_load_step(&parameters, &load, &sample);
        }
        int32_t sum_q8 = 0;
        for (int value = 1; value <= PITCH; value++) {
            sum_q8 += load.estimate_q8[(load.index - uint32_t(value)) % VALUES];
        }
        return sum_q8;
    };
    EXPECT_EQ(turn(1.5), load.window_q8);
    angle += 1u << 30;
    EXPECT_EQ(turn(0.7), load.window_q8);
    EXPECT_EQ(load.window, unsigned(PITCH));
    EXPECT_NE(load.window_q8, 0);
    turn(1.0 - double(load.count) / VALUES); // to the end of a turn, with its step
    const uint32_t before = load.index;
    periodic_load_reset(&load);
    turn(5.5 / VALUES);
    ASSERT_NE(load.index, before) << "it goes on within the same value";
    EXPECT_EQ(load.window, load.count) << "after a reset, too, only its own values count";
}

TEST(PeriodicLoad, the_window_of_a_pole_pitch_is_the_nearest_number_of_values) {
    for (unsigned poles = 1; poles <= 64; poles++) {
        const periodic_load_parameters_t parameters =
            periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), poles);
        EXPECT_NEAR(parameters.pitch, double(VALUES) / poles, 0.5) << poles;
    }
}

TEST(PeriodicLoad, values_are_the_means_of_their_intervals_rounded_towards_zero_and_the_torque_is_between_them) {
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    periodic_load_t load{};
    const int32_t angle_step = int32_t(REV * 150.0 / 60.0 / RATE_HZ);
    uint32_t angle = 12345, random = 1;
    int index = -1, sum_q8 = 0, updates = 0, ended_values = 0, cleared = 0, kept = 0;
    for (int k = 0; k < 3 * int(REV / angle_step); k++, angle += uint32_t(angle_step)) {
        const int now = int((angle - uint32_t(angle_step * parameters.lag_periods)) >> 26);
        const int mean_q8 = updates > 0 ? sum_q8 / updates : 0;
        const int ended = index;
        if (now != index) {
            index = now;
            sum_q8 = updates = 0;
        }
        random = random * 1664525u + 1013904223u;
        const int32_t load_q24 = int32_t(random) >> 4; // +-8 N m
        sum_q8 += load_q24 >> 16;
        updates++;
        const periodic_load_sample_t sample = {
            .angle = angle, .angle_step = angle_step, .load_torque_q24 = load_q24, .moving = false};
        const bool clear = load.mode == PERIODIC_LOAD_CLEAR;
        const int profile_q8 = clear || ended < 0 ? 0 : load.profile_q8[ended];
        periodic_load_step(&parameters, &load, &sample);
        if (updates == 1 && ended >= 0 && ++ended_values > 1) { // the first one has begun in its interval
            ASSERT_EQ(load.estimate_q8[ended], mean_q8 + profile_q8) << k;
            cleared += clear;
            kept += !clear;
        }
    }
    EXPECT_GT(cleared, VALUES / 2);
    EXPECT_GT(kept, VALUES / 2);
    // Interpolation: exact in Q24.
    load.mode = PERIODIC_LOAD_KEEP;
    for (int value = 0; value < VALUES; value++) {
        load.profile_q8[value] = int16_t((value * 7919) % 4001 - 2000);
    }
    for (int k = 0; k < 5000; k++, angle += uint32_t(angle_step)) {
        const periodic_load_sample_t sample = {
            .angle = angle, .angle_step = angle_step, .load_torque_q24 = 0, .moving = false};
        const std::array<int16_t, VALUES> before = std::to_array(load.profile_q8);
        periodic_load_step(&parameters, &load, &sample);
        if (load.mode == PERIODIC_LOAD_CLEAR) {
            break;
        }
        const uint32_t middle = angle + 4u * uint32_t(angle_step) - (1u << 25);
        const int from_q8 = before[middle >> 26], to_q8 = before[((middle >> 26) + 1) % VALUES];
        const int fraction_q16 = int((middle << 6) >> 16);
        ASSERT_EQ(load.torque_q24, from_q8 * 65536 + (to_q8 - from_q8) * fraction_q16) << k;
    }
}

TEST(PeriodicLoad, a_turn_decides_by_its_means_at_their_limits) {
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    const uint32_t least = parameters.threshold_q8;
    const auto mode = [&](uint32_t load_q8, uint32_t residual_q8, uint32_t slow_q8, uint32_t change_q8, bool moved) {
        periodic_load_t load{};
        load.mode = PERIODIC_LOAD_KEEP;
        load.count = VALUES;
        load.load_q8 = load_q8;
        load.residual_q8 = residual_q8;
        load.slow_q8 = slow_q8;
        load.change_q8 = change_q8;
        load.moved = moved;
        const periodic_load_sample_t sample{};
        periodic_load_step(&parameters, &load, &sample);
        return periodic_load_mode_t(load.mode);
    };
    EXPECT_EQ(mode(least - 1, 0, least, 0, true), PERIODIC_LOAD_CLEAR) << "no load";
    EXPECT_EQ(mode(least, 0, least, 0, true), PERIODIC_LOAD_KEEP);
    EXPECT_EQ(mode(least, 4 * least + 4, least, 0, true), PERIODIC_LOAD_CLEAR) << "all of it is a residual";
    EXPECT_EQ(mode(least, 4 * least, least, 4 * least, true), PERIODIC_LOAD_FORGET);
    EXPECT_EQ(mode(least, least, least / 4 - 1, 0, true), PERIODIC_LOAD_CLEAR) << "the machine's ripple";
    EXPECT_EQ(mode(least, least, least / 4, 0, true), PERIODIC_LOAD_LEARN);
    EXPECT_EQ(mode(least, least, least, least / 2, true), PERIODIC_LOAD_KEEP) << "it does not repeat";
    EXPECT_EQ(mode(2 * least, least - 1, least, 0, true), PERIODIC_LOAD_KEEP) << "nothing is left to learn";
    EXPECT_EQ(mode(least, least, least, 0, false), PERIODIC_LOAD_KEEP) << "it does not move";
}

TEST(PeriodicLoad, a_mode_that_is_none_keeps_the_profile_until_the_turn_ends) { // a bit has changed in memory
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    periodic_load_t load{};
    load.mode = 0x81;
    load.updates = 1;
    std::fill(std::begin(load.profile_q8), std::end(load.profile_q8), int16_t(1000));
    periodic_load_sample_t sample{};
    sample.angle = (1u << 26) + 1000;
    periodic_load_step(&parameters, &load, &sample);
    EXPECT_EQ(load.count, 1u);
    for (const int16_t value : load.profile_q8) {
        EXPECT_EQ(value, 1000);
    }
    load.count = VALUES;
    periodic_load_step(&parameters, &load, &sample);
    EXPECT_EQ(load.mode, PERIODIC_LOAD_CLEAR);
}

TEST(PeriodicLoad, a_value_that_lasts_longer_than_its_count_is_the_mean_of_what_was_counted) {
    const periodic_load_parameters_t parameters =
        periodic_load_configure(RATE_HZ, BANDWIDTH_RAD_S, to_fixed(TORQUE_MAX_NM, Q24), ROTOR_POLES);
    for (const double load_Nm : {-63.0, 63.0}) {
        periodic_load_t load{};
        periodic_load_sample_t sample{};
        sample.load_torque_q24 = to_fixed(load_Nm, Q24);
        for (int k = 0; k < 70000; k++) { // at standstill
            periodic_load_step(&parameters, &load, &sample);
        }
        EXPECT_EQ(load.updates, UINT16_MAX);
        sample.angle = 1u << 26;
        periodic_load_step(&parameters, &load, &sample);
        EXPECT_EQ(load.estimate_q8[0], int(load_Nm * 256.0));
    }
}

} // namespace
