/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/soc.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "stm32g4/cpu.h"
#include "stm32g4/flash.h"
#include "stm32g4/nvic.h"
#include "stm32g4/peripherals.h"

#define ATTACHMENTS_MAX 64
#define MESSAGE_RAM 0x4000A400u
#define MESSAGE_RAM_BYTES 0x400u /* 3 x 212 words, of which the first instance has 0x350 bytes */
#define NS_PER_S UINT64_C(1000000000)

soc_t soc;

typedef struct {
    const char *name;
    uint32_t address, reset, readable, writable;
} row_t;

static const row_t rows[] = {
#include "stm32g4/registers.inc"
};
#define ROWS (sizeof rows / sizeof rows[0])

typedef struct {
    uint32_t base, size, enable;
    unsigned bit;
    soc_read_t read;
    soc_write_t write;
} attachment_t;

uint32_t soc_words[SOC_PAGES][SOC_PAGE_WORDS];

static struct {
    uint16_t row[SOC_PAGE_WORDS];       /* 1 + index in rows; 0: none */
    uint8_t attachment[SOC_PAGE_WORDS]; /* 1 + index; 0: not modelled */
} pages[SOC_PAGES];

static attachment_t attachments[ATTACHMENTS_MAX];
static unsigned attachment_count;

#define ALTERED_MAX 8
static struct { uint32_t address, clear, set; } altered[ALTERED_MAX];
static unsigned altered_count;

void soc_violation(const char *format, ...) {
    char text[400];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    fflush(stdout);
    fprintf(stderr, "salient_stm32g4: %s; pc 0x%08X, %llu ns\n", text, cpu_program_counter(),
            (unsigned long long)soc_ns(soc.now));
    exit(EXIT_VIOLATION);
}

void soc_no_peripheral(uint32_t address) {
    soc_violation("address 0x%08X: no peripheral", address);
}

static const row_t *row_of(uint32_t address) {
    const unsigned page = soc_page(address);
    const unsigned row = page == SOC_PAGES ? 0 : pages[page].row[address % SOC_PAGE_BYTES / 4];
    return row ? &rows[row - 1] : NULL;
}

const char *soc_name(uint32_t address) {
    const row_t *row = row_of(address);
    return row ? row->name : "no register";
}

void soc_attach(uint32_t base, uint32_t size, uint32_t enable, unsigned bit, soc_read_t read, soc_write_t write) {
    attachments[attachment_count++] = (attachment_t){base, size, enable, bit, read, write};
    for (uint32_t address = base; address < base + size; address += 4) {
        const unsigned page = soc_page(address);
        if (page < SOC_PAGES) {
            pages[page].attachment[address % SOC_PAGE_BYTES / 4] = (uint8_t)attachment_count;
        }
    }
}

/* --- Accesses --- */

static bool is_message_ram(uint32_t address) {
    return address >= MESSAGE_RAM && address < MESSAGE_RAM + MESSAGE_RAM_BYTES;
}

static const attachment_t *checked(uint32_t address, unsigned size, const char *access, uint32_t value) {
    const unsigned page = soc_page(address);
    const unsigned number = page == SOC_PAGES ? 0 : pages[page].attachment[address % SOC_PAGE_BYTES / 4];
    if (!number || (!row_of(address) && !is_message_ram(address))) {
        soc_violation("%s of 0x%08X (%s), value 0x%X: not modelled", access, address, soc_name(address), value);
    }
    const attachment_t *attachment = &attachments[number - 1];
    if (attachment->enable && !(REG(attachment->enable) >> attachment->bit & 1)) {
        soc_violation("%s of %s (0x%08X), value 0x%X: its clock is off, %s bit %u", access, soc_name(address), address,
                      value, soc_name(attachment->enable), attachment->bit);
    }
    const bool any_width = address >= 0x48000000u && address < 0x48002000u; /* GPIO */
    if ((size != 4 && !any_width) || address % size != 0) {
        soc_violation("%s of %s (0x%08X), value 0x%X: %u bytes, must be a word", access, soc_name(address), address,
                      value, size);
    }
    return attachment;
}

bool soc_alter(const char *name, uint32_t clear, uint32_t set) {
    for (unsigned i = 0; i < ROWS && altered_count < ALTERED_MAX; ++i) {
        if (strcmp(rows[i].name, name) == 0) {
            altered[altered_count].address = rows[i].address;
            altered[altered_count].clear = clear;
            altered[altered_count++].set = set;
            return true;
        }
    }
    return false;
}

static uint32_t with_mistake(uint32_t address, uint32_t value) {
    for (unsigned i = 0; i < altered_count; ++i) {
        if (altered[i].address == address) {
            value = (value & ~altered[i].clear) | altered[i].set;
        }
    }
    return value;
}

