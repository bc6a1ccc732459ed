/* [SR-61] */
#include "storage/table_store.h"

#include <assert.h>
#include <string.h>

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "layout_hash.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"

#define WORD_BYTES sizeof(uint64_t)
#define TABLE_WORDS ((TABLE_STORE_BYTES + WORD_BYTES - 1u) / WORD_BYTES)
#define RECORD_WORDS (NVM_RING_OVERHEAD + 1u + TABLE_WORDS) /* with the identity */
#define FIRST_PAGE ((unsigned)NVM_STORE_PAGES)
#define FIRST_TABLE_WORD 2u /* of a record, behind header and identity */

#define HALF_REV (UINT32_C(1) << 31)
#define ROW_WIDTH_MIN (UINT32_C(1) << 17)
#define SPEED_EXPONENT_MAX 3
#define CURVATURE_SHIFT_MAX 8
#define RESULT_SHIFT_MAX 12
#define MINIMUM_PULSE_MAX_NS 2000
#define PHASES_MIN 3
#define RANGE_SHIFT_MAX 15

static_assert(FIRST_PAGE + 2u * ((RECORD_WORDS + HAL_NVM_PAGE_WORDS - 1u) / HAL_NVM_PAGE_WORDS) <= HAL_NVM_PAGES,
              "two slots in the memory");

/* The program and the size of its tables. */
static uint64_t identity(void) {
    return (uint64_t)TABLE_STORE_BYTES << 32 | LAYOUT_HASH;
}

COLD void table_store_init(table_store_t *store, const hal_t *hal) {
    *store = (table_store_t){.state = TABLE_STORE_IDLE};
    nvm_ring_init(&store->ring, hal, FIRST_PAGE, RECORD_WORDS);
}

/* --- Tables of a start --- */

/* The look-up reads two rows from the one in which a bin begins, and takes the reciprocal for the row's. */
static bool rows_are_right(const machine_tables_t *tables) {
    const machine_row_t *row = tables->row;
    bool right = row[0].start == 0 && row[MACHINE_ROWS - 1].start == HALF_REV && row[MACHINE_ROWS].start == HALF_REV;
    for (unsigned i = 0; right && i < MACHINE_ROWS - 1; i++) {
        const uint32_t width = row[i + 1].start - row[i].start;
        right = row[i + 1].start > row[i].start && width >= ROW_WIDTH_MIN && width <= HALF_REV &&
                row[i].reciprocal == (int32_t)fixed_divide((int64_t)1 << 46, width);
    }
    return right && row[MACHINE_ROWS - 1].reciprocal == 0 && row[MACHINE_ROWS].reciprocal == 0;
}

static bool bins_are_right(const machine_tables_t *tables) {
    for (uint32_t bin = 0; bin < MACHINE_ANGLE_BINS; bin++) {
        const unsigned first = tables->angle_bin_row[bin];
        const uint32_t begin = bin << MACHINE_ANGLE_BIN_BITS, end = begin + (1u << MACHINE_ANGLE_BIN_BITS);
        if (first > MACHINE_ROWS - 2 || tables->row[first].start > begin || tables->row[first + 1].start <= begin ||
            (first + 3 < MACHINE_ROWS && tables->row[first + 3].start < end)) {
            return false;
        }
    }
    return true;
}

static bool format_is_right(const machine_format_t *format) {
    return format->curvature_shift <= CURVATURE_SHIFT_MAX && format->result_shift <= RESULT_SHIFT_MAX;
}

/* Values that divide, shift, count or have a sign. */
static bool numbers_are_right(const machine_tables_t *tables) {
    return tables->phases >= PHASES_MIN && tables->phases <= HAL_PHASES_MAX && tables->rotor_poles > 0 &&
           tables->speed_exponent <= SPEED_EXPONENT_MAX && tables->minimum_pulse_ns <= MINIMUM_PULSE_MAX_NS &&
           format_is_right(&tables->torque_format) && format_is_right(&tables->flux_format) &&
           tables->current_slew_rate_A_s > 0 && tables->sharing_torque > 0 && tables->speed_reference_max > 0 &&
           tables->speed_max_q22 > 0;
}

/* Two full scales, raw, with the fraction bits of a parameter in their unit: equal but for the rounding of the coarser
 * one. */
static bool same_range(uint32_t range, int bits, uint32_t built_in, int built_in_bits) {
    const int shift = bits - built_in_bits;
    if (shift < -RANGE_SHIFT_MAX || shift > RANGE_SHIFT_MAX) {
        return false;
    }
    const uint32_t coarse = shift > 0 ? built_in : range, fine = shift > 0 ? range : built_in;
    const unsigned places = (unsigned)fixed_abs(shift);
    const uint32_t scaled = coarse << places;
    return (scaled > fine ? scaled - fine : fine - scaled) <= 1u << places;
}

/* [SR-61] */
COLD bool table_store_usable(const machine_tables_t *tables, const machine_tables_t *built_in,
                             uint32_t control_rate_hz) {
    const int8_t *bits = tables->parameter_fraction_bits, *built_in_bits = built_in->parameter_fraction_bits;
    return numbers_are_right(tables) && rows_are_right(tables) && bins_are_right(tables) &&
           parameters_within_limits(tables->parameter_default) && control_rate_hz >= tables->control_rate_min_hz &&
           same_range(tables->current_range_q9, bits[PARAMETER_CURRENT_LIMIT_A], built_in->current_range_q9,
                      built_in_bits[PARAMETER_CURRENT_LIMIT_A]) &&
           same_range(tables->voltage_range_q6, bits[PARAMETER_OVER_VOLTAGE_V], built_in->voltage_range_q6,
                      built_in_bits[PARAMETER_OVER_VOLTAGE_V]);
}

