// Predictive torque control against its reference model with the same tables, so that only the arithmetic differs, and
// properties that hold for any machine.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/predictive_torque.h"
#include "drive/configure.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;
constexpr unsigned PHASES = 3;
constexpr uint32_t RATE_HZ = 40000;
constexpr double BUS_V = 240.0;

// Phase map of the firmware in doubles. Angles in electrical revolutions.
struct tables_t {
    static phase_map_lookup_t at(double angle) { return phase_map_lookup(&machine_tables, uint32_t(angle * REV)); }
    double torque(double angle, double current_A) const {
        const phase_map_lookup_t lookup = at(angle);
        return phase_map_torque_q24(&lookup, to_fixed(current_A, Q9)) / Q24;
    }
    double flux(double angle, double current_A) const {
        const phase_map_lookup_t lookup = at(angle);
        return phase_map_flux_q29(&lookup, to_fixed(current_A, Q9)) / Q29;
    }
    // Largest current whose torque does not exceed it.
    double current_of_torque(double angle, double torque_Nm) const {
        return current_of([&](double current_A) { return torque(angle, current_A); }, torque_Nm);
    }
    double current_of_flux(double angle, double flux_Wb) const {
        return current_of([&](double current_A) { return flux(angle, current_A); }, flux_Wb);
    }
    template <typename function_t> static double current_of(const function_t &function, double target) {
        int32_t below = 0, above = PHASE_MAP_CURRENT_MAX_Q9 + 1;
        while (above - below > 1) {
            const int32_t middle = (below + above) / 2;
            (function(middle / Q9) <= target ? below : above) = middle;
        }
        return below / Q9;
    }
};

const tables_t TABLES;

predictive_torque_parameters_t parameters_of(double reserve_Nm = 0.0, double current_limit_A = 52.0,
                                             bool sharing = true) {
    parameters_t p;
    parameters_init(&p);
    p.values[PARAMETER_TORQUE_RESERVE_NM] = to_fixed(reserve_Nm, Q24);
    p.values[PARAMETER_CURRENT_LIMIT_A] = to_fixed(current_limit_A, Q9);
    p.values[PARAMETER_TORQUE_SHARING] = sharing;
    return configure_control(&p, &machine_tables, RATE_HZ, 17, 12).predictive;
}

// A machine that equals its tables: exact flux linkages, currents from the tables, 12-bit ADC.
class Machine {
  public:
    explicit Machine(const predictive_torque_parameters_t &p)
        : parameters(p), model(reference_model::model_of(p, &TABLES, PHASES)) {
        predictive_torque_reset(&control);
    }

