/* The host port: the hal_* functions on the emulated board. */
#ifndef HAL_HOST_H
#define HAL_HOST_H

#include "hal.h"
#include "rig/board.h"

struct hal {
    board_t *board;
};

#endif
