/* Samples within a step of the rotor in which every phase has steps of its own (phase_steps.h). */
#ifndef PLANT_PHASE_SAMPLES_H
#define PLANT_PHASE_SAMPLES_H

#include <stdint.h>

#include "plant/hermite.h"
#include "plant/link_steps.h"
#include "plant/plant_state.h"
#include "plant/rotor_step.h"

#define PHASE_STEPS_MAX 64 /* of a phase in a step of the rotor */

/* A step of a phase. */
typedef struct {
    double from_s, length_s; /* within the rotor's step */
    course_t current_A, torque_Nm;
    double impulse_Nms; /* of the phase's steps before */
} phase_step_t;

typedef struct {
    unsigned count;
    phase_step_t steps[PHASE_STEPS_MAX];
} phase_record_t;

/* Takes the samples before `end_ns`, the step's end; its correction of the angle grows as the cube of the time. The
 * currents and the time of the plant stay as at the step's start. link: no steps without a DC link. */
void phase_samples_take(plant_t *plant, const rotor_step_t *rotor, double correction_rad, const phase_record_t *records,
                        const link_record_t *link, uint64_t end_ns);

#endif
