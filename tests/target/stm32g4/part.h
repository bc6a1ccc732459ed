/* Registers and the start of the small programs that test the model of the part: bare metal, by the reference manual.
 */
#ifndef PART_H
#define PART_H

#include <stdint.h>

#define REG(address) (*(volatile uint32_t *)(address))
#define BIT(n) (UINT32_C(1) << (n))

#define RCC 0x40021000u
#define AHB1ENR REG(RCC + 0x48)
#define AHB2ENR REG(RCC + 0x4C)
#define APB1ENR1 REG(RCC + 0x58)
#define APB2ENR REG(RCC + 0x60)
#define TIM1 0x40012C00u
#define TIM2 0x40000000u
#define TIM3 0x40000400u
#define TIM5 0x40000C00u
#define TIM6 0x40001000u
#define TIM7 0x40001400u
#define TIM8 0x40013400u
#define CR1(tim) REG((tim) + 0x00)
#define CR2(tim) REG((tim) + 0x04)
#define SMCR(tim) REG((tim) + 0x08)
#define DIER(tim) REG((tim) + 0x0C)
#define SR(tim) REG((tim) + 0x10)
#define EGR(tim) REG((tim) + 0x14)
#define CCMR(tim, n) REG((tim) + 0x14 + 4 * (n)) /* n: 1, 2 */
#define CCER(tim) REG((tim) + 0x20)
#define CNT(tim) REG((tim) + 0x24)
#define PSC(tim) REG((tim) + 0x28)
#define ARR(tim) REG((tim) + 0x2C)
#define RCR(tim) REG((tim) + 0x30)
#define CCR(tim, n) REG((tim) + 0x30 + 4 * (n)) /* n: 1 to 4 */
#define BDTR(tim) REG((tim) + 0x44)
#define ECR(tim) REG((tim) + 0x58)
#define AF1(tim) REG((tim) + 0x60)
#define GPIO(port) (0x48000000u + 0x400u * (uint32_t)(port))
#define MODER(port) REG(GPIO(port) + 0x00)
#define IDR(port) REG(GPIO(port) + 0x10)
#define BSRR(port) REG(GPIO(port) + 0x18)
#define AFR(port, half) REG(GPIO(port) + 0x20 + 4 * (half))
enum { A, B, C, D };

#define NVIC_ENABLE(irq) (REG(0xE000E100u + 4 * ((irq) / 32)) = BIT((irq) % 32))
/* The barrier takes the exception here: the model takes them between blocks of instructions. */
#define NVIC_PEND(irq) (REG(0xE000E200u + 4 * ((irq) / 32)) = BIT((irq) % 32), barrier())
#define NVIC_PRIORITY(irq) (*(volatile uint8_t *)(0xE000E400u + (irq)))
#define ICSR REG(0xE000ED04u)
#define CYCLES REG(0xE0001004u)

static inline void barrier(void) {
    __asm__ volatile("dsb\n isb" ::: "memory");
}

typedef void (*handler_t)(void);
extern handler_t vectors[118]; /* in RAM: a program sets what it uses */

int test(void);
int leave(int code) __attribute__((noreturn));

/* Code of the first check that fails, by its line. */
#define CHECK(condition)                                                                                               \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            leave(__LINE__ & 0xFFFF);                                                                                  \
        }                                                                                                              \
    } while (0)

/* Waits for about n cycles or more. */
static inline void wait(uint32_t cycles) {
    REG(0xE0001000u) = 1;
    for (const uint32_t from = CYCLES; CYCLES - from < cycles;) {
    }
}

/* Pin as an alternate function, an output or an analogue input. */
static inline void pin_mode(unsigned port, unsigned pin, uint32_t mode, uint32_t function) {
    AHB2ENR |= BIT(port);
    AFR(port, pin / 8) = (AFR(port, pin / 8) & ~(15u << 4 * (pin % 8))) | function << 4 * (pin % 8);
    MODER(port) = (MODER(port) & ~(3u << 2 * pin)) | mode << 2 * pin;
}

/* 170 MHz from HSI16 by the sequence of the manual. */
void fast_clock(void);

/* A number in decimal and a line end, on standard output. */
void print(uint32_t value);

#endif
