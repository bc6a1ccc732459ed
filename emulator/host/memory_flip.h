/* Flips bits in the memory of a drive, on the host and in the images of targets: what a fault of the bench asks for. */
#ifndef HOST_MEMORY_FLIP_H
#define HOST_MEMORY_FLIP_H

#include <stddef.h>
#include <stdint.h>

#include "drive.h"
#include "rig/memory_object.h"

/* Bit of the objects in drive_t, counted from the lowest of the first byte on: the same one on every target, which are
 * all little endian. Without effect on another object. */
static inline void memory_flip(drive_t *drive, memory_object_t object, uint32_t bit) {
    void *const objects[MEMORY_OBJECTS] = {
        [MEMORY_LIMITS] = &drive->control_parameters.protection,
        [MEMORY_CONSTANTS] = &drive->control_parameters,
        [MEMORY_STATE] = &drive->control.state_machine.state,
        [MEMORY_FAULT_LATCH] = &drive->control.state_machine.record.fault,
    };
    if (objects[object]) {
        ((uint8_t *)objects[object])[bit / 8u] ^= (uint8_t)(1u << bit % 8u);
    }
}

#define MEMORY_FLIP_OBJECTS                                                                                            \
    (1u << MEMORY_LIMITS | 1u << MEMORY_CONSTANTS | 1u << MEMORY_STATE | 1u << MEMORY_FAULT_LATCH)

#endif
