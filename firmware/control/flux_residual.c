#include "control/flux_residual.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* Currents up to this multiple of the offset are small. Drops of the devices, and pulses that are too short to act,
 * then make the error of the voltage twice as large. */
#define SMALL_CURRENT 4

NOINLINE flux_band_t flux_residual_band(uint32_t distance, uint32_t width, int32_t least_q9, int32_t most_q9) {
    const uint32_t near = distance > width ? distance - width : 0;
    const uint32_t far = distance + width < HALF_REV ? distance + width : HALF_REV - 1u;
    return (flux_band_t){
        .least_q29 = phase_map_flux_q29(&machine_tables, near, least_q9),
        .most_q29 = phase_map_flux_q29(&machine_tables, far, most_q9),
    };
}

/* Tolerance of psi(f), Wb, Q2.29: what has accumulated of the error of the voltage and of what winding and devices take
 * more or less, which are independent; and delays. */
static int32_t slack_q29(const flux_residual_t *residual, const flux_residual_phase_t *phase, int64_t resistive_q29) {
    const int64_t voltage_q29 = (int64_t)residual->pulse_q29 * (int32_t)phase->conducting;
    /* An error at the largest flux linkage remains while it falls. */
    const int32_t fallen_q29 = phase->peak_q29 - phase->flux_q29;
    return fixed_saturate(applied_flux_independent(voltage_q29, resistive_q29) + residual->delay_q29 + fallen_q29 / 4);
}

int32_t flux_residual_least_q29(const flux_residual_t *residual, unsigned index) {
    const flux_residual_phase_t *phase = &residual->phase[index];
    const int64_t devices_q29 = (int64_t)residual->device_q29 * (int32_t)phase->conducting;
    const int32_t warm_q29 = applied_flux_warm_q29(&machine_tables, phase->followed_drop_q29);
    return fixed_subtract(phase->flux_q29, slack_q29(residual, phase, warm_q29 + devices_q29));
}

int32_t flux_residual_most_q29(const flux_residual_t *residual, unsigned index) {
    const flux_residual_phase_t *phase = &residual->phase[index];
    const int32_t cold_q29 = applied_flux_cold_q29(phase->followed_drop_q29);
    return fixed_add(phase->flux_q29, slack_q29(residual, phase, cold_q29));
}

/* Periods since the phase was at rest, periods of a small current twice; what lies further back than the time constant
 * has been corrected. */
static uint32_t conducting(const flux_residual_t *residual, const flux_residual_phase_t *phase) {
    const uint32_t follow = FLUX_RESIDUAL_FOLLOW_MS * residual->sample.periods_per_ms;
    const uint32_t step = 2 * (residual->elapsed < follow ? residual->elapsed : follow);
    const uint32_t now = phase->conducting;
    if (phase->small) {
        return now + step < 2 * follow ? now + step : 2 * follow;
    }
    if (now > follow) {
        return now - follow > step ? now - step : follow;
    }
    return now + step / 2 < follow ? now + step / 2 : follow;
}

/* True when the opposite voltage has left the phase without flux linkage, errors of the integral included. */
static bool at_rest(const flux_residual_t *residual, flux_residual_phase_t *phase) {
    if (!phase->off || phase->flux_q29 > 0) {
        phase->rest_q29 = 0;
        return false;
    }
    /* Since the previous sample, if the phase was at 0 then already. */
    const uint32_t periods = phase->rest_q29 == 0 ? 1 : residual->elapsed & 0xffffu;
    phase->rest_q29 = fixed_saturate(phase->rest_q29 + (int64_t)residual->sample.period_flux_q29 * (int32_t)periods);
    /* The integral of a cold winding is 0 before the flux linkage is. */
    const int32_t remains_q29 = applied_flux_cold_q29(phase->followed_drop_q29);
    return phase->rest_q29 >= fixed_add(fixed_add(phase->peak_q29 / 4, residual->delay_q29), remains_q29);
}

/* An integral that saturates, as of a phase which holds a load for half a second at another resistance. */
static bool saturated(int32_t flux_q29) {
    return fixed_magnitude(flux_q29) >= INT32_MAX;
}

/* R i over the periods between two samples, Wb, Q2.29. */
static int32_t step_drop_q29(const flux_residual_t *residual, unsigned phase) {
    const flux_sample_t *sample = &residual->sample;
    const int32_t period_q29 = fixed_multiply_high(sample->current_q9[phase] << 12, sample->resistance_period_q40);
    return fixed_non_negative(fixed_saturate((int64_t)period_q29 * (int32_t)(residual->elapsed & 0xffffu)));
}

