#include "rig/rig.h"

#include "rig/bus_events.h"
#include "rig/control_period.h"
#include "rig/dynamometer.h"
#include "rig/faults.h"
#include "rig/heat.h"
#include "rig/load.h"
#include "rig/server.h"
#include "rig/stimulus.h"
#include "rig/supply.h"

#define TRUTH_PERIOD_DEFAULT_NS UINT64_C(1000000)

static const scheduler_handler_t handlers[EVENT_COUNT] = {
    [EVENT_BENCH_VARIABLE] = stimulus_event,
    [EVENT_FAULT] = faults_event,
    [EVENT_SUPPLY] = supply_event,
    [EVENT_LOAD] = load_event,
    [EVENT_DYNAMOMETER] = dynamometer_event,
    [EVENT_CAN] = bus_event,
    [EVENT_CURRENT_HOLD] = control_period_hold_event,
    [EVENT_CONTROL] = control_period_start_event,
    [EVENT_BACKGROUND] = control_period_background_event,
    [EVENT_WATCHDOG] = control_period_watchdog_event,
    [EVENT_TRUTH] = truth_event,
};

/* Everything but what the rigs of a list share. */
static void init(rig_t *rig, rig_t *first, unsigned bus_drive, const rig_config_t *config) {
    plant_init(&rig->plant, config->machine, config->initial_angle_rad);
    sensors_init(&rig->sensors, &config->machine->sensors, config->encoder_bits, config->adc_bits, config->seed);
    rig->sensors.encoder_edges = config->encoder_edges;
    board_init(&rig->board, &rig->plant, &rig->sensors, &first->bus, bus_drive, config->seed);
    rig->board.immediate_pwm = config->immediate_pwm;
    rig->board.nvm.random = config->seed;
    rig->first = first;
    rig->next = NULL;
    rig->config = *config;
    rig->firmware = (rig_firmware_t){0};
    rig->observer = (rig_observer_t){0};
    scheduler_init(&rig->scheduler, &rig->board.time_ns, handlers, rig);
    rig->period_ns = 0;
    rig->truth_period_ns = config->drive_only ? 0 : TRUTH_PERIOD_DEFAULT_NS;
    rig->scheduler.due_ns[EVENT_TRUTH] = config->drive_only ? SCHEDULER_NEVER : TRUTH_PERIOD_DEFAULT_NS;
    rig->interrupt_time_ns = rig->interrupt_end_ns = 0;
    rig->stimuli.count = 0;
    rig->interrupts_lost = rig->background_hung = false;
    rig->interrupt_late_ns = 0;
    load_init(rig);
    supply_init(rig);
    dynamometer_init(rig);
    heat_init(rig);
    faults_init(rig);
}

void rig_init(rig_t *rig, const rig_config_t *config) {
    can_bus_init(&rig->bus, config->bit_rate, config->seed);
    init(rig, rig, 0, config);
    server_init(rig);
}

void rig_add(rig_t *first, rig_t *rig, const rig_config_t *config) {
    init(rig, first, can_bus_add_drive(&first->bus), config);
    rig_t *last = first;
    while (last->next) {
        last = last->next;
    }
    last->next = rig;
    last->scheduler.next = &rig->scheduler;
}

void rig_join(rig_t *rig, const rig_firmware_t *firmware) {
    rig->firmware = *firmware;
    control_period_begin(rig);
}

bool rig_reset_drive(rig_t *rig, hal_reset_cause_t cause) {
    if (!rig->firmware.restart) {
        return false;
    }
    plant_advance(&rig->plant, rig->board.time_ns);
    board_reset(&rig->board, cause);
    rig->interrupt_end_ns = 0;
    faults_drive_reset(rig);
    rig->scheduler.due_ns[EVENT_CONTROL] = rig->scheduler.due_ns[EVENT_CURRENT_HOLD] =
        rig->scheduler.due_ns[EVENT_BACKGROUND] = SCHEDULER_NEVER;
    rig->firmware.restart(rig->firmware.context);
    if (rig->observer.after_restart) {
        rig->observer.after_restart(rig->observer.context);
    }
    control_period_begin(rig);
    return true;
}

void rig_busy_until(rig_t *rig, uint64_t time_ns) {
    rig->interrupt_end_ns = time_ns;
}

bool rig_serve(rig_t *rig, int timeout_ms) {
    return server_round(rig, timeout_ms);
}

void rig_finish(rig_t *rig) {
    for (rig_t *each = rig; each; each = each->next) {
        plant_advance(&each->plant, each->board.time_ns);
    }
    transport_flush(rig->config.transport);
}

void rig_close(rig_t *rig) {
    can_bus_close(&rig->bus);
}
