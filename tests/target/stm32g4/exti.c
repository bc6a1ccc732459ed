/* Edges of a pin: the selected one alone sets the flag, of the selected port alone, and a one clears it. PB12 is driven
 * by the bench. */
#include "part.h"

#define EXTICR4 REG(0x40010014u)
#define IMR1 REG(0x40010400u)
#define RTSR1 REG(0x40010408u)
#define FTSR1 REG(0x4001040Cu)
#define PR1 REG(0x40010414u)
#define LEVEL(level) (REG(0xE0000008u) = 28u << 16 | (level))

int test(void) {
    APB2ENR |= BIT(0);
    AHB2ENR |= BIT(1);
    MODER(B) &= ~(3u << 24);
    EXTICR4 = 1;
    IMR1 |= BIT(12);
    LEVEL(1);
    FTSR1 |= BIT(12);
    CHECK(!(PR1 & BIT(12)));
    LEVEL(0);
    CHECK(PR1 & BIT(12));
    PR1 = BIT(12);
    CHECK(!(PR1 & BIT(12)));
    LEVEL(1);
    CHECK(!(PR1 & BIT(12)));
    FTSR1 &= ~BIT(12);
    RTSR1 |= BIT(12);
    LEVEL(0);
    CHECK(!(PR1 & BIT(12)));
    LEVEL(1);
    CHECK(PR1 & BIT(12));
    PR1 = BIT(12);
    EXTICR4 = 0;
    LEVEL(0);
    LEVEL(1);
    CHECK(!(PR1 & BIT(12)));
    return 0;
}
