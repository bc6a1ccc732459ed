/* Skeleton of a port: what its functions keep between calls. */
#ifndef SKELETON_BOARD_H
#define SKELETON_BOARD_H

#include <stdint.h>

#include "hal.h"

struct hal {
    uint16_t period_ticks;
    /* FILL IN: number of the last trigger, receive queue, written registers, ... */
};

#endif
