/* Registers of the STM32G474 that the port uses, written by hand after the reference manual RM0440.
 *
 * tests/target/test_board_registers.py compares every line with two independent descriptions (facts.json,
 * salient.board.crates), and reads the forms of this file: a base address, an interrupt number, a register with
 * access, reset value ("-": depends on the instance) and the bits that a one (w1c) or a zero (w0c) clears, and below it
 * its fields.
 */
#ifndef STM32G4_REGISTERS_H
#define STM32G4_REGISTERS_H

#include <stdint.h>

#define REGISTER(base, offset) (*(volatile uint32_t *)(uintptr_t)((base) + (offset)))
#define BIT(n) (UINT32_C(1) << (n))
#define BITS(first, width) (((UINT32_C(1) << (width)) - 1u) << (first))

/* A value placed in a field, and the value of a field. The lowest bit of a field is its factor. */
#define PUT(field, value) ((uint32_t)(value) * ((field) & ~((field)-1u)))
#define GET(field, word) (((word) & (field)) / ((field) & ~((field)-1u)))

/* --- Interrupts (RM0440, Nested vectored interrupt controller) --- */
#define FDCAN1_IT0_IRQ 21
#define ADC5_IRQ 62

/* --- Reset and clock control --- */
#define RCC_BASE 0x40021000u
#define RCC_CR REGISTER(RCC_BASE, 0x00) /* rw 0x63 */
#define RCC_CR_HSEON BIT(16)
#define RCC_CR_HSERDY BIT(17)
#define RCC_CR_CSSON BIT(19)
#define RCC_CR_PLLON BIT(24)
#define RCC_CR_PLLRDY BIT(25)
#define RCC_CFGR REGISTER(RCC_BASE, 0x08) /* rw 0x5 */
#define RCC_CFGR_SW BITS(0, 2)
#define RCC_CFGR_SWS BITS(2, 2)
#define RCC_CFGR_HPRE BITS(4, 4)
#define RCC_PLLCFGR REGISTER(RCC_BASE, 0x0C) /* rw 0x1000 */
#define RCC_PLLCFGR_PLLSRC BITS(0, 2)
#define RCC_PLLCFGR_PLLM BITS(4, 4)
#define RCC_PLLCFGR_PLLN BITS(8, 7)
#define RCC_PLLCFGR_PLLREN BIT(24)
#define RCC_PLLCFGR_PLLR BITS(25, 2)
#define RCC_CIFR REGISTER(RCC_BASE, 0x1C) /* r 0x0 */
#define RCC_CIFR_CSSF BIT(8)
#define RCC_AHB1ENR REGISTER(RCC_BASE, 0x48) /* rw 0x100 */
#define RCC_AHB1ENR_DMA1EN BIT(0)
#define RCC_AHB1ENR_DMAMUX1EN BIT(2)
#define RCC_AHB1ENR_FLASHEN BIT(8)
#define RCC_AHB2ENR REGISTER(RCC_BASE, 0x4C) /* rw 0x0 */
#define RCC_AHB2ENR_GPIOAEN BIT(0)
#define RCC_AHB2ENR_GPIOBEN BIT(1)
#define RCC_AHB2ENR_GPIOCEN BIT(2)
#define RCC_AHB2ENR_ADC12EN BIT(13)
#define RCC_AHB2ENR_ADC345EN BIT(14)
#define RCC_AHB2ENR_DAC3EN BIT(18)
#define RCC_AHB2ENR_DAC4EN BIT(19)
#define RCC_AHB2ENR_RNGEN BIT(26)
#define RCC_APB1ENR1 REGISTER(RCC_BASE, 0x58) /* rw 0x400 */
#define RCC_APB1ENR1_TIM2EN BIT(0)
#define RCC_APB1ENR1_TIM3EN BIT(1)
#define RCC_APB1ENR1_TIM4EN BIT(2)
#define RCC_APB1ENR1_TIM5EN BIT(3)
#define RCC_APB1ENR1_RTCAPBEN BIT(10)
#define RCC_APB1ENR1_FDCANEN BIT(25)
#define RCC_APB1ENR1_PWREN BIT(28)
#define RCC_APB1ENR1_LPTIM1EN BIT(31)
#define RCC_APB2ENR REGISTER(RCC_BASE, 0x60) /* rw 0x0 */
#define RCC_APB2ENR_SYSCFGEN BIT(0)
#define RCC_APB2ENR_TIM1EN BIT(11)
#define RCC_APB2ENR_TIM8EN BIT(13)
#define RCC_CCIPR REGISTER(RCC_BASE, 0x88) /* rw 0x0 */
#define RCC_CCIPR_LPTIM1SEL BITS(18, 2)
#define RCC_CCIPR_FDCANSEL BITS(24, 2)
#define RCC_CCIPR_CLK48SEL BITS(26, 2)
#define RCC_BDCR REGISTER(RCC_BASE, 0x90) /* rw 0x0 */
#define RCC_BDCR_LSEON BIT(0)
#define RCC_BDCR_LSERDY BIT(1)
#define RCC_CSR REGISTER(RCC_BASE, 0x94) /* rw 0xC000000 */
#define RCC_CSR_RMVF BIT(23)
#define RCC_CSR_IWDGRSTF BIT(29)
#define RCC_CRRCR REGISTER(RCC_BASE, 0x98) /* rw 0x0 */
#define RCC_CRRCR_HSI48ON BIT(0)
#define RCC_CRRCR_HSI48RDY BIT(1)

