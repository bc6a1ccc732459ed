/* A drive on the host port: the firmware joined with the board of a rig in one process. */
#ifndef HOST_DRIVE_H
#define HOST_DRIVE_H

#include <stdbool.h>

#include "drive/drive.h"
#include "host/hal_host.h"
#include "host/options.h"
#include "rig/rig.h"

/* Large: static. Must not be moved once started. */
typedef struct {
    drive_t drive;
    hal_t hal;
    drive_config_t config;
    machine_tables_t built_in; /* of the image; with config.stored_tables */
} host_drive_t;

/* The configuration of drive `number` of the bench by the options of the command line. One that is alone and whose
 * memory is kept (--memory) takes tables of another machine: drives of a bench share them. */
drive_config_t host_drive_config(const options_t *options, unsigned number);

/* Starts the firmware of a drive on the board of its rig; `firmware` is then for rig_join. False when the drive rejects
 * its configuration. */
bool host_drive_start(host_drive_t *host, board_t *board, const drive_config_t *config, rig_firmware_t *firmware);

#endif
