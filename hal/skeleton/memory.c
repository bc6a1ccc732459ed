/* Memory: pages for the parameters, random numbers. Program and stack for the self-test are in ../qemu/memory.c for
 * images that ../qemu/sections.ld places; a port with another linker script has a hal_memory of its own. */
#include "hal_nvm.h"
#include "hal_random.h"
#include "skeleton/board.h"

/* FILL IN: a word; errors of the memory's error correction are dealt with. */
uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word) {
    (void)hal;
    (void)page;
    (void)word;
    return HAL_NVM_ERASED;
}

/* FILL IN: programs an erased word, without stalling the interrupts. */
bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value) {
    (void)hal;
    (void)page;
    (void)word;
    (void)value;
    return false;
}

/* FILL IN: erases a page; kicks the watchdog, and as often as it takes longer than its time. */
bool hal_nvm_erase(hal_t *hal, unsigned page) {
    (void)hal;
    (void)page;
    return false;
}

/* FILL IN: true random number generator; with numbers that can be predicted anybody on the bus can arm the drive. */
uint32_t hal_random_u32(hal_t *hal) {
    (void)hal;
    return 0;
}
