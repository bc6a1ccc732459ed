/* One drive on its bench: the firmware, the host port and the emulator in one process and one thread. */
#include <assert.h>

#include "drive.h"
#include "host/hal_host.h"
#include "host/simulation.h"

static_assert((int)DRIVE_CONTROLLER_TRADITIONAL == OPTIONS_CONTROLLER_TRADITIONAL &&
                  (int)DRIVE_CONTROLLER_PAPER == OPTIONS_CONTROLLER_PAPER &&
                  (int)DRIVE_CONTROLLER_SALIENT == OPTIONS_CONTROLLER_SALIENT,
              "the record and the drive number the controllers differently");

/* Large: static. */
static simulation_t simulation;
static drive_t drive;
static hal_t hal = {.board = &simulation.rig.board};
static drive_config_t drive_config;
machine_tables_t machine_tables;

static void control_interrupt(void *context) {
    drive_control_interrupt(context);
}

static void deferred_interrupt(void *context) {
    drive_deferred_interrupt(context);
}

static void background(void *context) {
    drive_background(context);
}

static void restart(void *context) {
    drive_init(context, &hal, &drive_config); /* with the configuration of the start, which it accepted */
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
    drive_config = (drive_config_t){
        .control_rate_hz = options.control_rate_hz,
        .controller = (drive_controller_t)options.controller_index,
    };
    if (drive_init(&drive, &hal, &drive_config)) {
        simulation_run(&simulation, &(rig_firmware_t){.control_interrupt = control_interrupt,
                                                      .deferred_interrupt = deferred_interrupt,
                                                      .background = background,
                                                      .restart = restart,
                                                      .context = &drive});
    } else {
        simulation_rejected(&simulation);
    }
    return simulation_close(&simulation);
}
