/* Sensors between plant and firmware: converter counts of currents and bus voltage, encoder counts, their errors and
 * their faults.
 *
 * Current, in the order of the chain: the phase current of `current_delay_ns` before the sampling instant (the plain
 * delay of an isolated amplifier or a filter well below its corner), times the gain, plus offset, plus Gaussian noise,
 * limited to +-`current_limit_A` (the sensor saturates), then the converter. Bus voltage and load torque have no
 * errors; the torque transducer between machine and load shows the load's torque.
 *
 * Encoder: the angle read is theta + e sin(theta), then its floor in counts. This is a code disc whose centre is off
 * the axis by e (in rad) times the radius at which it is read, and at theta = 0 off towards the reading head: seen from
 * the disc's centre the head lies at -theta - e sin(theta), to first order in e; the familiar angular error of
 * eccentricity / radius. `encoder_offset_deg` is added: an encoder, or a table of angles, that is aligned wrongly.
 *
 * Edges of the encoder are what the angle read does at the counts' boundaries between two latches, the rotor's motion
 * there being the cubic through angle and speed of both: within 0.001 urad of the plant's at 40 kHz. The rotor may turn
 * round once between two latches. A frozen encoder has no edges, and a jump or a change of offset or eccentricity is
 * none: when the reading is elsewhere without having moved there, the last edge is forgotten.
 *
 * Scales are hal_adc.h's. A code is the nearest one (half a code upwards), limited to 0..2^bits-1: the converter is
 * unipolar, below 0 A it shows 0. Encoder counts are modulo a turn, for negative angles too.
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

/* Values are rig.dbc's. */
typedef enum {
    SENSORS_ENCODER_HEALTHY = 0,
    SENSORS_ENCODER_FROZEN = 1,
    SENSORS_ENCODER_JUMP = 2
} sensors_encoder_fault_t;

typedef struct {
    /* Settings; write at any time. */
    sensor_errors_t errors; /* the delay is kept by whoever calls sensors_hold_currents */
    sensors_encoder_fault_t encoder_fault;
    double encoder_offset_deg; /* mechanical */
    bool encoder_edges;        /* the board captures edges; false after sensors_init */

    /* What is converted instead of the plant's present currents while `currents_held`; clear it to let go. */
    bool currents_held;
    double held_current_A[HAL_PHASES_MAX];

    unsigned adc_bits, encoder_bits; /* read only */

    /* The rest is sensors.c's. */
    uint32_t encoder_last_counts;
    struct {
        bool known, forward;
        int64_t boundary; /* its number, counted on from turn to turn */
        double time_ns;
    } edge;
    bool latched; /* the state of the latch before, from here: there was one */
    double latch_time_ns, latch_angle_rad, latch_speed_rad_s;
    uint64_t random_state;
} sensors_t;

/* Sensors with these errors and without faults. encoder_bits 8..32, 0 means ideal (32); adc_bits 12..16. Equal seeds
 * give equal noise. */
void sensors_init(sensors_t *sensors, const sensor_errors_t *errors, unsigned encoder_bits, unsigned adc_bits,
                  uint64_t seed);

/* Holds the plant's present currents for the next conversion: call it `errors.current_delay_ns` before that. */
void sensors_hold_currents(sensors_t *sensors, const plant_t *plant);

/* Converts the held currents, or else the plant's present ones, and its present bus voltage and load torque:
 * unused phases read 0. Noise moves on by one draw a phase when it is on. */
void sensors_sample_adc(sensors_t *sensors, const plant_t *plant, hal_adc_sample_t *sample);

/* Latches the encoder; each control period, for edges are looked for since the latch before. Frozen: the count latched
 * last; jump: half a turn off as long as it is set. */
void sensors_sample_encoder(sensors_t *sensors, const plant_t *plant, hal_encoder_sample_t *sample);

#endif
