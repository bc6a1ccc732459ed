// Torque and flux linkage of a phase: interpolation against double precision, and the tables against the magnetics of
// the machine that they were generated from; the inverse is tested with the cell. One program per bundled machine.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <random>
#include <string>

#include <gtest/gtest.h>

extern "C" {
#include "control/phase_map.h"
#include "plant/machine.h"
}

#include "support/fixed_point.h"
#include "support/phase_map_results.h"

namespace {

using namespace fixed_point;
constexpr int32_t CURRENT_END_Q9 = PHASE_MAP_CURRENT_MAX_Q9;
constexpr uint32_t ROW_STEP = 1u << 17; // rows start at multiples of it

int32_t torque_q24(uint32_t angle, int32_t current_q9) {
    return phase_map_results::torque_q24(machine_tables, angle, current_q9);
}

int32_t flux_q29(uint32_t angle, int32_t current_q9) {
    return phase_map_results::flux_q29(machine_tables, angle, current_q9);
}

// LSB of an unscaled result in N m and Wb.
const double TORQUE_LSB = std::exp2(machine_tables.torque_format.result_shift) / Q24;
const double FLUX_LSB = std::exp2(machine_tables.flux_format.result_shift) / Q29;

constexpr int32_t column_q9(int32_t column) {
    return column << MACHINE_COLUMN_BITS;
}

// One of the two surfaces of the tables and the weight of a node's LSB in a result of `result_bits` fraction bits.
struct surface_t {
    unsigned first; // index of row 0, column 0
    machine_format_t machine_tables_t::*format;
    int result_bits;

    unsigned index(int row, int column) const {
        return first + unsigned(row) + unsigned(column) * MACHINE_TO_NEXT_COLUMN;
    }
    int node(int row, int column) const { return machine_tables.node[index(row, column)] + MACHINE_NODE_OFFSET; }
    double curvature(int row, int column) const {
        return std::ldexp(machine_tables.curvature[index(row, column)], (machine_tables.*format).curvature_shift);
    }
    // Q14 * Q9 * 2^15 / 2^32.
    int fraction_bits() const { return result_bits + 32 - 15 - 9 - 14 - (machine_tables.*format).result_shift; }
};

constexpr surface_t TORQUE = {0, &machine_tables_t::torque_format, 24};
constexpr surface_t FLUX = {MACHINE_TO_FLUX, &machine_tables_t::flux_format, 29};

int row_of(uint32_t distance) {
    int row = 0;
    while (row + 2 < MACHINE_ROWS && machine_tables.row[row + 1].start <= distance) {
        row++;
    }
    return row;
}

// Reference model: the same tables in double precision, for an angle from 2^31 on.
double table_value(const surface_t &surface, uint32_t angle, double current_A) {
    const uint32_t distance = angle - HALF_REV_Q32;
    const int row = row_of(distance);
    const double start = machine_tables.row[row].start;
    const double u = (distance - start) / (machine_tables.row[row + 1].start - start);
    const int column = std::min(int(current_A / 2.0), MACHINE_COLUMNS - 2);
    double at_column[2];
    for (int i = 0; i < 2; i++) {
        const double low = surface.node(row, column + i), high = surface.node(row + 1, column + i);
        at_column[i] = low + u * (high - low) - u * (1.0 - u) * surface.curvature(row, column + i);
    }
    const double value = at_column[0] + (current_A / 2.0 - column) * (at_column[1] - at_column[0]);
    return current_A * value / std::exp2(surface.fraction_bits());
}

class Magnetics {
  public:
    Magnetics() { magnetics_prepare(&model, &machine_plant.magnetics, machine_plant.rotor_poles); }

    // Exact magnetics of the machine, angle in 2^-32 electrical rev.
    magnetics_point_t at(uint32_t angle, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle / REV * 2.0 * PI / machine_plant.rotor_poles, current_A, &point);
        return point;
    }

  private:
    magnetics_model_t model;
};

