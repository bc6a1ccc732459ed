/* Worlds by seed: runs a range of seeds, each in a process of its own, and prints a JSON line for each.
 *
 *   salient_campaign --machines FILE [--first SEED] [--seeds N] [--step N] [--healthy|--motion] [--keep MASK]
 *                    [--frames FILE] [--describe] [--serve] [--branch CONTROLLER SPEED_RPM LOAD_NM FIRST TICKS EVERY]
 *                    [--flips CONTROLLER STATE FIRST COUNT STEP]
 *
 * --serve reads the seeds from standard input, a line each.
 *
 * FILE has a line for each machine: image, speed_base_rpm, torque_rated_Nm, torque_max_Nm, over_speed_rpm,
 * over_voltage_V, under_voltage_V, trip_current_A, command_lsb_rpm, speed_command_max_rpm, command_lsb_Nm,
 * current_lsb_A, voltage_lsb_V, rate_min_hz, name. */
#define _POSIX_C_SOURCE 200809L

#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include "campaign/branch.h"
#include "campaign/flips.h"
#include "campaign/run.h"
#include "campaign/world_draw.h"
#include "campaign/world_motion.h"
#include "host/host_drive.h"

#define EXIT_USAGE 2
#define PROCESSOR_MAX_S 30 /* of a seed, which takes some hundredths of a second */

static world_machine_t machines[WORLD_MACHINES_MAX];
static unsigned machine_count;
static host_drive_t host;
static run_t run;
static world_t world;
machine_tables_t machine_tables;

/* --- The drive --- */

static bool start(const world_t *of, board_t *board, rig_firmware_t *firmware) {
    const drive_config_t config = {.control_rate_hz = of->control_rate_hz,
                                   .controller = (drive_controller_t)of->controller,
                                   .telemetry_period_ms = 4,
                                   .canopen_node = of->client == WORLD_CLIENT_CANOPEN ? MASTER_NODE : 0};
    return machine_image_tables(&of->machine->image, &machine_tables_structure, &machine_tables) &&
           host_drive_start(&host, board, &config, firmware);
}

static observation_drive_t view(void) {
    const state_machine_t *state_machine = &host.drive.control.state_machine;
    const control_measurement_t *measured = &host.drive.control.measurement;
    observation_drive_t seen = {.state = (uint8_t)state_machine->state,
                                .fault = (uint8_t)state_machine->record.fault,
                                .checks = (uint32_t)state_machine->record.fault_mask,
                                .angle = measured->angle,
                                .heat = {temperature_C(&host.drive.temperature, TEMPERATURE_WINDING),
                                         temperature_C(&host.drive.temperature, TEMPERATURE_INVERTER)},
                                .link_voltage = (double)measured->dc_link_voltage_q6 / machine_tables.voltage_range_q6};
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        seen.current[phase] = (double)measured->current_q9[phase] / machine_tables.current_range_q9;
    }
    return seen;
}

static const run_drive_t drive = {
    .start = start,
    .view = view,
    .parameters = {PARAMETER_DEGRADED_RUNNING, PARAMETER_TORQUE_MAX_NM},
    .limit_bits = 8 * sizeof host.drive.control_parameters.protection,
    .constant_bits = 8 * sizeof host.drive.control_parameters,
};

/* --- Machines --- */

static bool read_machines(const char *path) {
    FILE *file = fopen(path, "r");
    if (!file) {
        fprintf(stderr, "salient: %s: %s\n", path, strerror(errno));
        return false;
    }
    char image[1024];
    world_machine_t *each = machines;
    while (machine_count < WORLD_MACHINES_MAX &&
           fscanf(file, "%1023s %lf %lf %lf %lf %lf %lf %lf %lf %lf %lf %lf %lf %u %63s", image, &each->speed_base_rpm,
                  &each->torque_rated_Nm, &each->torque_max_Nm, &each->over_speed_rpm, &each->over_voltage_V,
                  &each->under_voltage_V, &each->trip_current_A, &each->command_lsb_rpm, &each->speed_command_max_rpm,
                  &each->command_lsb_Nm, &each->current_lsb_A, &each->voltage_lsb_V, &each->rate_min_hz,
                  each->name) == 15) {
        if (!machine_image_open(&each->image, image)) {
            fclose(file);
            return false;
        }
        each++;
        machine_count++;
    }
    fclose(file);
    if (machine_count == 0) {
        fprintf(stderr, "salient: %s: no machine\n", path);
    }
    return machine_count > 0;
}

