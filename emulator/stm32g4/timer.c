/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/timer.h"

#include "stm32g4/nvic.h"
#include "stm32g4/part_pins.h"

tim_t timers[TIMERS];

static timer_watch_t watch;
static void *watch_context;

void timer_watch(timer_watch_t function, void *context) {
    watch = function;
    watch_context = context;
}

void timer_outputs_changed(void) {
    if (watch) {
        watch(watch_context);
    }
}

/* --- Counter --- */

bool timer_is_centred(const tim_t *timer) {
    return TIMER_REG(timer, TIM_CR1) & CR1_CMS;
}

uint64_t timer_period(const tim_t *timer) {
    return timer_is_centred(timer) ? 2 * (uint64_t)timer->arr : (uint64_t)timer->arr + 1;
}

uint64_t timer_place(const tim_t *timer, uint64_t cycle) {
    const uint64_t place = timer->place + (timer->runs && !timer->held ? (cycle - timer->at) / timer->tick : 0);
    const uint64_t period = timer_period(timer);
    return place > period ? period : place;
}

uint32_t timer_count_at(const tim_t *timer, uint64_t place, bool *down) {
    const uint64_t period = timer_period(timer);
    place = period ? place % period : 0;
    if (timer_is_centred(timer)) {
        *down = place >= timer->arr;
        return (uint32_t)(*down ? period - place : place);
    }
    *down = TIMER_REG(timer, TIM_CR1) & CR1_DIR;
    return (uint32_t)(*down ? timer->arr - place : place);
}

bool timer_clocked_outside(const tim_t *timer) {
    return timer_is_encoder(timer) || timer_is_external(timer);
}

uint32_t timer_count_now(const tim_t *timer, bool *down) {
    if (timer_clocked_outside(timer)) {
        *down = timer->down;
        return timer->count;
    }
    return timer_count_at(timer, timer_place(timer, soc.now), down);
}

unsigned timer_mode(const tim_t *timer, unsigned channel) {
    const uint32_t word = TIMER_REG(timer, TIM_CCMR1 + 4 * (channel / 2)) >> 8 * (channel % 2);
    return (word >> 4 & 7) | (word >> 13 & 8);
}

bool timer_preloads(const tim_t *timer, unsigned channel) {
    return TIMER_REG(timer, TIM_CCMR1 + 4 * (channel / 2)) >> (3 + 8 * (channel % 2)) & 1;
}

unsigned timer_selection(const tim_t *timer, unsigned channel) {
    return TIMER_REG(timer, TIM_CCMR1 + 4 * (channel / 2)) >> 8 * (channel % 2) & 3;
}

bool timer_reference(const tim_t *timer, unsigned channel, uint64_t place) {
    bool down;
    const uint32_t count = timer_count_at(timer, place, &down), ccr = timer->ccr[channel];
    const bool first = down ? count <= ccr : count < ccr; /* PWM mode 1 */
    switch (timer_mode(timer, channel)) {
    case 4:
        return false;
    case 5:
        return true;
    case 6:
        return first;
    case 7:
        return !first;
    default:
        return timer->reference[channel];
    }
}

/* --- Flags --- */

void timer_lines(const tim_t *timer) {
    const timer_facts_t *of = timer->facts;
    const uint32_t active = TIMER_REG(timer, TIM_SR) & TIMER_REG(timer, TIM_DIER);
    const bool breaks = TIMER_REG(timer, TIM_SR) & (SR_BIF | SR_B2IF) && TIMER_REG(timer, TIM_DIER) & 0x80;
    if (of->update_irq == of->capture_irq) {
        nvic_line(of->update_irq, active & 0x5F);
        return;
    }
    nvic_line(of->update_irq, active & SR_UIF);
    nvic_line(of->break_irq, breaks);
    nvic_line(of->trigger_irq, active & 0x60);
    nvic_line(of->capture_irq, active & 0x1E);
}

