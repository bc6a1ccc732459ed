// Scale of the tables and resistance, by conduction intervals of a machine whose flux linkage, resistance and drops are
// not the tables': against the factors that the model has been given, and a double-precision twin of the sums.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/phase_map.h"
#include "control/table_scale.h"
}

#include "support/fixed_point.h"
#include "support/flipped_bits.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;

constexpr double PERIOD_S = 25e-6, RESISTANCE_OHM = 0.05;
constexpr unsigned SPACING = 4;
constexpr int32_t LEAST_Q9 = 80 * 512 / 32, NONE_Q9 = 80 * 512 / 64;

double table_Wb(double rev, double current_A) {
    return phase_map_flux_q29(&machine_tables, phase_map_distance(uint32_t(int64_t(std::floor(rev * REV)))),
                              to_fixed(current_A, 512.0)) /
           Q29;
}

// The same sums in double precision, without forgetting: of equal intervals the same quotients.
struct twin_t {
    double applied = 0.0, table = 0.0, square = 0.0, charge = 0.0; // of the present interval
    double before_A = 0.0, before_Wb = 0.0, before_table_Wb = 0.0;
    double scale = 1.0, resistance_ohm = 0.0;

    void add(double current_A, double flux_Wb, double table_Wb, double time_s) {
        applied += (before_A + current_A) / 2.0 * (flux_Wb - before_Wb);
        table += (before_A + current_A) / 2.0 * (table_Wb - before_table_Wb);
        charge += (before_A + current_A) / 2.0 * time_s;
        square += (before_A * before_A + before_A * current_A + current_A * current_A) / 3.0 * time_s;
        before_A = current_A, before_Wb = flux_Wb, before_table_Wb = table_Wb;
    }

    void end() {
        const double of_voltage = before_Wb / charge, of_table = before_table_Wb / charge;
        scale = (applied - square * of_voltage) / (table - square * of_table);
        resistance_ohm = of_voltage - scale * of_table;
        *this = twin_t{.scale = scale, .resistance_ohm = resistance_ohm};
    }
};

// A phase that conducts from `on` to `off`, in electrical revolutions past the aligned position, and then has a current
// that falls to zero.
class TableScale : public testing::Test {
  protected:
    TableScale() { table_scale_reset(&state); }

    void intervals(int count) {
        for (int k = 0; k < count; k++) {
            interval();
        }
    }

    void interval() {
        table_scale_sample_t sample = {.zero = true, .none = true};
        table_scale_add(&state, 0, &sample, LEAST_Q9);
        double current_A = 0.0, drift_Wb = 0.0, corrections_Wb = 0.0, drops_Wb = 0.0, rev = on, step_s = 0.0;
        for (int k = 0;; k++) {
            const unsigned periods = off - rev < 0.05 ? 1 : SPACING; // finer at the end, as the background samples
            step_s = periods * PERIOD_S;
            rev += k == 0 ? 0.0 : rpm / 60.0 * machine_tables.rotor_poles * step_s;
            const double rise = std::min((rev - on) / 0.02, 1.0), fall = std::clamp((off - rev) / 0.05, 0.0, 1.0);
            const double now_A = peak_A * rise * fall * (1.0 + 0.2 * std::sin(40.0 * rev));
            if (k > 0 && now_A <= 0.0) {
                break;
            }
            drops_Wb += drop_V * (current_A > 0.0 ? 1.0 : 0.5) * step_s;
            drift_Wb += (resistance_gain - 1.0) * RESISTANCE_OHM * (now_A + current_A) / 2.0 * step_s;
            current_A = now_A;
            const double psi_Wb = table_Wb(rev, current_A), seen_A = gain * current_A;
            const double flux_Wb = flux_gain * psi_Wb + drift_Wb + drops_Wb, table = table_Wb(rev + misaligned, seen_A);
            sample = {
                .current_q9 = to_fixed(seen_A, 512.0),
                .flux_q29 = to_fixed(flux_Wb + corrections_Wb, Q29),
                .correction_q29 = to_fixed((table - flux_Wb - corrections_Wb) / 100.0, Q29),
                .table_q29 = to_fixed(table, Q29),
                .periods = periods,
                .drop_q29 = to_fixed(drop_V * step_s, Q29),
                .none = to_fixed(seen_A, 512.0) <= NONE_Q9,
                .lost = k == lost_at,
            };
            corrections_Wb += sample.correction_q29 / Q29;
            table_scale_add(&state, 0, &sample, LEAST_Q9);
            if (!sample.none || rise < 1.0) {
                twin.add(seen_A, flux_Wb - drops_Wb, table, step_s);
            }
        }
        sample = {.zero = true, .none = true};
        table_scale_add(&state, 0, &sample, LEAST_Q9);
        twin.end();
    }

