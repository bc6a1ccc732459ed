#include "monitors/encoder_monitor.h"

#include "control/applied_flux.h"
#include "control/machine_tables.h"
#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* Time constant of the leak of the reference, and time over which the error of the voltage adds up in it: 1/256 s. */
#define LEAK_SHIFT 8

/* Error of the flux linkage by the shape of the tables: 1/64. */
#define SHAPE_SHIFT 6

/* Once the rotor has been seen to move in a run, a larger error of the voltage is none, twice that and 1/64 of the
 * DC-link voltage: the currents follow the torque, and their pulses change. */
#define MOVING_FACTOR 2
#define PART_SHIFT 6

/* In short periods the other parts of the tolerances, which are of a period's flux linkage, are small: another 1/64 of
 * the DC-link voltage at each multiple of this rate. */
#define SHORT_PERIOD_HZ 50000u

/* Error of the flux linkage by gains of sensors and machine: 1/8. */
#define GAIN_SHIFT 3

/* Error of a current, A, Q7.9: 0.75 A. */
#define CURRENT_ERROR_Q9 384

/* Time for which they have parted that shows a frozen encoder: 1/2048 s, in which a current that a sensor does not show
 * trips the comparators first. */
#define FROZEN_SHIFT 11

/* Periods of a contradiction in succession that are one. */
#define PERSISTENT_PERIODS 3

/* Phases that contradict the angle within 1/4 s; or one for as long as 1/256 s, when no other conducts. */
#define CONTRADICTING_PHASES 2
#define SHOWN_SHIFT 2
#define ALONE_SHIFT 8

/* Time for which a phase has to be consistent with the angle to speak for the encoder: 1/1024 s. When two others, or
 * all that there are, have within a quarter of a second (SHOWN_SHIFT), the contradiction of one alone is not the
 * encoder's. */
#define AGREES_SHIFT 10
#define AGREEING_PHASES 2

/* Time for which a contradiction waits for the next phase: 1/64 s. */
#define WAIT_SHIFT 6

/* Time without a zero of the current after which an integral is too old to contradict the angle: 1/128 s. */
#define AGE_SHIFT 7

/* Window for the speed: 1/2048 s, and until the next check. */
#define WINDOW_SHIFT 11

/* Travel in a window at the limit of the speed up to which a larger one is seen: 7/16 of a turn. A sixteenth more, and
 * a count, are below the half turn beyond which travel appears smaller than it is: never as over-speed that is none.
 * The highest limit, 38400 r/min, has windows of up to 0.68 ms. */
#define TRAVEL_SEEN (HALF_REV / 8u * 7u)

/* Windows within which the encoder turns round faster than the rotor, from and to a speed of 1/64 of the limit and of
 * half the largest change of the rotor's in this time. */
#define REVERSAL_WINDOWS 3u
#define REVERSAL_SHIFT 6

/* Mechanical angle in which a free rotor at the torque limit reaches the speed whose back-EMF is the error of the
 * voltage that is none, twice, in rad: 4 degrees, Q20. */
#define TWICE_ANGLE_Q20 73204

/* 2^20 rad/s^2: 52 N m on 5e-5 kg m^2. */
#define ACCELERATION_MAX (INT64_C(1) << 20)

/* Least and largest flux linkage within `width` of an angle, at a current less or more its error. */
typedef struct {
    int32_t least_q29, most_q29;
} flux_range_t;

static flux_range_t flux_range(uint32_t angle, uint32_t width, int32_t current_q9, int32_t current_error_q9) {
    const uint32_t distance = phase_map_distance(angle);
    const uint32_t near = distance > width ? distance - width : 0;
    const uint32_t far = distance + width < HALF_REV ? distance + width : HALF_REV - 1u;
    return (flux_range_t){
        .least_q29 = phase_map_flux_q29(&machine_tables, near, current_q9 - current_error_q9),
        .most_q29 = phase_map_flux_q29(&machine_tables, far, current_q9 + current_error_q9),
    };
}

