/* Turns of the deferred interrupt, and the data that their jobs have from each other; deferred_jobs.def has the jobs.
 */
#ifndef INTERRUPTS_DEFERRED_JOBS_H
#define INTERRUPTS_DEFERRED_JOBS_H

typedef enum {
    TURN_LOAD,    /* mean load of the strokes, and what follows from it */
    TURN_PHASE,   /* learning of one phase, and its counts */
    TURN_COMMON,  /* learning of the common angle; conduction */
    TURN_INERTIA, /* inertia; conduction */
} deferred_turn_t;

/* Order of the turns, one in each step; then it begins again. Phases have half of them, because at a high bandwidth of
 * the observer the learning follows within a millisecond. */
#define DEFERRED_TURNS TURN_LOAD, TURN_PHASE, TURN_COMMON, TURN_PHASE, TURN_LOAD, TURN_PHASE, TURN_INERTIA, TURN_PHASE

/* Members of deferred_t that a job writes, and needs from other jobs. */
enum {
    DATA_NONE = 0,
    DATA_STROKES = 1 << 0, /* stroke_mean, load_constant */
    DATA_PERIODIC_LOAD = 1 << 1,
    DATA_TORQUE_OFFSET = 1 << 2,
    DATA_SPEED_LAW = 1 << 3, /* speed_smc */
    DATA_MISALIGNMENT = 1 << 4,
    DATA_APPROACH = 1 << 5, /* approached_q22, updates_since_near, approaches_reference */
    DATA_MEAN_TORQUE = 1 << 6,
    DATA_INERTIA = 1 << 7,
    DATA_CONDUCTION = 1 << 8, /* conduction, conduction_update */
    DATA_SLOW_COUNTS = 1 << 9,
};

#endif
