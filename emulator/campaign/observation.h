/* Everything that the checkers judge by: the world as drawn, the true state of the plant, the faults that have begun,
 * what the genuine client meant, and of the drive its state, its first cause and its measurements. Checkers read it and
 * never write it. Shares no code with the firmware or with the emulator's own checks. */
#ifndef CAMPAIGN_OBSERVATION_H
#define CAMPAIGN_OBSERVATION_H

#include <stdbool.h>
#include <stdint.h>

#include "campaign/drive_numbers.h"
#include "campaign/sender.h"
#include "campaign/world.h"
#include "plant/plant.h"

#define OBSERVATION_LOOK_NS UINT64_C(19000) /* not a fraction of a control period: it would meet the same pulses */
#define OBSERVATION_KINDS_MAX 128           /* of faults */
#define OBSERVATION_CAUSES_MAX 8

/* After its end a disturbance may still show: in a filter, in an observer, in frames that wait. */
#define OBSERVATION_AFTER_NS (200 * MS_NS)

/* Temperatures of the hottest winding and of the hottest switch. */
typedef struct {
    double winding_C, switch_C;
} observation_heat_t;

/* Members of the drive that are read. */
typedef struct {
    uint8_t state;                                /* STATE_* */
    uint8_t fault;                                /* first cause */
    uint32_t checks;                              /* failed ones of the tick that latched it */
    uint32_t angle;                               /* of the encoder by the last measurement, 2^-32 rev */
    double current[HAL_PHASES_MAX], link_voltage; /* then, as fractions of the full scales of their sensors */
    observation_heat_t heat;                      /* measured */
} observation_drive_t;

/* The genuine client, by what it has put on the bus. */
typedef struct {
    sender_meaning_t meant;        /* by the last motion command */
    bool confirmed;                /* an arming, since the last fault and the last run */
    uint64_t confirmed_ns;         /* the last one */
    bool commanded;                /* to run, ever */
    bool off_seen;                 /* since the last request to run */
    bool clear_seen;               /* since the last fault */
    bool unacknowledged;           /* a reset by the watchdog, without a request to clear since */
    bool succeeded;                /* the second sender is in sequence by chance */
    uint64_t run_ns, off_ns;       /* last request to run or to stop, first to switch off since */
    uint64_t clear_ns;             /* the present request to clear began; 0: none */
    uint64_t withdrawn_ns;         /* last request other than run */
    uint64_t stop_ns, constant_ns; /* since then stopping, since then one command */
    double begin_speed_rad_s;      /* at constant_ns, or at the start of a run since */
    double stop_speed_rad_s;       /* when the stop began */
} observation_client_t;

/* Extremes of the present window of 2 ms. */
typedef struct {
    uint64_t begin_ns;
    double current_A, speed_rad_s, voltage_high_V, voltage_low_V;
} observation_recent_t;

/* A rotor that stays within a range of angles. */
typedef struct {
    uint64_t since_ns; /* 0: nothing to stay for */
    double low_rad, high_rad;
} observation_stay_t;

typedef struct {
    uint64_t stroke_ns;              /* the rotor was last a stroke from where it had been, */
    double stroke_rad;               /* here */
    observation_stay_t within_pitch; /* while a speed is commanded */
    bool swings;                     /* within a rotor pitch for as long as a rotor that is stalled */
    double run_angle_rad;            /* at the start of the run */
    bool turned;                     /* by a stroke since */
} observation_rotor_t;

/* Least and largest value in the present and in the previous window of time. */
typedef struct {
    double low[2], high[2];
} observation_range_t;

/* Limit of the torque in telemetry, and sets of parameters. */
typedef struct {
    uint64_t window_ns, last_ns; /* the present window began, the last limit came; 0: none */
    observation_range_t limit_Nm;
    const world_event_t *limited; /* the limit that the client sets; NULL: none */
    unsigned applied;             /* sets in effect */
    uint64_t applied_ns;          /* the last of them was applied */
    uint64_t saved_ns;            /* they were saved; 0: not */
} observation_limit_t;

/* After the faults. */
typedef struct {
    double speed_rpm;      /* commanded */
    bool judged;           /* within what every drive reaches */
    bool restarted;        /* in a run again, */
    uint64_t settle_by_ns; /* and by then at the speed */
    double restart_angle_rad;
    uint64_t in_band_ns;
    bool settled;
    bool held; /* at rest by an encoder that does not count: not judged, but counted */
} observation_recovery_t;

