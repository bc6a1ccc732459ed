/* Parameters of the torque laws: commutation, hysteresis, duty, flux linkage, conduction angles, limits of currents. */
#ifndef INTERRUPTS_CONFIGURE_TORQUE_H
#define INTERRUPTS_CONFIGURE_TORQUE_H

#include "interrupts/configure_source.h"

/* Sets them. [background] */
void configure_torque(control_parameters_t *control, const configure_source_t *from);

#endif
