// The firmware's torque map: its interpolation against double precision, and the map itself against the machine's
// magnetics that it was generated from (the saturating machine).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/torque_map.h"
#include "plant/machine.h"
}

#include "twins.h"

namespace {

constexpr uint32_t HALF_PITCH = 0x80000000u;
constexpr double ROW = 1 << MACHINE_TORQUE_ROW_BITS, COLUMN = 1 << MACHINE_TORQUE_COLUMN_BITS;
constexpr int32_t CURRENT_END_Q9 = TORQUE_MAP_CURRENT_MAX_Q9;

// Bilinear interpolation of the same table; rows from the unaligned position, columns from no current.
double bilinear_Nm(double row, double position) {
    const int low = std::min(int(row), MACHINE_TORQUE_ANGLES - 2);
    const int column = std::min(int(position), MACHINE_TORQUE_CURRENTS - 2);
    const double u = row - low, v = position - column;
    const auto &t = machine_tables.torque_q8;
    return ((1 - u) * ((1 - v) * t[low][column] + v * t[low][column + 1]) +
            u * ((1 - v) * t[low + 1][column] + v * t[low + 1][column + 1])) /
           256.0;
}

class Magnetics {
  public:
    Magnetics() { magnetics_prepare(&model, &machine_plant.magnetics, machine_plant.rotor_poles); }

    // Torque of one phase from the machine's formula; angle in pitches.
    double torque_Nm(double pitches, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, pitches * 2.0 * twins::PI / machine_plant.rotor_poles, current_A, &point);
        return point.torque_Nm;
    }

  private:
    magnetics_model_t model;
};

TEST(TorqueMap, the_formula_has_the_machine_s_known_torques_at_mid_stroke) {
    const Magnetics magnetics;
    EXPECT_NEAR(magnetics.torque_Nm(0.75, 10.0), 1.82, 0.005);
    EXPECT_NEAR(magnetics.torque_Nm(0.75, 20.0), 6.17, 0.005);
    EXPECT_NEAR(magnetics.torque_Nm(0.75, 30.0), 11.92, 0.005);
    EXPECT_NEAR(magnetics.torque_Nm(0.75, 50.0), 25.3, 0.05);
}

TEST(TorqueMap, torque_is_the_bilinear_interpolation_of_the_table) {
    std::mt19937 random(1);
    double worst = 0.0;
    for (int i = 0; i < 1000000; i++) {
        const uint32_t angle = HALF_PITCH | uint32_t(random());
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9));
        const double exact = bilinear_Nm((angle - HALF_PITCH) / ROW, current_q9 / COLUMN);
        worst =
            std::max(worst, std::fabs(torque_map_torque_q24(&machine_tables, angle, current_q9) / twins::Q24 - exact));
    }
    // The angle within a row is truncated to 16 bits: that is where it comes from.
    EXPECT_LT(worst, 1.0 / 16384.0);
    EXPECT_GT(worst, 1e-5);
}

TEST(TorqueMap, torque_is_exact_at_every_entry_of_the_table) {
    for (uint32_t row = 0; row + 1 < MACHINE_TORQUE_ANGLES; row++) {
        for (int32_t column = 0; column + 1 < MACHINE_TORQUE_CURRENTS; column++) {
            ASSERT_EQ(torque_map_torque_q24(&machine_tables, HALF_PITCH + (row << MACHINE_TORQUE_ROW_BITS),
                                            column << MACHINE_TORQUE_COLUMN_BITS),
                      machine_tables.torque_q8[row][column] * 65536);
        }
    }
}

TEST(TorqueMap, differs_from_the_machine_s_formula_by_22_mNm_at_most) {
    const Magnetics magnetics;
    double worst = 0.0, squares = 0.0;
    int count = 0;
    for (uint32_t step = 0; step < 128 * 8; step++) {
        const uint32_t angle = HALF_PITCH + (step << 21);
        for (int32_t current_q9 = 0; current_q9 < CURRENT_END_Q9; current_q9 += 64) {
            const double exact = magnetics.torque_Nm(angle / twins::TURN, current_q9 / twins::Q9);
            const double error = torque_map_torque_q24(&machine_tables, angle, current_q9) / twins::Q24 - exact;
            worst = std::max(worst, std::fabs(error));
            squares += error * error;
            count++;
        }
    }
    const double rms = std::sqrt(squares / count);
    EXPECT_LT(worst, 0.022);
    EXPECT_GT(worst, 0.020);
    EXPECT_LT(rms, 0.0042);
    EXPECT_GT(rms, 0.0037);
}