uint32_t soc_read(uint32_t address, unsigned size) {
    const attachment_t *attachment = checked(address & ~3u, 4, "read", 0);
    if (size != 4) {
        checked(address, size, "read", 0);
    }
    const row_t *row = row_of(address);
    if (row && row->readable == 0) {
        soc_violation("read of %s (0x%08X): write-only", row->name, address);
    }
    const uint32_t word = attachment->read ? attachment->read(address & ~3u) : REG(address & ~3u);
    nvic_settle();
    return word >> 8 * (address & 3);
}

void soc_write(uint32_t address, uint32_t value, unsigned size) {
    const attachment_t *attachment = checked(address, size, "write", value);
    const uint32_t at = address & ~3u, shift = 8 * (address & 3);
    if (is_message_ram(at)) {
        REG(at) = value;
        return;
    }
    const row_t *row = row_of(at);
    if (size != 4) {
        const uint32_t mask = ((1u << 8 * size) - 1) << shift;
        value = (row->readable ? REG(at) & ~mask : 0) | (value << shift & mask);
    }
    value = with_mistake(at, value);
    if (row->writable == 0) {
        soc_violation("write of %s (0x%08X), value 0x%X: read-only", row->name, at, value);
    }
    /* Bits that no field has keep their reset value; read-only fields ignore what is written. */
    const uint32_t reserved = ~(row->writable | row->readable);
    if ((value ^ row->reset) & reserved && !timer_clears_by_zeros(at)) {
        soc_violation("write of %s (0x%08X), value 0x%X: reserved bits 0x%X", row->name, at, value,
                      (value ^ row->reset) & reserved);
    }
    if (attachment->write) {
        attachment->write(at, value);
    } else {
        REG(at) = (value & row->writable) | (REG(at) & ~row->writable);
    }
}

/* --- Time --- */

uint64_t soc_ns(uint64_t cycle) {
    return soc.segment_ns + (uint64_t)((__uint128_t)(cycle - soc.segment_cycle) * NS_PER_S / soc.hclk_hz);
}

uint64_t soc_cycle_of_ns(uint64_t ns) {
    if (ns <= soc.segment_ns) {
        return soc.segment_cycle;
    }
    return soc.segment_cycle + (uint64_t)(((__uint128_t)(ns - soc.segment_ns) * soc.hclk_hz + NS_PER_S - 1) / NS_PER_S);
}

void soc_set_hclk(uint32_t hz) {
    soc.segment_ns = soc_ns(soc.now);
    soc.segment_cycle = soc.now;
    soc.hclk_hz = hz;
}

void soc_schedule(soc_event_t event, uint64_t cycle) {
    soc.due[event] = cycle;
    soc.next = SOC_NEVER;
    for (unsigned i = 0; i < EVENT_COUNT_OF_SOC; ++i) {
        soc.next = soc.due[i] < soc.next ? soc.due[i] : soc.next;
    }
}

static void handle(unsigned event) {
    if (event >= EVENT_TIMER && event <= EVENT_TIMER_LAST) {
        timer_event(event - EVENT_TIMER);
    } else if (event >= EVENT_ADC && event <= EVENT_ADC_LAST) {
        adc_event(event - EVENT_ADC);
    } else {
        peripherals_event((soc_event_t)event);
    }
}

void soc_advance(uint64_t cycle) {
    while (soc.next <= cycle) {
        soc.now = soc.next > soc.now ? soc.next : soc.now;
        for (unsigned i = 0; i < EVENT_COUNT_OF_SOC; ++i) {
            if (soc.due[i] <= soc.now) {
                soc_schedule((soc_event_t)i, SOC_NEVER);
                handle(i);
            }
        }
    }
    soc.now = cycle > soc.now ? cycle : soc.now;
}

void soc_request_reset(uint32_t cause) {
    soc.reset_request |= cause;
}

/* --- Start --- */

static void registers_reset(void) {
    for (unsigned i = 0; i < ROWS; ++i) {
        const unsigned page = soc_page(rows[i].address);
        pages[page].row[rows[i].address % SOC_PAGE_BYTES / 4] = (uint16_t)(i + 1);
        soc_words[page][rows[i].address % SOC_PAGE_BYTES / 4] = rows[i].reset;
    }
}

void soc_reset(uint32_t cause) {
    registers_reset();
    for (unsigned i = 0; i < EVENT_COUNT_OF_SOC; ++i) {
        soc_schedule((soc_event_t)i, SOC_NEVER);
    }
    soc.reset_request = 0;
    peripherals_reset(cause);
}

void soc_open(void) {
    soc.flash = malloc(2 * FLASH_BANK_BYTES);
    soc.sram = malloc(SRAM_BYTES);
    if (!soc.flash || !soc.sram) {
        fputs("salient_stm32g4: no memory\n", stderr);
        exit(EXIT_VIOLATION);
    }
    memset(soc.flash, 0xFF, 2 * FLASH_BANK_BYTES);
    memset(soc.sram, 0xA5, SRAM_BYTES); /* undefined after power-on */
    soc.hclk_hz = 16000000;
    peripherals_attach();
    flash_open();
    soc_reset(UINT32_C(0x0C000000)); /* PINRSTF and BORRSTF */
}