    // One period at a speed in electrical revolutions per period and a torque reference: duties of firmware and model.
    // Those of the firmware act on the machine one period later.
    void step(double speed_rev, double reference_Nm) {
        int32_t current_q9[HAL_PHASES_MAX] = {}, flux_q29[HAL_PHASES_MAX] = {};
        uint32_t angle[HAL_PHASES_MAX] = {};
        reference_model::predictive_t<tables_t>::sample_t seen{};
        torque_Nm = opposed_Nm = 0.0;
        for (unsigned phase = 0; phase < PHASES; phase++) {
            const double angle_rev = wrapped(position - double(phase) / PHASES);
            const double mirrored = angle_rev >= 0.5 ? angle_rev : 1.0 - angle_rev;
            const double current_A = flux[phase] > 0.0 ? TABLES.current_of_flux(mirrored, flux[phase]) : 0.0;
            const double magnitude_Nm = TABLES.torque(mirrored, current_A);
            torque_Nm += angle_rev >= 0.5 ? magnitude_Nm : -magnitude_Nm;
            opposed_Nm += angle_rev >= 0.5 ? 0.0 : magnitude_Nm;
            // An ADC count is 10 LSB of Q9.
            current_q9[phase] = int32_t(std::floor(current_A * Q9 / 10.0 + 0.5)) * 10;
            const phase_map_lookup_t lookup = tables_t::at(angle_rev);
            flux_q29[phase] = phase_map_flux_q29(&lookup, current_q9[phase]);
            angle[phase] = uint32_t(wrapped(angle_rev + 2.0 * speed_rev) * REV);
            seen.current_A[phase] = current_q9[phase] / Q9;
            seen.table_Wb[phase] = flux_q29[phase] / Q29;
            seen.angle[phase] = planned_angle[phase] = angle[phase] / REV;
            // Until the next sample the duty of the previous period acts.
            const double drop = current_A * 0.05 / RATE_HZ;
            flux[phase] = std::max(flux[phase] + acting[phase] * BUS_V / RATE_HZ - drop, 0.0);
        }
        position = wrapped(position + speed_rev);
        const int32_t reference_q24 = to_fixed(reference_Nm, Q24);
        seen.bus_V = BUS_V;
        seen.torque_Nm = reference_q24 / Q24;
        seen.reverse = speed_rev < 0.0;
        seen.angle_step = std::fabs(speed_rev);
        const torque_sharing_window_t window =
            predictive_torque_move_windows(&parameters, &advance_q30, reference_q24, control.torque_shortfall_q24);
        const predictive_torque_sample_t sample = {.current_q9 = current_q9,
                                                   .flux_q29 = flux_q29,
                                                   .window = &window,
                                                   .angle = angle,
                                                   .bus_voltage_q6 = int32_t(BUS_V * Q6),
                                                   .torque_q24 = reference_q24,
                                                   .reverse = speed_rev < 0.0,
                                                   .angle_step = uint32_t(std::fabs(speed_rev) * REV)};
        predictive_torque_step(&parameters, &control, &machine_tables, &sample, duty_q15);
        model.step(seen);
        for (unsigned phase = 0; phase < PHASES; phase++) {
            acting[phase] = duty_q15[phase] / Q15;
        }
    }

    // Largest difference of the torques that the duties lead to, N m. Duties are less significant: without flux linkage
    // -1 and 0 are equivalent, and at the end of its window a phase has hardly any torque at any current.
    double difference_Nm() const {
        double worst = 0.0;
        for (unsigned phase = 0; phase < PHASES; phase++) {
            const double fixed = torque_after(phase, duty_q15[phase] / Q15);
            worst = std::max(worst, std::fabs(fixed - torque_after(phase, model.duty[phase])));
        }
        return worst;
    }

    predictive_torque_parameters_t parameters;
    predictive_torque_t control;
    int32_t advance_q30 = 0;
    reference_model::predictive_t<tables_t> model;
    int32_t duty_q15[HAL_PHASES_MAX] = {};
    double flux[PHASES] = {}, acting[PHASES] = {};
    double position = 0.3, torque_Nm = 0.0, opposed_Nm = 0.0; // opposed_Nm: of the braking phases

  private:
    // Magnitude of the torque after the duty has acted.
    double torque_after(unsigned phase, double duty) const {
        const double planned = wrapped(planned_angle[phase]);
        const double mirrored = planned >= 0.5 ? planned : 1.0 - planned;
        const double flux_Wb = control.flux_q29[phase] / Q29 + duty * BUS_V / RATE_HZ;
        return flux_Wb > 0.0 ? TABLES.torque(mirrored, TABLES.current_of_flux(mirrored, flux_Wb)) : 0.0;
    }

    double planned_angle[PHASES] = {};

    static double wrapped(double rev) { return rev - std::floor(rev); }
};

// Electrical revolutions per period.
double speed_of(double rpm) {
    return rpm / 60.0 * machine_tables.rotor_poles / RATE_HZ;
}