static void take_phase(flux_residual_t *residual, unsigned index, uint32_t lost_at) {
    const flux_sample_t *sample = &residual->sample;
    flux_residual_phase_t *phase = &residual->phase[index];
    const int32_t current_q9 = sample->current_q9[index];
    phase->misalignment = sample->misalignment[index];
    phase->angle = sample->electrical - index * sample->stroke - (uint32_t)phase->misalignment;
    phase->current_q9 = current_q9;
    phase->flux_q29 = fixed_non_negative(sample->flux_q29[index]);
    phase->voltage_q29 = fixed_subtract(phase->flux_q29, phase->followed_q29);
    phase->off = sample->off[index];
    phase->none = phase->off && current_q9 <= residual->offset_q9;
    phase->small = current_q9 <= SMALL_CURRENT * residual->offset_q9;
    phase->table_q29 =
        phase->none ? 0 : phase_map_flux_q29(&machine_tables, phase_map_distance(phase->angle), current_q9);
    phase->step_drop_q29 = step_drop_q29(residual, index);
    phase->drop_q29 = fixed_add(phase->drop_q29, phase->step_drop_q29);
    phase->followed_drop_q29 = fixed_add(phase->followed_drop_q29, phase->step_drop_q29);
    phase->known = sample->periods - phase->zero_at < sample->periods - lost_at && !saturated(phase->followed_q29) &&
                   !saturated(phase->voltage_q29);
    phase->conducting = conducting(residual, phase);
    phase->peak_q29 = phase->flux_q29 > phase->peak_q29 ? phase->flux_q29 : phase->peak_q29;
    phase->at_rest = at_rest(residual, phase);
    if (phase->at_rest && current_q9 <= 2 * residual->offset_q9) {
        phase->peak_q29 = 0;
        phase->conducting = 0;
    }
}

COLD bool flux_residual_step(flux_residual_t *residual, const flux_sample_t *sample) {
    const int32_t period_q29 = sample->period_flux_q29;
    residual->elapsed = sample->periods - residual->sample.periods;
    if (residual->elapsed == 0) {
        return false;
    }
    const uint32_t lost_at = residual->lost_at;
    residual->lost = sample->late_interrupts != residual->sample.late_interrupts;
    residual->lost_at = residual->lost ? sample->periods : lost_at;
    residual->step = (int32_t)(sample->electrical - residual->sample.electrical);
    residual->sample = *sample;
    residual->phases = machine_tables.phases;
    residual->offset_q9 = machine_tables.current_range_q9 / 128;
    residual->delay_q29 = fixed_saturate(period_q29 + (int64_t)(period_q29 / 50) * (int32_t)sample->periods_per_ms);
    residual->shortest_q29 =
        applied_flux_shortest_pulse_q29(period_q29, machine_tables.minimum_pulse_ns, sample->periods_per_ms);
    residual->pulse_q29 = fixed_max(residual->shortest_q29, period_q29 / 64);
    residual->device_q29 = applied_flux_device_q29(&machine_tables, sample->period_q40);
    for (unsigned phase = 0; phase < residual->phases; phase++) {
        take_phase(residual, phase, lost_at);
    }
    return true;
}

/* Corrections that bring the integral nearer to the tables. */
static int32_t correction_of(const flux_residual_t *residual, flux_residual_phase_t *phase, int32_t next_q29) {
    const int32_t flux_q29 = phase->flux_q29;
    if (phase->none) {
        phase->zero_at = residual->sample.periods;
        phase->followed_q29 = phase->drop_q29 = phase->followed_drop_q29 = 0;
        return -flux_q29;
    }
    if (phase->off && flux_q29 < residual->sample.period_flux_q29 && next_q29 <= 0) {
        /* The voltage alone ends it: without the corrections, too? */
        if (phase->voltage_q29 < residual->sample.period_flux_q29) {
            phase->zero_at = residual->sample.periods;
            phase->followed_q29 = 0;
        }
        return 0;
    }
    const int32_t error_q29 = phase->table_q29 - flux_q29;
    const int32_t follow = (int32_t)(FLUX_RESIDUAL_FOLLOW_MS * residual->sample.periods_per_ms);
    const int32_t elapsed = (int32_t)residual->elapsed;
    const bool set = residual->lost || residual->elapsed >= (uint32_t)follow;
    const int32_t correction_q29 = set ? error_q29 : error_q29 / follow * elapsed;
    const int32_t drop_q29 = phase->followed_drop_q29;
    phase->followed_drop_q29 = set ? 0 : drop_q29 - drop_q29 / follow * elapsed;
    phase->followed_q29 = fixed_add(phase->followed_q29, correction_q29);
    return correction_q29;
}

COLD void flux_residual_follow(flux_residual_t *residual, int32_t correction_q29[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < residual->phases; phase++) {
        correction_q29[phase] = correction_of(residual, &residual->phase[phase], residual->sample.next_q29[phase]);
    }
}
