// Commutation over all rotor angles.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

#include "support/commutation_roles.h"
#include "support/fixed_point.h"

namespace {

using namespace fixed_point;
commutation_angles_t parameters_of(double on_deg, double off_deg, double outgoing_off_deg) {
    return {.turn_on = electrical_angle(on_deg),
            .turn_off = electrical_angle(off_deg),
            .outgoing_off = electrical_angle(outgoing_off_deg)};
}

// The paper's angles of a 6/4 machine, 45, 75 and 87 degrees mechanical.
const commutation_angles_t PAPER = parameters_of(180.0, 300.0, 348.0);

// Every boundary of roles with its neighbouring LSBs, a uniform sweep and random angles.
template <typename visitor_t> void for_many_angles(unsigned phases, unsigned rotor_poles, visitor_t visit) {
    const uint32_t electrical_rev = uint32_t(REV / rotor_poles);
    for (unsigned pole = 0; pole < rotor_poles; pole++) {
        for (unsigned phase = 0; phase < phases; phase++) {
            for (const double degrees : {0.0, 90.0, 180.0, 270.0, 300.0, 348.0}) {
                const double rev = pole + phase / double(phases) + degrees / 360.0;
                for (int lsb = -3; lsb <= 3; lsb++) {
                    visit(uint32_t(int64_t(rev * electrical_rev)) + uint32_t(lsb));
                }
            }
        }
    }
    for (uint64_t angle = 0; angle < uint64_t(1) << 32; angle += 99991) {
        visit(uint32_t(angle));
    }
    std::mt19937 random(1);
    for (int i = 0; i < 100000; i++) {
        visit(uint32_t(random()));
    }
}

TEST(Commutation, exactly_one_phase_is_active_at_every_angle_of_a_three_phase_machine) {
    for (const unsigned rotor_poles : {4u, 8u}) {
        for_many_angles(3, rotor_poles, [&](uint32_t angle) {
            const roles_t c = roles_at(PAPER, 3, rotor_poles, angle);
            ASSERT_LT(c.active, 3u) << angle;
            unsigned in_window = 0;
            for (unsigned phase = 0; phase < 3; phase++) {
                in_window += c.angle[phase] >= PAPER.turn_on && c.angle[phase] < PAPER.turn_off;
            }
            ASSERT_EQ(in_window, 1u) << angle;
        });
    }
}

TEST(Commutation, each_phase_lags_its_predecessor_by_a_third_of_an_electrical_revolution) {
    for_many_angles(3, 4, [](uint32_t angle) {
        const roles_t c = roles_at(PAPER, 3, 4, angle);
        ASSERT_EQ(c.angle[0], angle * 4u);
        for (unsigned phase = 1; phase < 3; phase++) {
            ASSERT_EQ(c.angle[phase - 1] - c.angle[phase], 0x55555555u); // 30 degrees of 90
        }
    });
}

TEST(Commutation, the_active_window_is_45_to_75_degrees_and_the_outgoing_one_ends_at_87) {
    for (int tenth_deg = 0; tenth_deg < 3600; tenth_deg++) {
        const double rotor_deg = tenth_deg / 10.0 + 0.01;
        const roles_t c = roles_at(PAPER, 3, 4, electrical_angle(rotor_deg));
        for (unsigned phase = 0; phase < 3; phase++) {
            const double phase_deg = std::fmod(rotor_deg - 30.0 * phase + 360.0, 90.0);
            ASSERT_EQ(c.active == phase, phase_deg >= 45.0 && phase_deg < 75.0) << rotor_deg;
            ASSERT_EQ(c.outgoing == phase, phase_deg >= 75.0 && phase_deg < 87.0) << rotor_deg;
        }
    }
}

TEST(Commutation, forward_rotation_activates_phases_in_ascending_order_twelve_times_per_revolution) {
    unsigned strokes = 0;
    unsigned last = roles_at(PAPER, 3, 4, 0).active;
    for (uint64_t angle = 0; angle <= uint64_t(1) << 32; angle += 1 << 16) {
        const unsigned active = roles_at(PAPER, 3, 4, uint32_t(angle)).active;
        if (active != last) {
            ASSERT_EQ(active, (last + 1) % 3);
            strokes++;
            last = active;
        }
    }
    EXPECT_EQ(strokes, 12u);
}

TEST(Commutation, angles_wrap_at_a_revolution) {
    for (const unsigned rotor_poles : {4u, 6u, 8u}) {
        const unsigned phases = rotor_poles == 6 ? 4 : 3;
        const roles_t before = roles_at(PAPER, phases, rotor_poles, UINT32_MAX);
        const roles_t after = roles_at(PAPER, phases, rotor_poles, 0);
        for (unsigned phase = 0; phase < phases; phase++) {
            EXPECT_EQ(after.angle[phase] - before.angle[phase], rotor_poles);
        }
    }
}

TEST(Commutation, four_phases_with_windows_of_a_quarter_revolution_have_exactly_one_active) {
    const commutation_angles_t quarter = parameters_of(180.0, 270.0, 348.0);
    for_many_angles(4, 6, [&](uint32_t angle) {
        const roles_t c = roles_at(quarter, 4, 6, angle);
        unsigned in_window = 0;
        for (unsigned phase = 0; phase < 4; phase++) {
            in_window += c.angle[phase] >= quarter.turn_on && c.angle[phase] < quarter.turn_off;
        }
        ASSERT_EQ(in_window, 1u);
        ASSERT_LT(c.active, 4u);
        ASSERT_TRUE(c.angle[c.active] >= quarter.turn_on && c.angle[c.active] < quarter.turn_off);
    });
}

// The default angles on a four-phase machine: windows of 120 degrees every 90.
TEST(Commutation, where_windows_overlap_the_last_to_enter_is_active_and_its_predecessor_outgoing) {
    for_many_angles(4, 6, [](uint32_t angle) {
        const roles_t c = roles_at(PAPER, 4, 6, angle);
        ASSERT_LT(c.active, 4u);
        for (unsigned phase = 0; phase < 4; phase++) {
            const bool newest = c.angle[phase] - PAPER.turn_on < 0x40000000u;
            const bool next = c.angle[phase] >= PAPER.turn_on + 0x40000000u && c.angle[phase] < PAPER.outgoing_off;
            ASSERT_EQ(c.active == phase, newest) << angle;
            ASSERT_EQ(c.outgoing == phase, next) << angle;
        }
    });
}

TEST(Commutation, all_phases_of_a_machine_are_treated_equally) {
    // A third (a quarter) of an electrical revolution later, the roles are the next phase's.
    std::mt19937 random(2);
    for (int i = 0; i < 200000; i++) {
        const commutation_angles_t p = {uint32_t(random()), uint32_t(random()), uint32_t(random())};
        const auto angle = uint32_t(random());
        const roles_t now = roles_at(p, 4, 8, angle);
        const roles_t later = roles_at(p, 4, 8, angle + (1u << 27)); // a quarter of an eighth of a revolution
        const auto next = [](unsigned role) { return role == COMMUTATION_NONE ? role : (role + 1) % 4; };
        ASSERT_EQ(later.active, next(now.active));
        ASSERT_EQ(later.outgoing, next(now.outgoing));
    }
}

TEST(Commutation, roles_are_phases_of_the_machine_or_none_and_never_the_same_for_any_parameters) {
    std::mt19937 random(3);
    for (unsigned phases = 2; phases <= HAL_PHASES_MAX; phases++) {
        for (int i = 0; i < 100000; i++) {
            const commutation_angles_t p = {uint32_t(random()), uint32_t(random()), uint32_t(random())};
            const roles_t c = roles_at(p, phases, 1 + random() % 255, uint32_t(random()));
            ASSERT_TRUE(c.active < phases || c.active == COMMUTATION_NONE);
            ASSERT_TRUE(c.outgoing < phases || c.outgoing == COMMUTATION_NONE);
            ASSERT_TRUE(c.active != c.outgoing || c.active == COMMUTATION_NONE);
        }
    }
}

TEST(Commutation, windows_begin_with_turn_on_and_end_before_turn_off_to_the_lsb) {
    // One rotor pole: the rotor's angle is the phase's. Two phases: the other one is far from its window.
    const auto roles = [](uint32_t angle) { return roles_at(PAPER, 2, 1, angle); };
    EXPECT_EQ(roles(PAPER.turn_on - 1).active, unsigned(COMMUTATION_NONE));
    EXPECT_EQ(roles(PAPER.turn_on).active, 0u);
    EXPECT_EQ(roles(PAPER.turn_off - 1).active, 0u);
    EXPECT_EQ(roles(PAPER.turn_off).active, unsigned(COMMUTATION_NONE));
    EXPECT_EQ(roles(PAPER.turn_off - 1).outgoing, unsigned(COMMUTATION_NONE));
    EXPECT_EQ(roles(PAPER.turn_off).outgoing, 0u);
    EXPECT_EQ(roles(PAPER.outgoing_off - 1).outgoing, 0u);
    EXPECT_EQ(roles(PAPER.outgoing_off).outgoing, unsigned(COMMUTATION_NONE));
}

TEST(Commutation, with_turn_off_before_turn_on_no_phase_is_active) {
    const commutation_angles_t empty = parameters_of(300.0, 200.0, 200.0);
    for_many_angles(3, 4, [&](uint32_t angle) {
        const roles_t c = roles_at(empty, 3, 4, angle);
        ASSERT_EQ(c.active, unsigned(COMMUTATION_NONE));
        ASSERT_EQ(c.outgoing, unsigned(COMMUTATION_NONE));
    });
}

// Turn-on before the unaligned position makes torque against the commanded direction until there; the phase before it
// has to make more.
TEST(Commutation, drives_forward_unless_a_phase_that_is_turned_on_early_can_drive_the_rotor_back) {
    const auto drives = [](double on_deg, double off_deg, double outgoing_off_deg, int current_A) {
        const commutation_angles_t angles = parameters_of(on_deg, off_deg, outgoing_off_deg);
        const commutation_parameters_t parameters =
            commutation_configure(&angles, machine_tables.phases, machine_tables.rotor_poles);
        return commutation_drives_forward(&parameters, &machine_tables, current_A * 512);
    };
    for (const int current_A : {1, 20, 52, 79}) {
        EXPECT_TRUE(drives(180.0, 300.0, 348.0, current_A));
        EXPECT_TRUE(drives(160.0, 280.0, 348.0, current_A));
        EXPECT_TRUE(drives(200.0, 250.0, 260.0, current_A)) << "angles without torque, but none back";
        EXPECT_FALSE(drives(90.0, 359.9, 359.9, current_A));
        EXPECT_FALSE(drives(120.0, 240.0, 300.0, current_A)) << "as much back as forward";
        EXPECT_FALSE(drives(156.0, 250.0, 254.0, current_A)) << "the phase before it is off";
        EXPECT_FALSE(drives(179.0, 250.0, 250.0, current_A));
    }
}

} // namespace
