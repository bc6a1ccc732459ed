/* What the parts of the oracle share: what has happened in the world so far, and their doors to each other. */
#ifndef CAMPAIGN_ORACLE_PARTS_H
#define CAMPAIGN_ORACLE_PARTS_H

#include "campaign/oracle.h"

#define ORACLE_RPM_PER_RAD_S (30.0 / 3.14159265358979323846)
#define ORACLE_TWO_PI (2.0 * 3.14159265358979323846)
#define ORACLE_MS_NS UINT64_C(1000000)
#define ORACLE_STALLED_NS (200 * ORACLE_MS_NS)

/* Numbers of drive.dbc. */
enum { STATE_INITIALISE, STATE_READY, STATE_RUN, STATE_FAULT };

enum {
    CAUSE_OVER_CURRENT = 1,
    CAUSE_OVER_VOLTAGE,
    CAUSE_UNDER_VOLTAGE,
    CAUSE_OVER_SPEED,
    CAUSE_ENCODER,
    CAUSE_COMMAND_TIMEOUT,
    CAUSE_INTERRUPT_OVERRUN,
    CAUSE_COMMAND_ERROR,
    CAUSE_IDENTIFIER_CONFLICT,
    CAUSE_PARAMETER_MEMORY,
    CAUSE_HARDWARE_OVER_CURRENT,
    CAUSE_STO,
    CAUSE_STO_DISCREPANCY,
    CAUSE_STALL,
    CAUSE_CURRENT_SENSOR,
    CAUSE_PHASE_OPEN,
    CAUSE_PHASE_SHORTED,
    CAUSE_ENCODER_ANGLE,
    CAUSE_WINDING_OVERLOAD,
    CAUSE_INVERTER_OVERLOAD,
    CAUSE_TEMPERATURE_SENSOR,
    CAUSE_WATCHDOG,
    CAUSE_MEMORY,
    CAUSE_CODE,
    CAUSE_CLOCK,
};

#define BIT(cause) (UINT32_C(1) << (cause))

/* Remembers a violation, once for each rule and number. */
void oracle_violate(oracle_t *oracle, const char *rule, uint64_t time_ns, unsigned number, double value);

/* Sets the begin of a condition: the time now when it begins to hold, 0 when it does not hold. */
void oracle_since(uint64_t *begin_ns, bool holds, uint64_t now_ns);

/* --- History --- */

/* A fault of a kind between first and last, both included, has begun. */
bool oracle_any_injected(const oracle_t *oracle, unsigned first, unsigned last);

/* An event that sets the bench variable has begun, whether or not it is over. */
bool oracle_variable_begun(const oracle_t *oracle, unsigned variable, uint64_t time_us);

/* A second sender of valid frames; with a hostile one as well when its frames may be in the way of others. */
bool oracle_other_sender(const oracle_t *oracle, bool hostile, uint64_t time_us);

/* The event is a load that steps or ramps; the amplitude of a sine. */
bool oracle_is_load(const world_event_t *event);
bool oracle_is_load_sine(const world_event_t *event);

/* Rotation from a phase to the next one. */
double oracle_stroke_rad(const plant_t *plant);

/* A load drives the machine in the direction of a speed at any time. */
bool oracle_overhauled(const oracle_t *oracle, double speed);

/* Reads from the world what it does not change in its course. */
void oracle_read_world(oracle_t *oracle);

/* Both sets of a client that limits the torque are. */
bool oracle_sets_in_effect(const oracle_t *oracle);

/* The torque that the drive has at least for a change of the speed. */
double oracle_torque_max_Nm(const oracle_t *oracle);

/* A mean torque above a limit. */
void oracle_judge_limit(oracle_t *oracle, uint64_t time_ns, double mean_Nm, double limit_Nm);

/* The commanded speed is one that the drive turns at. */
bool oracle_can_turn(const oracle_t *oracle);

/* The state of the drive, or what it takes for it, was changed from outside. */
bool oracle_state_changed(const oracle_t *oracle);

/* Interrupts come late, or memory or clock of the drive was changed. */
bool oracle_drive_disturbed(const oracle_t *oracle, uint64_t time_us);

/* The encoder was faulty at any time. */
bool oracle_encoder_faulty(const oracle_t *oracle);

/* The only sensor of the link voltage was faulty at any time. */
bool oracle_link_sensor_faulty(const oracle_t *oracle);

/* --- Measurement --- */

/* Of the encoder on the shaft. */
double oracle_encoder_offset_rev(const world_t *world);

/* At the instant of the samples of a control interrupt, after it. */
void oracle_look_at_measurement(oracle_t *oracle, const plant_t *plant);

/* At the end. */
void oracle_judge_temperature(oracle_t *oracle, const plant_t *plant, oracle_heat_t heat);

/* --- Telemetry --- */

/* Part of the largest torque that temperatures of the hottest winding and of the hottest switch leave, 0..1. */
double oracle_cool_part(double winding_C, double switch_C);

/* After each control interrupt. */
void oracle_remember_measurement(oracle_t *oracle, const plant_t *plant);

/* In that which has latched a fault. */
void oracle_remember_fault(oracle_t *oracle, const plant_t *plant);

/* --- Detection --- */

/* At each look. */
void oracle_look_at_detection(oracle_t *oracle, const plant_t *plant);

/* --- Motion --- */

/* After each control interrupt. */
void oracle_look_at_motion(oracle_t *oracle, const plant_t *plant);

/* --- First causes --- */

/* Bit of each phase with a fault of its own in the last quarter of a second: its current is not the drive's alone. */
unsigned oracle_phases_at_fault(const oracle_t *oracle, uint64_t now_us);

/* The drive has latched a fault: wrong_cause or false_alarm. */
void oracle_judge_cause(oracle_t *oracle, const plant_t *plant);

/* --- Recovery --- */

void oracle_look_at_recovery(oracle_t *oracle, const plant_t *plant);

/* Speed that a drive of one quadrant cannot take away: what the torque limit adds in three periods, while the speed is
 * observed and while the voltage removes the largest flux linkage. */
double oracle_added_rad_s(const oracle_t *oracle, const plant_t *plant);

/* The drive has begun to run. */
void oracle_enter_run(oracle_t *oracle, const plant_t *plant);

#endif
