#include "drive/control.h"
#include "drive/torque_control.h"

control_diagnostics_t control_diagnose(const control_parameters_t *parameters, const control_state_t *state) {
    const control_measurement_t *measured = &state->measurement;
    const bool run = state->state_machine.state == DRIVE_STATE_RUN;
    const bool salient = run && parameters->controller == DRIVE_CONTROLLER_SALIENT;
    control_diagnostics_t diagnostics = {
        .angle = measured->angle,
        .speed_q22 = state->observer.speed_q22,
        .speed_reference_q22 = state->speed_reference_q22,
        .torque_reference_q24 = state->torque_reference_q24,
        .torque_q24 = measured->torque_sum_q24,
        .load_torque_q24 = state->observer.load_torque_q24,
        .bus_voltage_q6 = (uint16_t)measured->dc_link_voltage_q6,
        .duty_q15 = (state->duty.pid.duty_q23 + (1 << 7)) >> 8,
        .voltage_saturated = run && torque_control_voltage_saturated(parameters, state),
        .trim_torque_q24 = salient ? state->trim.trim_q24 : 0,
        .torque_missing_q24 = salient ? state->predictive.torque_shortfall_q24 : 0,
        .observer_bandwidth_rad_s = parameters->bandwidth.bandwidth_rad_s[state->bandwidth.stage],
    };
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        diagnostics.current_q9[phase] = (uint16_t)measured->current_q9[phase];
    }
    return diagnostics;
}
