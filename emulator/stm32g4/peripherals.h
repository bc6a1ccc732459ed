/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Functions of the peripherals for each other, and for the bench. Section numbers refer to RM0440.
 */
#ifndef STM32G4_PERIPHERALS_H
#define STM32G4_PERIPHERALS_H

#include <stdbool.h>
#include <stdint.h>

#include "stm32g4/soc.h"

/* Attaches all peripherals to their addresses; the state after a reset; events that no group below has. */
void peripherals_attach(void);
void peripherals_reset(uint32_t cause);
void peripherals_event(soc_event_t event);

/* --- Reset and clock control, power (6, 7): rcc.c --- */
void rcc_attach(void);
void rcc_reset(uint32_t cause);
bool rcc_lsi_runs(void);
void rcc_run_lsi(void); /* the independent watchdog starts it */
uint32_t rcc_lptim1_hz(void);
bool rcc_lptim1_has_lse(void);
uint32_t rcc_fdcan_hz(void);
uint32_t rcc_adc_hz(bool converters_345); /* of the kernel's clock before the prescaler, 0: off */
bool rcc_hsi48_ready(void);

/* --- Ports (9) and external interrupts (15): gpio.c --- */
void gpio_attach(void);
void gpio_reset(void);
#define GPIO_PINS 64                           /* PA0 = 0, PB0 = 16, PC0 = 32, PD0 = 48 */
void gpio_connect(unsigned from, unsigned to); /* a wire between two pins */
void gpio_drive(unsigned pin, bool level);     /* from outside */
void gpio_release(unsigned pin);               /* nothing outside drives it */
bool gpio_level(unsigned pin);                 /* of the input, through the Schmitt trigger */
int gpio_function(unsigned pin);               /* number of the alternate function, -1: not one */
bool gpio_is_analog(unsigned pin);
void gpio_refresh(void); /* outputs of peripherals have changed */
const char *gpio_name(unsigned pin);

/* --- Timers (28, 29, 31): timer.c, timer_output.c --- */
typedef enum { TIM1, TIM2, TIM3, TIM4, TIM5, TIM6, TIM7, TIM8, TIMERS } timer_number_t;
void timer_attach(void);
void timer_reset(void);
void timer_event(unsigned number);
void timer_input(unsigned pin, bool level);   /* an input of a port has changed */
bool timer_clears_by_zeros(uint32_t address); /* a status register, to which ones may be written anywhere */
void timer_break_changed(void);               /* a source of a break, or its routing, has changed */
bool timer_output(unsigned pin, unsigned function, bool *level); /* a timer drives the pin; false: high impedance */
void timer_fire(unsigned timer, unsigned event);                 /* for DMA requests and triggers, see timer.c */

/* Edges of an output from the present cycle up to the timer's next update: levels and cycles. */
typedef struct {
    uint64_t cycle;
    bool level;
} timer_edge_t;
#define TIMER_EDGES_MAX 8
/* Number of edges; the first one has the present level. False in `driven`: the pin is not driven. */
unsigned timer_edges(unsigned pin, uint64_t to, timer_edge_t edges[TIMER_EDGES_MAX], bool *driven);

/* --- Converters (21): adc.c --- */
void adc_attach(void);
void adc_reset(void);
void adc_event(unsigned number);
void adc_trigger(unsigned source);                            /* an internal trigger: TIM1_TRGO and others, adc.c */
typedef uint16_t (*adc_input_t)(void *context, unsigned pin); /* 0..4095 */
void adc_set_input(adc_input_t function, void *context);
/* The instant at which converter 0 sampled last, for the bench. */
uint64_t adc_sampled_at(unsigned adc);

/* --- Comparators and their references (22, 24): analogue.c --- */
void analog_attach(void);
void analog_reset(void);
bool analog_comparator(unsigned comparator);     /* 0..6: COMP1 to COMP7, after polarity */
void analog_refresh(void);                       /* an input has changed */
void analog_set_pin(unsigned pin, double volts); /* of a pin, for comparators */

/* --- DMA (12, 13): dma.c --- */
void dma_attach(void);
void dma_reset(void);
void dma_request(unsigned request); /* of DMAMUX, table 91 */

/* --- CAN (44): fdcan.c --- */
typedef struct {
    uint32_t identifier;
    bool extended, remote;
    uint8_t length, data[8];
} fdcan_frame_t;
typedef struct {
    void (*send)(void *context, unsigned buffer, const fdcan_frame_t *frame); /* takes part in arbitration */
    bool (*pending)(void *context, unsigned buffer);                          /* has not left yet */
    void (*cancel)(void *context, unsigned buffer);
    void (*state)(void *context, unsigned *tec, unsigned *rec, bool *bus_off);
    void (*rejoin)(void *context);
    uint32_t (*bit_rate)(void *context);
    void (*room)(void *context); /* a receive FIFO has room again */
    void *context;
} fdcan_bus_t;
void fdcan_attach(void);
void fdcan_reset(void);
void fdcan_event(void);
void fdcan_join(const fdcan_bus_t *bus);
bool fdcan_deliver(const fdcan_frame_t *frame);              /* from the bus; false: not taken */
int fdcan_destination(const fdcan_frame_t *frame);           /* number of the FIFO, below 0: none; fdcan_filters.c */
bool fdcan_room(void);                                       /* both FIFOs take a frame */
void fdcan_refresh(void);                                    /* the bus has moved on */
void fdcan_set_errors(unsigned tec, unsigned rec, bool off); /* without a bus */

/* --- Watchdog (42), low-power timer (34), random numbers (26): clocks_apart.c --- */
void apart_attach(void);
void apart_reset(void);
void apart_watchdog_event(void);
uint64_t apart_watchdog_expires_ns(void); /* SOC_NEVER: it does not run */
typedef uint32_t (*apart_random_t)(void *context);
void apart_set_random(apart_random_t random, void *context);
typedef uint64_t (*apart_lse_t)(void *context); /* cycles of the crystal since any instant */
void apart_set_lse(apart_lse_t lse, void *context);
#define APART_STALE 0x5EED5EEDu /* words of the random numbers' pipeline after a seed error */
void apart_seed_error(void);

#endif
