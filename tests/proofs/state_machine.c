/* States of the drive by induction: what holds before a tick holds after it, of any machine, input and duration. */
#include "interrupts/state_machine.c"
#include "proof.h"

static bool is_state(drive_state_t state) {
    return state == DRIVE_STATE_INITIALISE || state == DRIVE_STATE_READY || state == DRIVE_STATE_RUN ||
           state == DRIVE_STATE_FAULT;
}

/* Kept by every function; true of a machine that has been reset. */
static bool is_whole(const state_machine_t *machine) {
    return is_state(machine->state) && (machine->state == DRIVE_STATE_FAULT) == (machine->record.fault != FAULT_NONE) &&
           IMPLIES(machine->state == DRIVE_STATE_FAULT,
                   machine->record.fault_mask != 0 &&
                       machine->record.fault == state_machine_first_fault(machine->record.fault_mask)) &&
           IMPLIES(machine->state != DRIVE_STATE_FAULT, machine->record.fault_mask == 0) &&
           IMPLIES(machine->state == DRIVE_STATE_RUN, machine->rearmed) &&
           IMPLIES(machine->identifies, machine->state == DRIVE_STATE_RUN) &&
           IMPLIES(machine->state != DRIVE_STATE_INITIALISE, machine->start_inhibit_mask == 0);
}

/* A request that the accepted command may have: commands.c takes no other one. */
static bool is_request(command_request_t request) {
    return request >= COMMAND_OFF && request <= COMMAND_IDENTIFY;
}

/* No fault has number 0, FAULT_NONE. protection.c and fault.h: every bit is FAULT_BIT of a fault. */
static bool is_mask(uint64_t mask) {
    return (mask & FAULT_BIT(FAULT_NONE)) == 0 && mask < UINT64_C(1) << FAULT_COUNT;
}

void prove_first_fault(uint64_t mask) {
    const fault_t first = state_machine_first_fault(mask);
    CLAIM(IMPLIES(mask == 0, first == FAULT_NONE));
    CLAIM(IMPLIES(mask != 0, (mask & FAULT_BIT(first)) != 0 && (mask & (FAULT_BIT(first) - 1)) == 0));
}

void prove_state_machine_begins(state_machine_t machine, uint64_t mask) {
    state_machine_reset(&machine);
    CLAIM(is_whole(&machine) && machine.state == DRIVE_STATE_INITIALISE && !machine.rearmed);
    ASSUME(mask != 0 && is_mask(mask)); /* background_checks.c starts in a fault with one */
    state_machine_start_in_fault(&machine, mask);
    CLAIM(is_whole(&machine) && machine.state == DRIVE_STATE_FAULT && machine.record.fault_mask == mask);
}

/* A tick as control_step.c makes it. */
void prove_state_machine_tick(state_machine_t machine, state_machine_input_t input, uint32_t initialise_ticks) {
    ASSUME(is_whole(&machine) && is_request(input.request) && is_mask(input.fault_mask));
    ASSUME(initialise_ticks >= 20 && initialise_ticks <= 1000); /* configure.c: 1 ms of control at 20 kHz to 1 MHz */
    const state_machine_t before = machine;
    const bool goes_on = state_machine_runs(&machine, &input);
    const bool latched = !goes_on && state_machine_stands(&machine, input.fault_mask, input.request, initialise_ticks);
    const bool only_timeout = (input.fault_mask & ~FAULT_BIT(FAULT_COMMAND_TIMEOUT)) == 0;
    CLAIM(is_whole(&machine));
    CLAIM(IMPLIES(goes_on, machine.state == DRIVE_STATE_RUN && input.fault_mask == 0));
    /* A failed check ends a run in the same tick. */
    CLAIM(IMPLIES(input.fault_mask != 0, machine.state != DRIVE_STATE_RUN));
    CLAIM(IMPLIES(input.fault_mask != 0 && before.state == DRIVE_STATE_RUN, latched));
    CLAIM(latched == (machine.state == DRIVE_STATE_FAULT && before.state != DRIVE_STATE_FAULT));
    /* No way into a run but from READY, without a fault, by a request that was withdrawn since the last fault. */
    if (machine.state == DRIVE_STATE_RUN && before.state != DRIVE_STATE_RUN) {
        CLAIM(before.state == DRIVE_STATE_READY && input.fault_mask == 0);
        CLAIM(input.request == COMMAND_RUN || input.request == COMMAND_IDENTIFY);
        CLAIM(before.rearmed);
    }
    /* No way out of a fault but by a request to clear it, once every check has passed for 10 ms. */
    if (before.state == DRIVE_STATE_FAULT && machine.state != DRIVE_STATE_FAULT) {
        CLAIM(machine.state == DRIVE_STATE_READY && input.request == COMMAND_CLEAR_FAULT && only_timeout);
        CLAIM(before.fault_free_ticks >= STATE_MACHINE_CAUSE_GONE_MS * initialise_ticks);
        CLAIM(before.clearing || before.last_request != COMMAND_CLEAR_FAULT);
    }
    if (latched) {
        CLAIM(!machine.rearmed && !machine.clearing && machine.record.state == (uint8_t)before.state);
        CLAIM(IMPLIES(before.state != DRIVE_STATE_RUN, !only_timeout));
    }
    CLAIM(IMPLIES(before.state == DRIVE_STATE_INITIALISE,
                  machine.state == DRIVE_STATE_INITIALISE || machine.state == DRIVE_STATE_READY));
    CLAIM(IMPLIES(before.state == DRIVE_STATE_INITIALISE && !only_timeout, machine.state == DRIVE_STATE_INITIALISE));
    CLAIM(IMPLIES(input.request == COMMAND_OFF, machine.state != DRIVE_STATE_RUN));
}
