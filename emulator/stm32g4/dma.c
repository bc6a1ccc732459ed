/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * DMA1, DMA2 and DMAMUX (RM0440, 12 and 13): one transfer for each request of a peripheral, in no time. Memory to
 * memory, request generators and synchronisation are not modelled.
 */
#include <stddef.h>

#include "stm32g4/cpu.h"
#include "stm32g4/nvic.h"
#include "stm32g4/peripherals.h"

#define DMA1 0x40020000u
#define DMA2 0x40020400u
#define DMAMUX 0x40020800u
#define ISR 0x00u
#define IFCR 0x04u
#define CHANNELS 8u /* of each controller */
#define CHANNEL(n) (0x08u + 20u * (n))
#define CCR 0x00u
#define CNDTR 0x04u
#define CPAR 0x08u
#define CMAR 0x0Cu

#define CCR_EN 0x0001u
#define CCR_DIR 0x0010u
#define CCR_CIRC 0x0020u
#define CCR_PINC 0x0040u
#define CCR_MINC 0x0080u
#define CCR_MEM2MEM 0x4000u
#define FLAG_GIF 1u
#define FLAG_TCIF 2u
#define FLAG_HTIF 4u

static uint32_t reload[2 * CHANNELS], done[2 * CHANNELS];

static uint32_t controller(unsigned channel) {
    return channel < CHANNELS ? DMA1 : DMA2;
}

static void line(unsigned channel) {
    static const uint8_t irq[2 * CHANNELS] = {11, 12, 13, 14, 15, 16, 17, 96, 56, 57, 58, 59, 60, 97, 98, 99};
    const uint32_t base = controller(channel), flags = REG(base + ISR) >> 4 * (channel % CHANNELS) & 14;
    nvic_line(16u + irq[channel], flags & REG(base + CHANNEL(channel % CHANNELS) + CCR));
}

static uint32_t load(uint32_t address, unsigned size) {
    return address >= 0x40000000u && address < 0x60000000u ? soc_read(address, size) : cpu_memory_read(address, size);
}

static void store(uint32_t address, uint32_t value, unsigned size) {
    if (address >= 0x40000000u && address < 0x60000000u) {
        soc_write(address & ~3u, value, 4); /* the bus widens a narrow access */
    } else {
        cpu_memory_write(address, value, size);
    }
}

static void transfer(unsigned channel) {
    const uint32_t base = controller(channel), at = base + CHANNEL(channel % CHANNELS), ccr = REG(at + CCR);
    const unsigned peripheral_size = 1u << (ccr >> 8 & 3), memory_size = 1u << (ccr >> 10 & 3);
    const uint32_t peripheral = REG(at + CPAR) + (ccr & CCR_PINC ? done[channel] * peripheral_size : 0);
    const uint32_t memory = REG(at + CMAR) + (ccr & CCR_MINC ? done[channel] * memory_size : 0);
    if (ccr & CCR_DIR) {
        const uint32_t value = load(memory, memory_size);
        store(peripheral, memory_size < 4 ? value & ((1u << 8 * memory_size) - 1) : value, peripheral_size);
    } else {
        store(memory, load(peripheral, 4), memory_size);
    }
    ++done[channel];
    const uint32_t left = --REG(at + CNDTR);
    uint32_t flags = left == reload[channel] / 2 ? FLAG_HTIF | FLAG_GIF : 0;
    if (left == 0) {
        flags |= FLAG_TCIF | FLAG_GIF;
        done[channel] = 0;
        REG(at + CNDTR) = ccr & CCR_CIRC ? reload[channel] : 0;
    }
    REG(base + ISR) |= flags << 4 * (channel % CHANNELS);
    line(channel);
}

void dma_request(unsigned request) {
    for (unsigned channel = 0; request && channel < 2 * CHANNELS; ++channel) {
        const uint32_t at = controller(channel) + CHANNEL(channel % CHANNELS);
        if ((REG(DMAMUX + 4 * channel) & 0x7F) == request && REG(at + CCR) & CCR_EN && REG(at + CNDTR)) {
            transfer(channel);
        }
    }
}

static void channel_write(uint32_t base, unsigned number, uint32_t offset, uint32_t value) {
    const uint32_t at = base + CHANNEL(number);
    const unsigned channel = number + (base == DMA2 ? CHANNELS : 0);
    if (offset != CCR) {
        if (REG(at + CCR) & CCR_EN) {
            soc_violation("write of %s, value 0x%X: the channel is enabled", soc_name(at + offset), value);
        }
    } else {
        if (value & CCR_MEM2MEM) {
            soc_violation("write of %s, value 0x%X: memory to memory is not modelled", soc_name(at), value);
        }
        if (value & CCR_EN && !(REG(at + CCR) & CCR_EN)) {
            reload[channel] = REG(at + CNDTR);
            done[channel] = 0;
        }
    }
    REG(at + offset) = value;
    line(channel);
}

static void dma_write(uint32_t address, uint32_t value) {
    const uint32_t base = address & ~0x3FFu, offset = address - base;
    if (offset == IFCR) {
        for (unsigned channel = 0; channel < CHANNELS; ++channel) {
            const uint32_t clear = value >> 4 * channel & 15;
            REG(base + ISR) &= ~((clear & FLAG_GIF ? 15u : clear) << 4 * channel);
            line(channel + (base == DMA2 ? CHANNELS : 0));
        }
    } else {
        channel_write(base, (offset - 8) / 20, (offset - 8) % 20, value);
    }
}

static void mux_write(uint32_t address, uint32_t value) {
    if (address >= DMAMUX + 0x40 || value & ~0x7Fu) {
        soc_violation("write of %s, value 0x%X: synchronisation and generators are not modelled", soc_name(address),
                      value);
    }
    REG(address) = value;
}

void dma_attach(void) {
    soc_attach(DMA1, 0x400, 0x40021048u, 0, NULL, dma_write);
    soc_attach(DMA2, 0x400, 0x40021048u, 1, NULL, dma_write);
    soc_attach(DMAMUX, 0x400, 0x40021048u, 2, NULL, mux_write);
}

void dma_reset(void) {
    for (unsigned channel = 0; channel < 2 * CHANNELS; ++channel) {
        line(channel);
    }
}
