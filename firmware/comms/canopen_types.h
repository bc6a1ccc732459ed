/* State of the CANopen protocol (canopen.h). */
#ifndef COMMS_CANOPEN_TYPES_H
#define COMMS_CANOPEN_TYPES_H

#include <stdbool.h>
#include <stdint.h>

#include "canopen_dictionary.h"
#include "comms/commands.h"
#include "comms/frame_queue.h"
#include "comms/parameter_set.h"
#include "control/position/position.h"
#include "drive_telemetry.h"
#include "hal_can.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"

#define CANOPEN_NODE_MAX 127u
#define CANOPEN_NODE_NONE 255u /* unconfigured: LSS alone, until it gives a node-ID */
#define CANOPEN_PDOS 4u
#define CANOPEN_CONSUMERS 2u
#define CANOPEN_EMERGENCIES 4u
#define CANOPEN_BLOCK_BYTES 7u

/* Places of the queue that PDOs, heartbeats and emergencies find free while an SDO block is sent. */
#define CANOPEN_QUEUE_KEPT 20u

/* As in the heartbeat. */
typedef enum {
    CANOPEN_NMT_INITIALISING = 0,
    CANOPEN_NMT_STOPPED = 4,
    CANOPEN_NMT_OPERATIONAL = 5,
    CANOPEN_NMT_PRE_OPERATIONAL = 127
} canopen_nmt_t;

typedef enum {
    CANOPEN_SDO_IDLE,
    CANOPEN_SDO_UPLOAD,         /* segments */
    CANOPEN_SDO_DOWNLOAD,       /* segments */
    CANOPEN_SDO_BLOCK_START,    /* upload initiated, waits for the start */
    CANOPEN_SDO_BLOCK_UPLOAD,   /* segments of a block are sent, or its confirmation is awaited */
    CANOPEN_SDO_BLOCK_END,      /* the end of the upload is to be confirmed */
    CANOPEN_SDO_BLOCK_DOWNLOAD, /* segments of a block */
    CANOPEN_SDO_BLOCK_LAST      /* download: the end with its checksum is awaited */
} canopen_sdo_state_t;

typedef struct {
    canopen_sdo_state_t state;
    uint16_t index;
    uint8_t sub;
    bool toggle;
    uint8_t buffer[4];                 /* of a number */
    uint32_t size;                     /* of the object, bytes; download: announced, 0: not */
    uint32_t offset;                   /* bytes transferred; block upload: at the start of the block */
    uint8_t block_size, sequence;      /* segments of a block, and the last one */
    bool check;                        /* with CRC */
    uint16_t crc;                      /* of a download */
    uint32_t time_us;                  /* of the last request */
    uint8_t last[CANOPEN_BLOCK_BYTES]; /* last segment of a block download, of which the end says what counts */
} canopen_sdo_t;

typedef struct {
    bool seen;        /* since it is valid; its event timer runs */
    bool waiting;     /* `data` is for the next SYNC */
    bool misfits;     /* the last one had another length than its mapping */
    uint32_t time_us; /* of the last one */
    uint8_t data[8], length;
} canopen_rpdo_t;

typedef struct {
    bool sent;        /* since it is valid */
    bool event;       /* a change that waits for a SYNC */
    uint8_t syncs;    /* since the last one */
    uint32_t time_us; /* of the last one */
    uint8_t data[8];
} canopen_tpdo_t;

typedef struct {
    bool watched;
    uint32_t time_us;
} canopen_watch_t;

typedef struct {
    uint16_t code;
    uint8_t fault; /* of drive.dbc, 0: of the communication */
} canopen_emergency_t;

typedef struct {
    bool configuring;
    uint8_t selected; /* identity numbers that have matched, in order, to a selection or fast scan */
    uint8_t matched;  /* likewise of an identification */
    uint8_t node;     /* that takes effect with reset communication */
} canopen_lss_t;

/* States of CiA 402. */
typedef enum {
    CANOPEN_NOT_READY,
    CANOPEN_SWITCH_ON_DISABLED,
    CANOPEN_READY_TO_SWITCH_ON,
    CANOPEN_SWITCHED_ON,
    CANOPEN_OPERATION_ENABLED,
    CANOPEN_QUICK_STOP_ACTIVE,
    CANOPEN_FAULT_REACTION,
    CANOPEN_FAULT,
    CANOPEN_STATES
} canopen_state_t;

/* Set-point of profile position, in the units of position_set_point_t. */
typedef struct {
    int64_t target;
    int32_t speed_q22, acceleration_rpm_s, deceleration_rpm_s, jerk_rpm_s2;
} canopen_move_t;

