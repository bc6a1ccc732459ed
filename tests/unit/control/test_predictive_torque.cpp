// Predictive control of the torque by flux linkage against the double-precision twin, which asks the same tables: what
// differs is arithmetic, not the machine. Then what holds for any machine.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/predictive_torque.h"
#include "drive/configure.h"
}

#include "support/reference_models.h"

namespace {

constexpr double Q29 = 536870912.0, Q40 = 1099511627776.0, Q6 = 64.0;
constexpr unsigned PHASES = 3;
constexpr uint32_t RATE_HZ = 40000;
constexpr double BUS_V = 240.0;

// The firmware's tables with numbers instead of formats. Angles in pitches.
struct tables_t {
    static phase_map_place_t at(double angle) { return phase_map_at(&machine_tables, uint32_t(angle * twins::TURN)); }
    double torque(double angle, double current_A) const {
        const phase_map_place_t place = at(angle);
        return phase_map_torque_q24(&place, twins::to_fixed(current_A, twins::Q9)) / twins::Q24;
    }
    double flux(double angle, double current_A) const {
        const phase_map_place_t place = at(angle);
        return phase_map_flux_q29(&place, twins::to_fixed(current_A, twins::Q9)) / Q29;
    }
    // The greatest that gives no more.
    double current_of_torque(double angle, double torque_Nm) const {
        return current_of([&](double current_A) { return torque(angle, current_A); }, torque_Nm);
    }
    double current_of_flux(double angle, double flux_Wb) const {
        return current_of([&](double current_A) { return flux(angle, current_A); }, flux_Wb);
    }
    template <typename function_t> static double current_of(const function_t &gives, double wanted) {
        int32_t below = 0, above = PHASE_MAP_CURRENT_MAX_Q9 + 1;
        while (above - below > 1) {
            const int32_t middle = (below + above) / 2;
            (gives(middle / twins::Q9) <= wanted ? below : above) = middle;
        }
        return below / twins::Q9;
    }
};

using twin_t = twins::predictive_t<tables_t>;
const tables_t TABLES;

predictive_torque_parameters_t parameters_of(double reserve_Nm = 0.0, double current_limit_A = 52.0,
                                             bool sharing = true) {
    parameters_t p;
    parameters_init(&p);
    p.values[PARAMETER_TORQUE_RESERVE_NM] = twins::to_fixed(reserve_Nm, twins::Q24);
    p.values[PARAMETER_CURRENT_LIMIT_A] = twins::to_fixed(current_limit_A, twins::Q9);
    p.values[PARAMETER_TORQUE_SHARING] = sharing;
    return configure_control(&p, &machine_tables, RATE_HZ, 17, 12).predictive;
}

twin_t twin_of(const predictive_torque_parameters_t &p) {
    twin_t twin{};
    twin.machine = &TABLES;
    twin.phases = PHASES;
    twin.period_s = p.period_q40 / Q40;
    twin.resistance_ohm = p.flux.resistance_period_q40 / Q40 / twin.period_s;
    twin.flux_gain = p.flux.gain_q15 / twins::Q15;
    twin.current_limit_A = p.current_limit_q9 / twins::Q9;
    twin.reserve_Nm = p.reserve_q24 / twins::Q24;
    twin.sharing = p.share.sharing;
    const double stroke = p.share.stroke / twins::TURN;
    const auto window = [&](double on, double off) { return twins::share_t{on, stroke, off - on - stroke}; };
    const double on = p.share.turn_on / twins::TURN, off = p.share.turn_off / twins::TURN;
    twin.late = window(on, off);
    if (!p.share.sharing) {
        twin.late.overlap = 0.0;
    }
    twin.early = window(on - p.share.turn_on_early / twins::TURN, off - p.share.turn_off_early / twins::TURN);
    return twin;
}

// A machine that does what its tables say: exact flux linkages, currents by the tables, 12-bit codes.
class Machine {
  public:
    explicit Machine(const predictive_torque_parameters_t &p) : parameters(p), twin(twin_of(p)) {
        predictive_torque_reset(&control);
    }

