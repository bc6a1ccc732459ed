// Cell of the phase map: parabolas against the interpolation of the map, torque over flux linkage and its inverse
// against exact ones, and the ends of all ranges. One program per bundled machine.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <random>
#include <string>

#include <gtest/gtest.h>

extern "C" {
#include "control/phase_cell.h"
#include "plant/machine.h"
}

#include "support/fixed_point.h"
#include "support/phase_map_results.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr int32_t CURRENT_END_Q9 = PHASE_MAP_CURRENT_MAX_Q9;
constexpr double Q13 = one(13);

// Units of the tables in N m and Wb.
const double TORQUE_UNIT = std::exp2(machine_tables.torque_format.result_shift) / Q24;
const double FLUX_UNIT = std::exp2(machine_tables.flux_format.result_shift) / Q29;

phase_cell_t cell_at(uint32_t distance, int32_t column, const machine_tables_t &tables = machine_tables) {
    phase_cell_t cell{};
    phase_cell_locate(&tables, distance, column, &cell);
    return cell;
}

// Torque in N m and flux linkage in Wb of the map.
double map_torque_Nm(uint32_t distance, int32_t current_q9) {
    return phase_map_torque(&machine_tables, HALF_REV_Q32 + distance, current_q9) * TORQUE_UNIT;
}
double map_flux_Wb(uint32_t distance, int32_t current_q9) {
    return phase_map_results::flux_units(machine_tables, HALF_REV_Q32 + distance, current_q9) * FLUX_UNIT;
}

// Torque of the map at a flux linkage, interpolated between the two currents that enclose it.
double torque_of_flux_Nm(uint32_t distance, double flux_Wb) {
    int32_t below = 0, above = CURRENT_END_Q9;
    while (above - below > 1) {
        const int32_t middle = (below + above) / 2;
        (map_flux_Wb(distance, middle) <= flux_Wb ? below : above) = middle;
    }
    const double low_Wb = map_flux_Wb(distance, below), high_Wb = map_flux_Wb(distance, above);
    const double low_Nm = map_torque_Nm(distance, below), high_Nm = map_torque_Nm(distance, above);
    return low_Nm + (flux_Wb - low_Wb) / (high_Wb - low_Wb) * (high_Nm - low_Nm);
}

// Columns of up to 54 A, and torques up to 25 N m: the current limit and 1.3 times the largest torque reference.
constexpr int32_t COLUMN_END = 27;
constexpr int32_t OPERATING_END_Q9 = COLUMN_END << MACHINE_COLUMN_BITS;
constexpr double OPERATING_END_NM = 25.0;

// Operating points of the map and cells within `reach` columns of them.
template <typename function_t> void at_operating_points(double reach, const function_t &function) {
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const uint32_t distance = uint32_t(random()) >> 1;
        const auto column = int32_t(random() % COLUMN_END);
        const double middle_q9 = (column + 0.5) * (1 << MACHINE_COLUMN_BITS);
        const double reach_q9 = reach * (1 << MACHINE_COLUMN_BITS);
        const int32_t low = std::max(0, int32_t(middle_q9 - reach_q9));
        const int32_t high = std::min(OPERATING_END_Q9, int32_t(middle_q9 + reach_q9));
        const int32_t current_q9 = low + int32_t(random() % uint32_t(high - low + 1));
        const double torque_Nm = map_torque_Nm(distance, current_q9);
        if (torque_Nm <= OPERATING_END_NM) {
            function(cell_at(distance, column), distance, current_q9, torque_Nm, map_flux_Wb(distance, current_q9));
        }
    }
}

bool saturated(int32_t v_q13) {
    return v_q13 == PHASE_CELL_V_MAX_Q13 || v_q13 == -PHASE_CELL_V_MAX_Q13 - 1;
}

TEST(PhaseCell, inside_the_cell_both_parabolas_are_the_interpolation_of_the_map_within_40_units) {
    double torque_worst = 0.0, flux_worst = 0.0; // units of the tables
    at_operating_points(
        0.5, [&](const phase_cell_t &cell, uint32_t, int32_t current_q9, double torque_Nm, double flux_Wb) {
            const int32_t u_q13 = phase_cell_u_q13(&cell, current_q9);
            torque_worst =
                std::max(torque_worst, std::fabs(phase_cell_curve_at(&cell.torque, u_q13) - torque_Nm / TORQUE_UNIT));
            flux_worst = std::max(flux_worst, std::fabs(phase_cell_curve_at(&cell.flux, u_q13) - flux_Wb / FLUX_UNIT));
        });
    EXPECT_LT(torque_worst, 40.0);
    EXPECT_GT(torque_worst, 4.0);
    EXPECT_LT(flux_worst, 40.0);
    EXPECT_GT(flux_worst, 4.0);
}

