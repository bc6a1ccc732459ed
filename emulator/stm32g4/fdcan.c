/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * FDCAN1 (RM0440, 44): classic frames, message RAM, filters, receive FIFOs of three, three transmit buffers as FIFO or
 * queue, bit timing against the kernel's clock, bus-off by INIT. Without a bus, loop-back of the test mode alone.
 */
#include <string.h>

#include "stm32g4/nvic.h"
#include "stm32g4/part_pins.h"
#include "stm32g4/peripherals.h"

#define FDCAN 0x40006400u
#define RAM 0x4000A400u
#define TEST (FDCAN + 0x10)
#define CCCR (FDCAN + 0x18)
#define NBTP (FDCAN + 0x1C)
#define ECR (FDCAN + 0x40)
#define PSR (FDCAN + 0x44)
#define IR (FDCAN + 0x50)
#define IE (FDCAN + 0x54)
#define ILS (FDCAN + 0x58)
#define ILE (FDCAN + 0x5C)
#define RXGFC (FDCAN + 0x80)
#define XIDAM (FDCAN + 0x84)
#define RXF0S (FDCAN + 0x90)
#define RXF0A (FDCAN + 0x94)
#define RXF1S (FDCAN + 0x98)
#define RXF1A (FDCAN + 0x9C)
#define TXBC (FDCAN + 0xC0)
#define TXFQS (FDCAN + 0xC4)
#define TXBRP (FDCAN + 0xC8)
#define TXBAR (FDCAN + 0xCC)
#define TXBCR (FDCAN + 0xD0)
#define TXBTO (FDCAN + 0xD4)
#define TXBCF (FDCAN + 0xD8)
#define TXBTIE (FDCAN + 0xDC)
#define CKDIV (FDCAN + 0x100)

#define CCCR_INIT 0x01u
#define CCCR_CCE 0x02u
#define CCCR_MON 0x20u
#define CCCR_TEST 0x80u
#define CCCR_FDOE 0x100u
#define CCCR_CSR 0x10u
#define TEST_LBCK 0x10u
#define IR_RF0N 0x01u
#define IR_RF0F 0x02u
#define IR_RF0L 0x04u
#define IR_TC 0x80u
#define IR_TFE 0x200u
#define IR_EP 0x20000u
#define IR_EW 0x40000u
#define IR_BO 0x80000u
#define BUFFERS 3u
#define FIFO_ELEMENTS 3u
#define ELEMENT_BYTES 72u
#define FIFO(n) (0xB0u + (n)*FIFO_ELEMENTS * ELEMENT_BYTES)
#define TRANSMIT_BUFFERS 0x278u
#define TOLERANCE_PERMILLE 5u
#define LINE_0 (16u + 21u)
#define LINE_1 (16u + 22u)

static struct {
    fdcan_bus_t bus;
    bool joined;
    uint8_t order[BUFFERS]; /* requested buffers, oldest first */
    unsigned requested;
    bool sent[BUFFERS]; /* given to the bus */
    bool leaving;       /* in loop-back a frame is being sent */
    uint8_t buffer;     /* it */
    unsigned get[2], level[2];
    unsigned tec, rec; /* alone: as a program's bench has set them */
    bool off, was_off;
    bool was_warned, was_passive;
} can;

void fdcan_join(const fdcan_bus_t *bus) {
    can.bus = *bus;
    can.joined = true;
}

static bool loops_back(void) {
    return REG(CCCR) & CCCR_TEST && REG(TEST) & TEST_LBCK;
}

static void lines(void) {
    static const uint32_t groups[7] = {0x07, 0x38, 0x1C0, 0x1E00, 0xE000, 0x30000, 0xFC0000};
    const uint32_t active = REG(IR) & REG(IE);
    uint32_t second = 0;
    for (unsigned i = 0; i < 7; ++i) {
        second |= REG(ILS) >> i & 1 ? groups[i] : 0;
    }
    nvic_line(LINE_0, active & ~second && REG(ILE) & 1);
    nvic_line(LINE_1, active & second && REG(ILE) & 2);
}

