/* Memory: program and stack for the self-test, pages for the parameters, random numbers. */
#include "hal_memory.h"
#include "hal_nvm.h"
#include "hal_random.h"
#include "skeleton/board.h"

extern const uint32_t code_start[];       /* symbols of the linker script */
extern uint32_t stack_end[], stack_top[]; /* likewise */

/* After the code; salient.generate.code_check fills in both. */
__attribute__((section(".code_check"), used)) const volatile uint32_t code_check[2] = {0, 0};

/* As it is for a linker script with these symbols. */
void hal_memory(const hal_t *hal, hal_memory_t *memory) {
    (void)hal;
    *memory = (hal_memory_t){
        .code = code_start,
        .code_words = code_check[0],
        .code_crc = code_check[1],
        .stack = stack_end,
        .stack_words = (uint32_t)(stack_top - stack_end),
    };
}

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

/* FILL IN: erases a page; kicks the watchdog where that takes longer than its time. */
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
