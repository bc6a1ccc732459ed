/* States of the drive. The switches are closed only in RUN.
 *
 *   INITIALISE --all checks passed for 1 ms--> READY <--run / off, stopped--> RUN
 *   READY, RUN --a check fails--> FAULT --clear_fault, cause gone--> READY
 *
 * A lost command is a fault only in RUN. A drive that came back from a fault runs again only after it was asked for
 * something else than run: whoever holds `run` through a fault must let go first. Likewise `clear_fault` acts in the
 * tick in which it is first asked: held, it does not clear what comes later or goes away later.
 *
 * Direction: the states know none. RUN goes through zero speed when the reference changes its sign. A stop stays in RUN
 * with a reference that ramps to zero, from either side, until the rotor stands: a controller that can brake brakes,
 * with one that cannot the rotor coasts, and with a load that keeps turning it the stop does not end; `off` does.
 */
#ifndef DRIVE_STATE_MACHINE_H
#define DRIVE_STATE_MACHINE_H

#include <stdbool.h>
#include <stdint.h>

#include "drive/command.h"
#include "drive/fault.h"

typedef struct {
    drive_state_t state;
    uint32_t healthy_ticks;  /* in INITIALISE, since a check last failed */
    bool released;           /* run has been let go since the last fault */
    command_request_t asked; /* in the last tick */
    fault_record_t record;   /* fault FAULT_NONE outside FAULT */
} state_machine_t;

typedef struct {
    uint16_t checks; /* failed checks of this tick, FAULT_BIT */
    command_request_t request;
    bool standing; /* slow enough, in either direction, for a stop to end */
} state_machine_input_t;

/* INITIALISE. */
void state_machine_reset(state_machine_t *machine);

/* One tick. Returns true in the tick that a fault is latched, when the caller completes machine->record: fault, checks
 * and state are set. initialise_ticks: periods of 1 ms. */
bool state_machine_step(state_machine_t *machine, const state_machine_input_t *input, uint32_t initialise_ticks);

#endif
