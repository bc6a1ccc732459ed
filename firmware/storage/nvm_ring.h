/* Records of one length in non-volatile memory, appended to two halves in turn: each a page, or as many pages as a
 * longer record takes.
 *
 *   word 0              header: magic, layout version, length in words modulo 256; sequence number
 *   words 1 .. n - 3    payload
 *   word n - 2          CRC-32 of the words before, and its complement
 *   word n - 1          commit word, written last
 *
 * The newest record is the valid one with the highest sequence number. A record is written into erased words behind it;
 * when its half is full the other half, which has older records only, is erased and written. When no place of that half
 * takes the record it is erased again, and never the half of the newest record. So the newest record remains untouched
 * until the next one is committed, whatever power and memory do: a cut leaves the old record the newest, or the new
 * one. A record whose commit word is erased is unfinished and ignored, as if it were not there; one that is committed
 * but does not have the checksum is damaged. A commit word that was torn is as good as a whole one, because the
 * checksum before it was complete.
 *
 * Wear: one erasure for each page of records instead of one for each record. At 10,000 erasures of a page, as on an
 * STM32G4, 20,000 pages of records.
 *
 * Functions that write carry out one operation of the memory at most. All are called in the background.
 */
#ifndef STORAGE_NVM_RING_H
#define STORAGE_NVM_RING_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_nvm.h"

/* Words of a record beside its payload. */
#define NVM_RING_OVERHEAD 3

/* Faulty places, and erasures that fail, which the writing of one record passes over before it fails. */
#define NVM_RING_ATTEMPTS 4

#define NVM_RING_NOWHERE UINT32_MAX

typedef enum { NVM_RING_BUSY, NVM_RING_WRITTEN, NVM_RING_FAILED } nvm_ring_result_t;

typedef struct {
    uint16_t record_words; /* NVM_RING_OVERHEAD + payload */
    uint8_t first_page;    /* the ring has 2 nvm_ring_pages() from this one on */
    uint8_t slot;          /* place of the next record: its number in a half */
    uint32_t sequence;     /* of the newest record, from 1; 0: there is none. No wear-out reaches 2^32. */
    bool damaged;          /* at start: there is no valid record, but a damaged one */
    bool torn_commit;      /* at start: the newest record is valid, its commit word is not what was written */
    uint8_t newest_half;   /* of the newest record, 0 or 1: not erased before the next one; 0 when there is none */
    uint8_t half;          /* of the next record, 0 or 1 */
    uint16_t word;         /* next one to be written there */
    uint8_t erase;         /* pages of that half that have to be erased first */
    uint8_t attempts;      /* failed ones at the present record */
    uint32_t crc;          /* of the words written */
} nvm_ring_t;

/* Pages of a half of a ring whose records have a number of words. */
static inline unsigned nvm_ring_pages(unsigned record_words) {
    return (record_words + HAL_NVM_PAGE_WORDS - 1u) / HAL_NVM_PAGE_WORDS;
}

/* Finds the newest record and the place of the next one; reads only. The pages from first_page on exist. */
void nvm_ring_init(nvm_ring_t *ring, const hal_t *hal, unsigned first_page, unsigned record_words);

/* Number of the place of the valid record with a sequence number; NVM_RING_NOWHERE without one. */
unsigned nvm_ring_place(const nvm_ring_t *ring, const hal_t *hal, uint32_t sequence);

/* A payload word of the record at such a place; index within the payload. */
uint64_t nvm_ring_payload(const nvm_ring_t *ring, const hal_t *hal, unsigned place, unsigned index);

/* Copies the payload of the record with a sequence number; false, with an undefined payload, when there is no valid
 * one. */
bool nvm_ring_read(const nvm_ring_t *ring, const hal_t *hal, uint32_t sequence, uint64_t *payload);

/* Index of the payload word that the next nvm_ring_step takes; beyond the payload: it takes none. */
static inline unsigned nvm_ring_payload_index(const nvm_ring_t *ring) {
    return ring->word - 1u;
}

/* Next operation of writing a record: repeated until the result is not NVM_RING_BUSY. A place that has changed in
 * memory to one outside of both pages is not written to: the record fails. */
nvm_ring_result_t nvm_ring_step(nvm_ring_t *ring, hal_t *hal, uint64_t payload_word);

/* Leaves the record that is being written unfinished: the next step begins another one. */
void nvm_ring_abandon(nvm_ring_t *ring, const hal_t *hal);

#endif