// Each period starts with the state of the firmware in both, so that differences do not accumulate. Where only one of
// the two reaches a constraint, the redistributed torque differs slightly.
TEST(PredictiveTorque, duties_equal_the_reference_model_in_four_quadrants_with_and_without_reserve_and_overlap) {
    for (const double reserve_Nm : {0.0, 8.0}) {
        for (const bool sharing : {true, false}) {
            for (const double rpm : {150.0, 1500.0, 3000.0, -150.0, -1500.0, -3000.0}) {
                for (const double torque_Nm : {0.0, 0.5, 8.0, 19.0, -0.5, -8.0, -19.0}) {
                    Machine machine(parameters_of(reserve_Nm, 52.0, sharing));
                    double worst = 0.0, sum = 0.0, shortfall = 0.0;
                    for (int k = 0; k < 1500; k++) {
                        for (unsigned phase = 0; phase < PHASES; phase++) {
                            machine.model.flux[phase] = machine.control.flux_q29[phase] / Q29;
                            machine.model.duty[phase] = machine.control.duty_q15[phase] / Q15;
                        }
                        machine.model.advance = machine.advance_q30 / Q30;
                        machine.model.torque_shortfall = machine.control.torque_shortfall_q24 / Q24;
                        machine.step(speed_of(rpm), torque_Nm * (1.0 + 0.2 * std::sin(k * 0.01)));
                        worst = std::max(worst, machine.difference_Nm());
                        sum += machine.difference_Nm();
                        shortfall = std::max(shortfall, std::fabs(machine.control.torque_shortfall_q24 / Q24 -
                                                                  machine.model.torque_shortfall));
                    }
                    SCOPED_TRACE(testing::Message() << reserve_Nm << " N m reserve, sharing " << sharing << ", " << rpm
                                                    << " r/min, " << torque_Nm << " N m");
                    EXPECT_LT(worst, 0.03);
                    EXPECT_LT(sum / 1500, 0.005);
                    EXPECT_LT(shortfall, 0.03);
                }
            }
        }
    }
}

TEST(PredictiveTorque, produces_the_reference_torque_two_periods_later_in_four_quadrants) {
    for (const double rpm : {150.0, 600.0, -150.0, -600.0}) {
        for (const double torque_Nm : {0.5, 2.0, 8.0, -0.5, -2.0, -8.0}) {
            Machine machine(parameters_of());
            double worst = 0.0;
            for (int k = 0; k < 4000; k++) {
                machine.step(speed_of(rpm), torque_Nm);
                worst = k >= 200 ? std::max(worst, std::fabs(machine.torque_Nm - torque_Nm)) : worst;
            }
            // LSB of a current, 0.02 A, rounding of the shares, and the voltage limit during commutation.
            EXPECT_LT(worst, 0.02 + 0.02 * std::fabs(torque_Nm)) << rpm << " r/min, " << torque_Nm << " N m";
        }
    }
}

TEST(PredictiveTorque, a_reserve_adds_opposed_torque_and_keeps_the_total) {
    for (const double reserve_Nm : {0.0, 8.0}) {
        Machine machine(parameters_of(reserve_Nm));
        double worst = 0.0, least_opposed_Nm = 100.0, most_opposed_Nm = 0.0;
        for (int k = 0; k < 4000; k++) {
            machine.step(speed_of(150.0), 1.0);
            if (k >= 200) {
                worst = std::max(worst, std::fabs(machine.torque_Nm - 1.0));
                least_opposed_Nm = std::min(least_opposed_Nm, machine.opposed_Nm);
                most_opposed_Nm = std::max(most_opposed_Nm, machine.opposed_Nm);
            }
        }
        // 8 N m in one half, so 7 N m in the other.
        EXPECT_NEAR(least_opposed_Nm, reserve_Nm > 0.0 ? 7.0 : 0.0, 0.3);
        EXPECT_NEAR(most_opposed_Nm, reserve_Nm > 0.0 ? 7.0 : 0.0, 0.3);
        EXPECT_LT(worst, 0.3);
    }
}

