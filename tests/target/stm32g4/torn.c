/* A reset while a double word is programmed tears it: its read is an NMI until the flag is cleared; its neighbours are
 * whole. The address in ECCR is the first error's, and no evidence. */
#include "part.h"

#define FLASH 0x40022000u
#define ECCR REG(FLASH + 0x18)
#define WORD(n) REG(0x08040000u + 4 * (n))
#define KEPT REG(0x2001F000u) /* survives a reset */
#define MAGIC 0x70A7u

static volatile unsigned errors;
static volatile uint32_t at;

static void nmi(void) {
    ++errors;
    at = ECCR;
    ECCR = at | BIT(31);
    (void)ECCR;
}

int test(void) {
    REG(FLASH) &= ~BIT(10); /* no data cache */
    vectors[2] = nmi;
    if (KEPT != MAGIC) {
        KEPT = MAGIC;
        REG(FLASH + 8) = 0x45670123;
        REG(FLASH + 8) = 0xCDEF89AB;
        REG(FLASH + 0x14) = 1;
        WORD(4) = 0x11223344;
        WORD(5) = 0x55667788;
        CHECK(REG(FLASH + 0x10) & BIT(16));
        REG(0xE000ED0Cu) = 0x05FA0004u;
        wait(1000);
        CHECK(0);
    }
    KEPT = 0;
    CHECK(WORD(2) == 0xFFFFFFFF && WORD(6) == 0xFFFFFFFF);
    CHECK(errors == 0);
    (void)WORD(4);
    barrier();
    CHECK(errors == 1);
    CHECK(at & BIT(31));
    CHECK(!(ECCR & BIT(31)));
    return 0;
}