typedef struct {
    const world_t *world;
    const plant_t *plant;
    const master_t *master; /* of a world with one */
    uint64_t time_ns;       /* of the event */
    uint64_t period_ns;
    uint32_t limit_bits, constant_bits; /* of the drive's memory: a change of a higher one has no effect */
    double largest_flux_Wb;             /* aligned, at the trip current */
    double encoder_offset_rev;          /* on the shaft, in the direction of counting */
    double start_rev;                   /* turns of the encoder at the start: positions of the drive begin in them */

    observation_drive_t drive;
    uint8_t before;         /* state before the present control interrupt */
    uint64_t state_ns;      /* since when the drive has its state */
    uint64_t before_ns;     /* for how long it had the state before */
    uint64_t interrupt_ns;  /* last control interrupt */
    uint64_t reset_ns;      /* last reset */
    uint64_t latched_ns;    /* last fault */
    uint32_t latched_angle; /* measured then */
    bool counted;           /* it has changed since */
    unsigned causes;
    uint8_t cause[OBSERVATION_CAUSES_MAX]; /* first causes in their order */
    uint64_t cause_us;                     /* of the first one; 0: none */

    unsigned gates;                                                       /* not 0: a switch of any phase is on */
    uint64_t dark_ns;                                                     /* since then none is; 0: one is */
    uint64_t conducting_ns[HAL_PHASES_MAX], conducted_ns[HAL_PHASES_MAX]; /* since when, last for long enough */
    bool surged; /* a current of twice the trip flowed: what it heats has to cool, by the drive's reckoning */
    uint64_t reason_ns, reason_begin_ns; /* the plant had the last reason to keep the drive in a fault, since when */

    bool injected[OBSERVATION_KINDS_MAX]; /* kinds of faults that have begun, */
    uint32_t ever_disturbed;              /* and what they disturb */
    uint64_t fault_ns;                    /* the last fault began or ended */

    /* Present, or ended less than OBSERVATION_AFTER_NS ago; updated each millisecond. */
    bool active[OBSERVATION_KINDS_MAX];
    uint64_t ended_ns[OBSERVATION_KINDS_MAX]; /* 0: not yet */
    bool present[OBSERVATION_KINDS_MAX];
    uint32_t disturbed; /* by faults, DISTURBS_*; memory that has changed stays so */
    uint32_t variables; /* by bench variables, VARIABLE_* */
    bool second_sender, hostile_sender;

    observation_client_t client;
    observation_recent_t recent;
    observation_rotor_t rotor;
    observation_limit_t limit;
    observation_recovery_t recovery;
    observation_heat_t true_heat; /* at the end */
} observation_t;

/* The plant is read as it is at each event. */
void observation_start(observation_t *seen, const world_t *world, const plant_t *plant, uint64_t period_ns);

/* At each OBSERVATION_LOOK_NS of virtual time. */
void observation_on_look(observation_t *seen);

/* Once in a millisecond, at a look. */
void observation_on_millisecond(observation_t *seen);

void observation_on_interrupt(observation_t *seen, observation_drive_t drive);
void observation_on_reset(observation_t *seen, uint64_t time_ns, observation_drive_t drive);
void observation_on_command(observation_t *seen, uint64_t time_ns, const sender_meaning_t *meaning);
void observation_on_fault(observation_t *seen, unsigned kind, bool begins);

/* A frame of the drive, of eight bytes. */
void observation_on_frame(observation_t *seen, uint64_t time_ns, unsigned identifier, const uint8_t data[8]);

/* At the end of the faults: the speed to be commanded, r/min. */
double observation_recovery_speed_rpm(observation_t *seen);

void observation_at_end(observation_t *seen, observation_heat_t heat);

/* Start of a condition: the time now when it begins to hold, 0 when it does not hold. */
void observation_since(uint64_t *begin_ns, bool holds, uint64_t now_ns);

/* Time for which the rotor has stayed within a range of angles while it is asked for. */
uint64_t observation_stays_ns(const observation_t *seen, observation_stay_t *stay, bool asked, double range_rad);

/* Adds a value; renew: a new window begins. */
void observation_widen(observation_range_t *range, double value, bool renew);
bool observation_is_within(const observation_range_t *range, double value, double error);

#endif
