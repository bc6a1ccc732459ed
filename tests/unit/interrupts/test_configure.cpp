// From a user's parameters to the interrupt's: every conversion against double precision, at all control rates.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <random>
#include <string>

#include <gtest/gtest.h>

extern "C" {
#include "control/phase_map.h"
#include "fixed/formats.h"
#include "interrupts/configure.h"
#include "interrupts/configure_torque.h"
#include "interrupts/deferred.h"
}

#include "support/configured.h"
#include "support/reference_models.h"

namespace {

const uint32_t TIMER_CLOCKS_HZ[] = {50000000, 100000000, 200000000, 400000000}; // of which every rate can be made
const double RATES_HZ[] = {20000.0, 40000.0, 50000.0, 100000.0, 1000000.0};

double value_of(const parameters_t &parameters, unsigned index) {
    return std::ldexp(double(parameters.values[index]), -machine_tables.parameter_fraction_bits[index]);
}

double held(double value) {
    return std::clamp(value, -2147483648.0, 2147483647.0);
}

// Rotation since an edge of the encoder, to 2^-29 of it, for every age that is not cut off.
void expect_edge_timing(const control_parameters_t &c, uint32_t timer_clock_hz) {
    const double exact = fixed_point::REV / (2.0 * fixed_point::PI) / timer_clock_hz; // 2^-32 rev per rad/s and tick
    const double got = std::ldexp(c.edge_angle_per_tick_q51, 22 + int(c.edge_age_shift) - 64);
    ASSERT_NEAR(got * std::ldexp(1.0, -int(machine_tables.speed_exponent)), exact, exact * std::ldexp(1.0, -29));
    ASSERT_LT(std::ldexp(double(c.edge_age_max_ticks), c.edge_age_shift), 2147483648.0);
    ASSERT_EQ(c.edge_age_max_ticks, timer_clock_hz / 10000) << "100 us";
}

// Flux linkage that is left below the trip, at the angle with the least of it, when full voltage has driven a phase
// from a current on for some periods: a phase map in double precision.
double room_below_trip(int32_t current_q9, int32_t trip_q9, double rate_hz, double periods) {
    const double rise_A = std::min(machine_tables.current_slew_rate_A_s / rate_hz * periods, 79.99);
    const double gained = phase_map_flux_q29(&machine_tables, 0, int32_t(rise_A * fixed_point::Q9));
    double least = 1e12;
    for (unsigned row = 0; row < MACHINE_ROWS; row++) {
        const uint32_t distance = std::min(machine_tables.row[row].start, HALF_REV - 1u);
        least = std::min(least, double(phase_map_flux_q29(&machine_tables, distance, trip_q9)) - gained -
                                    phase_map_flux_q29(&machine_tables, distance, current_q9));
    }
    return least;
}

// A tenth more than two periods from the limit, and than one from where duty control ends, do not reach the trip, and
// from a current that is 1/64 A higher they do.
void expect_currents_below_trip(const control_parameters_t &c, const parameters_t &p, double rate_hz) {
    const int32_t trip_q9 = p.values[PARAMETER_CURRENT_TRIP_A], limit_q9 = p.values[PARAMETER_CURRENT_LIMIT_A];
    const auto expect_highest = [&](int32_t current_q9, double periods) {
        const double slack = 16384.0; // 30 uWb: of a rounded rise
        if (current_q9 > 0) {
            ASSERT_GE(room_below_trip(current_q9, trip_q9, rate_hz, periods), -slack) << periods;
        }
        if (current_q9 < std::min(trip_q9, PHASE_MAP_CURRENT_MAX_Q9)) {
            ASSERT_LT(room_below_trip(current_q9 + 8, trip_q9, rate_hz, periods), slack) << periods;
        }
    };
    ASSERT_EQ(c.hysteresis.current_limit_q9, std::min(c.hysteresis.generating_limit_q9, limit_q9));
    const double slope_A = double(trip_q9 - c.hysteresis.generating_limit_q9) / c.flux_monitor.encoder.over_speed_q22;
    ASSERT_NEAR(c.hysteresis.generating_slope_q19, held(slope_A * fixed_point::Q32), 1.0) << "two periods more";
    if (c.hysteresis.current_limit_q9 < limit_q9) {
        ASSERT_NO_FATAL_FAILURE(expect_highest(c.hysteresis.current_limit_q9, 2.2));
        if (c.duty.current_ceiling_q9 > limit_q9) { // else it is the limit
            const int32_t period_q9 = int32_t(std::lround(std::ldexp(1.0, 33) / c.duty.ceiling_gain_q24));
            ASSERT_NO_FATAL_FAILURE(expect_highest(c.duty.current_ceiling_q9 - period_q9, 1.1));
            ASSERT_NEAR(c.duty.current_ceiling_q9 - 2 * period_q9, c.hysteresis.current_limit_q9, 1.0);
        }
    }
    ASSERT_GE(c.duty.current_ceiling_q9, limit_q9);
}

// All the conversions, for one set of parameters.
void expect_converted(const parameters_t &p, double rate_hz, unsigned encoder_bits,
                      uint32_t timer_clock_hz = fixed_point::TIMER_CLOCK_HZ) {
    const control_parameters_t c =
        configure_control(&p, &machine_tables, uint32_t(rate_hz), encoder_bits, 12, timer_clock_hz);
    const auto v = [&](unsigned index) { return value_of(p, index); };
    // Within lsb LSBs of the format, or of 1 in 10^9 for what has more than 30 bits.
    const auto near = [](const char *what, double got, double exact, double lsb) {
        ASSERT_LE(std::fabs(got - held(exact)), lsb + 1e-9 * std::fabs(exact)) << what;
    };
    const double scale_Nm = v(PARAMETER_BP_ERROR_SCALE_NM);
    const auto pid_scale = [&](unsigned index) {
        return std::min(v(index) * scale_Nm * rate_hz / 40000.0, 4.0) * fixed_point::Q15;
    };
    const auto pitch = [&](unsigned index) {
        return std::min(v(index) / 360.0 * fixed_point::REV, fixed_point::REV - 1.0);
    };

    const bool salient = p.values[PARAMETER_CONTROLLER] == DRIVE_CONTROLLER_SALIENT;

    ASSERT_EQ(int(c.controller), p.values[PARAMETER_CONTROLLER]);
    const bool traditional = p.values[PARAMETER_CONTROLLER] == DRIVE_CONTROLLER_TRADITIONAL;
    ASSERT_EQ(c.speed_law, traditional ? SPEED_LAW_PI : SPEED_LAW_SMC);
    ASSERT_EQ(c.torque_law, salient                                                    ? TORQUE_LAW_PREDICTIVE
                            : traditional || p.values[PARAMETER_BP_MODE] == BP_PID_OFF ? TORQUE_LAW_HYSTERESIS
                                                                                       : TORQUE_LAW_DUTY);
    ASSERT_EQ(c.speed_reference_min_q22, salient ? INT32_MIN : 0);
    ASSERT_EQ(2.0 * c.period_ticks * rate_hz, double(timer_clock_hz));
    expect_edge_timing(c, timer_clock_hz);
    ASSERT_EQ(c.encoder_shift, 32 - encoder_bits);
    ASSERT_EQ(c.encoder_middle, encoder_bits == 32 ? 0u : 1u << (31 - encoder_bits));
    ASSERT_EQ(c.initialise_ticks, uint32_t(rate_hz / 1000.0));

    const double ramp = fixed_point::rad_s(v(PARAMETER_SPEED_RAMP_RPM_S)) / rate_hz * fixed_point::Q22;
    near("speed ramp", c.speed_ramp_q22, ramp == 0.0 ? INT32_MAX : std::max(ramp, 1.0), 1.0);

    near("kp", c.speed_pi.kp_q16, v(PARAMETER_SPEED_KP) * fixed_point::Q16, 0.0);
    near("ki", c.speed_pi.ki_step_q32, v(PARAMETER_SPEED_KI) / rate_hz * fixed_point::Q32, 1.0);
    ASSERT_EQ(c.speed_pi.torque_min_q24, 0);
    near("torque max", c.speed_pi.torque_max_q24, v(PARAMETER_TORQUE_MAX_NM) * fixed_point::Q24, 0.0);

    near("smc gain", c.speed_smc.gain_q24, v(PARAMETER_INERTIA_KG_M2) * v(PARAMETER_SMC_K) * fixed_point::Q24, 0.51);
    // Reduced where J k / epsilon would be less than 5/4 of the torque limit.
    const double limit_Nm = 1.25 * v(PARAMETER_TORQUE_MAX_NM) + 1e-9;
    const double reaching_Nm = v(PARAMETER_INERTIA_KG_M2) * v(PARAMETER_SMC_K);
    const double epsilon = std::max(std::min(v(PARAMETER_SMC_EPSILON), reaching_Nm / limit_Nm), std::ldexp(1.0, -15));
    near("epsilon", c.speed_smc.epsilon_q31, std::ldexp(epsilon, 31), 2.0 + 128.0 / limit_Nm + 1e-6 * epsilon * 2e9);
    near("delta", c.speed_smc.delta_q27, std::ldexp(v(PARAMETER_SMC_DELTA) / std::log(2.0), 27), 1.01);
    near("friction", c.speed_smc.friction_q30, v(PARAMETER_FRICTION_NM_S) * fixed_point::Q30, 0.0);
    ASSERT_EQ(c.torque_mode.torque_min_q24, salient ? -c.torque_mode.torque_max_q24 : 0);
    near("torque max", c.torque_mode.torque_max_q24, v(PARAMETER_TORQUE_MAX_NM) * fixed_point::Q24, 0.0);

    near("turn on", c.commutation.turn_on, 0.0, fixed_point::REV);
    ASSERT_LE(std::fabs(c.commutation.turn_on - pitch(PARAMETER_TURN_ON_ANGLE_DEG)), 1.0);
    const double active = pitch(PARAMETER_TURN_OFF_ANGLE_DEG) - pitch(PARAMETER_TURN_ON_ANGLE_DEG);
    const double available = pitch(PARAMETER_OUTGOING_OFF_ANGLE_DEG) - pitch(PARAMETER_TURN_ON_ANGLE_DEG);
    ASSERT_LE(std::fabs(c.commutation.active_width - std::max(active, 0.0)), 2.0);
    ASSERT_LE(std::fabs(c.commutation.available_width - std::max({active, available, 0.0})), 2.0);
    ASSERT_EQ(c.commutation.phases, machine_tables.phases);
    ASSERT_EQ(c.commutation.rotor_poles, machine_tables.rotor_poles);
    const pwm_ditc_setpoints_t aims = pwm_ditc_setpoints(&machine_tables, pitch(PARAMETER_HAND_OVER_ANGLE_DEG));
    for (unsigned k = 0; k < PWM_DITC_SETPOINTS; k++) {
        ASSERT_NEAR(c.duty.current_setpoints.current_q9[k], aims.current_q9[k], 1.0) << k;
    }

    near("inner", c.hysteresis.band_inner_q24, v(PARAMETER_TORQUE_BAND_INNER_NM) * fixed_point::Q24, 0.0);
    near("outer", c.hysteresis.band_outer_q24, v(PARAMETER_TORQUE_BAND_OUTER_NM) * fixed_point::Q24, 0.0);
    near("limit", c.duty.current_limit_q9, v(PARAMETER_CURRENT_LIMIT_A) * fixed_point::Q9, 0.0);
    ASSERT_NO_FATAL_FAILURE(expect_currents_below_trip(c, p, rate_hz));
    near("assist", c.duty.band_outer_q24, v(PARAMETER_BP_ASSIST_BAND_NM) * fixed_point::Q24, 0.0);
    near("incoming gain", c.duty.incoming_gain_q24,
         0.5 * rate_hz / machine_tables.current_slew_rate_A_s * fixed_point::Q24, 1.0);

    ASSERT_EQ(int(c.duty.pid.mode), p.values[PARAMETER_BP_MODE]);
    ASSERT_EQ(int32_t(c.duty.pid.seed), p.values[PARAMETER_BP_SEED]);
    near("scale", c.duty.pid.error_scale_inverse_q24, fixed_point::Q24 / scale_Nm, 1.0);
    near("kp scale", c.duty.pid.scale_q28[0] / 8192.0, pid_scale(PARAMETER_BP_KP_MAX), 0.5 * rate_hz / 40000.0 + 1.0);
    near("ki scale", c.duty.pid.scale_q28[1] / 8192.0, pid_scale(PARAMETER_BP_KI_MAX), 0.5 * rate_hz / 40000.0 + 1.0);
    near("kd scale", c.duty.pid.scale_q28[2] / 8192.0, pid_scale(PARAMETER_BP_KD_MAX), 0.5 * rate_hz / 40000.0 + 1.0);
    near("eta", c.duty.pid.network.learning_rate_q15, v(PARAMETER_BP_LEARNING_RATE) * fixed_point::Q15, 1.0);
    near("alpha", c.duty.pid.network.momentum_q32, v(PARAMETER_BP_MOMENTUM) * fixed_point::Q32, 1.0);

    const double count = std::ldexp(1.0, 32 - int(encoder_bits));
    const double fastest =
        fixed_point::rad_s(v(PARAMETER_OVER_SPEED_RPM)) / rate_hz / (2.0 * fixed_point::PI) * fixed_point::REV;
    near("trip", c.protection.current_trip_q9, v(PARAMETER_CURRENT_TRIP_A) * fixed_point::Q9, 0.0);
    near("over-voltage", c.protection.dc_link_over_voltage_q6, v(PARAMETER_OVER_VOLTAGE_V) * 64.0, 0.0);
    near("under-voltage", c.protection.dc_link_under_voltage_q6, v(PARAMETER_UNDER_VOLTAGE_V) * 64.0, 0.0);
    near("over-speed", c.flux_monitor.encoder.over_speed_q22,
         fixed_point::rad_s(v(PARAMETER_OVER_SPEED_RPM)) * fixed_point::Q22, 0.6);
    near("step", c.protection.angle_step_max, 0.0, fixed_point::REV);
    ASSERT_LE(std::fabs(c.protection.angle_step_max - (1.5 * fastest + 2.0 * count)), 3.0 + 1e-6 * fastest);
    const double travel_max = std::max(fixed_point::REV / 1440.0 + 4.0 * count, 16.0 * count);
    ASSERT_LE(std::fabs(c.protection.undetected_travel_max - travel_max), 1.0);
    ASSERT_EQ(c.protection.angle_step_q32, c.observer.angle_step_q32);
    near("slowing", c.protection.deceleration_max_q22, 40.0 / v(PARAMETER_INERTIA_KG_M2) / rate_hz * fixed_point::Q22,
         2.0);
    const double slew = v(PARAMETER_TORQUE_SLEW_RATE_NM_S) / rate_hz * fixed_point::Q24;
    near("torque slew", c.torque_mode.slew_q24, slew == 0.0 ? INT32_MAX : std::max(slew, 1.0), 1.0);
    near("fold-back", c.torque_mode.speed_end_q22, c.flux_monitor.encoder.over_speed_q22 * 15.0 / 16.0, 1.0);
    near("speed range", c.speed_reference_max_q22,
         std::min<double>(machine_tables.speed_max_q22, c.flux_monitor.encoder.over_speed_q22 * 7.0 / 8.0 + 2.0), 2.0);
    near("timeout", c.protection.command_timeout_us, 500000.0, 0.0);

    const auto &share = c.conduction.sharing;
    const double stroke = fixed_point::REV / machine_tables.phases;
    const double least = 2.0 / 360.0 * fixed_point::REV;
    const double on_early = pitch(PARAMETER_SHARE_ON_ADVANCE_DEG);
    const double asked_width = pitch(PARAMETER_SHARE_OFF_ANGLE_DEG) - pitch(PARAMETER_SHARE_ON_ANGLE_DEG);
    const double width = std::max(asked_width, stroke + least);
    const double narrowing =
        std::min(pitch(PARAMETER_SHARE_OFF_ADVANCE_DEG) - on_early, width - stroke - least); // at full advance
    ASSERT_EQ(c.interleaved_pwm,
              (salient || c.torque_law == TORQUE_LAW_DUTY) && p.values[PARAMETER_PULSES_PER_PERIOD] == 2);
    ASSERT_EQ(c.load_from_transducer, p.values[PARAMETER_LOAD_SOURCE] == 1);
    ASSERT_EQ(share.overlapping, p.values[PARAMETER_TORQUE_SHARING] == 1);
    near("stroke", share.stroke, 0.0, fixed_point::REV);
    ASSERT_LE(std::fabs(share.stroke - stroke), 1.0);
    const bool own_windows = v(PARAMETER_SHARE_ON_ANGLE_DEG) < 180.0;
    ASSERT_EQ(c.conduction.own_windows, own_windows);
    if (own_windows) { // the window of the largest torque stands for them
        const machine_sharing_window_t &widest = machine_tables.sharing[0][0][MACHINE_SHARING_PARTS - 1];
        ASSERT_EQ(share.turn_on - (1u << 31), uint32_t(widest.on) << 16);
        ASSERT_EQ(share.turn_off - (1u << 31), uint32_t(widest.off) << 16);
        ASSERT_EQ(share.turn_on_advance, 0u);
        ASSERT_EQ(share.turn_off_advance, 0u);
    } else {
        ASSERT_LE(std::fabs(share.turn_on - pitch(PARAMETER_SHARE_ON_ANGLE_DEG)), 1.0);
        ASSERT_LE(std::fabs(share.turn_off - share.turn_on - width), 4.0) << "at least 2 degrees of overlap";
        ASSERT_LE(std::fabs(share.turn_on_advance - on_early), 1.0);
        ASSERT_LE(std::fabs(share.turn_off_advance - on_early - narrowing), 4.0) << "at full advance, too";
    }
    near("current limit", c.predictive.current_limit_q9, v(PARAMETER_CURRENT_LIMIT_A) * fixed_point::Q9, 0.0);
    near("reserve", c.predictive.reserve_q24, v(PARAMETER_TORQUE_RESERVE_NM) * fixed_point::Q24, 0.0);
    near("flux gain", c.predictive.flux.gain_q30,
         std::min(v(PARAMETER_FLUX_OBSERVER_GAIN) * fixed_point::Q30, fixed_point::Q30 - 1), 0.0);
    const double q40 = std::ldexp(1.0, 40);
    near("resistance", c.predictive.flux.resistance_period_q40, v(PARAMETER_RESISTANCE_OHM) / rate_hz * q40, 1.0);
    near("period", c.predictive.period_q40, q40 / rate_hz, 1.0);
    near("advance", c.conduction.advance_step_q30, 10.0 * DEFERRED_CONDUCTION_PERIODS / rate_hz * fixed_point::Q30,
         1.0);
    near("return", c.conduction.retract_step_q30, 1.0 * DEFERRED_CONDUCTION_PERIODS / rate_hz * fixed_point::Q30, 1.0);

    const double learn_1_s = p.values[PARAMETER_ANGLE_ADAPTATION] == 1 ? v(PARAMETER_ANGLE_ADAPTATION_1_S) : 0.0;
    const double turn_rate_hz = std::floor(rate_hz / DEFERRED_LEARNING_PERIODS / machine_tables.phases);
    near("misalignment rate", c.misalignment.rate_q30, learn_1_s / turn_rate_hz * fixed_point::Q30, 1.0);
    near("common misalignment rate", c.misalignment.common_rate_q30,
         learn_1_s / 2.0 / (rate_hz / DEFERRED_COMMON_PERIODS) * fixed_point::Q30, 1.0);
    near("misalignment rate by the flux linkage", c.misalignment.flux_rate_q8,
         learn_1_s / 2.0 / turn_rate_hz * std::ldexp(1.0, 48) / (2.0 * c.misalignment.probe_angle), 1.0);
    near("inertia rate", c.misalignment.inertia_rate_q8, v(PARAMETER_INERTIA_KG_M2) * rate_hz * 256.0, 1.0);
    ASSERT_LE(std::fabs(c.misalignment.probe_angle -
                        0.01 / (2.0 * fixed_point::PI) * fixed_point::REV * machine_tables.rotor_poles),
              machine_tables.rotor_poles);

    // The observer's gains have a test of their own; here, that the right parameters get there.
    const uint32_t rate = uint32_t(rate_hz);
    const int32_t inertia_q30 = p.values[PARAMETER_INERTIA_KG_M2];
    const load_observer_model_t observer = load_observer_model(rate, inertia_q30, p.values[PARAMETER_FRICTION_NM_S]);
    const bool schedules = p.values[PARAMETER_CONTROLLER] != DRIVE_CONTROLLER_TRADITIONAL;
    const auto set_rad_s =
        uint32_t(p.values[schedules ? PARAMETER_OBSERVER_STEADY_RAD_S : PARAMETER_OBSERVER_BANDWIDTH_RAD_S]);
    const uint32_t steady_rad_s = c.bandwidth.stage[OBSERVER_BANDWIDTH_STAGES - 1].bandwidth_rad_s;
    ASSERT_LE(steady_rad_s, set_rad_s);
    ASSERT_TRUE(steady_rad_s == set_rad_s || c.bandwidth.schedule.adaptive) << "limited to what the encoder allows";
    const load_observer_gains_t gains = load_observer_gains(steady_rad_s, rate, inertia_q30);
    const load_observer_gains_t &steady = c.bandwidth.stage[OBSERVER_BANDWIDTH_STAGES - 1].gains;
    ASSERT_EQ(steady.angle_gain_q28, gains.angle_gain_q28);
    ASSERT_EQ(steady.speed_gain_q24, gains.speed_gain_q24);
    ASSERT_EQ(steady.load_gain_q28, gains.load_gain_q28);
    ASSERT_EQ(steady.load_factor_q4, gains.load_factor_q4);
    const bool wakes = schedules && p.values[PARAMETER_OBSERVER_SCHEDULING] == 1 &&
                       p.values[PARAMETER_OBSERVER_TRANSIENT_RAD_S] > p.values[PARAMETER_OBSERVER_STEADY_RAD_S];
    const parameter_index_t widest = wakes       ? PARAMETER_OBSERVER_TRANSIENT_RAD_S
                                     : schedules ? PARAMETER_OBSERVER_STEADY_RAD_S
                                                 : PARAMETER_OBSERVER_BANDWIDTH_RAD_S;
    ASSERT_EQ(c.bandwidth.stage[0].bandwidth_rad_s, p.values[widest]);
    ASSERT_EQ(c.bandwidth.schedule.threshold_count == UINT32_MAX, !wakes);
    ASSERT_EQ(c.bandwidth.schedule.threshold_edge == UINT32_MAX, !wakes);
    ASSERT_EQ(c.observer.acceleration_q32, observer.acceleration_q32);
    ASSERT_EQ(c.observer.friction_q30, observer.friction_q30);
}

TEST(Configure, converts_the_defaults_at_all_rates_and_encoders) {
    parameters_t parameters;
    parameters_init(&parameters);
    for (const double rate_hz : RATES_HZ) {
        for (unsigned bits = 8; bits <= 32; bits++) {
            SCOPED_TRACE(testing::Message() << rate_hz << " Hz, " << bits << " bits");
            ASSERT_NO_FATAL_FAILURE(expect_converted(parameters, rate_hz, bits));
        }
    }
}

TEST(Configure, converts_both_ends_of_every_parameter) {
    parameters_t parameters;
    for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
        for (const int32_t value : {parameters_row(index)->minimum, parameters_row(index)->maximum}) {
            parameters_init(&parameters);
            if (index > PARAMETER_LOAD_SOURCE) {
                parameters.values[PARAMETER_CONTROLLER] = DRIVE_CONTROLLER_SALIENT;
            }
            parameters.values[index] = value;
            for (const double rate_hz : RATES_HZ) {
                SCOPED_TRACE(testing::Message() << parameters_name(index) << " = " << value << ", " << rate_hz);
                ASSERT_NO_FATAL_FAILURE(expect_converted(parameters, rate_hz, 17));
            }
        }
    }
}

