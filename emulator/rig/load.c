#include "rig/load.h"

#include <math.h>

/* For a sine with the same bits on any computer. */
#include "plant/magnetics_kernel.h"

#define FREQUENCY_DEFAULT_HZ 1.0 /* GenSigStartValue of load_sine_frequency_Hz */
#define TWO_PI (2.0 * 3.14159265358979323846)
#define S_PER_NS 1e-9

static double since_s(const rig_t *rig, uint64_t start_ns) {
    return (double)(rig->board.time_ns - start_ns) * S_PER_NS;
}

/* Load without the sine. From the start of the ramp, so that rounding does not add up and the end is met exactly. */
static double base_Nm(const rig_t *rig) {
    const load_t *load = &rig->load;
    const double way_Nm = load->torque_Nm - load->ramp_from_Nm;
    const double done_Nm = load->ramp_Nm_s * since_s(rig, load->ramp_start_ns);
    if (load->ramp_Nm_s == 0.0 || done_Nm >= fabs(way_Nm)) {
        return load->torque_Nm;
    }
    return load->ramp_from_Nm + copysign(done_Nm, way_Nm);
}

/* Periods of the sine since its phase 0. */
static double sine_periods(const rig_t *rig) {
    const load_t *load = &rig->load;
    return load->sine_start_periods + load->sine_frequency_Hz * since_s(rig, load->sine_start_ns);
}

static double sine_Nm(const rig_t *rig) {
    if (rig->load.sine_amplitude_Nm == 0.0) {
        return 0.0;
    }
    const double periods = sine_periods(rig);
    double sine, cosine;
    magnetics_kernel_sine_cosine(TWO_PI * (periods - floor(periods + 0.5)), &sine, &cosine);
    return rig->load.sine_amplitude_Nm * sine;
}

/* Of the middle of the coming step, so that the staircase is not late on average. */
static double profile_Nm(const rig_t *rig) {
    const load_t *load = &rig->load;
    if (load->profile_Nm == 0.0 || load->profile_values == 0) {
        return 0.0;
    }
    const double angle_rad =
        rig->plant.rotor_angle_rad + rig->plant.speed_rad_s * (0.5 * (double)LOAD_STEP_NS * S_PER_NS);
    const double turns = angle_rad / TWO_PI;
    const double position = (turns - floor(turns)) * load->profile_values;
    const double before = floor(position);
    const unsigned index = (unsigned)before % load->profile_values; /* rounding may give a whole turn */
    const double from = load->profile[index], to = load->profile[(index + 1) % load->profile_values];
    return load->profile_Nm * (from + (position - before) * (to - from));
}

/* Applies the load of the present time and schedules the next step while it moves. */
static void apply(rig_t *rig) {
    const uint64_t now_ns = rig->board.time_ns;
    const double base = base_Nm(rig);
    plant_advance(&rig->plant, now_ns);
    rig->plant.load_torque_Nm = rig->load.dropped ? 0.0 : base + sine_Nm(rig) + profile_Nm(rig);
    const bool moves = base != rig->load.torque_Nm || rig->load.sine_amplitude_Nm != 0.0 || rig->load.profile_Nm != 0.0;
    rig->scheduler.due_ns[EVENT_LOAD] = moves ? now_ns + LOAD_STEP_NS : SCHEDULER_NEVER;
}

static void start_ramp(rig_t *rig) {
    rig->load.ramp_from_Nm = base_Nm(rig);
    rig->load.ramp_start_ns = rig->board.time_ns;
}

void load_init(rig_t *rig) {
    rig->load = (load_t){.sine_frequency_Hz = FREQUENCY_DEFAULT_HZ};
}

void load_set_torque(rig_t *rig, double torque_Nm) {
    start_ramp(rig);
    rig->load.torque_Nm = torque_Nm;
    apply(rig);
}

void load_set_ramp(rig_t *rig, double rate_Nm_s) {
    start_ramp(rig);
    rig->load.ramp_Nm_s = rate_Nm_s;
    apply(rig);
}

void load_set_sine_amplitude(rig_t *rig, double amplitude_Nm) {
    if (rig->load.sine_amplitude_Nm == 0.0) {
        rig->load.sine_start_periods = 0.0;
        rig->load.sine_start_ns = rig->board.time_ns;
    }
    rig->load.sine_amplitude_Nm = amplitude_Nm;
    apply(rig);
}

/* The phase continues, so that a change of frequency is no step of the load. */
void load_set_sine_frequency(rig_t *rig, double frequency_Hz) {
    rig->load.sine_start_periods = sine_periods(rig);
    rig->load.sine_start_ns = rig->board.time_ns;
    rig->load.sine_frequency_Hz = frequency_Hz;
    apply(rig);
}

void load_set_profile(rig_t *rig, double torque_Nm) {
    rig->load.profile_Nm = torque_Nm;
    apply(rig);
}

void load_drop(rig_t *rig, bool dropped) {
    rig->load.dropped = dropped;
    apply(rig);
}

void load_set_profile_value(rig_t *rig, unsigned values, unsigned index, double value) {
    if (values < 1 || values > RIG_LOAD_PROFILE_MAX || index >= values) {
        return;
    }
    rig->load.profile_values = values;
    rig->load.profile[index] = value;
}

void load_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    apply(context);
}
