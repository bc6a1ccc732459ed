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

/* --- Events, each for the part of the rig that it belongs to --- */

static void supply_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    supply_step(&((rig_t *)context)->supply);
}

static void load_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    load_step(&((rig_t *)context)->load);
}

static void dynamometer_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    dynamometer_end_acceleration(&((rig_t *)context)->dynamometer);
}

static void hold_event(void *context, uint64_t now_ns) {
    control_period_hold(&((rig_t *)context)->control_period, now_ns);
}

static void control_event(void *context, uint64_t now_ns) {
    control_period_start(&((rig_t *)context)->control_period, now_ns);
}

static void background_event(void *context, uint64_t now_ns) {
    control_period_resume_background(&((rig_t *)context)->control_period, now_ns);
}

static void watchdog_event(void *context, uint64_t now_ns) {
    control_period_watch(&((rig_t *)context)->control_period, now_ns);
}

static const scheduler_handler_t handlers[EVENT_COUNT] = {
    [EVENT_BENCH_VARIABLE] = stimulus_event,
    [EVENT_FAULT] = faults_event,
    [EVENT_SUPPLY] = supply_event,
    [EVENT_LOAD] = load_event,
    [EVENT_DYNAMOMETER] = dynamometer_event,
    [EVENT_CAN] = bus_event,
    [EVENT_CURRENT_HOLD] = hold_event,
    [EVENT_CONTROL] = control_event,
    [EVENT_BACKGROUND] = background_event,
    [EVENT_WATCHDOG] = watchdog_event,
    [EVENT_TRUTH] = truth_event,
};

/* --- A rig --- */

/* Everything but what the rigs of a list share. */
static void init(rig_t *rig, rig_t *first, unsigned bus_drive, const rig_config_t *config) {
    plant_init(&rig->plant, config->machine, config->initial_angle_rad);
    sensors_init(&rig->sensors, &config->machine->sensors, config->encoder_bits, config->adc_bits, config->seed);
    rig->sensors.encoder_edges = config->encoder_edges;
    board_init(&rig->board, &rig->plant, &rig->sensors, &first->bus, bus_drive, config->seed);
    rig->board.immediate_pwm = config->immediate_pwm;
    rig->board.nvm.random = config->seed;
    rig->next = NULL;
    rig->config = *config;
    rig->observer = (rig_observer_t){0};
    scheduler_init(&rig->scheduler, &rig->board.time_ns, handlers, rig);
    rig->shared_bus = (shared_bus_t){.bus = &first->bus, .scheduler = &first->scheduler};
    rig->truth_period_ns = config->drive_only ? 0 : TRUTH_PERIOD_DEFAULT_NS;
    rig->scheduler.due_ns[EVENT_TRUTH] = config->drive_only ? SCHEDULER_NEVER : TRUTH_PERIOD_DEFAULT_NS;
    rig->stimuli.count = 0;
    load_init(&rig->load, &rig->plant, &rig->scheduler);
    supply_init(&rig->supply, &rig->plant, &rig->scheduler);
    dynamometer_init(&rig->dynamometer, &rig->plant, &rig->scheduler);
    heat_init(&rig->heat, &rig->plant, rig->board.temperature_input);
    board_convert_temperatures(&rig->board);
    control_period_init(&rig->control_period, &(control_period_t){.plant = &rig->plant,
                                                                  .sensors = &rig->sensors,
                                                                  .board = &rig->board,
                                                                  .heat = &rig->heat,
                                                                  .scheduler = &rig->scheduler,
                                                                  .shared_bus = rig->shared_bus,
                                                                  .observer = &rig->observer});
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
    rig->control_period.firmware = *firmware;
    control_period_begin(&rig->control_period);
}

void rig_busy_until(rig_t *rig, uint64_t time_ns) {
    rig->control_period.interrupt_end_ns = time_ns;
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
