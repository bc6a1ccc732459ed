/* The quantities of the bench that RIG_SET changes (rig.dbc): decoding, ranges, and the queue of those set ahead. */
#ifndef RIG_QUANTITY_H
#define RIG_QUANTITY_H

#include <stdbool.h>
#include <stdint.h>

#define QUANTITY_QUEUE 64
#define QUANTITY_NEVER UINT64_MAX

typedef struct {
    uint8_t quantity; /* RIG_SET_QUANTITY_*_CHOICE */
    uint32_t at_us;   /* 0 is now */
    double value;     /* in the DBC's unit */
} quantity_setting_t;

typedef struct {
    struct {
        uint64_t at_ns;
        quantity_setting_t setting;
    } entry[QUANTITY_QUEUE]; /* by time, equal times in the order of arrival */
    unsigned count;
} quantity_queue_t;

/* Reads RIG_SET; the result is a RIG_SET_REPLY_STATUS_*_CHOICE: done, no_such_quantity or out_of_range. quantity
 * and at_us are always read, for the answer. */
uint8_t quantity_decode(const uint8_t data[8], quantity_setting_t *setting);

/* Queues a setting; false when QUANTITY_QUEUE wait. */
bool quantity_queue_add(quantity_queue_t *queue, uint64_t at_ns, const quantity_setting_t *setting);

/* When the first one is due; QUANTITY_NEVER when there is none. */
uint64_t quantity_queue_next_ns(const quantity_queue_t *queue);

/* Takes the first one out; there must be one. */
quantity_setting_t quantity_queue_take(quantity_queue_t *queue);

#endif
