/* Flips bits in the memory of a drive, on the host and in the images of targets: what a fault of the bench asks for. */
#ifndef HOST_MEMORY_FLIP_H
#define HOST_MEMORY_FLIP_H

#include <stddef.h>
#include <stdint.h>

#include "drive/drive.h"
#include "rig/memory_object.h"

/* Bit of the objects in drive_t, counted from the lowest of the first byte on: the same one on every target, which are
 * all little endian, and lay the objects out alike. Without effect on another object, and beyond its end. */
static inline void memory_flip(drive_t *drive, memory_object_t object, uint32_t bit) {
    control_parameters_t *const constants = &drive->control_parameters;
    state_machine_t *const state_machine = &drive->control.state_machine;
    const struct {
        void *begin;
        size_t bytes;
    } objects[MEMORY_OBJECTS] = {
        [MEMORY_LIMITS] = {&constants->protection, sizeof constants->protection},
        [MEMORY_CONSTANTS] = {constants, sizeof *constants},
        [MEMORY_STATE] = {&state_machine->state, sizeof state_machine->state},
        [MEMORY_FAULT_LATCH] = {&state_machine->record.fault, sizeof state_machine->record.fault},
    };
    if (bit / 8u < objects[object].bytes) {
        ((uint8_t *)objects[object].begin)[bit / 8u] ^= (uint8_t)(1u << bit % 8u);
    }
}

#define MEMORY_FLIP_OBJECTS                                                                                            \
    (1u << MEMORY_LIMITS | 1u << MEMORY_CONSTANTS | 1u << MEMORY_STATE | 1u << MEMORY_FAULT_LATCH)

#endif