static void flag(uint32_t flags) {
    REG(IR) |= flags;
    lines();
}

/* --- Bit timing --- */

static uint32_t kernel_hz(void) {
    const uint32_t divider = REG(CKDIV) & 15;
    return rcc_fdcan_hz() / (divider ? 2 * divider : 1);
}

static uint32_t bit_rate(void) {
    const uint32_t nbtp = REG(NBTP);
    const uint32_t quanta = 1 + (nbtp >> 8 & 255) + 1 + (nbtp & 127) + 1;
    return kernel_hz() / ((nbtp >> 16 & 511) + 1) / quanta;
}

static void check_timing(void) {
    const uint32_t nbtp = REG(NBTP), segment_2 = (nbtp & 127) + 1, jump = (nbtp >> 25) + 1;
    if (kernel_hz() == 0) {
        soc_violation("FDCAN1_CCCR.INIT = 0: the kernel's clock does not run (RCC_CCIPR.FDCANSEL)");
    }
    if (jump > segment_2) {
        soc_violation("FDCAN1_NBTP = 0x%08X: the jump width is above segment 2", nbtp);
    }
    if (can.joined && !loops_back()) {
        if (!pins_lead("FDCAN1", "RX") || !pins_lead("FDCAN1", "TX")) {
            soc_violation("FDCAN1_CCCR.INIT = 0: no pin has its function RX, or TX");
        }
        const uint32_t bus = can.bus.bit_rate(can.bus.context), own = bit_rate();
        const uint32_t difference = own > bus ? own - bus : bus - own;
        if ((uint64_t)difference * 1000 > (uint64_t)bus * TOLERANCE_PERMILLE) {
            soc_violation("FDCAN1_NBTP = 0x%08X: %u bit/s from %u Hz, the bus has %u bit/s", nbtp, own, kernel_hz(),
                          bus);
        }
    }
}

/* --- Receiving --- */

bool fdcan_deliver(const fdcan_frame_t *frame) {
    if (REG(CCCR) & CCCR_INIT) {
        return false;
    }
    const int fifo = fdcan_destination(frame);
    if (fifo < 0) {
        return true;
    }
    const uint32_t status = fifo ? RXF1S : RXF0S, shift = fifo ? 3 : 0;
    if (can.level[fifo] == FIFO_ELEMENTS) {
        REG(status) |= 1u << 25;
        flag(IR_RF0L << shift);
        return true;
    }
    const unsigned put = (can.get[fifo] + can.level[fifo]) % FIFO_ELEMENTS;
    const uint32_t at = RAM + FIFO((unsigned)fifo) + put * ELEMENT_BYTES;
    REG(at) =
        (frame->extended ? 1u << 30 | frame->identifier : frame->identifier << 18) | (frame->remote ? 1u << 29 : 0);
    REG(at + 4) = (uint32_t)frame->length << 16;
    uint32_t word[2];
    memcpy(word, frame->data, sizeof word);
    REG(at + 8) = word[0];
    REG(at + 12) = word[1];
    ++can.level[fifo];
    flag((can.level[fifo] == FIFO_ELEMENTS ? IR_RF0N | IR_RF0F : IR_RF0N) << shift);
    return true;
}

bool fdcan_room(void) {
    return can.level[0] < FIFO_ELEMENTS && can.level[1] < FIFO_ELEMENTS;
}

static uint32_t fifo_status(unsigned fifo) {
    const unsigned put = (can.get[fifo] + can.level[fifo]) % FIFO_ELEMENTS;
    return can.level[fifo] | can.get[fifo] << 8 | put << 16 | (can.level[fifo] == FIFO_ELEMENTS ? 1u << 24 : 0) |
           (REG(IR) & (fifo ? IR_RF0L << 3 : IR_RF0L) ? 1u << 25 : 0);
}

