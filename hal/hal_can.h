/* CAN controller: a receive queue and transmit mailboxes, classic frames only. */
#ifndef HAL_CAN_H
#define HAL_CAN_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

#define HAL_CAN_RECEIVE_QUEUE 64
#define HAL_CAN_MAILBOXES 3

typedef struct {
    uint32_t identifier; /* 11 or 29 bits, without flags */
    bool extended;
    bool remote;
    uint8_t length; /* 0..8; raw length codes 9 to 15 of the wire arrive as they are */
    uint8_t data[8];
} hal_can_frame_t;

/* Removes and returns the oldest received frame; false when there is none. [background] */
bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame);

/* Frames lost because the receive queue was full, since start. [background] */
uint32_t hal_can_receive_overflows(const hal_t *hal);

/* Puts a frame into a free mailbox; false when all are taken. The lowest identifier leaves first. [background] */
bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame);

#endif
