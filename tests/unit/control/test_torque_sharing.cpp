// The torque sharing function against its reference model, and the sum of all shares.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/torque_sharing.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;

uint32_t degrees(double electrical) {
    return uint32_t(electrical / 360.0 * REV);
}

torque_sharing_parameters_t parameters_of(unsigned phases, double on, double off, bool overlapping = true) {
    return {.overlapping = overlapping,
            .stroke = uint32_t(REV / phases),
            .turn_on = degrees(on),
            .turn_off = degrees(off),
            .turn_on_advance = degrees(24.0),
            .turn_off_advance = degrees(16.0)};
}

// Largest error against the reference model over all angles.
double worst_of(const torque_sharing_parameters_t &p, double advance) {
    const int32_t advance_q15 = to_fixed(advance, Q15);
    const torque_sharing_window_t window = torque_sharing_window(&p, advance_q15);
    const reference_model::torque_sharing_t model = reference_model::model_of(p, advance_q15 / Q15);
    double worst = 0.0;
    for (uint64_t angle = HALF_REV_Q32; angle < uint64_t(1) << 32; angle += 99991) {
        const int32_t share_q15 = torque_sharing_q15(&window, uint32_t(angle));
        EXPECT_GE(share_q15, 0);
        EXPECT_LE(share_q15, 32768);
        worst = std::max(worst, std::fabs(share_q15 / Q15 - model.at(angle / REV)));
    }
    return worst;
}

TEST(TorqueSharing,
     equals_its_reference_model_within_4_lsb_and_the_rounding_of_the_overlap_to_2_to_the_minus_17_of_a_revolution) {
    for (const unsigned phases : {3u, 4u}) {
        const double stroke_deg = 360.0 / phases;
        for (const double overlap_deg : {2.0, 6.0, 10.0, 20.0, 52.0}) {
            for (const double advance : {0.0, 0.3, 1.0}) {
                torque_sharing_parameters_t p = parameters_of(phases, 184.0, 184.0 + stroke_deg + overlap_deg);
                p.turn_off_advance = p.turn_on_advance / 2; // the overlap grows
                // The slope of 3 x^2 - 2 x^3 is at most 1.5, at x = 1/2; the overlap is truncated to 2^-17 rev.
                const double of_overlap = 0.75 / (overlap_deg / 360.0 * 131072.0);
                const double worst = worst_of(p, advance);
                EXPECT_LT(worst, 4.0 / 32768.0 + of_overlap) << overlap_deg << " degrees, " << advance;
                EXPECT_GT(worst, 0.5 / 32768.0);
            }
        }
    }
}

TEST(TorqueSharing, shares_of_all_phases_add_up_to_exactly_one) {
    for (const unsigned phases : {3u, 4u}) {
        const double stroke_deg = 360.0 / phases;
        for (const double overlap_deg : {2.0, 20.0, 50.0}) {
            const torque_sharing_parameters_t p = parameters_of(phases, 182.0, 182.0 + stroke_deg + overlap_deg);
            for (const int32_t advance_q15 : {0, 9830, 32768}) {
                const torque_sharing_window_t window = torque_sharing_window(&p, advance_q15);
                // A stroke from turn-on, where past the unaligned position.
                for (uint32_t since = 0; since < window.stroke; since += 9973) {
                    const uint32_t angle = window.turn_on + since;
                    const uint32_t ahead = angle + window.stroke; // the phase that entered before it
                    const int32_t sum = torque_sharing_q15(&window, angle) +
                                        (ahead >= HALF_REV_Q32 ? torque_sharing_q15(&window, ahead) : 0);
                    if (angle >= HALF_REV_Q32) {
                        ASSERT_EQ(sum, 32768) << phases << " phases, " << overlap_deg << " degrees, " << since;
                    }
                }
            }
        }
    }
}

TEST(TorqueSharing, is_zero_before_turn_on_and_after_turn_off) {
    const torque_sharing_parameters_t p = parameters_of(3, 184.0, 356.0);
    const torque_sharing_window_t window = torque_sharing_window(&p, 0);
    EXPECT_EQ(torque_sharing_q15(&window, HALF_REV_Q32), 0);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on - 1), 0);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on), 0);
    EXPECT_GT(torque_sharing_q15(&window, p.turn_on + degrees(1.0)), 0);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on + degrees(60.0)), 32768);
    EXPECT_GT(torque_sharing_q15(&window, p.turn_off - degrees(1.0)), 0);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_off), 0);
    EXPECT_EQ(torque_sharing_q15(&window, UINT32_MAX), 0);
}

TEST(TorqueSharing, advance_moves_turn_on_and_turn_off_and_causes_a_share_at_the_unaligned_position) {
    const torque_sharing_parameters_t p = parameters_of(3, 184.0, 356.0);
    for (const double advance : {0.25, 0.5, 1.0}) {
        const torque_sharing_window_t window = torque_sharing_window(&p, int32_t(advance * 32768));
        EXPECT_NEAR(window.turn_on / REV * 360.0, 184.0 - 24.0 * advance, 0.01);
        EXPECT_NEAR((window.turn_on + window.stroke + window.overlap) / REV * 360.0, 356.0 - 16.0 * advance, 0.01);
    }
    const torque_sharing_window_t early = torque_sharing_window(&p, 32768);
    EXPECT_NEAR(torque_sharing_q15(&early, HALF_REV_Q32) / Q15, reference_model::torque_sharing_t::cubic(20.0 / 60.0),
                1e-3);
}

TEST(TorqueSharing, a_window_is_moved_by_products_that_are_rounded_down) {
    std::mt19937 random(1);
    for (int i = 0; i < 100000; i++) {
        torque_sharing_parameters_t p = parameters_of(3, 184.0, 344.0);
        p.turn_on_advance = degrees(24.0) - random() % 1000000;
        p.turn_off_advance = degrees(16.0) - random() % 1000000;
        const auto advance_q15 = int32_t(random() % 32769);
        const torque_sharing_window_t window = torque_sharing_window(&p, advance_q15);
        const auto moved = [&](uint32_t by) { return uint32_t(uint64_t(by) * uint32_t(advance_q15) / 32768); };
        ASSERT_EQ(window.turn_on, p.turn_on - moved(p.turn_on_advance));
        ASSERT_EQ(window.turn_on + window.stroke + window.overlap, p.turn_off - moved(p.turn_off_advance));
        // 2^47 / overlap: the overlap without its lower 15 bits, and what the quotient is rounded down by.
        const double least = std::ldexp(1.0, 47) / (window.overlap | 0x7fff) - 1.0;
        ASSERT_GE(window.reciprocal, least);
        ASSERT_LE(window.reciprocal, std::ldexp(1.0, 47) / (window.overlap & ~0x7fffu));
    }
}

TEST(TorqueSharing, without_overlap_one_phase_conducts_at_a_time) {
    const torque_sharing_parameters_t p = parameters_of(3, 184.0, 356.0, false);
    const torque_sharing_window_t window = torque_sharing_window(&p, 0);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on - 1), 0);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on), 32768);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on + p.stroke - 1), 32768);
    EXPECT_EQ(torque_sharing_q15(&window, p.turn_on + p.stroke), 0);
}

} // namespace
