/* Reading in the background what both interrupts write, without masking them. The control interrupt counts its periods
 * after everything else that it writes, and the deferred interrupt runs after a control interrupt, before the
 * background continues: what has been read is of one period when the count is the same before and after.
 *
 *   for (unsigned attempt = 0; attempt < UNMASKED_READ_ATTEMPTS; attempt++) {
 *       const uint32_t periods = unmasked_read_begin(request);
 *       ...
 *       if (unmasked_read_ended(request, periods)) {
 *           return true;
 *       }
 *   }
 *   return false;
 *
 * The second attempt begins right after an interrupt, so that it fails only when the interrupts leave the background
 * less time in a period than a read takes. */
#ifndef INTERRUPTS_UNMASKED_READ_H
#define INTERRUPTS_UNMASKED_READ_H

#include <stdbool.h>
#include <stdint.h>

#include "interrupts/deferred_exchange.h"

#define UNMASKED_READ_ATTEMPTS 2u

/* Control periods since start, modulo 2^32. [background] */
static inline uint32_t unmasked_read_periods(const deferred_request_t *request) {
    const volatile uint32_t *requests = &request->requests, *skipped = &request->skipped_total;
    return *requests + *skipped; /* an interrupt in between changes one of them, and the sum by the next read */
}

static inline uint32_t unmasked_read_begin(const deferred_request_t *request) {
    const uint32_t periods = unmasked_read_periods(request);
    __atomic_signal_fence(__ATOMIC_ACQUIRE);
    return periods;
}

/* True when no interrupt came since the start. */
static inline bool unmasked_read_ended(const deferred_request_t *request, uint32_t periods) {
    __atomic_signal_fence(__ATOMIC_ACQUIRE);
    return unmasked_read_periods(request) == periods;
}

#endif
