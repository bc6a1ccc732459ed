/* The plant alone, driven by a recorded switching pattern: no firmware, no sensors, no bus. For measuring what the
 * plant costs and how exact it is.
 *
 * Standard input: one replay_t and its compare values. Standard output: the processor seconds of each pass (double),
 * then of the last pass a replay_state_t for the end of each control period. Native byte order. Exit code 2 and one
 * line when something is missing. */
#define _POSIX_C_SOURCE 200809L

#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "plant/plant.h"

#define EXIT_MISTAKE 2

/* What is replayed: the machine's state at the start, and `periods` hal_pwm_compare_t that follow it. Each pass starts
 * anew. */
typedef struct {
    double rotor_angle_rad, speed_rad_s, load_torque_Nm;
    double current_A[HAL_PHASES_MAX];
    double step_factor; /* of plant_set_step_factor */
    uint32_t period_ticks, periods, passes;
    uint32_t reserved;
} replay_t;

typedef struct {
    double rotor_angle_rad, speed_rad_s, torque_Nm;
    double current_A[HAL_PHASES_MAX];
} replay_state_t;

static double processor_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void begin(plant_t *plant, const replay_t *replay) {
    plant_init(plant, &machine_plant, replay->rotor_angle_rad);
    plant_set_step_factor(plant, replay->step_factor);
    plant->speed_rad_s = replay->speed_rad_s;
    plant->load_torque_Nm = replay->load_torque_Nm;
    for (unsigned phase = 0; phase < machine_plant.phases; phase++) {
        plant->current_A[phase] = replay->current_A[phase];
    }
}

/* One pass; states NULL: nothing is kept. */
static void run(plant_t *plant, const replay_t *replay, const hal_pwm_compare_t *compares, replay_state_t *states) {
    const uint64_t period_ns = UINT64_C(2) * replay->period_ticks * HAL_PWM_TICK_NS;
    for (uint32_t period = 0; period < replay->periods; period++) {
        plant_set_switches(plant, &compares[period], (uint16_t)replay->period_ticks);
        plant_advance(plant, (period + 1) * period_ns);
        if (states != NULL) {
            replay_state_t *state = &states[period];
            state->rotor_angle_rad = plant->rotor_angle_rad;
            state->speed_rad_s = plant->speed_rad_s;
            state->torque_Nm = plant_torque_Nm(plant);
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                state->current_A[phase] = plant->current_A[phase];
            }
        }
    }
}

/* The timed passes, then one more for the states. */
static bool measure(const replay_t *replay, const hal_pwm_compare_t *compares, replay_state_t *states) {
    plant_t plant;
    for (uint32_t pass = 0; pass < replay->passes; pass++) {
        begin(&plant, replay);
        const double started_s = processor_s();
        run(&plant, replay, compares, NULL);
        const double taken_s = processor_s() - started_s;
        if (fwrite(&taken_s, sizeof taken_s, 1, stdout) != 1) {
            return false;
        }
    }
    begin(&plant, replay);
    run(&plant, replay, compares, states);
    return fwrite(states, sizeof *states, replay->periods, stdout) == replay->periods && fflush(stdout) == 0;
}

int main(void) {
    replay_t replay;
    if (fread(&replay, sizeof replay, 1, stdin) != 1 || replay.period_ticks == 0 || replay.period_ticks > UINT16_MAX) {
        fputs("plant_benchmark: standard input: no replay_t with a period of 1 to 65535 ticks\n", stderr);
        return EXIT_MISTAKE;
    }
    hal_pwm_compare_t *compares = calloc(replay.periods, sizeof *compares);
    replay_state_t *states = calloc(replay.periods, sizeof *states);
    int exit_code = EXIT_MISTAKE;
    if (compares == NULL || states == NULL) {
        fputs("plant_benchmark: no memory\n", stderr);
    } else if (fread(compares, sizeof *compares, replay.periods, stdin) != replay.periods) {
        fputs("plant_benchmark: standard input: compare values are missing\n", stderr);
    } else if (!measure(&replay, compares, states)) {
        fputs("plant_benchmark: standard output cannot be written\n", stderr);
    } else {
        exit_code = 0;
    }
    free(compares);
    free(states);
    return exit_code;
}