typedef enum {
    CANOPEN_HOMING_IDLE,
    CANOPEN_HOMING_WANTED, /* begins once the position loop has seen the halt before it */
    CANOPEN_HOMING_RUNS,
    CANOPEN_HOMING_ATTAINED,
    CANOPEN_HOMING_FAILED
} canopen_homing_t;

/* Modes of position (canopen_position.h). */
typedef struct {
    position_order_t order; /* published, with its sequence */
    uint32_t sequence;
    canopen_move_t move, next; /* that runs, or has ended; that waits for its end */
    bool targeted;             /* a set-point or target has come since the mode began */
    bool moving;               /* `move` has not arrived */
    bool waiting;              /* `next` does */
    bool acknowledged;         /* bit 12 of profile position */
    canopen_homing_t homing;
    uint32_t silent_us; /* since the last cyclic target */
} canopen_position_t;

typedef struct {
    canopen_state_t state;
    bool stopping; /* a ramp to standstill, after which `after` is entered */
    canopen_state_t after;
    bool fast;           /* by the quick stop deceleration */
    bool clearing;       /* fault reset: the drive is asked to clear its fault */
    bool lost;           /* fault of the profile: the master was lost */
    bool torque;         /* the demand is one of torque */
    bool position;       /* the demand is one of position */
    uint8_t mode;        /* in effect */
    int64_t demand_q16;  /* 0.001 r/min, or 0.001 per mille of the rated torque */
    int32_t target;      /* of a cyclic mode, to which it interpolates, 0.001 as above */
    uint32_t left_us;    /* until the demand is the target */
    uint32_t stopped_us; /* since when a ramp's demand is 0 */
    bool at_rest;        /* it is */
    uint32_t step_us;    /* time of the last step */
    uint32_t clearing_us;
    bool enabling; /* enable operation has come before the drive was ready */
    uint32_t enabling_us;
    uint32_t within_us; /* for which the velocity, or the position, is within its window */
    uint32_t slow_us;   /* for which it is below its threshold */
    bool reset_bit;     /* bit 7 of the last controlword */
    bool order_bit;     /* bit 4 likewise */
    uint16_t error;     /* error code of the last step */
    bool limited;       /* the demand is beyond what the drive does */
    bool halted;        /* bit 8 of the controlword in the last step of a mode of position */
} canopen_drive_t;

/* Last telemetry cycle; LSBs of drive.dbc. */
typedef struct {
    int32_t speed, torque_q8, reference_q8;
    uint32_t voltage_q6;
    drive_state_t state;
    uint8_t fault;
    bool limited;
    bool supplied;
    bool has_position; /* the controller has the modes of position */
} canopen_measured_t;

typedef struct {
    uint8_t node; /* node-ID; 0: the protocol is not chosen, and nothing here acts */
    uint8_t serial;
    canopen_nmt_t nmt;
    bool boot_up; /* is to be sent */
    bool restart; /* reset node: the drive is to choose the protocol anew */
    bool restore; /* load the defaults with the next reset node */
    bool cycle;   /* a telemetry cycle has passed: a command is due */
    uint32_t heartbeat_us;
    bool guard_toggle;
    canopen_watch_t guard, consumer[CANOPEN_CONSUMERS];
    bool bus_off;                 /* bus-off has been seen, and the drive has not reacted yet */
    uint16_t communication_error; /* error code of a lost master */
    uint8_t reported_fault;       /* of drive.dbc */
    uint32_t error_base;          /* sequence number of the log up to which 0x1003 is cleared */
    canopen_emergency_t emergency[CANOPEN_EMERGENCIES];
    uint8_t emergencies;
    uint32_t emergency_us;
    uint32_t heard_us; /* last frame for this node */
    uint16_t dropped;
    int32_t values[CANOPEN_VALUE_COUNT];
    canopen_sdo_t sdo;
    canopen_rpdo_t rpdo[CANOPEN_PDOS];
    canopen_tpdo_t tpdo[CANOPEN_PDOS];
    canopen_lss_t lss;
    canopen_drive_t drive;
    canopen_position_t position;
    canopen_measured_t measured;
    position_status_t place; /* of the position loop, likewise */
} canopen_t;

/* Objects on which a frame may act, for one call. */
typedef struct {
    hal_t *hal;
    parameters_t *parameters;
    const parameters_conditions_t *conditions;
    parameter_set_t *set;
    nvm_store_t *store;
    commands_t *commands;
    frame_queue_t *queue;
    uint32_t time_us;
} canopen_context_t;

/* True while the drive runs or may run by a command of the profile. */
static inline bool canopen_enabled(const canopen_t *canopen) {
    return canopen->drive.state == CANOPEN_OPERATION_ENABLED || canopen->drive.state == CANOPEN_QUICK_STOP_ACTIVE ||
           canopen->drive.state == CANOPEN_FAULT_REACTION;
}

#endif