TEST(TorqueMap, is_mirror_symmetric_about_the_unaligned_position) {
    std::mt19937 random(2);
    for (int i = 0; i < 200000; i++) {
        const uint32_t distance = 1 + uint32_t(random()) % (HALF_PITCH - 1);
        const auto current_q9 = int32_t(random() % uint32_t(CURRENT_END_Q9));
        ASSERT_EQ(torque_map_torque_q24(&machine_tables, HALF_PITCH + distance, current_q9),
                  -torque_map_torque_q24(&machine_tables, HALF_PITCH - distance, current_q9));
    }
}

TEST(TorqueMap, unaligned_and_aligned_positions_have_no_torque) {
    for (int32_t current_q9 = 0; current_q9 <= CURRENT_END_Q9; current_q9++) {
        ASSERT_EQ(torque_map_torque_q24(&machine_tables, HALF_PITCH, current_q9), 0);
        ASSERT_LE(std::abs(torque_map_torque_q24(&machine_tables, 0, current_q9)) / twins::Q24, 1e-4);
        ASSERT_LE(std::abs(torque_map_torque_q24(&machine_tables, UINT32_MAX, current_q9)) / twins::Q24, 1e-4);
    }
}

TEST(TorqueMap, current_is_held_within_the_table) {
    const uint32_t angle = HALF_PITCH + HALF_PITCH / 2;
    EXPECT_EQ(torque_map_torque_q24(&machine_tables, angle, -1), 0);
    EXPECT_EQ(torque_map_torque_q24(&machine_tables, angle, INT32_MIN), 0);
    const int32_t end_q24 = torque_map_torque_q24(&machine_tables, angle, CURRENT_END_Q9);
    EXPECT_EQ(torque_map_torque_q24(&machine_tables, angle, INT32_MAX), end_q24);
    EXPECT_NEAR(end_q24 / twins::Q24, machine_tables.torque_q8[64][40] / 256.0, 0.005);
}

TEST(TorqueMap, current_and_torque_are_each_other_s_inverse) {
    std::mt19937 random(3);
    for (int i = 0; i < 200000; i++) {
        const uint32_t angle = HALF_PITCH | uint32_t(random());
        const int32_t torque_q24 = int32_t(random() % (60u << 24)) >> (random() % 20);
        const int32_t current_q9 = torque_map_current_q9(&machine_tables, angle, torque_q24);
        ASSERT_GE(current_q9, 0);
        ASSERT_LE(current_q9, CURRENT_END_Q9);
        if (current_q9 + 1 >= CURRENT_END_Q9) {
            ASSERT_GE(torque_q24, torque_map_torque_q24(&machine_tables, angle, CURRENT_END_Q9));
            continue;
        }
        // Truncated: no more than the torque wanted, and one LSB of current more is more. The torque's own rounding is
        // an LSB.
        ASSERT_LE(torque_map_torque_q24(&machine_tables, angle, current_q9), torque_q24 + 1) << angle;
        ASSERT_GE(torque_map_torque_q24(&machine_tables, angle, current_q9 + 1), torque_q24 - 1) << angle;
    }
}

TEST(TorqueMap, no_torque_needs_no_current_and_too_much_the_largest) {
    for (uint32_t row = 0; row + 1 < MACHINE_TORQUE_ANGLES; row++) {
        const uint32_t angle = HALF_PITCH + (row << MACHINE_TORQUE_ROW_BITS);
        EXPECT_EQ(torque_map_current_q9(&machine_tables, angle, 0), 0);
        EXPECT_EQ(torque_map_current_q9(&machine_tables, angle, -1), 0);
        EXPECT_EQ(torque_map_current_q9(&machine_tables, angle, INT32_MIN), 0);
        EXPECT_EQ(torque_map_current_q9(&machine_tables, angle, INT32_MAX), CURRENT_END_Q9);
    }
    EXPECT_EQ(torque_map_current_q9(&machine_tables, HALF_PITCH, 1), CURRENT_END_Q9);
    EXPECT_LE(torque_map_current_q9(&machine_tables, UINT32_MAX, 1 << 24), CURRENT_END_Q9);
}

TEST(TorqueMap, a_measured_map_with_negative_and_extreme_entries_does_not_overflow) {
    static machine_tables_t wild = machine_tables;
    std::mt19937 random(4);
    for (auto &row : wild.torque_q8) {
        for (auto &entry : row) {
            entry = int16_t(random() % 3 == 0 ? -INT16_MAX : random() % 2 == 0 ? INT16_MAX : random() % 256);
        }
    }
    for (int i = 0; i < 100000; i++) {
        const auto angle = uint32_t(random());
        const auto current_q9 = int32_t(uint32_t(random()) >> (random() % 24));
        const int32_t torque_q24 = torque_map_torque_q24(&wild, angle, current_q9);
        ASSERT_LE(std::abs(int64_t(torque_q24)), int64_t(32768) << 16);
    }
}

} // namespace
