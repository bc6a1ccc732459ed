#include "campaign/oracle_parts.h"

#include <math.h>

#include "bench_variables.h"
#include "fault_kinds.h"

#define STRETCH_COUNTS 16.0
#define STRETCH_MIN_NS (2 * ORACLE_MS_NS)
#define STRETCH_MAX_NS (32 * ORACLE_MS_NS)
#define STRETCH_SPEED 0.1                      /* change of the speed, at most */
#define STRETCH_SETTLED_NS (10 * ORACLE_MS_NS) /* after a larger one the drive still has to observe the speed */
#define ANGLE_ERROR_MAX_COUNTS 0.75
#define TIMER_TICK_S 5e-9
#define TEMPERATURE_ERROR_MAX_K 5.0
#define TEMPERATURE_MAX_C 120.0     /* within the range of every sensor */
#define MEASUREMENT_ERROR_MAX 0.008 /* of the full scale: sixteen times the largest noise */

/* Of the encoder on the shaft, in revolutions. */
double oracle_encoder_offset_rev(const world_t *world) {
    double offset_deg = 0.0;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = &world->event[i];
        if (event->kind == WORLD_SET && event->what == BENCH_VARIABLE_ENCODER_OFFSET_DEG && world_active(world, i, 0)) {
            offset_deg = event->raw * bench_variables[event->what].scale;
        }
    }
    return offset_deg / 360.0;
}

/* Both of the sensor's full scale. */
static bool is_off(double measured, double truth) {
    return fabs(measured - fmin(fmax(truth, 0.0), 1.0)) > MEASUREMENT_ERROR_MAX;
}

static void look_at_currents_and_link(oracle_t *oracle, const plant_t *plant) {
    const sensor_ranges_t *ranges = &plant->machine->ranges;
    const uint64_t time_us = plant->time_ns / 1000;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double measured = oracle->drive.current[phase];
        if (is_off(measured, plant_current_A(plant, phase) / ranges->current_A) &&
            !oracle_any_injected(oracle, FAULT_WINDING_SHORTED, FAULT_CURRENT_SENSOR_SWAPPED) &&
            !oracle_drive_disturbed(oracle, time_us)) {
            oracle_violate(oracle, "wrong_current", plant->time_ns, phase, measured * ranges->current_A);
        }
    }
    const double measured = oracle->drive.link_voltage;
    if (is_off(measured, plant->bus_voltage_V / ranges->dc_link_V) && !oracle_link_sensor_faulty(oracle) &&
        !oracle_drive_disturbed(oracle, time_us)) {
        oracle_violate(oracle, "wrong_voltage", plant->time_ns, 0, measured * ranges->dc_link_V);
    }
}

static void look_at_angle(oracle_t *oracle, const plant_t *plant) {
    oracle_stretch_t *stretch = &oracle->stretch;
    if (oracle->drive.state != STATE_RUN) {
        stretch->samples = 0;
        return;
    }
    const double counts_per_rev = ldexp(1.0, (int)oracle->world->encoder_bits);
    const double true_rev = plant->rotor_angle_rad / ORACLE_TWO_PI + oracle->encoder_offset_rev;
    const double counts = true_rev * counts_per_rev;
    const bool steady = fabs(plant->speed_rad_s - stretch->speed_rad_s) <= STRETCH_SPEED * fabs(stretch->speed_rad_s);
    const bool ended = stretch->samples == 0 || plant->time_ns > stretch->begin_ns + STRETCH_MAX_NS;
    if (!steady || (ended && plant->time_ns >= stretch->settled_ns)) {
        stretch->settled_ns = steady ? stretch->settled_ns : plant->time_ns + STRETCH_SETTLED_NS;
        *stretch = (oracle_stretch_t){.settled_ns = stretch->settled_ns,
                                      .begin_ns = plant->time_ns,
                                      .begin_counts = counts,
                                      .speed_rad_s = plant->speed_rad_s};
    }
    if (plant->time_ns < stretch->settled_ns) {
        return;
    }
    const double error_rev = ldexp((double)oracle->drive.angle, -32) - true_rev;
    stretch->error_counts += (error_rev - floor(error_rev + 0.5)) * counts_per_rev;
    stretch->samples++;
    if (fabs(counts - stretch->begin_counts) < STRETCH_COUNTS || plant->time_ns < stretch->begin_ns + STRETCH_MIN_NS) {
        return;
    }
    const double mean_counts = stretch->error_counts / stretch->samples;
    const double tick_counts = fabs(plant->speed_rad_s) / ORACLE_TWO_PI * TIMER_TICK_S * counts_per_rev;
    if (fabs(mean_counts) > ANGLE_ERROR_MAX_COUNTS + tick_counts && !oracle_encoder_faulty(oracle) &&
        !oracle_drive_disturbed(oracle, plant->time_ns / 1000)) {
        oracle_violate(oracle, "wrong_angle", plant->time_ns, 0, mean_counts);
    }
    stretch->samples = 0;
}

void oracle_judge_temperature(oracle_t *oracle, const plant_t *plant, oracle_heat_t heat) {
    const oracle_heat_t measured = oracle->drive.heat;
    const bool disturbed =
        oracle_drive_disturbed(oracle, UINT64_MAX) ||
        oracle_any_injected(oracle, FAULT_WINDING_TEMPERATURE_SENSOR_OPEN, FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET);
    if (!disturbed && heat.winding_C < TEMPERATURE_MAX_C &&
        fabs(measured.winding_C - heat.winding_C) > TEMPERATURE_ERROR_MAX_K) {
        oracle_violate(oracle, "wrong_temperature", plant->time_ns, 0, measured.winding_C - heat.winding_C);
    }
    if (!disturbed && heat.switch_C < TEMPERATURE_MAX_C &&
        fabs(measured.switch_C - heat.switch_C) > TEMPERATURE_ERROR_MAX_K) {
        oracle_violate(oracle, "wrong_temperature", plant->time_ns, 1, measured.switch_C - heat.switch_C);
    }
}

void oracle_look_at_measurement(oracle_t *oracle, const plant_t *plant) {
    look_at_angle(oracle, plant);
    if (oracle->fault_ns != plant->time_ns) { /* else it may have come between the samples and this look */
        look_at_currents_and_link(oracle, plant);
    }
}
