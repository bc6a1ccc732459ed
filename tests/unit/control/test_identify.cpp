// Experiments without a map: a phase of a given inductance, its switches a period late, as on a board.
#include <algorithm>
#include <cmath>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/identify.h"
}

namespace {

constexpr int32_t ONE = 32768, LIMIT_Q9 = 50 * 512;

struct Identify : testing::Test {
    identify_parameters_t parameters = {.limit_q9 = LIMIT_Q9, .periods_per_ms = 40, .phases = 3};
    identify_t identify = {};
    int32_t current_q9[HAL_PHASES_MAX] = {};
    int32_t duty_q15[HAL_PHASES_MAX] = {};
    uint32_t angle = 0, speed = 0;
    double current_A = 0.0, applied = -1.0, next = -1.0;
    double rise_A = 2.0;      // in a period at full voltage
    double saturated_A = 1e9; // about which it grows to three times as much, within 6 A
    double peak_A = 0.0;
    unsigned phase = 0, records = 0;

    void SetUp() override { identify_begin(&identify, 0, true); }

    void command(identify_kind_t kind, uint16_t level_q12 = 4095, uint16_t time_ms = 0, uint16_t begin = 0,
                 uint16_t width = 0) {
        identify.command = {kind,
                            static_cast<uint8_t>(phase),
                            static_cast<uint8_t>(identify.command.number + 1),
                            level_q12,
                            time_ms,
                            begin,
                            width};
    }
    void step() {
        current_A = std::max(0.0, current_A + applied * rise_A *
                                                  (1.0 + 2.0 / (1.0 + std::exp((saturated_A - current_A) / 3.0))));
        peak_A = std::max(peak_A, current_A);
        applied = next;
        angle += speed;
        current_q9[phase] = static_cast<int32_t>(current_A * 512.0);
        const identify_sample_t sample = {.current_q9 = current_q9, .dc_link_q6 = 240 * 64, .angle = angle};
        identify_step(&parameters, &identify, &sample, duty_q15);
        next = duty_q15[phase] / static_cast<double>(ONE);
        records += identify.records;
        for (unsigned other = 0; other < HAL_PHASES_MAX; other++) {
            if (other != phase) {
                EXPECT_EQ(duty_q15[other], -ONE) << other;
            }
        }
    }
    void run(unsigned periods) {
        for (unsigned n = 0; n < periods; n++) {
            step();
        }
    }
    unsigned run_until_idle(unsigned periods = 4000) {
        for (unsigned n = 1; n <= periods; n++) {
            step();
            if (identify.state == IDENTIFY_IDLE) {
                return n;
            }
        }
        return periods + 1;
    }
    void expect_off() {
        for (const int32_t duty : duty_q15) {
            EXPECT_EQ(duty, -ONE);
        }
    }
};

TEST_F(Identify, nothing_happens_before_a_command_of_another_number) {
    identify.command.kind = IDENTIFY_KIND_PULSE;
    identify.command.level_q12 = 4095;
    run(200);
    EXPECT_EQ(identify.state, IDENTIFY_IDLE);
    EXPECT_EQ(peak_A, 0.0);
    command(IDENTIFY_KIND_PULSE);
    EXPECT_LT(run_until_idle(), 200u);
    EXPECT_GT(peak_A, 40.0);
    peak_A = 0.0;
    run(500); // the same command, repeated
    EXPECT_EQ(peak_A, 0.0);
}

TEST_F(Identify, a_pulse_comes_near_its_level_and_never_beyond_it) {
    std::mt19937 random(1);
    for (unsigned n = 0; n < 300; n++) {
        rise_A = std::uniform_real_distribution<>(0.2, 6.0)(random);
        const auto level = static_cast<uint16_t>(std::uniform_int_distribution<>(1500, 4095)(random));
        const double level_A = 50.0 * level / 4096.0;
        identify_begin(&identify, 0, true);
        current_A = peak_A = 0.0;
        for (unsigned pulse = 0; pulse < 3; pulse++) {
            command(IDENTIFY_KIND_PULSE, level);
            ASSERT_LT(run_until_idle(), 4000u);
            EXPECT_LE(peak_A, level_A) << rise_A;
            EXPECT_GT(peak_A, level_A - 2.1 * rise_A) << rise_A;
        }
    }
}

TEST_F(Identify, a_rise_that_grows_threefold_stays_within_1_05_times_the_limit) {
    for (rise_A = 0.3; rise_A < 2.2; rise_A += 0.1) {
        for (saturated_A = 10.0; saturated_A < 50.0; saturated_A += 0.7) {
            identify_begin(&identify, 0, true);
            current_A = peak_A = 0.0;
            command(IDENTIFY_KIND_PULSE);
            run(600);
            EXPECT_LE(peak_A, 1.05 * 50.0) << rise_A << " " << saturated_A;
            EXPECT_EQ(identify.limit, IDENTIFY_WITHIN) << rise_A << " " << saturated_A;
        }
    }
}

TEST_F(Identify, the_first_pulse_waits_for_what_one_period_makes_of_the_current) {
    command(IDENTIFY_KIND_PULSE);
    step();
    EXPECT_EQ(duty_q15[0], ONE);
    step();
    EXPECT_EQ(duty_q15[0], 0);
    step();
    EXPECT_EQ(duty_q15[0], ONE);
    identify_begin(&identify, 0, true);
    current_A = 0.0;
    applied = next = -1.0;
    rise_A = 30.0; // a second one would be beyond the limit
    peak_A = 0.0;
    command(IDENTIFY_KIND_PULSE);
    run_until_idle();
    EXPECT_LE(peak_A, 30.0);
}

TEST_F(Identify, how_the_rise_of_one_pulse_grew_holds_back_no_pulse_of_another_number) {
    saturated_A = 20.0;
    command(IDENTIFY_KIND_PULSE);
    run_until_idle();
    ASSERT_GT(identify.growth_q9, 0);
    identify.acted = identify.action = IDENTIFY_OFF;
    command(IDENTIFY_KIND_PULSE);
    step();
    EXPECT_EQ(identify.growth_q9, 0);
    EXPECT_EQ(identify.state, IDENTIFY_CHARGES);
}

TEST_F(Identify, a_window_is_awaited_in_both_directions_and_over_the_end_of_the_revolution) {
    rise_A = 1.0;
    for (const int direction : {1, -1}) {
        for (const uint32_t begin : {0x1000u, 0x8000u, 0xFFF0u}) {
            identify_begin(&identify, 0, true);
            current_A = 0.0;
            angle =
                (begin << 16) - static_cast<uint32_t>(direction) * (300u << 16) + (direction < 0 ? 0x20u << 16 : 0u);
            speed = static_cast<uint32_t>(direction * (1 << 17));
            command(IDENTIFY_KIND_PULSE, 4095, 100, static_cast<uint16_t>(begin), 0x20);
            unsigned periods = 0;
            while (identify.state != IDENTIFY_CHARGES && periods < 1000) {
                step();
                periods++;
            }
            EXPECT_LT(((angle >> 16) - begin) & 0xFFFFu, 0x20u) << begin;
            EXPECT_NEAR(periods, 150, 3);
            speed = 0;
            run_until_idle();
        }
    }
    command(IDENTIFY_KIND_PULSE, 4095, 10, 0x4000, 0x20); // never comes
    angle = 0;
    EXPECT_NEAR(run_until_idle(), 10 * 40, 3);
    expect_off();
}

TEST_F(Identify, freewheeling_lasts_its_time_and_the_current_ends) {
    command(IDENTIFY_KIND_FREEWHEEL, 2048, 20);
    unsigned zero = 0;
    for (unsigned n = 0; n < 3000; n++) {
        step();
        zero += identify.state == IDENTIFY_FREEWHEELS;
    }
    EXPECT_NEAR(zero, 20 * 40, 2);
    EXPECT_EQ(identify.state, IDENTIFY_IDLE);
    EXPECT_EQ(current_A, 0.0);
}

TEST_F(Identify, a_hold_needs_a_known_rise_and_keeps_its_level_at_most_half_of_the_limit) {
    command(IDENTIFY_KIND_HOLD, 1024);
    run(400);
    EXPECT_EQ(peak_A, 0.0);
    command(IDENTIFY_KIND_PULSE, 409);
    run_until_idle();
    for (const uint16_t level : {512, 1024, 4095}) {
        command(IDENTIFY_KIND_HOLD, level);
        peak_A = 0.0;
        run(400);
        const double level_A = 50.0 * std::min<int>(level, 2048) / 4096.0;
        EXPECT_NEAR(current_A, level_A, 1.0);
        EXPECT_LE(peak_A, 1.25 * level_A + rise_A);
    }
    command(IDENTIFY_KIND_HOLD, 512); // a lower one: the current falls to it at the full opposite voltage
    const double level_A = 50.0 / 8.0;
    for (unsigned n = 0; n < 400; n++) {
        const double before_A = current_A;
        step();
        if (before_A > 1.3 * level_A + 3.0 * rise_A && n > 2) {
            EXPECT_EQ(duty_q15[0], -ONE) << n;
        }
    }
    EXPECT_NEAR(current_A, level_A, 1.0);
}

TEST_F(Identify, a_hold_ends_after_10_s_and_another_number_begins_the_next) {
    command(IDENTIFY_KIND_PULSE, 409);
    run_until_idle();
    for (unsigned trial = 0; trial < 2; trial++) {
        command(IDENTIFY_KIND_HOLD, 256);
        run(400);
        EXPECT_EQ(identify.state, IDENTIFY_HOLDS);
        EXPECT_NEAR(current_A, 50.0 / 16.0, 1.0);
        identify.periods = IDENTIFY_HOLD_MS * 40 - 10;
        EXPECT_NEAR(run_until_idle(), 12, 1);
        run(400);
        expect_off();
        EXPECT_EQ(current_A, 0.0);
        EXPECT_EQ(identify.limit, IDENTIFY_WITHIN);
    }
}

TEST_F(Identify, a_pulse_of_a_phase_that_carries_current_begins_when_it_has_lost_it) {
    command(IDENTIFY_KIND_PULSE, 409);
    run_until_idle();
    command(IDENTIFY_KIND_HOLD, 1024);
    run(400);
    ASSERT_GT(current_A, 10.0);
    command(IDENTIFY_KIND_PULSE, 2048, 100);
    unsigned periods = 0;
    for (; identify.state != IDENTIFY_CHARGES && periods < 100; periods++) {
        step();
        if (identify.state == IDENTIFY_WAITS) {
            expect_off();
        }
    }
    EXPECT_LE(current_A, 50.0 / 128.0);
    EXPECT_NEAR(periods, 12.5 / rise_A + 3.0, 3.0);
    EXPECT_LT(run_until_idle(), 200u);
    EXPECT_GT(peak_A, 20.0);
}

TEST_F(Identify, a_current_that_hardly_rises_has_full_voltage_for_50_ms_and_no_longer) {
    rise_A = 0.004;
    command(IDENTIFY_KIND_PULSE);
    unsigned charged = 0;
    for (unsigned n = 0; n < 6000; n++) {
        step();
        charged += duty_q15[0] == ONE;
    }
    EXPECT_NEAR(charged, 50 * 40, 3);
    EXPECT_EQ(identify.state, IDENTIFY_IDLE);
    EXPECT_EQ(identify.limit, IDENTIFY_WITHIN);
}

TEST_F(Identify, a_damped_hold_has_a_quarter_while_the_rotor_approaches) {
    command(IDENTIFY_KIND_PULSE, 409);
    run_until_idle();
    speed = 1 << 14;
    angle = 0;
    command(IDENTIFY_KIND_DAMPED, 1024, 0, 0x4000);
    run(600);
    EXPECT_NEAR(current_A, 12.5 / 4.0, 1.0);
    speed = static_cast<uint32_t>(-(1 << 14));
    run(600);
    EXPECT_NEAR(current_A, 12.5, 1.0);
}

TEST_F(Identify, each_limit_ends_all_experiments_until_the_next_run) {
    command(IDENTIFY_KIND_PULSE);
    run(5);
    current_A = 52.0;
    step();
    EXPECT_EQ(identify.limit, IDENTIFY_CURRENT);
    expect_off();
    command(IDENTIFY_KIND_PULSE, 1000);
    run(300);
    EXPECT_EQ(identify.state, IDENTIFY_ENDED);
    expect_off();

    identify_begin(&identify, angle, true);
    identify.energy[2] = 0xFFFFFFF0u / 2u;
    step();
    EXPECT_EQ(identify.limit, IDENTIFY_ENERGY);

    identify_begin(&identify, angle, true);
    identify.travel = -(IDENTIFY_TRAVEL_REV << 16) - 1;
    step();
    EXPECT_EQ(identify.limit, IDENTIFY_TRAVEL);

    identify_begin(&identify, angle, true);
    identify.run_periods = IDENTIFY_TIME_MS * 40 + 1;
    step();
    EXPECT_EQ(identify.limit, IDENTIFY_TIME);

    identify_begin(&identify, angle, false);
    command(IDENTIFY_KIND_PULSE);
    run(100);
    EXPECT_EQ(identify.limit, IDENTIFY_CONTROLLER);
    expect_off();
}

TEST_F(Identify, the_copper_loss_of_a_second_at_the_limit_is_its_end) {
    current_q9[1] = LIMIT_Q9;
    unsigned periods = 0;
    phase = 0;
    while (identify.state != IDENTIFY_ENDED && periods < 100000) {
        step();
        periods++;
    }
    EXPECT_NEAR(periods, 1000 * 40, 2);
}

TEST_F(Identify, the_copper_loss_of_a_current_between_the_steps_of_its_square_is_rounded_to_nearest) {
    parameters.limit_q9 = 2 * 512;
    for (const auto &[excess_q9, squares] : {std::pair(127, 4 * 4 / 2), std::pair(128, 5 * 5 / 2)}) {
        identify_begin(&identify, 0, true);
        current_q9[1] = 2 * 512 + excess_q9;
        parameters.limit_q9 = current_q9[1];
        const identify_sample_t sample = {.current_q9 = current_q9, .dc_link_q6 = 240 * 64, .angle = 0};
        identify_step(&parameters, &identify, &sample, duty_q15);
        EXPECT_EQ(identify.energy[1], uint32_t(squares)) << excess_q9;
    }
}

TEST_F(Identify, at_a_rate_at_which_the_copper_loss_of_a_second_does_not_fit_it_is_as_much_as_fits) {
    parameters.periods_per_ms = 1000;
    parameters.limit_q9 = current_q9[1] = 66 * 512; // 8.7e9 of 4.3e9
    unsigned periods = 0;
    while (identify.state != IDENTIFY_ENDED && periods < 1000001) {
        const identify_sample_t sample = {.current_q9 = current_q9, .dc_link_q6 = 240 * 64, .angle = 0};
        identify_step(&parameters, &identify, &sample, duty_q15);
        periods++;
    }
    EXPECT_EQ(identify.limit, IDENTIFY_ENERGY);
    EXPECT_NEAR(periods, 0x1p32 / (132 * 132 / 2.0), 200.0);
}

TEST_F(Identify, travel_is_counted_over_revolutions) {
    speed = 1u << 26;
    run(640);
    EXPECT_EQ(identify.travel, 640 << 10);
}

TEST_F(Identify, the_record_has_every_change_of_the_switches) {
    rise_A = 0.5;
    command(IDENTIFY_KIND_PULSE, 2000);
    unsigned action = IDENTIFY_OFF;
    for (unsigned n = 0; n < 400; n++) {
        step();
        const unsigned recorded = identify.record[1] >> 7 & 3u;
        if (recorded != action) {
            EXPECT_TRUE(identify.records) << n;
        }
        action = recorded;
        EXPECT_EQ(identify.record[0] & 0xFFFFu, static_cast<uint32_t>(current_q9[0]));
        EXPECT_EQ(identify.record[0] >> 16, 240u * 64u);
        EXPECT_EQ(identify.record[1] >> 12, angle >> 12);
    }
    EXPECT_LT(records, 80u);
    EXPECT_GT(records, 30u);
}

TEST_F(Identify, a_phase_that_the_machine_does_not_have_stays_off) {
    identify.command = {IDENTIFY_KIND_PULSE, 5, 9, 4095, 0, 0, 0};
    run(100);
    expect_off();
    EXPECT_EQ(identify.state, IDENTIFY_IDLE);
}

// A bit of its number that flips leads to no other phase's rise, nor beyond the arrays. [SR-51]
TEST_F(Identify, a_phase_that_becomes_one_that_the_machine_does_not_have_ends_its_experiment) {
    for (const identify_kind_t kind : {IDENTIFY_KIND_HOLD, IDENTIFY_KIND_PULSE, IDENTIFY_KIND_FREEWHEEL}) {
        identify_begin(&identify, 0, true);
        current_A = 0.0;
        command(IDENTIFY_KIND_PULSE, 409);
        run_until_idle();
        command(kind, 2048, 20);
        run(8);
        ASSERT_NE(identify.state, IDENTIFY_IDLE) << kind;
        const identify_t before = identify;
        for (const uint8_t other : {3, HAL_PHASES_MAX, 0x80}) {
            identify = before;
            identify.command.phase = other;
            step();
            EXPECT_EQ(identify.state, IDENTIFY_IDLE) << kind << ' ' << int(other);
            expect_off();
            for (unsigned n = 0; n < HAL_PHASES_MAX; n++) {
                EXPECT_EQ(identify.first_rise_q9[n], before.first_rise_q9[n]) << kind << ' ' << n;
            }
        }
    }
}

TEST_F(Identify, of_a_machine_of_six_phases_each_one_has_its_experiments_and_limits) {
    parameters.phases = HAL_PHASES_MAX;
    for (phase = 0; phase < HAL_PHASES_MAX; phase++) {
        std::fill(std::begin(current_q9), std::end(current_q9), 0);
        identify_begin(&identify, 0, true);
        current_A = peak_A = 0.0;
        command(IDENTIFY_KIND_PULSE, 2048);
        EXPECT_LT(run_until_idle(), 200u) << phase;
        EXPECT_GT(peak_A, 20.0) << phase;
        current_A = 56.0; // of which a period takes one rise away
        step();
        EXPECT_EQ(identify.limit, IDENTIFY_CURRENT) << phase;
    }
}

} // namespace
