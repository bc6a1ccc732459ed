/* Power cuts at every operation of the memory, for a test on the host and a program on a target: the store of the
 * firmware on the emulated flash.
 *
 * A write is a set of parameters or a fault in the log, with the number of the start that follows it. After each cut
 * the drive starts again, and its parameters must all be as before the write or all as the write has them; the log
 * must have every fault before the write, as far back as it reaches, and may have the new one; the number of the start
 * must not have decreased. Then the write is repeated, or the next one made, and must succeed.
 */
#ifndef POWER_CUTS_H
#define POWER_CUTS_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "rig/nvm.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"

/* With errors of the memory while there is power, which are no operations of nvm_t. */
struct hal {
    nvm_t nvm;
    uint32_t erase_errors;     /* next erasures that fail and leave the page as it was */
    uint32_t worn_page;        /* page whose words cannot be programmed; 0: none */
    bool worn_zero;            /* and read as 0 even after an erasure */
    const uint64_t *deaf_word; /* that remains as it is although the memory reports success; NULL: none */
};

uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word) {
    return nvm_read(&hal->nvm, page, word);
}

bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value) {
    const bool worn = hal->worn_page != 0 && page == hal->worn_page;
    if (hal->deaf_word == &hal->nvm.word[page][word]) {
        return true;
    }
    return nvm_program(&hal->nvm, page, word, worn ? HAL_NVM_ERASED : value) && !worn;
}

bool hal_nvm_erase(hal_t *hal, unsigned page) {
    if (hal->erase_errors > 0 && !hal->nvm.power_lost) {
        hal->erase_errors--;
        return false;
    }
    const bool erased = nvm_erase(&hal->nvm, page);
    if (page == hal->worn_page && hal->worn_zero) {
        memset(hal->nvm.word[page], 0, sizeof hal->nvm.word[page]);
    }
    return erased;
}

typedef enum { WRITE_SET, WRITE_FAULT } write_t;

/* A memory and what it is known to contain. */
typedef struct {
    hal_t hal;
    uint32_t sets;
    uint32_t faults;
    uint32_t start;
} memory_t;

typedef struct {
    uint32_t cuts;     /* starts after a single cut */
    uint32_t pairs;    /* starts after a second cut */
    uint32_t losses;   /* a set, a fault, a number of a start that was there before */
    uint32_t mixed;    /* parameters of several sets, a fault with another content */
    uint32_t failures; /* a write without a cut that did not succeed */
} power_cuts_t;

typedef struct {
    parameters_t parameters;
    nvm_store_t store;
} started_t;

/* Large: static, or in a memory of the board. */
typedef struct {
    memory_t memory, first, second;
    started_t drive;
} power_cuts_work_t;

/* Values of a set: the defaults of set 0, and three kinds in turn, so that a set differs from the two before it. */
static int32_t set_value(const parameters_t *parameters, uint32_t set, unsigned index) {
    const parameter_row_t *row = parameters_row(index);
    return set == 0       ? parameters_default(parameters, index)
           : set % 3 == 0 ? row->minimum + (row->maximum / 2 - row->minimum / 2)
           : set % 3 == 1 ? row->minimum
                          : row->maximum;
}

static fault_record_t fault_of(uint32_t number) {
    fault_record_t record;
    memset(&record, 0, sizeof record);
    record.fault = FAULT_ENCODER;
    record.time_us = number * 1000003u;
    record.fault_mask = FAULT_BIT(FAULT_ENCODER) | number % 2;
    record.speed_q22 = (int32_t)(number * 77777u);
    record.torque_reference_q24 = -(int32_t)number;
    record.current_q9[0] = (uint16_t)number;
    record.current_q9[HAL_PHASES_MAX - 1] = (uint16_t)(number + 2);
    record.angle = (uint16_t)(number * 3);
    record.self_test = (uint16_t)(number * 5);
    record.phases = (uint8_t)(number & 15);
    record.dc_link_voltage_q6 = (uint16_t)(number + 1);
    record.state = DRIVE_STATE_RUN;
    return record;
}

static void start_drive(started_t *drive, memory_t *memory) {
    nvm_power_on(&memory->hal.nvm);
    parameters_init(&drive->parameters);
    nvm_store_init(&drive->store, &memory->hal, &drive->parameters);
}

/* Starts the drive and writes until all is done, or the power is lost. */
static void write_next(started_t *drive, memory_t *memory, write_t write, uint32_t cut_after, nvm_cut_t kind) {
    start_drive(drive, memory);
    memory->hal.nvm.cut_after = cut_after;
    memory->hal.nvm.cut_kind = kind;
    nvm_store_t *store = &drive->store;
    if (write == WRITE_SET) {
        int32_t values[PARAMETER_COUNT];
        for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
            values[i] = set_value(&drive->parameters, memory->sets + 1, i);
        }
        parameters_restore(&drive->parameters, values);
        parameter_store_save(store);
    } else {
        const fault_record_t record = fault_of(memory->faults + 1);
        nvm_store_follow_fault(store, &record);
    }
    while (!memory->hal.nvm.power_lost &&
           (store->waiting_count > 0 || store->saving == NVM_STORE_SAVING || !store->start_written)) {
        nvm_store_step(store, &memory->hal, &drive->parameters, 1, true);
    }
}