    // One period with a rotor speed in pitches a period and a torque reference; duties of firmware and twin. Feeds the
    // machine with the firmware's, which act a period later.
    void step(double speed_pitch, double reference_Nm) {
        int32_t current_q9[HAL_PHASES_MAX] = {}, flux_q29[HAL_PHASES_MAX] = {};
        uint32_t angle[HAL_PHASES_MAX] = {};
        twin_t::sample_t seen{};
        torque_Nm = opposed_Nm = 0.0;
        for (unsigned phase = 0; phase < PHASES; phase++) {
            const double here = wrapped(position - double(phase) / PHASES);
            const double mirrored = here >= 0.5 ? here : 1.0 - here;
            const double current_A = flux[phase] > 0.0 ? TABLES.current_of_flux(mirrored, flux[phase]) : 0.0;
            const double magnitude_Nm = TABLES.torque(mirrored, current_A);
            torque_Nm += here >= 0.5 ? magnitude_Nm : -magnitude_Nm;
            opposed_Nm += here >= 0.5 ? 0.0 : magnitude_Nm;
            // A converter's code: 10 of Q9.
            current_q9[phase] = int32_t(std::floor(current_A * twins::Q9 / 10.0 + 0.5)) * 10;
            const phase_map_place_t place = tables_t::at(here);
            flux_q29[phase] = phase_map_flux_q29(&place, current_q9[phase]);
            angle[phase] = uint32_t(wrapped(here + 2.0 * speed_pitch) * twins::TURN);
            seen.current_A[phase] = current_q9[phase] / twins::Q9;
            seen.table_Wb[phase] = flux_q29[phase] / Q29;
            seen.angle[phase] = aimed[phase] = angle[phase] / twins::TURN;
            // Until the next sample the duty that was decided a period ago acts.
            const double drop = current_A * 0.05 / RATE_HZ;
            flux[phase] = std::max(flux[phase] + acting[phase] * BUS_V / RATE_HZ - drop, 0.0);
        }
        position = wrapped(position + speed_pitch);
        const int32_t reference_q24 = twins::to_fixed(reference_Nm, twins::Q24);
        seen.bus_V = BUS_V;
        seen.torque_Nm = reference_q24 / twins::Q24;
        seen.backwards = speed_pitch < 0.0;
        seen.turn = std::fabs(speed_pitch);
        const predictive_torque_sample_t sample = {current_q9,
                                                   flux_q29,
                                                   angle,
                                                   int32_t(BUS_V * Q6),
                                                   reference_q24,
                                                   speed_pitch < 0.0,
                                                   uint32_t(std::fabs(speed_pitch) * twins::TURN)};
        predictive_torque_step(&parameters, &control, &machine_tables, &sample, duty_q15);
        twin.step(seen);
        for (unsigned phase = 0; phase < PHASES; phase++) {
            acting[phase] = duty_q15[phase] / twins::Q15;
        }
    }

    // Of the torques that the duties lead to, N m. Duties themselves say less: without flux linkage -1 and 0 are the
    // same, and at the end of its window a phase gives hardly any torque, whatever its current.
    double difference_Nm() const {
        double worst = 0.0;
        for (unsigned phase = 0; phase < PHASES; phase++) {
            const double fixed = torque_after(phase, duty_q15[phase] / twins::Q15);
            worst = std::max(worst, std::fabs(fixed - torque_after(phase, twin.duty[phase])));
        }
        return worst;
    }

    predictive_torque_parameters_t parameters;
    predictive_torque_t control;
    twin_t twin;
    int32_t duty_q15[HAL_PHASES_MAX] = {};
    double flux[PHASES] = {}, acting[PHASES] = {};
    double position = 0.3, torque_Nm = 0.0, opposed_Nm = 0.0; // opposed: of the phases that brake

  private:
    // Magnitude, when the duty has acted.
    double torque_after(unsigned phase, double duty) const {
        const double ahead = wrapped(aimed[phase]);
        const double mirrored = ahead >= 0.5 ? ahead : 1.0 - ahead;
        const double flux_Wb = control.flux_q29[phase] / Q29 + duty * BUS_V / RATE_HZ;
        return flux_Wb > 0.0 ? TABLES.torque(mirrored, TABLES.current_of_flux(mirrored, flux_Wb)) : 0.0;
    }

    double aimed[PHASES] = {};

