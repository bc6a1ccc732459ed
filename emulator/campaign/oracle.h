/* Judges a run in terms of the plant: true currents, speed, voltage and gate signals, the frames that its senders
 * meant, and of the drive its state, its first fault and the angle that it has measured only. Shares no code with the
 * firmware or with the emulator's own checks.
 *
 * never
 *   over_current    a phase's true current, with a gate of it on, above the comparators' threshold by more than a
 *                   period's rise, in two looks in succession; without a gate no drive can end a current, which the
 *                   rotor or a shorted switch then drives
 *   gate_on         a gate on while the drive is not in state run, or a line of safe torque off is not energised, or
 *                   2.5 periods after the last control interrupt
 *   no_command      a gate on without a confirmed arming since the last fault, or 5 ms after a genuine off; a gate on,
 *                   or the state run, 502 ms after the last genuine request to run; torque 170 ms after it, or from 65
 *                   ms on a larger one than before, by half and a fifth of the largest; both later by the 18 ms for
 *                   which the request waits when the background hangs and the watchdog does not reset the drive; a
 *                   fault that ends without a genuine request to clear it; a gate on after a reset by the watchdog
 *                   without one
 *   stopped         state run left, without a fault, less than 30 ms after a genuine request to run; or after one to
 *                   stop while the rotor turns, faster than at 5 % of the base speed and what a light rotor loses
 *                   before its speed is known
 *   not_stopped     no fault: faster than at the request to stop, by 5 % of the base speed and what a light rotor
 *                   gains; four quadrants: still turning 100 ms after the time that half of the torque limit needs,
 *                   while the request is heard: after a silence the time begins anew
 *   resumed         a run after bus-off, with no other request than run since
 *   cleared         a fault ended less than 8 ms after the plant's last reason for one, unless that has just begun: a
 *                   line of safe torque off not energised, a link voltage or a speed beyond its limits; by a request to
 *                   clear that was there before it; after lines of safe torque off had differed, without both having
 *                   been off; or that of an encoder which stood still, and has not counted since
 *   under_voltage   in state run, the link voltage below its threshold by 6 % for 3 ms
 *   over_speed      a gate on for 2 ms at a speed above the limit by 2 %, unless the load turns the rotor and the
 *                   encoder shows nothing
 *   over_voltage    a gate on for 200 us at a link voltage above the limit by 2 %, on a machine whose supply takes no
 *                   energy back, unless a fault of the only sensor hides it
 *   wrong_angle     in state run, encoder and processor healthy, at a speed that is steady within 10 % for 12 ms and 16
 *                   counts of the encoder: the measured angle off the encoder's by more than three quarters of a count
 *                   and the motion in a tick of the timer, on average. The middle of a count is off by half of one at
 *                   most, when sampling is in step with the counts, the time of an edge by a tick
 *   wrong_current, wrong_voltage
 *                   a measured phase current or link voltage off the true one by more than 0.8 % of the sensor's full
 *                   scale, sensor and processor healthy
 *   wrong_temperature
 *                   at the end, the hottest winding or switch measured off the true one by more than 5 K, sensors and
 *                   processor healthy
 *   wrong_torque    no fault, torque mode, below half of the base speed: the mean torque of electrical periods off the
 *                   commanded one by more than 10 %, without torque sharing 25 %, and 2 % of the rated one
 *   not_following   no fault, a speed commanded and a load that has been constant for long: the mean speed over 50 ms
 *                   and a revolution off by more than 0.3 %, 0.1 % of the base speed and a count; with one quadrant
 *                   below by 2 %, with its sliding mode by 10 %, and 0.2 % of the base speed
 *   wrong_way       one quadrant: for 50 ms a torque forwards, at a speed, while a speed backwards is commanded
 *   above_limit     up to 0.9 of the base speed, without torque sharing half: the mean torque of electrical periods of
 *                   20 ms above the limit in telemetry, or that which the client has set, by 30 % and 5 % of the rated
 *                   one, without torque sharing 10 %, with the BP-PID in strokes of less than 128 periods half of the
 *                   torque; or a limit in telemetry above the one that the client has set, by 3 %
 *   overshoot       no fault, the speed above a reference that it has approached from below by more than 12 % and 5 %
 *                   of the base speed; one quadrant: and what a light rotor gains
 *   wrong_status    a state or a first cause on the bus that is not the drive's, which has had its state for 30 ms, bus
 *                   and memory undisturbed
 *   wrong_telemetry a measured current or voltage on the bus that the drive has not measured in the last 4 ms, a speed
 *                   off the true one by 10 %, 5 % of the base speed and half a count in a millisecond; in the snapshot
 *                   of a fault those of its instant; no fault: a mean torque of 100 ms off the true one, without
 *                   torque sharing beyond the least or the largest, by 30 % and 15 % of the rated one
 *   not_derated     a torque limit in telemetry above what loads and temperatures beside it leave, by 12 % of the
 *                   largest torque
 *   applied         a set of parameters with a wrong check was applied
 *   wrong_cause     a first cause that neither is true of the plant nor belongs to a fault that was there
 *   not_first       a first cause that is not the first one, by its number, of the checks that failed in its tick
 *   false_alarm     a fault of the drive without any other, which is not true of the plant, or the drive's own work:
 *                   too large a current, and without a load that drives the machine too high a speed or voltage; beside
 *                   faults that do not explain it, it is a wrong_cause
 *   undetected      in state run for longer than a reaction takes with a fault that shows at any time: changed memory,
 *                   sensors at a rail, a wrong clock, a background that hangs (oracle_detection.c)
 *   no_current      voltage on a phase for twenty times its largest flux linkage, in pulses of more than three
 *                   periods and of more than a 64th of one each, and no current at all
 *   two_lost        in state run for 300 ms at less than half of the commanded speed, with two phases lost
 *   blocked         a speed commanded, and the rotor within a quarter of a stroke for 300 ms and three strokes, or
 *                   within a stroke for 500 ms and six: a swing that grows is no standstill
 *   misled          for 200 ms, above a fifth of the base speed and a tenth of the trip current, a measured angle off
 *                   by more than a sixth of a rotor pitch
 *   contested       for 150 ms in state run while another client sends commands, or frames that are the drive's
 *   not_reset       no control interrupt for 60 ms, and no reset
 *   mute            no status on an undisturbed bus for 100 ms
 * eventually
 *   not_recovered   faults over, cleared, armed and commanded: not in run after 150 ms, or not within 0.5 % of the
 *                   speed 100 ms after the time that half of the torque limit needs, or again in a fault, or with a
 *                   phase that is not used; judged up to 0.9 of the base speed, above which a start is near the limit
 *                   of the speed. One quadrant: at most 20 % above, of a light rotor what it gains while a delay and
 *                   the flux linkage last
 * sometimes
 *   cells           (fault, state of the drive, sector of phase a) in which a fault began */