// Largest errors of a machine, measured; the tests allow 5 % more and 20 % less.
struct errors_t {
    double inside_Nm;                                 // torque at a flux linkage, within the cell
    double one_column_Nm;                             // for u within -1..1
    double two_columns_Nm;                            // for u within -2.5..2.5
    double inverse_inside_Nm, inverse_two_columns_Nm; // torque at the flux linkage that the inverse gives
    double solved_inside_Nm, solved_two_columns_Nm;   // torque(solve(T)) against T
};

const std::map<std::string, errors_t> ERRORS = {
    {"saturating", {8.4e-3, 0.164, 1.167, 9.4e-3, 1.633, 4.6e-3, 0.801}},
    {"finite_element", {4.7e-3, 0.125, 0.815, 5.2e-3, 1.209, 2.4e-3, 0.564}},
    {"linear_cosine", {0.92e-3, 4.8e-3, 12.8e-3, 4.5e-3, 58.2e-3, 4.5e-3, 58.2e-3}},
    {"linear_trapezoid", {1.68e-3, 3.6e-3, 8.6e-3, 3.2e-3, 40.9e-3, 3.2e-3, 40.9e-3}},
};

void expect_stated(const char *what, double measured, double errors_t::*stated) {
    const auto errors = ERRORS.find(machine_plant.name);
    ASSERT_NE(errors, ERRORS.end()) << machine_plant.name;
    EXPECT_LT(measured, 1.05 * errors->second.*stated) << what;
    EXPECT_GT(measured, 0.8 * errors->second.*stated) << what;
}

// Error of the second-order torque over flux linkage. It increases with the third power of v, and with saturation.
double torque_error_Nm(double reach) {
    double worst = 0.0;
    at_operating_points(reach, [&](const phase_cell_t &cell, uint32_t, int32_t, double torque_Nm, double flux_Wb) {
        const int32_t v_q13 = phase_cell_v_q13(&cell, int32_t(flux_Wb / FLUX_UNIT));
        if (!saturated(v_q13)) {
            worst = std::max(worst, std::fabs(phase_cell_torque(&cell, v_q13) * TORQUE_UNIT - torque_Nm));
        }
    });
    return worst;
}

TEST(PhaseCell, torque_of_a_flux_linkage_is_that_of_the_map_within_the_errors_stated_here) {
    expect_stated("inside the cell", torque_error_Nm(0.5), &errors_t::inside_Nm);
    expect_stated("half a column further", torque_error_Nm(1.0), &errors_t::one_column_Nm);
    expect_stated("to two columns", torque_error_Nm(2.5), &errors_t::two_columns_Nm);
}

struct inverse_errors_t {
    double solved_Nm = 0.0, torque_Nm = 0.0;
};

// Above 0.02 N m, where the torque has a slope.
inverse_errors_t inverse_error_Nm(double reach) {
    inverse_errors_t worst;
    at_operating_points(reach, [&](const phase_cell_t &cell, uint32_t distance, int32_t, double torque_Nm, double) {
        const int32_t v_q13 = phase_cell_solve_q13(&cell, int32_t(torque_Nm / TORQUE_UNIT));
        if (torque_Nm < 0.02 || saturated(v_q13)) {
            return;
        }
        const double solved_Nm = phase_cell_torque(&cell, v_q13) * TORQUE_UNIT;
        const double flux_Wb = phase_cell_flux(&cell, v_q13) * FLUX_UNIT;
        worst.solved_Nm = std::max(worst.solved_Nm, std::fabs(solved_Nm - torque_Nm));
        worst.torque_Nm = std::max(worst.torque_Nm, std::fabs(torque_of_flux_Nm(distance, flux_Wb) - torque_Nm));
    });
    return worst;
}

TEST(PhaseCell, the_inverse_has_the_torque_within_the_errors_stated_here) {
    const inverse_errors_t inside = inverse_error_Nm(0.5), two_columns = inverse_error_Nm(2.5);
    expect_stated("inside the cell", inside.torque_Nm, &errors_t::inverse_inside_Nm);
    expect_stated("to two columns", two_columns.torque_Nm, &errors_t::inverse_two_columns_Nm);
    // Two steps of Newton's method, and v in steps of 2^-13.
    expect_stated("solved inside the cell", inside.solved_Nm, &errors_t::solved_inside_Nm);
    expect_stated("solved to two columns", two_columns.solved_Nm, &errors_t::solved_two_columns_Nm);
}

