/* Interface of the drive, as far as start.c needs it; the program that checks the port takes its place (port.c). */
#ifndef DRIVE_DRIVE_H
#define DRIVE_DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

typedef struct {
    uint32_t unused;
} drive_t;

typedef unsigned drive_controller_t;

typedef struct {
    uint32_t control_rate_hz;
    drive_controller_t controller;
    uint8_t node;
    uint16_t telemetry_period_ms;
    bool stored_tables;
} drive_config_t;

bool drive_init(drive_t *drive, hal_t *hal, const drive_config_t *config);
void drive_control_interrupt(drive_t *drive, hal_t *hal);
void drive_deferred_interrupt(drive_t *drive, hal_t *hal);
void drive_background(drive_t *drive, hal_t *hal);

#endif
