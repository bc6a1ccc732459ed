/* Simulation of drives on their benches: opens bus, recordings and rig from the options, prints the ready line, serves,
 * closes.
 *
 * Shared by the programs that join a firmware with the rig: the host executable in one process, a target inside QEMU.
 * Each error is one line on stderr.
 */
#ifndef HOST_SIMULATION_H
#define HOST_SIMULATION_H

#include <stdbool.h>
#include <stdio.h>

#include "host/machine_image.h"
#include "host/options.h"
#include "plant/recorder.h"
#include "rig/rig.h"

#define EXIT_USAGE 2 /* exit code after an invalid argument or a resource that cannot be opened */

#define SIMULATION_DRIVES_MAX CAN_BUS_DRIVES_MAX

/* Large: static or on the heap. rigs, of options->drives drives, and image are for the port; the other members are
 * private to simulation.c. */
typedef struct {
    rig_t rigs[SIMULATION_DRIVES_MAX];
    machine_image_t image;
    const options_t *options;
    recorder_t recorder;
    nvm_t memory; /* as read from the file of --memory; this and what is recorded is of the first drive */
    rig_stop_t stop;
    /* Rows of hal_pwm_compare_t: row n acts in the control period that starts at n + 1 periods, when no trigger was
     * missed. NULL: not recorded. */
    FILE *switches;
    int exit_code;
} simulation_t;

/* Opens everything, with the rig at time 0. Blocks the signals that end a program, in this thread and those it starts:
 * the rig ends at them. Keeps options. False, with nothing left open, when something cannot be opened. */
bool simulation_open(simulation_t *simulation, const options_t *options);

/* Joins the firmware of each drive, which has started its timer, prints the ready line, and serves until the end. */
void simulation_run(simulation_t *simulation, const rig_firmware_t firmware[]);

/* Reports that drive_init has rejected the configuration: instead of simulation_run. */
void simulation_rejected(simulation_t *simulation);

/* Closes everything; returns the program's exit code, 0 or EXIT_USAGE. */
int simulation_close(simulation_t *simulation);

#endif
