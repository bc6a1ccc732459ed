/* Discrete-event scheduler: a due time and a handler for each event. Next event first, one thread.
 *
 * Events that are due at the same instant are handled in the order of scheduler_event_t, and of one kind in the
 * order of the list of schedulers.
 */
#ifndef RIG_SCHEDULER_H
#define RIG_SCHEDULER_H

#include <stdint.h>

#define SCHEDULER_NEVER UINT64_MAX

/* In the order of handling at equal times. */
typedef enum {
    EVENT_BENCH_VARIABLE, /* a bench variable changes (RIG_SET) */
    EVENT_FAULT,          /* a fault begins or ends (RIG_FAULT) */
    EVENT_SUPPLY,         /* a supply with ripple takes its next step */
    EVENT_LOAD,           /* a load that moves takes its next step */
    EVENT_DYNAMOMETER,    /* the shaft has the speed at which it is held */
    EVENT_CAN,            /* the CAN bus: a frame is complete, or the next one may start */
    EVENT_CURRENT_HOLD,   /* delayed current sensors hold the phase currents */
    EVENT_CONTROL,        /* a control period starts */
    EVENT_BACKGROUND,     /* the background resumes after an interrupt that takes time */
    EVENT_WATCHDOG,       /* the watchdog's time may be over */
    EVENT_TRUTH,          /* the RIG_TRUTH frames are due */
    EVENT_COUNT
} scheduler_event_t;

/* Handles the event that is due at now_ns; the handler sets the event's next due time. */
typedef void (*scheduler_handler_t)(void *context, uint64_t now_ns);

typedef struct scheduler {
    struct scheduler *next;       /* of another drive on the same clock, or NULL */
    uint64_t *clock_ns;           /* virtual time, advanced by scheduler_run alone */
    uint64_t due_ns[EVENT_COUNT]; /* SCHEDULER_NEVER: not scheduled; never before the clock */
    const scheduler_handler_t *handlers;
    void *context;
} scheduler_t;

/* Nothing scheduled. handlers has EVENT_COUNT entries; clock and handlers are kept. */
void scheduler_init(scheduler_t *scheduler, uint64_t *clock_ns, const scheduler_handler_t *handlers, void *context);

/* Handles every event of a list of schedulers up to and including until_ns, which all clocks show afterwards. */
void scheduler_run(scheduler_t *first, uint64_t until_ns);

#endif
