/* fixed/fixed.h: each operation equals its model in 64 bits over the whole range of its arguments. */
#include "fixed/fixed.h"
#include "proof.h"

static int64_t saturated(int64_t value) {
    return value > INT32_MAX ? INT32_MAX : value < INT32_MIN ? INT32_MIN : value;
}

void prove_saturate(int64_t value) {
    CLAIM(fixed_saturate(value) == saturated(value));
}

void prove_clamp(int32_t value, int32_t low, int32_t high, int64_t wide, int64_t wide_low, int64_t wide_high) {
    CLAIM(fixed_min(low, high) == (low < high ? low : high));
    CLAIM(fixed_max(low, high) == (low < high ? high : low));
    CLAIM(fixed_min_u32((uint32_t)low, (uint32_t)high) <= (uint32_t)low);
    CLAIM(fixed_max_u32((uint32_t)low, (uint32_t)high) >= (uint32_t)low);
    CLAIM(fixed_min_u32((uint32_t)low, (uint32_t)high) + fixed_max_u32((uint32_t)low, (uint32_t)high) ==
          (uint32_t)low + (uint32_t)high);
    ASSUME(low <= high && wide_low <= wide_high);
    const int32_t clamped = fixed_clamp(value, low, high);
    CLAIM(clamped >= low && clamped <= high && IMPLIES(value >= low && value <= high, clamped == value));
    CLAIM(IMPLIES(value > high, clamped == high) && IMPLIES(value < low, clamped == low));
    const int64_t wide_clamped = fixed_clamp_64(wide, wide_low, wide_high);
    CLAIM(wide_clamped >= wide_low && wide_clamped <= wide_high);
    CLAIM(IMPLIES(wide >= wide_low && wide <= wide_high, wide_clamped == wide));
    CLAIM(IMPLIES(wide > wide_high, wide_clamped == wide_high) && IMPLIES(wide < wide_low, wide_clamped == wide_low));
}

void prove_shift_below(uint64_t magnitude, unsigned bits) {
    ASSUME(bits >= 1 && bits <= 63); /* the header */
    const unsigned shift = fixed_shift_below(magnitude, bits);
    CLAIM(shift < 64 && magnitude >> shift < UINT64_C(1) << bits);
    CLAIM(shift == 0 || magnitude >> (shift - 1) >= UINT64_C(1) << bits); /* and none smaller */
}

void prove_sums(int32_t a, int32_t b) {
    CLAIM(fixed_add(a, b) == saturated((int64_t)a + b));
    CLAIM(fixed_subtract(a, b) == saturated((int64_t)a - b));
    CLAIM(fixed_add_twice(a, b) == saturated(a + saturated(2 * (int64_t)b)));
}

void prove_magnitudes(int32_t value) {
    const int64_t magnitude = value < 0 ? -(int64_t)value : value;
    CLAIM(fixed_abs(value) == saturated(magnitude));
    CLAIM(fixed_magnitude(value) == magnitude);
    CLAIM(fixed_non_negative(value) == (value < 0 ? 0 : value));
    CLAIM(fixed_saturate_u16(value) == (value < 0 ? 0 : value > UINT16_MAX ? UINT16_MAX : value));
}

/* Two multipliers of any factors are too much for a solver to compare: nothing is undefined for any, and the rounding
 * is proved for any factor a and these factors b and shifts. */
static const int32_t factors[] = {INT32_MIN, -1, 3};
#define FACTORS (sizeof factors / sizeof *factors)
static const unsigned shifts[] = {1, 15, 31};
#define SHIFTS (sizeof shifts / sizeof *shifts)

void prove_products(int64_t sum, int32_t a, int32_t b, int32_t high, unsigned shift) {
    ASSUME(shift >= 1 && shift <= 31); /* the header; of fixed_multiply() 1..62 */
    fixed_product(a, b);
    fixed_accumulate(sum, a, b);
    fixed_multiply(a, b, 2 * shift);
    fixed_product_shift_saturate(a, b, shift);
    fixed_multiply_shift(a, b, shift);
    CLAIM(fixed_multiply_high(a, b) <= 1 << 30 && fixed_multiply_high(a, b) >= -(1 << 30));
    ASSUME(high < 1 << 30 && high >= -(1 << 30)); /* the header: the caller ensures that the sum fits */
    fixed_multiply_high_add(high, a, b);
}

