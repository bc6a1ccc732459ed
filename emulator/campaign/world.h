/* A world: machine, board, client's script and events. */
#ifndef CAMPAIGN_WORLD_H
#define CAMPAIGN_WORLD_H

#include <stdbool.h>
#include <stdint.h>

#include "host/machine_image.h"

#define WORLD_MACHINES_MAX 64
#define WORLD_EVENTS_MAX 48

/* Rounded, as it was when the seeds that tests and documents name were drawn: another value draws other worlds. */
#define WORLD_RAD_S_PER_RPM 0.10472

/* A machine of the campaign: its image, and what the tools derive from its file for drawing and judging. */
typedef struct {
    machine_image_t image;
    double speed_base_rpm, torque_rated_Nm, torque_max_Nm;
    double over_speed_rpm, over_voltage_V, under_voltage_V, trip_current_A;
    double command_lsb_rpm; /* of DRIVE_COMMAND.speed_reference_rpm */
    double command_lsb_Nm;  /* of DRIVE_TORQUE_COMMAND.torque_reference_Nm */
    double speed_command_max_rpm;
    double current_lsb_A, voltage_lsb_V; /* of telemetry */
    unsigned rate_min_hz;
    char name[64];
} world_machine_t;

typedef enum {
    WORLD_SET,      /* bench variable `what` has `raw` from begin to end, then `raw_end` */
    WORLD_FAULT,    /* fault of kind `what` from begin to end */
    WORLD_SPEED,    /* the client's speed reference is `value` r/min from begin on */
    WORLD_TORQUE,   /* the client commands a torque of `value` N m instead, from begin to end */
    WORLD_SILENT,   /* the client sends nothing from begin to end */
    WORLD_HOSTILE,  /* a second client sends frames of sort `what` from begin to end */
    WORLD_SECOND,   /* a second client sends protected commands of its own from begin to end */
    WORLD_EAGER,    /* the client clears, arms and runs again after each fault, whatever its cause does */
    WORLD_UNARMED,  /* the client requests to run without arming the drive, from begin to end */
    WORLD_REQUEST,  /* the client sends request `what` instead of run, from begin to end */
    WORLD_BEYOND,   /* the client commands a speed of `value` times the largest one, from begin to end */
    WORLD_DEGRADED, /* the client sets the parameter degraded_running before it runs the drive; what: a check */
    WORLD_LIMITED,  /* before that it sets torque_max_Nm to `value` of the largest torque; what 1: and saves it */
    WORLD_ARMED,    /* the client arms the drive also while it does not request to run, from begin to end */
    WORLD_TARGET,   /* the position is `value` revolutions from begin on; what: WORLD_TARGET_* of profile position */
    WORLD_MODE,     /* the master chooses mode `what` of CiA 402 from begin on */
    WORLD_CONTROL,  /* its controlword is `what` from begin to end */
    WORLD_NMT,      /* it sends the NMT command `what` at begin */
    WORLD_LOST,     /* it is not heard from begin to end */
    WORLD_NOISE,    /* a second client sends random frames of every service to the drive, from begin to end */
    WORLD_MASTER,   /* a second master sends controlword `what` from begin to end */
} world_kind_t;

/* Clients of a world. */
typedef enum {
    WORLD_CLIENT_SPEED,    /* commands of speed and torque by drive.dbc */
    WORLD_CLIENT_POSITION, /* commands of position by drive.dbc */
    WORLD_CLIENT_CANOPEN,  /* a master of CANopen */
} world_client_t;

enum { WORLD_TARGET_IMMEDIATELY = 1, WORLD_TARGET_RELATIVE = 2 };

/* How a CANopen master is watched. */
typedef enum { WORLD_WATCH_SILENCE, WORLD_WATCH_HEARTBEAT, WORLD_WATCH_GUARDING, WORLD_WATCH_PDO } world_watch_t;

