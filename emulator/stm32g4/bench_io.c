/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/bench_io.h"

#include <string.h>

#include "stm32g4/flash.h"
#include "stm32g4/part_pins.h"
#include "stm32g4/peripherals.h"

#define CONVERTER_BITS 12
#define VREF_V 3.3
#define MEMORY_FIRST_PAGE 0 /* of bank 2 */
#define EDGES_MAX (2 * TIMER_EDGES_MAX)
#define NS_PER_S 1e9

static board_t *board;
static wiring_t wiring;
static uint32_t encoder_at; /* count whose levels the pins have */

/* --- Analogue --- */

static uint16_t code_at(int pin) {
    for (unsigned phase = 0; phase < WIRING_PHASES; ++phase) {
        if (pin == wiring.current[phase]) {
            return board->adc.phase_current_counts[phase];
        }
        if (pin == wiring.winding[phase]) {
            return board->temperature_input[HAL_ADC_WINDING + phase] >> (16 - CONVERTER_BITS);
        }
        if (pin == wiring.switches[phase]) {
            return board->temperature_input[HAL_ADC_INVERTER + phase] >> (16 - CONVERTER_BITS);
        }
    }
    return pin == wiring.dc_link  ? board->adc.bus_voltage_counts
           : pin == wiring.torque ? board->adc.load_torque_counts
                                  : 0;
}

static uint16_t analogue(void *context, unsigned pin) {
    (void)context;
    return code_at((int)pin);
}

/* --- Lines --- */

static void set(int pin, bool level) {
    if (pin >= 0) {
        gpio_drive((unsigned)pin, level);
    }
}

static void set_currents(double volts_of_tripped) {
    for (unsigned phase = 0; phase < WIRING_PHASES; ++phase) {
        if (wiring.current[phase] >= 0) {
            const double volts = board->adc.phase_current_counts[phase] / (double)(1u << CONVERTER_BITS) * VREF_V;
            analog_set_pin((unsigned)wiring.current[phase], volts_of_tripped > volts ? volts_of_tripped : volts);
        }
    }
    analog_refresh();
}

static void set_sto(bool first, bool second) {
    set(wiring.sto[0], first);
    set(wiring.sto[1], second);
    set(wiring.breaks[0], first && second);
    set(wiring.breaks[1], first && second);
}

/* The bench moves its lines at any time, and the model looks at them once a period: the board keeps a fall of which the
 * line has risen again. */
static void sto_lines(void) {
    const uint32_t fallen = board->break_causes;
    board->break_causes &= ~(HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2);
    set_sto(!(fallen & HAL_PWM_BREAK_STO_1), !(fallen & HAL_PWM_BREAK_STO_2));
    set_sto(board->sto_energised[0], board->sto_energised[1]);
}

void bench_io_lines(void) {
    sto_lines();
    set(wiring.driver_fault, true);
    if (board->plant->tripped) { /* the plant has opened the switches; a comparator has no memory */
        set_currents(VREF_V);
        plant_clear_trip(board->plant);
    }
    set_currents(0.0);
}

/* --- Encoder --- */

static void step(uint32_t count) {
    const unsigned state = count & 3; /* A leads B */
    set(wiring.encoder_a, state == 1 || state == 2);
    set(wiring.encoder_b, state >= 2);
}

void bench_io_encoder(void) {
    const uint32_t mask = board->encoder_bits < 32 ? (1u << board->encoder_bits) - 1 : UINT32_MAX;
    uint32_t ahead = (board->encoder.counts - encoder_at) & mask;
    const bool backwards = ahead > mask / 2;
    ahead = backwards ? mask - ahead + 1 : ahead;
    for (; ahead > 0; --ahead) {
        const uint32_t next = (encoder_at + (backwards ? UINT32_MAX : 1)) & mask;
        if (backwards) {
            set(wiring.encoder_index, next == 0);
        }
        if (!backwards) {
            set(wiring.encoder_index, next == 0);
        }
        step(next);
        encoder_at = next;
    }
}

