/* Order of exceptions: priorities, numbers, late arrival, tail-chaining, PendSV, masks, levels. */
#include "part.h"

static volatile unsigned order[16], count;
static volatile unsigned levels;

static void note(unsigned n) {
    order[count++] = n;
}

static void low(void) {
    note(1);
    NVIC_PEND(7); /* of higher priority: pre-empts here */
    note(2);
}
static void high(void) {
    note(3);
    ICSR = BIT(28); /* PendSV, lowest */
    NVIC_PEND(8);   /* of equal priority: afterwards */
    note(4);
}
static void equal(void) {
    note(5);
}
static void pendsv(void) {
    note(6);
}
static void update(void) {
    if (++levels == 3) {
        SR(TIM6) = 0; /* a level: pends until the flag is cleared */
        (void)SR(TIM6);
    }
}

int test(void) {
    vectors[16 + 6] = low;
    vectors[16 + 7] = high;
    vectors[16 + 8] = equal;
    vectors[14] = pendsv;
    vectors[16 + 54] = update;
    NVIC_PRIORITY(6) = 0x40;
    NVIC_PRIORITY(7) = 0x20;
    NVIC_PRIORITY(8) = 0x20;
    *(volatile uint8_t *)0xE000ED22u = 0xF0;
    NVIC_ENABLE(6);
    NVIC_ENABLE(7);
    NVIC_ENABLE(8);
    NVIC_PEND(6);
    static const unsigned expected[] = {1, 3, 4, 5, 2, 6};
    CHECK(count == 6);
    for (unsigned i = 0; i < 6; ++i) {
        CHECK(order[i] == expected[i]);
    }
    /* BASEPRI holds 6 back, not 7. */
    count = 0;
    __asm__ volatile("msr basepri, %0" ::"r"(0x30u));
    NVIC_PEND(6);
    NVIC_PEND(7);
    CHECK(count == 3 && order[0] == 3 && order[2] == 5);
    __asm__ volatile("msr basepri, %0" ::"r"(0u));
    CHECK(count >= 6);
    /* PRIMASK holds all back, and WFI wakes in spite of it. */
    count = 0;
    __asm__ volatile("cpsid i");
    NVIC_PEND(8);
    __asm__ volatile("wfi");
    CHECK(count == 0);
    __asm__ volatile("cpsie i" ::: "memory");
    CHECK(count == 1);
    APB1ENR1 |= BIT(4);
    ARR(TIM6) = 99;
    EGR(TIM6) = 1;
    SR(TIM6) = 0;
    DIER(TIM6) = 1;
    NVIC_ENABLE(54);
    CR1(TIM6) = BIT(0) | BIT(3);
    __asm__ volatile("wfi");
    CHECK(levels == 3);
    return 0;
}