/* --- Power control --- */
#define PWR_BASE 0x40007000u
#define PWR_CR1 REGISTER(PWR_BASE, 0x00) /* rw 0x200 */
#define PWR_CR1_DBP BIT(8)
#define PWR_CR5 REGISTER(PWR_BASE, 0x80) /* rw 0x100 */
#define PWR_CR5_R1MODE BIT(8)

/* --- Embedded flash memory, category 3 devices --- */
#define FLASH_BASE 0x40022000u
#define FLASH_ACR REGISTER(FLASH_BASE, 0x00) /* rw 0x600 */
#define FLASH_ACR_LATENCY BITS(0, 4)
#define FLASH_ACR_PRFTEN BIT(8)
#define FLASH_ACR_ICEN BIT(9)
#define FLASH_ACR_DCEN BIT(10)
#define FLASH_ACR_DCRST BIT(12)
#define FLASH_KEYR REGISTER(FLASH_BASE, 0x08) /* w 0x0 */
#define FLASH_SR REGISTER(FLASH_BASE, 0x10)   /* rw 0x0 w1c 0xC3FB */
#define FLASH_SR_EOP BIT(0)
#define FLASH_SR_OPERR BIT(1)
#define FLASH_SR_PROGERR BIT(3)
#define FLASH_SR_WRPERR BIT(4)
#define FLASH_SR_PGAERR BIT(5)
#define FLASH_SR_SIZERR BIT(6)
#define FLASH_SR_PGSERR BIT(7)
#define FLASH_SR_MISERR BIT(8)
#define FLASH_SR_FASTERR BIT(9)
#define FLASH_SR_RDERR BIT(14)
#define FLASH_SR_OPTVERR BIT(15)
#define FLASH_SR_BSY BIT(16)
#define FLASH_CR REGISTER(FLASH_BASE, 0x14) /* rw 0xC0000000 */
#define FLASH_CR_PG BIT(0)
#define FLASH_CR_PER BIT(1)
#define FLASH_CR_PNB BITS(3, 7)
#define FLASH_CR_BKER BIT(11)
#define FLASH_CR_STRT BIT(16)
#define FLASH_CR_LOCK BIT(31)
#define FLASH_ECCR REGISTER(FLASH_BASE, 0x18) /* rw 0x0 w1c 0xF0000000 */
#define FLASH_ECCR_ECCC2 BIT(28)
#define FLASH_ECCR_ECCD2 BIT(29)
#define FLASH_ECCR_ECCC BIT(30)
#define FLASH_ECCR_ECCD BIT(31)
#define FLASH_OPTR REGISTER(FLASH_BASE, 0x20) /* rw 0xFFEFF8AA */
#define FLASH_OPTR_DBANK BIT(22)

/* --- General-purpose I/Os; field n of a register: PIN_FIELD --- */
#define GPIOA_BASE 0x48000000u
#define GPIOB_BASE 0x48000400u
#define GPIOC_BASE 0x48000800u
#define GPIO_MODER(port) REGISTER(port, 0x00)   /* rw - */
#define GPIO_OSPEEDR(port) REGISTER(port, 0x08) /* rw - */
#define GPIO_PUPDR(port) REGISTER(port, 0x0C)   /* rw - */
#define GPIO_IDR(port) REGISTER(port, 0x10)     /* r - */
#define GPIO_AFRL(port) REGISTER(port, 0x20)    /* rw 0x0 */
#define GPIO_AFRH(port) REGISTER(port, 0x24)    /* rw 0x0 */