TEST(Configure, converts_random_sets_of_parameters_within_their_ranges) {
    std::mt19937_64 random(1);
    for (int i = 0; i < 5000; i++) {
        parameters_t parameters;
        parameters_init(&parameters);
        for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
            const parameter_row_t *row = parameters_row(index);
            const uint64_t width = uint64_t(int64_t(row->maximum) - row->minimum) + 1;
            parameters.values[index] = int32_t(row->minimum + int64_t(random() % width));
        }
        SCOPED_TRACE(testing::Message() << "set " << i);
        ASSERT_NO_FATAL_FAILURE(expect_converted(parameters, RATES_HZ[random() % 5], unsigned(8 + random() % 25),
                                                 TIMER_CLOCKS_HZ[random() % 4]));
    }
}

TEST(Configure, single_pulses_take_overlapping_windows_without_a_torque_reserve) {
    for (const bool sharing : {false, true}) {
        for (const int32_t reserve_q24 : {0, 1 << 24}) {
            const control_parameters_t c =
                configured(DRIVE_CONTROLLER_SALIENT, 40000, 17, 12,
                           {{PARAMETER_TORQUE_SHARING, sharing}, {PARAMETER_TORQUE_RESERVE_NM, reserve_q24}});
            EXPECT_EQ(c.conduction.single_pulse, sharing && reserve_q24 == 0) << sharing << " " << reserve_q24;
        }
    }
}

