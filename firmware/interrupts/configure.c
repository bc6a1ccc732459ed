#include "interrupts/configure.h"

#include "control/phase_map.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "interrupts/deferred.h"

/* Reference rate of the BP-PID gains: the torque change per period scales with the period. */
#define GAIN_RATE_HZ 40000

bool configure_rate_allowed(uint32_t control_rate_hz, uint32_t timer_clock_hz) {
    return (control_rate_hz == 20000 || control_rate_hz == 40000 || control_rate_hz == 50000 ||
            control_rate_hz == 100000 || control_rate_hz == 1000000) &&
           timer_clock_hz >= HAL_PWM_CLOCK_HZ_MIN && timer_clock_hz <= HAL_PWM_CLOCK_HZ_MAX &&
           timer_clock_hz % (2u * control_rate_hz) == 0;
}

/* Laws and features of a controller. */
typedef struct {
    speed_law_t speed_law;
    torque_law_t torque_law;
    bool four_quadrant;         /* false: motors forwards only */
    bool schedules_bandwidth;   /* of the observer; false: fixed bandwidth */
    bool may_interleave_pulses; /* by the parameter `pulses_per_period` */
} controller_t;

/* The only place that distinguishes the controllers. */
static controller_t controller_from(const int32_t *values) {
    switch ((drive_controller_t)values[PARAMETER_CONTROLLER]) {
    case DRIVE_CONTROLLER_SALIENT:
        return (controller_t){
            .speed_law = SPEED_LAW_SMC,
            .torque_law = TORQUE_LAW_PREDICTIVE,
            .four_quadrant = true,
            .schedules_bandwidth = true,
            .may_interleave_pulses = true,
        };
    case DRIVE_CONTROLLER_PAPER:
        return (controller_t){
            .speed_law = SPEED_LAW_SMC,
            .torque_law = values[PARAMETER_BP_MODE] == BP_PID_OFF ? TORQUE_LAW_HYSTERESIS : TORQUE_LAW_DUTY,
            .schedules_bandwidth = true,
            .may_interleave_pulses = values[PARAMETER_BP_MODE] != BP_PID_OFF,
        };
    case DRIVE_CONTROLLER_TRADITIONAL:
    default:
        return (controller_t){.speed_law = SPEED_LAW_PI, .torque_law = TORQUE_LAW_HYSTERESIS};
    }
}

/* pi / 30: r/min to rad/s. */
#define PI_30_Q37 INT64_C(14392573551)

/* rad/s with 22 fraction bits from whole r/min, any value: Q9.22 up to 4889 r/min. */
static int64_t speed_q22_from_rpm(int32_t rpm) {
    return fixed_shift(rpm * PI_30_Q37, 15);
}

/* 2^-32 electrical revolution from electrical degrees in Q7; 360 degrees saturate just below one revolution. */
static uint32_t angle_from_degrees(int32_t degrees_q7) {
    const int64_t angle = fixed_divide((int64_t)degrees_q7 << 32, 360 * 128);
    return angle > UINT32_MAX ? UINT32_MAX : (uint32_t)angle;
}

/* Value of one count in Q18 for a full scale below 2^16; exact. */
#define COUNT_SCALE_Q18(full_scale, bits) ((int32_t)(((int64_t)(full_scale) << 18) >> (bits)))

/* log2(e). */
#define LOG2_E_Q30 1549082005

/* Speed change per period, rad/s Q9.22, at least 1 LSB, from r/min per second; 0, no ramp, becomes INT32_MAX. */
static int32_t ramp_q22(int32_t rpm_s, uint32_t control_rate_hz) {
    if (rpm_s == 0) {
        return INT32_MAX;
    }
    const int64_t step_q22 = fixed_divide(speed_q22_from_rpm(rpm_s), control_rate_hz);
    return fixed_clamp(fixed_saturate(step_q22), 1, INT32_MAX);
}

/* Largest speed reference: the highest speed of the machine, but not above the speed from which on torque mode reduces
 * the driving torque, 7/8 of over_speed_rpm, rad/s, Q9.22. Two LSB more than that, so that the largest command in the
 * DBC, which has a resolution of its own, is within. */
static int32_t speed_reference_max_q22(const torque_mode_parameters_t *torque_mode, const machine_tables_t *tables) {
    const int32_t fold_back_q22 = torque_mode->speed_end_q22 - torque_mode->fold_back_range_q22 + 2;
    return fixed_min(fold_back_q22, tables->speed_max_q22);
}