/* --- System configuration controller --- */
#define SYSCFG_BASE 0x40010000u
#define SYSCFG_EXTICR3 REGISTER(SYSCFG_BASE, 0x10) /* rw 0x0 */
#define SYSCFG_EXTICR3_EXTI10 BITS(8, 4)
#define SYSCFG_EXTICR4 REGISTER(SYSCFG_BASE, 0x14) /* rw 0x0 */
#define SYSCFG_EXTICR4_EXTI12 BITS(0, 4)
#define SYSCFG_EXTICR4_EXTI13 BITS(4, 4)
#define SYSCFG_CFGR2 REGISTER(SYSCFG_BASE, 0x1C) /* rw 0x0 */
#define SYSCFG_CFGR2_CLL BIT(0)

/* --- Extended interrupts and events controller; bit n: line n --- */
#define EXTI_BASE 0x40010400u
#define EXTI_IMR1 REGISTER(EXTI_BASE, 0x00)   /* rw 0xFF820000 */
#define EXTI_FTSR1 REGISTER(EXTI_BASE, 0x0C)  /* rw 0x0 */
#define EXTI_SWIER1 REGISTER(EXTI_BASE, 0x10) /* rw 0x0 */
#define EXTI_PR1 REGISTER(EXTI_BASE, 0x14)    /* rw 0x0 w1c 0x7BFFFF */

/* --- Timers: advanced-control TIM1 and TIM8, general-purpose TIM2 to TIM5 --- */
#define TIM1_BASE 0x40012C00u
#define TIM2_BASE 0x40000000u
#define TIM3_BASE 0x40000400u
#define TIM4_BASE 0x40000800u
#define TIM5_BASE 0x40000C00u
#define TIM8_BASE 0x40013400u
#define TIM_CR1(tim) REGISTER(tim, 0x00) /* rw 0x0 */
#define TIM_CR1_CEN BIT(0)
#define TIM_CR1_URS BIT(2)
#define TIM_CR1_DIR BIT(4)
#define TIM_CR1_CMS BITS(5, 2)
#define TIM_CR2(tim) REGISTER(tim, 0x04) /* rw 0x0 */
#define TIM_CR2_MMS BITS(4, 3)
#define TIM_CR2_MMS2 BITS(20, 4)
#define TIM_SMCR(tim) REGISTER(tim, 0x08) /* rw 0x0 */
#define TIM_SMCR_SMS BITS(0, 3)
#define TIM_SMCR_TS BITS(4, 3)
#define TIM_DIER(tim) REGISTER(tim, 0x0C) /* rw 0x0 */
#define TIM_DIER_CC1DE BIT(9)
#define TIM_DIER_CC2DE BIT(10)
#define TIM_SR(tim) REGISTER(tim, 0x10) /* rw 0x0 w0c 0xF33FFF */
#define TIM_SR_UIF BIT(0)
#define TIM_SR_CC1IF BIT(1)
#define TIM_SR_CC2IF BIT(2)
#define TIM_SR_BIF BIT(7)
#define TIM_SR_B2IF BIT(8)
#define TIM_SR_SBIF BIT(13)
#define TIM_SR_IDXF BIT(20)
#define TIM_EGR(tim) REGISTER(tim, 0x14) /* w 0x0 */
#define TIM_EGR_UG BIT(0)
#define TIM_EGR_BG BIT(7)
#define TIM_CCMR1(tim) REGISTER(tim, 0x18) /* rw 0x0 */
#define TIM_CCMR1_CC1S BITS(0, 2)
#define TIM_CCMR1_OC1PE BIT(3)
#define TIM_CCMR1_OC1M BITS(4, 3)
#define TIM_CCMR1_IC1F BITS(4, 4)
#define TIM_CCMR1_CC2S BITS(8, 2)
#define TIM_CCMR1_OC2PE BIT(11)
#define TIM_CCMR1_OC2M BITS(12, 3)
#define TIM_CCMR1_IC2F BITS(12, 4)
#define TIM_CCMR2(tim) REGISTER(tim, 0x1C) /* rw 0x0 */
#define TIM_CCMR2_CC3S BITS(0, 2)
#define TIM_CCMR2_OC3PE BIT(3)
#define TIM_CCMR2_OC3M BITS(4, 3)
#define TIM_CCMR2_OC4PE BIT(11)
#define TIM_CCMR2_OC4M BITS(12, 3)
#define TIM_CCER(tim) REGISTER(tim, 0x20) /* rw 0x0 */
#define TIM_CCER_CC1E BIT(0)
#define TIM_CCER_CC2E BIT(4)
#define TIM_CCER_CC3E BIT(8)
#define TIM_CCER_CC4E BIT(12)
#define TIM_CNT(tim) REGISTER(tim, 0x24)  /* rw 0x0 */
#define TIM_PSC(tim) REGISTER(tim, 0x28)  /* rw 0x0 */
#define TIM_ARR(tim) REGISTER(tim, 0x2C)  /* rw - */
#define TIM_RCR(tim) REGISTER(tim, 0x30)  /* rw 0x0 */
#define TIM_CCR1(tim) REGISTER(tim, 0x34) /* rw 0x0 */
#define TIM_CCR2(tim) REGISTER(tim, 0x38) /* rw 0x0 */
#define TIM_CCR3(tim) REGISTER(tim, 0x3C) /* rw 0x0 */
#define TIM_CCR4(tim) REGISTER(tim, 0x40) /* rw 0x0 */
#define TIM_BDTR(tim) REGISTER(tim, 0x44) /* rw 0x0 */
#define TIM_BDTR_OSSI BIT(10)
#define TIM_BDTR_OSSR BIT(11)
#define TIM_BDTR_BKE BIT(12)
#define TIM_BDTR_MOE BIT(15)
#define TIM_BDTR_BK2F BITS(20, 4)
#define TIM_BDTR_BK2E BIT(24)
#define TIM_BDTR_BK2P BIT(25)
#define TIM_ECR(tim) REGISTER(tim, 0x58) /* rw 0x0 */
#define TIM_ECR_IE BIT(0)
#define TIM_AF1(tim) REGISTER(tim, 0x60) /* rw 0x1 */
#define TIM_AF1_BKINE BIT(0)
#define TIM_AF2(tim) REGISTER(tim, 0x64) /* rw 0x1 */
#define TIM_AF2_BK2CMP2E BIT(2)
#define TIM_AF2_BK2CMP3E BIT(3)
#define TIM_AF2_BK2CMP4E BIT(4)
#define TIM_AF2_BK2CMP7E BIT(7)

