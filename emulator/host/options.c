#include "host/options.h"

#include <errno.h>
#include <getopt.h>
#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "hal_adc.h"
#include "rig/can_bus.h"

const char *const options_controllers[] = {"traditional", "paper", "salient", NULL};

static const char usage[] =
    "usage: %s --can unix:PATH|socketcan:INTERFACE [option...]\n"
    "  --pace lockstep|realtime|xN|free   how virtual time moves, xN: N times real time (default realtime)\n"
    "  --controller traditional|paper     (default paper)\n"
    "  --control-rate-hz N                20000, 40000, 50000, 100000 or 1000000 (default 40000)\n"
    "  --encoder-bits N                   8..24, or 0 for an ideal encoder (default 17)\n"
    "  --encoder-edges                    the board captures the encoder's edges\n"
    "  --adc-bits N                       12..16 (default 12)\n"
    "  --immediate-pwm                    compare values act at once, not in the next period: no converter does that\n"
    "  --seed N                           of all noise (default 1)\n"
    "  --initial-angle-deg X              rotor angle at the start, -360..360 (default 0)\n"
    "  --record FILE.npy                  records the true state\n"
    "  --record-step-ns N                 its step, from 100 (default 1000)\n"
    "  --record-from-us N                 when it begins (default 0)\n"
    "  --record-switches FILE             records the compare values of each control period, for other simulators\n"
    "  --bit-rate N                       of the emulated bus, 10000..1000000 bit/s (default 1000000)\n"
    "  --stop-at-s X                      ends at this virtual time; not with --pace lockstep\n"
    "  --follow-stdin                     ends when standard input does\n";

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

/* Decimal digits only, at most `maximum`. */
static bool read_integer(const char *text, uint64_t maximum, uint64_t *value) {
    if (text[0] == '\0' || strspn(text, "0123456789") != strlen(text)) {
        return false;
    }
    errno = 0;
    *value = strtoull(text, NULL, 10);
    return errno == 0 && *value <= maximum;
}

static bool read_number(const char *text, double minimum, double maximum, double *value) {
    if (text[0] == '\0' || strspn(text, "0123456789.+-eE") != strlen(text)) {
        return false;
    }
    char *end;
    *value = strtod(text, &end);
    return *end == '\0' && *value >= minimum && *value <= maximum;
}

enum {
    OPTION_CAN = 1,
    OPTION_PACE,
    OPTION_CONTROLLER,
    OPTION_CONTROL_RATE,
    OPTION_ENCODER_BITS,
    OPTION_ENCODER_EDGES,
    OPTION_ADC_BITS,
    OPTION_IMMEDIATE_PWM,
    OPTION_SEED,
    OPTION_INITIAL_ANGLE,
    OPTION_RECORD,
    OPTION_RECORD_STEP,
    OPTION_RECORD_FROM,
    OPTION_RECORD_SWITCHES,
    OPTION_BIT_RATE,
    OPTION_STOP_AT,
    OPTION_FOLLOW_STDIN,
    OPTION_HELP
};

static const struct option long_options[] = {
    {"can", required_argument, NULL, OPTION_CAN},
    {"pace", required_argument, NULL, OPTION_PACE},
    {"controller", required_argument, NULL, OPTION_CONTROLLER},
    {"control-rate-hz", required_argument, NULL, OPTION_CONTROL_RATE},
    {"encoder-bits", required_argument, NULL, OPTION_ENCODER_BITS},
    {"encoder-edges", no_argument, NULL, OPTION_ENCODER_EDGES},
    {"immediate-pwm", no_argument, NULL, OPTION_IMMEDIATE_PWM},
    {"adc-bits", required_argument, NULL, OPTION_ADC_BITS},
    {"seed", required_argument, NULL, OPTION_SEED},
    {"initial-angle-deg", required_argument, NULL, OPTION_INITIAL_ANGLE},
    {"record", required_argument, NULL, OPTION_RECORD},
    {"record-step-ns", required_argument, NULL, OPTION_RECORD_STEP},
    {"record-from-us", required_argument, NULL, OPTION_RECORD_FROM},
    {"record-switches", required_argument, NULL, OPTION_RECORD_SWITCHES},
    {"bit-rate", required_argument, NULL, OPTION_BIT_RATE},
    {"stop-at-s", required_argument, NULL, OPTION_STOP_AT},
    {"follow-stdin", no_argument, NULL, OPTION_FOLLOW_STDIN},
    {"help", no_argument, NULL, OPTION_HELP},
    {0},
};

