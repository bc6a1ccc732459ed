#include "rig/load.h"

#include <math.h>

/* For a sine with the same bits on any computer. */
#include "plant/magnetics_kernel.h"
#include "plant/units.h"

#define FREQUENCY_DEFAULT_HZ 1.0 /* GenSigStartValue of load_sine_frequency_Hz */

static uint64_t now_ns(const load_t *load) {
    return *load->scheduler->clock_ns;
}

static double since_s(const load_t *load, uint64_t start_ns) {
    return (double)(now_ns(load) - start_ns) * S_PER_NS;
}

/* Load without the sine. From the start of the ramp, so that rounding does not add up and the end is met exactly. */
static double base_Nm(const load_t *load) {
    const double way_Nm = load->torque_Nm - load->ramp_from_Nm;
    const double done_Nm = load->ramp_Nm_s * since_s(load, load->ramp_start_ns);
    if (load->ramp_Nm_s == 0.0 || done_Nm >= fabs(way_Nm)) {
        return load->torque_Nm;
    }
    return load->ramp_from_Nm + copysign(done_Nm, way_Nm);
}

/* Periods of the sine since its phase 0. */
static double sine_periods(const load_t *load) {
    return load->sine_start_periods + load->sine_frequency_Hz * since_s(load, load->sine_start_ns);
}

static double sine_Nm(const load_t *load) {
    if (load->sine_amplitude_Nm == 0.0) {
        return 0.0;
    }
    const double periods = sine_periods(load);
    double sine, cosine;
    magnetics_kernel_sine_cosine(TWO_PI * (periods - floor(periods + 0.5)), &sine, &cosine);
    return load->sine_amplitude_Nm * sine;
}

/* Taken in the middle of the coming step, so that the staircase is not late on average. */
static double profile_Nm(const load_t *load) {
    if (load->profile_Nm == 0.0 || load->profile_values == 0) {
        return 0.0;
    }
    const double angle_rad =
        load->plant->rotor_angle_rad + load->plant->speed_rad_s * (0.5 * (double)LOAD_STEP_NS * S_PER_NS);
    const double turns = angle_rad / TWO_PI;
    const double position = (turns - floor(turns)) * load->profile_values;
    const double before = floor(position);
    const unsigned index = (unsigned)before % load->profile_values; /* rounding may give a whole turn */
    const double from = load->profile[index], to = load->profile[(index + 1) % load->profile_values];
    return load->profile_Nm * (from + (position - before) * (to - from));
}

/* Applies the load of the present time and schedules the next step while it moves. */
static void apply(load_t *load) {
    const double base = base_Nm(load);
    plant_advance(load->plant, now_ns(load));
    load->plant->load_torque_Nm = load->dropped ? 0.0 : base + sine_Nm(load) + profile_Nm(load);
    const bool moves = base != load->torque_Nm || load->sine_amplitude_Nm != 0.0 || load->profile_Nm != 0.0;
    load->scheduler->due_ns[EVENT_LOAD] = moves ? now_ns(load) + LOAD_STEP_NS : SCHEDULER_NEVER;
}

static void start_ramp(load_t *load) {
    load->ramp_from_Nm = base_Nm(load);
    load->ramp_start_ns = now_ns(load);
}

void load_init(load_t *load, plant_t *plant, scheduler_t *scheduler) {
    *load = (load_t){.plant = plant, .scheduler = scheduler, .sine_frequency_Hz = FREQUENCY_DEFAULT_HZ};
}

void load_set_torque(load_t *load, double torque_Nm) {
    start_ramp(load);
    load->torque_Nm = torque_Nm;
    apply(load);
}

void load_set_ramp(load_t *load, double rate_Nm_s) {
    start_ramp(load);
    load->ramp_Nm_s = rate_Nm_s;
    apply(load);
}

void load_set_sine_amplitude(load_t *load, double amplitude_Nm) {
    if (load->sine_amplitude_Nm == 0.0) {
        load->sine_start_periods = 0.0;
        load->sine_start_ns = now_ns(load);
    }
    load->sine_amplitude_Nm = amplitude_Nm;
    apply(load);
}

/* The phase continues, so that a change of frequency is no step of the load. */
void load_set_sine_frequency(load_t *load, double frequency_Hz) {
    load->sine_start_periods = sine_periods(load);
    load->sine_start_ns = now_ns(load);
    load->sine_frequency_Hz = frequency_Hz;
    apply(load);
}

void load_set_profile(load_t *load, double torque_Nm) {
    load->profile_Nm = torque_Nm;
    apply(load);
}

void load_drop(load_t *load, bool dropped) {
    load->dropped = dropped;
    apply(load);
}

void load_set_profile_value(load_t *load, unsigned values, unsigned index, double value) {
    if (values < 1 || values > LOAD_PROFILE_MAX || index >= values) {
        return;
    }
    load->profile_values = values;
    load->profile[index] = value;
}

void load_step(load_t *load) {
    apply(load);
}
