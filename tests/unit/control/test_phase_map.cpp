// The firmware's torque and flux linkage of a phase: their interpolation against double precision, their inverses, and
// the tables themselves against the machine's magnetics that they were generated from. Built once a shipped machine.
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

#include "support/reference_models.h"

namespace {

constexpr uint32_t HALF_PITCH = 0x80000000u;
constexpr int32_t CURRENT_END_Q9 = PHASE_MAP_CURRENT_MAX_Q9;
constexpr uint32_t ROW_STEP = 1u << 17; // rows start at multiples
constexpr double Q29 = 536870912.0;

int32_t torque_q24(uint32_t angle, int32_t current_q9) {
    const phase_map_place_t place = phase_map_at(&machine_tables, angle);
    return phase_map_torque_q24(&place, current_q9);
}

int32_t flux_q29(uint32_t angle, int32_t current_q9) {
    const phase_map_place_t place = phase_map_at(&machine_tables, angle);
    return phase_map_flux_q29(&place, current_q9);
}

// A product's last place in N m and Wb.
const double TORQUE_PLACE = std::exp2(machine_tables.torque_format.result_shift) / twins::Q24;
const double FLUX_PLACE = std::exp2(machine_tables.flux_format.result_shift) / Q29;

constexpr int32_t column_q9(int32_t column) {
    return column << MACHINE_COLUMN_BITS;
}

// One of the two surfaces that the tables hold, and what a node's last place is in a result of so many fraction bits.
struct surface_t {
    int16_t (machine_column_t::*nodes)[MACHINE_ROWS];
    int8_t (machine_column_t::*bends)[MACHINE_ROWS - 1];
    machine_format_t machine_tables_t::*format;
    int result_bits;

    int node(int row, int column) const { return (machine_tables.column[column].*nodes)[row] + MACHINE_NODE_OFFSET; }
    double bend(int row, int column) const {
        return std::ldexp((machine_tables.column[column].*bends)[row], (machine_tables.*format).bend_shift);
    }
    // Q14 times Q9 times 2^15 less 32 bits.
    int fraction_bits() const { return result_bits + 32 - 15 - 9 - 14 - (machine_tables.*format).result_shift; }
};

constexpr surface_t TORQUE = {&machine_column_t::torque_node, &machine_column_t::torque_bend,
                              &machine_tables_t::torque_format, 24};
constexpr surface_t FLUX = {&machine_column_t::flux_node, &machine_column_t::flux_bend, &machine_tables_t::flux_format,
                            29};

int row_of(uint32_t distance) {
    int row = 0;
    while (row + 2 < MACHINE_ROWS && machine_tables.row[row + 1].start <= distance) {
        row++;
    }
    return row;
}

// The same tables in double precision, an angle of the second half pitch.
double twin(const surface_t &surface, uint32_t angle, double current_A) {
    const uint32_t distance = angle - HALF_PITCH;
    const int row = row_of(distance);
    const double start = machine_tables.row[row].start;
    const double u = (distance - start) / (machine_tables.row[row + 1].start - start);
    const int column = std::min(int(current_A / 2.0), MACHINE_COLUMNS - 2);
    double at_column[2];
    for (int i = 0; i < 2; i++) {
        const double low = surface.node(row, column + i), high = surface.node(row + 1, column + i);
        at_column[i] = low + u * (high - low) - u * (1.0 - u) * surface.bend(row, column + i);
    }
    const double value = at_column[0] + (current_A / 2.0 - column) * (at_column[1] - at_column[0]);
    return current_A * value / std::exp2(surface.fraction_bits());
}

class Magnetics {
  public:
    Magnetics() { magnetics_prepare(&model, &machine_plant.magnetics, machine_plant.rotor_poles); }

    // The machine's own, angle in 2^-32 pitch.
    magnetics_point_t at(uint32_t angle, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle / twins::TURN * 2.0 * twins::PI / machine_plant.rotor_poles, current_A,
                           &point);
        return point;
    }

  private:
    magnetics_model_t model;
};

