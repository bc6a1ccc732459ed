/* The clients of a world, as a transport: an honest one, which arms the drive and sends commands, and a hostile or
 * second one. They see the drive through its frames only. In lock-step, in steps of a millisecond.
 *
 * What is sent is a function of the world and of the frames of the drive, so the same frames sent to salient_host by
 * any program give the same bits. */
#ifndef CAMPAIGN_SENDER_H
#define CAMPAIGN_SENDER_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include "campaign/master.h"
#include "campaign/world.h"
#include "rig/transport.h"

#define SENDER_STEP_US UINT64_C(1000)
#define SENDER_HISTORY 64
#define SENDER_POSITIONS_PER_REV 0x1p18 /* of position_deg in drive.dbc */

typedef enum { SENDER_OFF, SENDER_RUN, SENDER_STOP, SENDER_CLEAR } sender_request_t;

typedef struct {
    uint8_t data[8];
    uint8_t length;
    uint16_t identifier;
    uint64_t sent_us;
    uint64_t seen_ns; /* first on the bus; 0: not yet */
    bool other;       /* of the second sender */
    bool in_sequence; /* of the honest client, or by chance as if it were */
} sender_frame_t;

/* Meaning of a frame on the bus for the world, by its sender's own account. */
typedef struct {
    bool genuine;  /* of the client that arms the drive, or in its sequence by chance; not a replay of it */
    bool other;    /* of the second sender */
    bool command;  /* a motion command */
    bool confirms; /* an arming confirmed */
    bool torque;   /* the command is one of the torque mode */
    bool position; /* or of the position mode */
    sender_request_t request;
    double reference; /* r/min; in torque mode N m, in position mode revolutions */
} sender_meaning_t;

/* Indices of what the client sets. */
typedef struct {
    unsigned degraded_running, torque_max_Nm;
} sender_parameters_t;

typedef struct sender {
    transport_t transport; /* first */
    const world_t *world;
    uint64_t time_us;
    /* Honest client. */
    uint8_t counter, arm_counter;
    uint8_t followed;          /* counter of the last motion command that a receiver may follow */
    uint8_t state, last_state; /* of the drive, by DRIVE_STATUS */
    bool withdrawn;            /* after the faults the drive has left its run, */
    uint64_t running_us;       /* and was last in it */
    bool armed;
    unsigned configured;    /* sessions of configuration that are over, */
    uint64_t resting_us;    /* and until when it waits */
    unsigned challenge_for; /* arming_attempt_t */
    uint32_t challenge;
    sender_parameters_t parameters;
    uint64_t requested_us, due_us, phase_us;
    sender_request_t request;
    int32_t reference; /* LSBs */
    int32_t recovery_reference;
    master_t master; /* of CANopen, in place of the honest client */
    /* Second client. */
    uint8_t second_counter;
    uint64_t second_due_us;
    sender_frame_t history[SENDER_HISTORY]; /* genuine frames, the latest at sent - 1 */
    uint64_t sent;
    uint64_t drawn; /* random numbers of the hostile client */
    /* Outputs. */
    uint64_t hash; /* FNV-1a over times, identifiers, lengths and data of the frames on the bus and of the true state */
    uint64_t frames;
    FILE *record; /* every frame that is sent, a line each; NULL: not wanted */
    void (*on_command)(void *context, uint64_t time_ns, const sender_meaning_t *meaning);
    void (*on_frame)(void *context, uint64_t time_ns, unsigned identifier, const uint8_t data[8]); /* of the drive */
    void (*on_fault)(void *context, uint64_t time_ns, unsigned kind, bool begins);
    void *context;
} sender_t;

void sender_init(sender_t *sender, const world_t *world, sender_parameters_t parameters);

/* The speed that is commanded after the faults, r/min; set it before world->recovery_us. */
void sender_set_recovery_speed(sender_t *sender, double rpm);

#endif
