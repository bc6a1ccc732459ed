#include "plant/sensors.h"

#include <math.h>
#include <string.h>

#include "plant/magnetics_kernel.h"
#include "plant/pwm_timer.h"
#include "plant/random.h"

#define ENCODER_BITS_IDEAL 32
#define REVOLUTION_RAD 6.28318530717958647692

/* Accuracy of the times at which the encoder passes a boundary. */
#define CROSSING_TOLERANCE_S 1e-12
#define CROSSING_ITERATIONS 60

void sensors_init(sensors_t *sensors, const sensor_errors_t *errors, unsigned encoder_bits, unsigned adc_bits,
                  uint64_t seed) {
    memset(sensors, 0, sizeof *sensors);
    sensors->errors = *errors;
    sensors->encoder_bits = encoder_bits == 0 ? ENCODER_BITS_IDEAL : encoder_bits;
    sensors->adc_bits = adc_bits;
    sensors->random_state = seed;
    sensors->encoder.random_state = ~seed;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        sensors->current_line[phase] = phase;
    }
}

void sensors_hold_currents(sensors_t *sensors, const plant_t *plant) {
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        sensors->held_current_A[phase] = plant_current_A(plant, phase);
    }
    sensors->currents_held = true;
}

/* Mean 0, standard deviation 1, as the sum of twelve uniform 16-bit numbers: Gaussian up to four deviations, limited to
 * six. Without libm, so that the bits are equal on every computer. */
static double next_gaussian(uint64_t *state) {
    int64_t sum = 0;
    for (unsigned draw = 0; draw < 3; draw++) {
        const uint64_t bits = random_next(state);
        for (unsigned part = 0; part < 4; part++) {
            sum += (int64_t)((bits >> (16 * part)) & 0xFFFF);
        }
    }
    return ((double)sum - 12.0 * 32767.5) / 65536.0;
}

/* Counts nearest to a fraction of full scale, halves upwards; 0 for a NaN. */
static uint16_t to_counts(const sensors_t *sensors, double fraction) {
    if (!(fraction > 0.0)) {
        return 0;
    }
    const double full_scale = (double)(UINT32_C(1) << sensors->adc_bits);
    const double counts = fraction * full_scale, largest = full_scale - 1.0;
    return counts >= largest ? (uint16_t)largest : (uint16_t)(counts + 0.5);
}

/* Output of the current sensor of a phase; NaN for a NaN. */
static double sensed_current_A(sensors_t *sensors, double true_A, const sensors_input_fault_t *fault) {
    const sensor_errors_t *errors = &sensors->errors;
    double current_A = true_A * errors->current_gain + errors->current_offset_A;
    if (fault->scaled) {
        current_A = current_A * fault->gain + fault->offset;
    }
    if (errors->current_noise_A > 0.0) {
        current_A += errors->current_noise_A * next_gaussian(&sensors->random_state);
    }
    if (current_A > errors->current_limit_A) {
        return errors->current_limit_A;
    }
    return current_A < -errors->current_limit_A ? -errors->current_limit_A : current_A;
}

/* Count of an input, or the one at which a fault holds it. */
static uint16_t held_counts(const sensors_t *sensors, const sensors_input_fault_t *fault, uint16_t counts) {
    const uint32_t largest = (UINT32_C(1) << sensors->adc_bits) - 1;
    return !fault->held ? counts : (uint16_t)(fault->code < largest ? fault->code : largest);
}

void sensors_sample_adc(sensors_t *sensors, const plant_t *plant, hal_adc_sample_t *sample) {
    memset(sample, 0, sizeof *sample);
    const sensor_ranges_t *ranges = &plant->machine->ranges;
    uint16_t counts[HAL_PHASES_MAX];
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const sensors_input_fault_t *fault = &sensors->current_fault[phase];
        const double true_A = sensors->currents_held ? sensors->held_current_A[phase] : plant_current_A(plant, phase);
        counts[phase] = held_counts(
            sensors, fault, to_counts(sensors, sensed_current_A(sensors, true_A, fault) * (1.0 / ranges->current_A)));
    }
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        sample->phase_current_counts[phase] = counts[sensors->current_line[phase]];
    }
    double link_V = plant->bus_voltage_V;
    if (sensors->dc_link_fault.scaled) {
        link_V = link_V * sensors->dc_link_fault.gain + sensors->dc_link_fault.offset;
    }
    sample->bus_voltage_counts =
        held_counts(sensors, &sensors->dc_link_fault, to_counts(sensors, link_V * (1.0 / ranges->dc_link_V)));
    sample->load_torque_counts =
        to_counts(sensors, 0.5 + plant_shaft_torque_Nm(plant) * (0.5 / ranges->load_torque_Nm));
}

