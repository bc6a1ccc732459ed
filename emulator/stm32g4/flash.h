/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Flash (RM0440, 5): two banks of 256 KiB, pages of 2 KiB, double words with an error correction code. The program is
 * in bank 1; bank 2 is erased and programmed while the program runs. Times are the typical ones of the data sheet.
 */
#ifndef STM32G4_FLASH_H
#define STM32G4_FLASH_H

#include <stdbool.h>
#include <stdint.h>

void flash_open(void);
void flash_attach(void);
void flash_reset(void);
void flash_event(void);

unsigned flash_wait_states(void);

/* Identifiers and calibration values: the 4 KiB at 0x1FFF7000. */
void *flash_system_memory(void);

/* A read of bank 1 or 2 has found a double error. */
void flash_double_error(uint32_t offset);

/* The data cache has been emptied. */
void flash_cache_emptied(void);

uint32_t flash_bank_2_read(uint32_t offset, unsigned size);
void flash_bank_2_write(uint32_t offset, uint32_t value, unsigned size);

/* Content of bank 2 behind a bench's memory; each may be NULL. programmed: a double word at its index; erased: a page.
 */
typedef struct {
    uint64_t (*read)(void *context, unsigned double_word, bool *torn);
    void (*program)(void *context, unsigned double_word, uint64_t value);
    void (*erase)(void *context, unsigned page);
    void *context;
} flash_store_t;
void flash_set_store(const flash_store_t *store, unsigned first_page, unsigned pages);

/* Power fails while the double word is programmed: its correction code does not fit afterwards. */
void flash_tear(unsigned double_word);

#endif