/* --- Bus --- */

static void send(void *context, unsigned buffer, const fdcan_frame_t *frame) {
    (void)context;
    hal_can_frame_t copy = {
        .identifier = frame->identifier, .extended = frame->extended, .remote = frame->remote, .length = frame->length};
    memcpy(copy.data, frame->data, sizeof copy.data);
    (void)can_bus_transmit_from(board->bus, board->bus_drive, buffer, &copy); /* refused in bus-off alone */
}

static bool pending(void *context, unsigned buffer) {
    (void)context;
    return board->bus->drives[board->bus_drive].node.mailbox[buffer].taken;
}

static void cancel(void *context, unsigned buffer) {
    (void)context;
    soc_violation("write of FDCAN1_TXBCR: buffer %u is in arbitration on the bench's bus, which cannot withdraw it",
                  buffer);
}

static void state(void *context, unsigned *tec, unsigned *rec, bool *bus_off) {
    (void)context;
    hal_can_status_t status;
    board_can_status(board, &status);
    *tec = status.transmit_errors;
    *rec = status.receive_errors;
    *bus_off = status.state == HAL_CAN_BUS_OFF;
}

static void rejoin(void *context) {
    (void)context;
    board_can_rejoin(board);
}

static uint32_t bit_rate(void *context) {
    (void)context;
    return board->bus->bit_rate;
}

void bench_io_receive(void) {
    hal_can_frame_t frame;
    while (fdcan_room() && board_can_receive(board, &frame)) {
        fdcan_frame_t copy = {
            .identifier = frame.identifier, .extended = frame.extended, .remote = frame.remote, .length = frame.length};
        memcpy(copy.data, frame.data, sizeof copy.data);
        fdcan_deliver(&copy);
    }
}

static void room(void *context) {
    (void)context;
    bench_io_receive();
}

/* --- Memory, random numbers, second clock --- */

static uint64_t memory_read(void *context, unsigned word, bool *torn) {
    (void)context;
    (void)torn;
    return nvm_read(&board->nvm, word / HAL_NVM_PAGE_WORDS, word % HAL_NVM_PAGE_WORDS);
}

static void memory_program(void *context, unsigned word, uint64_t value) {
    (void)context;
    nvm_program(&board->nvm, word / HAL_NVM_PAGE_WORDS, word % HAL_NVM_PAGE_WORDS, value);
    if (board->nvm.power_lost) {
        flash_tear(word + MEMORY_FIRST_PAGE * HAL_NVM_PAGE_WORDS);
    }
}

static void memory_erase(void *context, unsigned page) {
    (void)context;
    nvm_erase(&board->nvm, page);
}

static uint32_t random_number(void *context) {
    (void)context;
    return board_random(board);
}

static uint64_t second_clock(void *context) {
    (void)context;
    return board_reference_cycles(board);
}

/* --- Gates --- */

/* The gate drivers of the stage suppress pulses and gaps that are too short, as plant/half_bridge.h has it. */
static unsigned without_short_pulses(timer_edge_t edges[TIMER_EDGES_MAX], unsigned count, uint64_t to) {
    uint64_t on = 0;
    for (unsigned i = 0; i < count; ++i) {
        const uint64_t from = edges[i].cycle > soc.now ? edges[i].cycle : soc.now;
        on += edges[i].level ? (i + 1 < count ? edges[i + 1].cycle : to) - from : 0;
    }
    const double shortest = board->plant->minimum_pulse_ns * (double)soc.hclk_hz, off = (double)(to - soc.now - on);
    const bool short_pulse = (double)on * NS_PER_S < shortest, short_gap = off * NS_PER_S < shortest;
    if (count == 1 || !(short_pulse || short_gap)) {
        return count;
    }
    edges[0].level = !short_pulse;
    return 1;
}

