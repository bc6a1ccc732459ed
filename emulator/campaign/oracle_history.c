#include "campaign/oracle_parts.h"

#include <string.h>

#include "bench_variables.h"
#include "fault_kinds.h"

bool oracle_any_injected(const oracle_t *oracle, unsigned first, unsigned last) {
    return memchr(&oracle->injected[first], true, last + 1 - first) != NULL;
}

bool oracle_variable_begun(const oracle_t *oracle, unsigned variable, uint64_t time_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, time_us);
        if (event != NULL && event->kind == WORLD_SET && event->what == variable) {
            return true;
        }
    }
    return false;
}

bool oracle_other_sender(const oracle_t *oracle, bool hostile, uint64_t time_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, time_us);
        if (event != NULL && (event->kind == WORLD_SECOND || (hostile && event->kind == WORLD_HOSTILE))) {
            return true;
        }
    }
    return false;
}

static bool disturbs_bus(const oracle_t *oracle) {
    static const unsigned variables[] = {BENCH_VARIABLE_BABBLE_LOAD_PERCENT, BENCH_VARIABLE_BUS_CONNECTION,
                                         BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER, BENCH_VARIABLE_FRAME_FAULT};
    for (unsigned i = 0; i < sizeof variables / sizeof *variables; i++) {
        if (oracle_variable_begun(oracle, variables[i], UINT64_MAX)) {
            return true;
        }
    }
    return oracle_other_sender(oracle, true, UINT64_MAX);
}

bool oracle_is_load(const world_event_t *event) {
    return event->kind == WORLD_SET &&
           (event->what == BENCH_VARIABLE_LOAD_TORQUE_NM || event->what == BENCH_VARIABLE_LOAD_TORQUE_COARSE_NM);
}

bool oracle_is_load_sine(const world_event_t *event) {
    return event->kind == WORLD_SET && (event->what == BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_NM ||
                                        event->what == BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_COARSE_NM);
}

double oracle_stroke_rad(const plant_t *plant) {
    return ORACLE_TWO_PI / (plant->machine->rotor_poles * plant->machine->phases);
}

bool oracle_overhauled(const oracle_t *oracle, double speed) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, UINT64_MAX);
        if (event != NULL && oracle_is_load(event) && event->raw * speed < 0.0) {
            return true;
        }
    }
    return false;
}

bool oracle_state_changed(const oracle_t *oracle) {
    return oracle_any_injected(oracle, FAULT_STATE_FLIPPED, FAULT_FAULT_LATCH_FLIPPED);
}

bool oracle_encoder_faulty(const oracle_t *oracle) {
    return oracle_any_injected(oracle, FAULT_ENCODER_STUCK, FAULT_ENCODER_NO_ANSWER);
}

bool oracle_link_sensor_faulty(const oracle_t *oracle) {
    return oracle_any_injected(oracle, FAULT_DC_LINK_SENSOR_OPEN, FAULT_DC_LINK_SENSOR_OFFSET);
}

bool oracle_drive_disturbed(const oracle_t *oracle, uint64_t time_us) {
    return oracle_any_injected(oracle, FAULT_INTERRUPT_LOST, FAULT_INTERRUPT_STORM) ||
           oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT) ||
           oracle_variable_begun(oracle, BENCH_VARIABLE_INTERRUPT_TIME_US, time_us);
}

bool oracle_can_turn(const oracle_t *oracle) {
    return oracle->world->controller == 2 || oracle->meant.reference > 0.0;
}

static const world_event_t *limited(const oracle_t *oracle) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_LIMITED) {
            return event;
        }
    }
    return NULL;
}

void oracle_read_world(oracle_t *oracle) {
    oracle->bus_disturbed = disturbs_bus(oracle);
    oracle->limited = limited(oracle);
}

bool oracle_sets_in_effect(const oracle_t *oracle) {
    return oracle->limited != NULL && oracle->applied >= 2;
}

double oracle_torque_max_Nm(const oracle_t *oracle) {
    return oracle->world->machine->torque_max_Nm * (oracle->limited != NULL ? oracle->limited->value : 1.0);
}
