#include "drive/parameters.h"

#include "fixed/fixed.h"

/* numerator / denominator in the row's format */
#define Q FIXED_CONSTANT

/* Angles are in electrical degrees of a rotor pitch as the phase sees them: 180 unaligned, 360 aligned. */
static const parameter_row_t rows[PARAMETER_COUNT] = {
    [PARAMETER_CONTROLLER] = {"controller", "", 0, 0, 2, 0},
    /* 0: the reference steps */
    [PARAMETER_SPEED_RAMP_RPM_S] = {"speed_ramp_rpm_s", "r/min/s", 0, 0, 1000000, 0},
    [PARAMETER_TORQUE_MAX_NM] = {"torque_max_Nm", "N m", 24, 0, Q(40, 1, 24), Q(191, 10, 24)},
    /* Chopping limit and trip. The sensors end just below 80 A: a trip above 79 A would never be seen. */
    [PARAMETER_CURRENT_LIMIT_A] = {"current_limit_A", "A", 9, Q(1, 1, 9), Q(79, 1, 9), Q(52, 1, 9)},
    [PARAMETER_CURRENT_TRIP_A] = {"current_trip_A", "A", 9, Q(1, 1, 9), Q(79, 1, 9), Q(75, 1, 9)},
    [PARAMETER_BUS_OVER_VOLTAGE_V] = {"bus_over_voltage_V", "V", 6, Q(10, 1, 6), Q(510, 1, 6), Q(300, 1, 6)},
    [PARAMETER_BUS_UNDER_VOLTAGE_V] = {"bus_under_voltage_V", "V", 6, 0, Q(510, 1, 6), Q(150, 1, 6)},
    /* Speeds end at 4889 r/min, the range of Q9.22 rad/s. */
    [PARAMETER_OVER_SPEED_RPM] = {"over_speed_rpm", "r/min", 0, 10, 4800, 3600},
    [PARAMETER_COMMAND_TIMEOUT_MS] = {"command_timeout_ms", "ms", 0, 10, 1000, 100},
    [PARAMETER_TURN_ON_ANGLE_DEG] = {"turn_on_angle_deg", "deg", 7, Q(90, 1, 7), Q(360, 1, 7), Q(180, 1, 7)},
    [PARAMETER_TURN_OFF_ANGLE_DEG] = {"turn_off_angle_deg", "deg", 7, Q(180, 1, 7), Q(360, 1, 7), Q(300, 1, 7)},
    [PARAMETER_OUTGOING_OFF_ANGLE_DEG] = {"outgoing_off_angle_deg", "deg", 7, Q(180, 1, 7), Q(360, 1, 7), Q(348, 1, 7)},
    /* Where the incoming phase is to carry the whole reference (paper controller). */
    [PARAMETER_HAND_OVER_ANGLE_DEG] = {"hand_over_angle_deg", "deg", 7, Q(180, 1, 7), Q(300, 1, 7), Q(210, 1, 7)},
    [PARAMETER_TORQUE_BAND_INNER_NM] = {"torque_band_inner_Nm", "N m", 24, 0, Q(20, 1, 24), Q(1, 10, 24)},
    [PARAMETER_TORQUE_BAND_OUTER_NM] = {"torque_band_outer_Nm", "N m", 24, 0, Q(20, 1, 24), Q(1, 1, 24)},
    [PARAMETER_SPEED_KP] = {"speed_kp", "N m s", 16, 0, Q(1000, 1, 16), Q(8, 1, 16)},
    [PARAMETER_SPEED_KI] = {"speed_ki", "N m", 16, 0, Q(10000, 1, 16), Q(400, 1, 16)},
    [PARAMETER_SMC_K] = {"smc_k", "1/s", 16, 0, Q(10000, 1, 16), Q(1100, 1, 16)},
    [PARAMETER_SMC_EPSILON] = {"smc_epsilon", "", 16, Q(1, 100, 16), Q(1, 1, 16), Q(1, 2, 16)},
    [PARAMETER_SMC_DELTA] = {"smc_delta", "s", 16, 0, Q(10, 1, 16), Q(1, 1, 16)},
    [PARAMETER_OBSERVER_BANDWIDTH_RAD_S] = {"observer_bandwidth_rad_s", "rad/s", 0, 100, 8000, 1000},
    /* 0 off, 1 fixed gains, 2 network without learning, 3 network that learns */
    [PARAMETER_BP_MODE] = {"bp_mode", "", 0, 0, 3, 3},
    [PARAMETER_BP_SEED] = {"bp_seed", "", 0, 0, INT32_MAX, 1},
    [PARAMETER_BP_ETA] = {"bp_eta", "", 28, 0, Q(1, 1, 28), Q(5, 100, 28)},
    [PARAMETER_BP_ALPHA] = {"bp_alpha", "", 28, 0, Q(1, 2, 28) - 1, Q(5, 100, 28)},
    [PARAMETER_BP_ERROR_SCALE_NM] = {"bp_error_scale_Nm", "N m", 24, Q(1, 10, 24), Q(40, 1, 24), Q(2, 1, 24)},
    [PARAMETER_BP_KP_MAX] = {"bp_kp_max", "1/(N m)", 15, 0, Q(2, 1, 15) - 1, Q(1, 2, 15)},
    [PARAMETER_BP_KI_MAX] = {"bp_ki_max", "1/(N m)", 15, 0, Q(2, 1, 15) - 1, Q(12, 100, 15)},
    [PARAMETER_BP_KD_MAX] = {"bp_kd_max", "1/(N m)", 15, 0, Q(2, 1, 15) - 1, Q(1, 5, 15)},
    /* Torque missing beyond it switches the incoming phase fully on. */
    [PARAMETER_BP_ASSIST_BAND_NM] = {"bp_assist_band_Nm", "N m", 24, 0, Q(20, 1, 24), Q(2, 1, 24)},
    /* The plant that the laws assume; the machine's tables give the defaults. */
    [PARAMETER_INERTIA_KG_M2] = {"inertia_kg_m2", "kg m^2", 30, Q(1, 10000, 30), Q(19, 10, 30), Q(2, 100, 30)},
    [PARAMETER_FRICTION_NM_S] = {"friction_Nm_s", "N m s", 30, 0, Q(19, 10, 30), Q(2, 100, 30)},
    [PARAMETER_RESISTANCE_OHM] = {"resistance_ohm", "ohm", 24, 0, Q(20, 1, 24), Q(5, 100, 24)},
    /* Of the sliding mode: 0 the observer, 1 a transducer on the shaft. */
    [PARAMETER_LOAD_SOURCE] = {"load_source", "", 0, 0, 1, 0},

    /* From here on the salient controller. 0: its observer keeps the steady bandwidth. */
    [PARAMETER_OBSERVER_WAKING] = {"observer_waking", "", 0, 0, 1, 1},
    [PARAMETER_OBSERVER_WAKE_RAD_S] = {"observer_wake_rad_s", "rad/s", 0, 100, 10000, 9000},
    [PARAMETER_OBSERVER_STEADY_RAD_S] = {"observer_steady_rad_s", "rad/s", 0, 100, 10000, 250},
    [PARAMETER_PULSES_PER_PERIOD] = {"pulses_per_period", "", 0, 1, 2, 2},
    /* 0: one phase at a time */
    [PARAMETER_TORQUE_SHARING] = {"torque_sharing", "", 0, 0, 1, 1},
    [PARAMETER_SHARE_ON_ANGLE_DEG] = {"share_on_angle_deg", "deg", 7, Q(180, 1, 7), Q(240, 1, 7), Q(184, 1, 7)},
    [PARAMETER_SHARE_OFF_ANGLE_DEG] = {"share_off_angle_deg", "deg", 7, Q(300, 1, 7), Q(360, 1, 7), Q(356, 1, 7)},
    /* How much earlier each where voltage runs out. */
    [PARAMETER_SHARE_ON_EARLY_DEG] = {"share_on_early_deg", "deg", 7, 0, Q(60, 1, 7), Q(24, 1, 7)},
    [PARAMETER_SHARE_OFF_EARLY_DEG] = {"share_off_early_deg", "deg", 7, 0, Q(60, 1, 7), Q(16, 1, 7)},
    [PARAMETER_TORQUE_RESERVE_NM] = {"torque_reserve_Nm", "N m", 24, 0, Q(20, 1, 24), 0},
    [PARAMETER_FLUX_OBSERVER_GAIN] = {"flux_observer_gain", "", 15, 0, Q(1, 1, 15), Q(1, 4, 15)},
    /* 0: the misalignment known so far stays */
    [PARAMETER_ANGLE_TRIM] = {"angle_trim", "", 0, 0, 1, 1},
    [PARAMETER_ANGLE_TRIM_RATE_1_S] = {"angle_trim_rate_1_s", "1/s", 0, 1, 100, 8},
    /* As bp_mode. */
    [PARAMETER_BP_TRIM_MODE] = {"bp_trim_mode", "", 0, 0, 3, 0},
    [PARAMETER_BP_TRIM_LIMIT_NM] = {"bp_trim_limit_Nm", "N m", 24, Q(1, 10, 24), Q(20, 1, 24), Q(3, 1, 24)},
    [PARAMETER_BP_TRIM_KP_MAX] = {"bp_trim_kp_max", "", 15, 0, Q(2, 1, 15) - 1, Q(1, 10, 15)},
    [PARAMETER_BP_TRIM_KI_MAX] = {"bp_trim_ki_max", "", 15, 0, Q(2, 1, 15) - 1, Q(1, 10, 15)},
    [PARAMETER_BP_TRIM_KD_MAX] = {"bp_trim_kd_max", "", 15, 0, Q(2, 1, 15) - 1, Q(5, 100, 15)},
};

void parameters_init(parameters_t *parameters) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        parameters->values[i] = rows[i].initial;
        parameters->defaults[i] = rows[i].initial;
    }
    parameters->changes = 0;
}

const parameter_row_t *parameters_row(unsigned index) {
    return &rows[index];
}

void parameters_set_default(parameters_t *parameters, unsigned index, int32_t value) {
    parameters->defaults[index] = fixed_clamp(value, rows[index].minimum, rows[index].maximum);
    parameters->values[index] = parameters->defaults[index];
    parameters->changes++;
}

parameter_status_t parameters_set(parameters_t *parameters, unsigned index, int32_t value) {
    if (index >= PARAMETER_COUNT) {
        return PARAMETER_NO_SUCH;
    }
    if (value < rows[index].minimum || value > rows[index].maximum) {
        return PARAMETER_OUT_OF_RANGE;
    }
    parameters->values[index] = value;
    parameters->changes++;
    return PARAMETER_DONE;
}

parameter_status_t parameters_get(const parameters_t *parameters, unsigned index, int32_t *value) {
    if (index >= PARAMETER_COUNT) {
        return PARAMETER_NO_SUCH;
    }
    *value = parameters->values[index];
    return PARAMETER_DONE;
}
