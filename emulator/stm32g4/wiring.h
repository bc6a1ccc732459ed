/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Wiring between the part and the stage: which signal is at which pin. A file with a signal and a pin in each line,
 * as "UPPER_A PC1"; tools/salient makes it from the board's table of pins.
 */
#ifndef STM32G4_WIRING_H
#define STM32G4_WIRING_H

#include <stdbool.h>

#define WIRING_PHASES 4
#define WIRING_NONE (-1)

typedef struct {
    int lower[WIRING_PHASES], upper[WIRING_PHASES]; /* gates */
    int current[WIRING_PHASES], winding[WIRING_PHASES], switches[WIRING_PHASES];
    int dc_link, torque;
    int encoder_a, encoder_b, encoder_index;
    int sto[2], driver_fault;
    int breaks[2]; /* the AND of both STO lines and of the drivers' fault line */
} wiring_t;

/* Reads the file; false after one line on stderr. A signal that is not in it is not connected. */
bool wiring_read(wiring_t *wiring, const char *path);

#endif
