/* From parameters (what a user sets, in his units) to control parameters (what the interrupt uses, ready multiplied).
 */
#ifndef DRIVE_CONFIGURE_H
#define DRIVE_CONFIGURE_H

#include <stdint.h>

#include "drive/control.h"
#include "drive/parameters.h"

/* What a board decides, once. */
typedef struct {
    uint32_t control_rate_hz;      /* 20000, 40000, 50000, 100000 or 1000000 */
    drive_controller_t controller; /* default of the parameter */
} drive_config_t;

/* True when the timer can make the rate: a whole number of ticks in half a period. */
bool configure_rate_allowed(uint32_t control_rate_hz);

/* Everything that depends on parameters, rate, machine and the board's resolutions (hal_encoder_bits, hal_adc_bits).
 * [background] */
control_parameters_t configure_control(const parameters_t *parameters, const machine_tables_t *tables,
                                       uint32_t control_rate_hz, unsigned encoder_bits, unsigned adc_bits);

#endif