/* Edges of one switch; of a pin that is not driven the pull-down resistor keeps the gate off. */
static unsigned edges_of(int pin, uint64_t to, timer_edge_t edges[TIMER_EDGES_MAX]) {
    bool driven = false;
    if (pin < 0) {
        edges[0] = (timer_edge_t){soc.now, false};
        return 1;
    }
    const unsigned count = timer_edges((unsigned)pin, to, edges, &driven);
    if (!driven && gpio_function((unsigned)pin) < 0) {
        edges[0].level = gpio_level((unsigned)pin);
    }
    return without_short_pulses(edges, count, to);
}

/* From the start of the period, to the nearest nanosecond, as the plant's timer has it. */
static uint32_t delay_ns(uint64_t cycles) {
    return (uint32_t)((cycles * UINT64_C(1000000000) + soc.hclk_hz / 2) / soc.hclk_hz);
}

static void pattern_of(half_bridge_pattern_t *pattern, unsigned phase, uint64_t to) {
    timer_edge_t lower[TIMER_EDGES_MAX], upper[TIMER_EDGES_MAX];
    const unsigned lowers = edges_of(wiring.lower[phase], to, lower), uppers = edges_of(wiring.upper[phase], to, upper);
    unsigned l = 1, u = 1;
    uint8_t now = (uint8_t)((lower[0].level ? HALF_BRIDGE_LOWER : 0) | (upper[0].level ? HALF_BRIDGE_UPPER : 0));
    *pattern = (half_bridge_pattern_t){.first = now};
    while (l < lowers || u < uppers) {
        const uint64_t at_l = l < lowers ? lower[l].cycle : SOC_NEVER, at_u = u < uppers ? upper[u].cycle : SOC_NEVER;
        const uint64_t at = at_l < at_u ? at_l : at_u;
        if (at_l == at) {
            now = (uint8_t)((now & ~HALF_BRIDGE_LOWER) | (lower[l++].level ? HALF_BRIDGE_LOWER : 0));
        }
        if (at_u == at) {
            now = (uint8_t)((now & ~HALF_BRIDGE_UPPER) | (upper[u++].level ? HALF_BRIDGE_UPPER : 0));
        }
        if (pattern->count == HALF_BRIDGE_EDGES_MAX) {
            soc_violation("gates of phase %c: more than two edges of a switch in a control period", 'a' + (int)phase);
        }
        pattern->delay_ns[pattern->count] = delay_ns(at - soc.now);
        pattern->switches[pattern->count++] = now;
    }
}

void bench_io_gates(uint64_t to) {
    plant_t *plant = board->plant;
    plant->pattern_ns = plant->time_ns;
    plant->pattern_source.period_ticks = 0; /* no compare values are behind the patterns */
    for (unsigned phase = 0; phase < plant->machine->phases; ++phase) {
        pattern_of(&plant->pattern[phase], phase, to);
        plant->edge_next[phase] = 0;
        plant->switches[phase] = plant->pattern[phase].first;
    }
}

/* --- Start --- */

void bench_io_reset(void) {
    encoder_at = 0;
    step(0);
    set(wiring.encoder_index, false);
    bench_io_lines();
}

void bench_io_open(board_t *of, const wiring_t *pins) {
    board = of;
    wiring = *pins;
    adc_set_input(analogue, NULL);
    fdcan_join(&(fdcan_bus_t){.send = send,
                              .pending = pending,
                              .cancel = cancel,
                              .state = state,
                              .rejoin = rejoin,
                              .bit_rate = bit_rate,
                              .room = room});
    flash_set_store(&(flash_store_t){.read = memory_read, .program = memory_program, .erase = memory_erase},
                    MEMORY_FIRST_PAGE, HAL_NVM_PAGES);
    apart_set_random(random_number, NULL);
    apart_set_lse(second_clock, NULL);
    bench_io_reset();
}