static options_result_t take(options_t *options, int option, const char *text) {
    uint64_t integer = 0;
    switch (option) {
    case OPTION_CAN:
        options->can = text;
        break;
    case OPTION_PACE:
        options->pace = text;
        if (!pacing_parse(&options->pacing, text)) {
            return mistake("--pace %s: allowed are lockstep, realtime, free and xN with N from %g to %g", text,
                           PACING_FACTOR_MIN, PACING_FACTOR_MAX);
        }
        break;
    case OPTION_CONTROLLER:
        options->controller = text;
        for (options->controller_index = 0; options_controllers[options->controller_index];
             ++options->controller_index) {
            if (strcmp(text, options_controllers[options->controller_index]) == 0) {
                return OPTIONS_RUN;
            }
        }
        return mistake("--controller %s: allowed are traditional, paper and salient", text);
    case OPTION_CONTROL_RATE:
        if (!read_integer(text, UINT32_MAX, &integer) ||
            (integer != 20000 && integer != 40000 && integer != 50000 && integer != 100000 && integer != 1000000)) {
            return mistake("--control-rate-hz %s: allowed are 20000, 40000, 50000, 100000 and 1000000", text);
        }
        options->control_rate_hz = (uint32_t)integer;
        break;
    case OPTION_ENCODER_BITS:
        if (!read_integer(text, 24, &integer) || (integer != 0 && integer < 8)) {
            return mistake("--encoder-bits %s: allowed are 8 to 24, and 0 for an ideal encoder", text);
        }
        options->encoder_bits = (unsigned)integer;
        break;
    case OPTION_ENCODER_EDGES:
        options->encoder_edges = true;
        break;
    case OPTION_IMMEDIATE_PWM:
        options->immediate_pwm = true;
        break;
    case OPTION_ADC_BITS:
        if (!read_integer(text, HAL_ADC_BITS_MAX, &integer) || integer < HAL_ADC_BITS_MIN) {
            return mistake("--adc-bits %s: allowed are %d to %d", text, HAL_ADC_BITS_MIN, HAL_ADC_BITS_MAX);
        }
        options->adc_bits = (unsigned)integer;
        break;
    case OPTION_SEED:
        if (!read_integer(text, UINT64_MAX, &options->seed)) {
            return mistake("--seed %s: allowed are whole numbers from 0 to %" PRIu64, text, UINT64_MAX);
        }
        break;
    case OPTION_INITIAL_ANGLE:
        if (!read_number(text, -360.0, 360.0, &options->initial_angle_deg)) {
            return mistake("--initial-angle-deg %s: allowed are numbers from -360 to 360", text);
        }
        break;
    case OPTION_RECORD:
        options->record = text;
        if (text[0] == '\0') {
            return mistake("--record: the name of a file is missing");
        }
        break;
    case OPTION_RECORD_STEP:
        if (!read_integer(text, 1000000000, &options->record_step_ns) || options->record_step_ns < 100) {
            return mistake("--record-step-ns %s: allowed are whole numbers from 100 to 1000000000", text);
        }
        break;
    case OPTION_RECORD_FROM:
        if (!read_integer(text, UINT64_MAX / 1000, &options->record_from_us)) {
            return mistake("--record-from-us %s: allowed are whole numbers from 0 to %" PRIu64, text,
                           UINT64_MAX / 1000);
        }
        break;
    case OPTION_RECORD_SWITCHES:
        options->record_switches = text;
        if (text[0] == '\0') {
            return mistake("--record-switches: the name of a file is missing");
        }
        break;
    case OPTION_BIT_RATE:
        if (!read_integer(text, CAN_BUS_BIT_RATE_MAX, &integer) || integer < CAN_BUS_BIT_RATE_MIN) {
            return mistake("--bit-rate %s: allowed are whole numbers from %d to %d", text, CAN_BUS_BIT_RATE_MIN,
                           CAN_BUS_BIT_RATE_MAX);
        }
        options->bit_rate = (uint32_t)integer;
        break;
    case OPTION_STOP_AT:
        if (!read_number(text, 1e-6, 281474.0, &options->stop_at_s)) {
            return mistake("--stop-at-s %s: allowed are numbers from 0.000001 to 281474", text);
        }
        break;
    case OPTION_FOLLOW_STDIN:
        options->follow_stdin = true;
        break;
    default:
        break;
    }
    return OPTIONS_RUN;
}

options_result_t options_parse(options_t *options, int argc, char *argv[]) {
    *options = (options_t){.pace = "realtime",
                           .pacing = {.kind = PACING_TIMED, .factor = 1.0},
                           .controller = "paper",
                           .controller_index = 1,
                           .control_rate_hz = 40000,
                           .encoder_bits = 17,
                           .adc_bits = HAL_ADC_BITS_MIN,
                           .seed = 1,
                           .record_step_ns = 1000,
                           .bit_rate = CAN_BUS_BIT_RATE_MAX};
    bool record_detail = false;
    int option;
    opterr = 0;
    while ((option = getopt_long(argc, argv, ":", long_options, NULL)) != -1) {
        if (option == '?') {
            return mistake("%s: not an option, or short for more than one; --help lists them", argv[optind - 1]);
        }
        if (option == ':') {
            return mistake("%s: its value is missing", argv[optind - 1]);
        }
        if (option == OPTION_HELP) {
            printf(usage, argv[0]);
            return OPTIONS_HELP;
        }
        record_detail = record_detail || option == OPTION_RECORD_STEP || option == OPTION_RECORD_FROM;
        options_result_t result = take(options, option, optarg);
        if (result != OPTIONS_RUN) {
            return result;
        }
    }
    if (optind < argc) {
        return mistake("%s: no such argument; --help lists the options", argv[optind]);
    }
    if (!options->can) {
        return mistake("--can is missing: unix:PATH or socketcan:INTERFACE");
    }
    if (record_detail && !options->record) {
        return mistake("--record-step-ns and --record-from-us need --record FILE.npy");
    }
    if (options->stop_at_s > 0 && options->pacing.kind == PACING_LOCKSTEP) {
        return mistake("--stop-at-s: not with --pace lockstep, where time runs as RIG_RUN_UNTIL says");
    }
    return OPTIONS_RUN;
}
