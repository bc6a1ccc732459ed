/* The board NUCLEO-G474RE with an asymmetric half-bridge stage: what the files of the port share.
 *
 * Options of the build, as definitions: BOARD_CLOCK_MHZ 170 or 100 (the second for comparison with the emulator, whose
 * time is in whole nanoseconds), BOARD_CAN_BIT_RATE, BOARD_ENCODER_INDEX 1 for an encoder that is absolute only after
 * its index has passed, 0 for one that counts to its absolute position at power-up.
 */
#ifndef STM32G4_BOARD_H
#define STM32G4_BOARD_H

#include <stdbool.h>
#include <stdint.h>
#include <stdnoreturn.h>

#include "hal.h"
#include "hal_can.h"

#define BOARD_CLOCK_HZ (UINT32_C(1000000) * BOARD_CLOCK_MHZ)

#define BOARD_TEMPERATURES 8

struct hal {
    uint16_t period_ticks;
    bool gates_open;           /* the outputs are disabled: hal_pwm_write enables them */
    uint16_t trigger;          /* number of the trigger that the present control interrupt serves, modulo 2^16 */
    uint16_t trigger_at_end;   /* number of the last trigger before the end of the last control interrupt */
    uint16_t trigger_reported; /* the one up to which missed triggers have been reported */
    bool watchdog_reset;       /* cause of the last reset */
    uint16_t temperature_counts[BOARD_TEMPERATURES];
    uint8_t temperature_sensor; /* being converted */
    uint16_t reference_low;     /* second clock: its counter when last read, and the counts until then */
    uint64_t reference_ticks;
    volatile bool reads_parameters;    /* a double error of the flash is one of theirs */
    volatile uint32_t received_pushed; /* counts, not indices; written by the CAN interrupt */
    volatile uint32_t received_popped; /* written by the background */
    volatile uint32_t receive_overflows;
    hal_can_frame_t received[HAL_CAN_RECEIVE_QUEUE];
};

extern hal_t board;

/* Data of the machine's board, generated with its tables (salient.board.machine). */
extern const uint16_t board_trip_counts; /* threshold of the comparators, 12 bits of the current sensors' range */
extern const uint8_t board_encoder_bits; /* 8..24 */
extern const uint32_t board_control_rate_hz;

/* Parts of the start, in this order; interrupts are masked. */
void clock_init(void);
void pins_init(void);
void encoder_init(void);
void time_init(void);
void pwm_init(void);
void break_init(void);
void adc_init(hal_t *hal);
void can_init(void);
void random_init(void);

/* The start of the periods and the first trigger, for hal_pwm_start. */
void trigger_start(void);

/* Lets the interrupts in; what was triggered before is forgotten. */
void board_interrupts_enable(hal_t *hal);

/* For the control interrupt, before and after the drive's: the number of its trigger; false for one that came while the
 * last control interrupt was running, whose call is left out. */
bool control_begin(hal_t *hal);
void control_end(hal_t *hal);

/* Number of the last trigger, modulo 2^16. */
uint16_t trigger_count(void);

/* Converts one temperature, after this period's sample. */
void adc_convert_temperature(hal_t *hal);

/* The compare values are renewed: begins the count of periods without anew. */
void break_renew(void);

/* HAL_PWM_BREAK_* causes that are latched or present, and their clearing. */
uint32_t break_causes(void);
void break_clear(void);

/* False until the encoder's count is absolute. */
bool encoder_is_absolute(void);

/* The CAN interrupt. */
void can_interrupt(hal_t *hal);

/* A double error of the flash, in the NMI: true when the parameters are being read, and it is dealt with. */
bool nvm_error_in_parameters(void);

/* Opens the switches and stays there until the watchdog resets the processor. */
noreturn void board_halt(void);

/* Waits at least a time in microseconds, at the present clock in MHz. */
void board_wait_us(uint32_t time_us, uint32_t clock_mhz);

#endif
