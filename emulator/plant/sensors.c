#include "plant/sensors.h"

#include <math.h>
#include <string.h>

#include "hal_pwm.h"
#include "plant/magnetics_kernel.h"

#define ENCODER_BITS_IDEAL 32
#define TURN_RAD 6.28318530717958647692

/* When the encoder passes a boundary. */
#define CROSSING_TOLERANCE_S 1e-12
#define CROSSING_ITERATIONS 60

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

/* --- Encoder --- */

/* The angle read when the rotor is at an angle, in turns, not wrapped. */
static double read_turns(const sensors_t *sensors, double rotor_angle_rad) {
    double turns = rotor_angle_rad / TURN_RAD;
    if (sensors->errors.encoder_eccentricity_deg != 0.0) {
        double sine, cosine;
        magnetics_kernel_sine_cosine((turns - floor(turns + 0.5)) * TURN_RAD, &sine, &cosine);
        turns += sensors->errors.encoder_eccentricity_deg / 360.0 * sine;
    }
    return turns + sensors->encoder_offset_deg / 360.0;
}

static double counts_per_turn(const sensors_t *sensors) {
    return (double)(UINT64_C(1) << sensors->encoder_bits);
}

/* The count of a reading, counted on from turn to turn. */
static int64_t position_of(const sensors_t *sensors, double turns) {
    /* A tiny negative angle is rounded up to a whole turn here, which makes its count 0. */
    const double whole = floor(turns), scale = counts_per_turn(sensors);
    return (int64_t)whole * (int64_t)scale + (int64_t)((turns - whole) * scale);
}

/* The rotor between two latches: the cubic through angle and speed at both ends. Time x from 0 to 1. */
typedef struct {
    double length_s;
    double start_rad, start_rad_s, end_rad, end_rad_s;
} motion_t;

static double motion_angle_rad(const motion_t *motion, double x) {
    const double y = 1.0 - x;
    return y * y * (motion->start_rad * (1.0 + 2.0 * x) + motion->length_s * x * motion->start_rad_s) +
           x * x * (motion->end_rad * (1.0 + 2.0 * y) - motion->length_s * y * motion->end_rad_s);
}

/* When the reading passes a boundary between `from` and `to`, where it lies on different sides: false position in the
 * Illinois variant, to less than a thousandth of a nanosecond. */
static double crossing(const sensors_t *sensors, const motion_t *motion, double from, double to, int64_t boundary) {
    const double wanted_turns = (double)boundary / counts_per_turn(sensors);
    double before = read_turns(sensors, motion_angle_rad(motion, from)) - wanted_turns;
    double after = read_turns(sensors, motion_angle_rad(motion, to)) - wanted_turns;
    double at = to;
    int last_side = 0;
    for (unsigned iteration = 0; iteration < CROSSING_ITERATIONS && before != after; iteration++) {
        const double previous = at;
        at = fmin(fmax(from + (to - from) * (before / (before - after)), from), to); /* not beyond, by rounding */
        const double value = read_turns(sensors, motion_angle_rad(motion, at)) - wanted_turns;
        if (value == 0.0 || fabs(at - previous) * motion->length_s < CROSSING_TOLERANCE_S) {
            break;
        }
        if ((value > 0.0) == (after > 0.0)) {
            to = at;
            after = value;
            before *= last_side < 0 ? 0.5 : 1.0;
            last_side = -1;
        } else {
            from = at;
            before = value;
            after *= last_side > 0 ? 0.5 : 1.0;
            last_side = 1;
        }
    }
    return at;
}

/* Where between the latches the speed is zero, when it has different signs there: the cubic's speed is a parabola. */
static double turning_point(const motion_t *motion) {
    const double mean_rad_s = (motion->end_rad - motion->start_rad) / motion->length_s;
    const double a = 3.0 * (motion->start_rad_s + motion->end_rad_s - 2.0 * mean_rad_s);
    const double b = 2.0 * (3.0 * mean_rad_s - 2.0 * motion->start_rad_s - motion->end_rad_s);
    const double c = motion->start_rad_s;
    /* Of a x^2 + b x + c the root between 0 and 1, in the form that a = 0 leaves whole. */
    const double root = sqrt(fmax(b * b - 4.0 * a * c, 0.0));
    const double q = -0.5 * (b + copysign(root, b));
    const double first = q != 0.0 ? c / q : 0.5;
    return first >= 0.0 && first <= 1.0 ? first : fmin(fmax(q / a, 0.0), 1.0);
}