/* Duty per scaled error from duty per N m at GAIN_RATE_HZ, both Q15. */
static int32_t pid_scale_q15(int32_t per_Nm_q15, int32_t error_scale_q24, uint32_t control_rate_hz) {
    const int64_t scaled_q15 = fixed_shift((int64_t)per_Nm_q15 * error_scale_q24, 24);
    return fixed_clamp(fixed_saturate(fixed_divide(scaled_q15 * control_rate_hz, GAIN_RATE_HZ)), 0, 4 << 15);
}

/* Braking torque of drive and load together, N m, that the largest deceleration assumes. */
#define BRAKING_TORQUE_MAX_NM 40

static protection_parameters_t protection_from(const int32_t *values, int32_t angle_step_q32, unsigned encoder_shift,
                                               uint32_t control_rate_hz) {
    const int32_t over_speed_q22 = fixed_saturate(speed_q22_from_rpm(values[PARAMETER_OVER_SPEED_RPM]));
    const uint32_t count = 1u << encoder_shift;
    const uint32_t quarter_deg = (uint32_t)(((uint64_t)1 << 32) / 1440u);
    /* One period at 1.5 times the speed limit, and the quantisation of two readings. */
    const uint64_t step = ((uint64_t)over_speed_q22 * (uint64_t)angle_step_q32 >> 32) * 3 / 2;
    return (protection_parameters_t){
        .current_trip_q9 = values[PARAMETER_CURRENT_TRIP_A],
        .dc_link_over_voltage_q6 = values[PARAMETER_OVER_VOLTAGE_V],
        .dc_link_under_voltage_q6 = values[PARAMETER_UNDER_VOLTAGE_V],
        .angle_step_max = fixed_saturate((int64_t)step + 2 * (int64_t)count),
        /* A quarter of a degree and four counts. Of a coarse encoder sixteen counts: a load step may stop the rotor
         * within a count, and the observer needs several to notice. */
        .undetected_travel_max = (int32_t)(quarter_deg > 12u * count ? quarter_deg + 4u * count : 16u * count),
        .angle_step_q32 = angle_step_q32,
        .command_timeout_us = COMMAND_LOST_US,
        .deceleration_max_q22 = fixed_clamp(
            fixed_saturate(fixed_divide(
                fixed_divide((int64_t)BRAKING_TORQUE_MAX_NM << 52, values[PARAMETER_INERTIA_KG_M2]), control_rate_hz)),
            0, PROTECTION_DECELERATION_MAX_Q22),
    };
}

/* 2^-32 rev. */
#define DEGREE UINT32_C(11930465)

static flux_monitor_parameters_t flux_monitor_from(const control_parameters_t *control, const int32_t *values,
                                                   uint32_t control_rate_hz) {
    const uint32_t rotor_poles = control->commutation.rotor_poles;
    const bool learned = control->torque_law == TORQUE_LAW_PREDICTIVE;
    const uint32_t angle_deg = learned ? ANGLE_EVIDENCE_LEARNED_DEG : ANGLE_EVIDENCE_DEG;
    const int32_t over_speed_q22 = fixed_saturate(speed_q22_from_rpm(values[PARAMETER_OVER_SPEED_RPM]));
    const int32_t travel = fixed_multiply_high(over_speed_q22, control->observer.angle_step_q32);
    return (flux_monitor_parameters_t){
        .angle =
            {
                .commutation = control->commutation,
                .half_count = control->encoder_middle * rotor_poles,
                .middle = control->encoder_middle,
                .advance_min = (int32_t)(control->commutation.stroke / rotor_poles / ANGLE_EVIDENCE_ADVANCE_STROKES +
                                         ANGLE_EVIDENCE_ADVANCE_COUNTS * 2u * control->encoder_middle),
                .angle_max = DEGREE * angle_deg * rotor_poles,
                .flux_error_q29 = angle_evidence_flux_error_q29(
                    load_observer_acceleration(values[PARAMETER_TORQUE_MAX_NM], values[PARAMETER_INERTIA_KG_M2]),
                    values[PARAMETER_CURRENT_LIMIT_A] / 2, control->observer.angle_step_q32, rotor_poles),
                .rate_hz = control_rate_hz,
                .current_min_q9 = values[PARAMETER_CURRENT_LIMIT_A] / 8,
            },
        .encoder =
            {
                .middle = control->encoder_middle,
                .rate_hz = control_rate_hz,
                .over_speed_q22 = over_speed_q22,
                .travel = travel,
                .travel_change =
                    fixed_multiply_high(control->protection.deceleration_max_q22, control->observer.angle_step_q32),
            },
        .least_q8 = learned ? PHASE_BALANCE_LEAST_LEARNED_Q8 : PHASE_BALANCE_LEAST_Q8,
    };
}

