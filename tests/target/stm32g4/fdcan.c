/* FDCAN1 in internal loop-back: three buffers, filters, a FIFO of three, lost frames, interrupt. */
#include "part.h"

#define CAN 0x40006400u
#define RAM 0x4000A400u
#define FIFO0 (RAM + 0xB0)
#define BUFFER(n) (RAM + 0x278 + 72 * (n))

static volatile unsigned calls;

static void received(void) {
    ++calls;
    REG(CAN + 0x50) = BIT(0);
    (void)REG(CAN + 0x50);
}

static void send(unsigned buffer, uint32_t identifier, uint32_t length, uint32_t word) {
    REG(BUFFER(buffer)) = identifier << 18;
    REG(BUFFER(buffer) + 4) = length << 16;
    REG(BUFFER(buffer) + 8) = word;
    REG(BUFFER(buffer) + 12) = ~word;
    REG(CAN + 0xCC) = BIT(buffer);
    while (!(REG(CAN + 0xD4) & BIT(buffer))) {
    }
}

int test(void) {
    APB1ENR1 |= BIT(25);
    REG(RCC + 0x88) = 2u << 24; /* PCLK1: 16 MHz */
    REG(CAN + 0x18) = 1;
    REG(CAN + 0x18) = 3;
    REG(CAN + 0x18) = 3 | BIT(5) | BIT(7);
    REG(CAN + 0x10) = BIT(4);
    REG(CAN + 0x1C) = 2u << 25 | 0u << 16 | 11u << 8 | 2u;  /* 16 quanta: 1 Mbit/s */
    REG(RAM) = 2u << 30 | 1u << 27 | 0x100u << 16 | 0x700u; /* 0x100 to 0x1FF into FIFO 0 */
    REG(CAN + 0x80) = 1u << 16 | 2u << 4 | 2u << 2;         /* others rejected */
    REG(CAN + 0x54) = BIT(0);
    REG(CAN + 0x5C) = 1;
    vectors[16 + 21] = received;
    NVIC_ENABLE(21);
    REG(CAN + 0x18) = BIT(5) | BIT(7);
    CHECK((REG(CAN + 0xC4) & 0x200007) == 3); /* three free */
    REG(0xE0001000u) = 1;
    const uint32_t from = CYCLES;
    send(0, 0x123, 8, 0x01020304);
    const uint32_t took = CYCLES - from;
    CHECK(took > 111 * 16 && took < 140 * 16); /* 111 bits of 1 us */
    CHECK(calls == 1);
    CHECK((REG(CAN + 0x90) & 0x0303000F) == 0x10001);
    CHECK(REG(FIFO0) == 0x123u << 18 && REG(FIFO0 + 4) == 8u << 16 && REG(FIFO0 + 8) == 0x01020304);
    send(1, 0x223, 2, 7);
    CHECK((REG(CAN + 0x90) & 15) == 1); /* filtered */
    send(2, 0x1FF, 1, 8);
    send(0, 0x100, 1, 9);
    CHECK((REG(CAN + 0x90) & 0x0100000F) == 0x01000003);
    send(0, 0x101, 1, 10);
    CHECK(REG(CAN + 0x50) & BIT(2)); /* lost */
    REG(CAN + 0x94) = 0;
    CHECK((REG(CAN + 0x90) & 15) == 2 && (REG(CAN + 0x90) >> 8 & 3) == 1);
    CHECK(calls == 3);
    /* Bus-off keeps a request, which CCE clears: nothing leaves after the return. */
    REG(BUFFER(0)) = 0x111u << 18;
    REG(CAN + 0xCC) = BIT(0);
    REG(0xE000000Cu) = 1u << 16 | 248;
    CHECK(REG(CAN + 0x44) & BIT(7) && REG(CAN + 0x18) & BIT(0) && REG(CAN + 0xC8) == 1);
    REG(CAN + 0x18) |= 3;
    CHECK(REG(CAN + 0xC8) == 0);
    REG(CAN + 0x18) = BIT(5) | BIT(7);
    wait(16 * 300);
    CHECK(!(REG(CAN + 0x44) & BIT(7)) && (REG(CAN + 0x90) & 15) == 0 && calls == 3);
    /* A queue sends buffers of one identifier in the order of their numbers; the first leaves at once. */
    REG(CAN + 0x18) |= 1;
    REG(CAN + 0x18) |= 3;
    REG(CAN + 0xC0) = BIT(24);
    REG(CAN + 0x18) = BIT(5) | BIT(7);
    for (unsigned buffer = 3; buffer-- > 0;) {
        REG(BUFFER(buffer)) = 0x123u << 18;
        REG(BUFFER(buffer) + 4) = 4u << 16;
        REG(BUFFER(buffer) + 8) = buffer;
        REG(CAN + 0xCC) = BIT(buffer);
    }
    CHECK(REG(CAN + 0xC4) == BIT(21)); /* full */
    wait(16 * 300);
    CHECK(REG(CAN + 0xC4) == 0 && REG(FIFO0 + 8) == 2 && REG(FIFO0 + 72 + 8) == 0 && REG(FIFO0 + 144 + 8) == 1);
    return 0;
}
