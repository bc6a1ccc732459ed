/* One drive on its bench: the firmware, the host port and the emulator in one process and one thread. */
#define _POSIX_C_SOURCE 200809L

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include "control/machine_tables.h"
#include "drive/drive.h"
#include "hal_host.h"
#include "options.h"
#include "plant/machine.h"
#include "plant/recorder.h"
#include "rig/rig.h"

#define EXIT_MISTAKE 2
#define RAD_PER_DEG (3.14159265358979323846 / 180.0)

/* Large; they live as long as the process. */
static rig_t rig;
static drive_t drive;

/* Rows of hal_pwm_compare_t: row n is what acts in the control period that starts at n + 1 periods, when no
 * interrupt was lost. NULL: none. */
static FILE *switches_file;

static void control_interrupt(void *context) {
    drive_control_interrupt(context);
    if (switches_file) {
        fwrite(&rig.board.active, sizeof rig.board.active, 1, switches_file);
    }
}
static void background(void *context) {
    drive_background(context);
}

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
    char discarded[4096]; /* what is written to standard input means nothing, only its end does */
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

static void print_ready(const options_t *options) {
    printf("{\"ready\": true, \"can\": ");
    print_json_string(options->can);
    printf(", \"pid\": %ld, \"machine\": ", (long)getpid());
    print_json_string(machine_plant.name);
    printf(", \"controller\": ");
    print_json_string(options->controller);
    printf(", \"control_rate_hz\": %" PRIu32 ", \"pace\": ", options->control_rate_hz);
    print_json_string(options->pace);
    printf(", \"seed\": %" PRIu64 "}\n", options->seed);
    fflush(stdout);
}

int main(int argc, char *argv[]) {
    options_t options;
    options_result_t result = options_parse(&options, argc, argv);
    if (result != OPTIONS_RUN) {
        return result == OPTIONS_HELP ? 0 : EXIT_MISTAKE;
    }

    rig_stop_t stop;
    if (!stop_init(&stop, options.follow_stdin)) {
        fprintf(stderr, "salient: signals: %s\n", strerror(errno));
        return EXIT_MISTAKE;
    }
    char error[TRANSPORT_ERROR_SIZE];
    transport_t *transport = transport_open(options.can, error);
    if (!transport) {
        fprintf(stderr, "salient: %s\n", error);
        return EXIT_MISTAKE;
    }
    recorder_t recorder = {0};
    if (options.record && !recorder_open(&recorder, options.record, machine_plant.phases, error, sizeof error)) {
        fprintf(stderr, "salient: %s\n", error);
        transport_close(transport);
        return EXIT_MISTAKE;
    }

    if (options.record_switches) {
        switches_file = fopen(options.record_switches, "wb");
        if (!switches_file) {
            fprintf(stderr, "salient: --record-switches %s: %s\n", options.record_switches, strerror(errno));
            recorder_close(&recorder, error, sizeof error);
            transport_close(transport);
            return EXIT_MISTAKE;
        }
    }

    const rig_config_t config = {
        .machine = &machine_plant,
        .initial_angle_rad = options.initial_angle_deg * RAD_PER_DEG,
        .encoder_bits = options.encoder_bits,
        .adc_bits = options.adc_bits,
        .encoder_edges = options.encoder_edges,
        .immediate_pwm = options.immediate_pwm,
        .seed = options.seed,
        .bit_rate = options.bit_rate,
        .pacing = options.pacing,
        .stop_at_ns = options.stop_at_s > 0 ? (uint64_t)(options.stop_at_s * 1e9 + 0.5) : RIG_NEVER,
        .stop = stop,
        .transport = transport,
    };
    rig_init(&rig, &config);
    if (options.record) {
        plant_observe(&rig.plant, options.record_from_us * 1000, options.record_step_ns, recorder_sample, &recorder);
    }

    hal_t hal = {.board = &rig.board};
    const drive_config_t drive_config = {
        .control_rate_hz = options.control_rate_hz,
        .controller = (drive_controller_t)options.controller_index,
    };
    int exit_code = 0;
    if (drive_init(&drive, &hal, &machine_tables, &drive_config)) {
        rig_join(&rig, &(rig_firmware_t){
                           .control_interrupt = control_interrupt, .background = background, .context = &drive});
        print_ready(&options);
        while (rig_serve(&rig, -1)) {
        }
        rig_finish(&rig);
        if (transport->failure) {
            fprintf(stderr, "salient: %s\n", transport->failure);
            exit_code = EXIT_MISTAKE;
        }
    } else {
        fprintf(stderr, "salient: the drive refuses machine %s at %" PRIu32 " Hz\n", machine_plant.name,
                options.control_rate_hz);
        exit_code = EXIT_MISTAKE;
    }
    if (!recorder_close(&recorder, error, sizeof error)) {
        fprintf(stderr, "salient: %s\n", error);
        exit_code = EXIT_MISTAKE;
    }
    if (switches_file) {
        const bool written = !ferror(switches_file);
        if (fclose(switches_file) != 0 || !written) {
            fprintf(stderr, "salient: --record-switches %s: not all could be written\n", options.record_switches);
            exit_code = EXIT_MISTAKE;
        }
    }
    transport_close(transport);
    return exit_code;
}
