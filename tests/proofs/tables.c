/* Functions of fixed/ with tables and loops. */
#include "fixed/crc32.c"
#include "fixed/divide.c"
#include "fixed/exp2.c"
#include "fixed/interpolate.h"
#include "fixed/sigmoid.c"
#include "fixed/vec3.h"
#include "proof.h"

void prove_divide(int64_t numerator, int64_t denominator) {
    ASSUME(denominator > 0); /* the header */
    const int64_t quotient = fixed_divide(numerator, denominator);
    CLAIM(IMPLIES(denominator == 1, quotient == numerator));
    CLAIM(IMPLIES(denominator == INT64_MAX, quotient == (numerator == INT64_MIN || numerator == -INT64_MAX ? -1
                                                         : numerator == INT64_MAX                          ? 1
                                                                                                           : 0)));
    CLAIM(IMPLIES(denominator == INT64_C(1) << 40,
                  quotient == (numerator < 0 ? -(int64_t)((0 - (uint64_t)numerator) >> 40) : numerator >> 40)));
}

/* Any numerator and denominator of eight bits. */
void prove_divide_small(int16_t numerator, int16_t denominator) {
    ASSUME(denominator > 0 && denominator < 256 && numerator > -256 && numerator < 256);
    CLAIM(fixed_divide(numerator, denominator) == numerator / denominator);
}

void prove_exp2(uint32_t exponent_q17) {
    const uint32_t value_q31 = exp2_negative_q31(exponent_q17);
    const uint32_t integer = exponent_q17 >> 17;
    CLAIM(IMPLIES(exponent_q17 == 0, value_q31 == UINT32_C(1) << 31));
    CLAIM(IMPLIES(integer >= 32, value_q31 == 0));
    if (integer < 32) { /* between the powers of 2 around it */
        CLAIM(value_q31 <= UINT32_C(1) << 31 >> integer && value_q31 >= UINT32_C(1) << 30 >> integer);
    }
}

void prove_sigmoid(int32_t x_q23) {
    const int32_t f_q27 = sigmoid_symmetric_q27(x_q23);
    CLAIM(f_q27 < (1 << 27) - (1 << 16) && f_q27 > -(1 << 27) + (1 << 16)); /* the header: 1 - 2^-11 */
    const int32_t g_q28 = sigmoid_logistic_q28(f_q27);
    CLAIM(g_q28 > 0 && g_q28 < 1 << 28);
}

typedef struct {
    int16_t entry[3];
} entries_t;

/* Nothing is undefined for any fraction; the value lies between the entries for fractions of three bits. */
void prove_interpolate(entries_t table, uint32_t index, uint32_t fraction, unsigned fraction_bits) {
    ASSUME(index < 2 && fraction_bits >= 1 && fraction_bits <= 16 && fraction < UINT32_C(1) << fraction_bits);
    interpolate_linear(table.entry, index, fraction, fraction_bits);
    const int32_t low = table.entry[index], high = table.entry[index + 1];
    const int32_t value = interpolate_linear(table.entry, index, fraction & 7, 3);
    CLAIM(value >= (low < high ? low : high) && value <= (low < high ? high : low));
    CLAIM(IMPLIES((fraction & 7) == 0, value == low));
}

void prove_dual16(int16_t low, int16_t high, int32_t word, int32_t other, int32_t sum) {
    const int16_t value[2] = {low, high};
    CLAIM((int16_t)(dual16_pack(low, high) & 0xFFFFu) == low && (int16_t)(dual16_pack(low, high) >> 16) == high);
    CLAIM((int16_t)(dual16_pack_upper(word, other) & 0xFFFFu) == word >> 16);
    CLAIM((int16_t)(dual16_pack_upper(word, other) >> 16) == other >> 16);
    ASSUME(sum > -(1 << 29) && sum < 1 << 29); /* the caller ensures that it fits */
    CLAIM(dual16_multiply_add(value, dual16_pack(3, -1), sum) == sum + 3 * low - high);
}

typedef struct {
    int32_t a[3];
    vec3_momentum_t vector;
} vectors_t;

/* Partial sums that fit: by smaller factors, in bp_network.c. */
static bool within(const int32_t *values, int32_t limit) {
    return values[0] <= limit && values[0] >= -limit && values[1] <= limit && values[1] >= -limit &&
           values[2] <= limit && values[2] >= -limit;
}

void prove_vec3(vectors_t any, int32_t scale, int32_t momentum_q32) {
    ASSUME(within(any.a, 1 << 30) && within(any.vector.value, 1 << 30) && within(any.vector.increment, 1 << 30));
    const int32_t before = any.vector.value[0];
    int32_t dot;
    CLAIM(vec3_dot_and_momentum_step(&any.vector, any.a, 0, 0, &dot) == &any.vector + 1);
    CLAIM(any.vector.increment[0] == 0 && any.vector.increment[2] == 0 && any.vector.value[0] == before);
    vec3_momentum_step(&any.vector, any.a, scale, momentum_q32);
    vec3_add_scaled(any.a, any.a, 0);
}

typedef struct {
    uint8_t byte[2];
} bytes_t;

/* A CRC that is continued is one of the whole. */
void prove_crc32(bytes_t bytes, unsigned count) {
    static const uint8_t digits[9] = "123456789";
    CLAIM(crc32_continue(0, digits, sizeof digits) == 0xCBF43926u); /* the header */
    ASSUME(count <= 2);
    const uint32_t whole = crc32_continue(0, bytes.byte, 2);
    CLAIM(crc32_continue(crc32_continue(0, bytes.byte, count), bytes.byte + count, 2 - count) == whole);
}
