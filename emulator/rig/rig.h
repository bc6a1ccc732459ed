/* The test bench: joins plant, board, CAN bus and clients on one virtual clock.
 *
 * Several drives on one bus are a list of rigs. The first one has the bus, the clients and the pacing; each has a
 * plant, a board, variables and faults of its own.
 *
 * One thread, next event first (scheduler.h). Events of the same instant come in the order of scheduler_event_t, then
 * the clients. The plant is advanced exactly to the events that touch it, and to no others, so that the way a client
 * divides time into RIG_RUN_UNTILs does not change a bit of the result.
 *
 * In lock-step, time stands still until a client sends RIG_RUN_UNTIL; clients are not read while time runs. Frames for
 * the bus that were sent while it stood still wait in the node of their client, in its order, and take part in
 * arbitration when time runs, whatever the moment they arrived; a client's frames that were sent before another
 * client's RIG_RUN_UNTIL are taken before it. The RIG_RUN_UNTIL of a client that has disconnected is abandoned, within
 * RIG_STOP_STEP_NS, when another client is connected; without one it runs to its end. In the other paces clients are
 * read each RIG_READ_STEP_NS of virtual time.
 */
#ifndef RIG_H
#define RIG_H

#include <stdbool.h>
#include <stdint.h>

#include "plant/machine.h"
#include "plant/plant.h"
#include "plant/sensors.h"
#include "rig/board.h"
#include "rig/can_bus.h"
#include "rig/memory_object.h"
#include "rig/pacing.h"
#include "rig/scheduler.h"
#include "rig/stimulus_queue.h"
#include "rig/transport.h"

#define RIG_READ_STEP_NS UINT64_C(1000000)
#define RIG_STOP_STEP_NS UINT64_C(10000000) /* virtual time between two checks for a stop request */
#define RIG_NEVER SCHEDULER_NEVER
#define RIG_LOAD_PROFILE_MAX 256  /* values */
#define RIG_RUNS_MAX 64           /* RIG_RUN_UNTILs that wait for their time */
#define RIG_MOVING_BACKLOG_MAX 64 /* all paces but lock-step: a client waits while so many of its frames are queued */

/* The firmware, seen from the emulator. All take no virtual time, except as board.interrupt_took_ns says. */
typedef struct {
    void (*control_interrupt)(void *context);  /* at the start of each control period */
    void (*deferred_interrupt)(void *context); /* after a control interrupt that has set board.deferred_requested */
    void (*background)(void *context);         /* after each control interrupt and the deferred one */
    void *context;
    void (*restart)(void *context); /* from its start on, after board_reset; NULL: it cannot be reset */
    /* Flips a bit of an object of memory_object.h; bit n of flip_objects: it has object n. */
    void (*flip)(void *context, memory_object_t object, uint32_t bit);
    uint32_t flip_objects;
} rig_firmware_t;

/* Who looks at a rig around the calls of the firmware; each function may be NULL. */
typedef struct {
    void (*before_interrupt)(void *context); /* the control interrupt */
    void (*after_interrupt)(void *context);
    void (*after_restart)(void *context);
    void *context;
} rig_observer_t;

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

typedef struct {
    uint64_t time_ns;
    uint8_t sequence;
    uint32_t client;
} rig_run_t;

typedef struct {
    double torque_Nm; /* load_torque_Nm as set: where a ramp ends */
    double ramp_Nm_s; /* 0: steps */
    double ramp_from_Nm;
    uint64_t ramp_start_ns;
    double sine_amplitude_Nm;
    double sine_frequency_Hz;
    double sine_start_periods; /* phase at sine_start_ns */
    uint64_t sine_start_ns;
    double profile_Nm; /* of the value 1 */
    unsigned profile_values;
    double profile[RIG_LOAD_PROFILE_MAX]; /* over one turn */
    bool dropped;                         /* no load, whatever the members above */
} load_t;

typedef struct {
    double voltage_V; /* supply_voltage_V */
    double factor;    /* of a fault */
    double ripple_V, ripple_Hz;
    uint64_t ripple_start_ns;
} supply_t;

