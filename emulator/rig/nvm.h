/* Emulated flash: pages, words that are programmed once, erasure, and the loss of power at any operation.
 *
 * Operations are programmings and erasures. A cut at operation n (the n-th from when it is set, from 1) leaves it as
 * the kind says, and no later operation has an effect until nvm_power_on. Random bits come from the seeded sequence.
 *
 *   kind    word that was being programmed        page that was being erased
 *   old     as before                             as before
 *   torn    some of its bits cleared              every bit random
 *   half    all bits of its lower half cleared    each word erased, as before, or with some of its bits set
 */
#ifndef RIG_NVM_H
#define RIG_NVM_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_nvm.h"

typedef enum { NVM_CUT_OLD, NVM_CUT_TORN, NVM_CUT_HALF, NVM_CUT_KINDS } nvm_cut_t;

typedef struct {
    uint64_t word[HAL_NVM_PAGES][HAL_NVM_PAGE_WORDS];
    uint32_t erasures[HAL_NVM_PAGES]; /* since nvm_init */
    uint32_t operations;              /* since nvm_init, with power */
    uint32_t cut_after;               /* operations until the one at which power is lost, 1: the next; 0: none */
    nvm_cut_t cut_kind;
    bool power_lost;
    uint64_t random; /* state of the sequence */
} nvm_t;

/* An erased memory. */
void nvm_init(nvm_t *nvm);

/* Ends a loss of power, and a cut that has not occurred. */
void nvm_power_on(nvm_t *nvm);

/* The hal_* functions of the same name. */
uint64_t nvm_read(const nvm_t *nvm, unsigned page, unsigned word);
bool nvm_program(nvm_t *nvm, unsigned page, unsigned word, uint64_t value);
bool nvm_erase(nvm_t *nvm, unsigned page);

#endif