#ifndef CAMPAIGN_ORACLE_H
#define CAMPAIGN_ORACLE_H

#include <stdbool.h>
#include <stdint.h>

#include "campaign/sender.h"
#include "campaign/world.h"
#include "plant/plant.h"

#define ORACLE_LOOK_NS UINT64_C(19000) /* no whole part of a control period: else it would meet the same pulses */
#define ORACLE_SECTORS 6
#define ORACLE_STATES 4
#define ORACLE_KINDS 128 /* of faults, at most */
#define ORACLE_CELLS (ORACLE_KINDS * ORACLE_STATES * ORACLE_SECTORS)
#define ORACLE_VIOLATIONS_MAX 4
#define ORACLE_CAUSES_MAX 8

/* Temperatures of the hottest winding and of the hottest switch. */
typedef struct {
    double winding_C, switch_C;
} oracle_heat_t;

/* What is read of the drive. */
typedef struct {
    uint8_t state;                                /* initialise, ready, run, fault */
    uint8_t fault;                                /* first cause, number of drive.dbc */
    uint32_t checks;                              /* failed ones of the tick that latched it */
    uint32_t angle;                               /* of the encoder by the last measurement, 2^-32 rev */
    double current[HAL_PHASES_MAX], link_voltage; /* then, of the full scales of their sensors */
    oracle_heat_t heat;                           /* measured */
} oracle_drive_t;

