#include "comms/telemetry.h"

#include <assert.h>

#include "comms/counter.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "drive_enumerations.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* The groups `background` and `idle` of any node have these, and no other frame of the drive. */
#define BACKGROUND_IDENTIFIERS DRIVE_IDENTITY_FRAME_ID

static_assert(DRIVE_TELEMETRY_CYCLE_MS == 1, "parameters have periods in ms");

/* Places of the queue: for the heartbeat, and with it for the frames of a fault and the counters, to which the
 * measurements of a bus or a background that does not keep up give way. */
#define KEPT_FOR_HEARTBEAT 1u
#define KEPT_FOR_OTHERS 14u

void telemetry_init(telemetry_t *telemetry, uint32_t identifier_offset, uint32_t time_us) {
    *telemetry = (telemetry_t){.next_us = time_us, .identifier_offset = identifier_offset};
    for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
        telemetry->countdown[i] = drive_telemetry_messages[i].delay;
        telemetry->period[drive_telemetry_messages[i].rate] = drive_telemetry_messages[i].period;
    }
}

COLD void telemetry_set_period(telemetry_t *telemetry, drive_telemetry_rate_t rate, unsigned period) {
    const int longer = (int)period - telemetry->period[rate];
    if (longer == 0) {
        return;
    }
    for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
        if (drive_telemetry_messages[i].rate == rate) {
            const int left = telemetry->countdown[i] + longer;
            telemetry->countdown[i] = (uint16_t)fixed_max(left, 0);
        }
    }
    telemetry->period[rate] = (uint16_t)period;
}

/* Counts down the cycles to a message; true when it is due now. More cycles than the period has come from a count
 * that has changed in memory. */
static bool count_down(uint16_t *cycles_left, uint16_t period) {
    const bool due = *cycles_left == 0 || *cycles_left > period;
    *cycles_left = (uint16_t)((due ? period : *cycles_left) - 1);
    return due;
}

static void enqueue(telemetry_t *telemetry, const drive_telemetry_message_t *message, const drive_telemetry_t *values) {
    hal_can_frame_t frame = {.identifier = message->identifier + telemetry->identifier_offset,
                             .length = message->length};
    drive_telemetry_pack((unsigned)(message - drive_telemetry_messages), values, frame.data);
    frame_queue_push(&telemetry->queue, &frame);
}

/* Messages of a group that are due in this cycle; advances their countdowns. */
static unsigned due_messages(telemetry_t *telemetry, drive_telemetry_group_t group,
                             const drive_telemetry_message_t *due[DRIVE_TELEMETRY_MESSAGES]) {
    const bool active = group == DRIVE_TELEMETRY_GROUP_POSITION ? telemetry->position_used : telemetry->in_fault;
    unsigned count = 0;
    for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
        const drive_telemetry_message_t *message = &drive_telemetry_messages[i];
        const bool settable = message->rate != DRIVE_TELEMETRY_RATE_FIXED;
        if (message->group == group && (active || !message->if_active) &&
            machine_tables.phases > message->phases_above &&
            count_down(&telemetry->countdown[i], settable ? telemetry->period[message->rate] : message->period)) {
            due[count++] = message;
        }
    }
    return count;
}

/* All of a group or none; `kept`: places that it leaves free. */
static void enqueue_group(telemetry_t *telemetry, drive_telemetry_group_t group, unsigned kept,
                          const drive_telemetry_t *values) {
    const drive_telemetry_message_t *due[DRIVE_TELEMETRY_MESSAGES];
    const unsigned count = due_messages(telemetry, group, due);
    if (frame_queue_free(&telemetry->queue) < count + kept) {
        counter_add(&telemetry->dropped, count);
        return;
    }
    for (unsigned i = 0; i < count; i++) {
        enqueue(telemetry, due[i], values);
    }
}

