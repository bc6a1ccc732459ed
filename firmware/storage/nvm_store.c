#include "storage/nvm_store.h"

#include <assert.h>
#include <string.h>

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/crc32.h"

enum { PARAMETER_PAGE = 0, FAULT_PAGE = 2, START_PAGE = 4 };

#define WORD_BYTES sizeof(uint64_t)
#define VALUES_PER_WORD 2

/* Payloads in words: identity and count, then the values; a fault; nothing but the sequence number. */
#define PARAMETER_WORDS (1 + (PARAMETER_COUNT + VALUES_PER_WORD - 1) / VALUES_PER_WORD)
#define FAULT_WORDS (sizeof(nvm_store_fault_t) / WORD_BYTES)
#define START_WORDS 0

static_assert(sizeof(nvm_store_fault_t) == FAULT_WORDS * WORD_BYTES, "whole words");
static_assert(HAL_NVM_PAGE_WORDS / (FAULT_WORDS + NVM_RING_OVERHEAD) >= NVM_STORE_FAULTS, "in one page");
static_assert(HAL_NVM_PAGE_WORDS / (PARAMETER_WORDS + NVM_RING_OVERHEAD) >= 2, "in one page");
static_assert(FAULT_COUNT <= 32, "checks of an entry");
static_assert(START_PAGE + 2 == NVM_STORE_PAGES, "two pages for each ring");

/* [SR-57] [SR-58] */
static uint64_t parameter_word(const nvm_store_t *store, const parameters_t *parameters, unsigned index) {
    if (index == 0) {
        return (uint64_t)PARAMETER_COUNT << 32 | store->identity;
    }
    uint32_t pair[VALUES_PER_WORD] = {0, 0};
    for (unsigned i = 0; i < VALUES_PER_WORD; i++) {
        const unsigned parameter = (index - 1) * VALUES_PER_WORD + i;
        if (parameter < PARAMETER_COUNT) {
            pair[i] = (uint32_t)parameters->values[parameter];
        }
    }
    return (uint64_t)pair[1] << 32 | pair[0];
}

/* Loads the newest set; false when it is of another list or machine, or a value is out of range. [SR-58] */
static bool load(const nvm_store_t *store, const hal_t *hal, parameters_t *parameters) {
    uint64_t payload[PARAMETER_WORDS];
    if (!nvm_ring_read(&store->parameters, hal, store->parameters.sequence, payload) ||
        payload[0] != parameter_word(store, parameters, 0)) {
        return false;
    }
    int32_t values[PARAMETER_COUNT];
    (void)memcpy(values, &payload[1], sizeof values);
    return parameters_restore(parameters, values);
}

/* [SR-58] */
COLD void nvm_store_init(nvm_store_t *store, const hal_t *hal, parameters_t *parameters) {
    *store = (nvm_store_t){0};
    store->identity = crc32_continue(parameters_identity(), &machine_tables, sizeof machine_tables);
    nvm_ring_init(&store->parameters, hal, PARAMETER_PAGE, PARAMETER_WORDS + NVM_RING_OVERHEAD);
    nvm_ring_init(&store->faults, hal, FAULT_PAGE, FAULT_WORDS + NVM_RING_OVERHEAD);
    nvm_ring_init(&store->starts, hal, START_PAGE, START_WORDS + NVM_RING_OVERHEAD);
    store->start = store->starts.sequence + 1;
    store->loaded = store->parameters.sequence != 0 && load(store, hal, parameters);
    store->rejected = !store->loaded && (store->parameters.sequence != 0 || store->parameters.damaged);
    store->inhibited = store->rejected;
    if (store->loaded && store->parameters.torn_commit) {
        parameter_store_save(store); /* a bit of the commit word may read differently next time */
    }
}

COLD void parameter_store_save(nvm_store_t *store) {
    store->saving = NVM_STORE_SAVING;
}

