#include "interrupts/configure.h"

#include "control/phase_map.h"
#include "control/position/position_configure.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "interrupts/configure_torque.h"
#include "interrupts/deferred.h"

bool configure_rate_allowed(uint32_t control_rate_hz, uint32_t timer_clock_hz) {
    return (control_rate_hz == 20000 || control_rate_hz == 40000 || control_rate_hz == 50000 ||
            control_rate_hz == 100000 || control_rate_hz == 1000000) &&
           timer_clock_hz >= HAL_PWM_CLOCK_HZ_MIN && timer_clock_hz <= HAL_PWM_CLOCK_HZ_MAX &&
           timer_clock_hz % (2u * control_rate_hz) == 0;
}

/* The only place that distinguishes the controllers. */
static configure_controller_t controller_from(const int32_t *values) {
    switch ((drive_controller_t)values[PARAMETER_CONTROLLER]) {
    case DRIVE_CONTROLLER_SALIENT:
        return (configure_controller_t){
            .speed_law = SPEED_LAW_SMC,
            .torque_law = TORQUE_LAW_PREDICTIVE,
            .four_quadrant = true,
            .schedules_bandwidth = true,
            .may_interleave_pulses = true,
        };
    case DRIVE_CONTROLLER_PAPER:
        return (configure_controller_t){
            .speed_law = SPEED_LAW_SMC,
            .torque_law = values[PARAMETER_BP_MODE] == BP_PID_OFF ? TORQUE_LAW_HYSTERESIS : TORQUE_LAW_DUTY,
            .schedules_bandwidth = true,
            .may_interleave_pulses = values[PARAMETER_BP_MODE] != BP_PID_OFF,
        };
    case DRIVE_CONTROLLER_TRADITIONAL:
    default:
        return (configure_controller_t){.speed_law = SPEED_LAW_PI, .torque_law = TORQUE_LAW_HYSTERESIS};
    }
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

/* Far from the sliding surface the reaching law asks for the torque J k / epsilon. On a light machine that would be
 * less than the torque limit: epsilon is then reduced until it is 5/4 of it. Near the surface the law is the one of k
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

/* From counts and ticks to the units of the laws. */
static void set_sampling(control_parameters_t *control, const configure_source_t *from) {
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
static void set_speed_control(control_parameters_t *control, const configure_source_t *from) {
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

static position_parameters_t position_from(const control_parameters_t *control, const configure_source_t *from) {
    const int32_t *values = from->values;
    return position_configure(&(position_settings_t){
        .control_rate_hz = from->control_rate_hz,
        .speed_exponent = from->tables->speed_exponent,
        .angle_step_q32 = control->observer.angle_step_q32,
        .acceleration_q32 = control->observer.acceleration_q32,
        .torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM],
        .speed_max_q22 = control->speed_reference_max_q22,
        .speed_rpm = values[PARAMETER_POSITION_SPEED_RPM],
        .acceleration_rpm_s = values[PARAMETER_POSITION_ACCEL_RPM_S],
        .deceleration_rpm_s = values[PARAMETER_POSITION_DECEL_RPM_S],
        .jerk_rpm_s2 = values[PARAMETER_POSITION_JERK_RPM_S2],
        .gain_1_s = values[PARAMETER_POSITION_GAIN_1_S],
        .lowest_rev = values[PARAMETER_POSITION_MIN_REV],
        .highest_rev = values[PARAMETER_POSITION_MAX_REV],
        .following_error_q7 = values[PARAMETER_FOLLOWING_ERROR_DEG],
        .window_q15 = values[PARAMETER_POSITION_WINDOW_DEG],
        .homing_speed_rpm = values[PARAMETER_HOMING_SPEED_RPM],
        .homing_torque_q24 = values[PARAMETER_HOMING_TORQUE_NM],
        .cycle_ms = values[PARAMETER_POSITION_CYCLE_MS],
    });
}

/* Laws that learn or adapt during a run; after the others, whose parameters they need. */
static void set_estimators(control_parameters_t *control, const configure_source_t *from) {
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
        .stages = OBSERVER_BANDWIDTH_STAGES - 1u - bandwidth->schedule.moving_stage,
        .trigger_ticks = bandwidth->stage[bandwidth->schedule.trigger_stage_count].end_ticks,
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
static void set_monitors(control_parameters_t *control, const configure_source_t *from) {
    control->protection =
        protection_from(from->values, control->observer.angle_step_q32, control->encoder_shift, from->control_rate_hz);
    control->degraded = degraded_from(control, from->values);
    control->flux_monitor = flux_monitor_from(control, from->values, from->control_rate_hz);
}

control_parameters_t configure_control(const parameters_t *parameters, const machine_tables_t *tables,
                                       uint32_t control_rate_hz, unsigned encoder_bits, unsigned adc_bits,
                                       uint32_t timer_clock_hz) {
    const configure_controller_t controller = controller_from(parameters->values);
    const configure_source_t from = {
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
    configure_torque(&control, &from);
    set_estimators(&control, &from);
    set_monitors(&control, &from);
    control.position = position_from(&control, &from);
    return control;
}

static void tune_stage(observer_bandwidth_parameters_t *bandwidth, const observer_bandwidth_parameters_t *tuned,
                       unsigned stage) {
    bandwidth->stage[stage] = tuned->stage[stage];
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
        parameters->misalignment = tuned->misalignment;
        return;
    case CONFIGURE_TUNE_CONDUCTION:
        parameters->conduction = tuned->conduction;
        return;
    case CONFIGURE_TUNE_POSITION:
        parameters->position.law = tuned->position.law;
        return;
    case CONFIGURE_TUNE_POSITION_PLAN:
        parameters->position.plan = tuned->position.plan;
        return;
    default: /* of the observer */
        tune_stage(&parameters->bandwidth, &tuned->bandwidth, part - CONFIGURE_TUNE_FIRST_STAGE);
        return;
    }
}
