/* Memory that survives a reset: the parameters, the last faults and the number of starts, each in a ring of two pages
 * (storage/nvm_ring.h).
 *
 * Writing is in the background, one operation of the memory in a call of nvm_store_step and none in RUN, because flash
 * may stall the interrupts (hal_nvm.h); never with the interrupts masked. A set of parameters is written from where it
 * is: when a parameter changes meanwhile, the record remains unfinished and another one begins, so that no set is
 * mixed.
 *
 * A set is loaded at start when it is whole, from this list of parameters and these machine tables, and each value is
 * within its limits. When the newest set is damaged the one before is loaded. When there are sets and none of them can
 * be used, the drive has its defaults and stays in state initialise, inhibited by parameter_memory, until a set is
 * stored: it does not run with trip limits that were never set. An erased memory is no such case.
 */
#ifndef STORAGE_NVM_STORE_H
#define STORAGE_NVM_STORE_H

#include <stdbool.h>
#include <stdint.h>

#include "storage/fault.h"
#include "storage/nvm_ring.h"
#include "storage/parameters.h"

/* Pages of the memory from the first one on; the tables follow them (storage/table_store.h). */
#define NVM_STORE_PAGES 6

/* Faults that can be read. A page has more of them, so that they survive the erasure of the other one. */
#define NVM_STORE_FAULTS 16

/* Faults that wait for being written: none is written in RUN. A further one is lost. */
#define NVM_STORE_WAITING_MAX 2

/* A fault in the log: a multiple of a word of the memory, 40 bytes with four phases, 48 with six. */
typedef struct {
    uint32_t start;                      /* number of the start, from 1 */
    uint32_t time_us;                    /* since that start, modulo 2^32 */
    uint32_t checks;                     /* failed in the tick that latched the fault, FAULT_BIT */
    uint16_t time_wraps;                 /* times 2^32 us; saturates */
    uint8_t fault;                       /* fault_t */
    uint8_t state;                       /* drive_state_t in that tick */
    int32_t speed_q22;                   /* rad/s, Q9.22 */
    int32_t torque_reference_q24;        /* N m, Q7.24 */
    uint16_t current_q9[HAL_PHASES_MAX]; /* A, Q7.9 */
    uint16_t dc_link_voltage_q6;         /* V, Q9.6 */
    uint16_t angle;                      /* rotor, 2^-16 rev */
    uint16_t self_test; /* failed checks, bits of DRIVE_SELF_TEST; this and the next soon after that tick */
    uint8_t phases;     /* of a fault of phases, bits */
    uint8_t sensors;    /* failed temperature sensors of phases e and f, as in DRIVE_PHASES_E_F */
#if HAL_PHASES_MAX > 4
    uint32_t reserved; /* 0 */
#endif
} nvm_store_fault_t;

typedef enum {
    NVM_STORE_IDLE, /* nothing stored since start */
    NVM_STORE_SAVING,
    NVM_STORE_SAVED,
    NVM_STORE_FAILED /* the memory did not accept it */
} nvm_store_saving_t;

typedef struct {
    nvm_ring_t parameters;
    nvm_ring_t faults;
    nvm_ring_t starts;
    uint32_t identity;         /* of parameter list and machine tables */
    nvm_store_saving_t saving; /* of the parameters */
    uint32_t saving_revision;  /* parameters.revision that the record has */
    bool loaded;               /* the parameters at start came from the memory */
    bool rejected;             /* at start no set could be used */
    bool inhibited;            /* parameter_memory: none could, and none was stored since */
    bool start_written;
    uint32_t start; /* number of this start, from 1 */
    uint32_t time_us;
    uint16_t time_wraps;
    bool fault_seen; /* of the present fault state; its time: */
    uint32_t fault_time_us;
    uint8_t waiting_count;
    nvm_store_fault_t waiting[NVM_STORE_WAITING_MAX]; /* the oldest first */
} nvm_store_t;

/* Reads the memory and loads the parameters, if there is a set. parameters must have their defaults. */
void nvm_store_init(nvm_store_t *store, const hal_t *hal, parameters_t *parameters);

/* Requests that the present parameters are stored: state NVM_STORE_SAVING until it is done. [background] */
void parameter_store_save(nvm_store_t *store);

/* The drive is in state fault with this record, or (record NULL) in another one: a new fault is queued for the log.
 * [background] */
void nvm_store_follow_fault(nvm_store_t *store, const fault_record_t *record);

/* One operation of the memory, when one is due and `writable`. To be called at least once in 71 minutes. [background]
 */
void nvm_store_step(nvm_store_t *store, hal_t *hal, const parameters_t *parameters, uint32_t time_us, bool writable);

/* Sequence number of the newest fault in the log, from 1; 0: there is none. */
static inline uint32_t nvm_store_newest_fault(const nvm_store_t *store) {
    return store->faults.sequence;
}

/* Reads a fault by its sequence number; false when it is not one of the last NVM_STORE_FAULTS. [background] */
bool nvm_store_read_fault(const nvm_store_t *store, const hal_t *hal, uint32_t sequence, nvm_store_fault_t *fault);

#endif