TEST(PhaseMap, rows_rise_from_the_unaligned_to_the_aligned_position) {
    EXPECT_EQ(machine_tables.row[0].start, 0u);
    EXPECT_EQ(machine_tables.row[MACHINE_ROWS - 1].start, HALF_PITCH);
    for (int row = 0; row + 1 < MACHINE_ROWS; row++) {
        const uint64_t width = machine_tables.row[row + 1].start - uint64_t(machine_tables.row[row].start);
        EXPECT_GE(width, ROW_STEP);
        EXPECT_LE(width, HALF_PITCH);
        EXPECT_EQ(machine_tables.row[row].reciprocal, (uint64_t(1) << 47) / width);
    }
}

TEST(PhaseMap, cells_begin_in_their_row_and_the_search_takes_at_most_two_steps) {
    for (uint32_t cell = 0; cell < MACHINE_CELLS; cell++) {
        EXPECT_EQ(machine_tables.cell_row[cell], row_of(cell << MACHINE_CELL_BITS));
        EXPECT_LE(row_of((cell << MACHINE_CELL_BITS) + ((1u << MACHINE_CELL_BITS) - 1)),
                  machine_tables.cell_row[cell] + 2);
    }
}

TEST(PhaseMap, an_angle_s_place_is_the_nearest_fraction_of_its_row_and_never_above_one) {
    std::mt19937 random(8);
    double worst = 0.0;
    int32_t greatest = 0;
    const auto look = [&](uint32_t distance) {
        const phase_map_place_t place = phase_map_at(&machine_tables, HALF_PITCH + distance);
        const int row = row_of(distance);
        ASSERT_EQ(place.row, uint32_t(row));
        const auto fraction_q14 = int32_t(place.weights_q14 >> 16);
        ASSERT_EQ(int32_t(place.weights_q14 & 0xFFFF) + fraction_q14, 1 << 14);
        ASSERT_LE(fraction_q14, 1 << 14);
        const double start = machine_tables.row[row].start;
        const double u = (distance - start) / (machine_tables.row[row + 1].start - start);
        worst = std::max(worst, std::fabs(fraction_q14 - std::ldexp(u, 14)));
        greatest = std::max(greatest, fraction_q14);
    };
    for (int i = 0; i < 1000000; i++) {
        look(uint32_t(random()) >> 1);
    }
    for (int row = 0; row < MACHINE_ROWS; row++) {
        const uint32_t start = machine_tables.row[row].start;
        look(start);
        look(start - (row > 0 ? 1 : 0));
        look(std::min(start + 1, HALF_PITCH));
    }
    EXPECT_EQ(greatest, 1 << 14);
    EXPECT_LT(worst, 0.6);
    EXPECT_GT(worst, 0.45);
}

TEST(PhaseMap, torque_and_flux_are_those_of_the_tables_within_three_of_their_last_place) {
    std::mt19937 random(1);
    double torque_worst = 0.0, flux_worst = 0.0; // last places of the tables
    for (int i = 0; i < 1000000; i++) {
        const uint32_t angle = HALF_PITCH | uint32_t(random());
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9)) + 1;
        const double current_A = current_q9 / twins::Q9;
        const double torque_Nm = std::min(twin(TORQUE, angle, current_A), 128.0);
        // But for the last place of the product.
        const double torque_error = std::fabs(torque_q24(angle, current_q9) / twins::Q24 - torque_Nm) - TORQUE_PLACE;
        const double flux_error =
            std::fabs(flux_q29(angle, current_q9) / Q29 - twin(FLUX, angle, current_A)) - FLUX_PLACE;
        torque_worst = std::max(torque_worst, torque_error / current_A * std::exp2(TORQUE.fraction_bits()));
        flux_worst = std::max(flux_worst, flux_error / current_A * std::exp2(FLUX.fraction_bits()));
    }
    // The angle within a row is rounded to 14 bits, and in one row the torque may go through all of its 16.
    EXPECT_LT(torque_worst, 3.0);
    EXPECT_GT(torque_worst, 0.05);
    EXPECT_LT(flux_worst, 3.0);
    EXPECT_GT(flux_worst, 0.05);
}