// The correction of an error of INT32_MAX would be rounded to 2^31.
TEST(Configure, a_gain_of_the_flux_observer_of_1_is_less_by_an_lsb) {
    const std::pair<int32_t, int32_t> gains[] = {{32768, (1 << 30) - 1}, {32767, 32767 << 15}, {0, 0}};
    for (const auto &[value, gain_q30] : gains) {
        const control_parameters_t control =
            configured(DRIVE_CONTROLLER_SALIENT, 20000, 17, 12, {{PARAMETER_FLUX_OBSERVER_GAIN, value}});
        EXPECT_EQ(control.predictive.flux.gain_q30, gain_q30) << value;
    }
}

TEST(Configure, a_gain_of_the_pid_of_0_is_none) {
    const parameter_index_t gains[] = {PARAMETER_BP_KP_MAX, PARAMETER_BP_KI_MAX, PARAMETER_BP_KD_MAX};
    for (unsigned off = 0; off < std::size(gains); off++) {
        const control_parameters_t c = configured(DRIVE_CONTROLLER_PAPER, 40000, 17, 12, {{gains[off], 0}});
        for (unsigned k = 0; k < std::size(gains); k++) {
            EXPECT_EQ(c.duty.pid.scale_q28[k] == 0, k == off) << off << " " << k;
        }
    }
}

