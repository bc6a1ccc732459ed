#define _POSIX_C_SOURCE 200809L

#include "host/simulation.h"

#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <string.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include "host/output.h"

#define MEMORY_OPTION "--memory"
#define SWITCHES_OPTION "--record-switches"

/* Descriptors that end the program: signals, and standard input with --follow-stdin. */
enum { STOP_SIGNAL, STOP_STDIN };

static bool stop_requested(void *context) {
    const rig_stop_t *stop = context;
    struct pollfd list[2];
    for (unsigned i = 0; i < 2; ++i) {
        list[i] = (struct pollfd){.fd = stop->descriptors[i], .events = POLLIN};
    }
    if (poll(list, 2, 0) <= 0) {
        return false;
    }
    if (list[STOP_SIGNAL].revents) {
        return true;
    }
    char discarded[4096]; /* only the end of standard input has a meaning */
    ssize_t size = read(STDIN_FILENO, discarded, sizeof discarded);
    return size == 0 || (size < 0 && errno != EAGAIN && errno != EINTR);
}

/* Signals become readable instead of interrupting; false when that is not possible. */
static bool stop_init(rig_stop_t *stop, bool follow_stdin) {
    sigset_t signals;
    sigemptyset(&signals);
    sigaddset(&signals, SIGINT);
    sigaddset(&signals, SIGTERM);
    sigaddset(&signals, SIGHUP);
    signal(SIGPIPE, SIG_IGN);
    *stop = (rig_stop_t){.requested = stop_requested, .context = stop};
    stop->descriptors[STOP_STDIN] = follow_stdin ? STDIN_FILENO : -1;
    stop->descriptors[STOP_SIGNAL] = -1;
    if (sigprocmask(SIG_BLOCK, &signals, NULL) != 0) {
        return false;
    }
    stop->descriptors[STOP_SIGNAL] = signalfd(-1, &signals, SFD_CLOEXEC | SFD_NONBLOCK);
    return stop->descriptors[STOP_SIGNAL] >= 0;
}

static void print_json_string(const char *text) {
    putchar('"');
    for (; *text; ++text) {
        unsigned char character = (unsigned char)*text;
        if (character == '"' || character == '\\') {
            printf("\\%c", character);
        } else if (character < 0x20) {
            printf("\\u%04x", character);
        } else {
            putchar(character);
        }
    }
    putchar('"');
}

static void print_ready(const options_t *options, const char *machine) {
    printf("{\"ready\": true, \"can\": ");
    print_json_string(options->can);
    printf(", \"pid\": %ld, \"machine\": ", (long)getpid());
    print_json_string(machine);
    printf(", \"controller\": ");
    print_json_string(options->controller);
    printf(", \"control_rate_hz\": %" PRIu32 ", \"pace\": ", options->control_rate_hz);
    print_json_string(options->pace);
    printf(", \"seed\": %" PRIu64 ", \"node\": %" PRIu32 ", \"drives\": %" PRIu32 "}\n", options->seed, options->node,
           options->drives);
    fflush(stdout);
}

/* Content of the drive's memory; a file that does not exist yet stands for an erased one. */
static bool read_memory(nvm_t *nvm, const char *path) {
    FILE *file = fopen(path, "rb");
    if (!file) {
        if (errno == ENOENT) {
            return true;
        }
        fprintf(stderr, "salient: %s %s: %s\n", MEMORY_OPTION, path, strerror(errno));
        return false;
    }
    const size_t size = fread(nvm->word, 1, sizeof nvm->word, file);
    const bool whole = size == sizeof nvm->word && fgetc(file) == EOF;
    fclose(file);
    if (!whole) {
        fprintf(stderr, "salient: %s %s: not the memory of a drive, %zu bytes\n", MEMORY_OPTION, path,
                sizeof nvm->word);
    }
    return whole;
}

static bool write_memory(const nvm_t *nvm, const char *path) {
    FILE *file = output_open(MEMORY_OPTION, path);
    return file && (fwrite(nvm->word, sizeof nvm->word, 1, file), output_close(file, MEMORY_OPTION, path));
}