/* --- Analog-to-digital converters --- */
#define ADC1_BASE 0x50000000u
#define ADC2_BASE 0x50000100u
#define ADC3_BASE 0x50000400u
#define ADC4_BASE 0x50000500u
#define ADC5_BASE 0x50000600u
#define ADC_ISR(adc) REGISTER(adc, 0x00) /* rw 0x0 w1c 0x7FF */
#define ADC_ISR_ADRDY BIT(0)
#define ADC_ISR_EOC BIT(2)
#define ADC_ISR_JEOC BIT(5)
#define ADC_ISR_JEOS BIT(6)
#define ADC_IER(adc) REGISTER(adc, 0x04) /* rw 0x0 */
#define ADC_IER_JEOSIE BIT(6)
#define ADC_CR(adc) REGISTER(adc, 0x08) /* rw 0x20000000 */
#define ADC_CR_ADEN BIT(0)
#define ADC_CR_ADSTART BIT(2)
#define ADC_CR_JADSTART BIT(3)
#define ADC_CR_ADVREGEN BIT(28)
#define ADC_CR_ADCAL BIT(31)
#define ADC_CFGR(adc) REGISTER(adc, 0x0C) /* rw 0x80000000 */
#define ADC_CFGR_OVRMOD BIT(12)
#define ADC_CFGR_JQDIS BIT(31)
#define ADC_SMPR1(adc) REGISTER(adc, 0x14) /* rw 0x0 */
#define ADC_SMPR2(adc) REGISTER(adc, 0x18) /* rw 0x0 */
#define ADC_SQR1(adc) REGISTER(adc, 0x30)  /* rw 0x0 */
#define ADC_SQR1_SQ1 BITS(6, 5)
#define ADC_DR(adc) REGISTER(adc, 0x40)   /* r 0x0 */
#define ADC_JSQR(adc) REGISTER(adc, 0x4C) /* rw 0x0 */
#define ADC_JSQR_JL BITS(0, 2)
#define ADC_JSQR_JEXTSEL BITS(2, 5)
#define ADC_JSQR_JEXTEN BITS(7, 2)
#define ADC_JSQR_JSQ1 BITS(9, 5)
#define ADC_JSQR_JSQ2 BITS(15, 5)
#define ADC_JDR1(adc) REGISTER(adc, 0x80) /* r 0x0 */
#define ADC_JDR2(adc) REGISTER(adc, 0x84) /* r 0x0 */
#define ADC12_COMMON_BASE 0x50000300u
#define ADC345_COMMON_BASE 0x50000700u
#define ADCC_CCR(common) REGISTER(common, 0x08) /* rw 0x0 */
#define ADCC_CCR_CKMODE BITS(16, 2)