/* Square root, rounded down. */
static uint32_t square_root(uint64_t square) {
    uint32_t root = 0;
    for (uint32_t bit = UINT32_C(1) << 31; bit != 0; bit >>= 1) {
        const uint64_t larger = root | bit;
        root = larger * larger <= square ? (uint32_t)larger : root;
    }
    return root;
}

int32_t encoder_monitor_flux_error_q29(int64_t acceleration, int32_t current_q9, int32_t angle_step_q32,
                                       uint32_t rotor_poles) {
    const int64_t clamped = acceleration < ACCELERATION_MAX ? acceleration : ACCELERATION_MAX;
    const uint64_t square_q22 = (uint64_t)clamped * TWICE_ANGLE_Q20 * 4u >> machine_tables.speed_exponent;
    const int32_t speed_q22 = fixed_saturate((int64_t)square_root(square_q22) << 11);
    const uint32_t step = (uint32_t)fixed_multiply_high(speed_q22, angle_step_q32) * rotor_poles;
    const int32_t rise_q29 = fixed_subtract(phase_map_flux_q29(&machine_tables, HALF_REV - 1u, current_q9),
                                            phase_map_flux_q29(&machine_tables, 0, current_q9)) /
                             2;
    return 2 * fixed_multiply_high(rise_q29, (int32_t)step);
}

/* Error of the voltage in a period that is none, Wb, Q2.29. moves: the rotor has been seen to move in this run. */
static int64_t drift_of(const encoder_monitor_parameters_t *parameters, const encoder_monitor_input_t *input,
                        bool moves) {
    const int32_t part_q29 = input->flux_step_max_q29 >> PART_SHIFT;
    const int32_t short_q29 = part_q29 * (int32_t)(parameters->rate_hz / SHORT_PERIOD_HZ);
    const int32_t suppressed_q29 =
        applied_flux_shortest_pulse_q29(input->flux_step_max_q29, machine_tables.minimum_pulse_ns,
                                        parameters->rate_hz / 1000u) /
        2; /* on average */
    const int64_t error_q29 = parameters->flux_error_q29;
    if (moves) {
        return MOVING_FACTOR * (error_q29 + short_q29) +
               applied_flux_voltage_error_q29(&machine_tables, input->flux_step_max_q29, parameters->period_q40);
    }
    const int32_t device_q29 = applied_flux_device_q29(&machine_tables, parameters->period_q40);
    const int32_t pulse_q29 = suppressed_q29 > short_q29 ? suppressed_q29 : short_q29;
    return error_q29 + (pulse_q29 > device_q29 ? pulse_q29 : device_q29);
}

/* Error that is none of an integral that is too small, by a cold winding, or too large, by a warm one, Wb, Q2.29, age
 * control periods after the phase was without current. */
static int32_t drift_since_zero_q29(const encoder_monitor_parameters_t *parameters,
                                    const encoder_monitor_input_t *input, unsigned index, uint32_t age, bool small) {
    const int32_t drop_q29 = input->drop_q29[index];
    const int64_t device_q29 = (int64_t)applied_flux_device_q29(&machine_tables, parameters->period_q40) * age;
    const int64_t resistive_q29 =
        small ? applied_flux_cold_q29(drop_q29) : applied_flux_warm_q29(&machine_tables, drop_q29) + device_q29;
    const int64_t drift_q29 = drift_of(parameters, input, true) * (int32_t)age;
    return fixed_saturate(input->flux_step_max_q29 / 4 + applied_flux_independent(drift_q29, resistive_q29));
}

/* False when no angle at all explains the integral at the measured current, by the tolerances of contradicts(): then
 * the phase, its sensor or the voltage is at fault, not the encoder. */
