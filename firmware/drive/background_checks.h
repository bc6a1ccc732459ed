/* Checks of the drive whose reaction may take longer than a few control periods, collected from the monitors. */
#ifndef BACKGROUND_CHECKS_H
#define BACKGROUND_CHECKS_H

#include <stdint.h>

#include "drive/drive.h"

/* Follows currents, voltages, angle and heat, and reports the failed checks to the interrupts, which latch the first
 * one. [background] */
void background_checks(drive_t *drive, hal_t *hal, uint32_t time_us);

/* Forgets what has been found beside parameters that now change, and is no more than that with them: before they take
 * effect. coming: those that follow the ones in effect, outside of a run. [background] */
void background_checks_reconfigure(drive_t *drive, const control_parameters_t *coming);

#endif