TEST(Configure, the_gains_of_duty_control_refer_to_the_middle_between_turn_on_and_turn_off) {
    for (const auto &[on_deg, off_deg] : {std::pair{185, 305}, {200, 320}}) {
        const control_parameters_t c =
            configured(DRIVE_CONTROLLER_PAPER, 40000, 17, 12,
                       {{PARAMETER_TURN_ON_ANGLE_DEG, on_deg << 7}, {PARAMETER_TURN_OFF_ANGLE_DEG, off_deg << 7}});
        const auto slope_at = [&](int32_t twice_deg) {
            pwm_ditc_parameters_t at = c.duty;
            pwm_ditc_set_reference_point(&at, &machine_tables, commutation_angle_from_degrees(twice_deg << 6), 1 << 20);
            return at.torque_per_flux_q16;
        };
        EXPECT_EQ(c.duty.torque_per_flux_q16, slope_at(on_deg + off_deg)) << on_deg;
        EXPECT_NE(c.duty.torque_per_flux_q16, slope_at(on_deg + off_deg - 4)) << on_deg;
    }
}

TEST(Configure, a_machine_whose_current_hardly_rises_gets_the_largest_gain_and_not_a_wrapped_one) {
    static machine_tables_t slow = machine_tables;
    slow.current_slew_rate_A_s = 1;
    parameters_t parameters;
    parameters_init(&parameters);
    EXPECT_EQ(configure_control(&parameters, &slow, 100000, 17, 12, fixed_point::TIMER_CLOCK_HZ).duty.incoming_gain_q24,
              INT32_MAX);
}

