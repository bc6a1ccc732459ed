/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Output side of the timers: pins, edges up to the next update, breaks, lock (RM0440, 28.3.15 to 28.3.18, table "output
 * control bits for complementary channels with break feature").
 */
#include "stm32g4/part_pins.h"
#include "stm32g4/timer.h"

#define BDTR_UNMODELLED 0x3C000000u /* bidirectional breaks */
#define AF_COMPARATORS 7u
#define BREAK_INPUTS 2u

/* --- Levels --- */

/* Dead time in cycles of the timer's clock, BDTR.DTG (28.6.20), for CR1.CKD = 0. */
static uint64_t dead_time(const tim_t *timer) {
    const uint32_t dtg = TIMER_REG(timer, TIM_BDTR) & 0xFF, unit = 1u << (TIMER_REG(timer, TIM_CR1) >> 8 & 3);
    const uint32_t steps = !(dtg & 0x80)          ? dtg
                           : (dtg & 0xC0) == 0x80 ? (64 + (dtg & 0x3F)) * 2
                           : (dtg & 0xE0) == 0xC0 ? (32 + (dtg & 0x1F)) * 8
                                                  : (32 + (dtg & 0x1F)) * 16;
    return (uint64_t)steps * unit;
}

typedef struct {
    tim_t *timer;
    unsigned channel;
    bool complementary;
} output_t;

static bool output_of(unsigned pin, unsigned function, output_t *output) {
    unsigned number;
    if (!pins_channel(pin, function, &number, &output->channel, &output->complementary)) {
        return false;
    }
    output->timer = &timers[number];
    return timer_selection(output->timer, output->channel) == 0;
}

/* How the output is driven at present: by the reference, at a level, or not at all. */
typedef enum { NOT_DRIVEN, AT_LEVEL, BY_REFERENCE } drive_kind_t;

static drive_kind_t drive_of(const output_t *output, bool *level) {
    const tim_t *timer = output->timer;
    const uint32_t ccer = TIMER_REG(timer, TIM_CCER) >> 4 * output->channel;
    const uint32_t own = output->complementary ? ccer >> 2 : ccer, other = output->complementary ? ccer : ccer >> 2;
    *level = own >> 1 & 1; /* inactive: 0 before the polarity */
    if (!timer->facts->advanced) {
        return own & 1 ? BY_REFERENCE : NOT_DRIVEN;
    }
    const uint32_t bdtr = TIMER_REG(timer, TIM_BDTR);
    if (bdtr & BDTR_MOE) {
        if (own & 1) {
            return BY_REFERENCE;
        }
        return other & 1 && bdtr & BDTR_OSSR ? AT_LEVEL : NOT_DRIVEN;
    }
    if (!(bdtr & BDTR_OSSI) || !((own | other) & 1)) {
        return NOT_DRIVEN;
    }
    *level = TIMER_REG(timer, TIM_CR2) >> (8 + 2 * output->channel + output->complementary) & 1; /* OISx, OISxN */
    return AT_LEVEL;
}

static bool pairs(const output_t *output) {
    return output->timer->facts->advanced && (TIMER_REG(output->timer, TIM_CCER) >> 4 * output->channel & 5) == 5;
}

static bool polarised(const output_t *output, bool reference) {
    const uint32_t ccer = TIMER_REG(output->timer, TIM_CCER) >> 4 * output->channel;
    const bool active = output->complementary && pairs(output) ? !reference : reference;
    return active != ((output->complementary ? ccer >> 3 : ccer >> 1) & 1);
}

bool timer_output(unsigned pin, unsigned function, bool *level) {
    output_t output;
    if (!output_of(pin, function, &output)) {
        return false;
    }
    const drive_kind_t drive = drive_of(&output, level);
    if (drive == BY_REFERENCE) {
        *level = polarised(&output, timer_reference(output.timer, output.channel, timer_place(output.timer, soc.now)));
    }
    return drive != NOT_DRIVEN;
}

/* --- Edges --- */

/* The next place after `place` at which the reference may change. */
static uint64_t next_change(const tim_t *timer, unsigned channel, uint64_t place) {
    const uint64_t period = timer_period(timer), ccr = timer->ccr[channel];
    uint64_t next = period;
    if (ccr <= timer->arr) {
        const bool down = !timer_is_centred(timer) && TIMER_REG(timer, TIM_CR1) & CR1_DIR;
        const uint64_t places[2] = {down ? timer->arr - ccr : ccr, timer_is_centred(timer) ? period - ccr : period};
        for (unsigned i = 0; i < 2; ++i) {
            next = places[i] > place && places[i] < next ? places[i] : next;
        }
    }
    if (timer_is_centred(timer) && place < timer->arr && timer->arr < next) {
        next = timer->arr;
    }
    return next;
}

unsigned timer_edges(unsigned pin, uint64_t to, timer_edge_t edges[TIMER_EDGES_MAX], bool *driven) {
    output_t output;
    const int function = gpio_function(pin);
    bool level = false;
    edges[0] = (timer_edge_t){soc.now, false};
    *driven = function >= 0 && output_of(pin, (unsigned)function, &output);
    const drive_kind_t drive = *driven ? drive_of(&output, &level) : NOT_DRIVEN;
    *driven = drive != NOT_DRIVEN;
    edges[0].level = *driven && level;
    if (drive != BY_REFERENCE) {
        return 1;
    }
    const tim_t *timer = output.timer;
    uint64_t place = timer_place(timer, soc.now), base = timer->at - timer->place * timer->tick;
    bool reference = timer_reference(timer, output.channel, place);
    edges[0].level = polarised(&output, reference);
    const uint64_t dead = pairs(&output) ? dead_time(timer) * (timer->tick / (timer->psc + 1)) : 0;
    unsigned count = 1;
    while (timer->runs && count < TIMER_EDGES_MAX) {
        place = next_change(timer, output.channel, place);
        uint64_t cycle = base + place * timer->tick;
        if (place >= timer_period(timer)) {
            base = cycle;
            place = 0;
        }
        if (cycle >= to) {
            break;
        }
        const bool next = timer_reference(timer, output.channel, place);
        if (next != reference) {
            reference = next;
            const bool goes_active = polarised(&output, next) != polarised(&output, !next) &&
                                     (output.complementary && pairs(&output) ? !next : next);
            cycle += goes_active ? dead : 0;
            edges[count++] = (timer_edge_t){cycle, polarised(&output, next)};
        }
    }
    return count;
}

/* --- Breaks --- */

static bool input_is_active(const tim_t *timer, unsigned input) {
    const uint32_t af = TIMER_REG(timer, input ? TIM_AF2 : TIM_AF1);
    const bool active_high = TIMER_REG(timer, TIM_BDTR) >> (input ? 25 : 13) & 1;
    const pin_list_t *list = pins_of_timer((unsigned)(timer - timers), input ? PIN_BKIN2 : PIN_BKIN);
    bool active = false;
    for (unsigned i = 0; af & 1 && i < list->count; ++i) {
        if (gpio_function(list->row[i]->pin) == list->row[i]->function) {
            active = active || (gpio_level(list->row[i]->pin) != (af >> 9 & 1)) == active_high;
        }
    }
    for (unsigned i = 0; i < AF_COMPARATORS; ++i) {
        if (af >> (1 + i) & 1) {
            const bool swaps = i < 4 && af >> (10 + i) & 1;
            active = active || (analog_comparator(i) != swaps) == active_high;
        }
    }
    return active;
}

void timer_break(tim_t *timer, uint32_t flag) {
    TIMER_REG(timer, TIM_BDTR) &= ~BDTR_MOE;
    timer_flag(timer, flag);
    timer_outputs_changed();
}

void timer_break_changed(void) {
    for (unsigned i = 0; i < TIMERS; ++i) {
        tim_t *timer = &timers[i];
        if (!timer->facts || !timer->facts->advanced) {
            continue;
        }
        for (unsigned input = 0; input < BREAK_INPUTS; ++input) {
            const bool enabled = TIMER_REG(timer, TIM_BDTR) & (input ? BDTR_BK2E : BDTR_BKE);
            if (enabled && input_is_active(timer, input)) {
                const uint32_t flag = input ? SR_B2IF : SR_BIF;
                if (TIMER_REG(timer, TIM_BDTR) & BDTR_MOE || !(TIMER_REG(timer, TIM_SR) & flag)) {
                    timer_break(timer, flag);
                }
            }
        }
    }
}

/* --- Registers --- */

static void locked(const tim_t *timer, uint32_t offset, uint32_t value, uint32_t bits) {
    if ((TIMER_REG(timer, offset) ^ value) & bits) {
        soc_violation("write of %s, value 0x%X: bits 0x%X are locked by TIMx_BDTR.LOCK",
                      soc_name(timer->facts->base + offset), value, (TIMER_REG(timer, offset) ^ value) & bits);
    }
}

static void break_write(tim_t *timer, uint32_t value) {
    if (value & BDTR_UNMODELLED) {
        soc_violation("write of %s, value 0x%X: bidirectional breaks are not modelled",
                      soc_name(timer->facts->base + TIM_BDTR), value);
    }
    if (timer->lock >= 1) {
        locked(timer, TIM_BDTR, value, 0x3C000000u | 0x03FF0000u | 0x0300u | 0xFFu | BDTR_BKE | BDTR_BKP | BDTR_AOE);
    }
    if (timer->lock >= 2) {
        locked(timer, TIM_BDTR, value, BDTR_OSSI | BDTR_OSSR);
    }
    TIMER_REG(timer, TIM_BDTR) = value;
    if (timer->lock == 0) {
        timer->lock = (uint8_t)(value >> 8 & 3);
    }
    timer_break_changed();
    timer_outputs_changed();
}

void timer_output_write(tim_t *timer, uint32_t offset, uint32_t value) {
    switch (offset) {
    case TIM_BDTR:
        break_write(timer, value);
        return;
    case TIM_CR2:
        if (timer->lock >= 1) {
            locked(timer, offset, value, 0x5FF00u);
        }
        if (value & 0x85u) {
            soc_violation("write of %s, value 0x%X: TI1S and CCPC are not modelled",
                          soc_name(timer->facts->base + offset), value);
        }
        break;
    case TIM_CCER:
        if (timer->lock >= 2) {
            locked(timer, offset, value, 0xAAAAu);
        }
        break;
    case TIM_AF1:
    case TIM_AF2:
        if (timer->lock >= 1) {
            locked(timer, offset, value, 0x3EFFu);
        }
        break;
    default:
        soc_violation("write of %s, value 0x%X: not modelled", soc_name(timer->facts->base + offset), value);
    }
    TIMER_REG(timer, offset) = value;
    if (offset == TIM_CCER || offset == TIM_CR2) {
        timer_plan(timer);
    }
    timer_break_changed();
    timer_outputs_changed();
}