/* Opens everything but the image. */
static bool open_bench(simulation_t *simulation, const options_t *options) {
    simulation->options = options;
    simulation->exit_code = 0;
    simulation->switches = NULL;
    simulation->recorder = (recorder_t){0};
    if (!stop_init(&simulation->stop, options->follow_stdin)) {
        fprintf(stderr, "salient: signals: %s\n", strerror(errno));
        return false;
    }
    nvm_init(&simulation->memory);
    if (options->memory && !read_memory(&simulation->memory, options->memory)) {
        return false;
    }
    char error[TRANSPORT_ERROR_SIZE];
    transport_t *transport = transport_open(options->can, error);
    if (!transport) {
        fprintf(stderr, "salient: %s\n", error);
        return false;
    }
    if (options->record &&
        !recorder_open(&simulation->recorder, options->record, simulation->image.machine.phases, error, sizeof error)) {
        fprintf(stderr, "salient: %s\n", error);
        transport_close(transport);
        return false;
    }
    if (options->record_switches) {
        simulation->switches = output_open(SWITCHES_OPTION, options->record_switches);
        if (!simulation->switches) {
            recorder_close(&simulation->recorder, error, sizeof error);
            transport_close(transport);
            return false;
        }
    }

    rig_config_t config = options_rig(options, &simulation->image.machine);
    config.stop = simulation->stop;
    config.transport = transport;
    rig_init(&simulation->rigs[0], &config);
    for (unsigned i = 1; i < options->drives; ++i) {
        ++config.node;
        ++config.seed;
        rig_add(&simulation->rigs[0], &simulation->rigs[i], &config);
    }
    memcpy(simulation->rigs[0].board.nvm.word, simulation->memory.word, sizeof simulation->memory.word);
    if (options->record) {
        plant_observe(&simulation->rigs[0].plant, options->record_from_us * 1000, options->record_step_ns,
                      recorder_sample, &simulation->recorder);
    }
    return true;
}

bool simulation_open(simulation_t *simulation, const options_t *options) {
    if (!machine_image_open(&simulation->image, options->machine_image)) {
        return false;
    }
    if (!open_bench(simulation, options)) {
        machine_image_close(&simulation->image);
        return false;
    }
    return true;
}

static void record_switches(void *context) {
    simulation_t *simulation = context;
    const hal_pwm_compare_t *active = &simulation->rigs[0].board.active;
    fwrite(active, sizeof *active, 1, simulation->switches);
}

void simulation_run(simulation_t *simulation, const rig_firmware_t firmware[]) {
    if (simulation->switches) {
        simulation->rigs[0].observer = (rig_observer_t){.after_interrupt = record_switches, .context = simulation};
    }
    for (unsigned i = 0; i < simulation->options->drives; ++i) {
        rig_join(&simulation->rigs[i], &firmware[i]);
    }
    print_ready(simulation->options, simulation->image.machine.name);
    while (rig_serve(&simulation->rigs[0], -1)) {
    }
    rig_finish(&simulation->rigs[0]);
    const transport_t *transport = simulation->rigs[0].config.transport;
    if (transport->failure) {
        fprintf(stderr, "salient: %s\n", transport->failure);
        simulation->exit_code = EXIT_USAGE;
    }
}

void simulation_rejected(simulation_t *simulation) {
    fprintf(stderr,
            "salient: machine %s at %" PRIu32 " Hz: fewer than 25 control periods in an electrical revolution at its"
            " drive.speed_max_rpm\n",
            simulation->image.machine.name, simulation->options->control_rate_hz);
    simulation->exit_code = EXIT_USAGE;
}

int simulation_close(simulation_t *simulation) {
    char error[TRANSPORT_ERROR_SIZE];
    if (!recorder_close(&simulation->recorder, error, sizeof error)) {
        fprintf(stderr, "salient: %s\n", error);
        simulation->exit_code = EXIT_USAGE;
    }
    if (simulation->switches &&
        !output_close(simulation->switches, SWITCHES_OPTION, simulation->options->record_switches)) {
        simulation->exit_code = EXIT_USAGE;
    }
    rig_close(&simulation->rigs[0]);
    if (simulation->options->memory && !write_memory(&simulation->rigs[0].board.nvm, simulation->options->memory)) {
        simulation->exit_code = EXIT_USAGE;
    }
    transport_close(simulation->rigs[0].config.transport);
    machine_image_close(&simulation->image);
    return simulation->exit_code;
}
