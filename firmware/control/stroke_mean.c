#include "control/stroke_mean.h"

#include "fixed/fixed.h"

#define SETTLE_MS 150
#define SETTLE_STROKES 2
#define STROKE_UPDATES_MIN 8
#define TOLERANCE_Q24 1677722u /* 0.1 N m */
/* Disturbed strokes of equal mean from which on the machine disturbs itself. */
#define REPEATED_STROKES 8u
/* A stroke of at least 1/8 of the settling time is slow: the noise of its amplitude is below the tolerance. */
#define SLOW_PARTS 8u

/* h of a phase that has not been seen since the load has changed. */
#define HALF_UNKNOWN INT32_MIN

/* Half a stroke, number of strokes in Q32. */
#define HALF_STROKE (UINT32_C(1) << 31)

stroke_mean_parameters_t stroke_mean_configure(unsigned phases, uint32_t update_rate_hz) {
    return (stroke_mean_parameters_t){.phases = phases, .settle_updates = update_rate_hz * SETTLE_MS / 1000u};
}

/* Part by which the mean that is compared with follows the mean of a stroke: time constant twice the settling time. */
static int32_t following_q16(const stroke_mean_parameters_t *parameters, uint32_t updates) {
    const uint32_t since_last = updates * parameters->phases; /* of the phase, below 2^18 */
    const uint32_t settle = parameters->settle_updates;
    return since_last < settle ? (int32_t)((since_last << 13) / settle << 2) : 1 << 15;
}

static bool differs(int32_t mean_q24, int32_t other_q24, uint32_t tolerance_q24) {
    return fixed_magnitude(fixed_subtract(mean_q24, other_q24)) > tolerance_q24;
}

static void await_settling(const stroke_mean_parameters_t *parameters, stroke_mean_t *mean, uint32_t updates) {
    const uint32_t strokes = SETTLE_STROKES * updates;
    mean->remaining = fixed_max_u32(strokes, parameters->settle_updates);
}

/* The sums add Q7.24 numbers: in units of 2^8 they fit in 32 bits for 2^8 updates, of 2^16 for 2^16. */
static unsigned sum_shift(uint32_t updates) {
    return updates < 256 ? 8 : 16;
}

static void end_stroke(const stroke_mean_parameters_t *parameters, stroke_mean_t *mean, int32_t torque_q24) {
    const unsigned shift = sum_shift(mean->updates);
    const int32_t mean_q24 = (int32_t)(mean->sum_q24 >> shift) / (int32_t)mean->updates * (1 << shift);
    int32_t *constant_q24 = &mean->constant_q24[mean->stroke % HAL_PHASES_MAX];
    const bool disturbed = mean->disturbed || mean->disturbed_strokes > 0;
    const uint32_t tolerance_q24 = TOLERANCE_Q24 + (fixed_magnitude(torque_q24) >> (disturbed ? 3 : 4));
    const bool own_differs = differs(mean_q24, *constant_q24, tolerance_q24);
    const int32_t change_q24 = fixed_subtract(mean_q24, *constant_q24);
    *constant_q24 +=
        own_differs ? change_q24 : fixed_multiply(change_q24, following_q16(parameters, mean->updates), 16);
    mean->changed = own_differs && differs(mean_q24, mean->changed_q24, tolerance_q24);
    mean->ended = (stroke_mean_ended_t){
        .half = (int32_t)(mean->half_sum_q24 >> shift),
        .deviation = (uint32_t)(mean->deviation_sum_q24 >> shift),
        .updates = mean->updates,
        .tolerance_q24 = tolerance_q24 / 2,
        .phase = mean->stroke % HAL_PHASES_MAX,
    };
    if (mean->changed) {
        mean->changed_q24 = mean_q24;
        await_settling(parameters, mean, mean->updates);
        mean->disturbed_strokes = 0;
    } else if (mean->disturbed) {
        mean->disturbed_strokes += mean->disturbed_strokes < 3 * REPEATED_STROKES ? 2 : 0;
    } else {
        mean->disturbed_strokes -= mean->disturbed_strokes > 0;
    }
    mean->undisturbed_stroke = !mean->disturbed;
    mean->disturbed = false;
    mean->sum_q24 = mean->half_sum_q24 = 0;
    mean->deviation_sum_q24 = 0;
    mean->updates = 0;
}