/* Whether the parameters are a set's. */
static bool has_set(const started_t *drive, uint32_t set) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        if (drive->parameters.values[i] != set_value(&drive->parameters, set, i)) {
            return false;
        }
    }
    return drive->store.loaded == (set > 0);
}

static bool has_fault(const started_t *drive, const hal_t *hal, uint32_t number) {
    nvm_store_fault_t fault;
    const fault_record_t record = fault_of(number);
    return nvm_store_read_fault(&drive->store, hal, number, &fault) && fault.time_us == record.time_us &&
           fault.checks == record.fault_mask && fault.speed_q22 == record.speed_q22 && fault.state == record.state &&
           fault.torque_reference_q24 == record.torque_reference_q24 && fault.fault == record.fault &&
           memcmp(fault.current_q9, record.current_q9, sizeof fault.current_q9) == 0 && fault.angle == record.angle &&
           fault.self_test == record.self_test && fault.phases == record.phases &&
           fault.dc_link_voltage_q6 == record.dc_link_voltage_q6;
}

/* Starts the drive after a cut and compares it with what was known; then that is known what it has. */
static void check_start(power_cuts_t *result, started_t *drive, memory_t *memory) {
    start_drive(drive, memory);
    const nvm_store_t *store = &drive->store;
    if (has_set(drive, memory->sets + 1)) {
        memory->sets++;
    } else if (!has_set(drive, memory->sets)) {
        const bool defaults = has_set(drive, 0);
        result->losses += defaults;
        result->mixed += !defaults;
    }
    result->losses += store->inhibited || store->start < memory->start;
    memory->start = store->start;
    const uint32_t newest = nvm_store_newest_fault(store);
    result->losses += newest != memory->faults && newest != memory->faults + 1;
    memory->faults = newest;
    for (uint32_t back = 0; back < NVM_STORE_FAULTS && back < newest; back++) {
        result->mixed += !has_fault(drive, &memory->hal, newest - back);
    }
}

/* The write without a cut. */
static void complete(power_cuts_t *result, started_t *drive, memory_t *memory, write_t write) {
    const uint32_t sets = memory->sets + (write == WRITE_SET), faults = memory->faults + (write == WRITE_FAULT);
    write_next(drive, memory, write, 0, NVM_CUT_OLD);
    check_start(result, drive, memory);
    result->failures += memory->sets != sets || memory->faults != faults;
}

/* Every cut of a write from the known state, work->memory, and with `pairs` every second cut after it. */
static void cut_write(power_cuts_t *result, power_cuts_work_t *work, write_t write, bool pairs) {
    started_t *drive = &work->drive;
    memory_t *first = &work->first, *second = &work->second;
    bool lost = true;
    for (uint32_t operation = 1; lost; operation++) {
        for (unsigned kind = 0; kind < NVM_CUT_KINDS; kind++) {
            *first = work->memory;
            first->hal.nvm.random += operation;
            write_next(drive, first, write, operation, (nvm_cut_t)kind);
            lost = first->hal.nvm.power_lost;
            if (!lost) {
                break;
            }
            result->cuts++;
            check_start(result, drive, first);
            bool second_lost = pairs;
            for (uint32_t next = 1; second_lost; next++) {
                for (unsigned next_kind = 0; next_kind < NVM_CUT_KINDS; next_kind++) {
                    *second = *first;
                    write_next(drive, second, write, next, (nvm_cut_t)next_kind);
                    second_lost = second->hal.nvm.power_lost;
                    if (!second_lost) {
                        break;
                    }
                    result->pairs++;
                    check_start(result, drive, second);
                    if (next_kind == NVM_CUT_TORN) {
                        complete(result, drive, second, write);
                    }
                }
            }
            complete(result, drive, first, write);
        }
    }
}

/* `writes` writes in succession from an erased memory, each cut at every operation; of those that `paired` accepts
 * also every pair of cuts. */
static void cut_writes(power_cuts_t *result, power_cuts_work_t *work, write_t write, uint32_t writes,
                       bool (*paired)(uint32_t number)) {
    memset(&work->memory, 0, sizeof work->memory);
    nvm_init(&work->memory.hal.nvm);
    work->memory.hal.nvm.random = 1;
    for (uint32_t number = 1; number <= writes; number++) {
        cut_write(result, work, write, paired(number));
        complete(result, &work->drive, &work->memory, write);
    }
}

#endif
