/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Inside of the timers (RM0440, 28 and 29): counter, shadow registers, outputs.
 *
 * The counter is not stepped: its place in the period is a number of ticks that follows from the time. A period is ARR
 * + 1 ticks edge-aligned and 2 ARR ticks centre-aligned, of which the first ARR count up from 0 and the others down
 * from ARR. Events are due at the ends of the halves and at the matches of the channels.
 */
#ifndef STM32G4_TIMER_H
#define STM32G4_TIMER_H

#include "stm32g4/peripherals.h"

#define TIMER_CHANNELS 4

/* Offsets of the registers. */
enum {
    TIM_CR1 = 0x00,
    TIM_CR2 = 0x04,
    TIM_SMCR = 0x08,
    TIM_DIER = 0x0C,
    TIM_SR = 0x10,
    TIM_EGR = 0x14,
    TIM_CCMR1 = 0x18,
    TIM_CCER = 0x20,
    TIM_CNT = 0x24,
    TIM_PSC = 0x28,
    TIM_ARR = 0x2C,
    TIM_RCR = 0x30,
    TIM_CCR1 = 0x34,
    TIM_BDTR = 0x44,
    TIM_CCMR3 = 0x50,
    TIM_ECR = 0x58,
    TIM_TISEL = 0x5C,
    TIM_AF1 = 0x60,
    TIM_AF2 = 0x64,
};

#define CR1_CEN 0x01u
#define CR1_UDIS 0x02u
#define CR1_URS 0x04u
#define CR1_OPM 0x08u
#define CR1_DIR 0x10u
#define CR1_CMS 0x60u
#define CR1_ARPE 0x80u
#define SR_UIF 0x0001u
#define SR_TIF 0x0040u
#define SR_BIF 0x0080u
#define SR_B2IF 0x0100u
#define BDTR_LOCK 0x0300u
#define BDTR_OSSI 0x0400u
#define BDTR_OSSR 0x0800u
#define BDTR_BKE 0x1000u
#define BDTR_BKP 0x2000u
#define BDTR_AOE 0x4000u
#define BDTR_MOE 0x8000u
#define BDTR_BK2E 0x1000000u
#define BDTR_BK2P 0x2000000u

typedef struct {
    uint32_t base;
    bool advanced; /* outputs with breaks, repetition counter */
    bool basic;    /* counter alone */
    bool wide;     /* 32 bits */
    bool apb2;
    uint8_t update_irq, break_irq, trigger_irq, capture_irq; /* one line for all where equal */
    uint8_t update_request, capture_request;                 /* of DMAMUX; 0: none */
} timer_facts_t;

typedef struct {
    const timer_facts_t *facts;
    bool runs;
    bool held;      /* runs, and does not count: a bench whose time has not begun */
    uint64_t at;    /* cycle at which the counter was at the place */
    uint64_t place; /* ticks from the start of the period */
    uint64_t tick;  /* cycles of HCLK */
    uint32_t count; /* while external edges or an encoder clock it */
    bool down;
    uint32_t psc, arr, ccr[TIMER_CHANNELS]; /* shadow registers */
    uint32_t repetitions;                   /* left */
    bool reference[TIMER_CHANNELS];         /* OCxREF */
    uint8_t lock;                           /* level, written once */
    bool index_seen;
} tim_t;

extern tim_t timers[TIMERS];

#define TIMER_REG(timer, offset) REG((timer)->facts->base + (offset))

/* Place in the period at a cycle not before `at`; not beyond the end of the period. */
uint64_t timer_place(const tim_t *timer, uint64_t cycle);

/* Length of the period in ticks; centre: in the middle of it the counter turns. */
uint64_t timer_period(const tim_t *timer);
bool timer_is_centred(const tim_t *timer);

/* Counter at a place, and its direction there. */
uint32_t timer_count_at(const tim_t *timer, uint64_t place, bool *down);

/* OCxREF at a place. */
bool timer_reference(const tim_t *timer, unsigned channel, uint64_t place);

/* Compare mode, OCxM; preload enable, OCxPE; selection, CCxS; of a channel. */
unsigned timer_mode(const tim_t *timer, unsigned channel);
bool timer_preloads(const tim_t *timer, unsigned channel);
unsigned timer_selection(const tim_t *timer, unsigned channel);

/* Sets flags of SR, with their interrupt and DMA requests. */
void timer_flag(tim_t *timer, uint32_t flags);
void timer_lines(const tim_t *timer);

/* Counter now, and its direction; an encoder or external edges clock it. */
uint32_t timer_count_now(const tim_t *timer, bool *down);
bool timer_clocked_outside(const tim_t *timer);

/* Update event: the shadow registers take what was written. by_counter: an overflow or underflow. */
void timer_update(tim_t *timer, bool by_counter);

/* OCxREF at a place; a rising edge may be a trigger. */
void timer_follow_references(tim_t *timer, uint64_t place);

/* Output side, timer_output.c: a write of BDTR, CR2, CCER or an alternate function register. */
void timer_output_write(tim_t *timer, uint32_t offset, uint32_t value);
void timer_break(tim_t *timer, uint32_t flag);

/* Input side, timer_input.c. */
void timer_input_trigger(tim_t *timer);                   /* the selected trigger, TRGI */
void timer_trigger_out(const tim_t *source, bool second); /* TRGO, TRGO2 */
bool timer_is_encoder(const tim_t *timer);
bool timer_is_external(const tim_t *timer);
void timer_capture(tim_t *timer, unsigned channel);
void timer_check_slave(const tim_t *timer, uint32_t value); /* of SMCR */

/* Counter from now on at a place, with events. */
void timer_restart(tim_t *timer, uint64_t place);
void timer_enable(tim_t *timer);
void timer_plan(tim_t *timer); /* events, after a change of what they depend on */
void timer_count_external(tim_t *timer, bool down);

/* The outputs of the timer may have changed before its next update: for the bench. */
typedef void (*timer_watch_t)(void *context);
void timer_watch(timer_watch_t function, void *context);
void timer_outputs_changed(void);

#endif
