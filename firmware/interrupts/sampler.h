/* A recorder of the drive's memory at the rate of an event: a triggered buffer, or a stream that the background sends.
 *
 * At every `divider`-th event it copies up to eight words of the drive, each with the variables in it, into a ring. As
 * a buffer it compares one variable with a level at every event, whatever the divider; from the event at which the
 * condition holds it goes on until the ring is full of `before` records that precede it, or those that there are, and
 * those that follow. As a stream it records until it is stopped; a record for which the background has left no room is
 * lost and counted.
 *
 * A word that another context writes is read whole; two words of one variable may be of two steps.
 *
 * Arming prepares what an event does, for an event is in an interrupt:
 * - A word of the drive is kept as a part of the drive, in 2^-32: the high half of the product with the number of words
 *   is its place, and whatever the part has become in memory, the place is within the drive.
 * - Every condition is one window. The variable is shifted by a multiplication to the upper end of a word, and its
 *   range may go beyond the largest word to the smallest. Bits of lower variables of its word count to the variable's
 *   step. A change is every value but the one at the arming. An edge waits until the variable is outside.
 * - A record begins before SAMPLER_WORDS, and the ring is longer by the rest of one. The one test that begins at 0
 *   again bounds a place that has changed in memory, too.
 */
#ifndef INTERRUPTS_SAMPLER_H
#define INTERRUPTS_SAMPLER_H

#include <stdbool.h>
#include <stdint.h>

#include "fixed/compiler.h"

#define SAMPLER_CHANNELS_MAX 8u
#define SAMPLER_DRIVE_WORDS_MAX 65536u

/* The drive as words, whatever they belong to, each of which an interrupt may write meanwhile. */
typedef const volatile uint32_t MAY_ALIAS sampler_word_t;

/* Size of the ring, words; 0 for a processor that has no memory for it: then nothing can be armed. */
#ifndef SAMPLER_WORDS
#define SAMPLER_WORDS 4096u
#endif

/* SAMPLER_EVENT_DEFERRED: the first control interrupt that finds a deferred step complete. The next step has changed
 * none of its results yet. */
typedef enum {
    SAMPLER_EVENT_CONTROL = 1,
    SAMPLER_EVENT_BACKGROUND,
    SAMPLER_EVENT_DEFERRED,
    SAMPLER_EVENT_IDENTIFY /* control periods that belong into the record of an experiment (control/identify.h) */
} sampler_event_t;

/* Bit of the events that the control interrupt has: one test for both. */
#define SAMPLER_IN_CONTROL 1u

typedef enum {
    SAMPLER_AT_ONCE,  /* at the next event */
    SAMPLER_AT_LEAST, /* value >= level */
    SAMPLER_AT_MOST,  /* value <= level */
    SAMPLER_RISING,   /* value >= level, and below it at the event before */
    SAMPLER_FALLING,  /* value <= level, and above it at the event before */
    SAMPLER_EQUAL,
    SAMPLER_CHANGED, /* another value than at the arming */
    SAMPLER_CONDITIONS
} sampler_condition_t;

typedef enum {
    SAMPLER_OFF,
    SAMPLER_STREAMS,
    SAMPLER_ARMED,    /* a buffer that waits for the trigger, or records what follows it */
    SAMPLER_COMPLETE, /* the ring is to be read */
} sampler_state_t;

/* A variable within a word. Words are counted from the drive's begin. */
typedef struct {
    uint16_t word;
    uint8_t left;  /* shift by which its highest bit becomes bit 31 */
    uint8_t right; /* then by which its lowest one becomes bit 0, 0..31 */
    bool is_signed;
} sampler_variable_t;

typedef struct {
    uint16_t word[SAMPLER_CHANNELS_MAX]; /* of the drive */
    uint8_t channels;                    /* 1..SAMPLER_CHANNELS_MAX */
    sampler_event_t event;
    uint16_t divider; /* events for each record, at least 1 */
    /* For the triggered buffer: */
    uint16_t before; /* records before the trigger */
    sampler_condition_t condition;
    sampler_variable_t variable;
    int32_t level; /* signed or not as the variable is */
} sampler_setup_t;

/* Members that an event reads or writes together are neighbours: one instruction for two. */
typedef struct {
    uint32_t event; /* at which it records, sampler_event_t; 0: none. Written last when it is armed */
    sampler_state_t state;
    uint32_t room;          /* records in the ring of a stream; 0: a buffer */
    uint32_t waiting_floor; /* while it waits for the trigger: the least of `left`; then 0 */
    uint32_t left;          /* records from the next one on, if the trigger comes now or has come */
    uint32_t countdown;     /* events to the next record */
    uint32_t divider;
    uint32_t place;        /* of the next record, words; of a complete buffer the oldest; from SAMPLER_WORDS on 0 */
    uint32_t record_words; /* the channels; before them in a stream the time, us */
    uint32_t last_channel; /* 0..SAMPLER_CHANNELS_MAX - 1 */
    uint32_t capacity;     /* of the ring, records */
    /* The trigger's variable: */
    uint32_t trigger_part; /* as `part` */
    uint32_t factor;       /* that shifts it to the upper end of a word */
    uint32_t window_end;   /* the last value of the condition */
    uint32_t window_length;
    uint32_t waits_for_outside; /* of an edge: 1 until it was outside */
    /* When the trigger came: */
    uint32_t trigger_events;             /* events to the next record */
    uint32_t trigger_left;               /* `left`: the others of the ring precede it */
    uint32_t part[SAMPLER_CHANNELS_MAX]; /* the words of the drive, in 2^-32 of it */
    uint32_t written, taken; /* records of a stream, modulo 2^32; the second one is written by the background */
    uint32_t taken_place;
    uint32_t lost; /* records of a stream */
    uint32_t ring[SAMPLER_WORDS > 0u ? SAMPLER_WORDS + SAMPLER_CHANNELS_MAX : 1u];
} sampler_t;

/* Stops recording; the ring stays as it is. [background] */
void sampler_stop(sampler_t *sampler);

/* Records from the next event on. streams: as a stream; else as a triggered buffer. False, with nothing changed, when a
 * member of the set-up is out of its range, the variable cannot have the level, or the ring has fewer than two records
 * more than `before`. memory: the drive, of `words` words, at most SAMPLER_DRIVE_WORDS_MAX. [background] */
bool sampler_arm(sampler_t *sampler, const sampler_setup_t *setup, bool streams, const void *memory, uint32_t words);

/* Triggers now, whatever the condition; no effect unless it waits. [background] */
void sampler_trigger(sampler_t *sampler);

/* The oldest record of a stream that is not taken: its words, the first one the time; false when there is none.
 * [background] */
bool sampler_take(sampler_t *sampler, uint32_t record[1 + SAMPLER_CHANNELS_MAX]);

/* An event for which sampler->event is set; the control interrupt's is one that has SAMPLER_IN_CONTROL. memory: the
 * drive, of `words` words. skipped, of a control interrupt: periods since one found a deferred step complete. [context
 * of the event] */
void sampler_record(sampler_t *sampler, const void *memory, uint32_t words, uint32_t time_us, uint32_t skipped);

#endif