/* Largest current, A, Q7.9, from which full voltage for some tenths of a control period drives no phase above the trip,
 * at any angle. By the flux linkage: a saturated phase has less inductance than at the unaligned position, where the
 * flux linkage of a voltage is that of the current which it drives. */
static int32_t highest_before_trip_q9(const int32_t *values, const machine_tables_t *tables, uint32_t control_rate_hz,
                                      unsigned tenths) {
    const int32_t trip_q9 = values[PARAMETER_CURRENT_TRIP_A];
    const int64_t rise_q9 =
        fixed_divide(((int64_t)tables->current_slew_rate_A_s << 9) * tenths, (int64_t)control_rate_hz * 10);
    const int32_t rise_q29 = phase_map_flux_q29(tables, 0, fixed_saturate(rise_q9));
    int32_t highest_q9 = trip_q9;
    for (unsigned row = 0; row < MACHINE_ROWS; row++) {
        const uint32_t distance = tables->row[row].start < HALF_REV ? tables->row[row].start : HALF_REV - 1u;
        const int32_t room_q29 = phase_map_flux_q29(tables, distance, trip_q9) - rise_q29;
        int32_t allowed_q9 = 0;
        for (int32_t bit = 1 << 15; bit > 0; bit >>= 1) {
            const int32_t trial_q9 = allowed_q9 | bit;
            if (trial_q9 <= highest_q9 && phase_map_flux_q29(tables, distance, trial_q9) <= room_q29) {
                allowed_q9 = trial_q9;
            }
        }
        highest_q9 = allowed_q9;
    }
    return highest_q9;
}

/* A current that exceeds its limit rises for two periods more, one until the sample and one until the new state acts;
 * a tenth of it is the margin for the machine's scatter. Hysteresis switches a phase on for whole periods. */
static void limit_currents(control_parameters_t *control, const int32_t *values, const machine_tables_t *tables,
                           uint32_t control_rate_hz) {
    const int32_t limit_q9 = values[PARAMETER_CURRENT_LIMIT_A];
    const int32_t two_periods_q9 = highest_before_trip_q9(values, tables, control_rate_hz, 22);
    const int32_t one_period_q9 = highest_before_trip_q9(values, tables, control_rate_hz, 11);
    const int32_t period_q9 = one_period_q9 > two_periods_q9 ? one_period_q9 - two_periods_q9 : 1;
    const int32_t ceiling_q9 = one_period_q9 + period_q9;
    control->hysteresis.current_limit_q9 = fixed_min(two_periods_q9, limit_q9);
    control->hysteresis.generating_limit_q9 = two_periods_q9;
    control->hysteresis.generating_slope_q19 =
        fixed_saturate(fixed_divide((int64_t)(values[PARAMETER_CURRENT_TRIP_A] - two_periods_q9) << 32,
                                    speed_q22_from_rpm(values[PARAMETER_OVER_SPEED_RPM])));
    control->duty.current_limit_q9 = limit_q9;
    control->duty.current_ceiling_q9 = fixed_max(ceiling_q9, limit_q9);
    control->duty.ceiling_gain_q24 = fixed_saturate(fixed_divide((int64_t)1 << 33, period_q9));
}

/* A period's flux linkage at full voltage is that of the rise of the current at the unaligned position. */
static void set_reference_point(control_parameters_t *control, const int32_t *values, const machine_tables_t *tables,
                                uint32_t control_rate_hz) {
    const int64_t rise_q9 = fixed_divide((int64_t)tables->current_slew_rate_A_s << 9, control_rate_hz);
    const uint32_t middle =
        angle_from_degrees((values[PARAMETER_TURN_ON_ANGLE_DEG] + values[PARAMETER_TURN_OFF_ANGLE_DEG]) / 2);
    const int32_t flux_q29 =
        phase_map_flux_q29(tables, 0, fixed_clamp(fixed_saturate(rise_q9), 1, PHASE_MAP_CURRENT_MAX_Q9));
    pwm_ditc_set_reference_point(&control->duty, tables, middle, flux_q29 > 0 ? flux_q29 : 1);
}

static observer_bandwidth_parameters_t bandwidth_from(const int32_t *values, bool schedules_bandwidth,
                                                      uint32_t control_rate_hz, unsigned encoder_bits) {
    const uint32_t steady_rad_s =
        (uint32_t)values[schedules_bandwidth ? PARAMETER_OBSERVER_STEADY_RAD_S : PARAMETER_OBSERVER_BANDWIDTH_RAD_S];
    const bool adaptive = schedules_bandwidth && values[PARAMETER_OBSERVER_SCHEDULING] != 0;
    return observer_bandwidth_configure(&(observer_bandwidth_settings_t){
        .transient_rad_s = adaptive ? (uint32_t)values[PARAMETER_OBSERVER_TRANSIENT_RAD_S] : steady_rad_s,
        .moving_rad_s = (uint32_t)values[PARAMETER_OBSERVER_MOVING_RAD_S],
        .steady_rad_s = steady_rad_s,
        .encoder_bits = encoder_bits,
        .control_rate_hz = control_rate_hz,
        .inertia_q30 = values[PARAMETER_INERTIA_KG_M2],
        .torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM],
    });
}

