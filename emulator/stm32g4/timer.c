/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/timer.h"

#include <string.h>

#include "stm32g4/nvic.h"
#include "stm32g4/pins.h"

#define IRQ(number) (16u + (number))

static const timer_facts_t facts[TIMERS] = {
    [TIM1] = {0x40012C00, true, false, false, true, IRQ(25), IRQ(24), IRQ(26), IRQ(27), 46, 42},
    [TIM2] = {0x40000000, false, false, true, false, IRQ(28), IRQ(28), IRQ(28), IRQ(28), 60, 56},
    [TIM3] = {0x40000400, false, false, false, false, IRQ(29), IRQ(29), IRQ(29), IRQ(29), 65, 61},
    [TIM4] = {0x40000800, false, false, false, false, IRQ(30), IRQ(30), IRQ(30), IRQ(30), 71, 67},
    [TIM5] = {0x40000C00, false, false, true, false, IRQ(50), IRQ(50), IRQ(50), IRQ(50), 76, 72},
    [TIM6] = {0x40001000, false, true, false, false, IRQ(54), IRQ(54), IRQ(54), IRQ(54), 8, 0},
    [TIM7] = {0x40001400, false, true, false, false, IRQ(55), IRQ(55), IRQ(55), IRQ(55), 9, 0},
    [TIM8] = {0x40013400, true, false, false, true, IRQ(44), IRQ(43), IRQ(45), IRQ(46), 53, 49},
};

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
    const uint64_t place = timer->place + (timer->runs ? (cycle - timer->at) / timer->tick : 0);
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

static bool clocked_outside(const tim_t *timer) {
    return timer_is_encoder(timer) || timer_is_external(timer);
}

