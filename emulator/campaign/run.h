/* A world in one process: rig, clients, checkers, and the drive by the functions of run_drive_t. One at a time. */
#ifndef CAMPAIGN_RUN_H
#define CAMPAIGN_RUN_H

#include "campaign/checkers/checkers.h"
#include "campaign/sender.h"
#include "campaign/world.h"
#include "rig/rig.h"

/* The drive. start: from reset, with the machine of the world; false when it rejects the configuration. */
typedef struct {
    bool (*start)(const world_t *world, board_t *board, rig_firmware_t *firmware);
    observation_drive_t (*view)(void);
    sender_parameters_t parameters;
    uint32_t limit_bits, constant_bits; /* that a change of memory finds there */
} run_drive_t;

typedef struct run {
    rig_t rig;
    sender_t sender;
    checkers_t checkers;
    const world_t *world;
    const run_drive_t *drive;
    uint64_t end_ns;                           /* may be moved while it runs */
    void (*before_interrupt)(struct run *run); /* NULL: none */
} run_t;

/* Begins a run at time 0. False when the drive rejects the configuration. record: of the frames that are sent, or NULL;
 * frames: the clients' true state and hash are wanted. */
bool run_begin(run_t *run, const world_t *world, const run_drive_t *drive, FILE *record);

/* Forks the process with its run: true in the child. False in the parent once the child has ended, with the signal that
 * ended it, 0 for none; without a child the process ends. */
bool run_fork(unsigned *signal);

/* Runs to end_ns, and judges what is judged at the end. */
void run_to_end(run_t *run);

#endif
