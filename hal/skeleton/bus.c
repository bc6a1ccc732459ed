/* CAN bus. */
#include "hal_can.h"
#include "skeleton/board.h"

/* FILL IN: oldest frame of a queue of HAL_CAN_RECEIVE_QUEUE, which an interrupt fills where the hardware's is shorter.
 */
bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    (void)hal;
    (void)frame;
    return false;
}

/* FILL IN: frames that found the queue full. */
uint32_t hal_can_receive_overflows(const hal_t *hal) {
    (void)hal;
    return 0;
}

/* FILL IN: a free one of HAL_CAN_MAILBOXES transmit buffers; the lowest identifier leaves first, equal ones in their
 * order. */
bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    (void)hal;
    (void)frame;
    return false;
}

/* FILL IN: error counters of the controller. Here: off the bus. */
void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    (void)hal;
    *status = (hal_can_status_t){.state = HAL_CAN_BUS_OFF};
}

/* FILL IN: only from bus-off; the frames in the buffers are lost. */
void hal_can_rejoin(hal_t *hal) {
    (void)hal;
}
