#include "rig/stimulus_queue.h"

#include <string.h>

bool stimulus_queue_push(stimulus_queue_t *queue, const stimulus_t *stimulus) {
    if (queue->count == STIMULUS_QUEUE) {
        return false;
    }
    unsigned index = queue->count++;
    for (; index > 0 && queue->entry[index - 1].at_ns > stimulus->at_ns; --index) {
        queue->entry[index] = queue->entry[index - 1];
    }
    queue->entry[index] = *stimulus;
    return true;
}

uint64_t stimulus_queue_next_ns(const stimulus_queue_t *queue) {
    return queue->count > 0 ? queue->entry[0].at_ns : STIMULUS_NEVER;
}

stimulus_t stimulus_queue_pop(stimulus_queue_t *queue) {
    const stimulus_t first = queue->entry[0];
    memmove(&queue->entry[0], &queue->entry[1], --queue->count * sizeof queue->entry[0]);
    return first;
}