static uint32_t count_now(const tim_t *timer, bool *down) {
    if (clocked_outside(timer)) {
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
    if (!timer->runs || clocked_outside(timer) || timer->arr == 0) {
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
static void follow_references(tim_t *timer, uint64_t place) {
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
static void update(tim_t *timer, bool by_counter) {
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
    update(timer, true);
    if (TIMER_REG(timer, TIM_CR1) & CR1_OPM) {
        TIMER_REG(timer, TIM_CR1) &= ~CR1_CEN;
        timer->runs = false;
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
            const uint32_t cr2 = TIMER_REG(timer, TIM_CR2);
            if (channel == 0 && (cr2 >> 4 & 7) == 3) {
                timer_trigger_out(timer, false);
            }
            if (channel == 0 && (cr2 >> 20 & 15) == 3) {
                timer_trigger_out(timer, true);
            }
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
        follow_references(timer, timer->place);
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

/* --- Registers --- */

void timer_start(tim_t *timer) {
    if (timer->runs) {
        return;
    }
    if (timer->arr == 0) {
        soc_violation("%s with the auto-reload register 0: the counter is blocked",
                      soc_name(timer->facts->base + TIM_CR1));
    }
    TIMER_REG(timer, TIM_CR1) |= CR1_CEN;
    timer->runs = true;
    timer_restart(timer, timer->place);
    if ((TIMER_REG(timer, TIM_CR2) >> 4 & 7) == 1) {
        timer_trigger_out(timer, false);
    }
    if (timer->facts->advanced && (TIMER_REG(timer, TIM_CR2) >> 20 & 15) == 1) {
        timer_trigger_out(timer, true);
    }
    if (!timer->facts->basic && !clocked_outside(timer)) {
        follow_references(timer, timer->place);
    }
    timer_outputs_changed();
}

static void control_write(tim_t *timer, uint32_t value) {
    const uint32_t old = TIMER_REG(timer, TIM_CR1), place = (uint32_t)timer_place(timer, soc.now);
    if (value & 0x1000) {
        soc_violation("%s = 0x%X: dithering is not modelled", soc_name(timer->facts->base), value);
    }
    if (old & CR1_CEN && (old ^ value) & CR1_CMS) {
        soc_violation("%s = 0x%X: the alignment changes while the counter runs", soc_name(timer->facts->base), value);
    }
    if (old & CR1_CEN && !(value & CR1_CEN)) {
        timer->place = place;
        timer->runs = false;
    }
    TIMER_REG(timer, TIM_CR1) = (value & ~CR1_CEN) | (old & value & CR1_CEN);
    if (value & CR1_CEN && !(old & CR1_CEN)) {
        timer_start(timer);
    } else {
        timer_plan(timer);
        timer_outputs_changed();
    }
}

static void event_write(tim_t *timer, uint32_t value) {
    if (value & 1) {
        timer->count = 0;
        update(timer, false);
        timer_restart(timer, 0);
        if ((TIMER_REG(timer, TIM_CR2) >> 4 & 7) == 0) {
            timer_trigger_out(timer, false);
        }
    }
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        if (value >> (1 + channel) & 1) {
            if (timer_selection(timer, channel)) {
                timer_capture(timer, channel);
            } else {
                timer_flag(timer, 2u << channel);
            }
        }
    }
    if (value & 0x20) {
        soc_violation("%s = 0x%X: COMG is not modelled", soc_name(timer->facts->base + TIM_EGR), value);
    }
    if (value & 0x40) {
        timer_flag(timer, SR_TIF);
    }
    if (value & 0x180 && timer->facts->advanced) {
        timer_break(timer, value & 0x180);
    }
}

static void compare_write(tim_t *timer, unsigned channel, uint32_t value) {
    if (!timer->facts->wide && value > 0xFFFF) {
        soc_violation("write of %s, value 0x%X: 16 bits without dithering",
                      soc_name(timer->facts->base + TIM_CCR1 + 4 * channel), value);
    }
    if (timer_selection(timer, channel)) {
        soc_violation("write of %s, value 0x%X: the channel is an input",
                      soc_name(timer->facts->base + TIM_CCR1 + 4 * channel), value);
    }
    TIMER_REG(timer, TIM_CCR1 + 4 * channel) = value;
    if (!timer_preloads(timer, channel)) {
        timer->ccr[channel] = value;
        if (timer->runs && !clocked_outside(timer)) {
            follow_references(timer, timer_place(timer, soc.now));
        }
        timer_plan(timer);
        timer_outputs_changed();
    }
}

static void mode_write(tim_t *timer, uint32_t offset, uint32_t value) {
    const uint32_t changed = TIMER_REG(timer, offset) ^ value;
    for (unsigned i = 0; i < 2; ++i) {
        const unsigned channel = (offset - TIM_CCMR1) / 4 * 2 + i, shift = 8 * i;
        const bool input = value >> shift & 3;
        if (changed >> shift & 3 && TIMER_REG(timer, TIM_CCER) >> 4 * channel & 1) {
            soc_violation("write of %s, value 0x%X: CC%uS changes while the channel is on",
                          soc_name(timer->facts->base + offset), value, channel + 1);
        }
        if (!input && value >> (16 + shift) & 1) {
            soc_violation("write of %s, value 0x%X: compare mode %u of channel %u is not modelled",
                          soc_name(timer->facts->base + offset), value, 8 + (value >> (4 + shift) & 7), channel + 1);
        }
        if (!input && value >> shift & 0x84) {
            soc_violation("write of %s, value 0x%X: OC%uFE and OC%uCE are not modelled",
                          soc_name(timer->facts->base + offset), value, channel + 1, channel + 1);
        }
    }
    if (timer->lock == 3 && changed & 0x01017878) {
        soc_violation("write of %s, value 0x%X: locked by TIMx_BDTR.LOCK", soc_name(timer->facts->base + offset),
                      value);
    }
    TIMER_REG(timer, offset) = value;
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        if (!timer_preloads(timer, channel) && timer_selection(timer, channel) == 0) {
            timer->ccr[channel] = TIMER_REG(timer, TIM_CCR1 + 4 * channel);
        }
    }
    timer_plan(timer);
    timer_outputs_changed();
}

static void period_write(tim_t *timer, uint32_t value) {
    if (!timer->facts->wide && value > 0xFFFF) {
        soc_violation("write of %s, value 0x%X: 16 bits without dithering", soc_name(timer->facts->base + TIM_ARR),
                      value);
    }
    TIMER_REG(timer, TIM_ARR) = value;
    if (!(TIMER_REG(timer, TIM_CR1) & CR1_ARPE)) {
        bool down;
        const uint32_t count = count_now(timer, &down);
        if (timer->runs && !clocked_outside(timer) && count > value) {
            soc_violation("write of %s, value 0x%X: below the counter, %u, without preload",
                          soc_name(timer->facts->base + TIM_ARR), value, count);
        }
        timer->arr = value;
        timer_restart(timer, timer_is_centred(timer) && down ? 2 * (uint64_t)value - count : count);
        timer_outputs_changed();
    }
}

static tim_t *timer_of(uint32_t address) {
    for (unsigned i = 0; i < TIMERS; ++i) {
        if ((address & ~0x3FFu) == facts[i].base) {
            return &timers[i];
        }
    }
    soc_violation("0x%08X: no timer", address);
}

bool timer_clears_by_zeros(uint32_t address) {
    for (unsigned i = 0; i < TIMERS; ++i) {
        if (address == facts[i].base + TIM_SR) {
            return true;
        }
    }
    return false;
}

static uint32_t timer_read(uint32_t address) {
    tim_t *timer = timer_of(address);
    const uint32_t offset = address & 0x3FF;
    bool down;
    const uint32_t count = count_now(timer, &down);
    switch (offset) {
    case TIM_CNT:
        return count | (TIMER_REG(timer, TIM_CR1) & 0x800 ? (TIMER_REG(timer, TIM_SR) & 1) << 31 : 0);
    case TIM_CR1:
        return (REG(address) & ~CR1_DIR) | (down ? CR1_DIR : 0);
    default:
        if (offset >= TIM_CCR1 && offset < TIM_CCR1 + 16 && timer_selection(timer, (offset - TIM_CCR1) / 4)) {
            TIMER_REG(timer, TIM_SR) &= ~(2u << (offset - TIM_CCR1) / 4); /* a read of a capture clears its flag */
            timer_lines(timer);
        }
        return REG(address);
    }
}

static void count_write(tim_t *timer, uint32_t value) {
    if (!timer->facts->wide && value > 0xFFFF) {
        soc_violation("write of %s, value 0x%X: 16 bits", soc_name(timer->facts->base + TIM_CNT), value);
    }
    timer->count = value;
    bool down;
    timer_count_at(timer, timer_place(timer, soc.now), &down);
    if (value > timer->arr) {
        soc_violation("write of %s, value 0x%X: above the auto-reload register, 0x%X",
                      soc_name(timer->facts->base + TIM_CNT), value, timer->arr);
    }
    if (!timer_is_centred(timer)) {
        timer_restart(timer, down ? timer->arr - value : value);
    } else {
        timer_restart(timer, down && value ? 2 * (uint64_t)timer->arr - value : value);
    }
}

static void timer_write(uint32_t address, uint32_t value) {
    tim_t *timer = timer_of(address);
    const uint32_t offset = address & 0x3FF;
    switch (offset) {
    case TIM_CR1:
        control_write(timer, value);
        break;
    case TIM_SMCR:
        timer_check_slave(timer, value);
        REG(address) = value;
        timer_plan(timer);
        break;
    case TIM_DIER:
        REG(address) = value;
        timer_lines(timer);
        timer_plan(timer);
        break;
    case TIM_SR:
        REG(address) &= value; /* write zero to clear */
        timer_lines(timer);
        timer_break_changed();
        break;
    case TIM_EGR:
        event_write(timer, value);
        break;
    case TIM_CCMR1:
    case TIM_CCMR1 + 4:
        mode_write(timer, offset, value);
        break;
    case TIM_CNT:
        count_write(timer, value);
        break;
    case TIM_ARR:
        period_write(timer, value);
        break;
    case TIM_PSC:
    case TIM_RCR:
    case TIM_ECR:
        REG(address) = value;
        break;
    case TIM_TISEL:
    case TIM_CCMR3:
        soc_violation("write of %s, value 0x%X: not modelled", soc_name(address), value);
    default:
        if (offset >= TIM_CCR1 && offset < TIM_CCR1 + 16) {
            compare_write(timer, (offset - TIM_CCR1) / 4, value);
        } else {
            timer_output_write(timer, offset, value);
        }
    }
}

void timer_attach(void) {
    static const struct {
        uint32_t enable;
        unsigned bit;
    } clocks[TIMERS] = {
        [TIM1] = {0x40021060u, 11}, [TIM2] = {0x40021058u, 0}, [TIM3] = {0x40021058u, 1}, [TIM4] = {0x40021058u, 2},
        [TIM5] = {0x40021058u, 3},  [TIM6] = {0x40021058u, 4}, [TIM7] = {0x40021058u, 5}, [TIM8] = {0x40021060u, 13}};
    for (unsigned i = 0; i < TIMERS; ++i) {
        timers[i].facts = &facts[i];
        soc_attach(facts[i].base, 0x400, clocks[i].enable, clocks[i].bit, timer_read, timer_write);
    }
}

void timer_reset(void) {
    for (unsigned i = 0; i < TIMERS; ++i) {
        memset(&timers[i], 0, sizeof timers[i]);
        timers[i].facts = &facts[i];
        timers[i].arr = REG(facts[i].base + TIM_ARR);
        timers[i].tick = 1;
        timer_lines(&timers[i]);
    }
}
