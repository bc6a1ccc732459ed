#include "host/host_drive.h"

#include <assert.h>

#include "host/memory_flip.h"

static_assert((int)DRIVE_CONTROLLER_TRADITIONAL == OPTIONS_CONTROLLER_TRADITIONAL &&
                  (int)DRIVE_CONTROLLER_PAPER == OPTIONS_CONTROLLER_PAPER &&
                  (int)DRIVE_CONTROLLER_SALIENT == OPTIONS_CONTROLLER_SALIENT,
              "the record and the drive number the controllers differently");

static void control_interrupt(void *context) {
    host_drive_t *host = context;
    drive_control_interrupt(&host->drive, &host->hal);
}

static void deferred_interrupt(void *context) {
    host_drive_t *host = context;
    drive_deferred_interrupt(&host->drive, &host->hal);
}

static void background(void *context) {
    host_drive_t *host = context;
    drive_background(&host->drive, &host->hal);
}

/* As the start of a port does. */
static bool start(host_drive_t *host) {
    if (host->config.stored_tables) {
        table_store_load(&host->hal, host->config.control_rate_hz, &host->built_in, &machine_tables);
    }
    return drive_init(&host->drive, &host->hal, &host->config);
}

static void restart(void *context) {
    start(context); /* with the configuration of the start, which it accepted */
}

static void flip(void *context, memory_object_t object, uint32_t bit) {
    memory_flip(&((host_drive_t *)context)->drive, object, bit);
}

drive_config_t host_drive_config(const options_t *options, unsigned number) {
    return (drive_config_t){
        .control_rate_hz = options->control_rate_hz,
        .controller = (drive_controller_t)options->controller_index,
        .node = options->node + number,
        .telemetry_period_ms = options->telemetry_period_ms,
        .canopen_node = options->protocol_index == OPTIONS_PROTOCOL_CANOPEN ? options->node + number + 1u : 0,
        .stored_tables = options->memory != NULL && options->drives == 1,
    };
}

bool host_drive_start(host_drive_t *host, board_t *board, const drive_config_t *config, rig_firmware_t *firmware) {
    host->hal.board = board;
    host->config = *config;
    host->built_in = machine_tables;
    *firmware = (rig_firmware_t){.control_interrupt = control_interrupt,
                                 .deferred_interrupt = deferred_interrupt,
                                 .background = background,
                                 .restart = restart,
                                 .flip = flip,
                                 .flip_objects = MEMORY_FLIP_OBJECTS,
                                 .context = host};
    return start(host);
}