static bp_pid_parameters_t bp_pid_from(const int32_t *values, uint32_t control_rate_hz) {
    const int32_t scale_q24 = values[PARAMETER_BP_ERROR_SCALE_NM];
    return (bp_pid_parameters_t){
        .mode = (bp_pid_mode_t)values[PARAMETER_BP_MODE],
        .seed = (uint32_t)values[PARAMETER_BP_SEED],
        .error_scale_inverse_q24 = fixed_saturate(fixed_divide((int64_t)1 << 48, scale_q24)),
        .scale_q28 = {pid_scale_q15(values[PARAMETER_BP_KP_MAX], scale_q24, control_rate_hz) << 13,
                      pid_scale_q15(values[PARAMETER_BP_KI_MAX], scale_q24, control_rate_hz) << 13,
                      pid_scale_q15(values[PARAMETER_BP_KD_MAX], scale_q24, control_rate_hz) << 13},
        .network = {.learning_rate_q15 = values[PARAMETER_BP_LEARNING_RATE] >> 13,
                    .momentum_q32 = values[PARAMETER_BP_MOMENTUM] << 4},
    };
}

/* Windows of the machine from its tables. */
static bool own_windows(const int32_t *values) {
    return values[PARAMETER_SHARE_ON_ANGLE_DEG] < 180 << 7;
}

/* Widest window of the tables, of the largest torque. */
static torque_sharing_parameters_t own_sharing_from(const int32_t *values, const machine_tables_t *tables) {
    const machine_sharing_window_t *window = &tables->sharing[CONDUCTION_MOTORING][0][MACHINE_SHARING_PARTS - 1];
    return (torque_sharing_parameters_t){
        .overlapping = values[PARAMETER_TORQUE_SHARING] != 0,
        .stroke = commutation_stroke(tables->phases),
        .turn_on = HALF_REV + ((uint32_t)window->on << 16),
        .turn_off = HALF_REV + ((uint32_t)window->off << 16),
    };
}

static torque_sharing_parameters_t sharing_from(const int32_t *values, const machine_tables_t *tables) {
    const uint32_t stroke = commutation_stroke(tables->phases);
    if (own_windows(values)) {
        return own_sharing_from(values, tables);
    }
    const uint32_t turn_on = angle_from_degrees(values[PARAMETER_SHARE_ON_ANGLE_DEG]);
    const uint32_t turn_off = angle_from_degrees(values[PARAMETER_SHARE_OFF_ANGLE_DEG]);
    const uint32_t on_early = angle_from_degrees(values[PARAMETER_SHARE_ON_ADVANCE_DEG]);
    const uint32_t off_early = angle_from_degrees(values[PARAMETER_SHARE_OFF_ADVANCE_DEG]);
    /* Windows overlap by at least 2 degrees, advanced or not; smaller settings are widened. */
    const uint32_t least = stroke + angle_from_degrees(2 << 7);
    const uint32_t width = fixed_max_u32(turn_off - turn_on, least);
    const uint32_t narrowing = off_early > on_early ? off_early - on_early : 0;
    return (torque_sharing_parameters_t){
        .overlapping = values[PARAMETER_TORQUE_SHARING] != 0,
        .stroke = stroke,
        .turn_on = turn_on,
        .turn_off = turn_on + width,
        .turn_on_advance = on_early,
        .turn_off_advance = off_early - (narrowing > width - least ? narrowing - (width - least) : 0),
    };
}

/* The fields of the phases hardly raise a large DC link: a 32nd of the over-voltage threshold is the least range. */
static int32_t fold_back_range_q6(int32_t over_voltage_q6, int32_t range_q6) {
    return fixed_max(range_q6, over_voltage_q6 / 32);
}