/* --- Comparators --- */
#define COMP_BASE 0x40010200u
#define COMP_C2CSR REGISTER(COMP_BASE, 0x04) /* rw 0x0 */
#define COMP_C2CSR_EN BIT(0)
#define COMP_C2CSR_INMSEL BITS(4, 3)
#define COMP_C2CSR_HYST BITS(16, 3)
#define COMP_C2CSR_LOCK BIT(31)
#define COMP_C3CSR REGISTER(COMP_BASE, 0x08) /* rw 0x0 */
#define COMP_C4CSR REGISTER(COMP_BASE, 0x0C) /* rw 0x0 */
#define COMP_C7CSR REGISTER(COMP_BASE, 0x18) /* rw 0x0 */

/* --- Digital-to-analog converters --- */
#define DAC3_BASE 0x50001000u
#define DAC4_BASE 0x50001400u
#define DAC_CR(dac) REGISTER(dac, 0x00) /* rw 0x0 */
#define DAC_CR_EN1 BIT(0)
#define DAC_CR_EN2 BIT(16)
#define DAC_DHR12R1(dac) REGISTER(dac, 0x08) /* rw 0x0 */
#define DAC_DHR12R2(dac) REGISTER(dac, 0x14) /* rw 0x0 */
#define DAC_MCR(dac) REGISTER(dac, 0x3C)     /* rw 0x0 */
#define DAC_MCR_MODE1 BITS(0, 3)
#define DAC_MCR_HFSEL BITS(14, 2)
#define DAC_MCR_MODE2 BITS(16, 3)

/* --- Direct memory access controller and its request multiplexer --- */
#define DMA1_BASE 0x40020000u
#define DMA_CCR1 REGISTER(DMA1_BASE, 0x08) /* rw 0x0 */
#define DMA_CCR1_EN BIT(0)
#define DMA_CCR1_DIR BIT(4)
#define DMA_CCR1_CIRC BIT(5)
#define DMA_CCR1_PSIZE BITS(8, 2)
#define DMA_CCR1_MSIZE BITS(10, 2)
#define DMA_CCR1_PL BITS(12, 2)
#define DMA_CNDTR1 REGISTER(DMA1_BASE, 0x0C) /* rw 0x0 */
#define DMA_CPAR1 REGISTER(DMA1_BASE, 0x10)  /* rw 0x0 */
#define DMA_CMAR1 REGISTER(DMA1_BASE, 0x14)  /* rw 0x0 */
#define DMA_CCR2 REGISTER(DMA1_BASE, 0x1C)   /* rw 0x0 */
#define DMA_CNDTR2 REGISTER(DMA1_BASE, 0x20) /* rw 0x0 */
#define DMA_CPAR2 REGISTER(DMA1_BASE, 0x24)  /* rw 0x0 */
#define DMA_CMAR2 REGISTER(DMA1_BASE, 0x28)  /* rw 0x0 */
#define DMAMUX_BASE 0x40020800u
#define DMAMUX_C0CR REGISTER(DMAMUX_BASE, 0x00) /* rw 0x0 */
#define DMAMUX_C0CR_DMAREQ_ID BITS(0, 7)
#define DMAMUX_C1CR REGISTER(DMAMUX_BASE, 0x04) /* rw 0x0 */