TEST(PhaseMap, rows_ascend_from_the_unaligned_to_the_aligned_position) {
    EXPECT_EQ(machine_tables.row[0].start, 0u);
    EXPECT_EQ(machine_tables.row[MACHINE_ROWS - 1].start, HALF_REV_Q32);
    for (int row = 0; row + 1 < MACHINE_ROWS; row++) {
        const uint64_t width = machine_tables.row[row + 1].start - uint64_t(machine_tables.row[row].start);
        EXPECT_GE(width, ROW_STEP);
        EXPECT_LE(width, HALF_REV_Q32);
        EXPECT_EQ(machine_tables.row[row].reciprocal, (uint64_t(1) << 46) / width);
    }
}

TEST(PhaseMap, the_last_row_has_neither_curvature_nor_reciprocal) {
    const int last = MACHINE_ROWS - 1;
    EXPECT_EQ(machine_tables.row[last].reciprocal, 0);
    for (int column = 0; column < MACHINE_COLUMNS; column++) {
        EXPECT_EQ(TORQUE.curvature(last, column), 0.0);
        EXPECT_EQ(FLUX.curvature(last, column), 0.0);
    }
}

TEST(PhaseMap, angle_bins_begin_in_their_row_and_at_most_two_rows_begin_within) {
    for (uint32_t bin = 0; bin < MACHINE_ANGLE_BINS; bin++) {
        const uint32_t begin = bin << MACHINE_ANGLE_BIN_BITS, last = begin + ((1u << MACHINE_ANGLE_BIN_BITS) - 1);
        EXPECT_EQ(machine_tables.angle_bin_row[bin], row_of(begin));
        EXPECT_LE(row_of(last) - row_of(begin), 2) << "the steps of a lookup";
    }
}

TEST(PhaseMap, a_lookup_finds_its_row_where_two_begin_within_an_angle_bin) {
    static machine_tables_t dense = machine_tables;
    constexpr uint32_t BIN = 1u << MACHINE_ANGLE_BIN_BITS;
    for (uint32_t row = 1; row + 1 < MACHINE_ROWS; row++) { // 1 and 2 in bin 0, 3 and 4 in bin 1, ...
        dense.row[row].start = (row - 1) / 2 * BIN + (row % 2 == 1 ? BIN / 3 : BIN - 1);
    }
    for (uint32_t row = 0; row + 1 < MACHINE_ROWS; row++) {
        const uint32_t width = dense.row[row + 1].start - dense.row[row].start;
        dense.row[row].reciprocal = int32_t((uint64_t(1) << 46) / width);
    }
    for (uint32_t bin = 0; bin < MACHINE_ANGLE_BINS; bin++) {
        dense.angle_bin_row[bin] = uint8_t(std::min(2 * bin, MACHINE_ROWS - 2u));
    }
    const auto expected_row = [](uint32_t distance) {
        uint32_t row = 0;
        while (dense.row[row + 1].start <= distance) {
            row++;
        }
        return row;
    };
    for (uint32_t bin = 0; bin < MACHINE_ANGLE_BINS; bin++) {
        for (const uint32_t within : {0u, BIN / 3 - 1, BIN / 3, BIN - 2, BIN - 1}) {
            const uint32_t distance = bin * BIN + within;
            ASSERT_EQ(phase_map_lookup(&dense, distance).row, expected_row(distance)) << bin << ", " << within;
        }
    }
}

TEST(PhaseMap, the_distance_is_that_from_the_unaligned_position_and_below_half_a_revolution) {
    std::mt19937 random(12);
    for (int i = 0; i < 100000; i++) {
        const auto angle = uint32_t(random());
        const uint32_t expected = angle == 0             ? HALF_REV_Q32 - 1
                                  : angle < HALF_REV_Q32 ? HALF_REV_Q32 - angle
                                                         : angle - HALF_REV_Q32;
        ASSERT_EQ(phase_map_distance(angle), expected) << angle;
        ASSERT_EQ(phase_map_mirrored(angle), angle < HALF_REV_Q32);
    }
    EXPECT_EQ(phase_map_distance(HALF_REV_Q32), 0u);
    EXPECT_EQ(phase_map_distance(0), HALF_REV_Q32 - 1) << "aligned, 1 LSB before it";
    EXPECT_EQ(phase_map_distance(UINT32_MAX), HALF_REV_Q32 - 1);
    EXPECT_EQ(phase_map_distance(1), HALF_REV_Q32 - 1);
}

