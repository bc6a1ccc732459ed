/* Bits that faults have flipped in the drive's memory, at most one of each object. */
#ifndef RIG_MEMORY_FLIPS_H
#define RIG_MEMORY_FLIPS_H

#include <stdbool.h>
#include <stdint.h>

#include "rig/firmware.h"
#include "rig/memory_object.h"

typedef struct {
    bool flipped[MEMORY_OBJECTS];
    uint32_t bit[MEMORY_OBJECTS]; /* which one */
} memory_flips_t;

/* No bit is flipped. */
void memory_flips_init(memory_flips_t *flips);

/* Flips this bit of an object, or none of it: a bit that was flipped before and is another one is flipped back. */
void memory_flips_set(memory_flips_t *flips, const rig_firmware_t *firmware, memory_object_t object, bool flipped,
                      uint32_t bit);

/* The drive starts again: of its memory only the program keeps a flipped bit. */
void memory_flips_drive_reset(memory_flips_t *flips);

#endif
