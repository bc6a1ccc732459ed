#include "rig/nvm.h"

#include <string.h>

#include "plant/random.h"

void nvm_init(nvm_t *nvm) {
    memset(nvm, 0, sizeof *nvm);
    memset(nvm->word, 0xFF, sizeof nvm->word);
}

void nvm_power_on(nvm_t *nvm) {
    nvm->power_lost = false;
    nvm->cut_after = 0;
}

/* Counts an operation; true when power is lost at it. */
static bool cut(nvm_t *nvm) {
    nvm->operations++;
    nvm->power_lost = nvm->cut_after == 1;
    if (nvm->cut_after > 0) {
        nvm->cut_after--;
    }
    return nvm->power_lost;
}

uint64_t nvm_read(const nvm_t *nvm, unsigned page, unsigned word) {
    return nvm->word[page][word];
}

bool nvm_program(nvm_t *nvm, unsigned page, unsigned word, uint64_t value) {
    uint64_t *target = &nvm->word[page][word];
    if (nvm->power_lost || *target != HAL_NVM_ERASED) {
        return false;
    }
    if (!cut(nvm)) {
        *target = value;
        return true;
    }
    switch (nvm->cut_kind) {
    case NVM_CUT_TORN:
        *target = value | random_next(&nvm->random);
        break;
    case NVM_CUT_HALF:
        *target = value | UINT64_C(0xFFFFFFFF00000000);
        break;
    case NVM_CUT_OLD:
    default:
        break;
    }
    return false;
}

bool nvm_erase(nvm_t *nvm, unsigned page) {
    if (nvm->power_lost) {
        return false;
    }
    nvm->erasures[page]++;
    if (!cut(nvm)) {
        memset(nvm->word[page], 0xFF, sizeof nvm->word[page]);
        return true;
    }
    for (unsigned i = 0; i < HAL_NVM_PAGE_WORDS; i++) {
        uint64_t *word = &nvm->word[page][i];
        const uint64_t random = random_next(&nvm->random);
        if (nvm->cut_kind == NVM_CUT_TORN) {
            *word = random;
        } else if (nvm->cut_kind == NVM_CUT_HALF && random % 3 == 0) {
            *word = HAL_NVM_ERASED;
        } else if (nvm->cut_kind == NVM_CUT_HALF && random % 3 == 1) {
            *word |= random_next(&nvm->random);
        }
    }
    return false;
}
