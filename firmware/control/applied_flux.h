/* Flux linkage that the applied voltage has built up in each phase: the integral of Faraday's law alone, from the
 * duties, whatever the current sensors say but for the resistive drop.
 *
 *   psi(k) = max(0, psi(k))                               without current: the diodes block a reverse one
 *   psi(k+1) = psi(k) + Ts (duty Vdc - R i)               forward Euler
 *
 * Both switches off are the duty -1: full opposite voltage until the flux linkage has gone. A phase that is off once in
 * an electrical revolution begins at 0 each time. Drops of the devices and errors of R and Vdc accumulate; the caller
 * corrects the integral by what it knows of the flux linkage (flux_residual.h). While there is current it may
 * fall below 0: that is what the error of R is known by (table_scale.h). */
#ifndef CONTROL_APPLIED_FLUX_H
#define CONTROL_APPLIED_FLUX_H

#include <stdint.h>

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "hal.h"

typedef struct {
    int32_t at_sample_q29[HAL_PHASES_MAX]; /* at the last sample, Wb, Q2.29 */
    int32_t next_q29[HAL_PHASES_MAX];      /* at the coming sample, if it has a current, Wb, Q2.29 */
} applied_flux_t;

/* Vdc Ts, Wb, Q2.29. dc_link_voltage_q6: V, Q9.6, below 2^16; period_q40: Ts, s, Q-9.40. */
ALWAYS_INLINE int32_t applied_flux_period_q29(int32_t dc_link_voltage_q6, int32_t period_q40) {
    return fixed_multiply_high(dc_link_voltage_q6 << 15, period_q40);
}

/* Flux linkage that the shortest pulse makes at the DC-link voltage, Wb, Q2.29: what a period lacks at most in which
 * the devices suppress a shorter one. minimum_pulse_ns: 0..2000, rate_kHz: up to 1000. */
static inline int32_t applied_flux_shortest_pulse_q29(int32_t period_flux_q29, uint32_t minimum_pulse_ns,
                                                      uint32_t rate_kHz) {
    const uint32_t part_q14 = minimum_pulse_ns * rate_kHz / 61u; /* 10^6 / 2^14 = 61 */
    return fixed_multiply(period_flux_q29, (int32_t)part_q14, 14);
}

/* Part of the sensors' range that is no current: an error of twice that is a fault of a sensor
 * (monitors/phase_evidence.h). */
#define APPLIED_FLUX_NO_CURRENT 64u

/* Resistance of a winding, of which the drive knows neither temperature nor tolerance: copper is 0.75 of its value at
 * 25 C at -40 C, and 1.5 times it at 155 C ((235 C + T) / 260 K, IEC 60034-1), and 6 % remain for the winding itself:
 * 0.7 to 1.6 times the parameter, and the resistance of the devices. So the integral is too small by at most 0.3, and
 * too large by at most 0.6 of what the resistive drop has taken from it, and what the devices take. drop_q29: integral
 * of R i, Wb, Q2.29, >= 0; saturates. */
static inline int32_t applied_flux_cold_q29(int32_t drop_q29) {
    return drop_q29 / 10 * 3;
}

static inline int32_t applied_flux_warm_q29(const machine_tables_t *tables, int32_t drop_q29) {
    return fixed_multiply(drop_q29, 154 + tables->device_resistance_q8, 8);
}

/* Threshold voltage of the devices in a period, Wb, Q2.29. */
static inline int32_t applied_flux_device_q29(const machine_tables_t *tables, int32_t period_q40) {
    return applied_flux_period_q29(tables->device_drop_most_q6, period_q40);
}

/* Error of the voltage in a period, Wb, Q2.29: 1/64, or the threshold of the devices if that is more. */
static inline int32_t applied_flux_voltage_error_q29(const machine_tables_t *tables, int32_t period_flux_q29,
                                                     int32_t period_q40) {
    const int32_t device_q29 = applied_flux_device_q29(tables, period_q40);
    return fixed_max(device_q29, period_flux_q29 / 64);
}

/* Two independent errors together, >= 0: the larger one and a quarter of the other, within 12 % of the root of the sum
 * of their squares. */
static inline int64_t applied_flux_independent(int64_t a, int64_t b) {
    return a > b ? a + b / 4 : b + a / 4;
}

/* Constants of a period for all phases. */
typedef struct {
    int32_t full_q32;    /* Vdc Ts, Wb */
    int32_t against_q40; /* -R Ts, ohm s */
    int32_t none_q9;     /* current up to which there is none, A */
} applied_flux_period_t;

/* dc_link_voltage_q6, period_q40: as above; the product below 2^27. resistance_period_q40: R Ts, ohm s, Q-9.40.
 * current_range_q9: of the sensors, A, Q7.9, of which 1/64 is no current. */
ALWAYS_INLINE applied_flux_period_t applied_flux_period(int32_t dc_link_voltage_q6, int32_t period_q40,
                                                        int32_t resistance_period_q40, uint32_t current_range_q9) {
    return (applied_flux_period_t){applied_flux_period_q29(dc_link_voltage_q6, period_q40) * 8, -resistance_period_q40,
                                   (int32_t)(current_range_q9 / APPLIED_FLUX_NO_CURRENT)};
}

/* One period of a phase, which begins with the sample. duty_q15: acts in this period, -32768..32768; current_q9: A,
 * Q7.9, below 2^16. Both products are rounded to 1 LSB, the sum saturates. A voltage that has ended the current within
 * a period has not made the flux linkage negative: without a current the sample begins at 0, before the new voltage
 * acts. */
ALWAYS_INLINE void applied_flux_step(applied_flux_t *flux, const applied_flux_period_t *period, unsigned phase,
                                     int32_t duty_q15, int32_t current_q9) {
    const int32_t before_q29 = flux->next_q29[phase];
    const int32_t now_q29 = current_q9 > period->none_q9 ? before_q29 : fixed_non_negative(before_q29);
    const int32_t gained_q29 = fixed_multiply_high(duty_q15 * (1 << 14), period->full_q32); /* Q15 Q29 to Q29 */
    const int32_t change_q29 = fixed_multiply_high_add(gained_q29, current_q9 << 12, period->against_q40);
    flux->at_sample_q29[phase] = now_q29;
    flux->next_q29[phase] = fixed_add(now_q29, change_q29);
}

#endif