/* Setting that a CANopen master writes before it starts the drive. */
typedef struct {
    unsigned mode;     /* of CiA 402, first */
    unsigned cycle_ms; /* of its frames */
    bool synchronous;  /* with SYNC */
    world_watch_t watch;
    unsigned watch_ms; /* without a sign of the master, which is lost then */
    unsigned quick_stop_option, abort_option, halt_option;
    double speed_rpm;          /* of profiles, and of the velocity modes */
    double acceleration_rpm_s; /* of all ramps */
    double torque;             /* of the torque modes, of the rated one */
    bool limited;              /* the positions, to: */
    double lowest_rev, highest_rev;
} world_master_t;

typedef enum {
    WORLD_HOSTILE_NOISE,    /* random data with identifiers of commands */
    WORLD_HOSTILE_REPLAY,   /* genuine frames once more, 50 to 500 ms old */
    WORLD_HOSTILE_LENGTH,   /* commands of a wrong length */
    WORLD_HOSTILE_FLOOD,    /* any identifier, five frames per millisecond */
    WORLD_HOSTILE_IDENTITY, /* identifiers of the drive's telemetry */
    WORLD_HOSTILE_FORGED,   /* commands in sequence, with a wrong checksum */
    WORLD_HOSTILE_REPEAT,   /* the latest genuine frame once more, each millisecond, as a gateway that hangs */
    WORLD_HOSTILE_SORTS
} world_hostile_t;

/* Check in the frames of the set. */
enum { WORLD_DEGRADED_RIGHT_CHECK, WORLD_DEGRADED_WRONG_CHECK };

/* As DRIVE_COMMAND.request. */
enum { WORLD_REQUEST_OFF, WORLD_REQUEST_STOP = 2, WORLD_REQUEST_CLEAR };

typedef struct {
    world_kind_t kind;
    unsigned what, phase, leg;
    int32_t raw, raw_end;
    double value;
    uint64_t begin_us, end_us; /* end_us 0: it lasts */
} world_event_t;

typedef struct {
    uint64_t seed;
    bool healthy;
    const world_machine_t *machine;
    double initial_angle_deg;
    unsigned control_rate_hz, controller, encoder_bits, adc_bits;
    bool encoder_edges;
    uint64_t duration_us;
    uint64_t recovery_us; /* all faults are over: the client clears, arms and commands a speed; 0: never */
    double supply_V, inertia_gain;
    bool keeps_reference; /* the client's stop and off have the reference of its run */
    unsigned events;
    world_event_t event[WORLD_EVENTS_MAX];
    uint64_t kept; /* bit n: event n happens */
    world_client_t client;
    world_master_t master;
} world_t;

/* A world without events and faults, whose drive has the usual board: 40 kHz, sensors of 12 and 17 bits. */
world_t world_plain(const world_machine_t *machine, unsigned controller);

/* Time in s after which a start from rest to a speed has settled: twice that at the largest torque, and 0.25 s. */
double world_settled_s(const world_machine_t *machine, double speed_rpm);

/* Adds an event; NULL: there is no room. */
world_event_t *world_add(world_t *world, world_kind_t kind, uint64_t begin_us, uint64_t end_us);

/* Adds a bench variable that has a value from begin to end, and another one after it; end 0: it lasts. */
void world_add_set(world_t *world, unsigned variable, double value, double after, uint64_t begin_us, uint64_t end_us);

/* The event when it is kept and has begun at a time, UINT64_MAX: ever; otherwise NULL. */
const world_event_t *world_begun(const world_t *world, unsigned event, uint64_t time_us);

/* True when the event is kept and active at a time. */
bool world_active(const world_t *world, unsigned event, uint64_t time_us);

/* The latest event of a kind that has begun at a time; NULL: none. active: and not ended. */
const world_event_t *world_latest(const world_t *world, world_kind_t kind, uint64_t time_us, bool active);

/* Name of what an event is, for the description. */
const char *world_event_name(const world_event_t *event);

/* One line of JSON. */
void world_print(const world_t *world);

#endif
