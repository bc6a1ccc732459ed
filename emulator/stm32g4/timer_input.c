/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Input side of the timers: triggers between timers, slave modes, capture, encoder with index (RM0440, 29.4).
 */
#include "stm32g4/part_pins.h"
#include "stm32g4/timer.h"

#define SMS(smcr) (((smcr)&7u) | ((smcr) >> 13 & 8u))
#define TS(smcr) (((smcr) >> 4 & 7u) | ((smcr) >> 17 & 0x18u))
#define TS_NONE 255u

enum {
    SMS_OFF = 0,
    SMS_ENCODER_1 = 1,
    SMS_ENCODER_3 = 3,
    SMS_RESET = 4,
    SMS_TRIGGER = 6,
    SMS_CLOCK = 7,
    SMS_RESET_TRIGGER = 8
};
enum { TS_TI1_EDGE = 4, TS_TI1 = 5, TS_TI2 = 6, TS_ETR = 7 };

/* Internal triggers of all timers, table "internal trigger connection": ITR0 to ITR3 are codes 0 to 3, ITR4 and on
 * codes 8 and on. */
static const uint8_t trigger_code[TIMERS] = {
    [TIM1] = 0, [TIM2] = 1, [TIM3] = 2, [TIM4] = 3, [TIM5] = 8, [TIM8] = 9, [TIM6] = TS_NONE, [TIM7] = TS_NONE};

bool timer_is_encoder(const tim_t *timer) {
    if (timer->facts->basic) {
        return false;
    }
    const uint32_t sms = SMS(TIMER_REG(timer, TIM_SMCR));
    return sms >= SMS_ENCODER_1 && sms <= SMS_ENCODER_3;
}

bool timer_is_external(const tim_t *timer) {
    return !timer->facts->basic && SMS(TIMER_REG(timer, TIM_SMCR)) == SMS_CLOCK;
}

void timer_check_slave(const tim_t *timer, uint32_t value) {
    const uint32_t sms = SMS(value), ts = TS(value);
    if (sms == 5 || sms > SMS_RESET_TRIGGER || value & 0x4000) {
        soc_violation("write of %s, value 0x%X: slave mode %u is not modelled", soc_name(timer->facts->base + TIM_SMCR),
                      value, sms);
    }
    const bool own = trigger_code[timer - timers] == ts;
    if (sms >= SMS_RESET && own) {
        soc_violation("write of %s, value 0x%X: the timer's own trigger output is not an input of it",
                      soc_name(timer->facts->base + TIM_SMCR), value);
    }
    if (SMS(TIMER_REG(timer, TIM_SMCR)) && sms && TS(TIMER_REG(timer, TIM_SMCR)) != ts) {
        soc_violation("write of %s, value 0x%X: TS changes while SMS is not 0", soc_name(timer->facts->base + TIM_SMCR),
                      value);
    }
}

void timer_capture(tim_t *timer, unsigned channel) {
    bool down;
    const bool outside = timer_is_encoder(timer) || timer_is_external(timer);
    const uint32_t count = outside ? timer->count : timer_count_at(timer, timer_place(timer, soc.now), &down);
    if (TIMER_REG(timer, TIM_SR) >> (1 + channel) & 1) {
        TIMER_REG(timer, TIM_SR) |= 0x200u << channel; /* over-capture */
    }
    TIMER_REG(timer, TIM_CCR1 + 4 * channel) = count;
    timer_flag(timer, 2u << channel);
}

/* Channels that capture on TRC. */
static void capture_trigger(tim_t *timer) {
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        if (timer_selection(timer, channel) == 3 && TIMER_REG(timer, TIM_CCER) >> 4 * channel & 1) {
            timer_capture(timer, channel);
        }
    }
}

void timer_input_trigger(tim_t *timer) {
    switch (SMS(TIMER_REG(timer, TIM_SMCR))) {
    case SMS_RESET:
        TIMER_REG(timer, TIM_EGR) = 0;
        soc_write(timer->facts->base + TIM_EGR, 1, 4);
        break;
    case SMS_TRIGGER:
        timer_enable(timer);
        break;
    case SMS_RESET_TRIGGER:
        soc_write(timer->facts->base + TIM_EGR, 1, 4);
        timer_enable(timer);
        break;
    case SMS_CLOCK:
        if (timer->runs) {
            timer_count_external(timer, TIMER_REG(timer, TIM_CR1) & CR1_DIR);
        }
        break;
    default:
        return;
    }
    timer_flag(timer, SR_TIF);
}