    double scale() const { return state.scale_q30 / Q30; }
    double resistance_ohm() const { return RESISTANCE_OHM + state.resistance_q40 / Q40 / PERIOD_S; }

    table_scale_t state{};
    twin_t twin;
    double rpm = 150.0, on = 0.52, off = 0.95, peak_A = 30.0;
    double flux_gain = 1.0, resistance_gain = 1.0, drop_V = 0.0, gain = 1.0, misaligned = 0.0;
    int lost_at = -1;
};

TEST_F(TableScale, is_that_of_the_machine_whatever_resistance_drops_speed_and_direction_of_the_energy_are) {
    for (const double speed_rpm : {20.0, 150.0, 1500.0}) {
        for (const bool brakes : {false, true}) {
            for (const double factor : {0.75, 1.0, 1.3}) {
                for (const double ohm : {0.7, 1.0, 1.5}) {
                    table_scale_reset(&state);
                    rpm = speed_rpm;
                    on = brakes ? 0.05 : 0.52;
                    off = brakes ? 0.48 : 0.95;
                    flux_gain = factor;
                    resistance_gain = ohm;
                    drop_V = ohm > 1.0 ? 1.7 : 0.0;
                    intervals(14);
                    EXPECT_NEAR(scale(), factor, 0.003 * factor) << rpm << " r/min, brakes " << brakes << ", R " << ohm;
                    EXPECT_NEAR(resistance_ohm(), ohm * RESISTANCE_OHM, 0.01 * RESISTANCE_OHM * (1.0 + rpm / 150.0))
                        << rpm << " r/min, brakes " << brakes << ", flux " << factor;
                    EXPECT_NEAR(scale(), twin.scale, 2e-3);
                    EXPECT_NEAR(resistance_ohm() - RESISTANCE_OHM, twin.resistance_ohm,
                                0.005 * RESISTANCE_OHM * (1.0 + rpm / 150.0));
                }
            }
        }
    }
}

// i dpsi is larger by the gain of the sensor: the ratio to the tables at a larger current is smaller than 1, and the
// torque is wrong by the gain alone.
TEST_F(TableScale, cannot_tell_the_gain_of_the_current_but_leaves_only_the_gain_itself_as_an_error) {
    gain = 1.05;
    intervals(14);
    double true_J = 0.0, table_J = 0.0, last_A = 0.0, last_Wb = 0.0, last_table_Wb = 0.0;
    for (double rev = on; rev < off; rev += 1e-4) {
        const double rise = std::min((rev - on) / 0.02, 1.0), fall = std::clamp((off - rev) / 0.05, 0.0, 1.0);
        const double now_A = peak_A * rise * fall * (1.0 + 0.2 * std::sin(40.0 * rev));
        const double now_Wb = table_Wb(rev, now_A), now_table_Wb = table_Wb(rev, gain * now_A);
        true_J += (now_A + last_A) / 2.0 * (now_Wb - last_Wb);
        table_J += gain * (now_A + last_A) / 2.0 * (now_table_Wb - last_table_Wb);
        last_A = now_A, last_Wb = now_Wb, last_table_Wb = now_table_Wb;
    }
    EXPECT_LT(table_J * scale() / true_J, 1.06);
    EXPECT_NEAR(table_J * scale() / true_J, gain, 0.007);
    EXPECT_GT(table_J / true_J, 1.065) << "without the scale";
}

TEST_F(TableScale, at_a_wrong_angle_is_the_factor_of_the_work) {
    misaligned = 0.015; // 5.4 electrical degrees
    intervals(14);
    EXPECT_NEAR(scale(), twin.scale, 2e-3);
    EXPECT_GT(std::fabs(scale() - 1.0), 0.005);
    EXPECT_NEAR(scale(), 1.0, 0.1);
}

TEST_F(TableScale, is_used_from_the_twelfth_interval_on_and_followed_slowly) {
    flux_gain = 1.2;
    intervals(11);
    EXPECT_EQ(state.scale_q30, TABLE_SCALE_ONE_Q30);
    interval();
    EXPECT_NEAR(scale(), 1.2, 0.004);
    EXPECT_EQ(state.smooth_q30, TABLE_SCALE_ONE_Q30);
    const int32_t part_q31 = table_scale_part_q31(40000);
    for (int k = 0; k < 8000; k++) { // 0.2 s
        table_scale_follow(&state, TABLE_SCALE_ONE_Q30, part_q31);
    }
    EXPECT_NEAR(state.smooth_q30 / Q30, 1.2 - 0.2 / std::exp(1.0), 0.002);
    for (int k = 0; k < 40000; k++) {
        table_scale_follow(&state, TABLE_SCALE_ONE_Q30, part_q31);
    }
    EXPECT_NEAR(state.smooth_q30 / Q30, 1.2, 0.003);
}