static void acknowledge(unsigned fifo, uint32_t index) {
    if (index >= FIFO_ELEMENTS) {
        soc_violation("write of FDCAN1_RXF%uA, value %u: an element above 2", fifo, index);
    }
    while (can.level[fifo] > 0) { /* up to and including the index */
        const unsigned freed = can.get[fifo];
        can.get[fifo] = (freed + 1) % FIFO_ELEMENTS;
        --can.level[fifo];
        if (freed == index) {
            break;
        }
    }
    if (can.joined) {
        can.bus.room(can.bus.context);
    }
}

/* --- Transmission --- */

static fdcan_frame_t frame_of(unsigned buffer) {
    const uint32_t at = RAM + TRANSMIT_BUFFERS + buffer * ELEMENT_BYTES, t0 = REG(at), t1 = REG(at + 4);
    if (t1 & 1u << 21 && REG(CCCR) & CCCR_FDOE) {
        soc_violation("transmit buffer %u: FDF, only classic frames are modelled", buffer);
    }
    fdcan_frame_t frame = {.extended = t0 >> 30 & 1, .remote = t0 >> 29 & 1, .length = (uint8_t)(t1 >> 16 & 15)};
    frame.identifier = frame.extended ? t0 & 0x1FFFFFFF : t0 >> 18 & 0x7FF;
    const uint32_t word[2] = {REG(at + 8), REG(at + 12)};
    memcpy(frame.data, word, sizeof word);
    return frame;
}

static void left(unsigned buffer) {
    REG(TXBRP) &= ~(1u << buffer);
    REG(TXBTO) |= 1u << buffer;
    can.sent[buffer] = false;
    can.leaving = can.leaving && can.buffer != buffer;
    unsigned kept = 0;
    for (unsigned i = 0; i < can.requested; ++i) {
        if (can.order[i] != buffer) {
            can.order[kept++] = can.order[i];
        }
    }
    can.requested = kept;
    flag((REG(TXBTIE) >> buffer & 1 ? IR_TC : 0) | (can.requested == 0 ? IR_TFE : 0));
}

/* Bits of a frame without stuffing, and the pause after it. */
static uint64_t frame_cycles(const fdcan_frame_t *frame) {
    const unsigned bytes = frame->remote ? 0 : frame->length > 8 ? 8 : frame->length;
    return (uint64_t)(47u + (frame->extended ? 20u : 0u) + 8u * bytes) * soc.hclk_hz / bit_rate();
}

/* Order of arbitration: smaller wins. A standard identifier wins against an extended one that begins with it. */
static uint32_t arbitration(unsigned buffer) {
    const fdcan_frame_t frame = frame_of(buffer);
    return frame.extended ? (frame.identifier >> 18) << 20 | 1u << 19 | (frame.identifier & 0x3FFFF)
                          : frame.identifier << 20 | (uint32_t)frame.remote;
}

/* The next of the requested buffers: of a queue the one that wins, by its number among equals, of a FIFO the oldest. */
static uint8_t next_buffer(void) {
    uint8_t next = can.order[0];
    for (unsigned i = 1; REG(TXBC) >> 24 & 1 && i < can.requested; ++i) {
        const uint32_t field = arbitration(can.order[i]), best = arbitration(next);
        next = field < best || (field == best && can.order[i] < next) ? can.order[i] : next;
    }
    return next;
}

/* Gives requested frames to the bus: of a queue all, of a FIFO the oldest alone. */
static void offer(void) {
    const bool queue = REG(TXBC) >> 24 & 1;
    if (REG(CCCR) & CCCR_INIT || can.requested == 0) {
        return;
    }
    if (!can.joined || loops_back()) {
        if (!can.leaving) {
            can.leaving = true;
            can.buffer = next_buffer();
            const fdcan_frame_t frame = frame_of(can.buffer);
            soc_schedule(EVENT_FDCAN, soc.now + frame_cycles(&frame));
        }
        return;
    }
    for (unsigned i = 0; i < (queue ? can.requested : 1); ++i) {
        const unsigned buffer = can.order[i];
        if (!can.sent[buffer]) {
            const fdcan_frame_t frame = frame_of(buffer);
            can.sent[buffer] = true;
            can.bus.send(can.bus.context, buffer, &frame);
        }
    }
}