bool stroke_mean_step(const stroke_mean_parameters_t *parameters, stroke_mean_t *mean, uint32_t electrical,
                      int32_t load_torque_q24, int32_t torque_q24, bool disturbed) {
    const uint64_t strokes_q32 = (uint64_t)electrical * parameters->phases;
    const uint32_t stroke = (uint32_t)(strokes_q32 >> 32);
    mean->remaining -= mean->remaining > 0;
    if ((stroke != mean->stroke && mean->updates >= STROKE_UPDATES_MIN) || mean->updates == UINT16_MAX) {
        end_stroke(parameters, mean, torque_q24);
    }
    mean->stroke = stroke;
    mean->sum_q24 += load_torque_q24;
    mean->half_sum_q24 += (strokes_q32 & HALF_STROKE) == 0 ? load_torque_q24 : -(int64_t)load_torque_q24;
    const unsigned phase = stroke % HAL_PHASES_MAX;
    const int32_t expected_q24 = mean->half_q24[phase] == HALF_UNKNOWN ? mean->changed_q24 : mean->constant_q24[phase];
    mean->deviation_sum_q24 += fixed_magnitude(fixed_subtract(load_torque_q24, expected_q24));
    mean->updates++;
    mean->disturbed |= disturbed;
    return mean->remaining == 0;
}

/* False for the first h under a load. */
static bool beyond_last(int32_t half_q24, int32_t last_q24, uint32_t tolerance_q24) {
    const uint32_t last_magnitude_q24 = fixed_magnitude(last_q24);
    const uint32_t limit_q24 = (half_q24 < 0) != (last_q24 < 0) ? last_magnitude_q24 / 2 : last_magnitude_q24;
    return last_q24 != HALF_UNKNOWN && fixed_magnitude(half_q24) > limit_q24 + tolerance_q24;
}

void stroke_mean_review(const stroke_mean_parameters_t *parameters, stroke_mean_t *mean) {
    const stroke_mean_ended_t *ended = &mean->ended;
    const unsigned shift = sum_shift(ended->updates);
    const uint32_t tolerance_q24 = ended->tolerance_q24;
    const int32_t half_q24 = (int32_t)((uint32_t)(ended->half / (int32_t)ended->updates) << shift);
    const uint32_t deviation_q24 = ended->deviation / ended->updates << shift;
    const uint32_t amplitude_q24 = fixed_magnitude(half_q24);
    int32_t *last_q24 = &mean->half_q24[ended->phase % HAL_PHASES_MAX];
    const bool slow = ended->updates >= parameters->settle_updates / SLOW_PARTS;
    const bool drifted = slow && (beyond_last(half_q24, *last_q24, tolerance_q24) ||
                                  deviation_q24 / 2 > amplitude_q24 + tolerance_q24 + tolerance_q24 / 4);
    *last_q24 = half_q24;
    const bool grown = slow && amplitude_q24 > mean->amplitude_q24 + tolerance_q24 / 2;
    mean->grown = drifted || grown || mean->last_grown;
    mean->last_grown = grown;
    mean->amplitude_q24 = amplitude_q24;
    if (mean->changed) {
        for (unsigned i = 0; i < HAL_PHASES_MAX; i++) {
            mean->half_q24[i] = HALF_UNKNOWN;
        }
    } else if (drifted) {
        mean->changed = true;
        mean->disturbed_strokes = 0;
        await_settling(parameters, mean, ended->updates);
    }
}

bool stroke_mean_shows_load(const stroke_mean_t *mean) {
    return (mean->undisturbed_stroke && !mean->disturbed) || mean->disturbed_strokes >= REPEATED_STROKES;
}
