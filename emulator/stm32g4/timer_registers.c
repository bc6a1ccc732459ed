/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Registers of the timers: reads and writes, start, reset.
 */
#include <string.h>

#include "stm32g4/nvic.h"
#include "stm32g4/timer.h"

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

void timer_enable(tim_t *timer) {
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
    if (!timer->facts->basic && !timer_clocked_outside(timer)) {
        timer_follow_references(timer, timer->place);
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
        timer_enable(timer);
    } else {
        timer_plan(timer);
        timer_outputs_changed();
    }
}

static void event_write(tim_t *timer, uint32_t value) {
    if (value & 1) {
        timer->count = 0;
        timer_update(timer, false);
        timer_restart(timer, 0);
        if ((TIMER_REG(timer, TIM_CR2) >> 4 & 7) == 0) {
            timer_trigger_out(timer, false);
        }
        if (timer->facts->advanced && (TIMER_REG(timer, TIM_CR2) >> 20 & 15) == 0) {
            timer_trigger_out(timer, true);
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
        if (timer->runs && !timer_clocked_outside(timer)) {
            timer_follow_references(timer, timer_place(timer, soc.now));
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
        const uint32_t count = timer_count_now(timer, &down);
        if (timer->runs && !timer_clocked_outside(timer) && count > value) {
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
    const uint32_t count = timer_count_now(timer, &down);
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
