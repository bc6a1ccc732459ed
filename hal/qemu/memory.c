/* Program and stack of an image that sections.ld places: for every port with this linker script. */
#include "hal_memory.h"

/* Symbols of the linker script. */
extern const uint32_t code_start[];
extern uint32_t stack_end[], stack_top[];

/* After the code; salient.generate.code_check fills in both. */
__attribute__((section(".code_check"), used)) const volatile uint32_t code_check[2] = {0, 0};

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
