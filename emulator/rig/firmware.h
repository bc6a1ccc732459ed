/* The firmware, seen from the emulator, and who looks on. */
#ifndef RIG_FIRMWARE_H
#define RIG_FIRMWARE_H

#include <stdint.h>

#include "rig/memory_object.h"

/* All functions take no virtual time, except as board.interrupt_took_ns says. */
typedef struct {
    void (*control_interrupt)(void *context);  /* at the start of each control period */
    void (*deferred_interrupt)(void *context); /* after a control interrupt that has set board.deferred_requested */
    void (*background)(void *context);         /* after each control interrupt and the deferred one */
    void *context;
    void (*restart)(void *context); /* from its start on, after board_reset; NULL: it cannot be reset */
    /* Flips a bit of an object of memory_object.h; bit n of flip_objects: it has object n. */
    void (*flip)(void *context, memory_object_t object, uint32_t bit);
    uint32_t flip_objects;
} rig_firmware_t;

/* Who looks at a rig around the calls of the firmware; each function may be NULL. */
typedef struct {
    void (*before_interrupt)(void *context); /* the control interrupt */
    void (*after_interrupt)(void *context);
    void (*after_restart)(void *context);
    void *context;
} rig_observer_t;

#endif