TEST(PhaseMap, torque_and_flux_are_exact_at_every_node_of_the_tables) {
    for (int row = 0; row < MACHINE_ROWS; row++) {
        const uint32_t angle = HALF_PITCH + machine_tables.row[row].start; // of the last: 0, aligned
        for (int32_t column = 0; column + 1 < MACHINE_COLUMNS; column++) {
            const int32_t current_q9 = column_q9(column);
            const double current_A = current_q9 / twins::Q9;
            const double torque_Nm = current_A * TORQUE.node(row, column) / std::exp2(TORQUE.fraction_bits());
            ASSERT_NEAR(torque_q24(angle, current_q9) / twins::Q24 * (angle == 0 ? -1.0 : 1.0),
                        std::min(torque_Nm, 128.0), 1e-5);
            const double flux_Wb = current_A * FLUX.node(row, column) / std::exp2(FLUX.fraction_bits());
            ASSERT_NEAR(flux_q29(angle, current_q9) / Q29, flux_Wb, 2e-7);
        }
    }
}

// Greatest differences from the machine's formula, measured; the test allows 5 % more and 20 % less.
struct differences_t {
    double torque_10_Nm; // where the torque is 10 N m or less, up to 60 A
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

TEST(PhaseMap, differs_from_the_machine_s_formula_by_what_is_stated_here) {
    const Magnetics magnetics;
    differences_t worst{};
    for (uint32_t unit = 0; unit < HALF_PITCH / ROW_STEP; unit++) {
        // Between any two angles where a row could start.
        const uint32_t angle = HALF_PITCH + unit * ROW_STEP + ROW_STEP / 2;
        const phase_map_place_t place = phase_map_at(&machine_tables, angle);
        for (int32_t current_q9 = 256; current_q9 <= 60 * 512; current_q9 += 256) {
            const magnetics_point_t point = magnetics.at(angle, current_q9 / twins::Q9);
            const double torque_Nm = std::fabs(phase_map_torque_q24(&place, current_q9) / twins::Q24 - point.torque_Nm);
            const double flux_Wb = std::fabs(phase_map_flux_q29(&place, current_q9) / Q29 - point.flux_linkage_Wb);
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
        const uint32_t distance = 1 + uint32_t(random()) % (HALF_PITCH - 1);
        const uint32_t ahead = HALF_PITCH + distance, behind = HALF_PITCH - distance;
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9 + 1));
        const int32_t torque = torque_q24(ahead, current_q9), flux = flux_q29(ahead, current_q9);
        ASSERT_EQ(torque_q24(behind, current_q9), -torque);
        ASSERT_EQ(flux_q29(behind, current_q9), flux);
    }
}

TEST(PhaseMap, unaligned_and_aligned_positions_have_no_torque) {
    for (int32_t current_q9 = 0; current_q9 <= CURRENT_END_Q9; current_q9++) {
        ASSERT_EQ(torque_q24(HALF_PITCH, current_q9), 0);
        ASSERT_EQ(torque_q24(0, current_q9), 0);
        ASSERT_GE(torque_q24(UINT32_MAX, current_q9), 0);
        ASSERT_LE(torque_q24(UINT32_MAX, current_q9) / twins::Q24, 0.03);
    }
}

TEST(PhaseMap, flux_is_continuous_over_the_aligned_and_the_unaligned_position) {
    for (int32_t current_q9 = 0; current_q9 <= CURRENT_END_Q9; current_q9 += 100) {
        ASSERT_NEAR(flux_q29(0, current_q9) / Q29, flux_q29(UINT32_MAX, current_q9) / Q29, 1e-4);
        ASSERT_NEAR(flux_q29(0, current_q9) / Q29, flux_q29(1, current_q9) / Q29, 1e-4);
        ASSERT_EQ(flux_q29(HALF_PITCH - 1, current_q9), flux_q29(HALF_PITCH + 1, current_q9));
    }
}

TEST(PhaseMap, torque_and_flux_rise_with_the_current) {
    // Near the aligned position the torque hardly rises, less than its table's rounding.
    constexpr double FALL_Nm = 1e-5;
    std::mt19937 random(5);
    for (int i = 0; i < 300; i++) {
        const phase_map_place_t place = phase_map_at(&machine_tables, HALF_PITCH | uint32_t(random()));
        int32_t torque = 0, flux = 0;
        for (int32_t current_q9 = 1; current_q9 <= CURRENT_END_Q9; current_q9++) {
            const int32_t next_torque = phase_map_torque_q24(&place, current_q9);
            const int32_t next_flux = phase_map_flux_q29(&place, current_q9);
            ASSERT_GE(next_torque / twins::Q24, torque / twins::Q24 - FALL_Nm) << current_q9;
            ASSERT_GT(next_flux, flux) << current_q9;
            torque = std::max(torque, next_torque);
            flux = next_flux;
        }
    }
}

