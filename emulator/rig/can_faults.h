/* Faults of single frames on the emulated bus, chosen by a seeded random stream of their own. */
#ifndef RIG_CAN_FAULTS_H
#define RIG_CAN_FAULTS_H

#include <stdbool.h>
#include <stdint.h>

/* Numbers of frame_fault in rig.dbc. */
typedef enum {
    CAN_FAULT_NONE,
    CAN_FAULT_LOST,       /* acknowledged, but its receivers drop it: not in the log, or not in the drive */
    CAN_FAULT_CORRUPTED,  /* one bit of control field, data or CRC inverted: error frame, retransmission */
    CAN_FAULT_DELAYED,    /* stays in its sender for delay_ns before it takes part in arbitration */
    CAN_FAULT_DUPLICATED, /* error in the last bit of the end of frame: received, and transmitted again */
} can_fault_t;

/* Numbers of frame_fault_sender in rig.dbc. */
typedef enum { CAN_FAULT_OF_ALL, CAN_FAULT_OF_DRIVE, CAN_FAULT_OF_OTHERS } can_fault_sender_t;

typedef struct {
    can_fault_t fault;
    can_fault_sender_t sender;
    double per_mille; /* of the frames of these senders; a frame is chosen once, its retransmissions are not */
    uint64_t delay_ns;
    uint64_t random_state;
} can_faults_t;

/* No fault. Equal seeds choose equal frames. */
void can_faults_init(can_faults_t *faults, uint64_t seed);

/* Fault of the next frame of the drive, or of another sender. */
can_fault_t can_faults_draw(can_faults_t *faults, bool from_drive);

/* Number from 0 to below `limit` (1..2^32). */
uint32_t can_faults_random(can_faults_t *faults, uint32_t limit);

#endif
