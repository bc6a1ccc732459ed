/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * STM32G474RE: time, events, memory map and the registers' common rules.
 *
 * Time is counted in cycles of HCLK; events are due at cycles. A change of the clock begins a new segment, so that a
 * cycle has an exact time in nanoseconds. Oscillators apart from HCLK (LSI, LSE) convert from nanoseconds.
 *
 * Registers are words with a row of registers.inc. Before a peripheral sees an access, the rules that hold for all of
 * them are checked: the register exists and is modelled, its peripheral is clocked, the access has 32 bits (GPIO: any),
 * no reserved bit changes, a register without writable bits is not written. A breach ends the run with one line.
 */
#ifndef STM32G4_SOC_H
#define STM32G4_SOC_H

#include <stdbool.h>
#include <stdint.h>
#include <stdnoreturn.h>

#define EXIT_VIOLATION 70 /* exit code after a breach of a rule or a fault of the processor */

#define FLASH_BASE 0x08000000u
#define FLASH_BANK_BYTES 0x40000u
#define FLASH_PAGE_BYTES 2048u
#define SRAM_BASE 0x20000000u
#define SRAM_BYTES 0x20000u /* SRAM1, SRAM2 and the alias of CCM SRAM */
#define CCM_BASE 0x10000000u
#define CCM_BYTES 0x8000u

/* Sources of events, in the order of handling at equal times. */
typedef enum {
    EVENT_FLASH,
    EVENT_TIMER, /* and the following: one for each timer */
    EVENT_TIMER_LAST = EVENT_TIMER + 7,
    EVENT_ADC, /* and the following: one for each converter */
    EVENT_ADC_LAST = EVENT_ADC + 4,
    EVENT_FDCAN,
    EVENT_IWDG,
    EVENT_SYSTICK,
    EVENT_COUNT_OF_SOC
} soc_event_t;

#define SOC_NEVER UINT64_MAX

typedef struct {
    uint64_t now;  /* cycles of HCLK since reset of the model */
    uint64_t next; /* earliest due */
    uint64_t due[EVENT_COUNT_OF_SOC];
    uint32_t hclk_hz, pclk1_hz, pclk2_hz;
    uint32_t timer1_hz, timer2_hz; /* clocks of the timers on APB1 and APB2 */
    uint64_t segment_cycle, segment_ns;
    bool untimed; /* instructions, conversions and waits take no time: time moves with the bench alone */
    uint8_t *flash, *sram;
    uint32_t reset_request; /* bits of RCC_CSR; 0: none */
} soc_t;

extern soc_t soc;

/* Memories and registers after power-on. */
void soc_open(void);

/* Registers after a reset, memories kept; `cause`: bits of RCC_CSR. */
void soc_reset(uint32_t cause);

/* Resets before the next block of instructions: the run of the processor ends, and its caller calls soc_reset. */
void soc_request_reset(uint32_t cause);

/* Due cycle of an event; SOC_NEVER: none. */
void soc_schedule(soc_event_t event, uint64_t cycle);

/* Handles all events up to a cycle, which is the time afterwards. */
void soc_advance(uint64_t cycle);

uint64_t soc_ns(uint64_t cycle);
uint64_t soc_cycle_of_ns(uint64_t ns); /* rounded up */

/* Begins a segment with another HCLK. */
void soc_set_hclk(uint32_t hz);

/* Ends the run: one line on stderr with the text, the program counter and the time. */
noreturn void soc_violation(const char *format, ...) __attribute__((format(printf, 1, 2)));

/* --- Registers --- */

/* Pages of address ranges with registers. */
#define SOC_PAGE_BYTES 1024u
#define SOC_PAGE_WORDS (SOC_PAGE_BYTES / 4)
#define SOC_PAGES_PERIPHERALS 192u
#define SOC_PAGES_PORTS 8u
#define SOC_PAGES_CONVERTERS 8u
#define SOC_PAGES (SOC_PAGES_PERIPHERALS + SOC_PAGES_PORTS + SOC_PAGES_CONVERTERS + 1) /* the last: random numbers */

/* Page of an address; SOC_PAGES: none. Inline, with soc_word: a search in a table took a fifth of the time of a world
 * of the campaign. */
static inline unsigned soc_page(uint32_t address) {
    const uint32_t peripherals = (address - 0x40000000u) / SOC_PAGE_BYTES,
                   ports = (address - 0x48000000u) / SOC_PAGE_BYTES,
                   converters = (address - 0x50000000u) / SOC_PAGE_BYTES;
    if (peripherals < SOC_PAGES_PERIPHERALS) {
        return peripherals;
    }
    if (ports < SOC_PAGES_PORTS) {
        return SOC_PAGES_PERIPHERALS + ports;
    }
    if (converters < SOC_PAGES_CONVERTERS) {
        return SOC_PAGES_PERIPHERALS + SOC_PAGES_PORTS + converters;
    }
    return (address - 0x50060800u) / SOC_PAGE_BYTES == 0 ? SOC_PAGES - 1 : SOC_PAGES;
}

/* Ends the run: no page has the address. */
noreturn void soc_no_peripheral(uint32_t address);

extern uint32_t soc_words[SOC_PAGES][SOC_PAGE_WORDS];

/* The stored word of a register. */
static inline uint32_t *soc_word(uint32_t address) {
    const unsigned page = soc_page(address);
    if (page == SOC_PAGES) {
        soc_no_peripheral(address);
    }
    return &soc_words[page][address % SOC_PAGE_BYTES / 4];
}
#define REG(address) (*soc_word(address))

/* Name of the manual, or a text without one. */
const char *soc_name(uint32_t address);

/* Accesses of processor and DMA. size in bytes. */
uint32_t soc_read(uint32_t address, unsigned size);
void soc_write(uint32_t address, uint32_t value, unsigned size);

/* A mistake that the program does not have: bits that its writes of a register clear and set, to see what finds it.
 * name: of the manual. False: no such register, or too many. */
bool soc_alter(const char *name, uint32_t clear, uint32_t set);

/* Functions of a peripheral: read returns the value; write receives a word whose reserved bits are checked. NULL: the
 * stored word alone. */
typedef uint32_t (*soc_read_t)(uint32_t address);
typedef void (*soc_write_t)(uint32_t address, uint32_t value);

/* Registers of [base, base + size) that belong to a peripheral; enable: address of the RCC register with its clock, or
 * 0; bit: in it. */
void soc_attach(uint32_t base, uint32_t size, uint32_t enable, unsigned bit, soc_read_t read, soc_write_t write);

#endif
