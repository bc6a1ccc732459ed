/* Parameters and tables: the first pages of flash bank 2, which is written while the program runs from bank 1. */
#include "hal_nvm.h"
#include "hal_time.h"
#include "hal_watchdog.h"
#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#define BANK_2 0x08040000u
#define PAGE_BYTES 2048u
#define KEY_1 UINT32_C(0x45670123)
#define KEY_2 UINT32_C(0xCDEF89AB)
#define ERRORS                                                                                                         \
    (FLASH_SR_OPERR | FLASH_SR_PROGERR | FLASH_SR_WRPERR | FLASH_SR_PGAERR | FLASH_SR_SIZERR | FLASH_SR_PGSERR |       \
     FLASH_SR_MISERR | FLASH_SR_FASTERR | FLASH_SR_RDERR | FLASH_SR_OPTVERR)
#define OPERATION_MAX_US 50000u /* an erasure takes 24.5 ms at most by the data sheet */

static volatile uint32_t *address(unsigned page, unsigned word) {
    return (volatile uint32_t *)(uintptr_t)(BANK_2 + PAGE_BYTES * page + sizeof(uint64_t) * word);
}

/* An erased word reads as ones. A torn one may have a double error: the NMI has dealt with it when the read returns. A
 * mark tells the NMI whose error it is: ECCR has the address of the first error since its flags were cleared, which a
 * corrected one of the program may be. Nothing else runs meanwhile. */
uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word) {
    (void)hal;
    const volatile uint32_t *at = address(page, word);
    uint32_t primask;
    __asm__ volatile("mrs %0, primask\n\tcpsid i" : "=r"(primask)::"memory");
    board.reads_parameters = true;
    const uint32_t low = at[0];
    const uint32_t high = at[1];
    __asm__ volatile("dsb\n\tisb" ::: "memory"); /* the NMI of a double error comes here at the latest */
    board.reads_parameters = false;
    __asm__ volatile("msr primask, %0" ::"r"(primask) : "memory");
    return (uint64_t)high << 32 | low;
}

bool nvm_error_in_parameters(void) {
    if (!board.reads_parameters) {
        return false;
    }
    FLASH_ECCR |= FLASH_ECCR_ECCD | FLASH_ECCR_ECCD2;
    (void)FLASH_ECCR; /* the flag has gone before the return: else the NMI comes again, and finds none */
    return true;
}

/* Begins an operation: false while the flash has a single bank, where it would stall the program. Without the
 * data cache, which the program's reads of bank 1 may corrupt during an operation in bank 2: ST's drivers do the same.
 */
static bool begin(void) {
    if (!(FLASH_OPTR & FLASH_OPTR_DBANK) || (FLASH_SR & FLASH_SR_BSY)) {
        return false;
    }
    if ((FLASH_CR & FLASH_CR_LOCK) != 0) {
        FLASH_KEYR = KEY_1;
        FLASH_KEYR = KEY_2;
    }
    FLASH_SR = ERRORS | FLASH_SR_EOP; /* errors of before would forbid the operation */
    FLASH_ACR &= ~FLASH_ACR_DCEN;
    return true;
}

/* Ends it: waits, locks the flash, and empties the data cache, which may have the words of before. kicks: an erasure
 * takes longer than the watchdog allows; a word does not, and a background that only writes is no sign of life. */
static bool end(hal_t *hal, bool kicks) {
    const uint32_t from_us = hal_time_us(hal);
    bool done;
    do {
        done = !(FLASH_SR & FLASH_SR_BSY);
        if (kicks) {
            hal_watchdog_kick(hal);
        }
    } while (!done && hal_time_us(hal) - from_us < OPERATION_MAX_US);
    const bool right = done && !(FLASH_SR & ERRORS);
    FLASH_CR = FLASH_CR_LOCK;
    FLASH_ACR |= FLASH_ACR_DCRST;
    FLASH_ACR &= ~FLASH_ACR_DCRST;
    FLASH_ACR |= FLASH_ACR_DCEN;
    return right;
}

bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value) {
    if (hal_nvm_read(hal, page, word) != HAL_NVM_ERASED || !begin()) {
        return false;
    }
    volatile uint32_t *at = address(page, word);
    FLASH_CR = FLASH_CR_PG;
    at[0] = (uint32_t)value;
    __asm__ volatile("isb" ::: "memory"); /* two stores, not merged (RM0440, FLASH: standard programming) */
    at[1] = (uint32_t)(value >> 32);
    return end(hal, false);
}

bool hal_nvm_erase(hal_t *hal, unsigned page) {
    if (!begin()) {
        return false;
    }
    FLASH_CR = FLASH_CR_PER | PUT(FLASH_CR_PNB, page) | FLASH_CR_BKER;
    FLASH_CR |= FLASH_CR_STRT;
    return end(hal, true);
}