TEST(PhaseMap, a_lookup_is_the_nearest_fraction_of_its_row_and_never_above_one) {
    std::mt19937 random(8);
    double worst = 0.0;
    int32_t maximum = 0;
    const auto look = [&](uint32_t distance) {
        const phase_map_lookup_t lookup = phase_map_lookup(&machine_tables, distance);
        const int row = row_of(distance);
        ASSERT_EQ(lookup.row, uint32_t(row));
        const auto fraction_q14 = int32_t(lookup.weights_q14 >> 16);
        ASSERT_EQ(int32_t(lookup.weights_q14 & 0xFFFF) + fraction_q14, 1 << 14);
        ASSERT_LE(fraction_q14, 1 << 14);
        const double start = machine_tables.row[row].start;
        const double u = (distance - start) / (machine_tables.row[row + 1].start - start);
        worst = std::max(worst, std::fabs(fraction_q14 - std::ldexp(u, 14)));
        maximum = std::max(maximum, fraction_q14);
    };
    for (int i = 0; i < 1000000; i++) {
        look(uint32_t(random()) >> 1);
    }
    for (int row = 0; row < MACHINE_ROWS; row++) {
        const uint32_t start = machine_tables.row[row].start;
        look(std::min(start, HALF_REV_Q32 - 1));
        look(start - (row > 0 ? 1 : 0));
        look(std::min(start + 1, HALF_REV_Q32 - 1));
    }
    EXPECT_EQ(maximum, 1 << 14);
    EXPECT_LT(worst, 0.6);
    EXPECT_GT(worst, 0.45);
}

TEST(PhaseMap, torque_and_flux_equal_the_tables_within_three_lsb) {
    std::mt19937 random(1);
    double torque_worst = 0.0, flux_worst = 0.0; // LSB of the tables
    for (int i = 0; i < 1000000; i++) {
        const uint32_t angle = HALF_REV_Q32 | uint32_t(random());
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9)) + 1;
        const double current_A = current_q9 / Q9;
        const double torque_Nm = std::min(table_value(TORQUE, angle, current_A), 128.0);
        // Apart from the LSB of the unscaled result.
        const double torque_error = std::fabs(torque_q24(angle, current_q9) / Q24 - torque_Nm) - TORQUE_LSB;
        const double flux_error =
            std::fabs(flux_q29(angle, current_q9) / Q29 - table_value(FLUX, angle, current_A)) - FLUX_LSB;
        torque_worst = std::max(torque_worst, torque_error / current_A * std::exp2(TORQUE.fraction_bits()));
        flux_worst = std::max(flux_worst, flux_error / current_A * std::exp2(FLUX.fraction_bits()));
    }
    // The angle within a row is rounded to 14 bits; the torque may change by all of its 16 bits within one row.
    EXPECT_LT(torque_worst, 3.0);
    EXPECT_GT(torque_worst, 0.05);
    EXPECT_LT(flux_worst, 3.0);
    EXPECT_GT(flux_worst, 0.05);
}

TEST(PhaseMap, torque_and_flux_are_exact_at_every_node_of_the_tables) {
    for (int row = 0; row < MACHINE_ROWS; row++) {
        // Angle of the last row: 0, aligned, which counts as 1 LSB before.
        const uint32_t angle = HALF_REV_Q32 + machine_tables.row[row].start;
        for (int32_t column = 0; column + 1 < MACHINE_COLUMNS; column++) {
            const int32_t current_q9 = column_q9(column);
            const double current_A = current_q9 / Q9;
            const double torque_Nm = current_A * TORQUE.node(row, column) / std::exp2(TORQUE.fraction_bits());
            ASSERT_NEAR(torque_q24(angle, current_q9) / Q24 * (angle == 0 ? -1.0 : 1.0), std::min(torque_Nm, 128.0),
                        1e-5);
            const double flux_Wb = current_A * FLUX.node(row, column) / std::exp2(FLUX.fraction_bits());
            ASSERT_NEAR(flux_q29(angle, current_q9) / Q29, flux_Wb, 2e-7);
        }
    }
}

