/* States of the drive. The switches are closed only in RUN.
 *
 *   INITIALISE --all checks passed for 1 ms--> READY <--run / off, stopped--> RUN
 *   READY, RUN --a check fails--> FAULT --clear_fault, all checks passed for 10 ms--> READY
 *
 * A command timeout is a fault only in RUN. After a fault the drive runs again only once the run request has been
 * withdrawn: a run request that persists through the fault does not restart it. Likewise `clear_fault` counts
 * from the tick in which the request changes to it, and only if every check passes in that tick and until the 10 ms are
 * over: a request that persists clears neither a later fault nor one whose cause disappears later. In RUN it is refused
 * (comms/commands.h): a drive that finds both has got there without a request to run, and leaves it.
 *
 * COMMAND_IDENTIFY, from READY on, is a run without the control laws: `identifies`. Every other request ends it, as
 * COMMAND_OFF, which is all that drive.c lets through then.
 *
 * The states are independent of the direction of rotation. RUN passes through zero speed when the reference changes its
 * sign. A stop remains in RUN with a reference that ramps to zero, from either side, until the rotor is at standstill:
 * a four-quadrant controller brakes, with a single-quadrant one the rotor coasts. Under a load that keeps the rotor
 * turning the stop does not end; `off` does.
 */
#ifndef INTERRUPTS_STATE_MACHINE_H
#define INTERRUPTS_STATE_MACHINE_H

#include <stdbool.h>
#include <stdint.h>

#include "interrupts/command.h"
#include "storage/fault.h"

/* Time for which every check must have passed before a fault can be cleared. */
#define STATE_MACHINE_CAUSE_GONE_MS 10u

typedef struct {
    drive_state_t state;
    uint32_t fault_free_ticks;      /* in INITIALISE and FAULT, since the last failed check; saturates */
    uint32_t start_inhibit_mask;    /* in INITIALISE: failed checks of this tick; 0 in every other state */
    bool clearing;                  /* in FAULT: requested, waits for the rest of the time */
    bool rearmed;                   /* the run request has been withdrawn since the last fault */
    bool identifies;                /* in RUN: experiments instead of the control laws */
    command_request_t last_request; /* of the previous tick */
    fault_record_t record;          /* in FAULT; fault FAULT_NONE in every other state */
} state_machine_t;

typedef struct {
    uint64_t fault_mask; /* failed checks of this tick, FAULT_BIT */
    command_request_t request;
    bool at_standstill; /* the speed, in either direction, allows a stop to end; matters in a stop only */
} state_machine_input_t;

/* Fault with the lowest number in a mask; FAULT_NONE of an empty one. */
fault_t state_machine_first_fault(uint64_t fault_mask);

/* State INITIALISE, no fault. */
void state_machine_reset(state_machine_t *state_machine);

/* State FAULT, with these faults found at the start, after state_machine_reset. */
void state_machine_start_in_fault(state_machine_t *state_machine, uint64_t fault_mask);

static inline bool begin_run(state_machine_t *state_machine) {
    state_machine->state = DRIVE_STATE_RUN;
    return true;
}

/* First part of a tick: true when a run goes on, or begins, in which case nothing else is to be done. */
static inline bool state_machine_runs(state_machine_t *state_machine, const state_machine_input_t *input) {
    if (input->fault_mask != 0) {
        return false;
    }
    if (state_machine->state == DRIVE_STATE_RUN) { /* rearmed; the last request matters in FAULT only */
        return input->request == COMMAND_RUN || (input->request == COMMAND_STOP && !input->at_standstill);
    }
    if (state_machine->state == DRIVE_STATE_READY && input->request == COMMAND_RUN && state_machine->rearmed) {
        return begin_run(state_machine);
    }
    return false;
}

/* The rest of a tick in which state_machine_runs() is false. initialise_ticks: control periods in 1 ms. Returns true in
 * the tick that latches a fault: fault, fault_mask and state of the record are set, the caller completes the others. */
bool state_machine_stands(state_machine_t *state_machine, uint64_t fault_mask, command_request_t request,
                          uint32_t initialise_ticks);

#endif
