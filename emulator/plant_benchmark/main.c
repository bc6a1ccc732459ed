/* Plant alone, driven by a recorded switching pattern, without firmware, sensors and bus: measures execution time and
 * accuracy of the plant.
 *
 * Standard input: one benchmark_t and its compare values. Standard output: the processor seconds of each pass (double),
 * then a sample_t of a last pass for the end of each control period. Native byte order. On invalid input, exit code 2
 * and one line on standard error. */
#define _POSIX_C_SOURCE 200809L

#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "plant/plant.h"
#include "plant/pwm_timer.h"

#define EXIT_USAGE 2

/* Initial state of the machine; `periods` hal_pwm_compare_t follow it. Each pass starts from this state. */
typedef struct {
    double rotor_angle_rad, speed_rad_s, load_torque_Nm;
    double current_A[HAL_PHASES_MAX];
    double step_factor; /* argument of plant_set_step_factor */
    uint32_t period_ticks, periods, passes;
    uint32_t reserved;
} benchmark_t;

typedef struct {
    double rotor_angle_rad, speed_rad_s, torque_Nm;
    double current_A[HAL_PHASES_MAX];
} sample_t;

static double processor_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void begin(plant_t *plant, const benchmark_t *benchmark) {
    plant_init(plant, &machine_plant, benchmark->rotor_angle_rad);
    plant_set_step_factor(plant, benchmark->step_factor);
    plant->speed_rad_s = benchmark->speed_rad_s;
    plant->load_torque_Nm = benchmark->load_torque_Nm;
    for (unsigned phase = 0; phase < machine_plant.phases; phase++) {
        plant->current_A[phase] = benchmark->current_A[phase];
    }
}

/* Runs one pass; records samples unless NULL. */
static void run(plant_t *plant, const benchmark_t *benchmark, const hal_pwm_compare_t *compares, sample_t *samples) {
    const uint64_t period_ns = pwm_timer_ns(UINT64_C(2) * benchmark->period_ticks);
    for (uint32_t period = 0; period < benchmark->periods; period++) {
        plant_set_switches(plant, &compares[period], (uint16_t)benchmark->period_ticks);
        plant_advance(plant, (period + 1) * period_ns);
        if (samples != NULL) {
            sample_t *sample = &samples[period];
            sample->rotor_angle_rad = plant->rotor_angle_rad;
            sample->speed_rad_s = plant->speed_rad_s;
            sample->torque_Nm = plant_torque_Nm(plant);
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                sample->current_A[phase] = plant->current_A[phase];
            }
        }
    }
}

/* Runs the timed passes, then one more for the samples. */
static bool measure(const benchmark_t *benchmark, const hal_pwm_compare_t *compares, sample_t *samples) {
    plant_t plant;
    for (uint32_t pass = 0; pass < benchmark->passes; pass++) {
        begin(&plant, benchmark);
        const double started_s = processor_s();
        run(&plant, benchmark, compares, NULL);
        const double taken_s = processor_s() - started_s;
        if (fwrite(&taken_s, sizeof taken_s, 1, stdout) != 1) {
            return false;
        }
    }
    begin(&plant, benchmark);
    run(&plant, benchmark, compares, samples);
    return fwrite(samples, sizeof *samples, benchmark->periods, stdout) == benchmark->periods && fflush(stdout) == 0;
}

int main(void) {
    benchmark_t benchmark;
    if (fread(&benchmark, sizeof benchmark, 1, stdin) != 1 || benchmark.period_ticks == 0 ||
        benchmark.period_ticks > UINT16_MAX) {
        fputs("plant_benchmark: standard input: no benchmark_t with a period of 1 to 65535 ticks\n", stderr);
        return EXIT_USAGE;
    }
    hal_pwm_compare_t *compares = calloc(benchmark.periods, sizeof *compares);
    sample_t *samples = calloc(benchmark.periods, sizeof *samples);
    int exit_code = EXIT_USAGE;
    if (compares == NULL || samples == NULL) {
        fputs("plant_benchmark: out of memory\n", stderr);
    } else if (fread(compares, sizeof *compares, benchmark.periods, stdin) != benchmark.periods) {
        fputs("plant_benchmark: standard input: compare values are missing\n", stderr);
    } else if (!measure(&benchmark, compares, samples)) {
        fputs("plant_benchmark: standard output cannot be written\n", stderr);
    } else {
        exit_code = 0;
    }
    free(compares);
    free(samples);
    return exit_code;
}