static bool fits_an_angle(const encoder_monitor_parameters_t *parameters, const encoder_monitor_input_t *input,
                          unsigned index) {
    const uint32_t age = input->period - input->zero_at[index];
    if (age > parameters->rate_hz >> AGE_SHIFT) {
        return true;
    }
    const int32_t flux_q29 = input->flux_q29[index];
    const flux_range_t range = flux_range(HALF_REV, HALF_REV, input->current_q9[index], CURRENT_ERROR_Q9);
    const int32_t least_q29 = range.least_q29 - (range.least_q29 >> GAIN_SHIFT);
    const int32_t most_q29 = fixed_add(range.most_q29, range.most_q29 >> GAIN_SHIFT);
    return flux_q29 >= fixed_subtract(least_q29, drift_since_zero_q29(parameters, input, index, age, true)) &&
           flux_q29 <= fixed_add(most_q29, drift_since_zero_q29(parameters, input, index, age, false));
}

/* First-order step of a value towards another, by a part in Q15. */
static int32_t leak(int32_t value, int32_t towards, int32_t part_q15) {
    return fixed_add(value, fixed_multiply(fixed_subtract(towards, value), part_q15, 15));
}

/* Fastest parting that a rotor can cause whose motion the encoder does not show, per control period, Wb, Q2.29: its
 * back-EMF a sixteenth of the DC-link voltage, above which a rotor that turned before is found by its travel
 * (monitors/protection.h), or that of a free rotor from rest after 32 degrees. What parts faster is a fault of the
 * phase.
 */
static int32_t fastest_parting_q29(const encoder_monitor_parameters_t *parameters,
                                   const encoder_monitor_input_t *input) {
    const int32_t turning_q29 = input->flux_step_max_q29 / 16;
    const int32_t from_rest_q29 = fixed_saturate(8 * (int64_t)parameters->flux_error_q29);
    return turning_q29 > from_rest_q29 ? turning_q29 : from_rest_q29;
}

static void refer(encoder_monitor_phase_t *phase, const encoder_monitor_input_t *input, unsigned index,
                  int32_t excess_q29, int32_t table_q29) {
    phase->referred = true;
    phase->current_q9 = input->current_q9[index];
    phase->excess_q29 = phase->last_excess_q29 = excess_q29;
    phase->table_q29 = phase->last_table_q29 = table_q29;
    phase->referred_at = input->period;
    phase->zero_at = input->zero_at[index];
    phase->drop_q29 = 0;
    phase->moved = 0;
}

/* True when integral and tables have parted since the encoder has been at its present count. */
static bool has_moved(const encoder_monitor_parameters_t *parameters, encoder_monitor_phase_t *phase,
                      const encoder_monitor_input_t *input, uint32_t angle, unsigned index, uint32_t periods,
                      bool moves) {
    const int32_t current_q9 = input->current_q9[index];
    const flux_range_t range = flux_range(angle, parameters->half_count, current_q9, 0);
    const int32_t table_q29 = range.least_q29 / 2 + range.most_q29 / 2;
    const int32_t excess_q29 = fixed_subtract(input->flux_q29[index], table_q29);
    const bool renewed = !phase->referred || phase->zero_at != input->zero_at[index];
    if (renewed || current_q9 > phase->current_q9 + phase->current_q9 / 8) {
        refer(phase, input, index, excess_q29, table_q29);
        return false;
    }
    const uint32_t leak_periods = parameters->rate_hz >> LEAK_SHIFT;
    const uint32_t age = input->period - phase->referred_at;
    const uint32_t summed = age < leak_periods ? age : leak_periods;
    const int32_t drop_q29 = fixed_multiply_high(current_q9 << 12, parameters->resistance_period_q40);
    phase->drop_q29 = fixed_saturate(phase->drop_q29 + (int64_t)drop_q29 * (int32_t)(periods & 0xffffu));
    const bool falls = excess_q29 < phase->excess_q29;
    const int32_t resistive_q29 =
        falls ? applied_flux_cold_q29(phase->drop_q29) : applied_flux_warm_q29(&machine_tables, phase->drop_q29);
    const int32_t drift_q29 =
        fixed_saturate(applied_flux_independent(drift_of(parameters, input, moves) * (int32_t)summed, resistive_q29));
    const int32_t change_q29 = fixed_abs(fixed_subtract(excess_q29, phase->excess_q29));
    const int32_t tolerance_q29 = drift_q29 + (range.most_q29 - range.least_q29) + (table_q29 >> SHAPE_SHIFT) +
                                  (fixed_abs(table_q29 - phase->table_q29) >> GAIN_SHIFT);
    /* At another angle the tables err by a part of what the current has changed. */
    const int32_t jump_q29 = fixed_abs(fixed_subtract(excess_q29, phase->last_excess_q29)) -
                             fixed_abs(table_q29 - phase->last_table_q29) / 2;
    phase->last_excess_q29 = excess_q29;
    phase->last_table_q29 = table_q29;
    const int64_t fastest_q29 = fastest_parting_q29(parameters, input);
    if ((change_q29 > tolerance_q29 / 2 && change_q29 > fastest_q29 * age) ||
        (jump_q29 > tolerance_q29 / 2 && jump_q29 > fastest_q29 * periods)) {
        refer(phase, input, index, excess_q29, table_q29);
        return false;
    }
    const bool parted = change_q29 > tolerance_q29 && fits_an_angle(parameters, input, index);
    phase->moved = parted ? phase->moved + periods : 0;
    const int32_t part_q15 = (int32_t)(((periods < leak_periods ? periods : leak_periods) << 15) / leak_periods);
    phase->excess_q29 = leak(phase->excess_q29, excess_q29, part_q15);
    phase->table_q29 = leak(phase->table_q29, table_q29, part_q15);
    phase->drop_q29 = leak(phase->drop_q29, 0, part_q15);
    return phase->moved > parameters->rate_hz >> FROZEN_SHIFT;
}