    static double wrapped(double pitches) { return pitches - std::floor(pitches); }
};

// Pitches a period.
double speed_of(double rpm) {
    return rpm / 60.0 * machine_tables.rotor_poles / RATE_HZ;
}

// The twin goes on from where the firmware is, so that a difference is one of this period. Where a clamp is hit in the
// one and just not in the other, the torque handed over differs a little, too.
TEST(PredictiveTorque, duties_are_the_twin_s_in_four_quadrants_with_and_without_reserve_and_sharing) {
    for (const double reserve_Nm : {0.0, 8.0}) {
        for (const bool sharing : {true, false}) {
            for (const double rpm : {150.0, 1500.0, 3000.0, -150.0, -1500.0, -3000.0}) {
                for (const double torque_Nm : {0.0, 0.5, 8.0, 19.0, -0.5, -8.0, -19.0}) {
                    Machine machine(parameters_of(reserve_Nm, 52.0, sharing));
                    double worst = 0.0, sum = 0.0, missing = 0.0;
                    for (int k = 0; k < 1500; k++) {
                        for (unsigned phase = 0; phase < PHASES; phase++) {
                            machine.twin.flux[phase] = machine.control.flux_q29[phase] / Q29;
                            machine.twin.duty[phase] = machine.control.duty_q15[phase] / twins::Q15;
                        }
                        machine.twin.advance = machine.control.advance_q30 / twins::Q30;
                        machine.twin.missing = machine.control.missing_q24 / twins::Q24;
                        machine.step(speed_of(rpm), torque_Nm * (1.0 + 0.2 * std::sin(k * 0.01)));
                        worst = std::max(worst, machine.difference_Nm());
                        sum += machine.difference_Nm();
                        missing = std::max(missing,
                                           std::fabs(machine.control.missing_q24 / twins::Q24 - machine.twin.missing));
                    }
                    SCOPED_TRACE(testing::Message() << reserve_Nm << " N m reserve, sharing " << sharing << ", " << rpm
                                                    << " r/min, " << torque_Nm << " N m");
                    EXPECT_LT(worst, 0.03);
                    EXPECT_LT(sum / 1500, 0.005);
                    EXPECT_LT(missing, 0.03);
                }
            }
        }
    }
}

TEST(PredictiveTorque, makes_the_torque_that_is_asked_two_periods_later_in_four_quadrants) {
    for (const double rpm : {150.0, 600.0, -150.0, -600.0}) {
        for (const double torque_Nm : {0.5, 2.0, 8.0, -0.5, -2.0, -8.0}) {
            Machine machine(parameters_of());
            double worst = 0.0;
            for (int k = 0; k < 4000; k++) {
                machine.step(speed_of(rpm), torque_Nm);
                worst = k >= 200 ? std::max(worst, std::fabs(machine.torque_Nm - torque_Nm)) : worst;
            }
            // An LSB of a current is 0.02 A; rounded shares, and what the voltage does not reach at the hand-over.
            EXPECT_LT(worst, 0.02 + 0.02 * std::fabs(torque_Nm)) << rpm << " r/min, " << torque_Nm << " N m";
        }
    }
}

TEST(PredictiveTorque, a_reserve_adds_opposed_torque_and_leaves_the_sum_as_it_is) {
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

TEST(PredictiveTorque, advances_while_torque_is_missing_within_100_ms_and_returns_within_a_second) {
    Machine machine(parameters_of());
    int up = 0;
    while (machine.control.advance_q30 < 1 << 30 && up < 2 * int(RATE_HZ)) {
        machine.step(speed_of(4500.0), 19.0);
        up++;
    }
    EXPECT_GE(up, int(RATE_HZ) / 10);
    EXPECT_LT(up, int(RATE_HZ) / 5) << "voltage does not suffice in most periods";
    EXPECT_GT(machine.control.missing_q24, 0);
    int down = 0;
    while (machine.control.advance_q30 > 0 && down < 2 * int(RATE_HZ)) {
        machine.step(speed_of(150.0), 1.0);
        down++;
    }
    EXPECT_NEAR(down, int(RATE_HZ), 0.02 * RATE_HZ);
}

TEST(PredictiveTorque, no_phase_passes_its_current_limit_by_more_than_a_percent_and_what_is_missing_is_told) {
    const double limit_A = 10.0;
    Machine machine(parameters_of(0.0, limit_A));
    double largest = 0.0, missing = 0.0;
    for (int k = 0; k < 4000; k++) {
        machine.step(speed_of(150.0), 15.0);
        for (unsigned phase = 0; phase < PHASES; phase++) {
            double here = machine.position - phase / 3.0;
            here -= std::floor(here);
            largest = std::max(largest, TABLES.current_of_flux(here >= 0.5 ? here : 1.0 - here, machine.flux[phase]));
        }
        missing = k > 200 ? std::max(missing, machine.control.missing_q24 / twins::Q24) : missing;
    }
    EXPECT_GT(largest, 0.97 * limit_A);
    EXPECT_LT(largest, 1.02 * limit_A);
    EXPECT_GT(missing, 1.0);
    EXPECT_LT(missing, 15.0);
}

TEST(PredictiveTorque, a_current_above_the_limit_gets_no_voltage_whatever_is_asked) {
    const predictive_torque_parameters_t p = parameters_of(0.0, 10.0);
    predictive_torque_t control;
    predictive_torque_reset(&control);
    const int32_t current_q9[HAL_PHASES_MAX] = {10 * 512 + 1, 0, 0, 0};
    const int32_t flux_q29[HAL_PHASES_MAX] = {};
    const uint32_t angle[HAL_PHASES_MAX] = {0xC0000000u, 0xC0000000u, 0x80000000u, 0};
    const predictive_torque_sample_t sample = {current_q9, flux_q29, angle, 240 * 64, 19 << 24, false, 0};
    int32_t duty_q15[HAL_PHASES_MAX] = {};
    predictive_torque_step(&p, &control, &machine_tables, &sample, duty_q15);
    EXPECT_LE(duty_q15[0], 0);
    EXPECT_EQ(duty_q15[1], 32768);
}

TEST(PredictiveTorque, a_phase_that_brakes_carries_what_the_voltage_takes_away_until_unaligned) {
    // Asked for far more than it can give, at every angle between aligned and unaligned, two ways round.
    for (const bool backwards : {false, true}) {
        for (int tenths = 2; tenths < 9; tenths++) {
            const double way = 0.05 * tenths; // to unaligned, pitch
            const double turn = 0.02;         // fast enough for every limit to be below 79 A
            predictive_torque_t control;
            predictive_torque_reset(&control);
            const predictive_torque_parameters_t p = parameters_of(0.0, 79.0);
            const double reach = 240.0 / RATE_HZ;
            control.flux_q29[0] = int32_t(reach * way / turn * Q29);
            const int32_t current_q9[HAL_PHASES_MAX] = {};
            const int32_t flux_q29[HAL_PHASES_MAX] = {control.flux_q29[0], 0, 0, 0};
            const uint32_t angle[HAL_PHASES_MAX] = {uint32_t((backwards ? 0.5 + way : 0.5 - way) * twins::TURN), 0, 0,
                                                    0};
            const predictive_torque_sample_t sample = {current_q9,
                                                       flux_q29,
                                                       angle,
                                                       240 * 64,
                                                       (backwards ? 40 : -40) * (1 << 24),
                                                       backwards,
                                                       uint32_t(turn * twins::TURN)};
            int32_t duty_q15[HAL_PHASES_MAX] = {};
            predictive_torque_step(&p, &control, &machine_tables, &sample, duty_q15);
            EXPECT_NEAR(duty_q15[0], 0, 200) << "at the limit already: " << way;
            predictive_torque_sample_t still = sample;
            still.turn = 0;
            predictive_torque_reset(&control);
            control.flux_q29[0] = flux_q29[0];
            predictive_torque_step(&p, &control, &machine_tables, &still, duty_q15);
            EXPECT_GT(duty_q15[0], 20000) << "no limit at standstill: " << way;
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

TEST(PredictiveTorque, any_sample_gives_a_duty_within_one_and_overflows_nothing) {
    std::mt19937 random(7);
    for (int i = 0; i < 20000; i++) {
        predictive_torque_parameters_t p = parameters_of(i % 3 == 0 ? 20.0 : 0.0);
        p.current_limit_q9 = int32_t(random() % (79 * 512)) + 512;
        predictive_torque_t control{};
        int32_t current_q9[HAL_PHASES_MAX], flux_q29[HAL_PHASES_MAX], duty_q15[HAL_PHASES_MAX];
        uint32_t angle[HAL_PHASES_MAX];
        for (int k = 0; k < 4; k++) {
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                current_q9[phase] = int32_t(random() % 40951);
                flux_q29[phase] = int32_t(random() >> 1);
                angle[phase] = uint32_t(random());
            }
            const int32_t references[] = {INT32_MIN, INT32_MAX, 0, int32_t(random())};
            const int32_t buses[] = {0, 1, 512 * 64 - 1, int32_t(random() % (512 * 64))};
            const predictive_torque_sample_t sample = {current_q9,
                                                       flux_q29,
                                                       angle,
                                                       buses[random() % 4],
                                                       references[k],
                                                       i % 2 == 0,
                                                       uint32_t(random()) >> (random() % 32)};
            predictive_torque_step(&p, &control, &machine_tables, &sample, duty_q15);
            for (unsigned phase = 0; phase < PHASES; phase++) {
                ASSERT_GE(duty_q15[phase], -32768);
                ASSERT_LE(duty_q15[phase], 32768);
                ASSERT_GE(control.flux_q29[phase], 0);
            }
            ASSERT_GE(control.advance_q30, 0);
            ASSERT_LE(control.advance_q30, 1 << 30);
        }
    }
}

} // namespace