TEST(PhaseMap, current_is_held_within_the_tables) {
    const phase_map_place_t place = phase_map_at(&machine_tables, HALF_PITCH + HALF_PITCH / 2);
    for (const int32_t below : {0, -1, INT32_MIN}) {
        EXPECT_EQ(phase_map_torque_q24(&place, below), 0);
        EXPECT_EQ(phase_map_flux_q29(&place, below), 0);
    }
    for (const int32_t above : {CURRENT_END_Q9 + 1, INT32_MAX}) {
        EXPECT_EQ(phase_map_torque_q24(&place, above), phase_map_torque_q24(&place, CURRENT_END_Q9));
        EXPECT_EQ(phase_map_flux_q29(&place, above), phase_map_flux_q29(&place, CURRENT_END_Q9));
    }
    EXPECT_GT(phase_map_torque_q24(&place, CURRENT_END_Q9), 30 << 24);
    EXPECT_GT(phase_map_flux_q29(&place, CURRENT_END_Q9), int32_t(0.15 * Q29));
}

// The torque of a flux linkage: of the two currents that enclose it, drawn straight.
double torque_of_flux_Nm(const phase_map_place_t &place, int32_t flux) {
    int32_t below = 0, above = CURRENT_END_Q9;
    while (above - below > 1) {
        const int32_t middle = (below + above) / 2;
        (phase_map_flux_q29(&place, middle) <= flux ? below : above) = middle;
    }
    const double low = phase_map_flux_q29(&place, below), high = phase_map_flux_q29(&place, above);
    const double low_q24 = phase_map_torque_q24(&place, below), high_q24 = phase_map_torque_q24(&place, above);
    return (low_q24 + (flux - low) / (high - low) * (high_q24 - low_q24)) / twins::Q24;
}

TEST(PhaseMap, the_point_that_is_reached_has_the_torque_of_its_flux_linkage_within_2_millinewtonmetres) {
    std::mt19937 random(4);
    double worst = 0.0;
    int reached_count = 0, lowest_count = 0, highest_count = 0, limited_count = 0;
    for (int i = 0; i < 300000; i++) {
        const uint32_t angle = HALF_PITCH | uint32_t(random());
        const phase_map_place_t place = phase_map_at(&machine_tables, angle);
        const int32_t centre = phase_map_flux_q29(&place, int32_t(random() % (60 * 512)));
        const int32_t reach = int32_t(0.05 * Q29) >> (random() % 8);
        const phase_map_range_t range = {std::max(centre - reach, 0), centre + reach, 52 * 512};
        const int32_t wanted = int32_t(random() % (60u << 24)) >> (random() % 10);
        phase_map_point_t point = {uint32_t(random() % (MACHINE_COLUMNS - 1)), 0, 0};
        const bool reached = phase_map_reach(&machine_tables, angle, wanted, &range, &point);
        ASSERT_GE(point.flux_q29, range.lowest_q29);
        ASSERT_LE(point.flux_q29, range.highest_q29);
        const int32_t limit_q29 = phase_map_flux_q29(&place, range.current_limit_q9);
        const double slack = 1e-6 * Q29;
        if (reached) {
            ASSERT_EQ(point.torque_q24, wanted);
            reached_count++;
        } else if (point.flux_q29 == range.lowest_q29) {
            lowest_count++;
        } else if (point.flux_q29 == range.highest_q29) {
            highest_count++;
        } else {
            ASSERT_NEAR(point.flux_q29, limit_q29, slack) << "neither reached nor an end";
            limited_count++;
        }
        ASSERT_LE(point.flux_q29, std::max<double>(range.lowest_q29, limit_q29 + slack));
        if (point.flux_q29 < phase_map_flux_q29(&place, CURRENT_END_Q9)) {
            const double torque_Nm = point.torque_q24 / twins::Q24;
            worst = std::max(worst, std::fabs(torque_Nm - torque_of_flux_Nm(place, point.flux_q29)));
            // No end where the torque is on its other side.
            const double missing_Nm = wanted / twins::Q24 - torque_Nm;
            if (!reached) {
                ASSERT_TRUE(point.flux_q29 == range.lowest_q29 || missing_Nm > -2e-3);
                ASSERT_TRUE(point.flux_q29 != range.lowest_q29 || missing_Nm < 2e-3 ||
                            point.flux_q29 >= limit_q29 - slack);
            }
        }
    }
    EXPECT_LT(worst, 2e-3);
    EXPECT_GT(worst, 1e-5);
    for (const int count : {reached_count, lowest_count, highest_count, limited_count}) {
        EXPECT_GT(count, 1000);
    }
}