TEST_F(TableScale, leaves_tables_that_are_right_as_they_are) {
    const int32_t all_q31 = INT32_MAX;
    const auto in_effect = [&](double gain) {
        flux_gain = gain;
        intervals(100);
        table_scale_follow(&state, TABLE_SCALE_ONE_Q30, all_q31);
        return state.smooth_q30 / Q30;
    };
    EXPECT_EQ(in_effect(1.02), 1.0);
    EXPECT_NEAR(in_effect(1.03), 1.03, 0.002);
    EXPECT_NEAR(in_effect(1.02), 1.02, 0.002); // once it has been another one
    EXPECT_NEAR(in_effect(1.008), 1.0, 1e-6);
    EXPECT_EQ(in_effect(0.98), 1.0);
    EXPECT_NEAR(in_effect(0.965), 0.965, 0.002);
}

// The gain of the machine moves slowly away from 1 and back, to each side.
TEST_F(TableScale, differs_from_a_40th_on_until_it_is_within_an_80th) {
    for (const double side : {1.0, -1.0}) {
        table_scale_reset(&state);
        double last_off = 0.0, begins = 0.0, ends = 0.0;
        for (int k = 0; k <= 800; k++) {
            const bool before = state.differs;
            flux_gain = 1.0 + side * 0.04 * std::min(k, 800 - k) / 400.0;
            interval();
            const double off = std::fabs(scale() - 1.0);
            if (state.differs != before) {
                (state.differs ? begins : ends) = (off + last_off) / 2.0;
            }
            last_off = off;
        }
        EXPECT_NEAR(begins, 1.0 / 40.0, 1e-4) << side;
        EXPECT_NEAR(ends, 1.0 / 80.0, 1e-4) << side;
    }
}

TEST_F(TableScale, is_limited) {
    flux_gain = 2.0;
    intervals(14);
    EXPECT_EQ(state.scale_q30, TABLE_SCALE_MAX_Q30);
    flux_gain = 0.3;
    intervals(100);
    EXPECT_EQ(state.scale_q30, TABLE_SCALE_MIN_Q30);
}

TEST_F(TableScale, is_not_learned_from_small_currents_lost_periods_or_hardly_any_work) {
    flux_gain = 1.2;
    peak_A = 2.0;
    intervals(20);
    EXPECT_EQ(state.scale_q30, TABLE_SCALE_ONE_Q30);
    peak_A = 30.0;
    lost_at = 10;
    intervals(20);
    EXPECT_EQ(state.scale_q30, TABLE_SCALE_ONE_Q30);
    lost_at = -1;
    on = 0.79; // drives to the aligned position and brakes after it
    off = 1.24;
    intervals(20);
    EXPECT_EQ(state.scale_q30, TABLE_SCALE_ONE_Q30);
    on = 0.52;
    off = 0.95;
    intervals(14);
    EXPECT_NEAR(scale(), 1.2, 0.004);
}

TEST_F(TableScale, is_not_learned_from_a_conduction_longer_than_its_sums_hold_and_from_the_next_one_again) {
    const table_scale_sample_t zero = {.zero = true, .none = true};
    table_scale_add(&state, 0, &zero, LEAST_Q9);
    table_scale_sample_t sample = {.current_q9 = 80 * 512, .flux_q29 = 1 << 28, .table_q29 = 1 << 27, .periods = 255};
    int whole = 0;
    for (int k = 0; k < 1000000 && state.phase[0].whole; k++) {
        table_scale_add(&state, 0, &sample, LEAST_Q9);
        whole++;
    }
    EXPECT_GT(whole, 10000) << "some minutes";
    EXPECT_LT(whole, 1000000);
    const int64_t charge = state.phase[0].charge_q10;
    table_scale_add(&state, 0, &sample, LEAST_Q9);
    EXPECT_EQ(state.phase[0].charge_q10, charge) << "it ends";
    table_scale_add(&state, 0, &zero, LEAST_Q9);
    EXPECT_EQ(state.intervals, 0u);
    EXPECT_TRUE(state.phase[0].whole);
    intervals(1);
    table_scale_add(&state, 0, &zero, LEAST_Q9);
    EXPECT_EQ(state.intervals, 1u);
}

