/* Arming in two steps: a drive runs, and takes a set of parameters, only after its host has answered a number that it
 * did not know before.
 *
 *   host    DRIVE_ARM request_run            step 1, with any sequence counter
 *   drive   DRIVE_ARMING challenge           a new random number, sent at once
 *   host    DRIVE_ARM confirm_run            step 2, next sequence counter, response = ~challenge (every bit inverted)
 *   drive   DRIVE_ARMING armed
 *
 * request_configuration and confirm_configuration likewise arm for configuration, DRIVE_ARMING configuring, in any
 * state of the drive. That ends with the set (parameter_set.h), with the next challenge, with the beginning of a run,
 * at bus-off, and after ARMING_CONFIGURATION_US without a valid frame of the set.
 *
 * A challenge serves one attempt: it ends with the first step 2, correct or not, with a new step 1, or
 * ARMING_RESPONSE_MAX_US after it was drawn. A recording of a sequence therefore arms nothing. A response that comes
 * before the challenge can have been read is refused, too, and so is a step 1 less than ARMING_INTERVAL_US after the
 * last challenge that was not answered correctly, which bounds the number of attempts. Every refused frame is counted.
 */
#ifndef COMMS_ARMING_H
#define COMMS_ARMING_H

#include <stdbool.h>
#include <stdint.h>

#include "drive_enumerations.h"
#include "hal_can.h"

/* Challenge and response take at least 111 bits each on a bus of 1 Mbit/s. */
#define ARMING_RESPONSE_MIN_US 200u
#define ARMING_RESPONSE_MAX_US 500000u
#define ARMING_INTERVAL_US 10000u

#define ARMING_CONFIGURATION_US 2000000u

/* All zero is not armed. */
typedef struct {
    /* 0 or not; no bool, of which a byte that has changed in memory has no defined value: */
    uint8_t armed;       /* a command to run is accepted */
    uint8_t configuring; /* a set of parameters is accepted */
    bool changed;        /* DRIVE_ARMING is to be sent */
    bool drawn;      /* the last challenge was drawn less than ARMING_INTERVAL_US ago, and has no correct response */
    uint8_t counter; /* of step 1 */
    arming_attempt_t attempt;
    uint32_t challenge;      /* of the attempt; 0 without one */
    uint32_t challenge_us;   /* when it was drawn */
    uint32_t configuring_us; /* time of the confirmation or of the last valid frame of the set */
    uint16_t refused;        /* frames, since start; saturates at 65535 */
    uint16_t check;          /* of armed and configuring, follows each change of them */
} arming_t;

typedef enum { ARMING_REFUSED, ARMING_CHALLENGED, ARMING_ARMED, ARMING_CONFIGURING } arming_result_t;

/* Not armed, which is to be reported. */
void arming_init(arming_t *arming);

/* False when one of both armings has changed in memory. [background] */
bool arming_is_intact(const arming_t *arming);

/* Ends an attempt whose response is overdue, and a configuration without frames; and both armings when one of them has
 * changed in memory. Call it before a frame is received, and at least once in 35 minutes. [background] */
void arming_check_timeout(arming_t *arming, uint32_t time_us);

/* Takes a DRIVE_ARM of the right length and checksum: draws a challenge, or arms. permitted: the drive may be armed
 * for a run now. hal: its random number generator. [background] */
arming_result_t arming_receive(arming_t *arming, hal_t *hal, const hal_can_frame_t *frame, bool permitted,
                               uint32_t time_us);

/* Armed for a run without a challenge: for a protocol with a procedure of its own (comms/canopen_drive.h). [background]
 */
void arming_arm(arming_t *arming);

/* Neither armed for a run nor in an attempt to arm for one. [background] */
void arming_disarm(arming_t *arming);

/* No longer armed for configuration. [background] */
void arming_end_configuration(arming_t *arming);

/* Counts a refused frame. [background] */
arming_result_t arming_refuse(arming_t *arming);

/* Frame DRIVE_ARMING; run_unarmed: its counter of the same name. */
void arming_report(const arming_t *arming, uint16_t run_unarmed, hal_can_frame_t *frame);

#endif
