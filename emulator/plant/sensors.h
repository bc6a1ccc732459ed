/* Sensors between plant and firmware: ADC counts of currents and DC-link voltage, encoder counts, errors and faults.
 *
 * Current, in the order of the signal chain: the phase current `current_delay_ns` before the sampling instant (the pure
 * delay of an isolated amplifier, or of a filter well below its corner frequency), times the gain, plus offset, plus
 * Gaussian noise, saturated at +-`current_limit_A`, then the ADC. DC-link voltage and load torque have no errors; the
 * torque transducer between machine and load measures the load torque.
 *
 * Encoder: the angle reading is theta + e sin(theta), and its floor in counts. It models a code disc whose centre is
 * off the axis by e (in rad) times the track radius, at theta = 0 towards the reading head: seen from the centre of the
 * disc the head is at -theta - e sin(theta), to first order in e; the well-known angle error of eccentricity / radius.
 * `encoder_offset_deg` is added: a misaligned encoder or angle table.
 *
 * Encoder edges are the times at which the angle reading crosses boundaries of counts between two latches, computed
 * with the cubic through angle and speed at both latches, which differs from the plant's motion by at most 0.001 urad
 * at 40 kHz. The rotor may reverse once between two latches. A frozen encoder has no edges. A jump and a change of
 * offset or eccentricity are no edges: when the reading has changed without a motion, the last edge is discarded.
 *
 * Full scales: machine.h. Counts are rounded to nearest (halves upwards) and clamped to 0..2^bits-1: the ADC is
 * unipolar and reads 0 below 0 A. Encoder counts are modulo one revolution, for negative angles too.
 */
#ifndef PLANT_SENSORS_H
#define PLANT_SENSORS_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"
#include "hal_adc.h"
#include "hal_encoder.h"
#include "plant/machine.h"
#include "plant/plant.h"

/* Values of rig.dbc. */
typedef enum {
    SENSORS_ENCODER_HEALTHY = 0,
    SENSORS_ENCODER_FROZEN = 1,
    SENSORS_ENCODER_JUMP = 2
} sensors_encoder_fault_t;

/* Fault of one analogue input; all zero: none. */
typedef struct {
    bool held; /* the converter reads `code`, at most its largest count */
    uint16_t code;
    bool scaled; /* gain and offset (in the sensor's unit) after the common ones of all sensors, before noise */
    double gain, offset;
} sensors_input_fault_t;

/* Faults of the encoder, several at once; all zero: none. `stuck`: the count of the instant at which it was set;
 * `no_answer`: all bits are 1. Neither has edges. The others change the angle reading, and with it the edges. */
typedef struct {
    bool stuck, no_answer;
    bool reversed;               /* from the reading at which it was set */
    double jump_deg, noise_deg;  /* noise: standard deviation, anew at each latch */
    double slip_deg_s;           /* from the time at which it was set */
    double lost_counts_per_turn; /* from the angle at which it was set, in either direction */
    bool shifted;                /* set by sensors_set_encoder_faults */
} sensors_encoder_faults_t;

typedef struct {
    /* Settings; write at any time. */
    sensor_errors_t errors; /* the caller of sensors_hold_currents implements the delay */
    sensors_encoder_fault_t encoder_fault;
    double encoder_offset_deg; /* mechanical */
    bool encoder_edges;        /* the board captures edges; false after sensors_init */
    sensors_input_fault_t current_fault[HAL_PHASES_MAX], dc_link_fault;
    unsigned current_line[HAL_PHASES_MAX]; /* phase whose sensor the input of a phase is connected to */

    /* Currents that are converted instead of the present ones while `currents_held`; clear it to return to those. */
    bool currents_held;
    double held_current_A[HAL_PHASES_MAX];

    unsigned adc_bits, encoder_bits; /* read only */

    /* Private to sensors.c. */
    uint32_t encoder_last_counts;
    struct {
        bool known, forward;
        int64_t boundary; /* number of the count above it, continued over revolutions */
        double time_ns;
    } edge;
    bool latched; /* the members below belong to the previous latch */
    double latch_time_ns, latch_angle_rad, latch_speed_rad_s;
    uint64_t random_state;
    struct {
        sensors_encoder_faults_t faults;
        uint64_t random_state, slip_from_ns;
        double reversed_at_rev, losing_from_rad, shift_rev;
    } encoder;
} sensors_t;

/* Initialises sensors with these errors and without faults. encoder_bits 8..32, 0 means ideal (32); adc_bits 12..16.
 * Equal seeds give equal noise. */
void sensors_init(sensors_t *sensors, const sensor_errors_t *errors, unsigned encoder_bits, unsigned adc_bits,
                  uint64_t seed);

/* Holds the present currents for the next conversion: call it `errors.current_delay_ns` before that. */
void sensors_hold_currents(sensors_t *sensors, const plant_t *plant);

/* Converts the held currents, or else the present ones, and the present DC-link voltage and load torque; unused phases
 * read 0. With noise, draws one random number per phase. */
void sensors_sample_adc(sensors_t *sensors, const plant_t *plant, hal_adc_sample_t *sample);

/* Changes the faults of the encoder at the time of the plant. */
void sensors_set_encoder_faults(sensors_t *sensors, const plant_t *plant, const sensors_encoder_faults_t *faults);

/* Latches the encoder. Call it in each control period: edges are found between two latches. Fault frozen: the count
 * latched last; jump: offset by half a revolution while it is set. */
void sensors_sample_encoder(sensors_t *sensors, const plant_t *plant, hal_encoder_sample_t *sample);

#endif