void prove_shift(int64_t value, unsigned shift) {
    ASSUME(shift >= 1 && shift <= 62);                        /* the header */
    ASSUME(value <= INT64_MAX - (INT64_C(1) << (shift - 1))); /* likewise */
    const int64_t half = INT64_C(1) << (shift - 1);
    const int64_t rounded = fixed_shift(value, shift);
    const int64_t error = (int64_t)((uint64_t)value - ((uint64_t)rounded << shift));
    CLAIM(rounded <= (INT64_MAX >> shift) + 1 && rounded >= INT64_MIN >> shift);
    CLAIM(error >= -half && error < half); /* to nearest, halves upwards */
}

/* Product / 2^shift, to nearest: rounded down, and the bit below. */
static int64_t rounded(int64_t product, unsigned shift) {
    return (product >> shift) + (product >> (shift - 1) & 1);
}

void prove_multiply(int32_t a) {
    for (unsigned k = 0; k < FACTORS; k++) {
        for (unsigned i = 0; i < SHIFTS; i++) {
            const int64_t wanted = rounded((int64_t)a * factors[k], shifts[i]);
            CLAIM(fixed_multiply(a, factors[k], shifts[i]) == saturated(wanted));
        }
    }
}

void prove_multiply_high(int32_t a, int32_t sum) {
    for (unsigned k = 0; k < FACTORS; k++) {
        const int64_t high = rounded((int64_t)a * factors[k], 32);
        CLAIM(fixed_multiply_high(a, factors[k]) == high);
        ASSUME(saturated(sum + high) == sum + high); /* the header: the caller ensures that the sum fits */
        CLAIM(fixed_multiply_high_add(sum, a, factors[k]) == sum + high);
    }
}

void prove_saturate_bits(int32_t value, unsigned bits, unsigned shift) {
    ASSUME(bits >= 1 && bits <= 32 && shift >= 1 && shift <= 31); /* the header */
    const int64_t limit = INT64_C(1) << (bits - 1);
    const int64_t clamped = value >= limit ? limit - 1 : value < -limit ? -limit : value;
    CLAIM(fixed_saturate_bits(value, bits) == clamped);
    const int64_t shifted = (int64_t)value * (INT64_C(1) << shift);
    ASSUME(saturated(shifted) == shifted); /* the header: it fits in 32 bits */
    const int64_t shifted_clamped = shifted >= limit ? limit - 1 : shifted < -limit ? -limit : shifted;
    CLAIM(fixed_shift_up_saturate_bits(value, shift, bits) == shifted_clamped);
}

/* Saturates to within 2^(32 - shift) of the ends, and is exact between. */
static void claim_shifted(int32_t result, int64_t value, unsigned shift) {
    const int64_t wanted = value >> shift;
    const int64_t slack = INT64_C(1) << (32 - shift);
    CLAIM(IMPLIES(saturated(wanted) == wanted, result == wanted));
    CLAIM(IMPLIES(wanted > INT32_MAX, result > INT32_MAX - slack));
    CLAIM(IMPLIES(wanted < INT32_MIN, result < INT32_MIN + slack));
}

void prove_shift_saturate(int64_t value, unsigned shift) {
    ASSUME(shift >= 1 && shift <= 31); /* the header */
    claim_shifted(fixed_words_shift_saturate((int32_t)(value >> 32), (uint32_t)value, shift), value, shift);
    claim_shifted(fixed_shift_saturate(value, shift), value, shift);
}

void prove_multiply_shift(int32_t a) {
    for (unsigned k = 0; k < FACTORS; k++) {
        for (unsigned i = 0; i < SHIFTS; i++) {
            const int64_t product = (int64_t)a * factors[k];
            const int64_t half = INT64_C(1) << (shifts[i] - 1);
            claim_shifted(fixed_product_shift_saturate(a, factors[k], shifts[i]), product, shifts[i]);
            claim_shifted(fixed_multiply_shift(a, factors[k], shifts[i]), product + half, shifts[i]);
        }
    }
}
