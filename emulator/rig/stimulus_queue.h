/* Changes of bench variables, or of faults, that wait for their time. */
#ifndef RIG_STIMULUS_QUEUE_H
#define RIG_STIMULUS_QUEUE_H

#include <stdbool.h>
#include <stdint.h>

#define STIMULUS_QUEUE 64
#define STIMULUS_NEVER UINT64_MAX

typedef struct {
    uint64_t at_ns;
    unsigned variable; /* BENCH_VARIABLE_*, or kind and place of a fault */
    double value;      /* in the DBC's unit */
} stimulus_t;

typedef struct {
    stimulus_t entry[STIMULUS_QUEUE]; /* by time, equal times in the order of arrival */
    unsigned count;
} stimulus_queue_t;

/* Queues a stimulus; false when STIMULUS_QUEUE are waiting. */
bool stimulus_queue_push(stimulus_queue_t *queue, const stimulus_t *stimulus);

/* Time of the first stimulus; STIMULUS_NEVER when there is none. */
uint64_t stimulus_queue_next_ns(const stimulus_queue_t *queue);

/* Removes and returns the first stimulus; there must be one. */
stimulus_t stimulus_queue_pop(stimulus_queue_t *queue);

#endif
