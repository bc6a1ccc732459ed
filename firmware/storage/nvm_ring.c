/* [SR-59] */
#include "storage/nvm_ring.h"

#include "fixed/compiler.h"
#include "fixed/crc32.h"

#define MAGIC UINT32_C(0x5344)
#define LAYOUT_VERSION UINT32_C(1)
#define COMMIT UINT64_C(0x0F1E2D3C4B5A6978)

/* 0 when the length has changed in memory to 0. */
static unsigned slots(const nvm_ring_t *ring) {
    return ring->record_words > 0 ? (unsigned)HAL_NVM_PAGE_WORDS / ring->record_words : 0u;
}

static uint64_t read_word(const nvm_ring_t *ring, const hal_t *hal, unsigned page, unsigned slot, unsigned word) {
    return hal_nvm_read(hal, ring->first_page + page, slot * ring->record_words + word);
}

static uint64_t header(const nvm_ring_t *ring, uint32_t sequence) {
    return (uint64_t)(MAGIC << 16 | LAYOUT_VERSION << 8 | ring->record_words) << 32 | sequence;
}

static uint64_t checksum_word(uint32_t crc) {
    return (uint64_t)~crc << 32 | crc;
}

/* A committed record with a sequence number. [SR-58] [SR-59] */
static bool valid(const nvm_ring_t *ring, const hal_t *hal, unsigned page, unsigned slot, uint32_t sequence) {
    const unsigned checked = ring->record_words - 2u;
    if (read_word(ring, hal, page, slot, 0) != header(ring, sequence) ||
        read_word(ring, hal, page, slot, ring->record_words - 1u) == HAL_NVM_ERASED) {
        return false;
    }
    uint32_t crc = 0;
    for (unsigned i = 0; i < checked; i++) {
        const uint64_t word = read_word(ring, hal, page, slot, i);
        crc = crc32_continue(crc, &word, sizeof word);
    }
    return read_word(ring, hal, page, slot, checked) == checksum_word(crc);
}

static bool erased(const nvm_ring_t *ring, const hal_t *hal, unsigned page, unsigned slot) {
    for (unsigned i = 0; i < ring->record_words; i++) {
        if (read_word(ring, hal, page, slot, i) != HAL_NVM_ERASED) {
            return false;
        }
    }
    return true;
}

/* False for a place outside of both pages, which has changed in memory. */
static bool is_inside(const nvm_ring_t *ring) {
    return ring->page < 2 && ring->newest_page < 2 && ring->slot < slots(ring) && ring->word < ring->record_words;
}

/* The first erased place from the present one on, else the start of the page that does not have the newest record: of
 * the present page again, when every place of it was passed over before a record was committed. Without a record page 0
 * is kept, because what is damaged there tells the caller that there was one. [SR-58] */
static void find_place(nvm_ring_t *ring, const hal_t *hal) {
    ring->word = 0;
    ring->crc = 0;
    while (ring->slot < slots(ring) && !erased(ring, hal, ring->page, ring->slot)) {
        ring->slot++;
    }
    if (ring->slot >= slots(ring)) {
        ring->page = ring->newest_page ^ 1u;
        ring->slot = 0;
        ring->erase = true;
    }
}

COLD void nvm_ring_init(nvm_ring_t *ring, const hal_t *hal, unsigned first_page, unsigned record_words) {
    *ring = (nvm_ring_t){.first_page = (uint8_t)first_page, .record_words = (uint8_t)record_words};
    bool committed = false;
    for (unsigned page = 0; page < 2; page++) {
        /* Backwards: the newest of a page comes first, and the checksums of the others need not be computed. */
        for (unsigned slot = slots(ring); slot-- > 0;) {
            const uint32_t sequence = (uint32_t)read_word(ring, hal, page, slot, 0);
            const uint64_t commit = read_word(ring, hal, page, slot, record_words - 1);
            committed = committed || commit != HAL_NVM_ERASED;
            if (sequence > ring->sequence && valid(ring, hal, page, slot, sequence)) {
                ring->sequence = sequence;
                ring->torn_commit = commit != COMMIT;
                ring->page = ring->newest_page = (uint8_t)page;
                ring->slot = (uint8_t)(slot + 1);
            }
        }
    }
    ring->damaged = ring->sequence == 0 && committed;
    find_place(ring, hal);
}

/* [SR-58] [SR-60] */
COLD bool nvm_ring_read(const nvm_ring_t *ring, const hal_t *hal, uint32_t sequence, uint64_t *payload) {
    for (unsigned page = 0; page < 2; page++) {
        for (unsigned slot = slots(ring); slot-- > 0;) {
            if ((uint32_t)read_word(ring, hal, page, slot, 0) == sequence && valid(ring, hal, page, slot, sequence)) {
                for (unsigned i = 0; i + NVM_RING_OVERHEAD < ring->record_words; i++) {
                    payload[i] = read_word(ring, hal, page, slot, i + 1);
                }
                return true;
            }
        }
    }
    return false;
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
    if (ring->erase) {
        ring->erase = false;
        return hal_nvm_erase(hal, (unsigned)ring->first_page + ring->page) ? NVM_RING_BUSY : pass_over(ring, hal);
    }
    const unsigned page = (unsigned)ring->first_page + ring->page;
    const unsigned place = (unsigned)ring->slot * ring->record_words + ring->word;
    uint64_t word = payload_word;
    if (ring->word == 0) {
        word = header(ring, ring->sequence + 1);
    } else if (ring->word == ring->record_words - 2) {
        word = checksum_word(ring->crc);
    } else if (ring->word == ring->record_words - 1) {
        word = COMMIT;
    }
    if (!hal_nvm_program(hal, page, place, word) || hal_nvm_read(hal, page, place) != word) {
        return pass_over(ring, hal);
    }
    ring->crc = crc32_continue(ring->crc, &word, sizeof word);
    ring->word++;
    if (ring->word < ring->record_words) {
        return NVM_RING_BUSY;
    }
    ring->sequence++;
    ring->newest_page = ring->page;
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
