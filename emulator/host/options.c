#include "host/options.h"

#include <assert.h>
#include <errno.h>
#include <getopt.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "hal_adc.h"
#include "plant/units.h"
#include "rig/can_bus.h"

static_assert(OPTIONS_ADC_BITS_MIN == HAL_ADC_BITS_MIN && OPTIONS_ADC_BITS_MAX == HAL_ADC_BITS_MAX,
              "the record and the HAL disagree on the resolution of converters");
static_assert(OPTIONS_BIT_RATE_MIN == CAN_BUS_BIT_RATE_MIN && OPTIONS_BIT_RATE_MAX == CAN_BUS_BIT_RATE_MAX,
              "the record and the emulated bus disagree on bit rates");
static_assert(OPTIONS_DRIVES_MAX == CAN_BUS_DRIVES_MAX && OPTIONS_NODE_MAX == CAN_BUS_DRIVES_MAX - 1,
              "the record and the emulated bus disagree on the number of drives");

/* Return values of getopt_long: numbers of options from 1, because getopt_long returns 0 for another purpose. */
enum { HELP = OPTION_COUNT + 1 };

static options_result_t mistake(const char *format, ...) __attribute__((format(printf, 1, 2)));

static options_result_t mistake(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    fputs("salient: ", stderr);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    va_end(arguments);
    return OPTIONS_ERROR;
}

/* Decimal digits only. */
static bool read_integer(const option_t *option, const char *text, uint64_t *value) {
    if (text[0] == '\0' || strspn(text, "0123456789") != strlen(text)) {
        return false;
    }
    errno = 0;
    *value = strtoull(text, NULL, 10);
    if (errno != 0 || *value < option->minimum || *value > option->maximum) {
        return false;
    }
    bool found = option->choices == NULL;
    for (unsigned i = 0; i < option->choice_count; ++i) {
        found = found || *value == option->choices[i];
    }
    return found;
}

static bool read_number(const option_t *option, const char *text, double *value) {
    if (text[0] == '\0' || strspn(text, "0123456789.+-eE") != strlen(text)) {
        return false;
    }
    char *end;
    *value = strtod(text, &end);
    return *end == '\0' && *value >= option->low && *value <= option->high;
}

static bool read_word(const option_t *option, const char *text, uint32_t *index) {
    for (*index = 0; option->words[*index]; ++*index) {
        if (strcmp(text, option->words[*index]) == 0) {
            return true;
        }
    }
    return false;
}

static bool names_a_bus(const char *text) {
    static const char *const kinds[] = {"unix:", "socketcan:"};
    for (size_t i = 0; i < sizeof kinds / sizeof kinds[0]; ++i) {
        const size_t length = strlen(kinds[i]);
        if (strncmp(text, kinds[i], length) == 0 && text[length] != '\0') {
            return true;
        }
    }
    return false;
}

/* Stores a value that is not empty; false when it is not allowed. text: not used for a flag. */
static bool store(options_t *options, const option_t *option, const char *text) {
    void *const member = (char *)options + option->offset;
    void *const parsed = (char *)options + option->parsed_offset;
    uint64_t integer = 0;
    switch (option->kind) {
    case OPTION_KIND_FLAG:
        *(bool *)member = true;
        return true;
    case OPTION_KIND_INTEGER32:
        if (!read_integer(option, text, &integer)) {
            return false;
        }
        *(uint32_t *)member = (uint32_t)integer;
        return true;
    case OPTION_KIND_INTEGER64:
        return read_integer(option, text, member);
    case OPTION_KIND_NUMBER:
        return read_number(option, text, member);
    case OPTION_KIND_WORD:
        *(const char **)member = text;
        return read_word(option, text, parsed);
    case OPTION_KIND_FILE:
        *(const char **)member = text;
        return true;
    case OPTION_KIND_BUS:
        *(const char **)member = text;
        return names_a_bus(text);
    case OPTION_KIND_PACE:
        *(const char **)member = text;
        return pacing_parse(parsed, text);
    }
    return false;
}

/* Rules between options. given: the options of the command line. */
static options_result_t check_combination(const options_t *options, const bool given[OPTION_COUNT]) {
    if (!given[OPTION_CAN]) {
        return mistake("--can: missing; must be %s", options_table[OPTION_CAN].allowed);
    }
    if (!options->machine_image) {
        return mistake("--machine-image: missing; must be %s", options_table[OPTION_MACHINE_IMAGE].allowed);
    }
    if ((given[OPTION_RECORD_STEP_NS] || given[OPTION_RECORD_FROM_US]) && !options->record) {
        return mistake("--record-step-ns and --record-from-us require --record FILE.npy");
    }
    if (options->node + options->drives > CAN_BUS_DRIVES_MAX) {
        return mistake("--drives %u: with --node %u at most %u", options->drives, options->node,
                       CAN_BUS_DRIVES_MAX - options->node);
    }
    if (given[OPTION_STOP_AT_S] && options->pacing.kind == PACING_LOCKSTEP) {
        return mistake("--stop-at-s: not with --pace lockstep, where RIG_RUN_UNTIL moves time");
    }
    return OPTIONS_RUN;
}

options_result_t options_parse(options_t *options, int argc, char *argv[]) {
    struct option names[OPTION_COUNT + 2] = {
        [OPTION_COUNT] = {"help", no_argument, NULL, HELP},
    };
    for (int i = 0; i < OPTION_COUNT; ++i) {
        const bool is_flag = options_table[i].kind == OPTION_KIND_FLAG;
        names[i] = (struct option){options_table[i].name, is_flag ? no_argument : required_argument, NULL, i + 1};
    }
    *options = options_defaults;
    pacing_parse(&options->pacing, options->pace);
    bool given[OPTION_COUNT] = {false};
    int found;
    opterr = 0;
    while ((found = getopt_long(argc, argv, ":", names, NULL)) != -1) {
        if (found == '?') {
            return mistake("%s: unrecognised or ambiguous option; --help lists them", argv[optind - 1]);
        }
        if (found == ':') {
            return mistake("%s: requires a value", argv[optind - 1]);
        }
        if (found == HELP) {
            printf(options_usage, argv[0]);
            return OPTIONS_HELP;
        }
        const option_t *option = &options_table[found - 1];
        if (optarg && optarg[0] == '\0') {
            return mistake("--%s: requires a value", option->name);
        }
        if (!store(options, option, optarg)) {
            return mistake("--%s %s: must be %s", option->name, optarg, option->allowed);
        }
        given[found - 1] = true;
    }
    if (optind < argc) {
        return mistake("%s: unrecognised argument; --help lists the options", argv[optind]);
    }
    return check_combination(options, given);
}

rig_config_t options_rig(const options_t *options, const machine_t *machine) {
    return (rig_config_t){
        .machine = machine,
        .initial_angle_rad = options->initial_angle_deg * RAD_PER_DEG,
        .encoder_bits = options->encoder_bits,
        .adc_bits = options->adc_bits,
        .encoder_edges = options->encoder_edges,
        .immediate_pwm = options->immediate_pwm,
        .seed = options->seed,
        .node = options->node,
        .bit_rate = options->bit_rate,
        .drive_only = options->drive_only,
        .pacing = options->pacing,
        .stop_at_ns = options->stop_at_s > 0 ? (uint64_t)(options->stop_at_s * 1e9 + 0.5) : RIG_NEVER,
    };
}
