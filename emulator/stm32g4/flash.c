/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/flash.h"

#include <string.h>

#include "stm32g4/cpu.h"
#include "stm32g4/nvic.h"
#include "stm32g4/peripherals.h"

#define FLASH 0x40022000u
#define ACR (FLASH + 0x00)
#define KEYR (FLASH + 0x08)
#define SR (FLASH + 0x10)
#define CR (FLASH + 0x14)
#define ECCR (FLASH + 0x18)
#define IRQ_FLASH CPU_IRQ(4)
#define NMI 2u

#define ACR_DCEN (1u << 10)
#define SR_EOP 0x1u
#define SR_PROGERR 0x8u
#define SR_PGAERR 0x20u
#define SR_SIZERR 0x40u
#define SR_PGSERR 0x80u
#define SR_ERRORS 0x3FAu
#define SR_BSY (1u << 16)
#define CR_PG 1u
#define CR_PER 2u
#define CR_BKER (1u << 11)
#define CR_STRT (1u << 16)
#define CR_EOPIE (1u << 24)
#define CR_ERRIE (1u << 25)
#define CR_LOCK (1u << 31)
#define CR_UNMODELLED 0x0C068004u /* mass erases, fast programming, option bytes, read errors */
#define ECCR_ECCD (1u << 31)

#define KEY_1 0x45670123u
#define KEY_2 0xCDEF89ABu
#define PROGRAM_NS 81690u /* data sheet, table of flash characteristics, typical */
#define ERASE_NS 22020000u
#define DOUBLE_WORDS (FLASH_BANK_BYTES / 8)
#define PAGE_DOUBLE_WORDS (FLASH_PAGE_BYTES / 8)

static struct {
    unsigned keys; /* of the sequence so far; 3: wrong until reset */
    bool first_written;
    uint32_t first_offset, first;
    bool torn[DOUBLE_WORDS];
    flash_store_t store;
    unsigned store_first, store_pages;
    uint8_t system[0x1000];
    uint64_t busy_until;
    bool cached;                       /* an operation has ended since the data cache was emptied */
    unsigned first_changing, changing; /* double words of the operation */
} flash;

unsigned flash_wait_states(void) {
    return REG(ACR) & 15;
}

void *flash_system_memory(void) {
    return flash.system;
}

void flash_open(void) {
    memset(flash.system, 0xFF, sizeof flash.system);
    static const uint16_t size_kib = 512;
    memcpy(flash.system + 0x5E0, &size_kib, sizeof size_kib);
    static const uint32_t identifier[] = {0x00320041, 0x5033500A, 0x20373357};
    memcpy(flash.system + 0x590, identifier, sizeof identifier);
}

void flash_set_store(const flash_store_t *store, unsigned first_page, unsigned pages) {
    flash.store = *store;
    flash.store_first = first_page;
    flash.store_pages = pages;
}

void flash_tear(unsigned double_word) {
    flash.torn[double_word] = true;
}

/* Index in the store, or -1. */
static int stored(unsigned double_word) {
    const unsigned page = double_word / PAGE_DOUBLE_WORDS;
    const bool inside = flash.store.read && page >= flash.store_first && page - flash.store_first < flash.store_pages;
    return inside ? (int)(double_word - flash.store_first * PAGE_DOUBLE_WORDS) : -1;
}

static uint64_t content(unsigned double_word) {
    const int index = stored(double_word);
    if (index >= 0) {
        bool torn = flash.torn[double_word];
        const uint64_t value = flash.store.read(flash.store.context, (unsigned)index, &torn);
        flash.torn[double_word] = torn;
        return value;
    }
    uint64_t value;
    memcpy(&value, soc.flash + FLASH_BANK_BYTES + 8u * double_word, sizeof value);
    return value;
}

static void line(void) {
    const uint32_t sr = REG(SR), cr = REG(CR);
    nvic_line(IRQ_FLASH, (sr & SR_EOP && cr & CR_EOPIE) || (sr & SR_ERRORS && cr & CR_ERRIE));
}

static void fail(uint32_t flag) {
    REG(SR) |= flag;
    line();
}

static void begin(uint64_t ns, unsigned first, unsigned count) {
    if (REG(ACR) & ACR_DCEN) {
        soc_violation("an operation in bank 2 with FLASH_ACR.DCEN: reads of bank 1 may corrupt the data cache");
    }
    flash.cached = true;
    flash.first_changing = first;
    flash.changing = count;
    if (soc.untimed) {
        flash_event();
        return;
    }
    REG(SR) |= SR_BSY;
    flash.busy_until = soc_cycle_of_ns(soc_ns(soc.now) + ns);
    soc_schedule(EVENT_FLASH, flash.busy_until);
}

void flash_event(void) {
    REG(SR) &= ~SR_BSY;
    if (REG(CR) & CR_EOPIE) {
        REG(SR) |= SR_EOP;
    }
    REG(CR) &= ~CR_STRT;
    line();
}

/* --- Operations --- */

static void erase(void) {
    const uint32_t cr = REG(CR), page = cr >> 3 & 0x7F;
    if (!(cr & CR_PER)) {
        fail(SR_PGSERR);
        return;
    }
    if (!(cr & CR_BKER)) {
        soc_violation("FLASH_CR = 0x%08X: page %u of bank 1, which the program runs from", cr, page);
    }
    if (REG(SR) & SR_ERRORS) {
        fail(SR_PGSERR);
        return;
    }
    const int index = stored(page * PAGE_DOUBLE_WORDS);
    if (index >= 0) {
        flash.store.erase(flash.store.context, (unsigned)index / PAGE_DOUBLE_WORDS);
    } else {
        memset(soc.flash + FLASH_BANK_BYTES + page * FLASH_PAGE_BYTES, 0xFF, FLASH_PAGE_BYTES);
    }
    memset(flash.torn + page * PAGE_DOUBLE_WORDS, 0, PAGE_DOUBLE_WORDS * sizeof flash.torn[0]);
    begin(ERASE_NS, page * PAGE_DOUBLE_WORDS, PAGE_DOUBLE_WORDS);
}