/* Bodies of one kind, one in each phase, and their temperature sensors (heat.h). */
typedef struct {
    double temperature_C[HAL_PHASES_MAX];
    double loss_J[HAL_PHASES_MAX];                      /* of the plant, at the last step */
    double held_C;                                      /* a variable of the bench */
    sensors_input_fault_t sensor_fault[HAL_PHASES_MAX]; /* code: of 16 bits; offset in K */
} heat_bodies_t;

typedef struct {
    uint64_t time_ns; /* of the last step */
    double ambient_C;
    heat_bodies_t winding, inverter;
    double resistance_C[HAL_PHASES_MAX]; /* temperatures of the windings that the plant's resistances are for */
} heat_t;

#define RIG_FAULT_KINDS_MAX 128

/* A fault of one kind at one place. */
typedef struct {
    bool present;
    double value; /* of its attribute, in the DBC's unit */
} fault_presence_t;

/* Large: static or on the heap. */
typedef struct rig {
    plant_t plant;
    sensors_t sensors;
    can_bus_t bus; /* of the first rig of a list */
    board_t board; /* board.time_ns is the time */

    /* Private to the rig's files. */
    struct rig *first, *next; /* of the list of the drives on one bus */
    rig_config_t config;
    rig_firmware_t firmware;
    rig_observer_t observer; /* set after rig_init */
    scheduler_t scheduler;
    uint64_t period_ns;                           /* control_period.c */
    uint64_t interrupt_time_ns, interrupt_end_ns; /* triggers before the end of the last interrupt are lost */
    uint64_t truth_period_ns;
    stimulus_queue_t stimuli;
    load_t load;             /* load.c */
    supply_t supply;         /* supply.c */
    double held_speed_rpm;   /* dynamometer.c: as set */
    double held_speed_rad_s; /* where its acceleration ends */
    bool shaft_locked;
    stimulus_queue_t fault_changes;                                  /* faults.c */
    fault_presence_t faults[RIG_FAULT_KINDS_MAX][HAL_PHASES_MAX][2]; /* by kind, phase and leg */
    bool flipped[MEMORY_OBJECTS];                                    /* and which bit: */
    uint32_t flipped_bit[MEMORY_OBJECTS];
    bool interrupts_lost, background_hung; /* control_period.c */
    uint64_t interrupt_late_ns;            /* least time of the control interrupt, control_period.c */
    heat_t heat;                           /* heat.c */
    rig_run_t runs[RIG_RUNS_MAX];          /* server.c, by time, equal times in the order of arrival */
    unsigned run_count;
    uint64_t stop_checked_ns;
} rig_t;

/* A bench at time 0: machine at rest, supply on, no load, no firmware. The rig must not be moved afterwards. */
void rig_init(rig_t *rig, const rig_config_t *config);

/* A bench for another drive on the bus of `first`, which is at time 0: of the configuration, what concerns bus, clients
 * and pacing is not used. There are at most CAN_BUS_DRIVES_MAX drives, with different nodes. */
void rig_add(rig_t *first, rig_t *rig, const rig_config_t *config);

/* Joins the firmware, which must have started the timer (hal_pwm_start); its first interrupt is one period away. */
void rig_join(rig_t *rig, const rig_firmware_t *firmware);

/* Resets the drive: the switches open, the firmware starts again, the memory and everything outside the drive continue.
 * False when the firmware cannot be reset. */
bool rig_reset_drive(rig_t *rig, hal_reset_cause_t cause);

/* The processor serves no trigger of a control interrupt before time_ns: they are lost, like those during an
 * interrupt. */
void rig_busy_until(rig_t *rig, uint64_t time_ns);

/* One round, of the first rig as the next two. Lock-step: takes the clients' frames; runs to the earliest requested
 * time, or waits up to timeout_ms (negative: indefinitely) when none is requested. Other paces: runs to the next
 * reading point. False at the end: stop requested, stop_at_ns reached, or config.transport->failure. */
bool rig_serve(rig_t *rig, int timeout_ms);

/* Advances the plant, and its observer, to the present time and sends the frames that are still in batches. */
void rig_finish(rig_t *rig);

/* Frees what the rig allocated for its clients. */
void rig_close(rig_t *rig);

#endif
