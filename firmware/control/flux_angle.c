#include "control/flux_angle.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* s: 2^26 of 2^-32 electrical rev. */
#define STEP_BITS 26
#define HALF_STEP (UINT32_C(1) << (STEP_BITS - 1))

/* Sums over 2^11 samples, 0.45 s of a phase that conducts for nearly half of the time and has ten a millisecond.
 * They are solved after each 256, from 1.1 s on: an encoder that is displaced by more than can be learned has been
 * found before (monitors/phase_balance.h). */
#define FORGET_BITS 11
#define SAMPLES_MIN 5120u
#define SAMPLES_EACH 256u
/* Samples of one conduction: the start of a longer one is forgotten (e^-2) before its end, and the courses of the rest
 * are alike. */
#define CONDUCTION_MAX (2u << FORGET_BITS)

/* Flux linkages in the sums, Wb: Q19, so that 2^13 squares of 4 Wb fit; D, which is smaller, Q23. */
#define COARSER 10
#define SLOPE_COARSER 6

/* Sums are scaled below 2^SCALED_BITS. Of the squares of D at least RESOLVED is unlike the other courses. */
#define SCALED_BITS 30
#define RESOLVED 1024

#define DELTA (FLUX_ANGLE_COURSES - 2)

/* 0.5 rad/s: at a lower speed the errors of the voltage are many times the flux linkage. */
#define SPEED_MIN_Q22 (1u << 21)

/* Part of the sensors' range above which a current counts. */
#define CURRENT_PART 64

static int32_t flux_at(uint32_t angle, int32_t current_q9) {
    return phase_map_flux_q29(&machine_tables, phase_map_distance(angle), current_q9);
}

COLD bool flux_angle_add(flux_angle_t *flux_angle, const flux_residual_t *residual, unsigned index) {
    const flux_residual_phase_t *phase = &residual->phase[index];
    const int32_t flux_q29 = phase->voltage_q29, current_q9 = phase->current_q9;
    if (flux_q29 <= 0) {
        flux_angle->resistive_q29 = flux_angle->time_q29 = 0;
        if (flux_angle->conduction_samples > 0) {
            flux_angle->last_conduction_samples = flux_angle->conduction_samples;
        }
        flux_angle->conduction_samples = 0;
        return false;
    }
    /* After more than 255 periods the integrals are wrong until the phase begins again. */
    const int32_t time_q29 = (residual->sample.period_flux_q29 >> 8) * (int32_t)(residual->elapsed & 0xffu);
    flux_angle->resistive_q29 = fixed_add(flux_angle->resistive_q29, phase->step_drop_q29);
    flux_angle->time_q29 = fixed_add(flux_angle->time_q29, time_q29);
    if (!phase->known || phase->off || current_q9 <= machine_tables.current_range_q9 / CURRENT_PART ||
        fixed_magnitude(residual->sample.speed_q22) <= SPEED_MIN_Q22) {
        return false;
    }
    const int32_t slope_q29 =
        flux_at(phase->angle + HALF_STEP, current_q9) - flux_at(phase->angle - HALF_STEP, current_q9);
    const int32_t excess_q29 = fixed_subtract(phase->table_q29, flux_q29);
    const int32_t course[FLUX_ANGLE_COURSES] = {
        flux_angle->time_q29 >> COARSER,
        flux_angle->resistive_q29 >> COARSER,
        phase->table_q29 >> COARSER,
        slope_q29 >> SLOPE_COARSER,
        fixed_add(excess_q29, fixed_multiply_shift(slope_q29, phase->misalignment, STEP_BITS)) >> COARSER,
    };
    for (unsigned row = 0; row < FLUX_ANGLE_COURSES; row++) {
        for (unsigned column = row; column < FLUX_ANGLE_COURSES; column++) {
            int64_t *sum = &flux_angle->sum[row][column];
            *sum += fixed_product(course[row], course[column]) - (*sum >> FORGET_BITS);
        }
    }
    flux_angle->samples++;
    flux_angle->conduction_samples++;
    return flux_angle->samples >= SAMPLES_MIN && flux_angle->samples % SAMPLES_EACH == 0;
}

COLD int32_t flux_angle_solve(const flux_angle_t *flux_angle) {
    if (flux_angle->conduction_samples > CONDUCTION_MAX || flux_angle->last_conduction_samples > CONDUCTION_MAX) {
        return 0;
    }
    unsigned shift = 0;
    for (unsigned row = 0; row < FLUX_ANGLE_COURSES; row++) {
        shift = fixed_max_u32(shift, fixed_shift_below((uint64_t)flux_angle->sum[row][row], SCALED_BITS));
    }
    int32_t scaled[FLUX_ANGLE_COURSES][FLUX_ANGLE_COURSES];
    for (unsigned row = 0; row < FLUX_ANGLE_COURSES; row++) {
        for (unsigned column = row; column < FLUX_ANGLE_COURSES; column++) {
            scaled[row][column] = (int32_t)(flux_angle->sum[row][column] >> shift);
        }
    }
    for (unsigned pivot = 0; pivot < DELTA; pivot++) {
        const int32_t *by = scaled[pivot];
        if (by[pivot] <= 0) {
            return 0;
        }
        for (unsigned row = pivot + 1; row < FLUX_ANGLE_COURSES; row++) {
            for (unsigned column = row; column < FLUX_ANGLE_COURSES; column++) {
                const int32_t part = fixed_saturate(fixed_divide(fixed_product(by[row], by[column]), by[pivot]));
                scaled[row][column] = fixed_subtract(scaled[row][column], part);
            }
        }
    }
    const int32_t unlike = scaled[DELTA][DELTA];
    if (unlike < RESOLVED) {
        return 0;
    }
    const int64_t left = (int64_t)scaled[DELTA][DELTA + 1] * (INT64_C(1) << (STEP_BITS + COARSER - SLOPE_COARSER));
    return fixed_saturate(fixed_divide(left, unlike));
}
