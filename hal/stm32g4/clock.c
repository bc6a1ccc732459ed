/* Clock tree: the crystal of 24 MHz and the PLL for everything, HSI48 for the random number generator, LSE for the
 * second clock. CAN requires the crystal: HSI16 may be off by 1 %, its bit timing allows 0.8 %. */
#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#if BOARD_CLOCK_MHZ == 170
#define PLL_N 85
#define WAIT_STATES 4 /* above 136 MHz in boost mode */
#elif BOARD_CLOCK_MHZ == 100
#define PLL_N 50
#define WAIT_STATES 3 /* above 90 MHz in range 1 */
#else
#error "BOARD_CLOCK_MHZ must be 170 or 100"
#endif
#define PLL_M 6   /* 24 MHz / 6 = 4 MHz, within 2.66 to 16 MHz */
#define PLL_R 2   /* the VCO is at 340 or 200 MHz, within 96 to 344 MHz */
#define HPRE_2 8u /* code of AHB clock / 2 */
#define SOURCE_HSE 3u
#define SOURCE_PLL 3u
#define FDCAN_PCLK 2u
#define LPTIM_LSE 3u
#define CLK48_HSI48 0u
#define ACCESS_TURNS 100u /* without access LSE does not start, which the self-test tells */

void board_wait_us(uint32_t time_us, uint32_t clock_mhz) {
    /* Three cycles or more per turn. */
    for (uint32_t turns = time_us * clock_mhz / 3u + 1u; turns > 0; turns--) {
        __asm__ volatile("" ::: "memory");
    }
}

static void peripherals_clock(void) {
    RCC_AHB1ENR |= RCC_AHB1ENR_DMA1EN | RCC_AHB1ENR_DMAMUX1EN | RCC_AHB1ENR_FLASHEN;
    RCC_AHB2ENR |= RCC_AHB2ENR_GPIOAEN | RCC_AHB2ENR_GPIOBEN | RCC_AHB2ENR_GPIOCEN | RCC_AHB2ENR_ADC12EN |
                   RCC_AHB2ENR_ADC345EN | RCC_AHB2ENR_DAC3EN | RCC_AHB2ENR_DAC4EN | RCC_AHB2ENR_RNGEN;
    RCC_APB1ENR1 |= RCC_APB1ENR1_TIM2EN | RCC_APB1ENR1_TIM3EN | RCC_APB1ENR1_TIM4EN | RCC_APB1ENR1_TIM5EN |
                    RCC_APB1ENR1_RTCAPBEN | RCC_APB1ENR1_FDCANEN | RCC_APB1ENR1_PWREN | RCC_APB1ENR1_LPTIM1EN;
    RCC_APB2ENR |= RCC_APB2ENR_SYSCFGEN | RCC_APB2ENR_TIM1EN | RCC_APB2ENR_TIM8EN;
    (void)RCC_APB2ENR; /* a peripheral answers two cycles after its clock has been enabled */
}

/* Above 80 MHz the AHB clock goes there in two steps, and boost mode comes before the PLL whose output needs it
 * (RM0440, PWR: dynamic voltage scaling management). */
static void system_clock(void) {
    RCC_CR |= RCC_CR_HSEON;
    while (!(RCC_CR & RCC_CR_HSERDY)) { /* without the crystal there is no drive: all switches stay open */
    }
    RCC_CFGR = (RCC_CFGR & ~RCC_CFGR_HPRE) | PUT(RCC_CFGR_HPRE, HPRE_2);
#if BOARD_CLOCK_MHZ > 150
    PWR_CR5 &= ~PWR_CR5_R1MODE; /* boost mode */
#endif
    FLASH_ACR = (FLASH_ACR & ~FLASH_ACR_LATENCY) | PUT(FLASH_ACR_LATENCY, WAIT_STATES) | FLASH_ACR_PRFTEN;
    while (GET(FLASH_ACR_LATENCY, FLASH_ACR) != WAIT_STATES) {
    }
    RCC_PLLCFGR = PUT(RCC_PLLCFGR_PLLSRC, SOURCE_HSE) | PUT(RCC_PLLCFGR_PLLM, PLL_M - 1) |
                  PUT(RCC_PLLCFGR_PLLN, PLL_N) | PUT(RCC_PLLCFGR_PLLR, PLL_R / 2 - 1);
    RCC_CR |= RCC_CR_PLLON;
    while (!(RCC_CR & RCC_CR_PLLRDY)) {
    }
    RCC_PLLCFGR |= RCC_PLLCFGR_PLLREN;
    RCC_CFGR = (RCC_CFGR & ~RCC_CFGR_SW) | PUT(RCC_CFGR_SW, SOURCE_PLL);
    while (GET(RCC_CFGR_SWS, RCC_CFGR) != SOURCE_PLL) {
    }
    board_wait_us(2, BOARD_CLOCK_MHZ);
    RCC_CFGR &= ~RCC_CFGR_HPRE;
    RCC_CR |= RCC_CR_CSSON; /* a crystal that stops breaks TIM1 and TIM8, and requests the NMI */
}

/* Starts the crystal LSE, for which time_init waits. */
static void second_clock(void) {
    PWR_CR1 |= PWR_CR1_DBP;
    for (uint32_t turn = 0; turn < ACCESS_TURNS && !(PWR_CR1 & PWR_CR1_DBP); turn++) {
        /* RCC is on another bus: the access is there before the write that needs it */
    }
    RCC_BDCR |= RCC_BDCR_LSEON;
}

void clock_init(void) {
    peripherals_clock();
    system_clock();
    RCC_CCIPR = PUT(RCC_CCIPR_LPTIM1SEL, LPTIM_LSE) | PUT(RCC_CCIPR_FDCANSEL, FDCAN_PCLK) |
                PUT(RCC_CCIPR_CLK48SEL, CLK48_HSI48);
    RCC_CRRCR |= RCC_CRRCR_HSI48ON;
    while (!(RCC_CRRCR & RCC_CRRCR_HSI48RDY)) {
    }
    second_clock();
}