/* Counts the periods for which the flux linkage has contradicted the angle. True when it does, or is beyond half of its
 * tolerance. */
static bool contradicts(const encoder_monitor_parameters_t *parameters, encoder_monitor_phase_t *phase,
                        const encoder_monitor_input_t *input, uint32_t angle, unsigned index, uint32_t periods) {
    const uint32_t age = input->period - input->zero_at[index];
    if (age > parameters->rate_hz >> AGE_SHIFT) {
        return phase->contradicted > 0;
    }
    const int32_t flux_q29 = input->flux_q29[index];
    const flux_range_t range =
        flux_range(angle, parameters->angle_max + parameters->half_count, input->current_q9[index], CURRENT_ERROR_Q9);
    const bool below = flux_q29 < range.least_q29;
    const int32_t drift_q29 = drift_since_zero_q29(parameters, input, index, age, below);
    const int32_t limit_q29 = below ? range.least_q29 : range.most_q29;
    const int32_t beyond_q29 = below ? fixed_subtract(limit_q29, flux_q29) : fixed_subtract(flux_q29, limit_q29);
    const int32_t tolerance_q29 = fixed_add(limit_q29 >> GAIN_SHIFT, drift_q29);
    if (beyond_q29 <= tolerance_q29 || !fits_an_angle(parameters, input, index)) {
        phase->contradicted = 0;
        return beyond_q29 > tolerance_q29 / 2;
    }
    phase->contradicted += phase->contradicted == 0 ? 1 : periods;
    return true;
}

/* True from a current that moves without a voltage, at the smallest inductance and beyond what the rotor's motion does,
 * until the phase is without current again: a connection or sensor that fails for a moment leaves the integral wrong.
 */
static bool interrupted(encoder_monitor_phase_t *phase, const encoder_monitor_input_t *input, unsigned index,
                        uint32_t periods) {
    const int32_t moved_q9 = fixed_abs(input->current_q9[index] - phase->last_current_q9);
    const int64_t moved_q29 = fixed_abs(fixed_subtract(input->flux_q29[index], phase->last_flux_q29));
    if (phase->conducts &&
        phase_map_flux_q29(&machine_tables, 0, moved_q9) > moved_q29 + (int64_t)input->flux_step_max_q29 * periods) {
        phase->interrupted = true;
        phase->interrupted_zero_at = input->zero_at[index];
    }
    phase->conducts = true;
    phase->last_current_q9 = input->current_q9[index];
    phase->last_flux_q29 = input->flux_q29[index];
    phase->interrupted = phase->interrupted && phase->interrupted_zero_at == input->zero_at[index];
    return phase->interrupted;
}

