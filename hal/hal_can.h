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

/* Puts a frame into a free mailbox: the lowest identifier leaves first, and frames of one identifier in their order.
 * Controllers send equal identifiers by number of the mailbox: the frame takes the lowest free one above every other of
 * its identifier. False without such a mailbox, and in bus-off. [background] */
bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame);

/* Error state (ISO 11898-1): passive above 127 of either counter, bus-off above 255 transmit errors. In bus-off nothing
 * is received or transmitted, and frames in the mailboxes are lost. */
typedef enum { HAL_CAN_ERROR_ACTIVE, HAL_CAN_ERROR_PASSIVE, HAL_CAN_BUS_OFF } hal_can_error_state_t;

/* Transmit errors that are reported in bus-off: the counter of a controller has 8 bits, and the state is the ninth. */
#define HAL_CAN_TRANSMIT_ERRORS_BUS_OFF 256u

typedef struct {
    hal_can_error_state_t state;
    uint16_t transmit_errors; /* transmit error counter */
    uint16_t receive_errors;  /* receive error counter */
    bool transmitting;        /* a frame is in a mailbox */
} hal_can_status_t;

/* Present error state, counters and mailboxes. [background] */
void hal_can_status(const hal_t *hal, hal_can_status_t *status);

/* Requests to leave bus-off, which the controller does after 128 times 11 recessive bits, with counters of 0; it must
 * not leave it without request. No effect in the other states. [background] */
void hal_can_rejoin(hal_t *hal);

#endif
