#include "plant/sensors.h"

#include <math.h>
#include <string.h>

#include "plant/magnetics_kernel.h"

#define ENCODER_BITS_IDEAL 32
#define TURN_RAD 6.28318530717958647692

void sensors_init(sensors_t *sensors, const sensor_errors_t *errors, unsigned encoder_bits, unsigned adc_bits,
                  uint64_t seed) {
    memset(sensors, 0, sizeof *sensors);
    sensors->errors = *errors;
    sensors->encoder_bits = encoder_bits == 0 ? ENCODER_BITS_IDEAL : encoder_bits;
    sensors->adc_bits = adc_bits;
    sensors->random_state = seed;
}

void sensors_hold_currents(sensors_t *sensors, const plant_t *plant) {
    memcpy(sensors->held_current_A, plant->current_A, sizeof sensors->held_current_A);
    sensors->currents_held = true;
}

/* splitmix64 (G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014). */
static uint64_t next_random(uint64_t *state) {
    *state += UINT64_C(0x9E3779B97F4A7C15);
    uint64_t z = *state;
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return z ^ (z >> 31);
}

/* Mean 0, standard deviation 1, as the sum of twelve uniform 16-bit numbers: Gaussian out to four deviations, at most
 * six, and without libm, so that the bits are the same everywhere. */
static double next_gaussian(uint64_t *state) {
    int64_t sum = 0;
    for (unsigned draw = 0; draw < 3; draw++) {
        const uint64_t bits = next_random(state);
        for (unsigned part = 0; part < 4; part++) {
            sum += (int64_t)((bits >> (16 * part)) & 0xFFFF);
        }
    }
    return ((double)sum - 12.0 * 32767.5) / 65536.0;
}

/* Nearest code of a fraction of full scale, half a code upwards; written so that a NaN gives 0. */
static uint16_t to_code(const sensors_t *sensors, double fraction) {
    if (!(fraction > 0.0)) {
        return 0;
    }
    const double full_scale = (double)(UINT32_C(1) << sensors->adc_bits);
    const double counts = fraction * full_scale, largest = full_scale - 1.0;
    return counts >= largest ? (uint16_t)largest : (uint16_t)(counts + 0.5);
}

/* What the sensor puts out; written so that a NaN stays one. */
static double sensed_current_A(sensors_t *sensors, double true_A) {
    const sensor_errors_t *errors = &sensors->errors;
    double current_A = true_A * errors->current_gain + errors->current_offset_A;
    if (errors->current_noise_A > 0.0) {
        current_A += errors->current_noise_A * next_gaussian(&sensors->random_state);
    }
    if (current_A > errors->current_limit_A) {
        return errors->current_limit_A;
    }
    return current_A < -errors->current_limit_A ? -errors->current_limit_A : current_A;
}

void sensors_sample_adc(sensors_t *sensors, const plant_t *plant, hal_adc_sample_t *sample) {
    memset(sample, 0, sizeof *sample);
    const double *true_A = sensors->currents_held ? sensors->held_current_A : plant->current_A;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        sample->phase_current_counts[phase] =
            to_code(sensors, sensed_current_A(sensors, true_A[phase]) * (1.0 / HAL_ADC_CURRENT_FULL_SCALE_A));
    }
    sample->bus_voltage_counts = to_code(sensors, plant->bus_voltage_V * (1.0 / HAL_ADC_BUS_FULL_SCALE_V));
    sample->load_torque_counts =
        to_code(sensors, 0.5 + plant->load_torque_Nm * (0.5 / HAL_ADC_LOAD_TORQUE_FULL_SCALE_NM));
}

static uint32_t latched_counts(sensors_t *sensors, const plant_t *plant) {
    if (sensors->encoder_fault == SENSORS_ENCODER_FROZEN) {
        return sensors->encoder_last_counts;
    }
    const uint64_t counts_per_turn = UINT64_C(1) << sensors->encoder_bits;
    double turns = plant->rotor_angle_rad / TURN_RAD;
    if (sensors->errors.encoder_eccentricity_deg != 0.0) {
        double sine, cosine;
        magnetics_kernel_sine_cosine((turns - floor(turns + 0.5)) * TURN_RAD, &sine, &cosine);
        turns += sensors->errors.encoder_eccentricity_deg / 360.0 * sine;
    }
    /* A tiny negative angle is rounded up to a whole turn here: the mask makes that count 0. */
    uint64_t counts = (uint64_t)((turns - floor(turns)) * (double)counts_per_turn);
    if (sensors->encoder_fault == SENSORS_ENCODER_JUMP) {
        counts += counts_per_turn / 2;
    }
    sensors->encoder_last_counts = (uint32_t)(counts & (counts_per_turn - 1));
    return sensors->encoder_last_counts;
}

void sensors_sample_encoder(sensors_t *sensors, const plant_t *plant, hal_encoder_sample_t *sample) {
    *sample = (hal_encoder_sample_t){.edge_known = false};
    sample->counts = latched_counts(sensors, plant);
}