void fdcan_event(void) {
    if (can.requested == 0 || REG(CCCR) & CCCR_INIT) {
        return;
    }
    if (!loops_back()) {
        return; /* no node acknowledges */
    }
    const unsigned buffer = can.buffer;
    const fdcan_frame_t frame = frame_of(buffer);
    left(buffer);
    fdcan_deliver(&frame);
    offer();
}

static void error_state(void) {
    unsigned tec = can.tec, rec = can.rec;
    bool off = can.off;
    if (can.joined) {
        can.bus.state(can.bus.context, &tec, &rec, &off);
    }
    const bool warned = tec >= 96 || rec >= 96, passive = tec > 127 || rec > 127;
    uint32_t flags = 0;
    flags |= warned != can.was_warned ? IR_EW : 0;
    flags |= passive != can.was_passive ? IR_EP : 0;
    flags |= off != can.was_off ? IR_BO : 0;
    if (off && !can.was_off) {
        if (can.joined) {
            can.bus.room(can.bus.context); /* what ended before on the bus has been received */
        }
        REG(CCCR) |= CCCR_INIT; /* the requests stay: they are sent after the return, unless CCE clears them */
        memset(can.sent, 0, sizeof can.sent);
        can.leaving = false;
    }
    can.was_warned = warned;
    can.was_passive = passive;
    can.was_off = off;
    REG(ECR) = (tec > 255 ? 255 : tec) | (rec > 127 ? 127 : rec) << 8 | (rec > 127 ? 1u << 15 : 0);
    REG(PSR) = (uint32_t)off << 7 | (uint32_t)warned << 6 | (uint32_t)passive << 5 | 0x707u;
    if (flags) {
        flag(flags);
    }
}

void fdcan_refresh(void) {
    error_state();
    for (unsigned buffer = 0; can.joined && buffer < BUFFERS; ++buffer) {
        if (can.sent[buffer] && !can.bus.pending(can.bus.context, buffer)) {
            left(buffer);
        }
    }
    offer();
}

void fdcan_set_errors(unsigned tec, unsigned rec, bool off) {
    can.tec = tec;
    can.rec = rec;
    can.off = off;
    fdcan_refresh();
}

static void request(uint32_t buffers) {
    if (REG(CCCR) & CCCR_INIT) {
        soc_violation("write of FDCAN1_TXBAR, value 0x%X: FDCAN1_CCCR.INIT is set", buffers);
    }
    for (unsigned buffer = 0; buffer < BUFFERS; ++buffer) {
        if (!(buffers >> buffer & 1)) {
            continue;
        }
        if (REG(TXBRP) >> buffer & 1) {
            soc_violation("write of FDCAN1_TXBAR, value 0x%X: buffer %u is pending", buffers, buffer);
        }
        REG(TXBRP) |= 1u << buffer;
        REG(TXBTO) &= ~(1u << buffer);
        REG(TXBCF) &= ~(1u << buffer);
        can.order[can.requested++] = (uint8_t)buffer;
    }
    offer();
}

static void cancel(uint32_t buffers) {
    for (unsigned buffer = 0; buffer < BUFFERS; ++buffer) {
        if (buffers >> buffer & REG(TXBRP) >> buffer & 1) {
            if (can.sent[buffer]) {
                can.bus.cancel(can.bus.context, buffer);
            }
            left(buffer);
            REG(TXBTO) &= ~(1u << buffer);
            REG(TXBCF) |= 1u << buffer;
        }
    }
}

static uint32_t queue_status(void) {
    unsigned put = BUFFERS, free = 0;
    for (unsigned i = BUFFERS; i-- > 0;) {
        if (!(REG(TXBRP) >> i & 1)) {
            put = i;
            ++free;
        }
    }
    const bool queue = REG(TXBC) >> 24 & 1;
    return (free == 0 ? 1u << 21 : (uint32_t)put << 16) |
           (queue ? 0 : free | (can.requested ? (uint32_t)can.order[0] << 8 : 0));
}

