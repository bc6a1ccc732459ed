/* [SR-59] */
#include "storage/nvm_ring.h"

#include "fixed/compiler.h"
#include "fixed/crc32.h"
#include "fixed/fixed.h"

#define MAGIC UINT32_C(0x5344)
#define LAYOUT_VERSION UINT32_C(1)
#define COMMIT UINT64_C(0x0F1E2D3C4B5A6978)

/* Records that a half takes; 0 when the length has changed in memory to 0, and never more than `slot` can count. */
static unsigned slots(const nvm_ring_t *ring) {
    const unsigned words = nvm_ring_pages(ring->record_words) * HAL_NVM_PAGE_WORDS;
    return ring->record_words > 0 ? fixed_min_u32(words / ring->record_words, UINT8_MAX) : 0u;
}

/* Place of a word in the memory. */
typedef struct {
    unsigned page, word;
} address_t;

static unsigned first_page_of(const nvm_ring_t *ring, unsigned half) {
    return ring->first_page + half * nvm_ring_pages(ring->record_words);
}

static address_t address(const nvm_ring_t *ring, unsigned half, unsigned slot, unsigned word) {
    const unsigned at = slot * ring->record_words + word;
    return (address_t){.page = first_page_of(ring, half) + at / HAL_NVM_PAGE_WORDS, .word = at % HAL_NVM_PAGE_WORDS};
}

static uint64_t read_word(const nvm_ring_t *ring, const hal_t *hal, unsigned half, unsigned slot, unsigned word) {
    const address_t at = address(ring, half, slot, word);
    return at.page < HAL_NVM_PAGES ? hal_nvm_read(hal, at.page, at.word) : 0; /* neither a record nor erased */
}

static uint64_t header(const nvm_ring_t *ring, uint32_t sequence) {
    return (uint64_t)(MAGIC << 16 | LAYOUT_VERSION << 8 | (ring->record_words & 0xFFu)) << 32 | sequence;
}

static uint64_t checksum_word(uint32_t crc) {
    return (uint64_t)~crc << 32 | crc;
}

/* A committed record with a sequence number. [SR-58] [SR-59] */
static bool valid(const nvm_ring_t *ring, const hal_t *hal, unsigned half, unsigned slot, uint32_t sequence) {
    const unsigned checked = ring->record_words - 2u;
    if (read_word(ring, hal, half, slot, 0) != header(ring, sequence) ||
        read_word(ring, hal, half, slot, ring->record_words - 1u) == HAL_NVM_ERASED) {
        return false;
    }
    uint32_t crc = 0;
    for (unsigned i = 0; i < checked; i++) {
        const uint64_t word = read_word(ring, hal, half, slot, i);
        crc = crc32_continue(crc, &word, sizeof word);
    }
    return read_word(ring, hal, half, slot, checked) == checksum_word(crc);
}

static bool erased(const nvm_ring_t *ring, const hal_t *hal, unsigned half, unsigned slot) {
    for (unsigned i = 0; i < ring->record_words; i++) {
        if (read_word(ring, hal, half, slot, i) != HAL_NVM_ERASED) {
            return false;
        }
    }
    return true;
}

/* False for a place outside of both halves, which has changed in memory. */
static bool is_inside(const nvm_ring_t *ring) {
    return ring->half < 2 && ring->newest_half < 2 && ring->slot < slots(ring) && ring->word < ring->record_words &&
           ring->erase <= nvm_ring_pages(ring->record_words) && first_page_of(ring, 2) <= HAL_NVM_PAGES;
}

/* The first erased place from the present one on, else the start of the half that does not have the newest record: of
 * the present half again, when every place of it was passed over before a record was committed. Without a record half 0
 * is kept, because what is damaged there tells the caller that there was one. [SR-58] */
static void find_place(nvm_ring_t *ring, const hal_t *hal) {
    ring->word = 0;
    ring->crc = 0;
    while (ring->slot < slots(ring) && !erased(ring, hal, ring->half, ring->slot)) {
        ring->slot++;
    }
    if (ring->slot >= slots(ring)) {
        ring->half = ring->newest_half ^ 1u;
        ring->slot = 0;
        ring->erase = (uint8_t)nvm_ring_pages(ring->record_words);
    }
}

