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

#include "twins.h"

namespace {

constexpr uint32_t HALF_PITCH = 0x80000000u;
constexpr int32_t CURRENT_END_Q9 = PHASE_MAP_CURRENT_MAX_Q9;
constexpr int FINE = MACHINE_FINE_COLUMNS;
constexpr double Q29 = 536870912.0;

int32_t torque_q24(uint32_t angle, int32_t current_q9) {
    const phase_map_place_t place = phase_map_at(&machine_tables, angle);
    return phase_map_torque_q24(&place, current_q9);
}

int32_t flux_q29(uint32_t angle, int32_t current_q9) {
    const phase_map_place_t place = phase_map_at(&machine_tables, angle);
    return phase_map_flux_q29(&place, current_q9);
}

// Current of a column.
constexpr double column_A(int column) {
    return column < FINE ? 2.0 * column : 2.0 * FINE + 4.0 * (column - FINE);
}

// The same tables in double precision, an angle of the second half pitch.
double twin(const machine_surface_t &surface, uint32_t angle, double current_A) {
    const double distance = (angle - HALF_PITCH) / double(1 << MACHINE_ROW_BITS);
    int row = 0;
    while (machine_tables.row_start[row + 1] <= distance) {
        row++;
    }
    const double start = machine_tables.row_start[row];
    const double u = (distance - start) / (machine_tables.row_start[row + 1] - start);
    const int first = current_A < column_A(FINE)
                          ? std::clamp(int(current_A / 2.0) - 1, 0, FINE - 3)
                          : std::clamp(int((current_A - column_A(FINE)) / 4.0) + FINE - 1, FINE, MACHINE_COLUMNS - 4);
    double sum = 0.0;
    for (int a = first; a < first + 4; a++) {
        double weight = 1.0; // Lagrange
        for (int b = first; b < first + 4; b++) {
            weight *= a == b ? 1.0 : (current_A - column_A(b)) / (column_A(a) - column_A(b));
        }
        const double low = surface.node[row][a], high = surface.node[row + 1][a];
        sum += weight * (low + u * (high - low) - u * (1.0 - u) * surface.bend[row][a]);
    }
    return current_A * sum / std::exp2(surface.fraction_bits);
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
    EXPECT_EQ(machine_tables.row_start[0], 0);
    EXPECT_EQ(machine_tables.row_start[MACHINE_ROWS - 1], HALF_PITCH >> MACHINE_ROW_BITS);
    for (int row = 0; row + 1 < MACHINE_ROWS; row++) {
        EXPECT_LT(machine_tables.row_start[row], machine_tables.row_start[row + 1]);
    }
}

TEST(PhaseMap, torque_and_flux_are_those_of_the_tables_within_two_of_their_last_place) {
    std::mt19937 random(1);
    const machine_surface_t &torque = machine_tables.torque_per_ampere;
    const machine_surface_t &flux = machine_tables.flux_per_ampere;
    double torque_worst = 0.0, flux_worst = 0.0; // last places of the tables
    for (int i = 0; i < 1000000; i++) {
        const uint32_t angle = HALF_PITCH | uint32_t(random());
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9)) + 1;
        const double current_A = current_q9 / twins::Q9;
        const double torque_Nm = std::min(twin(torque, angle, current_A), 128.0);
        // But for the last place of the result.
        const double torque_error = std::fabs(torque_q24(angle, current_q9) / twins::Q24 - torque_Nm) - 1 / twins::Q24;
        const double flux_error = std::fabs(flux_q29(angle, current_q9) / Q29 - twin(flux, angle, current_A)) - 1 / Q29;
        torque_worst = std::max(torque_worst, torque_error / current_A * std::exp2(torque.fraction_bits));
        flux_worst = std::max(flux_worst, flux_error / current_A * std::exp2(flux.fraction_bits));
    }
    // The angle within a row is truncated to 15 bits, and in one row the torque may go through all of its 16.
    EXPECT_LT(torque_worst, 2.0);
    EXPECT_GT(torque_worst, 0.05);
    EXPECT_LT(flux_worst, 2.0);
    EXPECT_GT(flux_worst, 0.05);
}