static void enqueue_background(telemetry_t *telemetry, drive_telemetry_group_t group, bool room,
                               const drive_telemetry_t *values) {
    const drive_telemetry_message_t *due[DRIVE_TELEMETRY_MESSAGES];
    const unsigned count = due_messages(telemetry, group, due);
    for (unsigned i = 0; i < count; i++) {
        if (telemetry->background_queued || telemetry->background_in_mailbox || !room ||
            frame_queue_free(&telemetry->queue) == 0) {
            counter_add(&telemetry->dropped, 1);
        } else {
            enqueue(telemetry, due[i], values);
            telemetry->background_queued = true;
        }
    }
}

/* Restarts the schedule of the messages that are sent in fault at every new fault. */
static void follow_fault(telemetry_t *telemetry, const drive_telemetry_t *values) {
    const bool in_fault = values->status.state == DRIVE_STATE_FAULT;
    const uint32_t time_us = values->fault_cause.time_us;
    if (in_fault && (!telemetry->in_fault || time_us != telemetry->fault_time_us)) {
        for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
            if (drive_telemetry_messages[i].if_active) {
                telemetry->countdown[i] = drive_telemetry_messages[i].delay;
            }
        }
        telemetry->fault_time_us = time_us;
    }
    telemetry->in_fault = in_fault;
}

void telemetry_advance(telemetry_t *telemetry, uint32_t time_us) {
    uint32_t cycles = 1;
    /* Negative when the values were collected a little before the cycle was due. */
    int32_t late_us = (int32_t)(time_us - telemetry->next_us);
    if (late_us < -TELEMETRY_CYCLE_US) { /* changed in memory: telemetry_due() */
        telemetry->next_us = time_us;
        late_us = 0;
    }
    if (late_us >= TELEMETRY_CYCLE_US) {
        cycles += (uint32_t)late_us / TELEMETRY_CYCLE_US;
    }
    telemetry->next_us += cycles * TELEMETRY_CYCLE_US;
    telemetry->cycle = (uint8_t)(telemetry->cycle + cycles);
}

void telemetry_cycle(telemetry_t *telemetry, drive_telemetry_t *values) {
    telemetry->backlog = frame_queue_peek(&telemetry->queue) != NULL;
    follow_fault(telemetry, values);
    enqueue_group(telemetry, DRIVE_TELEMETRY_GROUP_MEASUREMENTS, KEPT_FOR_OTHERS, values);
    telemetry->position_used |= values->position.position_state != DRIVE_POSITION_STATE_INACTIVE;
    enqueue_group(telemetry, DRIVE_TELEMETRY_GROUP_POSITION, KEPT_FOR_OTHERS, values);
    enqueue_group(telemetry, DRIVE_TELEMETRY_GROUP_FAULT, KEPT_FOR_HEARTBEAT, values);
    values->bus_counters.telemetry_dropped = telemetry->dropped;
    enqueue_group(telemetry, DRIVE_TELEMETRY_GROUP_COUNTERS, KEPT_FOR_HEARTBEAT, values);
    enqueue_background(telemetry, DRIVE_TELEMETRY_GROUP_BACKGROUND, true, values);
    enqueue_background(telemetry, DRIVE_TELEMETRY_GROUP_IDLE, !telemetry->backlog, values);

    telemetry_advance(telemetry, values->status.time_us);
}

bool telemetry_pauses(telemetry_t *telemetry, uint32_t time_us) {
    const uint32_t age_us = time_us - telemetry->background_us;
    if (!telemetry->backlog || !telemetry->background_in_mailbox || age_us < TELEMETRY_PATIENCE_US) {
        return false;
    }
    const bool pauses = age_us < TELEMETRY_PATIENCE_US + TELEMETRY_PAUSE_US;
    if (!pauses) { /* other nodes have filled the bus meanwhile */
        telemetry->background_us = time_us;
    }
    return pauses;
}

void telemetry_flush(telemetry_t *telemetry, hal_t *hal, uint32_t time_us) {
    const hal_can_frame_t *frame;
    while ((frame = frame_queue_peek(&telemetry->queue)) != NULL && hal_can_transmit(hal, frame)) {
        if (frame->identifier >= BACKGROUND_IDENTIFIERS) {
            telemetry->background_queued = false;
            telemetry->background_in_mailbox = true;
            telemetry->background_us = time_us;
        }
        frame_queue_pop(&telemetry->queue);
    }
}
