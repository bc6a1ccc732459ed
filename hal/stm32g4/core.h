/* Registers of the processor's core (Armv7-M architecture reference manual, B3.2 and B3.4). */
#ifndef STM32G4_CORE_H
#define STM32G4_CORE_H

#include <stdint.h>

#define SCB_ICSR (*(volatile uint32_t *)0xE000ED04u)
#define SCB_ICSR_PENDSVSET (UINT32_C(1) << 28)
#define SCB_VTOR (*(volatile uint32_t *)0xE000ED08u)
#define SCB_SHPR3_PENDSV (*(volatile uint8_t *)0xE000ED22u)
#define NVIC_ISER(irq) (*(volatile uint32_t *)(0xE000E100u + 4u * ((irq) / 32u)))
#define NVIC_ICPR(irq) (*(volatile uint32_t *)(0xE000E280u + 4u * ((irq) / 32u)))
#define NVIC_IPR(irq) (*(volatile uint8_t *)(0xE000E400u + (irq)))
#define NVIC_MASK(irq) (UINT32_C(1) << ((irq) % 32u))

#endif
