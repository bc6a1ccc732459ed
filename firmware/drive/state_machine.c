#include "drive/state_machine.h"

void state_machine_reset(state_machine_t *machine) {
    *machine = (state_machine_t){.state = DRIVE_STATE_INITIALISE};
}

static fault_t first_fault(uint16_t checks) {
    fault_t fault = FAULT_NONE;
    while (fault < FAULT_COUNT && (checks & FAULT_BIT(fault)) == 0) {
        fault++;
    }
    return fault;
}

static bool latch(state_machine_t *machine, uint16_t checks) {
    machine->record = (fault_record_t){
        .fault = first_fault(checks),
        .checks = checks,
        .state = (uint8_t)machine->state,
    };
    machine->state = DRIVE_STATE_FAULT;
    machine->released = false;
    return true;
}

/* A tick in which something may happen. */
__attribute__((cold)) static bool decide(state_machine_t *machine, const state_machine_input_t *input,
                                         uint32_t initialise_ticks) {
    const uint16_t lasting = input->checks & (uint16_t)~FAULT_BIT(FAULT_COMMAND_TIMEOUT);
    const bool clear = input->request == COMMAND_CLEAR_FAULT && machine->asked != COMMAND_CLEAR_FAULT;
    machine->asked = input->request;
    if (input->request != COMMAND_RUN) {
        machine->released = true;
    }
    switch (machine->state) {
    case DRIVE_STATE_INITIALISE:
        machine->healthy_ticks = lasting == 0 ? machine->healthy_ticks + 1 : 0;
        if (machine->healthy_ticks >= initialise_ticks) {
            machine->state = DRIVE_STATE_READY;
        }
        break;
    case DRIVE_STATE_READY:
        if (lasting != 0) {
            return latch(machine, lasting);
        }
        if (input->request == COMMAND_RUN && input->checks == 0 && machine->released) {
            machine->state = DRIVE_STATE_RUN;
        }
        break;
    case DRIVE_STATE_RUN:
        if (input->checks != 0) {
            return latch(machine, input->checks);
        }
        if (input->request == COMMAND_OFF || (input->request == COMMAND_STOP && input->standing)) {
            machine->state = DRIVE_STATE_READY;
        }
        break;
    case DRIVE_STATE_FAULT:
        if (clear && lasting == 0) {
            machine->state = DRIVE_STATE_READY;
            machine->record = (fault_record_t){.fault = FAULT_NONE};
        }
        break;
    }
    return false;
}

bool state_machine_step(state_machine_t *machine, const state_machine_input_t *input, uint32_t initialise_ticks) {
    if (machine->state == DRIVE_STATE_RUN && input->request == COMMAND_RUN && input->checks == 0) {
        machine->asked = COMMAND_RUN; /* nearly every tick of a run */
        return false;
    }
    return decide(machine, input, initialise_ticks);
}