/* Looks for the last edge on a piece of the motion that goes one way, from position p0 to p1. */
static void find_edge(sensors_t *sensors, const motion_t *motion, double from, double to, int64_t p0, int64_t p1) {
    if (p0 == p1) {
        return;
    }
    sensors->edge.known = true;
    sensors->edge.forward = p1 > p0;
    sensors->edge.boundary = p1 > p0 ? p1 : p1 + 1;
    sensors->edge.time_ns =
        sensors->latch_time_ns + crossing(sensors, motion, from, to, sensors->edge.boundary) * motion->length_s * 1e9;
}

/* The edges since the latch before, up to now at position p1. */
static void capture_edges(sensors_t *sensors, const plant_t *plant, int64_t p1) {
    const double now_ns = (double)plant->time_ns;
    if (sensors->latched) {
        const int64_t p0 = position_of(sensors, read_turns(sensors, sensors->latch_angle_rad));
        const motion_t motion = {(now_ns - sensors->latch_time_ns) * 1e-9, sensors->latch_angle_rad,
                                 sensors->latch_speed_rad_s, plant->rotor_angle_rad, plant->speed_rad_s};
        if (motion.length_s > 0.0) {
            double turn = 0.0;
            int64_t turned = p0;
            if (motion.start_rad_s * motion.end_rad_s < 0.0) {
                turn = turning_point(&motion);
                turned = position_of(sensors, read_turns(sensors, motion_angle_rad(&motion, turn)));
                find_edge(sensors, &motion, 0.0, turn, p0, turned);
            }
            find_edge(sensors, &motion, turn, 1.0, turned, p1);
        }
    }
    if (sensors->edge.boundary - (sensors->edge.forward ? 0 : 1) != p1) {
        sensors->edge.known = false; /* the reading came here without moving */
    }
    sensors->latched = true;
    sensors->latch_time_ns = now_ns;
    sensors->latch_angle_rad = plant->rotor_angle_rad;
    sensors->latch_speed_rad_s = plant->speed_rad_s;
}

static uint32_t edge_age_ticks(const sensors_t *sensors, const plant_t *plant) {
    const double ticks = ((double)plant->time_ns - sensors->edge.time_ns) / HAL_PWM_TICK_NS;
    return ticks >= (double)HAL_ENCODER_AGE_MAX_TICKS ? HAL_ENCODER_AGE_MAX_TICKS : (uint32_t)(fmax(ticks, 0.0) + 0.5);
}

void sensors_sample_encoder(sensors_t *sensors, const plant_t *plant, hal_encoder_sample_t *sample) {
    if (sensors->encoder_fault == SENSORS_ENCODER_FROZEN) {
        sensors->latched = false; /* what moves meanwhile is not seen */
    } else {
        const uint64_t turn = UINT64_C(1) << sensors->encoder_bits;
        const int64_t position = position_of(sensors, read_turns(sensors, plant->rotor_angle_rad));
        const uint64_t jump = sensors->encoder_fault == SENSORS_ENCODER_JUMP ? turn / 2 : 0;
        sensors->encoder_last_counts = (uint32_t)(((uint64_t)position + jump) & (turn - 1));
        if (sensors->encoder_edges) {
            capture_edges(sensors, plant, position);
        }
    }
    *sample = (hal_encoder_sample_t){.counts = sensors->encoder_last_counts};
    if (sensors->encoder_edges && sensors->edge.known) {
        sample->edge_known = true;
        sample->edge_forward = sensors->edge.forward;
        sample->edge_age_ticks = edge_age_ticks(sensors, plant);
    }
}