TEST(PredictiveTorque, advances_within_100_ms_during_a_shortfall_and_returns_within_a_second) {
    Machine machine(parameters_of());
    int up = 0;
    while (machine.advance_q30 < 1 << 30 && up < 2 * int(RATE_HZ)) {
        machine.step(speed_of(4500.0), 19.0);
        up++;
    }
    EXPECT_GE(up, int(RATE_HZ) / 10);
    EXPECT_LT(up, int(RATE_HZ) / 5) << "voltage does not suffice in most periods";
    EXPECT_GT(machine.control.torque_shortfall_q24, 0);
    int down = 0;
    while (machine.advance_q30 > 0 && down < 2 * int(RATE_HZ)) {
        machine.step(speed_of(150.0), 1.0);
        down++;
    }
    EXPECT_NEAR(down, int(RATE_HZ), 0.02 * RATE_HZ);
}

TEST(PredictiveTorque, no_phase_exceeds_its_current_limit_by_more_than_2_percent_and_the_shortfall_is_reported) {
    const double limit_A = 10.0;
    Machine machine(parameters_of(0.0, limit_A));
    double largest = 0.0, shortfall = 0.0;
    for (int k = 0; k < 4000; k++) {
        machine.step(speed_of(150.0), 15.0);
        for (unsigned phase = 0; phase < PHASES; phase++) {
            double angle_rev = machine.position - phase / 3.0;
            angle_rev -= std::floor(angle_rev);
            largest = std::max(
                largest, TABLES.current_of_flux(angle_rev >= 0.5 ? angle_rev : 1.0 - angle_rev, machine.flux[phase]));
        }
        shortfall = k > 200 ? std::max(shortfall, machine.control.torque_shortfall_q24 / Q24) : shortfall;
    }
    EXPECT_GT(largest, 0.97 * limit_A);
    EXPECT_LT(largest, 1.02 * limit_A);
    EXPECT_GT(shortfall, 1.0);
    EXPECT_LT(shortfall, 15.0);
}

TEST(PredictiveTorque, a_phase_above_the_current_limit_gets_no_positive_voltage_at_any_reference) {
    const predictive_torque_parameters_t p = parameters_of(0.0, 10.0);
    predictive_torque_t control;
    predictive_torque_reset(&control);
    const int32_t current_q9[HAL_PHASES_MAX] = {10 * 512 + 1, 0, 0, 0};
    const int32_t flux_q29[HAL_PHASES_MAX] = {};
    const uint32_t angle[HAL_PHASES_MAX] = {0xC0000000u, 0xC0000000u, 0x80000000u, 0};
    const predictive_torque_sample_t sample = {.current_q9 = current_q9,
                                               .flux_q29 = flux_q29,
                                               .window = &p.base_window,
                                               .angle = angle,
                                               .bus_voltage_q6 = 240 * 64,
                                               .torque_q24 = 19 << 24,
                                               .reverse = false,
                                               .angle_step = 0};
    int32_t duty_q15[HAL_PHASES_MAX] = {};
    predictive_torque_step(&p, &control, &machine_tables, &sample, duty_q15);
    EXPECT_LE(duty_q15[0], 0);
    EXPECT_EQ(duty_q15[1], 32768);
}