// Largest errors against the formula of the machine, measured; the test allows 5 % more and 20 % less.
struct differences_t {
    double torque_10_Nm; // where the torque is at most 10 N m, up to 60 A
    double torque_Nm;    // anywhere up to 60 A
    double flux_Wb;      // up to 60 A
    double current_A;    // flux divided by the incremental inductance, up to 20 A
};

const std::map<std::string, differences_t> DIFFERENCES = {
    {"finite_element", {21.5e-3, 21.5e-3, 410e-6, 52e-3}},
    {"saturating", {3.9e-3, 3.9e-3, 116e-6, 13.3e-3}},
    {"linear_cosine", {3.3e-3, 4.1e-3, 63.8e-6, 4.6e-3}},
    {"linear_trapezoid", {9.3e-3, 9.3e-3, 20.7e-6, 7.8e-3}},
};

TEST(PhaseMap, errors_against_the_formula_of_the_machine_are_those_stated_here) {
    const Magnetics magnetics;
    differences_t worst{};
    for (uint32_t unit = 0; unit < HALF_REV_Q32 / ROW_STEP; unit++) {
        // Midway between adjacent angles at which a row can start.
        const uint32_t angle = HALF_REV_Q32 + unit * ROW_STEP + ROW_STEP / 2;
        for (int32_t current_q9 = 256; current_q9 <= 60 * 512; current_q9 += 256) {
            const magnetics_point_t point = magnetics.at(angle, current_q9 / Q9);
            const double torque_Nm = std::fabs(torque_q24(angle, current_q9) / Q24 - point.torque_Nm);
            const double flux_Wb = std::fabs(flux_q29(angle, current_q9) / Q29 - point.flux_linkage_Wb);
            worst.torque_Nm = std::max(worst.torque_Nm, torque_Nm);
            worst.flux_Wb = std::max(worst.flux_Wb, flux_Wb);
            if (point.torque_Nm <= 10.0) {
                worst.torque_10_Nm = std::max(worst.torque_10_Nm, torque_Nm);
            }
            if (current_q9 <= 20 * 512) {
                worst.current_A = std::max(worst.current_A, flux_Wb / point.incremental_inductance_H);
            }
        }
    }
    const auto stated = DIFFERENCES.find(machine_plant.name);
    ASSERT_NE(stated, DIFFERENCES.end()) << machine_plant.name;
    const auto expect = [](const char *what, double measured, double expected) {
        EXPECT_LT(measured, 1.05 * expected) << what;
        EXPECT_GT(measured, 0.8 * expected) << what;
    };
    expect("torque up to 10 N m", worst.torque_10_Nm, stated->second.torque_10_Nm);
    expect("torque", worst.torque_Nm, stated->second.torque_Nm);
    expect("flux linkage", worst.flux_Wb, stated->second.flux_Wb);
    expect("current", worst.current_A, stated->second.current_A);
}

TEST(PhaseMap, is_mirror_symmetric_about_the_unaligned_position) {
    std::mt19937 random(2);
    for (int i = 0; i < 200000; i++) {
        const uint32_t distance = 1 + uint32_t(random()) % (HALF_REV_Q32 - 1);
        const uint32_t second_half = HALF_REV_Q32 + distance, first_half = HALF_REV_Q32 - distance;
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9 + 1));
        const int32_t torque = phase_map_torque(&machine_tables, second_half, current_q9);
        const int32_t flux = flux_q29(second_half, current_q9);
        ASSERT_EQ(phase_map_torque(&machine_tables, first_half, current_q9), -torque);
        ASSERT_EQ(flux_q29(first_half, current_q9), flux);
    }
}