/* Motion at a steady speed, over which the error of the measured angle is averaged. */
typedef struct {
    uint64_t settled_ns; /* not before, after the speed has changed */
    unsigned samples;    /* 0: begins with the next one */
    uint64_t begin_ns;
    double begin_counts; /* of the encoder, continued over revolutions */
    double speed_rad_s;  /* at the begin */
    double error_counts; /* sum, positive: ahead in the direction of counting */
} oracle_stretch_t;

/* A rotor that stays within a range of angles. */
typedef struct {
    uint64_t since_ns; /* 0: no speed is commanded */
    double low_rad, high_rad;
} oracle_stay_t;

/* Of what has to be noticed. */
typedef struct {
    uint64_t looked_ns, misled_ns, lost_ns, status_ns;
    oracle_stay_t held, swinging, within_pitch;
    bool swings;                     /* within a rotor pitch for as long as a rotor that is stalled */
    uint64_t stroke_ns;              /* the rotor was last a stroke from where it had been, */
    double stroke_rad;               /* here */
    double largest_flux_Wb;          /* aligned, at the trip current */
    double flux_Wb[HAL_PHASES_MAX];  /* applied to a phase without any current, V s, */
    double pulse_Wb[HAL_PHASES_MAX]; /* by the present pulse, which the opposite voltage ends */
} oracle_detection_t;

/* Torque in torque mode, over at least an electrical period. */
typedef struct {
    unsigned samples; /* 0: begins with the next one */
    uint64_t begin_ns;
    double begin_angle_rad, sum_Nm;
} oracle_torque_t;

/* Speed over 50 ms and a revolution. */
typedef struct {
    uint64_t begin_ns; /* 0: begins with the next sample */
    double begin_angle_rad;
} oracle_speed_t;

/* Torque in telemetry and the true one, over at least two electrical periods. */
typedef struct {
    unsigned frames, samples;
    double estimate_sum_Nm, true_sum_Nm, least_Nm, most_Nm, begin_angle_rad;
} oracle_torque_telemetry_t;

/* Least and largest value in the present and in the previous window of time. */
typedef struct {
    double low[2], high[2];
} oracle_range_t;

/* Of what telemetry is compared with. */
typedef struct {
    uint64_t window_ns;                                          /* the present one began */
    oracle_range_t current[HAL_PHASES_MAX], link_voltage;        /* measured, of the full scales */
    oracle_range_t speed_rad_s;                                  /* true */
    double fault_speed_rad_s, fault_link_voltage, fault_current; /* when the last fault was latched */
    bool ran;                                                    /* for long when it was */
    double angle_rad;                                            /* of the rotor */
    oracle_torque_telemetry_t torque;
    uint64_t limit_window_ns, limit_ns; /* the present window began, the last limit of the torque came */
    oracle_range_t limit_Nm;
} oracle_telemetry_t;

typedef struct {
    const char *rule;
    uint64_t time_us;
    unsigned number; /* cause or phase */
    double value;
} oracle_violation_t;