void timer_trigger_out(const tim_t *source, bool second) {
    const unsigned number = (unsigned)(source - timers);
    adc_trigger(ADC_TRIGGER(number, second ? ADC_KIND_TRGO2 : ADC_KIND_TRGO));
    if (second || trigger_code[number] == TS_NONE) {
        return;
    }
    for (unsigned i = 0; i < TIMERS; ++i) {
        tim_t *timer = &timers[i];
        const uint32_t enable = timer->facts->apb2 ? REG(0x40021060u) : REG(0x40021058u);
        if (timer == source || timer->facts->basic || !enable ||
            TS(TIMER_REG(timer, TIM_SMCR)) != trigger_code[number]) {
            continue;
        }
        capture_trigger(timer);
        timer_input_trigger(timer);
    }
}

/* --- Pins --- */

/* Level of an input of a timer. */
static bool input_level(const tim_t *timer, pin_kind_t kind) {
    const pin_list_t *list = pins_of_timer((unsigned)(timer - timers), kind);
    for (unsigned i = 0; i < list->count; ++i) {
        if (gpio_function(list->row[i]->pin) == list->row[i]->function) {
            return gpio_level(list->row[i]->pin);
        }
    }
    return false;
}

static bool inverted(const tim_t *timer, unsigned channel) {
    return TIMER_REG(timer, TIM_CCER) >> (1 + 4 * channel) & 1;
}

/* The index acts when the quadrature state is the one selected, at its boundary towards lower counts. */
static void index_step(tim_t *timer, bool down, bool before, bool after) {
    const uint32_t ecr = TIMER_REG(timer, TIM_ECR);
    const bool directed = (ecr >> 1 & 3) == 0 || (ecr >> 1 & 3) == (down ? 2u : 1u);
    if (!(ecr & 1) || !directed || (ecr >> 5 & 1 && timer->index_seen)) {
        return;
    }
    if (down ? before : after) {
        timer->count = down ? timer->arr : 0;
        timer->index_seen = true;
        TIMER_REG(timer, TIM_SR) |= 1u << 20; /* IDXF */
    }
}

static bool index_selected(const tim_t *timer, bool a, bool b) {
    const uint32_t position = TIMER_REG(timer, TIM_ECR) >> 6 & 3;
    const bool etr = input_level(timer, PIN_ETR) != (TIMER_REG(timer, TIM_SMCR) >> 15 & 1);
    return etr && position == ((b ? 1u : 0) | (a ? 2u : 0));
}

/* Table of counting direction against encoder signals. */
static void encoder_edge(tim_t *timer, unsigned input, bool level) {
    const uint32_t sms = SMS(TIMER_REG(timer, TIM_SMCR));
    level = level != inverted(timer, input);
    const bool other = input_level(timer, input ? PIN_CH1 : PIN_CH2) != inverted(timer, 1 - input);
    const bool counts = sms == SMS_ENCODER_3 || sms == SMS_ENCODER_1 + input;
    if (!counts || !timer->runs) {
        return;
    }
    const bool down = input == 0 ? level == other : level != other;
    const bool a = input == 0 ? level : other, b = input == 0 ? other : level;
    const bool before = index_selected(timer, input == 0 ? !a : a, input == 0 ? b : !b);
    timer_count_external(timer, down);
    index_step(timer, down, before, index_selected(timer, a, b));
}

/* Capture of an input: a selection of 1 is the channel's own input, 2 its neighbour's. */
static void capture_edge(tim_t *timer, unsigned input, bool level) {
    for (unsigned channel = 0; channel < TIMER_CHANNELS; ++channel) {
        const unsigned selection = timer_selection(timer, channel);
        const bool connected = (selection == 1 && channel == input) || (selection == 2 && channel == (input ^ 1u));
        const uint32_t ccer = TIMER_REG(timer, TIM_CCER) >> 4 * channel;
        const bool both = (ccer & 0xA) == 0xA, edge = both || level != (ccer >> 1 & 1);
        if (connected && ccer & 1 && edge) {
            timer_capture(timer, channel);
        }
    }
}

void timer_input(unsigned pin, bool level) {
    unsigned number, input;
    bool complementary;
    const int function = gpio_function(pin);
    if (function < 0 || !pins_channel(pin, (unsigned)function, &number, &input, &complementary) || complementary) {
        return;
    }
    tim_t *timer = &timers[number];
    const uint32_t ts = TS(TIMER_REG(timer, TIM_SMCR));
    if (timer_is_encoder(timer) && input < 2) {
        encoder_edge(timer, input, level);
    } else if ((ts == TS_TI1 && input == 0) || (ts == TS_TI2 && input == 1)) {
        if (level != inverted(timer, input)) {
            timer_input_trigger(timer);
        }
    } else if (ts == TS_TI1_EDGE && input == 0) {
        timer_input_trigger(timer);
    }
    capture_edge(timer, input, level);
}