TEST(PhaseMap, unaligned_and_aligned_positions_have_no_torque) {
    for (int32_t current_q9 = 0; current_q9 <= CURRENT_END_Q9; current_q9++) {
        ASSERT_EQ(torque_q24(HALF_REV_Q32, current_q9), 0);
        ASSERT_EQ(torque_q24(0, current_q9), 0);
        ASSERT_GE(torque_q24(UINT32_MAX, current_q9), 0);
        ASSERT_LE(torque_q24(UINT32_MAX, current_q9) / Q24, 0.03);
    }
}

TEST(PhaseMap, flux_is_continuous_over_the_aligned_and_the_unaligned_position) {
    for (int32_t current_q9 = 0; current_q9 <= CURRENT_END_Q9; current_q9 += 100) {
        ASSERT_NEAR(flux_q29(0, current_q9) / Q29, flux_q29(UINT32_MAX, current_q9) / Q29, 1e-4);
        ASSERT_NEAR(flux_q29(0, current_q9) / Q29, flux_q29(1, current_q9) / Q29, 1e-4);
        ASSERT_EQ(flux_q29(HALF_REV_Q32 - 1, current_q9), flux_q29(HALF_REV_Q32 + 1, current_q9));
    }
}

TEST(PhaseMap, torque_and_flux_increase_with_the_current) {
    // Near the aligned position the torque increases by less than the rounding of its table.
    constexpr double FALL_Nm = 1e-5;
    std::mt19937 random(5);
    for (int i = 0; i < 300; i++) {
        const uint32_t angle = HALF_REV_Q32 | uint32_t(random());
        int32_t torque = 0, flux = 0;
        for (int32_t current_q9 = 1; current_q9 <= CURRENT_END_Q9; current_q9++) {
            const int32_t next_torque = torque_q24(angle, current_q9);
            const int32_t next_flux = flux_q29(angle, current_q9);
            ASSERT_GE(next_torque / Q24, torque / Q24 - FALL_Nm) << current_q9;
            ASSERT_GT(next_flux, flux) << current_q9;
            torque = std::max(torque, next_torque);
            flux = next_flux;
        }
    }
}

TEST(PhaseMap, the_largest_current_is_just_below_the_last_column) {
    EXPECT_EQ(CURRENT_END_Q9, 80 * 512 - 1);
    const uint32_t angle = HALF_REV_Q32 + HALF_REV_Q32 / 2;
    EXPECT_EQ(torque_q24(angle, 0), 0);
    EXPECT_EQ(flux_q29(angle, 0), 0);
    EXPECT_GT(torque_q24(angle, CURRENT_END_Q9), 30 << 24);
    EXPECT_GT(flux_q29(angle, CURRENT_END_Q9), int32_t(0.15 * Q29));
}

TEST(PhaseMap, a_slope_equals_the_difference_quotient_of_the_torque) {
    std::mt19937 random(10);
    constexpr uint32_t STEP = 1u << 12, ANGLE_STEP = 1u << 25;
    double worst = 0.0, largest = 0.0;
    for (int i = 0; i < 100000; i++) {
        const uint32_t angle = uint32_t(random());
        const uint32_t distance = angle < HALF_REV_Q32 ? HALF_REV_Q32 - angle : angle - HALF_REV_Q32;
        const int row = row_of(distance);
        const uint32_t width = machine_tables.row[row + 1].start - machine_tables.row[row].start;
        if (distance - machine_tables.row[row].start < STEP || machine_tables.row[row + 1].start - distance < STEP) {
            continue; // across a corner
        }
        const auto current_q9 = int32_t(random() % (40 * 512));
        const double current_A = current_q9 / Q9;
        const auto torque_Nm = [&](double d) { return table_value(TORQUE, HALF_REV_Q32 + uint32_t(d), current_A); };
        const double slope_Nm = (torque_Nm(distance + STEP) - torque_Nm(distance - STEP)) / (2.0 * STEP) * ANGLE_STEP;
        const double found_Nm = phase_map_torque_slope_q24(&machine_tables, angle, current_q9, ANGLE_STEP) / Q24;
        largest = std::max(largest, std::fabs(slope_Nm));
        // The rounding of the nodes weighs more in narrow rows.
        const double lsb_Nm = current_A / std::exp2(TORQUE.fraction_bits()) * ANGLE_STEP / width;
        worst = std::max(worst, std::fabs(found_Nm - slope_Nm) / (0.01 + lsb_Nm + 1e-3 * std::fabs(slope_Nm)));
    }
    EXPECT_GT(largest, 1.0);
    EXPECT_LT(worst, 1.0);
}

