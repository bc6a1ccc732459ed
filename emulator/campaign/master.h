/* A CANopen master of a world: it writes its setting by SDO, starts the drive by the NMT, and sends controlword, mode
 * and references in receive PDOs each cycle, by the statusword that it hears, as a PLC does. Beside it, while the world
 * has them, a second master and a node that sends random frames of every service.
 *
 * All that they ask for is followed by their frames on the bus, as a device of CiA 402 may at most take it. Shares
 * no code with the firmware. */
#ifndef CAMPAIGN_MASTER_H
#define CAMPAIGN_MASTER_H

#include <stdbool.h>
#include <stdint.h>

#include "campaign/world.h"
#include "rig/transport.h"

#define MASTER_NODE 1u        /* of the drive */
#define MASTER_OWN 0x7Fu      /* of the master */
#define MASTER_UNITS 131072.0 /* of position in a revolution, by default */

/* Modes of CiA 402. */
enum { MODE_PP = 1, MODE_PV = 3, MODE_TQ = 4, MODE_HM = 6, MODE_CSP = 8, MODE_CSV = 9, MODE_CST = 10 };

/* Bits of the statusword. */
enum { STATUS_REACHED = 0x400, STATUS_LIMITED = 0x800, STATUS_ACKNOWLEDGED = 0x1000, STATUS_ERROR = 0x2000 };

/* Reasons to stop. */
typedef enum {
    MASTER_GOES_ON,
    MASTER_STOPS, /* by a ramp, at whose end all switches open */
    MASTER_HOLDS, /* by a ramp, and the run goes on */
    MASTER_OPENS, /* all switches open at once */
} master_stop_t;

/* The drive by its frames. */
typedef struct {
    bool heard;       /* a statusword, */
    uint16_t status;  /* the last one */
    bool placed;      /* a position, */
    int32_t position; /* the last one */
    uint64_t placed_ns, status_ns;
} master_drive_t;

/* Requests by the frames on the bus. */
typedef struct {
    bool operational;
    bool prepared;         /* shutdown has come since the drive was last disabled, */
    bool enabled;          /* and enable operation behind it */
    bool unsure;           /* random frames may have changed what frames mean */
    uint64_t enabled_ns;   /* the last time */
    uint64_t withdrawn_ns; /* enabled until then; 0: never yet */
    master_stop_t stop;
    uint64_t stop_ns;  /* since when */
    uint64_t sign_ns;  /* last sign of the master that is watched */
    unsigned mode;     /* in the last frame */
    bool aimed;        /* a set-point or target has come */
    double target_rev; /* the last one, over relative ones */
    uint64_t target_ns;
    unsigned targets;
    uint16_t word; /* last controlword */
} master_wish_t;

typedef struct {
    /* Before the drive runs. */
    unsigned written;    /* entries of the setting */
    uint64_t started_us; /* 0: not yet */
    uint64_t idle_us;    /* nothing before, after a command of the NMT */
    uint64_t due_us;
    /* In it. */
    unsigned taken;                /* targets of profile position that the drive has acknowledged */
    bool ordered;                  /* bit 4 is set */
    double place_rev, speed_rev_s; /* cyclic position: of the target sent */
    bool follows;                  /* it has begun */
    uint64_t guard_us, heartbeat_us;
    uint64_t drawn; /* random numbers */
    master_drive_t drive;
    master_wish_t wish;
} master_t;

struct sender;

/* A step of a millisecond. */
void master_step(struct sender *sender, const transport_receiver_t *receiver);

/* Controlword, mode, and targets of this cycle (master_orders.c). */
typedef struct {
    uint16_t word;
    uint8_t mode;
    int32_t position, velocity;
    int16_t torque;
} master_orders_t;
master_orders_t master_orders(struct sender *sender);

/* A frame of a client is on the bus; a frame of the drive (master_seen.c). */
void master_on_bus(struct sender *sender, uint64_t time_ns, const struct can_frame *frame);
void master_on_frame(struct sender *sender, uint64_t time_ns, const struct can_frame *frame);

#endif