/* [SR-61] */
COLD bool table_store_load(const hal_t *hal, uint32_t control_rate_hz, const machine_tables_t *built_in,
                           machine_tables_t *tables) {
    nvm_ring_t ring;
    nvm_ring_init(&ring, hal, FIRST_PAGE, RECORD_WORDS);
    const unsigned place = ring.sequence != 0 ? nvm_ring_place(&ring, hal, ring.sequence) : NVM_RING_NOWHERE;
    if (place != NVM_RING_NOWHERE && nvm_ring_payload(&ring, hal, place, 0) == identity()) {
        for (unsigned i = 0; i < TABLE_WORDS; i++) {
            const uint64_t word = nvm_ring_payload(&ring, hal, place, i + 1u);
            const size_t at = i * WORD_BYTES, left = TABLE_STORE_BYTES - at;
            (void)memcpy(&((char *)tables)[at], &word, left < WORD_BYTES ? left : WORD_BYTES);
        }
        if (table_store_usable(tables, built_in, control_rate_hz)) {
            return true;
        }
    }
    (void)memcpy(tables, built_in, sizeof *tables);
    return false;
}

/* --- Writing --- */

static bool word_waits(const table_store_t *store) {
    return store->waiting_bytes >= WORD_BYTES;
}

COLD void table_store_begin(table_store_t *store, const hal_t *hal) {
    nvm_ring_abandon(&store->ring, hal);
    store->taken = 0;
    store->waiting_bytes = 0;
    store->state = TABLE_STORE_ERASING;
}

COLD bool table_store_take(table_store_t *store, const uint8_t *bytes, unsigned count) {
    if (store->state != TABLE_STORE_TAKING || word_waits(store) || count == 0 || count > TABLE_STORE_TAKE_MAX ||
        count > TABLE_STORE_BYTES - store->taken) {
        return false;
    }
    (void)memcpy(&store->waiting[store->waiting_bytes], bytes, count);
    store->waiting_bytes = (uint8_t)(store->waiting_bytes + count);
    store->taken += count;
    return true;
}

COLD bool table_store_end(table_store_t *store) {
    if (store->state != TABLE_STORE_TAKING || word_waits(store) || store->taken != TABLE_STORE_BYTES) {
        return false;
    }
    if (store->waiting_bytes > 0) {
        (void)memset(&store->waiting[store->waiting_bytes], 0, WORD_BYTES - store->waiting_bytes);
        store->waiting_bytes = WORD_BYTES;
    }
    store->state = TABLE_STORE_ENDING;
    return true;
}

bool table_store_busy(const table_store_t *store) {
    return store->state == TABLE_STORE_ERASING || store->state == TABLE_STORE_ENDING ||
           (store->state == TABLE_STORE_TAKING && word_waits(store));
}

/* The next word of the record. When the ring passes over its place the record begins anew in another one, and the words
 * before are no longer there to be written again. */
static nvm_ring_result_t write_word(table_store_t *store, hal_t *hal, uint64_t word) {
    const unsigned next = store->ring.word + 1u;
    const nvm_ring_result_t result = nvm_ring_step(&store->ring, hal, word);
    return result == NVM_RING_WRITTEN || store->ring.word == next ? result : NVM_RING_FAILED;
}

/* Writes the first of the words that wait. */
static void write_waiting(table_store_t *store, hal_t *hal) {
    uint64_t word;
    (void)memcpy(&word, store->waiting, sizeof word);
    const nvm_ring_result_t result = write_word(store, hal, word);
    store->waiting_bytes = (uint8_t)(store->waiting_bytes - WORD_BYTES);
    for (unsigned i = 0; i < TABLE_STORE_TAKE_MAX; i++) {
        store->waiting[i] = store->waiting[WORD_BYTES + i];
    }
    if (result != NVM_RING_BUSY) {
        store->state = TABLE_STORE_FAILED;
    }
}

/* Erases, and writes header and identity. */
static void prepare(table_store_t *store, hal_t *hal) {
    if (nvm_ring_step(&store->ring, hal, identity()) == NVM_RING_FAILED) {
        store->state = TABLE_STORE_FAILED;
    } else if (store->ring.erase == 0 && store->ring.word == FIRST_TABLE_WORD) {
        store->state = TABLE_STORE_TAKING;
    }
}

/* [SR-61] */
COLD void table_store_step(table_store_t *store, hal_t *hal, bool writable) {
    if (!writable || !table_store_busy(store)) {
        return;
    }
    if (store->state == TABLE_STORE_ERASING) {
        prepare(store, hal);
    } else if (word_waits(store)) {
        write_waiting(store, hal);
    } else {
        const nvm_ring_result_t result = write_word(store, hal, 0);
        if (result == NVM_RING_WRITTEN) {
            store->state = TABLE_STORE_WRITTEN;
        } else if (result == NVM_RING_FAILED) {
            store->state = TABLE_STORE_FAILED;
        }
    }
}