TEST(TableScaleFactors, are_the_scale_and_its_inverse_and_exact_for_1) {
    const flux_observer_parameters_t flux = {.gain_q30 = 1 << 28, .resistance_period_q40 = to_fixed(1.25e-6, Q40)};
    const int32_t period_q40 = to_fixed(PERIOD_S, Q40);
    const table_scale_factors_t one = table_scale_factors(TABLE_SCALE_ONE_Q30, period_q40, &flux);
    EXPECT_EQ(one.excess_q31, 0);
    EXPECT_EQ(one.inverse_excess_q31, 0);
    EXPECT_EQ(one.period_q40, period_q40);
    EXPECT_EQ(one.flux.gain_q30, flux.gain_q30);
    EXPECT_EQ(one.flux.resistance_period_q40, flux.resistance_period_q40);
    for (const int32_t torque_q24 : {INT32_MIN, -(8 << 24), -1, 0, 1, 19 << 24, INT32_MAX}) {
        EXPECT_EQ(table_scale_multiply(torque_q24, 0), torque_q24);
    }
    for (const double factor : {0.7, 0.93, 1.1, 1.4}) {
        const table_scale_factors_t f = table_scale_factors(to_fixed(factor, Q30), period_q40, &flux);
        EXPECT_NEAR(table_scale_multiply(16 << 24, f.excess_q31) / Q24, 16.0 * factor, 1e-6);
        EXPECT_NEAR(table_scale_multiply(-(16 << 24), f.inverse_excess_q31) / Q24, -16.0 / factor, 1e-6);
        EXPECT_NEAR(f.period_q40 / Q40, PERIOD_S / factor, 1e-11);
        EXPECT_NEAR(f.flux.resistance_period_q40 / Q40, 1.25e-6 / factor, 1e-11);
    }
    EXPECT_EQ(table_scale_multiply(100 << 24, table_scale_factors(to_fixed(1.4, Q30), period_q40, &flux).excess_q31),
              INT32_MAX);
}

TEST(TableScaleSums, overflow_nothing) {
    for (const int sign : {1, -1}) {
        table_scale_t state;
        table_scale_reset(&state);
        for (int interval = 0; interval < 60; interval++) {
            for (int k = 0; k < 300; k++) {
                const table_scale_sample_t sample = {
                    .current_q9 = k == 0 ? 0 : 79 * 512,
                    .flux_q29 = k % 2 == 0 ? INT32_MAX : sign * INT32_MAX,
                    .correction_q29 = sign * INT32_MAX,
                    .table_q29 = k < 200 ? INT32_MAX : 0,
                    .periods = 255,
                    .drop_q29 = INT32_MAX,
                    .zero = k == 0,
                    .none = k == 0,
                };
                table_scale_add(&state, 3, &sample, LEAST_Q9);
            }
            table_scale_follow(&state, TABLE_SCALE_ONE_Q30, table_scale_part_q31(20000) * 255);
            ASSERT_GE(state.scale_q30, TABLE_SCALE_MIN_Q30);
            ASSERT_LE(state.scale_q30, TABLE_SCALE_MAX_Q30);
        }
    }
}

TEST(TableScaleSums, leave_the_scale_within_its_limits_with_any_bit_changed) {
    table_scale_t state;
    table_scale_reset(&state);
    const auto interval = [](table_scale_t &scale) {
        for (int k = 0; k < 20; k++) {
            const table_scale_sample_t sample = {
                .current_q9 = k == 0 ? 0 : 20 * 512,
                .flux_q29 = k << 22,
                .correction_q29 = 0,
                .table_q29 = k << 22,
                .periods = 4,
                .drop_q29 = 0,
                .zero = k == 0,
                .none = k == 0,
                .lost = false,
            };
            table_scale_add(&scale, 0, &sample, LEAST_Q9);
        }
    };
    for (unsigned k = 0; k < 2 * TABLE_SCALE_INTERVALS_MIN; k++) {
        interval(state);
    }
    ASSERT_GT(state.table_q30, 0);
    for (int64_t table_scale_t::*sum :
         {&table_scale_t::applied_q30, &table_scale_t::table_q30, &table_scale_t::square_q10, &table_scale_t::end,
          &table_scale_t::end_table, &table_scale_t::charge}) {
        with_each_bit_flipped(state.*sum, [&](int64_t flipped) {
            table_scale_t changed = state;
            changed.*sum = flipped;
            interval(changed);
            interval(changed);
            ASSERT_GE(changed.scale_q30, TABLE_SCALE_MIN_Q30);
            ASSERT_LE(changed.scale_q30, TABLE_SCALE_MAX_Q30);
        });
    }
}

