#include "fixed/exp2.h"

#define STEP_BITS 6 /* 64 steps per factor of 2 */

/* 2^(-k/64) in unsigned Q1.30, k = 0..64. */
static const uint32_t exp2_table_q30[(1u << STEP_BITS) + 1] = {
    1073741824, 1062175491, 1050733751, 1039415261, 1028218693, 1017142735, 1006186087, 995347464, 984625594, 974019220,
    963527098,  953147997,  942880699,  932724001,  922676710,  912737649,  902905651,  893179563, 883558244, 874040567,
    864625413,  855311680,  846098274,  836984114,  827968132,  819049271,  810226483,  801498734, 792865000, 784324269,
    775875538,  767517817,  759250125,  751071493,  742980960,  734977579,  727060411,  719228525, 711481005, 703816941,
    696235434,  688735596,  681316545,  673977412,  666717336,  659535466,  652430958,  645402981, 638450708, 631573326,
    624770026,  618040012,  611382493,  604796689,  598281827,  591837143,  585461881,  579155293, 572916640, 566745190,
    560640218,  554601009,  548626854,  542717053,  536870912,
};

uint32_t exp2_negative_q31(uint32_t exponent_q17) {
    const uint32_t integer = exponent_q17 >> 17;
    if (integer >= 32) {
        return 0;
    }
    const uint32_t index = (exponent_q17 >> (17 - STEP_BITS)) & ((1u << STEP_BITS) - 1u);
    const uint32_t fraction_q11 = exponent_q17 & ((1u << (17 - STEP_BITS)) - 1u);
    const uint32_t high = exp2_table_q30[index];
    const uint32_t difference = high - exp2_table_q30[index + 1]; /* below 2^24; without 4 bits the product has 32 */
    const uint32_t value_q30 = high - (((difference >> 4) * fraction_q11) >> 7);
    return value_q30 << 1 >> integer;
}
