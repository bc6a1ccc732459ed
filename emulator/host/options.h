/* The command line of the host executable. */
#ifndef OPTIONS_H
#define OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

#include "rig/pacing.h"

typedef struct {
    const char *can;           /* unix:PATH or socketcan:INTERFACE, not checked further */
    const char *pace;          /* as given */
    pacing_t pacing;           /* as read */
    const char *controller;    /* as given */
    unsigned controller_index; /* place in OPTIONS_CONTROLLERS */
    uint32_t control_rate_hz;
    unsigned encoder_bits; /* 8..24, 0 is ideal */
    unsigned adc_bits;     /* 12..16 */
    bool encoder_edges, immediate_pwm;
    uint64_t seed;
    double initial_angle_deg;
    const char *record; /* NULL: no recording */
    uint64_t record_step_ns, record_from_us;
    const char *record_switches; /* NULL: not recorded */
    uint32_t bit_rate;
    double stop_at_s; /* 0: no end */
    bool follow_stdin;
} options_t;

extern const char *const options_controllers[]; /* ended by NULL */

typedef enum { OPTIONS_RUN, OPTIONS_HELP, OPTIONS_ERROR } options_result_t;

/* Reads the command line. OPTIONS_HELP was asked for and printed; OPTIONS_ERROR: one line on stderr has named the
 * option, its value and what is allowed. */
options_result_t options_parse(options_t *options, int argc, char *argv[]);

#endif
