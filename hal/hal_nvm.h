/* Non-volatile memory: pages of flash for data that survive a reset, apart from the pages of the program.
 *
 * A page is erased as a whole, which sets all its bits; a word is programmed once after that. Both block the caller. On
 * a microcontroller whose program runs from the same flash they also stall the interrupts (STM32G431: 22 ms and 85 us),
 * so that the drive begins neither in RUN nor after a command that starts a run: hal_pwm_open_all has opened all
 * switches, and no compare values are written before the operation has ended.
 *
 * A port whose operations stall the interrupts hides that from the next control interrupt: it discards the triggers
 * that came meanwhile, the pending one too, and the break `not renewed` that they caused, which in READY the drive
 * would take for the fault interrupt_overrun. Other causes of a break remain, and triggers that were missed before.
 * What the rotor turned meanwhile cannot be hidden: more than in one period at 1.5 times the speed limit, and two
 * counts, is the fault encoder in READY.
 *
 * Power may be lost during an operation. Of a word that was being programmed any of the bits to be cleared may be
 * cleared; a page that was being erased may have any content, different in each word. Other words and pages are
 * unchanged. A read of a torn word returns some value: a port whose memory has an error correction handles its errors.
 */
#ifndef HAL_NVM_H
#define HAL_NVM_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

#define HAL_NVM_PAGES 16
#define HAL_NVM_PAGE_WORDS 256 /* of 64 bits; a port with larger pages offers the first words of each */

/* Content of an erased word. */
#define HAL_NVM_ERASED UINT64_MAX

/* The word; page 0..HAL_NVM_PAGES-1, word 0..HAL_NVM_PAGE_WORDS-1, as below. [background] */
uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word);

/* Programs an erased word. False, with the word unchanged, when it is not erased; false also when the memory reports an
 * error: then the content is undefined. [background] */
bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value);

/* Erases a page, and kicks the watchdog. False when the memory reports an error: then the content is undefined.
 * [background] */
bool hal_nvm_erase(hal_t *hal, unsigned page);

#endif
