/* Sensors between plant and firmware: converter counts of currents and bus voltage, encoder counts, their faults.
 *
 * Scales are hal_adc.h's. A code is the nearest one (half a code upwards), limited to 0..4095. Encoder counts are the
 * angle's floor, modulo a turn, for negative angles too.
 */
#ifndef PLANT_SENSORS_H
#define PLANT_SENSORS_H

#include <stdint.h>

#include "hal.h"
#include "hal_adc.h"
#include "plant/plant.h"

/* Values are rig.dbc's. */
typedef enum {
    SENSORS_ENCODER_HEALTHY = 0,
    SENSORS_ENCODER_FROZEN = 1,
    SENSORS_ENCODER_JUMP = 2
} sensors_encoder_fault_t;

typedef struct {
    /* Settings; write at any time. */
    double current_gain[HAL_PHASES_MAX]; /* 1 is right */
    double current_noise_A;              /* standard deviation; 0 is off */
    sensors_encoder_fault_t encoder_fault;

    /* The rest is sensors.c's. */
    unsigned encoder_bits;
    uint32_t encoder_last_counts;
    uint64_t random_state;
} sensors_t;

/* Healthy, noiseless sensors. encoder_bits 8..32, 0 means ideal (32). Equal seeds give equal noise. */
void sensors_init(sensors_t *sensors, unsigned encoder_bits, uint64_t seed);

/* Converts the plant's present state: unused phases read 0. Noise moves on by one draw a phase when it is on. */
void sensors_sample_adc(sensors_t *sensors, const plant_t *plant, hal_adc_sample_t *sample);

/* Latches the encoder: 0..2^bits-1. Frozen: the count latched last; jump: half a turn off as long as it is set. */
uint32_t sensors_sample_encoder(sensors_t *sensors, const plant_t *plant);

#endif