/* --- One seed --- */

static void print_result(void) {
    const checkers_t *checkers = &run.checkers;
    const observation_t *seen = &checkers->seen;
    printf("{\"seed\": %" PRIu64 ", \"hash\": \"%016" PRIx64 "\", \"machine\": %u, \"controller\": %u, \"virtual_us\": "
           "%" PRIu64 ", \"causes\": [",
           world.seed, run.sender.hash, (unsigned)(world.machine - machines), world.controller,
           run.rig.board.time_ns / 1000);
    for (unsigned i = 0; i < seen->causes; i++) {
        printf("%s%u", i ? ", " : "", seen->cause[i]);
    }
    printf("], \"recovered\": %s, \"held\": %s, \"violations\": [", seen->recovery.settled ? "true" : "false",
           seen->recovery.held ? "true" : "false");
    for (unsigned i = 0; i < checkers->violations; i++) {
        const checkers_violation_t *violation = &checkers->violation[i];
        printf("%s{\"rule\": \"%s\", \"number\": %u, \"at_us\": %" PRIu64 ", \"value\": %.6g}", i ? ", " : "",
               violation->rule, violation->number, violation->time_us, violation->value);
    }
    printf("], \"cells\": [");
    const char *separator = "";
    for (unsigned cell = 0; cell < CHECKERS_CELLS; cell++) {
        if ((unsigned)checkers->cell[cell / 8] >> cell % 8 & 1u) {
            printf("%s%u", separator, cell);
            separator = ", ";
        }
    }
    printf("]}\n");
}

typedef struct {
    const char *machines_file, *frames_file;
    uint64_t first, seeds, step, keep;
    bool healthy, motion, describe, serve;
    branch_setting_t branch;
    flips_setting_t flip;
    bool branches, flips;
} arguments_t;

static int run_seed(const arguments_t *arguments, uint64_t seed) {
    (arguments->motion    ? world_draw_motion
     : arguments->healthy ? world_draw_healthy
                          : world_draw)(&world, machines, machine_count, seed);
    world.kept = arguments->keep;
    if (arguments->describe) {
        world_print(&world);
        return 0;
    }
    FILE *record = NULL;
    if (arguments->frames_file && !(record = fopen(arguments->frames_file, "w"))) {
        fprintf(stderr, "salient: %s: %s\n", arguments->frames_file, strerror(errno));
        return EXIT_USAGE;
    }
    if (record) {
        setvbuf(record, NULL, _IOLBF, 0); /* what was sent before a crash */
    }
    if (run_begin(&run, &world, &drive, record)) {
        run_to_end(&run);
        print_result();
    } else {
        printf("{\"seed\": %" PRIu64 ", \"rejected\": true}\n", seed);
    }
    if (record) {
        fclose(record);
    }
    return 0;
}

/* In a process of its own: a seed starts from the same memory, and one that crashes, or does not end, ends no other. */
static int run_apart(const arguments_t *arguments, uint64_t seed) {
    fflush(stdout);
    const pid_t child = fork();
    if (child == 0) {
        setrlimit(RLIMIT_CPU, &(struct rlimit){PROCESSOR_MAX_S, PROCESSOR_MAX_S});
        const int code = run_seed(arguments, seed);
        fflush(stdout);
        _exit(code);
    }
    int status = 0;
    if (child < 0 || waitpid(child, &status, 0) != child) {
        fprintf(stderr, "salient: %s\n", strerror(errno));
        return 1;
    }
    if (WIFSIGNALED(status)) {
        printf("{\"seed\": %" PRIu64
               ", \"violations\": [{\"rule\": \"crash\", \"number\": %d, \"at_us\": 0, \"value\": "
               "0}]}\n",
               seed, WTERMSIG(status));
        return 0;
    }
    return WEXITSTATUS(status);
}

/* --- Command line --- */

