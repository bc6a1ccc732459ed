/* Frames of the clients of a world, protected as the drive expects them, and frames of the bench. */
#ifndef CAMPAIGN_SENDER_FRAMES_H
#define CAMPAIGN_SENDER_FRAMES_H

#include "campaign/sender.h"

#define SENDER_COMMAND_PERIOD_US 10000
#define SENDER_STREAM 200 /* of random numbers */

enum { SENDER_HONEST = 1, SENDER_RIVAL = 2 }; /* numbers of the clients */

/* Header of AUTOSAR E2E profile 5 over the bytes that follow it; does not share the firmware's code. */
void sender_protect(uint8_t *data, unsigned length, uint16_t data_id, uint8_t counter);

/* A frame of a client, recorded; genuine: also kept in the history. */
void sender_put(sender_t *sender, const transport_receiver_t *receiver, unsigned client, canid_t identifier,
                const uint8_t *data, unsigned length);
void sender_put_genuine(sender_t *sender, const transport_receiver_t *receiver, unsigned client, unsigned identifier,
                        const uint8_t *data, unsigned length);

/* reference: LSBs of the speed or, in torque mode, of the torque. */
void sender_put_command(sender_t *sender, const transport_receiver_t *receiver, unsigned client, uint8_t counter,
                        bool torque_mode, sender_request_t request, int32_t reference);
void sender_put_position(sender_t *sender, const transport_receiver_t *receiver, uint8_t counter,
                         sender_request_t request, bool moves, double position_rev);
void sender_put_arm(sender_t *sender, const transport_receiver_t *receiver, unsigned step, uint32_t response);

/* One byte and four: PARAMETER_WRITE, PARAMETER_SET_CONTROL. */
void sender_put_set(sender_t *sender, const transport_receiver_t *receiver, unsigned identifier, uint16_t data_id,
                    uint8_t head, uint32_t value);

/* CRC-32 of IEEE 802.3 over index and value of a PARAMETER_WRITE. */
uint32_t sender_check_of_set(uint8_t index, uint32_t value);

/* Events of the bench that begin or end in the present step. */
void sender_put_events(sender_t *sender, const transport_receiver_t *receiver);

bool sender_in_step(const sender_t *sender, uint64_t at_us);
bool sender_is_motion_command(unsigned identifier);

#endif
