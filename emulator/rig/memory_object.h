/* Objects in the memory of the drive of which a fault flips a bit. No dependencies: also in the images of targets. */
#ifndef RIG_MEMORY_OBJECT_H
#define RIG_MEMORY_OBJECT_H

typedef enum {
    MEMORY_LIMITS,      /* protection_parameters_t */
    MEMORY_CONSTANTS,   /* control_parameters_t */
    MEMORY_STATE,       /* state of the state machine */
    MEMORY_FAULT_LATCH, /* number of the latched fault */
    MEMORY_CODE,        /* the program */
    MEMORY_STACK_GUARD,
    MEMORY_OBJECTS
} memory_object_t;

#endif