static bool number(const char *text, uint64_t *value) {
    char *end;
    errno = 0;
    *value = strtoull(text, &end, 0);
    return errno == 0 && end != text && *end == '\0' && text[0] != '-';
}

/* The rest of a command line, from an option on. */
typedef struct {
    char **words;
    int count;
} words_t;

static bool parse_flag(arguments_t *arguments, const char *option) {
    const struct {
        const char *name;
        bool *to;
    } flags[] = {{"--healthy", &arguments->healthy},
                 {"--motion", &arguments->motion},
                 {"--describe", &arguments->describe},
                 {"--serve", &arguments->serve}};
    for (unsigned i = 0; i < sizeof flags / sizeof *flags; i++) {
        if (strcmp(option, flags[i].name) == 0) {
            return *flags[i].to = true;
        }
    }
    return false;
}

/* Words that an option with a value takes; 0: no such option, or not a value of it. */
static int parse_value(arguments_t *arguments, words_t words) {
    const struct {
        const char *name;
        uint64_t *number;
        const char **text;
    } options[] = {{"--first", &arguments->first, NULL},
                   {"--seeds", &arguments->seeds, NULL},
                   {"--step", &arguments->step, NULL},
                   {"--keep", &arguments->keep, NULL},
                   {"--machines", NULL, &arguments->machines_file},
                   {"--frames", NULL, &arguments->frames_file}};
    for (unsigned i = 0; i < sizeof options / sizeof *options && words.count > 1; i++) {
        if (strcmp(words.words[0], options[i].name) != 0) {
            continue;
        }
        if (options[i].text) {
            *options[i].text = words.words[1];
        }
        return options[i].text || number(words.words[1], options[i].number) ? 2 : 0;
    }
    return 0;
}

static int parse_branch(arguments_t *arguments, words_t words) {
    if (strcmp(words.words[0], "--branch") != 0 || words.count <= BRANCH_ARGUMENTS) {
        return 0;
    }
    arguments->branches = branch_parse(&arguments->branch, &words.words[1]);
    return arguments->branches ? 1 + BRANCH_ARGUMENTS : 0;
}

static int parse_flips(arguments_t *arguments, words_t words) {
    if (strcmp(words.words[0], "--flips") != 0 || words.count <= FLIPS_ARGUMENTS) {
        return 0;
    }
    arguments->flips = flips_parse(&arguments->flip, &words.words[1]);
    return arguments->flips ? 1 + FLIPS_ARGUMENTS : 0;
}

static bool parse(arguments_t *arguments, int argc, char *argv[]) {
    *arguments = (arguments_t){.seeds = 1, .step = 1, .keep = UINT64_MAX};
    for (words_t words = {argv + 1, argc - 1}; words.count > 0;) {
        int taken = parse_flag(arguments, words.words[0]) ? 1 : parse_value(arguments, words);
        taken = taken ? taken : parse_branch(arguments, words);
        taken = taken ? taken : parse_flips(arguments, words);
        if (taken == 0) {
            fprintf(stderr, "salient: %s %s: not an option of salient_campaign, or not a whole number\n",
                    words.words[0], words.count > 1 ? words.words[1] : "");
            return false;
        }
        words.words += taken;
        words.count -= taken;
    }
    if (!arguments->machines_file) {
        fprintf(stderr, "salient: --machines: missing\n");
    }
    return arguments->machines_file;
}

int main(int argc, char *argv[]) {
    arguments_t arguments;
    if (!parse(&arguments, argc, argv) || !read_machines(arguments.machines_file)) {
        return EXIT_USAGE;
    }
    if (arguments.branches) {
        return branch_all(&arguments.branch, &run, &world, machines, &drive);
    }
    if (arguments.flips) {
        return flips_all(&arguments.flip, &run, &world, &machines[0], &drive, &host.drive, sizeof host.drive);
    }
    int code = 0;
    char line[64];
    while (arguments.serve && code == 0 && fgets(line, sizeof line, stdin)) {
        code = run_apart(&arguments, strtoull(line, NULL, 10));
        fflush(stdout);
    }
    for (uint64_t i = 0; i < arguments.seeds && code == 0 && !arguments.serve; i++) {
        code = run_apart(&arguments, arguments.first + i * arguments.step);
    }
    return code;
}
