// The rule table of hysteresis DITC, exhaustively.
#include <algorithm>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/ditc_hysteresis.h"
}

namespace {

constexpr int32_t INNER = 1 << 20;
constexpr int32_t OUTER = 1 << 24;
constexpr int32_t LIMIT = 52 << 9;
const ditc_hysteresis_parameters_t PARAMETERS = {.band_inner_q24 = INNER,
                                                 .band_outer_q24 = OUTER,
                                                 .current_limit_q9 = LIMIT,
                                                 .generating_limit_q9 = 56 << 9,
                                                 .generating_slope_q19 = 1 << 16}; // an eighth of an ampere per rad/s

// Just inside and outside of every boundary.
const int32_t ERRORS[] = {INT32_MIN, -OUTER - 1, -OUTER, -OUTER + 1, -INNER - 1, -INNER, -INNER + 1, -1,       0,
                          1,         INNER - 1,  INNER,  INNER + 1,  OUTER - 1,  OUTER,  OUTER + 1,  INT32_MAX};

enum role_t { SINGLE, INCOMING, OUTGOING, IDLE };

// The rule table of ditc_hysteresis.h.
int rule(role_t role, int state, int64_t error) {
    switch (role) {
    case SINGLE:
        return error > INNER ? 1 : error < -OUTER ? -1 : error < -INNER ? 0 : state < 0 ? 0 : state;
    case INCOMING:
        return error > OUTER ? 1 : error < 0 ? 0 : state < 0 ? 0 : state;
    case OUTGOING:
        return error > INNER    ? 1
               : error < -INNER ? -1
               : state > 0      ? (error <= 0 ? 0 : 1)
               : state < 0      ? (error >= 0 ? 0 : -1)
                                : 0;
    default:
        return -1;
    }
}

struct scene_t {
    commutation_t commutation;
    int32_t current_q9[HAL_PHASES_MAX];
};

// Phase 1 active; phase 0 outgoing if requested, with or without current.
scene_t scene(bool outgoing, int32_t outgoing_current_q9, int32_t active_current_q9) {
    scene_t s{};
    s.commutation.active = 1;
    s.commutation.outgoing = outgoing ? 0 : COMMUTATION_NONE;
    s.current_q9[0] = outgoing_current_q9;
    s.current_q9[1] = active_current_q9;
    return s;
}

constexpr int32_t ONE_Q15 = 32768;

int next_state(const scene_t &s, unsigned phase, int state, int32_t error, int32_t backwards_rad_s = 0) {
    int32_t duty_q15[HAL_PHASES_MAX] = {};
    duty_q15[phase] = state * ONE_Q15;
    ditc_hysteresis_step(&PARAMETERS, &s.commutation, error, s.current_q9,
                         ditc_hysteresis_limit(&PARAMETERS, backwards_rad_s << 22), duty_q15);
    EXPECT_EQ(duty_q15[phase] % ONE_Q15, 0);
    return duty_q15[phase] / ONE_Q15;
}

TEST(DitcHysteresis, follows_the_rule_table_for_every_state_error_and_role) {
    const scene_t alone = scene(false, 0, 512), both = scene(true, 512, 512), depleted = scene(true, 0, 512);
    for (const int state : {-1, 0, 1}) {
        for (const int32_t error : ERRORS) {
            SCOPED_TRACE(testing::Message() << "state " << state << ", error " << error);
            EXPECT_EQ(next_state(alone, 1, state, error), rule(SINGLE, state, error));
            EXPECT_EQ(next_state(both, 1, state, error), rule(INCOMING, state, error));
            EXPECT_EQ(next_state(both, 0, state, error), rule(OUTGOING, state, error));
            // An outgoing phase without current does not count: the active one is single.
            EXPECT_EQ(next_state(depleted, 1, state, error), rule(SINGLE, state, error));
            EXPECT_EQ(next_state(depleted, 0, state, error), rule(OUTGOING, state, error));
            // Phases without a role.
            EXPECT_EQ(next_state(both, 2, state, error), rule(IDLE, state, error));
            EXPECT_EQ(next_state(alone, 0, state, error), rule(IDLE, state, error));
        }
    }
}

TEST(DitcHysteresis, a_phase_above_the_current_limit_freewheels_instead_of_being_switched_on) {
    for (const int state : {-1, 0, 1}) {
        for (const int32_t error : ERRORS) {
            for (const int32_t current : {LIMIT, LIMIT + 1, 79 << 9}) {
                for (const role_t role : {SINGLE, INCOMING, OUTGOING}) {
                    const unsigned phase = role == OUTGOING ? 0 : 1;
                    const scene_t s = role == SINGLE     ? scene(false, 0, current)
                                      : role == INCOMING ? scene(true, 512, current)
                                                         : scene(true, current, 512);
                    const int expected = rule(role, state, error);
                    EXPECT_EQ(next_state(s, phase, state, error), current > LIMIT && expected > 0 ? 0 : expected);
                }
            }
        }
    }
}

// Speeds against the order of the phases and limits: 3/4 of LIMIT up to 8 (56 A - 3/4 LIMIT) rad/s.
void expect_backwards_limit(int32_t rad_s, int32_t limit) {
    for (const int state : {-1, 0, 1}) {
        for (const int32_t error : ERRORS) {
            for (const int32_t current : {0, limit, limit + 1, 79 << 9}) {
                for (const role_t role : {SINGLE, INCOMING, OUTGOING}) {
                    const unsigned phase = role == OUTGOING ? 0 : 1;
                    const scene_t s = role == SINGLE     ? scene(false, 0, current)
                                      : role == INCOMING ? scene(true, 512, current)
                                                         : scene(true, current, 512);
                    const int expected = current > limit ? -1 : rule(role, state, error);
                    EXPECT_EQ(next_state(s, phase, state, error, rad_s), expected);
                }
            }
        }
    }
}

TEST(DitcHysteresis, backwards_a_phase_above_three_quarters_of_the_limit_is_switched_off) {
    expect_backwards_limit(1, LIMIT * 3 / 4);
    expect_backwards_limit(8 * 56 - 8 * 3 * LIMIT / 4 / 512, LIMIT * 3 / 4);
}

TEST(DitcHysteresis, fast_backwards_the_limit_falls_with_the_speed_until_no_current_may_begin) {
    expect_backwards_limit(200, 31 << 9);
    expect_backwards_limit(400, 6 << 9);
    for (const int32_t rad_s : {449, 511}) {
        for (const int state : {-1, 0, 1}) {
            EXPECT_EQ(next_state(scene(false, 0, 0), 1, state, INT32_MAX, rad_s), -1);
        }
    }
}

TEST(DitcHysteresis, every_phase_can_have_every_role) {
    for (unsigned active = 0; active < HAL_PHASES_MAX; active++) {
        for (unsigned outgoing = 0; outgoing <= HAL_PHASES_MAX; outgoing++) {
            if (outgoing == active) {
                continue;
            }
            commutation_t commutation{};
            commutation.active = active;
            commutation.outgoing = outgoing;
            const int32_t current_q9[HAL_PHASES_MAX] = {100, 100, 100, 100};
            int32_t duty_q15[HAL_PHASES_MAX];
            ditc_hysteresis_reset(duty_q15);
            ditc_hysteresis_step(&PARAMETERS, &commutation, INT32_MAX, current_q9,
                                 ditc_hysteresis_limit(&PARAMETERS, 0), duty_q15);
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                EXPECT_EQ(duty_q15[phase], phase == active || phase == outgoing ? ONE_Q15 : -ONE_Q15);
            }
        }
    }
}

