/* What the drive reports by itself: a cycle of measurements every millisecond, slower frames between.
 *
 *   every 1 ms    DRIVE_STATUS, DRIVE_MOTION, DRIVE_TORQUE, DRIVE_CURRENTS
 *   every 10 ms   DRIVE_BP_PID, DRIVE_TRIM
 *   every 100 ms  DRIVE_COMMAND_COUNTERS, DRIVE_BUS_COUNTERS, DRIVE_PROCESSOR, DRIVE_HEARTBEAT
 *   in fault      DRIVE_FAULT_CAUSE, DRIVE_FAULT_SNAPSHOT in the cycle after the fault and every 100 ms from there
 *
 * The first cycle after start has everything. Frames wait in a queue for one of the three mailboxes. Frames that belong
 * together (a line above; those of 10 ms go with their cycle) are queued together or, when the queue has no room for
 * all of them, dropped together and counted: what waits stays whole and in order, what is missing shows in the cycle
 * number.
 *
 * The heartbeat has the highest identifier on the bus. While other nodes hold it back it keeps a mailbox, so there is
 * never more than one: the next is dropped and counted until the last is seen to have left.
 */
#ifndef COMMS_TELEMETRY_H
#define COMMS_TELEMETRY_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/commands.h"
#include "comms/frame_queue.h"
#include "drive/fault.h"
#include "hal_can.h"

#define TELEMETRY_CYCLE_US 1000
#define TELEMETRY_PHASES 4 /* current signals of DRIVE_CURRENTS */

/* The drive at one moment; formats as in comms/units.h. Values beyond the range of their signal are held at its end. */
typedef struct {
    uint32_t time_us;
    uint8_t state;      /* as DRIVE_STATUS.state */
    uint8_t controller; /* as DRIVE_STATUS.controller */
    uint8_t fault;      /* the cause while in fault, else 0 */
    bool voltage_saturated;
    int32_t speed_q22;
    int32_t speed_reference_q22;
    uint32_t rotor_angle; /* 2^-32 turn */
    int32_t torque_reference_q24;
    int32_t torque_estimate_q24;
    int32_t load_torque_estimate_q24;
    uint16_t bus_voltage_q6;
    uint16_t current_q9[TELEMETRY_PHASES];
    int32_t kp_q15; /* 1/(N m), 0..65535 */
    int32_t ki_q15;
    int32_t kd_q15;
    int32_t duty_q15; /* -32768..32767 */
    /* Of the salient controller, 0 by the others. */
    int32_t trim_torque_q24;           /* what the BP-PID adds to the torque reference */
    int32_t misalignment;              /* 2^-32 turn */
    int32_t torque_missing_q24;        /* reference less what the voltage can reach */
    uint16_t observer_bandwidth_rad_s; /* at this moment */
    /* The control interrupt's time on the processor, HAL_PWM_TICK_NS. */
    uint32_t used_ticks;       /* of the last one */
    uint32_t worst_ticks;      /* of the longest since start */
    uint32_t available_ticks;  /* the control period */
    uint32_t late_interrupts;  /* since start */
    fault_record_t last_fault; /* sent while state is fault */
} telemetry_snapshot_t;

typedef struct {
    uint8_t phases;
    uint32_t control_rate_hz;
    uint32_t next_us; /* when the next cycle is due */
    uint8_t cycle;    /* number of the next cycle */
    uint8_t laws_in;  /* cycles until each is due */
    uint8_t heartbeat_in;
    uint8_t fault_in;
    bool in_fault;
    uint32_t fault_time_us;    /* of the fault reported last */
    bool heartbeat_in_mailbox; /* for all that is known */
    uint16_t dropped;          /* frames, since start; holds at 65535 */
    frame_queue_t queue;
} telemetry_t;

/* The first cycle is due at time_us. phases 1..4, control_rate_hz as in DRIVE_HEARTBEAT. */
void telemetry_init(telemetry_t *telemetry, uint8_t phases, uint32_t control_rate_hz, uint32_t time_us);

/* Whether a cycle is due. */
static inline bool telemetry_due(const telemetry_t *telemetry, uint32_t time_us) {
    return (int32_t)(time_us - telemetry->next_us) >= 0;
}

/* Queues the frames of one cycle and sets the time of the next one on the millisecond grid that began at start; cycles
 * that were missed altogether are left out, but counted in the cycle number. [background] */
void telemetry_cycle(telemetry_t *telemetry, const telemetry_snapshot_t *snapshot, const commands_counters_t *counters,
                     uint32_t receive_overflows);

/* Moves waiting frames to the mailboxes until those are taken. [background] */
void telemetry_flush(telemetry_t *telemetry, hal_t *hal);

#endif