static conduction_parameters_t conduction_from(const int32_t *values, const machine_tables_t *tables,
                                               uint32_t control_rate_hz, int32_t torque_min_q24) {
    const unsigned phases = tables->phases;
    const torque_sharing_parameters_t sharing = sharing_from(values, tables);
    const torque_sharing_window_t base_window = torque_sharing_window(&sharing, 0);
    const int32_t over_voltage_q6 = values[PARAMETER_OVER_VOLTAGE_V];
    const int32_t range_q6 = fold_back_range_q6(over_voltage_q6, tables->fold_back_q6);
    const int32_t mean_range_q6 = fold_back_range_q6(over_voltage_q6, tables->mean_fold_back_q6);
    /* A chopper is to have something left to take. */
    const int32_t end_q6 = fixed_min(range_q6 / 2, mean_range_q6 * 3 / 4);
    /* Twice the largest braking torque: a larger one would hardly leave a range. */
    const int32_t link_torque_q24 =
        fixed_clamp(values[PARAMETER_TORQUE_MAX_NM], 0,
                    fixed_saturate((int64_t)tables->pulse[CONDUCTION_BRAKING][0].mean_torque << 17));
    return (conduction_parameters_t){
        .sharing = sharing,
        .initial = conduction_initial(&base_window),
        .own_windows = own_windows(values),
        /* A reserve loads both halves against each other: turn-on of one leads into the other. */
        .single_pulse = sharing.overlapping && values[PARAMETER_TORQUE_RESERVE_NM] == 0,
        /* Not where the limit of each period reduces the torque at the voltage that their feedback holds. */
        .longer_pulses = range_q6 + end_q6 < mean_range_q6 * 7 / 4 ? 3 : 0,
        .torque_min_q24 = torque_min_q24,
        .torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM],
        .advance_step_q30 =
            (int32_t)fixed_divide(10 * DEFERRED_CONDUCTION_PERIODS * ((int64_t)1 << 30), (int64_t)control_rate_hz),
        .retract_step_q30 =
            (int32_t)fixed_divide(DEFERRED_CONDUCTION_PERIODS * ((int64_t)1 << 30), (int64_t)control_rate_hz),
        .gain_per_step_q16 = (uint32_t)fixed_saturate(
            fixed_divide((int64_t)phases * control_rate_hz << 30,
                         (int64_t)DEFERRED_CONDUCTION_PERIODS * (values[PARAMETER_SMC_K] + 1))),
        .braking_end_q6 = over_voltage_q6 - mean_range_q6 / 4,
        .fold_back_range_q6 = mean_range_q6 - mean_range_q6 / 4 + 1,
        .full_link_q6 = over_voltage_q6 - end_q6,
        .full_link_range_q6 = range_q6 - end_q6 + 1,
        .full_link_slope_q18 = link_torque_q24 / (range_q6 - end_q6 + 1),
    };
}

static predictive_torque_parameters_t predictive_from(const int32_t *values, unsigned phases,
                                                      uint32_t control_rate_hz) {
    const int64_t rate = control_rate_hz;
    const int32_t limit_column = values[PARAMETER_CURRENT_LIMIT_A] >> MACHINE_COLUMN_BITS;
    return (predictive_torque_parameters_t){
        .flux =
            {
                .gain_q30 = values[PARAMETER_FLUX_OBSERVER_GAIN] << 15,
                .resistance_period_q40 =
                    fixed_saturate(fixed_divide((int64_t)values[PARAMETER_RESISTANCE_OHM] << 16, rate)),
            },
        .stroke = commutation_stroke(phases),
        .period_q40 = (int32_t)fixed_divide((int64_t)1 << 40, rate),
        .current_limit_q9 = values[PARAMETER_CURRENT_LIMIT_A],
        .current_max_q9 = values[PARAMETER_CURRENT_LIMIT_A] + values[PARAMETER_CURRENT_LIMIT_A] / 64,
        .column_max = fixed_clamp(limit_column + PHASE_CELL_REACH, 0, PHASE_CELL_COLUMN_MAX),
        .reserve_q24 = values[PARAMETER_TORQUE_RESERVE_NM],
    };
}

/* Far from the sliding surface the reaching law asks for the torque J k / epsilon. On a light machine that would be
 * less than the torque limit: epsilon is then reduced until it is 5/4 of it. Near the surface the law is that of k
 * alone. */
static int32_t epsilon_q31(const int32_t *values, int32_t gain_q24) {
    const int64_t set_q31 = (int64_t)values[PARAMETER_SMC_EPSILON] << 15;
    const int64_t limit_q24 = (int64_t)values[PARAMETER_TORQUE_MAX_NM] * 5 / 4 + 1;
    const int64_t reduced_q31 = fixed_divide((int64_t)gain_q24 << 31, limit_q24);
    return fixed_clamp(fixed_saturate(reduced_q31 < set_q31 ? reduced_q31 : set_q31), SPEED_SMC_EPSILON_MIN_Q31,
                       INT32_MAX);
}

/* 2^32 / (2 pi): 2^-32 rev in a rad. */
#define ANGLE_PER_RAD_Q29 INT64_C(366986312910250153)

/* Slowest clock at which the rotation in a tick, edge_angle_per_tick_q51, fits 32 bits. With a slower clock it is that
 * in a tick divided by a power of 2, by which the age is multiplied. */