// V, at the default trip: begin and end of both ranges of the DC-link voltage in which braking torque decreases.
TEST(Configure, braking_torque_decreases_over_the_last_32nd_of_the_voltage_or_over_the_ranges_of_the_machine) {
    static machine_tables_t tables = machine_tables;
    parameters_t parameters;
    parameters_init(&parameters);
    const double trip_V = parameters.values[PARAMETER_OVER_VOLTAGE_V] / 64.0;
    struct {
        double range_V, mean_V, begin_V, end_V, mean_begin_V, mean_end_V;
        bool longer_pulses;
    } const rows[] = {
        {0.0, 0.0, 1.0 / 32, 1.0 / 64, 1.0 / 32, 1.0 / 128, true},
        {0.01, 0.005, 1.0 / 32, 1.0 / 64, 1.0 / 32, 1.0 / 128, true},
        {0.08, 0.08, 0.08, 0.04, 0.08, 0.02, true},
        {0.12, 0.10, 0.12, 0.06, 0.10, 0.025, false},
        {0.12, 0.06, 0.12, 0.045, 0.06, 0.015, false}, // a chopper above the middle
    };
    for (const auto &row : rows) {
        tables.fold_back_q6 = uint16_t(row.range_V * trip_V * 64.0);
        tables.mean_fold_back_q6 = uint16_t(row.mean_V * trip_V * 64.0);
        const conduction_parameters_t c =
            configure_control(&parameters, &tables, 40000, 17, 12, fixed_point::TIMER_CLOCK_HZ).conduction;
        const auto below_trip = [&](int32_t voltage_q6) { return 1.0 - voltage_q6 / 64.0 / trip_V; };
        EXPECT_NEAR(below_trip(c.full_link_q6 - c.full_link_range_q6), row.begin_V, 3e-4);
        EXPECT_NEAR(below_trip(c.full_link_q6), row.end_V, 3e-4);
        EXPECT_NEAR(below_trip(c.braking_end_q6 - c.fold_back_range_q6), row.mean_begin_V, 3e-4);
        EXPECT_NEAR(below_trip(c.braking_end_q6), row.mean_end_V, 3e-4);
        const int32_t begin_q6 = c.full_link_q6 - c.full_link_range_q6;
        EXPECT_EQ(conduction_braking_q24(&c, c.full_link_q6), 0);
        EXPECT_EQ(conduction_braking_q24(&c, begin_q6 - 1), INT32_MAX);
        EXPECT_NEAR(conduction_braking_q24(&c, begin_q6), parameters.values[PARAMETER_TORQUE_MAX_NM], 2e-3 * (1 << 24));
        EXPECT_EQ(c.longer_pulses, row.longer_pulses ? 3 : 0);
    }
    // A larger limit of the torque than the machine brakes with leaves the range for what it brakes with.
    parameters.values[PARAMETER_TORQUE_MAX_NM] = 100 << 24;
    for (const unsigned largest_Nm : {20u, 40u, 60u, 70u, 255u}) {
        tables.pulse[CONDUCTION_BRAKING][0].mean_torque = uint16_t(largest_Nm << 8);
        const conduction_parameters_t c =
            configure_control(&parameters, &tables, 40000, 17, 12, fixed_point::TIMER_CLOCK_HZ).conduction;
        EXPECT_NEAR(conduction_braking_q24(&c, c.full_link_q6 - c.full_link_range_q6) / double(1 << 24),
                    std::min(2.0 * largest_Nm, 100.0), 0.03);
    }
}

