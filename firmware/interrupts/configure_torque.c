#include "interrupts/configure_torque.h"

#include "control/phase_map.h"
#include "fixed/formats.h"
#include "interrupts/deferred.h"
#include "storage/parameters.h"

/* Reference rate of the BP-PID gains: the torque change per period scales with the period. */
#define GAIN_RATE_HZ 40000

/* Duty per scaled error from duty per N m at GAIN_RATE_HZ, both Q15. */
static int32_t pid_scale_q15(int32_t per_Nm_q15, int32_t error_scale_q24, uint32_t control_rate_hz) {
    const int64_t scaled_q15 = fixed_shift((int64_t)per_Nm_q15 * error_scale_q24, 24);
    return fixed_clamp(fixed_saturate(fixed_divide(scaled_q15 * control_rate_hz, GAIN_RATE_HZ)), 0, 4 << 15);
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

static pwm_ditc_parameters_t duty_from(const configure_source_t *from) {
    const int32_t *values = from->values;
    return (pwm_ditc_parameters_t){
        .pid = bp_pid_from(values, from->control_rate_hz),
        .current_setpoints =
            pwm_ditc_setpoints(from->tables, commutation_angle_from_degrees(values[PARAMETER_HAND_OVER_ANGLE_DEG])),
        /* Half of the deadbeat gain at standstill: rate / (2 * A/s), in Q24. */
        .incoming_gain_q24 =
            fixed_saturate(fixed_divide((int64_t)from->control_rate_hz << 23, from->tables->current_slew_rate_A_s)),
        .band_outer_q24 = values[PARAMETER_BP_ASSIST_BAND_NM],
    };
}

/* Largest current, A, Q7.9, from which full voltage for some tenths of a control period drives no phase above the trip,
 * at any angle. By the flux linkage: a saturated phase has less inductance than at the unaligned position, where the
 * flux linkage of a voltage is the flux linkage of the current which it drives. */
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

/* A period's flux linkage at full voltage is the flux linkage of the rise of the current at the unaligned position. */
static void set_reference_point(control_parameters_t *control, const int32_t *values, const machine_tables_t *tables,
                                uint32_t control_rate_hz) {
    const int64_t rise_q9 = fixed_divide((int64_t)tables->current_slew_rate_A_s << 9, control_rate_hz);
    const uint32_t middle = commutation_angle_from_degrees(
        (values[PARAMETER_TURN_ON_ANGLE_DEG] + values[PARAMETER_TURN_OFF_ANGLE_DEG]) / 2);
    const int32_t flux_q29 =
        phase_map_flux_q29(tables, 0, fixed_clamp(fixed_saturate(rise_q9), 1, PHASE_MAP_CURRENT_MAX_Q9));
    pwm_ditc_set_reference_point(&control->duty, tables, middle, fixed_max(flux_q29, 1));
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
    const uint32_t turn_on = commutation_angle_from_degrees(values[PARAMETER_SHARE_ON_ANGLE_DEG]);
    const uint32_t turn_off = commutation_angle_from_degrees(values[PARAMETER_SHARE_OFF_ANGLE_DEG]);
    const uint32_t on_early = commutation_angle_from_degrees(values[PARAMETER_SHARE_ON_ADVANCE_DEG]);
    const uint32_t off_early = commutation_angle_from_degrees(values[PARAMETER_SHARE_OFF_ADVANCE_DEG]);
    /* Windows overlap by at least 2 degrees, advanced or not; smaller settings are widened. */
    const uint32_t least = stroke + commutation_angle_from_degrees(2 << 7);
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

/* The fields of the phases hardly raise a large DC link: a 32nd of the over-voltage threshold is the least range.
 * [SR-14] */
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
                .gain_q30 = fixed_min(values[PARAMETER_FLUX_OBSERVER_GAIN] << 15, ONE_Q30 - 1),
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

void configure_torque(control_parameters_t *control, const configure_source_t *from) {
    const int32_t *values = from->values;
    control->torque_law = from->controller.torque_law;
    control->interleaved_pwm = from->controller.may_interleave_pulses && values[PARAMETER_PULSES_PER_PERIOD] == 2;
    const commutation_angles_t angles = parameters_commutation_angles(values);
    control->commutation = commutation_configure(&angles, from->tables->phases, from->tables->rotor_poles);
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
