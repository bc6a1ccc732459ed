/* A drive on the host port: the firmware joined with the board of a rig in one process. */
#ifndef HOST_DRIVE_H
#define HOST_DRIVE_H

#include <stdbool.h>

#include "drive.h"
#include "host/hal_host.h"
#include "host/options.h"
#include "rig/rig.h"

/* Large: static. Must not be moved once started. */
typedef struct {
    drive_t drive;
    hal_t hal;
    drive_config_t config;
} host_drive_t;

/* Starts the firmware of drive `number` of the bench on the board of its rig; `firmware` is then for rig_join. False
 * when the drive rejects its configuration. */
bool host_drive_start(host_drive_t *host, board_t *board, const options_t *options, unsigned number,
                      rig_firmware_t *firmware);

#endif
