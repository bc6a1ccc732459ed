/* The bench of a drive's program: bus, recordings and rig as the options want them, the ready line, the end.
 *
 * What the programs share that put a firmware on the rig: the host executable in its own process, a target inside
 * QEMU. What goes wrong is one line on stderr.
 */
#ifndef BENCH_H
#define BENCH_H

#include <stdbool.h>
#include <stdio.h>

#include "host/options.h"
#include "plant/recorder.h"
#include "rig/rig.h"

#define BENCH_EXIT_MISTAKE 2

/* Large: static or on the heap. rig is for the port; the rest is bench.c's. */
typedef struct {
    rig_t rig;
    const options_t *options;
    recorder_t recorder;
    rig_stop_t stop;
    rig_firmware_t firmware;
    /* Rows of hal_pwm_compare_t: row n is what acts in the control period that starts at n + 1 periods, when no
     * interrupt was lost. NULL: none. */
    FILE *switches;
    int exit_code;
} bench_t;

/* Opens everything, with the rig at time 0. Signals that end a program are blocked from now on in this thread and those
 * it starts: the rig ends at them. Keeps options. False, with nothing left open: something cannot be had. */
bool bench_open(bench_t *bench, const options_t *options);

/* Joins the firmware, which has started the timer, says that all is ready, and serves until it is over. */
void bench_run(bench_t *bench, const rig_firmware_t *firmware);

/* Says that the drive refused to start: instead of bench_run. */
void bench_refused(bench_t *bench);

/* Closes everything; gives back the program's exit code, 0 or BENCH_EXIT_MISTAKE. */
int bench_close(bench_t *bench);

#endif