/* --- Encoder --- */

/* Angle reading at a rotor angle, in revolutions, not wrapped. */
static double reading_rev(const sensors_t *sensors, double rotor_angle_rad) {
    double angle_rev = rotor_angle_rad / REVOLUTION_RAD;
    if (sensors->errors.encoder_eccentricity_deg != 0.0) {
        double sine, cosine;
        magnetics_kernel_sine_cosine((angle_rev - floor(angle_rev + 0.5)) * REVOLUTION_RAD, &sine, &cosine);
        angle_rev += sensors->errors.encoder_eccentricity_deg / 360.0 * sine;
    }
    angle_rev += sensors->encoder_offset_deg / 360.0;
    const sensors_encoder_faults_t *faults = &sensors->encoder.faults;
    if (faults->reversed) {
        angle_rev = 2.0 * sensors->encoder.reversed_at_rev - angle_rev;
    }
    if (faults->shifted) {
        angle_rev += sensors->encoder.shift_rev;
    }
    return angle_rev;
}

static double counts_per_rev(const sensors_t *sensors) {
    return (double)(UINT64_C(1) << sensors->encoder_bits);
}

/* Count of a reading, continued over revolutions. */
static int64_t position_of(const sensors_t *sensors, double angle_rev) {
    /* A tiny negative angle is rounded up to a whole revolution, count 0. */
    const double whole = floor(angle_rev), scale = counts_per_rev(sensors);
    return (int64_t)whole * (int64_t)scale + (int64_t)((angle_rev - whole) * scale);
}

/* Rotor angle between two latches: the cubic through angle and speed at both ends, over time x from 0 to 1. */
typedef struct {
    double length_s;
    double start_rad, start_rad_s, end_rad, end_rad_s;
} motion_t;

static double motion_angle_rad(const motion_t *motion, double x) {
    const double y = 1.0 - x;
    return y * y * (motion->start_rad * (1.0 + 2.0 * x) + motion->length_s * x * motion->start_rad_s) +
           x * x * (motion->end_rad * (1.0 + 2.0 * y) - motion->length_s * y * motion->end_rad_s);
}

/* Time x at which the reading passes a boundary between `from` and `to`, where it lies on different sides: Illinois
 * variant of the false position method, to CROSSING_TOLERANCE_S. */
