/* Bank 2: erase and program times while bank 1 executes, errors of the sequence, read back. */
#include "part.h"

#define FLASH 0x40022000u
#define SR_ REG(FLASH + 0x10)
#define CR_ REG(FLASH + 0x14)
#define WORD(n) REG(0x08040000u + 4 * (n))

/* Without its data cache, which would keep what it has read. */
static void cache_off(void) {
    REG(FLASH) &= ~BIT(10);
}

int test(void) {
    cache_off();
    REG(FLASH + 8) = 0x45670123;
    REG(FLASH + 8) = 0xCDEF89AB;
    CHECK(!(CR_ & BIT(31)));
    CR_ = BIT(1) | BIT(11); /* PER, bank 2, page 0 */
    REG(0xE0001000u) = 1;
    uint32_t from = CYCLES;
    CR_ |= BIT(16);
    unsigned executed = 0;
    while (SR_ & BIT(16)) {
        ++executed;
    }
    CHECK(executed > 1000);
    CHECK(CYCLES - from > 16 * 20000 && CYCLES - from < 16 * 25000);
    CHECK(WORD(0) == 0xFFFFFFFF);
    /* Without PG: an error of the sequence. */
    CR_ = 0;
    WORD(0) = 1;
    CHECK(SR_ & BIT(7));
    SR_ = BIT(7);
    CHECK(!(SR_ & BIT(7)));
    CR_ = 1;
    from = CYCLES;
    WORD(0) = 0x11223344;
    WORD(1) = 0x55667788;
    while (SR_ & BIT(16)) {
    }
    CHECK(CYCLES - from > 16 * 80 && CYCLES - from < 16 * 100);
    CHECK(WORD(0) == 0x11223344 && WORD(1) == 0x55667788);
    /* A word that is not erased. */
    WORD(0) = 0x1;
    WORD(1) = 0x1;
    CHECK(SR_ & BIT(3));
    CHECK(WORD(0) == 0x11223344);
    return 0;
}