TEST(PhaseMap, no_torque_is_the_least_flux_linkage_also_where_no_current_makes_torque) {
    std::mt19937 random(11);
    for (int i = 0; i < 20000; i++) {
        // Every other one at the aligned position or close to it.
        const uint32_t angle = i % 2 == 0 ? ~(uint32_t(random()) >> (8 + i % 24)) : HALF_PITCH | uint32_t(random());
        const phase_map_place_t place = phase_map_at(&machine_tables, angle);
        const int32_t lowest = phase_map_flux_q29(&place, 512 + int32_t(random() % (40 * 512)));
        const phase_map_range_t range = {lowest, lowest + int32_t(0.05 * Q29), 52 * 512};
        for (const int32_t wanted : {0, -(1 << 24)}) {
            phase_map_point_t point = {uint32_t(random() % (MACHINE_COLUMNS - 1)), 0, 0};
            phase_map_reach(&machine_tables, angle, wanted, &range, &point);
            ASSERT_EQ(point.flux_q29, lowest) << angle;
        }
    }
}

TEST(PhaseMap, a_point_is_the_same_wherever_its_search_begins) {
    std::mt19937 random(9);
    for (int i = 0; i < 2000; i++) {
        // But near the ends, where the torque hardly rises.
        const uint32_t angle = HALF_PITCH + (1u << 26) + uint32_t(random()) % (HALF_PITCH - (1u << 27));
        const phase_map_place_t place = phase_map_at(&machine_tables, angle);
        const int32_t centre = phase_map_flux_q29(&place, int32_t(random() % (60 * 512)));
        const int32_t reach = int32_t(0.05 * Q29) >> (random() % 8);
        const phase_map_range_t range = {std::max(centre - reach, 0), centre + reach, 52 * 512};
        const int32_t wanted = int32_t(random() % (30u << 24));
        phase_map_point_t first = {0, 0, 0};
        const bool reached = phase_map_reach(&machine_tables, angle, wanted, &range, &first);
        for (uint32_t column = 1; column < MACHINE_COLUMNS - 1; column++) {
            phase_map_point_t point = {column, 0, 0};
            ASSERT_EQ(phase_map_reach(&machine_tables, angle, wanted, &range, &point), reached);
            ASSERT_EQ(point.column, first.column);
            ASSERT_EQ(point.flux_q29, first.flux_q29);
            ASSERT_EQ(point.torque_q24, first.torque_q24);
        }
    }
}

TEST(PhaseMap, a_slope_is_that_of_the_torque) {
    std::mt19937 random(10);
    constexpr uint32_t STEP = 1u << 12, TURN = 1u << 25;
    double worst = 0.0, largest = 0.0;
    for (int i = 0; i < 100000; i++) {
        const uint32_t angle = uint32_t(random());
        const uint32_t distance = angle < HALF_PITCH ? HALF_PITCH - angle : angle - HALF_PITCH;
        const int row = row_of(distance);
        const uint32_t width = machine_tables.row[row + 1].start - machine_tables.row[row].start;
        if (distance - machine_tables.row[row].start < STEP || machine_tables.row[row + 1].start - distance < STEP) {
            continue; // over a corner
        }
        const auto current_q9 = int32_t(random() % (40 * 512));
        const double current_A = current_q9 / twins::Q9;
        const auto forwards = [&](double d) { return twin(TORQUE, HALF_PITCH + uint32_t(d), current_A); };
        const double slope_Nm = (forwards(distance + STEP) - forwards(distance - STEP)) / (2.0 * STEP) * TURN;
        const double found_Nm = phase_map_torque_slope_q24(&machine_tables, angle, current_q9, TURN) / twins::Q24;
        largest = std::max(largest, std::fabs(slope_Nm));
        // The nodes are rounded, and of their difference over a narrow row more is asked for than it says.
        const double place_Nm = current_A / std::exp2(TORQUE.fraction_bits()) * TURN / width;
        worst = std::max(worst, std::fabs(found_Nm - slope_Nm) / (0.01 + place_Nm + 1e-3 * std::fabs(slope_Nm)));
    }
    EXPECT_GT(largest, 1.0);
    EXPECT_LT(worst, 1.0);
}