COLD void nvm_ring_init(nvm_ring_t *ring, const hal_t *hal, unsigned first_page, unsigned record_words) {
    *ring = (nvm_ring_t){.first_page = (uint8_t)first_page, .record_words = (uint16_t)record_words};
    bool committed = false;
    for (unsigned half = 0; half < 2; half++) {
        /* Backwards: the newest of a half comes first, and the checksums of the others need not be computed. */
        for (unsigned slot = slots(ring); slot-- > 0;) {
            const uint32_t sequence = (uint32_t)read_word(ring, hal, half, slot, 0);
            const uint64_t commit = read_word(ring, hal, half, slot, record_words - 1);
            committed = committed || commit != HAL_NVM_ERASED;
            if (sequence > ring->sequence && valid(ring, hal, half, slot, sequence)) {
                ring->sequence = sequence;
                ring->torn_commit = commit != COMMIT;
                ring->half = ring->newest_half = (uint8_t)half;
                ring->slot = (uint8_t)(slot + 1);
            }
        }
    }
    ring->damaged = ring->sequence == 0 && committed;
    find_place(ring, hal);
}

COLD unsigned nvm_ring_place(const nvm_ring_t *ring, const hal_t *hal, uint32_t sequence) {
    for (unsigned half = 0; half < 2; half++) {
        for (unsigned slot = slots(ring); slot-- > 0;) {
            if ((uint32_t)read_word(ring, hal, half, slot, 0) == sequence && valid(ring, hal, half, slot, sequence)) {
                return half * slots(ring) + slot;
            }
        }
    }
    return NVM_RING_NOWHERE;
}

uint64_t nvm_ring_payload(const nvm_ring_t *ring, const hal_t *hal, unsigned place, unsigned index) {
    return read_word(ring, hal, place / slots(ring), place % slots(ring), index + 1u);
}

/* [SR-58] [SR-60] */
COLD bool nvm_ring_read(const nvm_ring_t *ring, const hal_t *hal, uint32_t sequence, uint64_t *payload) {
    const unsigned place = nvm_ring_place(ring, hal, sequence);
    if (place == NVM_RING_NOWHERE) {
        return false;
    }
    for (unsigned i = 0; i + NVM_RING_OVERHEAD < ring->record_words; i++) {
        payload[i] = nvm_ring_payload(ring, hal, place, i);
    }
    return true;
}

static nvm_ring_result_t pass_over(nvm_ring_t *ring, const hal_t *hal) {
    ring->slot++;
    find_place(ring, hal);
    if (++ring->attempts < NVM_RING_ATTEMPTS) {
        return NVM_RING_BUSY;
    }
    ring->attempts = 0;
    return NVM_RING_FAILED;
}

COLD nvm_ring_result_t nvm_ring_step(nvm_ring_t *ring, hal_t *hal, uint64_t payload_word) {
    if (!is_inside(ring)) {
        return NVM_RING_FAILED;
    }
    if (ring->erase > 0) {
        ring->erase--;
        return hal_nvm_erase(hal, first_page_of(ring, ring->half) + ring->erase) ? NVM_RING_BUSY : pass_over(ring, hal);
    }
    const address_t at = address(ring, ring->half, ring->slot, ring->word);
    uint64_t word = payload_word;
    if (ring->word == 0) {
        word = header(ring, ring->sequence + 1);
    } else if (ring->word == ring->record_words - 2) {
        word = checksum_word(ring->crc);
    } else if (ring->word == ring->record_words - 1) {
        word = COMMIT;
    }
    if (!hal_nvm_program(hal, at.page, at.word, word) || hal_nvm_read(hal, at.page, at.word) != word) {
        return pass_over(ring, hal);
    }
    ring->crc = crc32_continue(ring->crc, &word, sizeof word);
    ring->word++;
    if (ring->word < ring->record_words) {
        return NVM_RING_BUSY;
    }
    ring->sequence++;
    ring->newest_half = ring->half;
    ring->attempts = 0;
    ring->damaged = ring->torn_commit = false;
    ring->slot++;
    find_place(ring, hal);
    return NVM_RING_WRITTEN;
}

COLD void nvm_ring_abandon(nvm_ring_t *ring, const hal_t *hal) {
    if (ring->word > 0) {
        ring->slot++;
        find_place(ring, hal);
    }
}
