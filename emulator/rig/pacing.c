#define _POSIX_C_SOURCE 200809L /* clock_nanosleep */

#include "rig/pacing.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define NS_PER_S UINT64_C(1000000000)
#define LATE_NS UINT64_C(100000000)

bool pacing_parse(pacing_t *pacing, const char *text) {
    *pacing = (pacing_t){.kind = PACING_TIMED, .factor = 1.0};
    if (strcmp(text, "lockstep") == 0) {
        pacing->kind = PACING_LOCKSTEP;
        return true;
    }
    if (strcmp(text, "free") == 0) {
        pacing->kind = PACING_FREE;
        return true;
    }
    if (strcmp(text, "realtime") == 0) {
        return true;
    }
    /* Digits and a point only: strtod would also accept signs, hexadecimal, infinity and not-a-number. */
    if (text[0] != 'x' || text[1] == '\0' || strspn(text + 1, "0123456789.") != strlen(text + 1)) {
        return false;
    }
    char *end;
    pacing->factor = strtod(text + 1, &end);
    return *end == '\0' && pacing->factor >= PACING_FACTOR_MIN && pacing->factor <= PACING_FACTOR_MAX;
}

void pacing_wait(pacing_t *pacing, uint64_t virtual_ns) {
    if (pacing->kind != PACING_TIMED) {
        return;
    }
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    uint64_t wall_ns = (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
    uint64_t due_ns =
        pacing->anchor_wall_ns + (uint64_t)((double)(virtual_ns - pacing->anchor_virtual_ns) / pacing->factor);
    if (!pacing->anchored || wall_ns > due_ns + LATE_NS) {
        pacing->anchored = true;
        pacing->anchor_virtual_ns = virtual_ns;
        pacing->anchor_wall_ns = wall_ns;
        return;
    }
    struct timespec due = {.tv_sec = (time_t)(due_ns / NS_PER_S), .tv_nsec = (long)(due_ns % NS_PER_S)};
    while (wall_ns < due_ns && clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) == EINTR) {
    }
}