static void program(unsigned double_word, uint64_t value) {
    if (content(double_word) != UINT64_MAX && value != 0) {
        fail(SR_PROGERR);
        return;
    }
    const int index = stored(double_word);
    if (index >= 0) {
        flash.store.program(flash.store.context, (unsigned)index, value);
    } else {
        memcpy(soc.flash + FLASH_BANK_BYTES + 8u * double_word, &value, sizeof value);
    }
    begin(PROGRAM_NS, double_word, 1);
}

void flash_bank_2_write(uint32_t offset, uint32_t value, unsigned size) {
    if (REG(SR) & SR_BSY) {
        cpu_stall(flash.busy_until);
        soc_violation("write of 0x%X to 0x%08X while FLASH_SR.BSY is set", value,
                      FLASH_BASE + FLASH_BANK_BYTES + offset);
    }
    if (!(REG(CR) & CR_PG) || REG(SR) & SR_ERRORS) {
        fail(SR_PGSERR);
    } else if (size != 4) {
        fail(SR_SIZERR);
    } else if (!flash.first_written) {
        flash.first_written = true;
        flash.first_offset = offset;
        flash.first = value;
        if (offset % 8) {
            flash.first_written = false;
            fail(SR_PGAERR);
        }
    } else {
        flash.first_written = false;
        if (offset != flash.first_offset + 4) {
            fail(SR_PGAERR);
            return;
        }
        program(offset / 8, (uint64_t)value << 32 | flash.first);
    }
}

void flash_double_error(uint32_t offset) {
    if (!(REG(ECCR) & ECCR_ECCD)) {
        REG(ECCR) = (REG(ECCR) & 1u << 24) | ECCR_ECCD | ((offset & ~7u) & 0x7FFFF);
        nvic_line(NMI, true);
    }
}

void flash_cache_emptied(void) {
    flash.cached = false;
}

uint32_t flash_bank_2_read(uint32_t offset, unsigned size) {
    (void)size;
    if (flash.cached && REG(ACR) & ACR_DCEN) {
        soc_violation("read of 0x%08X: the data cache has not been emptied since the last operation (FLASH_ACR.DCRST)",
                      FLASH_BASE + FLASH_BANK_BYTES + offset);
    }
    if (REG(SR) & SR_BSY) {
        cpu_stall(flash.busy_until); /* the same bank: the bus waits */
    }
    const unsigned double_word = offset / 8;
    const uint64_t value = content(double_word);
    if (flash.torn[double_word]) {
        flash_double_error(0); /* worst case: ECCR has kept the address of an earlier, corrected error in bank 1 */
    }
    return (uint32_t)(value >> 8 * (offset % 8));
}

/* --- Registers --- */

static void key_write(uint32_t value) {
    if (flash.keys == 3 || value != (flash.keys == 0 ? KEY_1 : KEY_2) || !(REG(CR) & CR_LOCK)) {
        soc_violation("write of FLASH_KEYR, value 0x%08X: not the next key; the flash stays locked until a reset",
                      value);
    }
    if (++flash.keys == 2) {
        flash.keys = 0;
        REG(CR) &= ~CR_LOCK;
    }
}

static void control_write(uint32_t value) {
    const uint32_t old = REG(CR);
    if (REG(SR) & SR_BSY) {
        soc_violation("write of FLASH_CR, value 0x%08X, while FLASH_SR.BSY is set", value);
    }
    if (value & CR_UNMODELLED) {
        soc_violation("write of FLASH_CR, value 0x%08X: bits 0x%08X are not modelled", value, value & CR_UNMODELLED);
    }
    if (old & CR_LOCK && (value ^ old) & ~CR_LOCK) {
        soc_violation("write of FLASH_CR, value 0x%08X: it is locked", value);
    }
    REG(CR) = (value & ~CR_LOCK) | ((value | (old & CR_LOCK)) & CR_LOCK);
    if (!(value & CR_PG)) {
        flash.first_written = false;
    }
    if (value & CR_STRT) {
        erase();
    }
    line();
}

static void flash_write(uint32_t address, uint32_t value) {
    switch (address) {
    case KEYR:
        key_write(value);
        break;
    case SR:
        REG(SR) &= ~(value & 0xC3FBu);
        line();
        break;
    case CR:
        control_write(value);
        break;
    case ECCR:
        REG(ECCR) = (REG(ECCR) & ~(value & 0xF0000000u) & ~(1u << 24)) | (value & 1u << 24);
        nvic_line(NMI, REG(ECCR) & ECCR_ECCD); /* as long as the flag is set */
        break;
    default:
        soc_violation("write of %s, value 0x%08X: not modelled", soc_name(address), value);
    }
}

void flash_attach(void) {
    soc_attach(FLASH + 4, 0x400 - 4, 0x40021048u, 8, 0, flash_write);
}

/* A reset stops an operation: its double words are torn. A bench's memory has a way of its own. */
void flash_reset(void) {
    if (flash.busy_until > soc.now) {
        for (unsigned i = 0; i < flash.changing && stored(flash.first_changing) < 0; ++i) {
            flash.torn[flash.first_changing + i] = true;
        }
    }
    flash.busy_until = 0;
    flash.cached = false;
    nvic_line(NMI, false);
    flash.keys = 0;
    flash.first_written = false;
}
