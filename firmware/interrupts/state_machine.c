/* [SR-39] */
#include "interrupts/state_machine.h"

#include "fixed/compiler.h"

void state_machine_reset(state_machine_t *state_machine) {
    *state_machine = (state_machine_t){.state = DRIVE_STATE_INITIALISE};
}

fault_t state_machine_first_fault(uint64_t fault_mask) {
    const uint32_t low = (uint32_t)fault_mask;
    if (fault_mask == 0) {
        return FAULT_NONE;
    }
    return (fault_t)(low != 0 ? __builtin_ctz(low) : 32 + __builtin_ctz((uint32_t)(fault_mask >> 32)));
}

/* [SR-39] [SR-40] [SR-42] */
static bool latch_fault(state_machine_t *state_machine, uint64_t fault_mask) {
    fault_record_t *record = &state_machine->record; /* the caller sets its other members */
    record->fault = state_machine_first_fault(fault_mask);
    record->fault_mask = fault_mask;
    record->state = (uint8_t)state_machine->state;
    state_machine->state = DRIVE_STATE_FAULT;
    state_machine->rearmed = false;
    state_machine->clearing = false;
    state_machine->identifies = false;
    state_machine->fault_free_ticks = 0;
    return true;
}

/* [SR-48] [SR-51] */
COLD void state_machine_start_in_fault(state_machine_t *state_machine, uint64_t fault_mask) {
    (void)latch_fault(state_machine, fault_mask);
}

/* The record by members, because a call of memset takes 44 instructions. [SR-41] */
static void end_fault(state_machine_t *state_machine) {
    fault_record_t *record = &state_machine->record;
    state_machine->state = DRIVE_STATE_READY;
    record->fault = FAULT_NONE;
    record->time_us = 0;
    record->fault_mask = 0;
    record->speed_q22 = 0;
    record->torque_reference_q24 = 0;
    record->current_max_q9 = 0;
    record->dc_link_voltage_q6 = 0;
    record->state = 0;
}

/* One more; a drive may stand in a fault for days. */
static uint32_t saturated_count(uint32_t ticks) {
    return ticks < UINT32_MAX ? ticks + 1u : ticks;
}

/* [SR-39] [SR-41] [SR-42] [SR-43] */
bool state_machine_stands(state_machine_t *state_machine, uint64_t fault_mask, command_request_t request,
                          uint32_t initialise_ticks) {
    const uint64_t all_but_timeout = fault_mask & ~FAULT_BIT(FAULT_COMMAND_TIMEOUT);
    const bool request_changed = request != state_machine->last_request;
    state_machine->last_request = request;
    if (!command_needs_arming(request)) {
        state_machine->rearmed = true;
    }
    switch (state_machine->state) {
    case DRIVE_STATE_INITIALISE:
        state_machine->start_inhibit_mask = (uint32_t)all_but_timeout;
        state_machine->fault_free_ticks =
            state_machine->start_inhibit_mask == 0 ? state_machine->fault_free_ticks + 1 : 0;
        if (state_machine->fault_free_ticks >= initialise_ticks) {
            state_machine->state = DRIVE_STATE_READY;
        }
        break;
    case DRIVE_STATE_READY:
        if (all_but_timeout != 0) {
            return latch_fault(state_machine, all_but_timeout);
        }
        state_machine->identifies = request == COMMAND_IDENTIFY && state_machine->rearmed && fault_mask == 0;
        state_machine->state = state_machine->identifies ? DRIVE_STATE_RUN : DRIVE_STATE_READY;
        break;
    case DRIVE_STATE_RUN:
        if (fault_mask != 0) {
            return latch_fault(state_machine, fault_mask);
        }
        state_machine->identifies = state_machine->identifies && request == COMMAND_IDENTIFY;
        state_machine->state = state_machine->identifies ? DRIVE_STATE_RUN : DRIVE_STATE_READY;
        break;
    case DRIVE_STATE_FAULT:
        state_machine->fault_free_ticks = all_but_timeout == 0 ? saturated_count(state_machine->fault_free_ticks) : 0;
        state_machine->clearing =
            all_but_timeout == 0 && request == COMMAND_CLEAR_FAULT && (request_changed || state_machine->clearing);
        if (state_machine->clearing &&
            state_machine->fault_free_ticks > STATE_MACHINE_CAUSE_GONE_MS * initialise_ticks) {
            end_fault(state_machine);
        }
        break;
    }
    return false;
}
