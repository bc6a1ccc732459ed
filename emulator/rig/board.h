/* Emulated board: the registers that a port of the firmware reads and writes; the rig updates them over time.
 *
 * Independent of the firmware; a port maps its hal_* functions to these, one to one.
 */
#ifndef RIG_BOARD_H
#define RIG_BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_adc.h"
#include "hal_can.h"
#include "hal_encoder.h"
#include "hal_pwm.h"
#include "hal_watchdog.h"
#include "plant/plant.h"
#include "plant/sensors.h"
#include "rig/can_bus.h"
#include "rig/nvm.h"

#define BOARD_STO_LINES 2
#define BOARD_REFERENCE_HZ 32768u

/* Context in which the firmware is called. */
typedef enum { BOARD_START, BOARD_INTERRUPT, BOARD_DEFERRED, BOARD_BACKGROUND } board_context_t;

typedef struct {
    uint64_t time_ns;
    uint64_t start_ns; /* of the drive, at its last reset */
    board_context_t context;
    bool in_critical_section;
    bool deferred_requested; /* by the control interrupt: the rig calls the deferred interrupt after it */

    hal_adc_sample_t adc;         /* latched at the start of the period */
    hal_encoder_sample_t encoder; /* likewise */
    unsigned adc_bits;            /* 12..16 */
    unsigned encoder_bits;        /* 8..32 */
    /* Temperature sensors: the codes at their inputs, and the last converted ones. Each control interrupt starts the
     * conversion of one, and the next has its code, as in hal/stm32g4. */
    uint16_t temperature_input[HAL_ADC_TEMPERATURES], temperature_code[HAL_ADC_TEMPERATURES];
    unsigned temperature_number; /* of the sensor in conversion, in the order of the board */
    uint16_t temperature_sample; /* its code */

    uint16_t period_ticks;   /* register of the timer; 0 until it is started */
    uint16_t period_written; /* to it */
    bool immediate_pwm;      /* setting, see board_pwm_write; false after board_init */
    hal_pwm_compare_t active, buffered;
    uint32_t missed_triggers;   /* since last read */
    bool renewed;               /* compare values were written or cleared since the start of the period */
    uint32_t periods_unrenewed; /* in succession, up to the start of the present one */
    uint32_t break_causes;      /* latched, HAL_PWM_BREAK_*; the comparators' is plant.tripped */
    bool sto_energised[BOARD_STO_LINES];
    uint64_t interrupt_took_ns; /* execution time of the present control interrupt, from its trigger on: set by the rig,
                                   overwritten before its end by a port with instruction timing */

    hal_can_frame_t received[HAL_CAN_RECEIVE_QUEUE];
    uint32_t received_pushed, received_popped; /* counts, not indices */
    uint32_t receive_overflows;

    /* The second clock, a crystal of BOARD_REFERENCE_HZ: its cycles since the drive's start up to an instant, and its
     * rate from there on. */
    uint64_t reference_from_ns;
    double reference_at, reference_rate;

    uint64_t watchdog_ns; /* time at which the watchdog acts; UINT64_MAX: not started */
    hal_reset_cause_t reset_cause;

    nvm_t nvm; /* keeps its content in a reset */
    /* True random number generator, from the seed of the bench: a reset of the board does not restart it. */
    uint64_t random_state;

    plant_t *plant;
    sensors_t *sensors;
    can_bus_t *bus;
    unsigned bus_drive; /* its number on the bus */
} board_t;

/* Initialises a board after reset at time 0: timer stopped, switches open, safe torque off not requested, queues empty,
 * resolutions of `sensors`, comparators of the machine. Plant, sensors and bus, on which it is drive `bus_drive`, are
 * used, not owned. The random stream begins with `seed`. */
void board_init(board_t *board, plant_t *plant, sensors_t *sensors, can_bus_t *bus, unsigned bus_drive, uint64_t seed);

/* For the rig: a reset of the drive, or power that returns. Timer and watchdog stopped, switches open, what was
 * received is lost, temperatures converted. */
void board_reset(board_t *board, hal_reset_cause_t cause);

/* For the rig: the watchdog of a firmware that cannot be reset opens the switches, as a break does. */
void board_stop_gates(board_t *board);

/* For the rig: starts a control period at the time of the plant. Latches the sensors and activates the buffered compare
 * values. While the interrupt is still running (`busy`), the trigger is missed and counted, and the values that the
 * interrupt reads are unchanged. */
void board_start_period(board_t *board, bool busy);

/* For the rig: converts all temperatures, as a port does before the drive starts. */
void board_convert_temperatures(board_t *board);

/* For the rig: energises a line of safe torque off, or not, at the time of the plant; without both every switch is
 * open. line < BOARD_STO_LINES. */
void board_set_sto(board_t *board, unsigned line, bool energised);

/* For the rig: delivers a complete frame of another node. */
void board_deliver(board_t *board, const hal_can_frame_t *frame);

/* For the port; each is the hal_* function of the same name. With `immediate_pwm` the compare values act from the
 * present period on, at whose start the control interrupt runs: modulation without the delay of one period that a real
 * timer has. */
void board_pwm_start(board_t *board, uint16_t period_ticks);
void board_pwm_write(board_t *board, const hal_pwm_compare_t *compare);
void board_pwm_open_all(board_t *board);
uint32_t board_pwm_break(const board_t *board);
void board_pwm_clear_break(board_t *board);
uint32_t board_missed_triggers(board_t *board);
bool board_can_receive(board_t *board, hal_can_frame_t *frame);
bool board_can_transmit(board_t *board, const hal_can_frame_t *frame);
void board_can_status(const board_t *board, hal_can_status_t *status);
void board_can_rejoin(board_t *board);
void board_watchdog_start(board_t *board);
/* Without effect before its start. */
void board_watchdog_kick(board_t *board);
bool board_registers_intact(const board_t *board);
/* Second clock: whole cycles since the drive's start, and the microseconds that they are. */
uint64_t board_reference_cycles(const board_t *board);
uint32_t board_reference_us(const board_t *board);

/* For the rig: rate of the second clock from now on, >= 0; 1 is right. */
void board_set_reference_rate(board_t *board, double rate);

/* The next number of a stream that depends on the seed and on the instants of the calls: a bench with the same seed and
 * the same course repeats it, as everything else. */
uint32_t board_random(board_t *board);

#endif
