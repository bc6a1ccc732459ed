/* The drive's state as telemetry: the one place that maps the one to the other. */
#ifndef TELEMETRY_COLLECT_H
#define TELEMETRY_COLLECT_H

#include <stdint.h>

#include "drive/drive.h"
#include "drive_telemetry.h"

/* All signals of the drive's cyclic messages at one moment, in the LSBs of the bus (comms/units.h), except
 * telemetry_dropped, which telemetry_cycle() writes. The control interrupt must not run meanwhile. [background] */
void telemetry_collect(const drive_t *drive, const hal_t *hal, uint32_t time_us, drive_telemetry_t *telemetry);

/* Bits of DRIVE_SELF_TEST: failed temperature sensors, and above them SELF_TEST_*. */
uint16_t telemetry_self_test(const drive_t *drive);

/* Failed temperature sensors of phases e and f, in the order of DRIVE_PHASES_E_F from bit 0 on. [background] */
uint8_t telemetry_sensors_e_f(const drive_t *drive);

#endif