TEST(PredictiveTorque, a_braking_phase_carries_only_the_flux_linkage_that_the_voltage_removes_before_unaligned) {
    // References far beyond its torque, angles between aligned and unaligned, both directions of rotation.
    for (const bool reverse : {false, true}) {
        for (int tenths = 2; tenths < 9; tenths++) {
            const double travel_rev = 0.05 * tenths; // to unaligned
            const double step_rev = 0.02;            // fast enough for every limit to be below 79 A
            predictive_torque_t control;
            predictive_torque_reset(&control);
            const predictive_torque_parameters_t p = parameters_of(0.0, 79.0);
            const double flux_step = 240.0 / RATE_HZ;
            control.flux_q29[0] = int32_t(flux_step * travel_rev / step_rev * Q29);
            const int32_t current_q9[HAL_PHASES_MAX] = {};
            const int32_t flux_q29[HAL_PHASES_MAX] = {control.flux_q29[0], 0, 0, 0};
            const uint32_t angle[HAL_PHASES_MAX] = {uint32_t((reverse ? 0.5 + travel_rev : 0.5 - travel_rev) * REV), 0,
                                                    0, 0};
            const predictive_torque_sample_t sample = {.current_q9 = current_q9,
                                                       .flux_q29 = flux_q29,
                                                       .window = &p.base_window,
                                                       .angle = angle,
                                                       .bus_voltage_q6 = 240 * 64,
                                                       .torque_q24 = (reverse ? 40 : -40) * (1 << 24),
                                                       .reverse = reverse,
                                                       .angle_step = uint32_t(step_rev * REV)};
            int32_t duty_q15[HAL_PHASES_MAX] = {};
            predictive_torque_step(&p, &control, &machine_tables, &sample, duty_q15);
            EXPECT_NEAR(duty_q15[0], 0, 200) << "at the limit already: " << travel_rev;
            predictive_torque_sample_t still = sample;
            still.angle_step = 0;
            predictive_torque_reset(&control);
            control.flux_q29[0] = flux_q29[0];
            predictive_torque_step(&p, &control, &machine_tables, &still, duty_q15);
            EXPECT_GT(duty_q15[0], 20000) << "no limit at standstill: " << travel_rev;
        }
    }
}

TEST(PredictiveTorque, without_reference_every_switch_is_open) {
    Machine machine(parameters_of());
    for (int k = 0; k < 400; k++) {
        machine.step(speed_of(300.0), k < 200 ? 8.0 : 0.0);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_EQ(machine.duty_q15[phase], -32768);
        EXPECT_EQ(machine.control.flux_q29[phase], 0);
    }
}

uint32_t random_angle_step(std::mt19937 &random) {
    return uint32_t(random()) >> (random() % 32);
}

TEST(PredictiveTorque, any_sample_gives_duties_within_one_and_overflows_nothing) {
    std::mt19937 random(7);
    for (int i = 0; i < 20000; i++) {
        predictive_torque_parameters_t p = parameters_of(i % 3 == 0 ? 20.0 : 0.0);
        p.current_limit_q9 = int32_t(random() % (79 * 512)) + 512;
        predictive_torque_t control{};
        int32_t advance_q30 = 0;
        int32_t current_q9[HAL_PHASES_MAX], flux_q29[HAL_PHASES_MAX], duty_q15[HAL_PHASES_MAX];
        uint32_t angle[HAL_PHASES_MAX];
        for (int k = 0; k < 4; k++) {
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                current_q9[phase] = int32_t(random() % 40951);
                flux_q29[phase] = int32_t(random() >> 1);
                angle[phase] = uint32_t(random());
            }
            const int32_t references[] = {INT32_MIN, INT32_MAX, 0, int32_t(random())};
            const int32_t voltages[] = {0, 1, 512 * 64 - 1, int32_t(random() % (512 * 64))};
            const int32_t reference_q24 = references[k];
            const torque_sharing_window_t window =
                predictive_torque_move_windows(&p, &advance_q30, reference_q24, control.torque_shortfall_q24);
            const predictive_torque_sample_t sample = {.current_q9 = current_q9,
                                                       .flux_q29 = flux_q29,
                                                       .window = &window,
                                                       .angle = angle,
                                                       .bus_voltage_q6 = voltages[random() % 4],
                                                       .torque_q24 = reference_q24,
                                                       .reverse = i % 2 == 0,
                                                       .angle_step = random_angle_step(random)};
            predictive_torque_step(&p, &control, &machine_tables, &sample, duty_q15);
            for (unsigned phase = 0; phase < PHASES; phase++) {
                ASSERT_GE(duty_q15[phase], -32768);
                ASSERT_LE(duty_q15[phase], 32768);
                ASSERT_GE(control.flux_q29[phase], 0);
            }
            ASSERT_GE(advance_q30, 0);
            ASSERT_LE(advance_q30, 1 << 30);
        }
    }
}

} // namespace