TEST(PhaseCell, the_inverse_of_a_torque_far_beyond_the_cell_is_on_its_side) {
    std::mt19937 random(3);
    int compared = 0;
    for (int i = 0; i < 100000; i++) {
        const uint32_t distance = uint32_t(random()) >> 1;
        const auto column = int32_t(random() % COLUMN_END);
        const phase_cell_t cell = cell_at(distance, column);
        if (cell.torque.rise * TORQUE_UNIT < 0.05) {
            continue; // hardly any torque at any current
        }
        const double highest_Nm = map_torque_Nm(distance, std::min((column + 4) * 1024, CURRENT_END_Q9));
        ASSERT_GT(phase_cell_solve_q13(&cell, int32_t(highest_Nm / TORQUE_UNIT)), 3 << 12) << column << " " << distance;
        if (column >= 8) {
            const double lowest_Nm = map_torque_Nm(distance, (column - 3) * 1024);
            ASSERT_LT(phase_cell_solve_q13(&cell, int32_t(lowest_Nm / TORQUE_UNIT)), -(3 << 12))
                << column << " " << distance;
        }
        ASSERT_GT(phase_cell_solve_q13(&cell, INT32_MAX), 3 << 12);
        compared++;
    }
    EXPECT_GT(compared, 50000);
}

TEST(PhaseCell, flux_linkage_and_v_are_inverse_within_16_units_and_the_resolution_of_v) {
    std::mt19937 random(4);
    double worst = 0.0;
    for (int i = 0; i < 100000; i++) {
        const phase_cell_t cell = cell_at(uint32_t(random()) >> 1, int32_t(random() % COLUMN_END));
        const auto v_q13 = int32_t(random() % 32766) - 16383;
        const int32_t flux = phase_cell_flux(&cell, v_q13);
        ASSERT_NEAR(flux, cell.flux.middle + cell.flux.rise * (v_q13 / Q13), 4.001);
        worst = std::max(worst, std::fabs(phase_cell_v_q13(&cell, flux) - double(v_q13)));
    }
    // The rise is rounded to 2^8 units.
    EXPECT_LT(worst, 40.0);
    EXPECT_GT(worst, 1.0);
}

TEST(PhaseCell, u_is_exact_for_every_current_to_four_columns_and_saturates_beyond) {
    for (const int32_t column : {0, 1, 20, PHASE_CELL_COLUMN_MAX}) {
        const phase_cell_t cell = cell_at(HALF_REV_Q32 / 2, column);
        for (int32_t current_q9 = 0; current_q9 <= 1 << 18; current_q9++) {
            const int64_t exact_q13 = (int64_t(current_q9) - column * 1024) * 8 - 4096;
            ASSERT_EQ(phase_cell_u_q13(&cell, current_q9), std::clamp<int64_t>(exact_q13, -32768, 32767));
        }
    }
}

TEST(PhaseCell, the_expected_distance_is_that_along_the_straight_line_towards_zero) {
    std::mt19937 random(5);
    double worst = 0.0;
    for (int i = 0; i < 100000; i++) {
        const phase_cell_t cell = cell_at(uint32_t(random()) >> 1, int32_t(random() % COLUMN_END));
        const auto y = int32_t(random() % (1u << 29));
        const double exact_q4 = (double(y) - cell.flux.middle) / std::ldexp(cell.flux.rise, -4);
        const int32_t found_q4 = phase_cell_distance_q4(&cell.flux, y);
        ASSERT_LE(std::fabs(found_q4), std::fabs(exact_q4) * 1.001 + 1e-3);
        worst = std::max(worst, (std::fabs(exact_q4) - std::fabs(found_q4)) / (1.0 + 1e-3 * std::fabs(exact_q4)));
    }
    EXPECT_LT(worst, 1.0);
}

TEST(PhaseCell, a_rise_of_zero_or_below_its_rounding_counts_as_256_units) {
    for (const int32_t rise : {-128, -1, 0, 1, 127, 256, 383}) {
        EXPECT_EQ(phase_cell_quotient_q13(1000, rise, 31), 32000) << rise;
        EXPECT_EQ(phase_cell_quotient_q13(-1000, rise, 31), -32000) << rise;
    }
    EXPECT_EQ(phase_cell_quotient_q13(1000, -400, 31), -32000) << "negative";
    // Unaligned no current makes torque: the inverse goes to the end, in the direction of the torque.
    const phase_cell_t flat = cell_at(0, 5);
    ASSERT_LT(std::abs(flat.torque.rise), 128);
    EXPECT_EQ(phase_cell_solve_q13(&flat, 1 << 20), PHASE_CELL_V_MAX_Q13);
    EXPECT_EQ(phase_cell_solve_q13(&flat, -(1 << 20)), -PHASE_CELL_V_MAX_Q13 - 1);
    phase_cell_curve_t falling = flat.torque;
    falling.rise = -(1 << 20);
    EXPECT_EQ(phase_cell_distance_q4(&falling, flat.torque.middle + 100), 100);
}