typedef struct {
    const world_t *world;
    uint64_t period_ns;
    bool bus_disturbed;                 /* loaded, cut or shared with another sender at any time */
    const world_event_t *limited;       /* the limit of the torque that the client sets; NULL: none */
    uint32_t limit_bits, constant_bits; /* of the drive's memory: a change of a higher one has no effect */
    unsigned violations;
    oracle_violation_t violation[ORACLE_VIOLATIONS_MAX];
    unsigned causes;
    uint8_t cause[ORACLE_CAUSES_MAX]; /* first causes in their order */
    uint64_t cause_us;                /* of the first one; 0: none */
    uint64_t dark_ns;                 /* since then no gate has been on; 0: one is */
    bool injected[ORACLE_KINDS];      /* kinds of faults that have begun */
    uint8_t cell[ORACLE_CELLS / 8];
    /* Private. */
    oracle_drive_t drive;
    uint64_t state_ns; /* since when the drive has its state */
    uint64_t interrupt_ns;
    bool confirmed, commanded, off_seen, clear_seen;
    bool unacknowledged; /* a reset by the watchdog, without a genuine request to clear since */
    bool succeeded;      /* the first sender by the second one, whose counter is in sequence by chance */
    uint64_t run_ns, off_ns, speed_ns, voltage_ns, low_ns;
    uint64_t clear_ns, latched_ns;   /* a request to clear began, the last fault */
    uint32_t latched_angle;          /* measured then */
    bool counted;                    /* it has changed since */
    double silence_torque_Nm;        /* largest torque before the client has been silent for 55 ms */
    sender_meaning_t meant;          /* by the last genuine motion command */
    uint64_t withdrawn_ns, reset_ns; /* last genuine request other than run, last reset */
    uint64_t cause_ns;               /* last time at which the plant had a reason to keep the drive in a fault, */
    uint64_t cause_begin_ns;         /* which it has had since */
    uint64_t stop_ns, constant_ns;   /* since then stopping, since then one command */
    double begin_speed_rad_s;        /* then, or at the start of a run since */
    double stop_speed_rad_s;         /* when the stop began */
    oracle_detection_t detection;
    oracle_torque_t torque, any_torque; /* in torque mode; in any, over 20 ms */
    double mean_torque_Nm;              /* largest since the last limit in telemetry */
    oracle_speed_t speed;
    unsigned applied;     /* sets of parameters in effect */
    uint64_t applied_ns;  /* the last of them was applied */
    uint64_t saved_ns;    /* they were saved; 0: not */
    uint64_t forwards_ns; /* since then a torque forwards against a reference backwards */
    oracle_telemetry_t telemetry;
    unsigned over_current_looks;
    double speed_recent_rad_s, voltage_recent_high_V, voltage_recent_low_V, current_recent_A;
    uint64_t recent_ns;
    double run_angle_rad;                                                 /* of the rotor at the start of the run */
    bool turned;                                                          /* by a stroke since */
    uint64_t conducting_ns[HAL_PHASES_MAX], conducted_ns[HAL_PHASES_MAX]; /* since when, last for long enough */
    uint64_t fault_ns;                                                    /* the last fault began or ended */
    double encoder_offset_rev;                                            /* on the shaft, in counting direction */
    oracle_stretch_t stretch;
    /* Recovery. */
    double recovery_rpm;
    uint64_t settle_by_ns, in_band_ns;
    bool recovery_judged, recovered, settled;
    double recovery_angle_rad; /* of the rotor, when it began to run again */
    unsigned used;             /* bit of each phase with a gate on since */
    bool surged; /* a current of twice the trip flowed: what it heats has to cool, by the drive's reckoning */
    bool held;   /* at rest by an encoder that does not count: not judged, but counted */
} oracle_t;

void oracle_init(oracle_t *oracle, const world_t *world, const plant_t *plant, uint64_t period_ns);

/* At each ORACLE_LOOK_NS of virtual time, from plant_observe. */
void oracle_look(oracle_t *oracle, const plant_t *plant);

/* After each control interrupt. */
void oracle_after_interrupt(oracle_t *oracle, const plant_t *plant, oracle_drive_t drive);

/* The drive was reset. */
void oracle_reset(oracle_t *oracle, uint64_t time_ns, oracle_drive_t drive);

/* Events of the sender. */
void oracle_on_bus(oracle_t *oracle, const plant_t *plant, uint64_t time_ns, const sender_meaning_t *meaning);
void oracle_on_status(oracle_t *oracle, uint64_t time_ns, unsigned state, unsigned fault); /* DRIVE_STATUS */
void oracle_on_telemetry(oracle_t *oracle, uint64_t time_ns, unsigned identifier, const uint8_t data[8]);
void oracle_on_fault(oracle_t *oracle, const plant_t *plant, unsigned kind, bool begins);

/* At the begin of the recovery: the speed to be commanded, r/min. */
double oracle_recovery_speed_rpm(oracle_t *oracle, const plant_t *plant);

/* At the end. */
void oracle_finish(oracle_t *oracle, const plant_t *plant, oracle_heat_t heat);

#endif
