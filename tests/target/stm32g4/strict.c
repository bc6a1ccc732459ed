/* One breach of a rule, which ends the run; CASE numbers them as the test does. */
#include "part.h"

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
#endif
    return 0;
}
