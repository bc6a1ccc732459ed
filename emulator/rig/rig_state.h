/* State of a rig, the sum of its parts: for the modules that need most of them. rig.h has the functions. */
#ifndef RIG_STATE_H
#define RIG_STATE_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"
#include "plant/machine.h"
#include "plant/plant.h"
#include "plant/sensors.h"
#include "rig/board.h"
#include "rig/can_bus.h"
#include "rig/control_period.h"
#include "rig/dynamometer.h"
#include "rig/firmware.h"
#include "rig/heat.h"
#include "rig/load.h"
#include "rig/pacing.h"
#include "rig/scheduler.h"
#include "rig/shared_bus.h"
#include "rig/stimulus_queue.h"
#include "rig/supply.h"
#include "rig/transport.h"

#define RIG_READ_STEP_NS UINT64_C(1000000)
#define RIG_STOP_STEP_NS UINT64_C(10000000) /* virtual time between two checks for a stop request */
#define RIG_NEVER SCHEDULER_NEVER
#define RIG_MOVING_BACKLOG_MAX 64 /* all paces but lock-step: a client waits while so many of its frames are queued */

/* When to end: `requested` is called at least every RIG_STOP_STEP_NS, and when a descriptor becomes readable. */
typedef struct {
    int descriptors[2]; /* negative: not used */
    bool (*requested)(void *context);
    void *context;
} rig_stop_t;

typedef struct {
    const machine_t *machine;
    double initial_angle_rad;
    unsigned encoder_bits; /* 8..32, 0 means ideal */
    unsigned adc_bits;     /* 12..16 */
    bool encoder_edges;    /* the board captures the encoder's edges */
    bool immediate_pwm;    /* compare values act when they are written, not in the next period */
    uint64_t seed;
    unsigned node; /* of the drive: in the identifiers of its rig */
    uint32_t bit_rate;
    bool drive_only; /* of the bench only replies are sent: no true state until its period is set, no time stamps */
    pacing_t pacing;
    uint64_t stop_at_ns;    /* RIG_NEVER: no end */
    rig_stop_t stop;        /* requested NULL: never */
    transport_t *transport; /* outlives the rig, is not closed by it */
} rig_config_t;

/* A fault of one kind at one place. */
typedef struct {
    bool present;
    double value; /* of its attribute, in the DBC's unit */
} fault_presence_t;

#define FAULT_KINDS_MAX 128

typedef struct {
    stimulus_queue_t changes;
    fault_presence_t present[FAULT_KINDS_MAX][HAL_PHASES_MAX][2]; /* by kind, phase and leg */
} faults_t;

/* A RIG_RUN_UNTIL that waits for its time. */
typedef struct {
    uint64_t time_ns;
    uint8_t sequence;
    uint32_t client;
} server_run_t;

#define SERVER_RUNS_MAX 64

typedef struct {
    server_run_t runs[SERVER_RUNS_MAX]; /* by time, equal times in the order of arrival */
    unsigned run_count;
    uint64_t stop_checked_ns;
} server_t;

/* Large: static or on the heap. */
typedef struct rig {
    plant_t plant;
    sensors_t sensors;
    can_bus_t bus; /* of the first rig of a list */
    board_t board; /* board.time_ns is the time */

    rig_observer_t observer; /* set after rig_init */

    /* Private to the rig's files. */
    struct rig *next; /* of the list of the drives on one bus */
    rig_config_t config;
    scheduler_t scheduler;
    shared_bus_t shared_bus; /* of the list */
    control_period_t control_period;
    load_t load;
    supply_t supply;
    dynamometer_t dynamometer;
    heat_t heat;
    stimulus_queue_t stimuli;
    faults_t faults;
    server_t server; /* of the first rig of a list */
    uint64_t truth_period_ns;
} rig_t;

#endif
