/* Comparators and the DACs that give their thresholds, by the table of the manual: each source another threshold, each
 * input just below and above it. */
#include "part.h"

#define COMP(n) REG(0x40010200u + 4 * ((n)-1))
#define DAC(n) (0x50000400u + 0x400u * (n))
#define CODE(pin, code) (REG(0xE0000004u) = (uint32_t)(pin) << 16 | (code))
#define AT(port, number) ((port)*16 + (number))

int test(void) {
    /* Input INP0; DAC and channel of the codes 4 and 5. */
    static const uint8_t rows[7][5] = {{AT(A, 1), 3, 1, 1, 1}, {AT(A, 7), 3, 2, 1, 2},  {AT(A, 0), 3, 1, 1, 1},
                                       {AT(B, 0), 3, 2, 1, 1}, {AT(B, 13), 4, 1, 1, 2}, {AT(B, 11), 4, 2, 2, 1},
                                       {AT(B, 14), 4, 1, 2, 1}};
    APB2ENR |= BIT(0);
    AHB2ENR |= BIT(0) | BIT(1) | BIT(16) | BIT(17) | BIT(18) | BIT(19);
    for (unsigned dac = 1; dac <= 4; ++dac) {
        REG(DAC(dac) + 0x3C) = 3u | 3u << 16;
        REG(DAC(dac) + 0x08) = 500 * dac;
        REG(DAC(dac) + 0x14) = 500 * dac + 200;
        REG(DAC(dac)) = BIT(0) | BIT(16);
    }
    for (unsigned n = 1; n <= 7; ++n) {
        for (unsigned source = 0; source < 2; ++source) {
            const uint8_t *row = rows[n - 1];
            const uint32_t threshold = 500u * row[1 + 2 * source] + 200u * (row[2 + 2 * source] - 1u);
            COMP(n) = (4 + source) << 4 | 1;
            CODE(row[0], threshold - 2);
            CHECK(!(COMP(n) & BIT(30)));
            CODE(row[0], threshold + 2);
            CHECK(COMP(n) & BIT(30));
            COMP(n) = (4 + source) << 4 | BIT(15) | 1;
            CHECK(!(COMP(n) & BIT(30)));
            CODE(row[0], 0);
            CHECK(COMP(n) & BIT(30));
        }
    }
    return 0;
}