TEST(PhaseMap, torque_and_flux_are_exact_at_every_node_of_the_tables) {
    for (uint32_t row = 0; row + 1 < MACHINE_ROWS; row++) {
        const uint32_t angle = HALF_PITCH + (uint32_t(machine_tables.row_start[row]) << MACHINE_ROW_BITS);
        for (int32_t column = 0; column < MACHINE_COLUMNS; column++) {
            const double current_A = column_A(column);
            const auto current_q9 = int32_t(current_A * twins::Q9);
            const machine_surface_t &torque = machine_tables.torque_per_ampere;
            const double torque_Nm = current_A * torque.node[row][column] / std::exp2(torque.fraction_bits);
            ASSERT_NEAR(torque_q24(angle, current_q9) / twins::Q24, std::min(torque_Nm, 128.0), 1e-5);
            const machine_surface_t &flux = machine_tables.flux_per_ampere;
            const double flux_Wb = current_A * flux.node[row][column] / std::exp2(flux.fraction_bits);
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
    {"finite_element", {7.8e-3, 9.9e-3, 94.6e-6, 7.3e-3}},
    {"saturating", {0.40e-3, 0.50e-3, 16.0e-6, 4.5e-3}},
    {"linear_cosine", {1.18e-3, 1.36e-3, 63.8e-6, 4.6e-3}},
    {"linear_trapezoid", {9.3e-3, 9.3e-3, 15.8e-6, 5.0e-3}},
};

TEST(PhaseMap, differs_from_the_machine_s_formula_by_what_is_stated_here) {
    const Magnetics magnetics;
    differences_t worst{};
    for (uint32_t unit = 0; unit < HALF_PITCH >> MACHINE_ROW_BITS; unit++) {
        // Between any two angles where a row could start.
        const uint32_t angle = HALF_PITCH + (unit << MACHINE_ROW_BITS) + (1u << (MACHINE_ROW_BITS - 1));
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
        const phase_map_place_t place_ahead = phase_map_at(&machine_tables, ahead);
        const phase_map_place_t place_behind = phase_map_at(&machine_tables, behind);
        ASSERT_EQ(phase_map_current_of_torque_q9(&place_behind, -torque),
                  phase_map_current_of_torque_q9(&place_ahead, torque));
        ASSERT_EQ(phase_map_current_of_flux_q9(&place_behind, flux), phase_map_current_of_flux_q9(&place_ahead, flux));
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

TEST(PhaseMap, current_and_torque_are_each_other_s_inverse) {
    std::mt19937 random(3);
    for (int i = 0; i < 300000; i++) {
        const phase_map_place_t place = phase_map_at(&machine_tables, HALF_PITCH | uint32_t(random()));
        const int32_t wanted = int32_t(random() % (60u << 24)) >> (random() % 20);
        const int32_t current_q9 = phase_map_current_of_torque_q9(&place, wanted);
        ASSERT_GE(current_q9, 0);
        ASSERT_LE(current_q9, CURRENT_END_Q9);
        ASSERT_LE(phase_map_torque_q24(&place, current_q9), wanted);
        if (current_q9 < CURRENT_END_Q9) {
            ASSERT_GE(phase_map_torque_q24(&place, current_q9 + 1), wanted);
        }
    }
}

TEST(PhaseMap, current_and_flux_are_each_other_s_inverse) {
    std::mt19937 random(4);
    for (int i = 0; i < 300000; i++) {
        const phase_map_place_t place = phase_map_at(&machine_tables, uint32_t(random()));
        const int32_t wanted = int32_t(uint32_t(random()) >> 1) >> (random() % 20);
        const int32_t current_q9 = phase_map_current_of_flux_q9(&place, wanted);
        ASSERT_GE(current_q9, 0);
        ASSERT_LE(current_q9, CURRENT_END_Q9);
        ASSERT_LE(phase_map_flux_q29(&place, current_q9), wanted);
        if (current_q9 < CURRENT_END_Q9) {
            ASSERT_GE(phase_map_flux_q29(&place, current_q9 + 1), wanted);
        }
        // And back: the current that made a flux linkage is found again.
        const auto made_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9));
        const int32_t found_q9 = phase_map_current_of_flux_q9(&place, phase_map_flux_q29(&place, made_q9));
        ASSERT_LE(found_q9, made_q9);
        ASSERT_GE(found_q9, made_q9 - 1);
    }
}

TEST(PhaseMap, nothing_wanted_or_of_the_wrong_sign_needs_no_current_and_too_much_the_largest) {
    std::mt19937 random(6);
    for (int i = 0; i < 1000; i++) {
        const phase_map_place_t ahead = phase_map_at(&machine_tables, HALF_PITCH | uint32_t(random()));
        const phase_map_place_t behind = phase_map_at(&machine_tables, 1 + uint32_t(random()) % (HALF_PITCH - 1));
        for (const int32_t none : {0, -1, INT32_MIN}) {
            EXPECT_EQ(phase_map_current_of_torque_q9(&ahead, none), 0);
            EXPECT_EQ(phase_map_current_of_flux_q9(&ahead, none), 0);
            EXPECT_EQ(phase_map_current_of_flux_q9(&behind, none), 0);
        }
        for (const int32_t none : {0, 1, INT32_MAX}) {
            EXPECT_EQ(phase_map_current_of_torque_q9(&behind, none), 0);
        }
        EXPECT_EQ(phase_map_current_of_flux_q9(&ahead, INT32_MAX), CURRENT_END_Q9);
    }
    const phase_map_place_t unaligned = phase_map_at(&machine_tables, HALF_PITCH);
    EXPECT_EQ(phase_map_current_of_torque_q9(&unaligned, 1), CURRENT_END_Q9);
    EXPECT_EQ(phase_map_current_of_torque_q9(&unaligned, INT32_MAX), CURRENT_END_Q9);
}

TEST(PhaseMap, what_a_format_cannot_hold_saturates) {
    static machine_tables_t strong = machine_tables;
    strong.torque_per_ampere.fraction_bits = 6;
    strong.flux_per_ampere.fraction_bits = 11;
    const phase_map_place_t ahead = phase_map_at(&strong, HALF_PITCH + HALF_PITCH / 2);
    const phase_map_place_t behind = phase_map_at(&strong, HALF_PITCH / 2);
    EXPECT_EQ(phase_map_torque_q24(&ahead, CURRENT_END_Q9), INT32_MAX);
    EXPECT_EQ(phase_map_torque_q24(&behind, CURRENT_END_Q9), -INT32_MAX);
    EXPECT_EQ(phase_map_flux_q29(&ahead, CURRENT_END_Q9), INT32_MAX);
    EXPECT_LT(phase_map_current_of_torque_q9(&ahead, INT32_MAX), CURRENT_END_Q9);
    EXPECT_LT(phase_map_current_of_flux_q9(&ahead, INT32_MAX), CURRENT_END_Q9);
}

TEST(PhaseMap, tables_full_of_noise_and_extremes_do_not_overflow) {
    std::mt19937 random(7);
    for (int tables = 0; tables < 20; tables++) {
        static machine_tables_t wild = machine_tables;
        for (machine_surface_t *surface : {&wild.torque_per_ampere, &wild.flux_per_ampere}) {
            surface->fraction_bits = uint8_t(tables % 2 == 0 ? 11 : 30);
            for (auto &row : surface->node) {
                for (uint16_t &entry : row) {
                    entry = random() % 2 == 0 ? 0 : UINT16_MAX;
                }
            }
            for (auto &row : surface->bend) {
                for (int16_t &entry : row) {
                    entry = random() % 2 == 0 ? INT16_MIN : INT16_MAX;
                }
            }
        }
        for (int i = 0; i < 20000; i++) {
            const phase_map_place_t place = phase_map_at(&wild, uint32_t(random()));
            const auto any = int32_t(uint32_t(random())) >> (random() % 24);
            phase_map_torque_q24(&place, any);
            phase_map_flux_q29(&place, any);
            for (const int32_t current_q9 :
                 {phase_map_current_of_torque_q9(&place, any), phase_map_current_of_flux_q9(&place, any)}) {
                ASSERT_GE(current_q9, 0);
                ASSERT_LE(current_q9, CURRENT_END_Q9);
            }
        }
    }
}

} // namespace
