/* The command line of the host executable. Names, ranges, defaults and usage text of the options are a table generated
 * from tools/src/salient/config.py. */
#ifndef OPTIONS_H
#define OPTIONS_H

#include <stddef.h>
#include <stdint.h>

#include "options_table.h"
#include "rig/rig.h"

typedef enum {
    OPTION_KIND_FLAG, /* bool; has no value */
    OPTION_KIND_INTEGER32,
    OPTION_KIND_INTEGER64,
    OPTION_KIND_NUMBER, /* double */
    OPTION_KIND_WORD,   /* one of words; parsed is its index */
    OPTION_KIND_FILE,   /* name of a file, not checked further */
    OPTION_KIND_BUS,    /* unix:PATH or socketcan:INTERFACE, PATH and INTERFACE not checked */
    OPTION_KIND_PACE,   /* parsed is a pacing_t */
} option_kind_t;

typedef struct {
    const char *name; /* without -- */
    option_kind_t kind;
    size_t offset;             /* of its member of options_t */
    size_t parsed_offset;      /* of a word and a pace: of the member with the meaning */
    const char *allowed;       /* ends a sentence that begins with "must be" */
    uint64_t minimum, maximum; /* of integers */
    const uint32_t *choices;   /* of integers; NULL: all between minimum and maximum */
    unsigned choice_count;     /* of integers */
    double low, high;          /* of a number */
    const char *const *words;  /* of a word; ended by NULL */
} option_t;

extern const option_t options_table[OPTION_COUNT];
extern const options_t options_defaults;
extern const char options_usage[]; /* a format; its %s is the program's name */

typedef enum { OPTIONS_RUN, OPTIONS_HELP, OPTIONS_ERROR } options_result_t;

/* Reads the command line. OPTIONS_HELP: the usage text was requested and written; OPTIONS_ERROR: one line on stderr
 * names the option, its value and the values allowed. */
options_result_t options_parse(options_t *options, int argc, char *argv[]);

/* The bench of the first drive, without its stop request and its transport. */
rig_config_t options_rig(const options_t *options, const machine_t *machine);

#endif
