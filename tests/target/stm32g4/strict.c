/* One breach of a rule, which ends the run; CASE numbers them as the test does. */
#include "part.h"

#if CASE == 26
static void clears_at_its_end(void) {
    REG(TIM2 + 0x10) = 0;
}
#endif

int test(void) {
#if CASE == 0
    CR1(TIM1) = 1; /* without clock */
#elif CASE == 1
    APB2ENR |= BIT(11);
    CR1(TIM1) = BIT(10); /* reserved */
#elif CASE == 2
    APB2ENR |= BIT(11);
    *(volatile uint16_t *)TIM1 = 1; /* half a word */
#elif CASE == 3
    REG(0x40013800u) = 1; /* USART1 */
#elif CASE == 4
    APB1ENR1 |= BIT(31);
    REG(0x40007C1Cu) = 1; /* LPTIM1_CNT */
#elif CASE == 5
    APB1ENR1 |= BIT(28);
    REG(0x40007080u) = 0; /* PWR_CR5: boost */
    REG(RCC + 0x0C) = 2u | 3u << 4 | 85u << 8 | BIT(24);
    REG(RCC) |= BIT(24);
    while (!(REG(RCC) & BIT(25))) {
    }
    REG(RCC + 0x08) = 8u << 4 | 3; /* 85 MHz without wait states */
#elif CASE == 6
    REG(RCC + 0x0C) = 2u | 3u << 4 | 100u << 8 | BIT(24);
    REG(RCC) |= BIT(24); /* VCO 400 MHz */
#elif CASE == 7
    AHB2ENR |= BIT(13);
    REG(0x50000308u) = 1u << 16;
    REG(0x50000008u) = 0;
    REG(0x50000008u) = BIT(28);
    REG(0x50000008u) |= BIT(31); /* the regulator has not started */
#elif CASE == 8
    __asm__ volatile("udf #0");
#elif CASE == 9
    REG(0x90000000u) = 1;
#elif CASE == 10
    __asm__ volatile(".short 0xEE30, 0x0A00"); /* VADD.F32 */
#elif CASE == 11
    APB2ENR |= BIT(11);
    BDTR(TIM1) = BIT(8) | BIT(12);
    BDTR(TIM1) = BIT(8) | BIT(12) | 5; /* dead time, locked */
#elif CASE == 12
    REG(0x40022014u) |= 1; /* FLASH_CR, locked */
#elif CASE == 13
    APB1ENR1 |= BIT(28);
    REG(RCC + 0x90) = 1; /* LSEON without DBP */
#elif CASE == 14
    *(volatile uint8_t *)0xE000E400u = 0x41; /* four bits of priority */
#elif CASE == 15
    APB2ENR |= BIT(0);
    AHB2ENR |= BIT(0);
    REG(0x40010204u) = BIT(31);
    REG(0x40010204u) = BIT(31) | 1; /* COMP2 is locked */
#elif CASE == 16
    REG(0x40022008u) = 0x45670123;
    REG(0x40022008u) = 0x45670123; /* FLASH_KEYR: the first key again */
#elif CASE == 17
    REG(0x40022008u) = 0x45670123;
    REG(0x40022008u) = 0xCDEF89AB;
    REG(0x40022000u) &= ~BIT(10);
    REG(0x40022014u) = 1;
    REG(0x08040000u) = 1;
    REG(0x08040004u) = 2;
    while (REG(0x40022010u) & BIT(16)) {
    }
    REG(0x40022000u) |= BIT(10);
    (void)REG(0x08040000u); /* from the data cache */
#elif CASE == 18
    REG(0x40022000u) |= BIT(12); /* DCRST with DCEN */
#elif CASE == 19
    AHB2ENR |= BIT(26);
    REG(0x50060800u) = 4; /* RNG without its clock */
#elif CASE == 20
    REG(RCC + 0x98) = 1;
    wait(1000);
    AHB2ENR |= BIT(26);
    REG(0x50060800u) = 4;
    (void)REG(0x50060808u); /* before DRDY */
#elif CASE == 21
    APB1ENR1 |= BIT(28);
    REG(0x40022000u) = (REG(0x40022000u) & ~15u) | 4;
    REG(RCC + 0x0C) = 2u | 3u << 4 | 50u << 8 | BIT(24); /* 100 MHz */
    REG(RCC) |= BIT(24);
    while (!(REG(RCC) & BIT(25))) {
    }
    REG(RCC + 0x08) = 3; /* at once */
#elif CASE == 22
    AHB2ENR |= BIT(2);
    AFR(C, 0) = 0;
    MODER(C) = (MODER(C) & ~3u) | 2; /* PC0 has no function 0 */
#elif CASE == 23
    AHB2ENR |= BIT(13);
    REG(0x5000004Cu) = 8u << 2 | 2u << 7; /* JSQR: falling edge of TRGO2 */
#elif CASE == 24
    REG(0x40022008u) = 0x45670123;
    REG(0x40022008u) = 0xCDEF89AB;
    REG(0x40022014u) = BIT(1) | BIT(11);
    REG(0x40022014u) |= BIT(16); /* an erasure with the data cache */
#elif CASE == 25
    APB1ENR1 |= BIT(28);
    REG(0x40007000u) |= BIT(8);
    REG(RCC + 0x90) = 1; /* LSEON before DBP was read */
#elif CASE == 26
    vectors[16 + 28] = clears_at_its_end;
    APB1ENR1 |= BIT(0);
    REG(0xE000E100u) = BIT(28);
    REG(TIM2 + 0x0C) = 1;
    REG(TIM2 + 0x14) = 1; /* UG: update interrupt */
    barrier();
#elif CASE == 27
    REG(RCC + 0x0C) = 2u | 3u << 4 | 85u << 8 | BIT(24); /* output R of 170 MHz */
    REG(RCC) |= BIT(24);
#elif CASE == 28
    APB1ENR1 |= BIT(28);
    REG(0x40007080u) = 0;
    REG(RCC + 0x0C) = 2u | 3u << 4 | 85u << 8 | BIT(24);
    REG(RCC) |= BIT(24);
    REG(0x40007080u) = BIT(8); /* the end of boost, under a running PLL */
#endif
    return 0;
}