TEST(TableScaleFactors, are_within_their_roundings_for_any_scale) {
    std::mt19937 random(1);
    double worst = 0.0, worst_of_step = 0.0;
    for (int i = 0; i < 100000; i++) {
        const int32_t range_q30 = TABLE_SCALE_MAX_Q30 - TABLE_SCALE_MIN_Q30;
        const int32_t scale_q30 = TABLE_SCALE_MIN_Q30 + wide_integer::any_up_to(random, range_q30);
        const int32_t period_q40 = 1 + wide_integer::any_up_to(random, to_fixed(50e-6, Q40) - 1);
        const int32_t resistance_q40 = wide_integer::any_up_to(random, INT32_MAX / 2);
        const flux_observer_parameters_t flux = {.gain_q30 = 1 << 28, .resistance_period_q40 = resistance_q40};
        const table_scale_factors_t f = table_scale_factors(scale_q30, period_q40, &flux);
        const double inverse = Q30 / scale_q30;
        ASSERT_EQ(f.excess_q31, 2 * (int64_t(scale_q30) - TABLE_SCALE_ONE_Q30));
        ASSERT_LE(std::fabs(f.inverse_excess_q31 / Q31 - (inverse - 1.0)), 1.0001 / Q31) << scale_q30;
        // 1 / s has been rounded before.
        ASSERT_LE(std::fabs(f.period_q40 - period_q40 * inverse), 0.5001 + period_q40 / Q31) << scale_q30;
        const double resistance_error = std::fabs(f.flux.resistance_period_q40 - resistance_q40 * inverse);
        ASSERT_LE(resistance_error, 0.5001 + resistance_q40 / Q31) << scale_q30 << " " << resistance_q40;
        worst = std::max(worst, std::fabs(f.inverse_excess_q31 / Q31 - (inverse - 1.0)) * Q31);
        worst_of_step = std::max(worst_of_step, std::fabs(f.period_q40 - period_q40 * inverse));
    }
    EXPECT_GT(worst, 0.9);
    EXPECT_GT(worst_of_step, 0.45);
}

TEST(TableScaleFactors, a_torque_times_a_factor_is_rounded_to_2_lsb_and_saturated_for_any_arguments) {
    std::mt19937 random(2);
    double worst = 0.0;
    int saturating = 0;
    for (int i = 0; i < 200000; i++) {
        const int32_t torque_q24 = wide_integer::any(random), excess_q31 = wide_integer::any(random);
        const double exact = torque_q24 + torque_q24 / Q31 * excess_q31;
        const double error =
            std::fabs(table_scale_multiply(torque_q24, excess_q31) - std::clamp(exact, -2147483648.0, 2147483647.0));
        ASSERT_LE(error, 1.0001) << torque_q24 << " " << excess_q31;
        worst = std::max(worst, error);
        saturating += std::fabs(exact) > Q31;
    }
    EXPECT_GT(worst, 0.9);
    EXPECT_GT(saturating, 1000);
}

TEST(TableScaleFollow, the_resistance_follows_by_a_quarter_of_the_part_by_which_the_scale_follows) {
    table_scale_t state;
    table_scale_reset(&state);
    state.differs = true;
    state.scale_q30 = to_fixed(1.2, Q30);
    state.resistance_q40 = 1 << 20;
    const int32_t part_q31 = table_scale_part_q31(40000);
    for (int k = 0; k < 8000; k++) { // 0.2 s, a time constant of the scale
        table_scale_follow(&state, TABLE_SCALE_ONE_Q30, part_q31);
    }
    EXPECT_NEAR((state.smooth_q30 / Q30 - 1.0) / 0.2, 1.0 - std::exp(-1.0), 0.01);
    EXPECT_NEAR(state.smooth_resistance_q40 / double(1 << 20), 1.0 - std::exp(-0.25), 0.01);
}

TEST(TableScaleInMemory, a_scale_of_which_a_bit_has_changed_begins_anew) {
    for (unsigned bit = 0; bit < 32; bit++) {
        table_scale_t scale;
        table_scale_reset(&scale);
        scale.smooth_q30 = int32_t(uint32_t(scale.smooth_q30) ^ UINT32_C(1) << bit);
        table_scale_follow(&scale, TABLE_SCALE_ONE_Q30, 1 << 10);
        EXPECT_EQ(scale.smooth_q30, TABLE_SCALE_ONE_Q30) << bit;
    }
}

} // namespace
