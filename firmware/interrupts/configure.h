/* Control parameters, pre-scaled for the interrupt, from the user's parameters. */
#ifndef INTERRUPTS_CONFIGURE_H
#define INTERRUPTS_CONFIGURE_H

#include <stdint.h>

#include "interrupts/control_step.h"
#include "storage/parameters.h"

/* Settings of the board, constant after start. */
typedef struct {
    uint32_t control_rate_hz;      /* 20000, 40000, 50000, 100000 or 1000000 */
    drive_controller_t controller; /* default of the parameter */
    uint32_t node;                 /* number on the bus, 0..NODE_MAX: the board's address switches */
    uint32_t telemetry_period_ms;  /* parameter of that name at the start, unless one is stored; 0: its default */
    uint32_t canopen_node;         /* parameter `protocol` at the start, likewise: 0, or a node-ID of CANopen */
    bool stored_tables;            /* the port has called table_store_load: the drive takes new tables */
} drive_config_t;

/* True for the supported control rates of which a timer with this clock (hal_pwm_clock_hz, 25 to 400 MHz) makes half a
 * period of an integer number of ticks. */
bool configure_rate_allowed(uint32_t control_rate_hz, uint32_t timer_clock_hz);

/* Control parameters for a machine (machine_tables, for which the control interrupt is linked), a control rate and the
 * board's resolutions and timer (hal_encoder_bits, hal_adc_bits, hal_pwm_clock_hz). [background] */
control_parameters_t configure_control(const parameters_t *parameters, const machine_tables_t *tables,
                                       uint32_t control_rate_hz, unsigned encoder_bits, unsigned adc_bits,
                                       uint32_t timer_clock_hz);

/* Parts in which a run takes over tuned parameters, so that no interrupt waits for all of them: laws of speed and load,
 * laws of torque, their windows, law and limits of position, then each stage of the observer's bandwidth. */
enum {
    CONFIGURE_TUNE_SPEED,
    CONFIGURE_TUNE_TORQUE,
    CONFIGURE_TUNE_CONDUCTION,
    CONFIGURE_TUNE_POSITION,
    CONFIGURE_TUNE_POSITION_PLAN,
    CONFIGURE_TUNE_FIRST_STAGE,
    CONFIGURE_TUNE_PARTS = CONFIGURE_TUNE_FIRST_STAGE + OBSERVER_BANDWIDTH_STAGES
};

/* Takes over a part from the control parameters of a set that differs in nothing else than tunable parameters
 * (parameters.h): every law that depends on one of them, as a whole, so that no member can be forgotten; members that
 * depend on others are equal in both. [background, in a critical section] */
void configure_tune(control_parameters_t *parameters, const control_parameters_t *tuned, unsigned part);

#endif