static void forget_references(encoder_monitor_t *monitor) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        monitor->phase[phase].referred = false;
    }
}

/* True while a phase has shown a contradiction in the last quarter of a second. */
static bool shows(const encoder_monitor_parameters_t *parameters, encoder_monitor_phase_t *phase, uint32_t period) {
    if (phase->contradicted >= PERSISTENT_PERIODS) {
        phase->shown_from = phase->shown ? phase->shown_from : period;
        phase->shown = true;
        phase->shown_at = period;
    } else if (period - phase->shown_at > parameters->rate_hz >> SHOWN_SHIFT) {
        phase->shown = false;
    }
    return phase->shown;
}

/* Notes how long a phase that is checked has been consistent with the angle. */
static void note_agreement(const encoder_monitor_parameters_t *parameters, encoder_monitor_phase_t *phase,
                           uint32_t period, uint32_t periods) {
    phase->agrees = phase->contradicted == 0 ? phase->agrees + periods : 0;
    if (phase->agrees > parameters->rate_hz >> AGREES_SHIFT) {
        phase->agreed = true;
        phase->agreed_at = period;
    }
}

/* True when two of the other phases, or all that are not lost, have been consistent with the angle in the last quarter
 * of a second. One that is left is enough: what it has shown, it contradicts when it conducts the next time, if the
 * encoder is wrong. */
static bool others_agree(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor, unsigned index,
                         const encoder_monitor_input_t *input) {
    bool all = true;
    unsigned agreeing = 0;
    for (unsigned other = 0; other < machine_tables.phases; other++) {
        encoder_monitor_phase_t *phase = &monitor->phase[other];
        phase->agreed = phase->agreed && input->period - phase->agreed_at <= parameters->rate_hz >> SHOWN_SHIFT;
        if (other != index && (input->lost_phases >> other & 1u) == 0) {
            all &= phase->agreed;
            agreeing += phase->agreed;
        }
    }
    return all || agreeing >= AGREEING_PHASES;
}

/* True while the encoder shows a rotor that turns the way the torque drives it. */
static bool advances(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                     const encoder_monitor_input_t *input) {
    const int32_t least = parameters->advance_min;
    const int32_t travel = (int32_t)(input->encoder_angle - monitor->waypoint);
    const int32_t advance = input->torque_q24 < 0 ? fixed_subtract(0, travel) : travel;
    if (advance < 0 || advance >= least) {
        monitor->waypoint = input->encoder_angle;
    }
    if (advance >= least) {
        monitor->advanced = true;
        monitor->advanced_at = input->period;
    }
    return monitor->advanced && input->period - monitor->advanced_at <= parameters->rate_hz >> ALONE_SHIFT;
}

static void check_flux(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                       const encoder_monitor_input_t *input, uint32_t periods, bool counted) {
    const uint32_t electrical =
        commutation_electrical(&parameters->commutation, input->encoder_angle + parameters->middle);
    const bool next_decides = advances(parameters, monitor, input);
    unsigned contradicting = 0;
    bool alone = false;
    monitor->suspicious = false;
    for (unsigned index = 0; index < machine_tables.phases; index++) {
        encoder_monitor_phase_t *phase = &monitor->phase[index];
        const bool conducts = input->current_q9[index] >= parameters->current_min_q9;
        if (!conducts) {
            phase->conducts = false;
        }
        if (conducts && input->known[index] && !interrupted(phase, input, index, periods)) {
            const uint32_t angle = electrical - index * parameters->commutation.stroke;
            monitor->frozen |= !counted && has_moved(parameters, phase, input, angle, index, periods, monitor->counted);
            monitor->suspicious |= contradicts(parameters, phase, input, angle, index, periods);
            note_agreement(parameters, phase, input->period, periods);
        } else {
            phase->referred = false;
            phase->contradicted = 0;
            phase->agrees = 0;
        }
        contradicting += shows(parameters, phase, input->period);
        const bool waits = next_decides && input->period - phase->shown_from <= parameters->rate_hz >> WAIT_SHIFT;
        alone |= phase->contradicted > parameters->rate_hz >> ALONE_SHIFT && !waits &&
                 !others_agree(parameters, monitor, index, input);
    }
    monitor->angle |= contradicting >= CONTRADICTING_PHASES || alone;
}

