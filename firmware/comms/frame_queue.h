/* A ring of CAN frames that wait for a transmit mailbox: first in, first out. An index or a count that has changed in
 * memory leaves other frames in the ring, and reaches none outside of it. */
#ifndef COMMS_FRAME_QUEUE_H
#define COMMS_FRAME_QUEUE_H

#include <stddef.h>
#include <stdint.h>

#include "hal_can.h"

#define FRAME_QUEUE_CAPACITY 32 /* a power of two */

/* All zero is an empty queue. */
typedef struct {
    hal_can_frame_t frames[FRAME_QUEUE_CAPACITY];
    uint8_t first; /* index of the oldest frame */
    uint8_t count;
} frame_queue_t;

/* Number of free places. */
static inline unsigned frame_queue_free(const frame_queue_t *queue) {
    return queue->count < FRAME_QUEUE_CAPACITY ? FRAME_QUEUE_CAPACITY - (unsigned)queue->count : 0;
}

/* Appends a frame to a queue that is not full. */
static inline void frame_queue_push(frame_queue_t *queue, const hal_can_frame_t *frame) {
    queue->frames[(unsigned)(queue->first + queue->count) % FRAME_QUEUE_CAPACITY] = *frame;
    queue->count++;
}

/* The oldest frame; NULL when the queue is empty. */
static inline const hal_can_frame_t *frame_queue_peek(const frame_queue_t *queue) {
    return queue->count == 0 ? NULL : &queue->frames[queue->first % FRAME_QUEUE_CAPACITY];
}

/* Removes the oldest frame of a queue that is not empty. */
static inline void frame_queue_pop(frame_queue_t *queue) {
    queue->first = (uint8_t)((queue->first + 1u) % FRAME_QUEUE_CAPACITY);
    queue->count--;
}

#endif
