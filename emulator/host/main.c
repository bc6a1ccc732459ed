/* Drives on their benches: the firmware, the host port and the emulator in one process and one thread. */
#include <assert.h>

#include "drive.h"
#include "host/hal_host.h"
#include "host/memory_flip.h"
#include "host/simulation.h"

static_assert((int)DRIVE_CONTROLLER_TRADITIONAL == OPTIONS_CONTROLLER_TRADITIONAL &&
                  (int)DRIVE_CONTROLLER_PAPER == OPTIONS_CONTROLLER_PAPER &&
                  (int)DRIVE_CONTROLLER_SALIENT == OPTIONS_CONTROLLER_SALIENT,
              "the record and the drive number the controllers differently");

/* Large: static. */
static simulation_t simulation;
static struct host_drive {
    drive_t drive;
    hal_t hal;
    drive_config_t config;
} drives[SIMULATION_DRIVES_MAX];
machine_tables_t machine_tables;

static void control_interrupt(void *context) {
    drive_control_interrupt(&((struct host_drive *)context)->drive);
}

static void deferred_interrupt(void *context) {
    drive_deferred_interrupt(&((struct host_drive *)context)->drive);
}

static void background(void *context) {
    drive_background(&((struct host_drive *)context)->drive);
}

static void restart(void *context) {
    struct host_drive *host = context;
    drive_init(&host->drive, &host->hal, &host->config); /* with the configuration of the start, which it accepted */
}

static void flip(void *context, memory_object_t object, uint32_t bit) {
    memory_flip(&((struct host_drive *)context)->drive, object, bit);
}

/* Starts every drive; false when one rejects its configuration. */
static bool start(const options_t *options, rig_firmware_t firmware[]) {
    for (unsigned i = 0; i < options->drives; ++i) {
        struct host_drive *host = &drives[i];
        host->hal.board = &simulation.rigs[i].board;
        host->config = (drive_config_t){
            .control_rate_hz = options->control_rate_hz,
            .controller = (drive_controller_t)options->controller_index,
            .node = options->node + i,
            .telemetry_period_ms = options->telemetry_period_ms,
        };
        if (!drive_init(&host->drive, &host->hal, &host->config)) {
            return false;
        }
        firmware[i] = (rig_firmware_t){.control_interrupt = control_interrupt,
                                       .deferred_interrupt = deferred_interrupt,
                                       .background = background,
                                       .restart = restart,
                                       .flip = flip,
                                       .flip_objects = MEMORY_FLIP_OBJECTS,
                                       .context = host};
    }
    return true;
}

int main(int argc, char *argv[]) {
    options_t options;
    options_result_t result = options_parse(&options, argc, argv);
    if (result != OPTIONS_RUN) {
        return result == OPTIONS_HELP ? 0 : EXIT_USAGE;
    }
    if (!simulation_open(&simulation, &options)) {
        return EXIT_USAGE;
    }
    if (!machine_image_tables(&simulation.image, &machine_tables_structure, &machine_tables)) {
        simulation_close(&simulation);
        return EXIT_USAGE;
    }
    rig_firmware_t firmware[SIMULATION_DRIVES_MAX];
    if (start(&options, firmware)) {
        simulation_run(&simulation, firmware);
    } else {
        simulation_rejected(&simulation);
    }
    return simulation_close(&simulation);
}