static double crossing(const sensors_t *sensors, const motion_t *motion, double from, double to, int64_t boundary) {
    const double boundary_rev = (double)boundary / counts_per_rev(sensors);
    double before = reading_rev(sensors, motion_angle_rad(motion, from)) - boundary_rev;
    double after = reading_rev(sensors, motion_angle_rad(motion, to)) - boundary_rev;
    double at = to;
    int last_side = 0;
    for (unsigned iteration = 0; iteration < CROSSING_ITERATIONS && before != after; iteration++) {
        const double previous = at;
        at = fmin(fmax(from + (to - from) * (before / (before - after)), from),
                  to); /* rounding must not exceed the ends */
        const double value = reading_rev(sensors, motion_angle_rad(motion, at)) - boundary_rev;
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

/* Time x between the latches at which the speed is zero, for speeds of different signs at the two latches: the speed of
 * the cubic is a parabola. */
static double turning_point(const motion_t *motion) {
    const double mean_rad_s = (motion->end_rad - motion->start_rad) / motion->length_s;
    const double a = 3.0 * (motion->start_rad_s + motion->end_rad_s - 2.0 * mean_rad_s);
    const double b = 2.0 * (3.0 * mean_rad_s - 2.0 * motion->start_rad_s - motion->end_rad_s);
    const double c = motion->start_rad_s;
    /* Root of a x^2 + b x + c between 0 and 1, in the form that is valid for a = 0. */
    const double root = sqrt(fmax(b * b - 4.0 * a * c, 0.0));
    const double q = -0.5 * (b + copysign(root, b));
    const double first = q != 0.0 ? c / q : 0.5;
    return first >= 0.0 && first <= 1.0 ? first : fmin(fmax(q / a, 0.0), 1.0);
}

/* Finds the last edge of a part of the motion in one direction, from position p0 to p1. */
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

/* Finds the last edge between the previous latch and the present position p1. */
static void capture_edges(sensors_t *sensors, const plant_t *plant, int64_t p1) {
    const double now_ns = (double)plant->time_ns;
    if (sensors->latched) {
        const int64_t p0 = position_of(sensors, reading_rev(sensors, sensors->latch_angle_rad));
        const motion_t motion = {(now_ns - sensors->latch_time_ns) * 1e-9, sensors->latch_angle_rad,
                                 sensors->latch_speed_rad_s, plant->rotor_angle_rad, plant->speed_rad_s};
        if (motion.length_s > 0.0) {
            double reversal = 0.0;
            int64_t reversal_position = p0;
            if (motion.start_rad_s * motion.end_rad_s < 0.0) {
                reversal = turning_point(&motion);
                reversal_position = position_of(sensors, reading_rev(sensors, motion_angle_rad(&motion, reversal)));
                find_edge(sensors, &motion, 0.0, reversal, p0, reversal_position);
            }
            find_edge(sensors, &motion, reversal, 1.0, reversal_position, p1);
        }
    }
    if (sensors->edge.boundary - (sensors->edge.forward ? 0 : 1) != p1) {
        sensors->edge.known = false; /* the reading changed without a motion */
    }
    sensors->latched = true;
    sensors->latch_time_ns = now_ns;
    sensors->latch_angle_rad = plant->rotor_angle_rad;
    sensors->latch_speed_rad_s = plant->speed_rad_s;
}

static uint32_t edge_age_ticks(const sensors_t *sensors, const plant_t *plant) {
    const double ticks = ((double)plant->time_ns - sensors->edge.time_ns) / PWM_TIMER_TICK_REAL_NS;
    return ticks >= (double)HAL_ENCODER_AGE_MAX_TICKS ? HAL_ENCODER_AGE_MAX_TICKS : (uint32_t)(fmax(ticks, 0.0) + 0.5);
}

/* Shift of the reading at a latch, from the faults that move it. */
static double shift_rev(sensors_t *sensors, const plant_t *plant) {
    const sensors_encoder_faults_t *faults = &sensors->encoder.faults;
    const double slipped_s = (double)(plant->time_ns - sensors->encoder.slip_from_ns) * 1e-9;
    const double turns = fabs(plant->rotor_angle_rad - sensors->encoder.losing_from_rad) / REVOLUTION_RAD;
    double shift_deg = faults->jump_deg + faults->slip_deg_s * slipped_s;
    if (faults->noise_deg > 0.0) {
        shift_deg += faults->noise_deg * next_gaussian(&sensors->encoder.random_state);
    }
    return shift_deg / 360.0 - floor(turns * faults->lost_counts_per_turn) / counts_per_rev(sensors);
}

static uint32_t counts_of(const sensors_t *sensors, int64_t position) {
    const uint64_t revolution = UINT64_C(1) << sensors->encoder_bits;
    const uint64_t jump = sensors->encoder_fault == SENSORS_ENCODER_JUMP ? revolution / 2 : 0;
    return (uint32_t)(((uint64_t)position + jump) & (revolution - 1));
}

void sensors_set_encoder_faults(sensors_t *sensors, const plant_t *plant, const sensors_encoder_faults_t *faults) {
    const sensors_encoder_faults_t before = sensors->encoder.faults;
    const double reading = reading_rev(sensors, plant->rotor_angle_rad);
    if (faults->stuck && !before.stuck) {
        sensors->encoder_last_counts = counts_of(sensors, position_of(sensors, reading));
    }
    sensors->encoder.faults = *faults;
    sensors->encoder.faults.shifted = faults->jump_deg != 0.0 || faults->slip_deg_s != 0.0 || faults->noise_deg > 0.0 ||
                                      faults->lost_counts_per_turn > 0.0;
    if (faults->reversed && !before.reversed) {
        sensors->encoder.reversed_at_rev = reading - (before.shifted ? sensors->encoder.shift_rev : 0.0);
    }
    if (before.slip_deg_s == 0.0) {
        sensors->encoder.slip_from_ns = plant->time_ns;
    }
    if (before.lost_counts_per_turn == 0.0) {
        sensors->encoder.losing_from_rad = plant->rotor_angle_rad;
    }
    sensors->encoder.shift_rev = shift_rev(sensors, plant);
}

void sensors_sample_encoder(sensors_t *sensors, const plant_t *plant, hal_encoder_sample_t *sample) {
    if (sensors->encoder.faults.no_answer) {
        sensors->latched = false;
        *sample = (hal_encoder_sample_t){.counts = (uint32_t)((UINT64_C(1) << sensors->encoder_bits) - 1)};
        return;
    }
    if (sensors->encoder.faults.shifted) {
        sensors->encoder.shift_rev = shift_rev(sensors, plant);
    }
    if (sensors->encoder_fault == SENSORS_ENCODER_FROZEN || sensors->encoder.faults.stuck) {
        sensors->latched = false; /* motion in the meantime has no edges */
    } else {
        const int64_t position = position_of(sensors, reading_rev(sensors, plant->rotor_angle_rad));
        sensors->encoder_last_counts = counts_of(sensors, position);
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