// Every function with any arguments: undefined behaviour is found by the build with sanitizers.
TEST(PhaseCell, tables_of_extreme_entries_and_any_target_overflow_nothing) {
    std::mt19937 random(7);
    int32_t largest = 0;
    for (int tables = 0; tables < 60; tables++) {
        static machine_tables_t extreme = machine_tables;
        for (machine_format_t *format : {&extreme.torque_format, &extreme.flux_format}) {
            format->curvature_shift = uint8_t(tables % 3 * 4);
            format->result_shift = uint8_t(tables % 2 == 0 ? 12 : 0);
        }
        const bool noise = tables % 5 == 4;
        for (int16_t &entry : extreme.node) {
            entry = noise ? int16_t(random()) : random() % 2 == 0 ? INT16_MIN : INT16_MAX;
        }
        for (int8_t &entry : extreme.curvature) {
            entry = noise ? int8_t(random()) : random() % 2 == 0 ? INT8_MIN : INT8_MAX;
        }
        for (int i = 0; i < 20000; i++) {
            const phase_cell_t cell =
                cell_at(uint32_t(random()) >> 1, int32_t(random() % (PHASE_CELL_COLUMN_MAX + 1)), extreme);
            const auto any = int32_t(uint32_t(random())) >> (random() % 24);
            for (const int32_t target : {any, INT32_MIN, INT32_MAX, 0}) {
                for (const int32_t v_q13 : {phase_cell_solve_q13(&cell, target), phase_cell_v_q13(&cell, target)}) {
                    ASSERT_LE(v_q13, PHASE_CELL_V_MAX_Q13);
                    ASSERT_GE(v_q13, -PHASE_CELL_V_MAX_Q13 - 1);
                    largest = std::max(
                        {largest, std::abs(phase_cell_torque(&cell, v_q13)), std::abs(phase_cell_flux(&cell, v_q13))});
                }
                phase_cell_distance_q4(&cell.torque, target);
                phase_cell_distance_q4(&cell.flux, target);
            }
            const int32_t u_q13 = phase_cell_u_q13(&cell, int32_t(random() % ((1u << 18) + 1)));
            largest = std::max({largest, std::abs(phase_cell_curve_at(&cell.torque, u_q13)),
                                std::abs(phase_cell_curve_at(&cell.flux, u_q13))});
        }
    }
    EXPECT_LT(largest, 1 << 30);
    EXPECT_GT(largest, 1 << 28);
}

TEST(PhaseCell, a_curve_is_evaluated_with_products_rounded_to_8_units_for_any_curve) {
    using wide_integer::any_up_to;
    std::mt19937 random(6);
    double worst_of_bound = 0.0;
    for (int i = 0; i < 200000; i++) {
        const int32_t middle = any_up_to(random, 1 << 30) - (1 << 29);
        const int32_t rise = any_up_to(random, 1 << 26) - (1 << 25);
        const int32_t curvature = any_up_to(random, 1 << 25) - (1 << 24);
        const int32_t x_q13 = any_up_to(random, 65535) - 32768;
        const double x = x_q13 / Q13, exact = middle + x * (rise + x * curvature);
        const double error = std::fabs(phase_cell_evaluate(middle, rise, curvature, x_q13) - exact);
        const double bound = 4.0 + 4.0 * std::fabs(x);
        ASSERT_LE(error, bound + 0.001) << middle << " " << rise << " " << curvature << " " << x_q13;
        worst_of_bound = std::max(worst_of_bound, error / bound);
    }
    EXPECT_GT(worst_of_bound, 0.8);
}

TEST(PhaseCell, a_divisor_is_the_rise_rounded_to_an_odd_multiple_of_256_units) {
    for (int32_t rise = -128; rise <= 1 << 25; rise += 1 + rise / 4096) {
        const int32_t divisor = phase_cell_divisor(rise);
        ASSERT_EQ(divisor % 2, 1) << rise;
        ASSERT_LE(std::abs(divisor * 256 - rise), 384) << rise;
    }
}

} // namespace