static uint32_t fdcan_read(uint32_t address) {
    switch (address) {
    case RXF0S:
        return fifo_status(0);
    case RXF1S:
        return fifo_status(1);
    case TXFQS:
    case TXBRP:
    case TXBTO:
    case ECR:
    case PSR:
    case CCCR:
        fdcan_refresh();
        return address == TXFQS ? queue_status() : REG(address);
    default:
        return REG(address);
    }
}

/* States of FIFOs and buffers, by a reset and by the start of CCE. */
static void empty(void) {
    can.requested = 0;
    can.leaving = false;
    can.get[0] = can.get[1] = can.level[0] = can.level[1] = 0;
}

static void mode_write(uint32_t value) {
    const uint32_t old = REG(CCCR);
    if (value & ~(CCCR_INIT | CCCR_CCE | CCCR_MON | CCCR_TEST | CCCR_CSR | 0x1040u)) {
        soc_violation("write of FDCAN1_CCCR, value 0x%X: only classic frames are modelled", value);
    }
    const uint32_t protected_bits = CCCR_MON | CCCR_TEST | 0x1040u;
    if ((old ^ value) & protected_bits & value && !(old & CCCR_CCE && old & CCCR_INIT)) {
        soc_violation("write of FDCAN1_CCCR, value 0x%X: needs INIT and CCE", value);
    }
    if (value & CCCR_CCE && !(old & CCCR_INIT)) {
        soc_violation("write of FDCAN1_CCCR, value 0x%X: CCE is set with INIT = 1 alone", value);
    }
    REG(CCCR) = value & CCCR_INIT ? value : value & ~CCCR_CCE;
    if (value & CCCR_CCE && !(old & CCCR_CCE)) {
        empty();
        REG(TXBRP) = REG(TXBTO) = REG(TXBCF) = 0;
    }
    if (old & CCCR_INIT && !(value & CCCR_INIT)) {
        check_timing();
        if (can.joined) {
            can.bus.rejoin(can.bus.context);
        } else if (can.off) {
            can.off = false;
            can.tec = can.rec = 0;
        }
        fdcan_refresh();
    }
}

static void check_change(uint32_t address, uint32_t value) {
    if ((REG(CCCR) & (CCCR_INIT | CCCR_CCE)) != (CCCR_INIT | CCCR_CCE)) {
        soc_violation("write of %s, value 0x%X: needs FDCAN1_CCCR.INIT and CCE", soc_name(address), value);
    }
}

static void fdcan_write(uint32_t address, uint32_t value) {
    switch (address) {
    case CCCR:
        mode_write(value);
        return;
    case IR:
        REG(IR) &= ~value;
        lines();
        return;
    case RXF0A:
        acknowledge(0, value);
        return;
    case RXF1A:
        acknowledge(1, value);
        return;
    case TXBAR:
        request(value);
        return;
    case TXBCR:
        cancel(value);
        return;
    case NBTP:
    case RXGFC:
    case XIDAM:
    case TXBC:
    case CKDIV:
        check_change(address, value);
        break;
    case TEST:
        if (!(REG(CCCR) & CCCR_TEST)) {
            soc_violation("write of FDCAN1_TEST, value 0x%X: needs FDCAN1_CCCR.TEST", value);
        }
        break;
    case IE:
    case ILS:
    case ILE:
    case TXBTIE:
        break;
    default:
        soc_violation("write of %s, value 0x%X: not modelled", soc_name(address), value);
    }
    REG(address) = value;
    lines();
}

void fdcan_attach(void) {
    soc_attach(FDCAN, 0x400, 0x40021058u, 25, fdcan_read, fdcan_write);
    soc_attach(RAM, 0x350, 0x40021058u, 25, NULL, NULL);
    for (uint32_t at = 0; at < 0x350; at += 4) {
        REG(RAM + at) = 0x5A5A5A5A; /* undefined after power-on */
    }
}

void fdcan_reset(void) {
    memset(can.sent, 0, sizeof can.sent);
    can.off = can.was_off = can.was_warned = can.was_passive = false;
    can.tec = can.rec = 0;
    empty();
    lines();
}
