#include "part.h"
#include "stimulus.h"

extern uint32_t stack_top[], bss_start[], bss_end[];
void start(void) __attribute__((noreturn));

handler_t vectors[118] __attribute__((aligned(512)));

__attribute__((section(".vectors"), used)) static void *const first[2] = {stack_top, start};

int leave(int code) {
    register int result __asm__("r0") = code;
    __asm__ volatile("bkpt 0" ::"r"(result));
    for (;;) {
    }
}

static void unexpected(void) {
    leave(0x10000);
}

void start(void) {
    for (volatile uint32_t *word = bss_start; word < bss_end; ++word) {
        *word = 0;
    }
    for (unsigned i = 0; i < sizeof vectors / sizeof vectors[0]; ++i) {
        vectors[i] = unexpected;
    }
    REG(0xE000ED08u) = (uint32_t)vectors;
    leave(test());
}

void fast_clock(void) {
    APB1ENR1 |= BIT(28);
    REG(0x40007080u) = 0;                                /* PWR_CR5: boost */
    REG(0x40022000u) = (REG(0x40022000u) & ~15u) | 4;    /* FLASH_ACR: four wait states */
    REG(RCC + 0x0C) = 2u | 3u << 4 | 85u << 8 | BIT(24); /* 16 / 4 * 85 / 2 = 170 MHz */
    REG(RCC) |= BIT(24);
    while (!(REG(RCC) & BIT(25))) {
    }
    REG(RCC + 0x08) = (REG(RCC + 0x08) & ~0xFFu) | 8u << 4 | 3; /* half, for 1 us */
    wait(200);
    REG(RCC + 0x08) &= ~0xF0u;
}

void print(uint32_t value) {
    stimulus_number(value);
    stimulus_character('\n');
}