#define EDGE_CLOCK_MIN_HZ 171000000u

/* Scale of the age of an encoder edge, by which measure.c extrapolates the angle: ticks, of 5 ns at 200 MHz, to a
 * rotation at the observer's speed. */
static void set_edge_timing(control_parameters_t *control, unsigned speed_exponent, uint32_t timer_clock_hz) {
    unsigned shift = 0;
    while (timer_clock_hz << shift < EDGE_CLOCK_MIN_HZ) {
        shift++;
    }
    const uint32_t shifted_hz = timer_clock_hz << shift;
    const unsigned age_shift = 13u + speed_exponent + shift;
    const uint32_t age_max = (uint32_t)INT32_MAX >> age_shift;
    const uint32_t two_periods = timer_clock_hz / 10000u; /* at 20 kHz */
    control->edge_angle_per_tick_q51 = (int32_t)fixed_divide(ANGLE_PER_RAD_Q29 + shifted_hz / 2u, shifted_hz);
    control->edge_age_shift = (uint8_t)age_shift;
    control->edge_age_max_ticks = (uint16_t)fixed_min_u32(two_periods, age_max);
}

/* The window in which each law uses a phase. */
static degraded_parameters_t degraded_from(const control_parameters_t *control, const int32_t *values) {
    const torque_sharing_parameters_t *sharing = &control->conduction.sharing;
    const bool shares = control->torque_law == TORQUE_LAW_PREDICTIVE;
    const commutation_parameters_t *commutation = &control->commutation;
    return (degraded_parameters_t){
        .allowed = values[PARAMETER_DEGRADED_RUNNING] != 0,
        .stroke = commutation->stroke,
        .window = {.turn_on = shares ? sharing->turn_on : commutation->turn_on,
                   .width = shares ? sharing->turn_off - sharing->turn_on : commutation->available_width},
        .current_limit_q9 = control->torque_law == TORQUE_LAW_HYSTERESIS ? control->hysteresis.current_limit_q9
                                                                         : values[PARAMETER_CURRENT_LIMIT_A],
        .torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM],
    };
}

/* Sources of the derived parameters. */
typedef struct {
    const int32_t *values; /* of the user's parameters */
    const machine_tables_t *tables;
    uint32_t control_rate_hz;
    unsigned encoder_bits, adc_bits;
    uint32_t timer_clock_hz;
    controller_t controller;
    int32_t torque_min_q24; /* of the drive, N m, Q7.24; the maximum is a parameter */
} source_t;

/* From counts and ticks to the units of the laws. */
static void set_sampling(control_parameters_t *control, const source_t *from) {
    const unsigned encoder_shift = 32u - from->encoder_bits;
    control->period_ticks = (uint16_t)(from->timer_clock_hz / (2u * from->control_rate_hz));
    control->encoder_shift = (uint8_t)encoder_shift;
    control->encoder_middle = (1u << encoder_shift) >> 1;
    control->adc_bits = (uint8_t)from->adc_bits;
    control->current_scale_q18 = COUNT_SCALE_Q18(from->tables->current_range_q9, from->adc_bits);
    control->voltage_scale_q18 = COUNT_SCALE_Q18(from->tables->voltage_range_q6, from->adc_bits);
    control->initialise_ticks = from->control_rate_hz / 1000u;
    set_edge_timing(control, from->tables->speed_exponent, from->timer_clock_hz);
}

static speed_smc_parameters_t smc_from(const int32_t *values) {
    const int32_t gain_q24 = fixed_multiply(values[PARAMETER_INERTIA_KG_M2], values[PARAMETER_SMC_K], 22);
    return (speed_smc_parameters_t){
        .gain_q24 = gain_q24,
        .epsilon_q31 = epsilon_q31(values, gain_q24),
        .delta_q27 = fixed_multiply(values[PARAMETER_SMC_DELTA], LOG2_E_Q30, 19),
        .friction_q30 = values[PARAMETER_FRICTION_NM_S],
    };
}