/* [SR-60] */
COLD void nvm_store_follow_fault(nvm_store_t *store, const fault_record_t *record) {
    if (record == NULL) {
        store->fault_seen = false;
        return;
    }
    if (store->fault_seen && record->time_us == store->fault_time_us) {
        return;
    }
    store->fault_seen = true;
    store->fault_time_us = record->time_us;
    if (store->waiting_count >= NVM_STORE_WAITING_MAX) {
        return;
    }
    /* The clock may have wrapped since the last step. */
    const bool wrapped = record->time_us < store->time_us && store->time_us - record->time_us > UINT32_MAX / 2;
    nvm_store_fault_t *entry = &store->waiting[store->waiting_count++];
    *entry = (nvm_store_fault_t){
        .start = store->start,
        .time_us = record->time_us,
        .checks = (uint32_t)record->fault_mask,
        .time_wraps = (uint16_t)(store->time_wraps + wrapped),
        .fault = (uint8_t)record->fault,
        .state = record->state,
        .speed_q22 = record->speed_q22,
        .torque_reference_q24 = record->torque_reference_q24,
        .dc_link_voltage_q6 = record->dc_link_voltage_q6,
        .angle = record->angle,
        .self_test = record->self_test,
        .phases = record->phases,
        .sensors = record->sensors,
    };
    (void)memcpy(entry->current_q9, record->current_q9, sizeof entry->current_q9);
}

/* [SR-60] */
static void write_fault(nvm_store_t *store, hal_t *hal) {
    uint64_t payload[FAULT_WORDS];
    (void)memcpy(payload, &store->waiting[0], sizeof payload);
    const unsigned index = nvm_ring_payload_index(&store->faults);
    if (nvm_ring_step(&store->faults, hal, index < FAULT_WORDS ? payload[index] : 0) != NVM_RING_BUSY) {
        store->waiting_count--;
        store->waiting[0] = store->waiting[1];
    }
}

/* [SR-59] */
static void write_parameters(nvm_store_t *store, hal_t *hal, const parameters_t *parameters) {
    nvm_ring_t *ring = &store->parameters;
    if (!parameters_intact(parameters)) {
        nvm_ring_abandon(ring, hal);
        store->saving = NVM_STORE_FAILED;
        return;
    }
    if (store->saving_revision != parameters->revision) {
        nvm_ring_abandon(ring, hal);
        store->saving_revision = parameters->revision;
    }
    const unsigned index = nvm_ring_payload_index(ring);
    const uint64_t word = index < PARAMETER_WORDS ? parameter_word(store, parameters, index) : 0;
    const nvm_ring_result_t result = nvm_ring_step(ring, hal, word);
    if (result == NVM_RING_WRITTEN) {
        store->saving = NVM_STORE_SAVED;
        store->inhibited = false;
    } else if (result == NVM_RING_FAILED) {
        store->saving = NVM_STORE_FAILED;
    }
}

/* [SR-59] [SR-60] */
COLD void nvm_store_step(nvm_store_t *store, hal_t *hal, const parameters_t *parameters, uint32_t time_us,
                         bool writable) {
    if (time_us < store->time_us && store->time_wraps < UINT16_MAX) {
        store->time_wraps++;
    }
    store->time_us = time_us;
    if (!writable) {
        return;
    }
    if (store->waiting_count > 0) {
        write_fault(store, hal);
    } else if (store->saving == NVM_STORE_SAVING) {
        write_parameters(store, hal, parameters);
    } else if (!store->start_written) {
        store->start_written = nvm_ring_step(&store->starts, hal, 0) != NVM_RING_BUSY;
    }
}

/* [SR-60] */
COLD bool nvm_store_read_fault(const nvm_store_t *store, const hal_t *hal, uint32_t sequence,
                               nvm_store_fault_t *fault) {
    const uint32_t newest = nvm_store_newest_fault(store);
    uint64_t payload[FAULT_WORDS];
    if (sequence == 0 || sequence > newest || newest - sequence >= NVM_STORE_FAULTS ||
        !nvm_ring_read(&store->faults, hal, sequence, payload)) {
        return false;
    }
    (void)memcpy(fault, payload, sizeof *fault);
    return true;
}