TEST(PhaseMap, what_a_format_cannot_hold_saturates) {
    static machine_tables_t strong = machine_tables;
    strong.torque_format.result_shift = 12;
    strong.flux_format.result_shift = 12;
    const phase_map_place_t ahead = phase_map_at(&strong, HALF_PITCH + HALF_PITCH / 2);
    const phase_map_place_t behind = phase_map_at(&strong, HALF_PITCH / 2);
    EXPECT_EQ(phase_map_torque_q24(&ahead, CURRENT_END_Q9), INT32_MAX);
    EXPECT_EQ(phase_map_torque_q24(&behind, CURRENT_END_Q9), -INT32_MAX);
    EXPECT_EQ(phase_map_flux_q29(&ahead, CURRENT_END_Q9), INT32_MAX);
    const phase_map_range_t anything = {0, INT32_MAX, CURRENT_END_Q9};
    phase_map_point_t point = {0, 0, 0};
    phase_map_reach(&strong, HALF_PITCH + HALF_PITCH / 2, INT32_MAX, &anything, &point);
    EXPECT_EQ(point.flux_q29, INT32_MAX);
}

TEST(PhaseMap, tables_full_of_noise_and_extremes_do_not_overflow) {
    std::mt19937 random(7);
    for (int tables = 0; tables < 20; tables++) {
        static machine_tables_t wild = machine_tables;
        for (machine_format_t *format : {&wild.torque_format, &wild.flux_format}) {
            format->bend_shift = uint8_t(tables % 3 * 4);
            format->result_shift = uint8_t(tables % 2 == 0 ? 12 : 0);
        }
        for (machine_column_t &column : wild.column) {
            for (auto *nodes : {&column.torque_node, &column.flux_node}) {
                for (int16_t &entry : *nodes) {
                    entry = random() % 2 == 0 ? INT16_MIN : INT16_MAX;
                }
            }
            for (auto *bends : {&column.torque_bend, &column.flux_bend}) {
                for (int8_t &entry : *bends) {
                    entry = random() % 2 == 0 ? INT8_MIN : INT8_MAX;
                }
            }
        }
        for (int i = 0; i < 20000; i++) {
            const phase_map_place_t place = phase_map_at(&wild, uint32_t(random()));
            const auto any = int32_t(uint32_t(random())) >> (random() % 24);
            phase_map_torque_q24(&place, any);
            phase_map_flux_q29(&place, any);
            const uint32_t angle = uint32_t(random()) | HALF_PITCH;
            phase_map_torque_slope_q24(&wild, angle, any, 1u << 26);
            const int32_t lowest = int32_t(uint32_t(random()) >> 1) >> (random() % 24);
            const int32_t above = int32_t(uint32_t(random()) >> 1) >> (random() % 24);
            const phase_map_range_t range = {lowest, above < INT32_MAX - lowest ? lowest + above : INT32_MAX,
                                             int32_t(random() % uint32_t(CURRENT_END_Q9))};
            phase_map_point_t point = {uint32_t(random() % (MACHINE_COLUMNS - 1)), 0, 0};
            phase_map_reach(&wild, angle, any, &range, &point);
            ASSERT_LE(point.column, uint32_t(MACHINE_COLUMNS - 2));
            ASSERT_GE(point.flux_q29, range.lowest_q29);
            ASSERT_LE(point.flux_q29, range.highest_q29);
        }
    }
}

} // namespace