/* Observer, speed laws and torque mode. */
static void set_speed_control(control_parameters_t *control, const source_t *from) {
    const int32_t *values = from->values;
    const uint32_t rate_hz = from->control_rate_hz;
    const int32_t torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM];
    control->speed_law = from->controller.speed_law;
    control->speed_reference_min_q22 = from->controller.four_quadrant ? INT32_MIN : 0;
    control->load_from_transducer = values[PARAMETER_LOAD_SOURCE] != 0;
    control->speed_ramp_q22 = ramp_q22(values[PARAMETER_SPEED_RAMP_RPM_S], rate_hz);
    control->observer = load_observer_model(rate_hz, values[PARAMETER_INERTIA_KG_M2], values[PARAMETER_FRICTION_NM_S]);
    control->bandwidth = bandwidth_from(values, from->controller.schedules_bandwidth, rate_hz, from->encoder_bits);
    control->speed_pi = (speed_pi_parameters_t){
        .kp_q16 = values[PARAMETER_SPEED_KP],
        .ki_step_q32 = fixed_saturate(fixed_divide((int64_t)values[PARAMETER_SPEED_KI] << 16, rate_hz)),
        .torque_min_q24 = 0,
        .torque_max_q24 = torque_max_q24,
    };
    control->speed_smc = smc_from(values);
    control->torque_mode =
        torque_mode_configure(values[PARAMETER_TORQUE_SLEW_RATE_NM_S], rate_hz, from->torque_min_q24, torque_max_q24,
                              fixed_saturate(speed_q22_from_rpm(values[PARAMETER_OVER_SPEED_RPM])));
    control->speed_reference_max_q22 = speed_reference_max_q22(&control->torque_mode, from->tables);
}

static pwm_ditc_parameters_t duty_from(const source_t *from) {
    const int32_t *values = from->values;
    return (pwm_ditc_parameters_t){
        .pid = bp_pid_from(values, from->control_rate_hz),
        .current_setpoints =
            pwm_ditc_setpoints(from->tables, angle_from_degrees(values[PARAMETER_HAND_OVER_ANGLE_DEG])),
        /* Half of the deadbeat gain at standstill: rate / (2 * A/s), in Q24. */
        .incoming_gain_q24 =
            fixed_saturate(fixed_divide((int64_t)from->control_rate_hz << 23, from->tables->current_slew_rate_A_s)),
        .band_outer_q24 = values[PARAMETER_BP_ASSIST_BAND_NM],
    };
}

static void set_torque_control(control_parameters_t *control, const source_t *from) {
    const int32_t *values = from->values;
    control->torque_law = from->controller.torque_law;
    control->interleaved_pwm = from->controller.may_interleave_pulses && values[PARAMETER_PULSES_PER_PERIOD] == 2;
    control->commutation = commutation_configure(
        &(commutation_angles_t){
            .turn_on = angle_from_degrees(values[PARAMETER_TURN_ON_ANGLE_DEG]),
            .turn_off = angle_from_degrees(values[PARAMETER_TURN_OFF_ANGLE_DEG]),
            .outgoing_off = angle_from_degrees(values[PARAMETER_OUTGOING_OFF_ANGLE_DEG]),
        },
        from->tables->phases, from->tables->rotor_poles);
    control->hysteresis = (ditc_hysteresis_parameters_t){
        .band_inner_q24 = values[PARAMETER_TORQUE_BAND_INNER_NM],
        .band_outer_q24 = values[PARAMETER_TORQUE_BAND_OUTER_NM],
    };
    control->duty = duty_from(from);
    control->predictive = predictive_from(values, from->tables->phases, from->control_rate_hz);
    control->conduction = conduction_from(values, from->tables, from->control_rate_hz, from->torque_min_q24);
    limit_currents(control, values, from->tables, from->control_rate_hz);
    set_reference_point(control, values, from->tables, from->control_rate_hz);
}