/* --- FD controller area network; message RAM below --- */
#define FDCAN1_BASE 0x40006400u
#define FDCAN_CCCR REGISTER(FDCAN1_BASE, 0x18) /* rw 0x1 */
#define FDCAN_CCCR_INIT BIT(0)
#define FDCAN_CCCR_CCE BIT(1)
#define FDCAN_NBTP REGISTER(FDCAN1_BASE, 0x1C) /* rw 0x6000A03 */
#define FDCAN_NBTP_NTSEG2 BITS(0, 7)
#define FDCAN_NBTP_NTSEG1 BITS(8, 8)
#define FDCAN_NBTP_NBRP BITS(16, 9)
#define FDCAN_NBTP_NSJW BITS(25, 7)
#define FDCAN_ECR REGISTER(FDCAN1_BASE, 0x40) /* rw 0x0 */
#define FDCAN_ECR_TEC BITS(0, 8)
#define FDCAN_ECR_REC BITS(8, 7)
#define FDCAN_ECR_RP BIT(15)
#define FDCAN_PSR REGISTER(FDCAN1_BASE, 0x44) /* rw 0x707 */
#define FDCAN_PSR_EP BIT(5)
#define FDCAN_PSR_BO BIT(7)
#define FDCAN_IR REGISTER(FDCAN1_BASE, 0x50) /* rw 0x0 w1c 0xFFFFFF */
#define FDCAN_IR_RF0N BIT(0)
#define FDCAN_IR_RF0L BIT(2)
#define FDCAN_IE REGISTER(FDCAN1_BASE, 0x54) /* rw 0x0 */
#define FDCAN_IE_RF0NE BIT(0)
#define FDCAN_IE_RF0LE BIT(2)
#define FDCAN_ILE REGISTER(FDCAN1_BASE, 0x5C) /* rw 0x0 */
#define FDCAN_ILE_EINT0 BIT(0)
#define FDCAN_RXGFC REGISTER(FDCAN1_BASE, 0x80) /* rw 0x0 */
#define FDCAN_RXF0S REGISTER(FDCAN1_BASE, 0x90) /* r 0x0 */
#define FDCAN_RXF0S_F0FL BITS(0, 4)
#define FDCAN_RXF0S_F0GI BITS(8, 2)
#define FDCAN_RXF0A REGISTER(FDCAN1_BASE, 0x94) /* rw 0x0 */
#define FDCAN_TXBC REGISTER(FDCAN1_BASE, 0xC0)  /* rw 0x0 */
#define FDCAN_TXBC_TFQM BIT(24)
#define FDCAN_TXBRP REGISTER(FDCAN1_BASE, 0xC8) /* r 0x0 */
#define FDCAN_TXBAR REGISTER(FDCAN1_BASE, 0xCC) /* rw 0x0 */
#define FDCANRAM1_BASE 0x4000A400u

/* --- Independent watchdog --- */
#define IWDG_BASE 0x40003000u
#define IWDG_KR REGISTER(IWDG_BASE, 0x00)  /* w 0x0 */
#define IWDG_PR REGISTER(IWDG_BASE, 0x04)  /* rw 0x0 */
#define IWDG_RLR REGISTER(IWDG_BASE, 0x08) /* rw 0xFFF */
#define IWDG_SR REGISTER(IWDG_BASE, 0x0C)  /* r 0x0 */
#define IWDG_SR_PVU BIT(0)
#define IWDG_SR_RVU BIT(1)

/* --- True random number generator --- */
#define RNG_BASE 0x50060800u
#define RNG_CR REGISTER(RNG_BASE, 0x00) /* rw 0x0 */
#define RNG_CR_RNGEN BIT(2)
#define RNG_SR REGISTER(RNG_BASE, 0x04) /* rw 0x0 w0c 0x60 */
#define RNG_SR_DRDY BIT(0)
#define RNG_SR_SEIS BIT(6)
#define RNG_DR REGISTER(RNG_BASE, 0x08) /* r 0x0 */

/* --- Low-power timer --- */
#define LPTIM1_BASE 0x40007C00u
#define LPTIM_ISR REGISTER(LPTIM1_BASE, 0x00) /* r 0x0 */
#define LPTIM_ISR_ARROK BIT(4)
#define LPTIM_CR REGISTER(LPTIM1_BASE, 0x10) /* rw 0x0 */
#define LPTIM_CR_ENABLE BIT(0)
#define LPTIM_CR_CNTSTRT BIT(2)
#define LPTIM_ARR REGISTER(LPTIM1_BASE, 0x18) /* rw 0x1 */
#define LPTIM_CNT REGISTER(LPTIM1_BASE, 0x1C) /* r 0x0 */

#endif