TEST(Configure, the_rotation_since_an_edge_is_right_for_every_clock_and_on_the_fastest_machine) {
    const machine_tables_t bundled = machine_tables;
    parameters_t parameters;
    parameters_init(&parameters);
    for (const uint8_t exponent : {0, 3}) {
        machine_tables.speed_exponent = exponent;
        for (uint32_t clock_hz = 25000000; clock_hz <= 400000000; clock_hz += 1000000) {
            const control_parameters_t c = configure_control(&parameters, &machine_tables, 20000, 17, 12, clock_hz);
            if (exponent == 3 && c.edge_age_max_ticks < clock_hz / 10000) {
                // Only as old as the product allows, and that is at least 80 us.
                EXPECT_EQ(c.edge_age_max_ticks, 32767u >> (c.edge_age_shift - 16)) << clock_hz;
                EXPECT_GE(c.edge_age_max_ticks, clock_hz / 12500) << clock_hz;
            } else {
                ASSERT_NO_FATAL_FAILURE(expect_edge_timing(c, clock_hz)) << clock_hz;
            }
        }
    }
    machine_tables = bundled;
    const control_parameters_t c = configure_control(&parameters, &machine_tables, 40000, 17, 12, 200000000);
    EXPECT_EQ(c.edge_angle_per_tick_q51, 1834931565) << "5 ns / (2 pi)";
    EXPECT_EQ(c.edge_age_shift, 13);
}