/* Notes when the encoder has turned round. clear: faster than its counts and the rotor's swings. The first direction
 * since a reset of the drive, whose rotor may turn backwards, is no turn round. */
static void note_reversal(encoder_monitor_t *monitor, int32_t turned, bool clear, uint32_t rate_hz) {
    const bool backwards = turned < 0;
    if (!clear) {
        return;
    }
    if (monitor->turned && backwards != monitor->backwards &&
        monitor->window_period - monitor->turned_at <= REVERSAL_WINDOWS * (rate_hz >> WINDOW_SHIFT)) {
        monitor->reversed = true;
        monitor->reversed_at = monitor->window_period;
    }
    monitor->turned = true;
    monitor->backwards = backwards;
    monitor->turned_at = monitor->window_period;
}

static void check_speed(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                        const encoder_monitor_input_t *input) {
    const uint32_t periods = input->period - monitor->window_period;
    if (input->lost) { /* the window was longer than its periods */
        monitor->window_period = input->period;
        monitor->window_angle = input->encoder_angle;
        monitor->turned = false;
        return;
    }
    if (periods < parameters->rate_hz >> WINDOW_SHIFT) {
        return;
    }
    const int32_t turned = (int32_t)(input->encoder_angle - monitor->window_angle);
    const uint32_t travel = (uint32_t)fixed_abs(turned);
    const uint64_t limit = (uint64_t)parameters->travel * periods;
    const uint64_t count = 2 * (uint64_t)parameters->middle;
    const bool above = fixed_abs(input->speed_q22) > parameters->over_speed_q22;
    monitor->over_speed =
        limit < TRAVEL_SEEN && (travel > limit + limit / 16 + count || (above && travel + count > limit - limit / 32));
    monitor->window_period = input->period;
    monitor->window_angle = input->encoder_angle;
    const uint64_t change = (uint64_t)parameters->travel_change * periods * periods * REVERSAL_WINDOWS / 2u;
    const uint64_t least = limit >> REVERSAL_SHIFT;
    note_reversal(monitor, turned, travel > (least > change ? least : change) + count, parameters->rate_hz);
}

bool encoder_monitor_suspects(const encoder_monitor_parameters_t *parameters, const encoder_monitor_t *monitor,
                              uint32_t phases) {
    bool any = monitor->reversed && monitor->period - monitor->reversed_at <= parameters->rate_hz >> SHOWN_SHIFT;
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        any |= monitor->phase[phase].shown && (phases >> phase & 1u) == 0;
    }
    return any;
}

static void start(encoder_monitor_t *monitor, const encoder_monitor_input_t *input) {
    monitor->started = true;
    monitor->window_period = input->period;
    monitor->encoder_angle = monitor->window_angle = input->encoder_angle;
}

COLD void encoder_monitor_step(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                               const encoder_monitor_input_t *input) {
    if (!monitor->started) {
        start(monitor, input);
    }
    const uint32_t periods = input->period - monitor->period;
    if (periods == 0) {
        return;
    }
    monitor->period = input->period;
    const bool counted = input->encoder_angle != monitor->encoder_angle;
    if (counted) {
        monitor->encoder_angle = input->encoder_angle;
        monitor->frozen = false;
        monitor->counted = true;
        forget_references(monitor);
    }
    check_speed(parameters, monitor, input);
    if (input->run) {
        check_flux(parameters, monitor, input, periods, counted);
        return;
    }
    monitor->angle = false;
    monitor->suspicious = false;
    monitor->counted = false;
    monitor->advanced = false;
    monitor->waypoint = input->encoder_angle;
    forget_references(monitor);
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        monitor->phase[phase].contradicted = 0;
        monitor->phase[phase].shown = false;
        monitor->phase[phase].agreed = false;
        monitor->phase[phase].agrees = 0;
    }
}
