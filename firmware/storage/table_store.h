/* Machine tables in non-volatile memory: the drive takes another machine at run time, without another program.
 *
 * Two slots, the halves of a ring with one record each (storage/nvm_ring.h): tables are written into the slot that does
 * not have the newest, and are the newest when all of them are there. A cut, a damaged word or a transfer that is given
 * up leave the tables of before. Written in the background, one operation of the memory in a call of table_store_step
 * and none in RUN, as the parameters are (storage/nvm_store.h).
 *
 * The tables in effect are the ones of the start. A port that has them as a variable (MACHINE_TABLES_VARIABLE) calls
 * table_store_load before drive_init: the newest tables are taken when they are of this program and usable, else the
 * ones that it was built with. Usable means: no table leads an access out of its array, a divisor is not 0, every
 * default of a parameter is within its limits, the control rate is possible, and the sensors of current and voltage
 * have the ranges of the tables that the program was built with, because these belong to the board. What the values do
 * to the motor is up to who makes them: tools/src/salient/machine.
 *
 * A record belongs to the program that wrote it (LAYOUT_HASH): another version falls back to its own tables.
 */
#ifndef STORAGE_TABLE_STORE_H
#define STORAGE_TABLE_STORE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "storage/nvm_ring.h"

#define TABLE_STORE_BYTES ((uint32_t)sizeof(machine_tables_t))

/* Bytes that one call takes at most. */
#define TABLE_STORE_TAKE_MAX 6u

typedef enum {
    TABLE_STORE_IDLE,    /* nothing written since the start, or given up */
    TABLE_STORE_ERASING, /* the other slot */
    TABLE_STORE_TAKING,
    TABLE_STORE_ENDING, /* checksum and commit */
    TABLE_STORE_WRITTEN,
    TABLE_STORE_FAILED /* the memory did not accept it */
} table_store_state_t;

typedef struct {
    nvm_ring_t ring;
    uint32_t taken; /* bytes of the tables */
    uint8_t state;  /* table_store_state_t */
    uint8_t waiting_bytes;
    uint8_t waiting[sizeof(uint64_t) + TABLE_STORE_TAKE_MAX]; /* that do not fill a word yet, or do */
} table_store_t;

/* True after table_store_init: the drive takes new tables. */
static inline bool table_store_offered(const table_store_t *store) {
    return store->ring.record_words > 0;
}

/* Finds the slots; reads only. */
void table_store_init(table_store_t *store, const hal_t *hal);

/* Fills `tables` with the newest ones in the memory, or with `built_in`; true: the former. Before drive_init.
 * control_rate_hz: of the start. [background, before anything else] */
bool table_store_load(const hal_t *hal, uint32_t control_rate_hz, const machine_tables_t *built_in,
                      machine_tables_t *tables);

/* True when a drive that was built with `built_in` can use the tables. */
bool table_store_usable(const machine_tables_t *tables, const machine_tables_t *built_in, uint32_t control_rate_hz);

/* Begins new tables; the next step erases. [background] */
void table_store_begin(table_store_t *store, const hal_t *hal);

/* Takes the next bytes, 1..TABLE_STORE_TAKE_MAX; false, with nothing taken, when they are too many or the store is not
 * in TABLE_STORE_TAKING, or busy. [background] */
bool table_store_take(table_store_t *store, const uint8_t *bytes, unsigned count);

/* All bytes have been taken: the tables become the newest. False, with nothing changed, when some are missing or the
 * store is busy. [background] */
bool table_store_end(table_store_t *store);

/* True while table_store_step has something to do: nothing else can be asked for. */
bool table_store_busy(const table_store_t *store);

/* One operation of the memory, when one is due and `writable`. [background] */
void table_store_step(table_store_t *store, hal_t *hal, bool writable);

#endif
