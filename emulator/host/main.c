/* Drives on their benches: the firmware, the host port and the emulator in one process and one thread. */
#include "host/host_drive.h"
#include "host/simulation.h"

/* Large: static. */
static simulation_t simulation;
static host_drive_t drives[SIMULATION_DRIVES_MAX];
machine_tables_t machine_tables;

/* Starts every drive; false when one rejects its configuration. */
static bool start(const options_t *options, rig_firmware_t firmware[]) {
    for (unsigned i = 0; i < options->drives; ++i) {
        const drive_config_t config = host_drive_config(options, i);
        if (!host_drive_start(&drives[i], &simulation.rigs[i].board, &config, &firmware[i])) {
            return false;
        }
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