TEST(Configure, allows_the_rates_that_the_timer_makes_exactly) {
    for (uint32_t rate_hz = 0; rate_hz <= 2000000; rate_hz += 1000) {
        const bool listed = std::count(std::begin(RATES_HZ), std::end(RATES_HZ), double(rate_hz)) > 0;
        EXPECT_EQ(configure_rate_allowed(rate_hz, fixed_point::TIMER_CLOCK_HZ), listed) << rate_hz;
    }
    EXPECT_FALSE(configure_rate_allowed(UINT32_MAX, fixed_point::TIMER_CLOCK_HZ));
    EXPECT_TRUE(configure_rate_allowed(40000, 170000000));
    EXPECT_TRUE(configure_rate_allowed(50000, 25000000));
    EXPECT_FALSE(configure_rate_allowed(1000000, 25000000)) << "12.5 ticks";
    EXPECT_FALSE(configure_rate_allowed(40000, 170000001));
    EXPECT_FALSE(configure_rate_allowed(20000, 24960000)) << "below 25 MHz";
    EXPECT_TRUE(configure_rate_allowed(20000, 400000000));
    EXPECT_FALSE(configure_rate_allowed(20000, 400040000)) << "above 400 MHz";
}

TEST(Configure, every_default_is_within_its_range_and_every_name_fits) {
    for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
        const parameter_row_t *row = parameters_row(index);
        const std::string name = parameters_name(index);
        EXPECT_LE(name.size(), size_t(PARAMETER_NAME_MAX));
        EXPECT_LT(row->minimum, row->maximum) << name;
        EXPECT_GE(machine_tables.parameter_default[index], row->minimum) << name;
        EXPECT_LE(machine_tables.parameter_default[index], row->maximum) << name;
        EXPECT_LE(machine_tables.parameter_fraction_bits[index], 30) << name;
    }
}

TEST(Configure, the_torque_without_a_phase_is_that_of_the_controller_s_current_limit) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        parameters_t parameters;
        parameters_init(&parameters);
        parameters_set_controller(&parameters, controller);
        const int32_t limit_q9 = parameters.values[PARAMETER_CURRENT_LIMIT_A] =
            parameters.values[PARAMETER_CURRENT_TRIP_A];
        const control_parameters_t control =
            configure_control(&parameters, &machine_tables, 40000, 17, 12, fixed_point::TIMER_CLOCK_HZ);
        const bool hysteresis = controller == DRIVE_CONTROLLER_TRADITIONAL;
        ASSERT_LT(control.hysteresis.current_limit_q9, limit_q9) << "a margin for the overshoot of chopping";
        EXPECT_EQ(control.degraded.current_limit_q9, hysteresis ? control.hysteresis.current_limit_q9 : limit_q9);
    }
}

} // namespace