TEST(DitcHysteresis, in_a_commutation_gap_and_after_reset_all_phases_are_off) {
    commutation_t commutation{};
    commutation.active = commutation.outgoing = COMMUTATION_NONE;
    const int32_t current_q9[HAL_PHASES_MAX] = {100, 100, 100, 100};
    int32_t duty_q15[HAL_PHASES_MAX];
    ditc_hysteresis_reset(duty_q15);
    for (const int32_t state : duty_q15) {
        EXPECT_EQ(state, -ONE_Q15);
    }
    for (const int32_t error : ERRORS) {
        ditc_hysteresis_step(&PARAMETERS, &commutation, error, current_q9, ditc_hysteresis_limit(&PARAMETERS, 0),
                             duty_q15);
        for (const int32_t state : duty_q15) {
            EXPECT_EQ(state, -ONE_Q15);
        }
    }
}

TEST(DitcHysteresis, no_state_beyond_the_last_phase_is_written) {
    commutation_t commutation{};
    commutation.active = 1;
    commutation.outgoing = 0;
    const int32_t current_q9[HAL_PHASES_MAX] = {100, 100, 100, 100};
    int32_t duty_q15[HAL_PHASES_MAX + 1];
    std::fill_n(duty_q15, HAL_PHASES_MAX + 1, 123);
    ditc_hysteresis_reset(duty_q15);
    EXPECT_EQ(duty_q15[HAL_PHASES_MAX], 123);
    ditc_hysteresis_step(&PARAMETERS, &commutation, INT32_MAX, current_q9, ditc_hysteresis_limit(&PARAMETERS, 0),
                         duty_q15);
    EXPECT_EQ(duty_q15[HAL_PHASES_MAX], 123);
}

TEST(DitcHysteresis, extreme_bands_do_not_overflow) {
    const scene_t both = scene(true, 512, 512);
    for (const int32_t inner : {0, INT32_MAX}) {
        for (const int32_t outer : {0, INT32_MAX}) {
            const ditc_hysteresis_parameters_t parameters = {
                .band_inner_q24 = inner, .band_outer_q24 = outer, .current_limit_q9 = LIMIT};
            for (const int32_t error : ERRORS) {
                int32_t duty_q15[HAL_PHASES_MAX];
                ditc_hysteresis_reset(duty_q15);
                ditc_hysteresis_step(&parameters, &both.commutation, error, both.current_q9,
                                     ditc_hysteresis_limit(&parameters, 0), duty_q15);
                for (unsigned phase = 0; phase < 3; phase++) {
                    ASSERT_LE(std::abs(duty_q15[phase]), ONE_Q15);
                }
            }
        }
    }
}

} // namespace