TEST(PhaseMap, results_beyond_their_format_saturate) {
    static machine_tables_t strong = machine_tables;
    strong.torque_format.result_shift = 12;
    strong.flux_format.result_shift = 12;
    constexpr int32_t LAST_UNIT = INT32_MAX - 4095;
    EXPECT_EQ(phase_map_results::torque_q24(strong, HALF_REV_Q32 + HALF_REV_Q32 / 2, CURRENT_END_Q9), LAST_UNIT);
    EXPECT_EQ(phase_map_results::torque_q24(strong, HALF_REV_Q32 / 2, CURRENT_END_Q9), INT32_MIN);
    EXPECT_EQ(phase_map_results::flux_q29(strong, HALF_REV_Q32 + HALF_REV_Q32 / 2, CURRENT_END_Q9), LAST_UNIT);
}

TEST(PhaseMap, units_become_the_format_exactly_or_saturate) {
    for (unsigned shift = 0; shift <= 12; shift++) {
        const machine_format_t format = {.curvature_shift = 0, .result_shift = uint8_t(shift)};
        const int64_t limit = int64_t(1) << (31 - shift);
        for (const int64_t units : {int64_t(0), int64_t(1), int64_t(-1), int64_t(12345), limit - 1, -limit, limit,
                                    -limit - 1, int64_t(INT32_MAX), int64_t(INT32_MIN)}) {
            if (units > INT32_MAX || units < INT32_MIN) {
                continue;
            }
            const int64_t expected = std::clamp(units, -limit, limit - 1) * (int64_t(1) << shift);
            ASSERT_EQ(phase_map_scale(&format, int32_t(units)), expected) << units << " << " << shift;
        }
    }
}

TEST(PhaseMap, tables_of_extreme_entries_do_not_overflow) {
    std::mt19937 random(7);
    int32_t largest = 0;
    for (int tables = 0; tables < 20; tables++) {
        static machine_tables_t extreme = machine_tables;
        for (machine_format_t *format : {&extreme.torque_format, &extreme.flux_format}) {
            format->curvature_shift = uint8_t(tables % 3 * 4);
            format->result_shift = uint8_t(tables % 2 == 0 ? 12 : 0);
        }
        for (int16_t &entry : extreme.node) {
            entry = random() % 2 == 0 ? INT16_MIN : INT16_MAX;
        }
        for (int8_t &entry : extreme.curvature) {
            entry = random() % 2 == 0 ? INT8_MIN : INT8_MAX;
        }
        for (int i = 0; i < 20000; i++) {
            const auto angle = uint32_t(random());
            const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9 + 1)) >> (random() % 16);
            const int32_t torque = phase_map_torque(&extreme, angle, current_q9);
            const int32_t flux = phase_map_results::flux_units(extreme, angle, current_q9);
            phase_map_torque_slope_q24(&extreme, angle, current_q9, 1u << 26);
            phase_map_scale(&extreme.torque_format, torque);
            largest = std::max({largest, std::abs(torque), std::abs(flux)});
        }
    }
    // So that the sum of four phases fits.
    EXPECT_LT(largest, 1 << 29);
    EXPECT_GT(largest, 1 << 28);
}

TEST(PhaseMap, flux_of_a_current_below_0_is_that_of_none) {
    for (const uint32_t distance : {0u, 1u << 30, (1u << 31) - 1}) {
        for (const int32_t current_q9 : {-1, -1 << 12, -CURRENT_END_Q9, INT32_MIN}) {
            EXPECT_EQ(phase_map_flux_q29(&machine_tables, distance, current_q9), 0) << distance << " " << current_q9;
        }
    }
}

} // namespace