void timer_flag(tim_t *timer, uint32_t flags) {
    const uint32_t dier = TIMER_REG(timer, TIM_DIER);
    TIMER_REG(timer, TIM_SR) |= flags;
    timer_lines(timer);
    if (flags & SR_UIF && dier & 0x100) {
        dma_request(timer->facts->update_request);
    }
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        if (flags >> (1 + channel) & 1) {
            if (dier >> (9 + channel) & 1) {
                dma_request(timer->facts->capture_request + channel);
            }
            adc_trigger(ADC_TRIGGER((unsigned)(timer - timers), ADC_KIND_CHANNEL + channel));
        }
    }
}

/* --- Events --- */

/* The channel's match has a consumer. */
static bool listened(const tim_t *timer, unsigned channel) {
    const uint32_t dier = TIMER_REG(timer, TIM_DIER);
    return timer_selection(timer, channel) == 0 &&
           (TIMER_REG(timer, TIM_CCER) >> 4 * channel & 5 || dier >> (1 + channel) & 1 || dier >> (9 + channel) & 1 ||
            (TIMER_REG(timer, TIM_CR2) & 0xF00070) || timer_mode(timer, channel) != 0);
}

/* The first place after `place` at which something happens. */
static uint64_t next_place(const tim_t *timer, uint64_t place) {
    const bool centred = timer_is_centred(timer);
    const uint64_t period = timer_period(timer);
    uint64_t next = centred && place < timer->arr ? timer->arr : period;
    for (unsigned channel = 0; channel < TIMER_CHANNELS && !timer->facts->basic; ++channel) {
        const uint64_t ccr = timer->ccr[channel];
        if (!listened(timer, channel) || ccr > timer->arr) {
            continue;
        }
        const bool down = !centred && TIMER_REG(timer, TIM_CR1) & CR1_DIR;
        const uint64_t places[2] = {down ? timer->arr - ccr : ccr, centred ? period - ccr : period};
        for (unsigned i = 0; i < 2; ++i) {
            next = places[i] > place && places[i] < next ? places[i] : next;
        }
    }
    return next;
}

void timer_plan(tim_t *timer) {
    const unsigned number = (unsigned)(timer - timers);
    if (!timer->runs || timer_clocked_outside(timer) || timer->arr == 0) {
        soc_schedule(EVENT_TIMER + number, SOC_NEVER);
        return;
    }
    const uint64_t place = timer_place(timer, soc.now);
    soc_schedule(EVENT_TIMER + number, timer->at + (next_place(timer, place) - timer->place) * timer->tick);
}

static void set_tick(tim_t *timer) {
    const uint32_t hz = timer->facts->apb2 ? soc.timer2_hz : soc.timer1_hz;
    const uint32_t ratio = hz ? soc.hclk_hz / hz : 1;
    timer->tick = (uint64_t)(ratio ? ratio : 1) * (timer->psc + 1);
}

void timer_restart(tim_t *timer, uint64_t place) {
    set_tick(timer);
    timer->at = soc.now;
    timer->place = place;
    timer_plan(timer);
}

/* References before and after, for a rising edge that is a trigger. */
void timer_follow_references(tim_t *timer, uint64_t place) {
    const uint32_t cr2 = TIMER_REG(timer, TIM_CR2), mms = cr2 >> 4 & 7, mms2 = cr2 >> 20 & 15;
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        const bool now = timer_reference(timer, channel, place), rises = now && !timer->reference[channel];
        timer->reference[channel] = now;
        if (rises && mms == 4 + channel) {
            timer_trigger_out(timer, false);
        }
        if (rises && mms2 == 4 + channel) {
            timer_trigger_out(timer, true);
        }
    }
}

