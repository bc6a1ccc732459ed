/* CAN: FDCAN1, classic frames, 80 % sample point. Its interrupt moves the three frames of the FIFO into a queue of
 * HAL_CAN_RECEIVE_QUEUE; the background writes the three transmit buffers. */
#include "hal_can.h"

#include <string.h>

#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#define QUANTA 10u /* of a bit: 1 synchronisation, 7, 2 */
#define SEGMENT_1 7u
#define SEGMENT_2 2u
#define PRESCALER (BOARD_CLOCK_HZ / QUANTA / BOARD_CAN_BIT_RATE)
_Static_assert(PRESCALER *QUANTA *BOARD_CAN_BIT_RATE == BOARD_CLOCK_HZ && PRESCALER <= 512, "CAN bit rate");

/* Message RAM (RM0440, FDCAN: message RAM configuration), elements of 18 words. */
#define RECEIVE_FIFO (FDCANRAM1_BASE + 0xB0u)
#define TRANSMIT_BUFFERS (FDCANRAM1_BASE + 0x278u)
#define ELEMENT_BYTES 72u
#define ELEMENT(begin, index) ((volatile uint32_t *)(uintptr_t)((begin) + ELEMENT_BYTES * (index)))
#define WORD0_EXTENDED BIT(30)
#define WORD0_REMOTE BIT(29)
#define WORD0_STANDARD_ID BITS(18, 11)
#define WORD0_EXTENDED_ID BITS(0, 29)
#define WORD1_LENGTH BITS(16, 4)
#define RECEIVE_ERRORS_PASSIVE 128u

void can_init(void) {
    FDCAN_CCCR = FDCAN_CCCR_INIT;
    while (!(FDCAN_CCCR & FDCAN_CCCR_INIT)) {
    }
    FDCAN_CCCR = FDCAN_CCCR_INIT | FDCAN_CCCR_CCE;
    FDCAN_NBTP = PUT(FDCAN_NBTP_NBRP, PRESCALER - 1) | PUT(FDCAN_NBTP_NTSEG1, SEGMENT_1 - 1) |
                 PUT(FDCAN_NBTP_NTSEG2, SEGMENT_2 - 1) | PUT(FDCAN_NBTP_NSJW, SEGMENT_2 - 1);
    FDCAN_RXGFC = 0;              /* no filters: every frame to FIFO 0, which keeps what it has when full */
    FDCAN_TXBC = FDCAN_TXBC_TFQM; /* a queue: the lowest identifier first */
    FDCAN_IE = FDCAN_IE_RF0NE | FDCAN_IE_RF0LE;
    FDCAN_ILE = FDCAN_ILE_EINT0;
    FDCAN_CCCR = 0;
    while ((FDCAN_CCCR & FDCAN_CCCR_INIT) != 0) {
    }
}

static void take(hal_can_frame_t *frame, const volatile uint32_t *element) {
    const uint32_t word0 = element[0];
    const uint32_t data[2] = {element[2], element[3]};
    *frame = (hal_can_frame_t){
        .extended = (word0 & WORD0_EXTENDED) != 0,
        .remote = (word0 & WORD0_REMOTE) != 0,
        .identifier = (word0 & WORD0_EXTENDED) != 0 ? GET(WORD0_EXTENDED_ID, word0) : GET(WORD0_STANDARD_ID, word0),
        .length = (uint8_t)GET(WORD1_LENGTH, element[1]),
    };
    (void)memcpy(frame->data, data, sizeof data);
}

/* The flags first: a frame that arrives after the last look at the FIFO sets them again. */
void can_interrupt(hal_t *hal) {
    const uint32_t flags = FDCAN_IR & (FDCAN_IR_RF0N | FDCAN_IR_RF0L);
    FDCAN_IR = flags;
    if ((flags & FDCAN_IR_RF0L) != 0) {
        hal->receive_overflows++;
    }
    for (;;) {
        const uint32_t status = FDCAN_RXF0S;
        if (GET(FDCAN_RXF0S_F0FL, status) == 0) {
            return;
        }
        const uint32_t index = GET(FDCAN_RXF0S_F0GI, status);
        const uint32_t pushed = hal->received_pushed;
        if (pushed - hal->received_popped == HAL_CAN_RECEIVE_QUEUE) {
            hal->receive_overflows++;
        } else {
            take(&hal->received[pushed % HAL_CAN_RECEIVE_QUEUE], ELEMENT(RECEIVE_FIFO, index));
            __asm__ volatile("" ::: "memory"); /* the frame before its number */
            hal->received_pushed = pushed + 1u;
        }
        FDCAN_RXF0A = index;
    }
}

bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    const uint32_t popped = hal->received_popped;
    if (hal->received_pushed == popped) {
        return false;
    }
    __asm__ volatile("" ::: "memory");
    *frame = hal->received[popped % HAL_CAN_RECEIVE_QUEUE];
    __asm__ volatile("" ::: "memory"); /* the frame is copied before its place is free */
    hal->received_popped = popped + 1u;
    return true;
}

uint32_t hal_can_receive_overflows(const hal_t *hal) {
    return hal->receive_overflows;
}

/* Lowest free buffer above every frame with this first word, HAL_CAN_MAILBOXES where all are taken: buffers of one
 * identifier leave in the order of their numbers, not of their requests (RM0440, FDCAN: Tx queue). */
static uint32_t free_buffer(uint32_t word0) {
    const uint32_t pending = FDCAN_TXBRP;
    uint32_t lowest = HAL_CAN_MAILBOXES;
    for (uint32_t index = 0; index < HAL_CAN_MAILBOXES; index++) {
        if ((pending & BIT(index)) == 0) {
            lowest = lowest < index ? lowest : index;
        } else if (ELEMENT(TRANSMIT_BUFFERS, index)[0] == word0) {
            lowest = HAL_CAN_MAILBOXES;
        } else {
            /* another identifier: arbitration decides */
        }
    }
    return lowest;
}

bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    (void)hal;
    const uint32_t word0 = (frame->extended ? WORD0_EXTENDED | PUT(WORD0_EXTENDED_ID, frame->identifier)
                                            : PUT(WORD0_STANDARD_ID, frame->identifier)) |
                           (frame->remote ? WORD0_REMOTE : 0u);
    const uint32_t index = free_buffer(word0);
    if (index == HAL_CAN_MAILBOXES || (FDCAN_PSR & FDCAN_PSR_BO) != 0) {
        return false;
    }
    volatile uint32_t *element = ELEMENT(TRANSMIT_BUFFERS, index);
    uint32_t data[2];
    (void)memcpy(data, frame->data, sizeof data);
    element[0] = word0;
    element[1] = PUT(WORD1_LENGTH, frame->length);
    element[2] = data[0];
    element[3] = data[1];
    FDCAN_TXBAR = BIT(index);
    return true;
}

void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    (void)hal;
    const uint32_t state = FDCAN_PSR, errors = FDCAN_ECR;
    const bool off = (state & FDCAN_PSR_BO) != 0;
    *status = (hal_can_status_t){
        .state = off                           ? HAL_CAN_BUS_OFF
                 : (state & FDCAN_PSR_EP) != 0 ? HAL_CAN_ERROR_PASSIVE
                                               : HAL_CAN_ERROR_ACTIVE,
        .transmit_errors = (uint16_t)(off ? HAL_CAN_TRANSMIT_ERRORS_BUS_OFF : GET(FDCAN_ECR_TEC, errors)),
        .receive_errors =
            (uint16_t)((errors & FDCAN_ECR_RP) != 0 ? RECEIVE_ERRORS_PASSIVE : GET(FDCAN_ECR_REC, errors)),
        .transmitting = !off && FDCAN_TXBRP != 0,
    };
}

/* In bus-off the controller has set INIT, and returns after its end. CCE clears the requests of the transmit buffers,
 * whose frames are lost, and the FIFO. */
void hal_can_rejoin(hal_t *hal) {
    (void)hal;
    if ((FDCAN_PSR & FDCAN_PSR_BO) && (FDCAN_CCCR & FDCAN_CCCR_INIT)) {
        FDCAN_CCCR = FDCAN_CCCR_INIT | FDCAN_CCCR_CCE;
        FDCAN_CCCR = 0;
    }
}