/* Laws that learn or adapt during a run; after the others, whose parameters they need. */
static void set_estimators(control_parameters_t *control, const source_t *from) {
    const int32_t *values = from->values;
    const machine_tables_t *tables = from->tables;
    const uint32_t rate_hz = from->control_rate_hz;
    const int32_t inertia_q30 = values[PARAMETER_INERTIA_KG_M2];
    const int32_t torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM];
    const observer_bandwidth_parameters_t *bandwidth = &control->bandwidth;
    const observer_bandwidth_stage_t *moving = &bandwidth->stage[bandwidth->schedule.moving_stage];
    control->misalignment = misalignment_configure(&(misalignment_settings_t){
        .rate_1_s = values[PARAMETER_ANGLE_ADAPTATION] != 0 ? values[PARAMETER_ANGLE_ADAPTATION_1_S] : 0,
        .control_rate_hz = rate_hz,
        .periods_per_update = DEFERRED_LEARNING_PERIODS,
        .periods_per_common_update = DEFERRED_COMMON_PERIODS,
        .inertia_q30 = inertia_q30,
        .phases = tables->phases,
        .rotor_poles = tables->rotor_poles,
        .encoder_bits = from->encoder_bits,
        .bandwidth_rad_s = bandwidth->stage[OBSERVER_BANDWIDTH_STEADY_STAGE].bandwidth_rad_s,
        .speed_exponent = tables->speed_exponent,
    });
    control->moving_load = moving_load_configure(&(moving_load_settings_t){
        .encoder_bits = from->encoder_bits,
        .control_rate_hz = rate_hz,
        .periods_per_review = DEFERRED_SLOW_PERIODS,
        .stages = OBSERVER_BANDWIDTH_STAGES - 1u - bandwidth->schedule.moving_stage,
        .bandwidth_rad_s = moving->bandwidth_rad_s,
        .trigger_ticks = bandwidth->stage[bandwidth->schedule.trigger_stage_count].end_ticks,
        .inertia_q30 = inertia_q30,
        .torque_max_q24 = torque_max_q24,
    });
    /* With a transducer the whole load is fed forward already. */
    const bool learns_load =
        values[PARAMETER_PERIODIC_LOAD] != 0 && !control->load_from_transducer && control->moving_load.stages > 0;
    control->periodic_load = periodic_load_configure(rate_hz, learns_load ? moving->bandwidth_rad_s : 0, torque_max_q24,
                                                     tables->rotor_poles);
    control->inertia = inertia_configure(&(inertia_settings_t){
        .control_rate_hz = rate_hz,
        .periods_per_update = DEFERRED_COMMON_PERIODS,
        .inertia_q30 = inertia_q30,
        .torque_max_q24 = torque_max_q24,
        .encoder_bits = from->encoder_bits,
        .rotor_poles = tables->rotor_poles,
        .reaching_gain_q24 = control->speed_smc.gain_q24,
        .rate_q8 = control->misalignment.inertia_rate_q8,
    });
    control->slow_counts = slow_counts_configure(rate_hz, from->encoder_bits, inertia_q30);
    control->count_course = count_course_configure(control->observer.angle_step_q32, from->encoder_bits);
    control->stroke_mean = stroke_mean_configure(tables->phases, rate_hz / DEFERRED_SLOW_PERIODS);
    control->torque_offset = torque_offset_configure(rate_hz / DEFERRED_SLOW_PERIODS, torque_max_q24);
    control->table_scale_part_q31 = values[PARAMETER_TABLE_SCALE] != 0 ? table_scale_part_q31(rate_hz) : 0;
    control->scale_by_shaft = values[PARAMETER_TABLE_SCALE] == 2;
}

/* After the laws, whose parameters they need. */
static void set_monitors(control_parameters_t *control, const source_t *from) {
    control->protection =
        protection_from(from->values, control->observer.angle_step_q32, control->encoder_shift, from->control_rate_hz);
    control->degraded = degraded_from(control, from->values);
    control->flux_monitor = flux_monitor_from(control, from->values, from->control_rate_hz);
}

control_parameters_t configure_control(const parameters_t *parameters, const machine_tables_t *tables,
                                       uint32_t control_rate_hz, unsigned encoder_bits, unsigned adc_bits,
                                       uint32_t timer_clock_hz) {
    const controller_t controller = controller_from(parameters->values);
    const source_t from = {
        .values = parameters->values,
        .tables = tables,
        .control_rate_hz = control_rate_hz,
        .encoder_bits = encoder_bits,
        .adc_bits = adc_bits,
        .timer_clock_hz = timer_clock_hz,
        .controller = controller,
        .torque_min_q24 = controller.four_quadrant ? -parameters->values[PARAMETER_TORQUE_MAX_NM] : 0,
    };
    control_parameters_t control = {.controller = (drive_controller_t)parameters->values[PARAMETER_CONTROLLER]};
    set_sampling(&control, &from);
    set_speed_control(&control, &from);
    set_torque_control(&control, &from);
    set_estimators(&control, &from);
    set_monitors(&control, &from);
    return control;
}

COLD void configure_tune(control_parameters_t *parameters, const control_parameters_t *tuned, unsigned part) {
    switch (part) {
    case CONFIGURE_TUNE_SPEED:
        parameters->speed_pi = tuned->speed_pi;
        parameters->speed_smc = tuned->speed_smc;
        parameters->inertia = tuned->inertia;
        parameters->moving_load = tuned->moving_load;
        parameters->periodic_load = tuned->periodic_load;
        parameters->bandwidth.schedule = tuned->bandwidth.schedule;
        return;
    case CONFIGURE_TUNE_TORQUE:
        parameters->duty.pid = tuned->duty.pid;
        parameters->predictive.flux = tuned->predictive.flux;
        parameters->conduction = tuned->conduction;
        parameters->misalignment = tuned->misalignment;
        return;
    default: { /* of the observer */
        const unsigned stage = part - CONFIGURE_TUNE_FIRST_STAGE;
        parameters->bandwidth.stage[stage] = tuned->bandwidth.stage[stage];
        return;
    }
    }
}