/* Update event: the shadow registers take what was written. */
void timer_update(tim_t *timer, bool by_counter) {
    if (TIMER_REG(timer, TIM_CR1) & CR1_UDIS) {
        return;
    }
    timer->psc = TIMER_REG(timer, TIM_PSC);
    timer->arr = TIMER_REG(timer, TIM_ARR);
    for (unsigned channel = 0; channel < TIMER_CHANNELS && !timer->facts->basic; ++channel) {
        if (timer_selection(timer, channel) == 0) {
            timer->ccr[channel] = TIMER_REG(timer, TIM_CCR1 + 4 * channel);
        }
    }
    timer->repetitions = timer->facts->advanced ? TIMER_REG(timer, TIM_RCR) : 0;
    if (by_counter || !(TIMER_REG(timer, TIM_CR1) & CR1_URS)) {
        timer_flag(timer, SR_UIF);
    }
    if (timer->facts->advanced && TIMER_REG(timer, TIM_BDTR) & BDTR_AOE) {
        timer_output_write(timer, TIM_BDTR, TIMER_REG(timer, TIM_BDTR) | BDTR_MOE);
    }
    const uint32_t cr2 = TIMER_REG(timer, TIM_CR2);
    if ((cr2 >> 4 & 7) == 2) {
        timer_trigger_out(timer, false);
    }
    if (timer->facts->advanced && (cr2 >> 20 & 15) == 2) {
        timer_trigger_out(timer, true);
    }
    timer_outputs_changed();
}

/* Overflow or underflow. */
static void turn(tim_t *timer) {
    if (timer->repetitions) {
        --timer->repetitions;
        return;
    }
    timer_update(timer, true);
    if (TIMER_REG(timer, TIM_CR1) & CR1_OPM) {
        TIMER_REG(timer, TIM_CR1) &= ~CR1_CEN;
        timer->runs = false;
    }
}

/* Compare pulse of channel 1 as a trigger. */
static void compare_pulse(tim_t *timer, unsigned channel) {
    const uint32_t cr2 = TIMER_REG(timer, TIM_CR2);
    if (channel == 0 && (cr2 >> 4 & 7) == 3) {
        timer_trigger_out(timer, false);
    }
    if (channel == 0 && (cr2 >> 20 & 15) == 3) {
        timer_trigger_out(timer, true);
    }
}

static void matches(tim_t *timer, uint64_t place) {
    const uint32_t cms = TIMER_REG(timer, TIM_CR1) >> 5 & 3;
    bool down;
    const uint32_t count = timer_count_at(timer, place, &down);
    const bool flagged = cms == 0 || cms == 3 || (cms == 1) == down;
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        if (!listened(timer, channel) || count != timer->ccr[channel]) {
            continue;
        }
        const unsigned mode = timer_mode(timer, channel);
        if (mode >= 1 && mode <= 3) {
            const bool level = mode == 1 || (mode == 3 && !timer->reference[channel]);
            if (level != timer->reference[channel]) {
                timer->reference[channel] = level;
                timer_outputs_changed();
            }
        }
        if (flagged) {
            timer_flag(timer, 2u << channel);
            compare_pulse(timer, channel);
        }
    }
}

void timer_event(unsigned number) {
    tim_t *timer = &timers[number];
    uint64_t place = timer->place + (soc.now - timer->at) / timer->tick;
    const uint64_t period = timer_period(timer);
    timer->at = soc.now;
    timer->place = place;
    const bool end = place >= period, middle = timer_is_centred(timer) && place == timer->arr;
    if (end) {
        timer->place = place = 0;
    }
    if (end || middle) {
        turn(timer);
        set_tick(timer);
        if (middle && timer->place != timer->arr) {
            timer->place = timer->arr;
        }
    }
    if (!timer->facts->basic) {
        matches(timer, timer->place);
        timer_follow_references(timer, timer->place);
    }
    timer_plan(timer);
}

void timer_count_external(tim_t *timer, bool down) {
    timer->down = down;
    const uint32_t arr = timer->arr;
    const bool wraps = down ? timer->count == 0 : timer->count >= arr;
    timer->count = wraps ? (down ? arr : 0) : timer->count + (down ? UINT32_MAX : 1);
    if (wraps) {
        turn(timer);
    }
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        if (timer_selection(timer, channel) == 0 && timer->count == timer->ccr[channel]) {
            timer_flag(timer, 2u << channel);
        }
    }
}
