// Torque sharing: each phase's share against the double-precision twin, and that they make one.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/torque_share.h"
}

#include "support/reference_models.h"

namespace {

constexpr uint32_t HALF_PITCH = 0x80000000u;

uint32_t degrees(double electrical) {
    return uint32_t(electrical / 360.0 * twins::TURN);
}

torque_share_parameters_t parameters_of(unsigned phases, double on, double off, bool sharing = true) {
    return {sharing, uint32_t(twins::TURN / phases), degrees(on), degrees(off), degrees(24.0), degrees(16.0)};
}

twins::share_t twin_of(const torque_share_parameters_t &p, double advance) {
    const double on = p.turn_on / twins::TURN - advance * p.turn_on_early / twins::TURN;
    const double off = p.turn_off / twins::TURN - advance * p.turn_off_early / twins::TURN;
    const double stroke = p.stroke / twins::TURN;
    return {on, stroke, p.sharing ? off - on - stroke : 0.0};
}

// Largest difference from the twin over every angle.
double worst_of(const torque_share_parameters_t &p, double advance) {
    const int32_t advance_q15 = twins::to_fixed(advance, twins::Q15);
    const torque_share_window_t window = torque_share_window(&p, advance_q15);
    const twins::share_t twin = twin_of(p, advance_q15 / twins::Q15);
    double worst = 0.0;
    for (uint64_t angle = HALF_PITCH; angle < uint64_t(1) << 32; angle += 99991) {
        const int32_t share_q15 = torque_share_q15(&window, uint32_t(angle));
        EXPECT_GE(share_q15, 0);
        EXPECT_LE(share_q15, 32768);
        worst = std::max(worst, std::fabs(share_q15 / twins::Q15 - twin.at(angle / twins::TURN)));
    }
    return worst;
}

TEST(TorqueShare, is_its_twin_s_within_4_lsb_and_the_rounding_of_the_overlap_to_a_2_to_the_minus_17_of_a_pitch) {
    for (const unsigned phases : {3u, 4u}) {
        const double stroke_deg = 360.0 / phases;
        for (const double overlap_deg : {2.0, 6.0, 10.0, 20.0, 52.0}) {
            for (const double advance : {0.0, 0.3, 1.0}) {
                torque_share_parameters_t p = parameters_of(phases, 184.0, 184.0 + stroke_deg + overlap_deg);
                p.turn_off_early = p.turn_on_early / 2; // the overlap grows
                // The steepest of x (3 x - 2 x^2) is 1.5 at x of a half, the overlap's error is at most one in so many.
                const double of_overlap = 0.75 / (overlap_deg / 360.0 * 131072.0);
                const double worst = worst_of(p, advance);
                EXPECT_LT(worst, 4.0 / 32768.0 + of_overlap) << overlap_deg << " degrees, " << advance;
                EXPECT_GT(worst, 0.5 / 32768.0);
            }
        }
    }
}

TEST(TorqueShare, shares_of_all_phases_make_one_to_the_bit) {
    for (const unsigned phases : {3u, 4u}) {
        const double stroke_deg = 360.0 / phases;
        for (const double overlap_deg : {2.0, 20.0, 50.0}) {
            const torque_share_parameters_t p = parameters_of(phases, 182.0, 182.0 + stroke_deg + overlap_deg);
            for (const int32_t advance_q15 : {0, 9830, 32768}) {
                const torque_share_window_t window = torque_share_window(&p, advance_q15);
                // From the last moment of one phase's overlap to the next phase's, past the unaligned position.
                for (uint32_t since = 0; since < window.stroke; since += 9973) {
                    const uint32_t angle = window.turn_on + since;
                    const uint32_t ahead = angle + window.stroke; // the phase that entered before
                    const int32_t sum =
                        torque_share_q15(&window, angle) + (ahead >= HALF_PITCH ? torque_share_q15(&window, ahead) : 0);
                    if (angle >= HALF_PITCH) {
                        ASSERT_EQ(sum, 32768) << phases << " phases, " << overlap_deg << " degrees, " << since;
                    }
                }
            }
        }
    }
}

TEST(TorqueShare, is_nothing_before_turn_on_and_behind_turn_off) {
    const torque_share_parameters_t p = parameters_of(3, 184.0, 356.0);
    const torque_share_window_t window = torque_share_window(&p, 0);
    EXPECT_EQ(torque_share_q15(&window, HALF_PITCH), 0);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on - 1), 0);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on), 0);
    EXPECT_GT(torque_share_q15(&window, p.turn_on + degrees(1.0)), 0);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on + degrees(60.0)), 32768);
    EXPECT_GT(torque_share_q15(&window, p.turn_off - degrees(1.0)), 0);
    EXPECT_EQ(torque_share_q15(&window, p.turn_off), 0);
    EXPECT_EQ(torque_share_q15(&window, UINT32_MAX), 0);
}

TEST(TorqueShare, advance_moves_turn_on_and_turn_off_and_gives_a_share_at_the_unaligned_position) {
    const torque_share_parameters_t p = parameters_of(3, 184.0, 356.0);
    for (const double advance : {0.25, 0.5, 1.0}) {
        const torque_share_window_t window = torque_share_window(&p, int32_t(advance * 32768));
        EXPECT_NEAR(window.turn_on / twins::TURN * 360.0, 184.0 - 24.0 * advance, 0.01);
        EXPECT_NEAR((window.turn_on + window.stroke + window.overlap) / twins::TURN * 360.0, 356.0 - 16.0 * advance,
                    0.01);
    }
    const torque_share_window_t early = torque_share_window(&p, 32768);
    EXPECT_NEAR(torque_share_q15(&early, HALF_PITCH) / twins::Q15, twins::share_t::cubic(20.0 / 60.0), 1e-3);
}

TEST(TorqueShare, without_sharing_one_phase_works_at_a_time) {
    const torque_share_parameters_t p = parameters_of(3, 184.0, 356.0, false);
    const torque_share_window_t window = torque_share_window(&p, 0);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on - 1), 0);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on), 32768);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on + p.stroke - 1), 32768);
    EXPECT_EQ(torque_share_q15(&window, p.turn_on + p.stroke), 0);
}

} // namespace
