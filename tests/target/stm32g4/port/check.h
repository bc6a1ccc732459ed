/* Checks of the port, and what stands around the part: the registers of the port are not used here, so that a mistake
 * in them is not repeated. */
#ifndef CHECK_H
#define CHECK_H

#include <stdbool.h>
#include <stdint.h>

#include "drive/drive.h"
#include "hal.h"

#define WORD(address) (*(volatile uint32_t *)(address))
#define CYCLES WORD(0xE0001004u)

#define PERIOD_TICKS ((uint32_t)(BOARD_CLOCK_MHZ * 1000000u / 40000u / 2u))
#define PERIOD_CYCLES (2u * PERIOD_TICKS)

/* Pins of the bench's side, by the table in docs/board/pins.md. */
#define PIN(port, number) ((port)*16u + (number))
enum { PORT_A, PORT_B, PORT_C };

/* Bits of the input register of port C: gates of phases a and b, of TIM1, and of c and d, of TIM8. */
#define GATES_1 0x00Fu
#define GATES_2 0x3C0u
#define GATES (GATES_1 | GATES_2)
#define GATES_NOW (WORD(0x48000810u) & GATES)

/* The instrumentation ports of the processor, which the model gives to its bench: code at an analogue pin, level at a
 * pin. */
static inline void bench_code(uint32_t pin, uint32_t code) {
    WORD(0xE0000004u) = pin << 16 | code;
}

static inline void bench_level(uint32_t pin, uint32_t level) {
    WORD(0xE0000008u) = pin << 16 | level;
}

/* Errors of the bus: counters up to 255. */
static inline void bench_errors(uint32_t transmit, uint32_t receive, bool off) {
    WORD(0xE000000Cu) = (off ? 1u << 16 : 0) | receive << 8 | transmit;
}

/* A word of bank 1 has a double error from now on. */
static inline void bench_tear(uint32_t address) {
    WORD(0xE0000010u) = address;
}

/* The random numbers have a seed error; from the pipeline then come twelve words that are no numbers. */
#define STALE_WORD 0x5EED5EEDu
static inline void bench_seed_error(void) {
    WORD(0xE0000014u) = 1;
}

/* Ends the program with the line of a check that fails; 1000 are added in a second file and so on. */
void leave(int code) __attribute__((noreturn));

#ifndef CHECK_BASE
#define CHECK_BASE 0
#endif
#define CHECK(condition)                                                                                               \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            leave(CHECK_BASE + __LINE__);                                                                              \
        }                                                                                                              \
    } while (0)

/* Work of the control interrupt. */
typedef enum {
    IDLE,           /* opens all switches */
    FIXED,          /* writes compare values */
    SWEEP,          /* writes every compare value, at many instants of the period */
    SAMPLE,         /* checks the sample of inputs that change */
    TEMPERATURES,   /* changes the temperatures around the end of their sampling */
    LATE,           /* takes longer than a period, once */
    TEAR,           /* resets the part while the flash is busy */
    DEFERRED,       /* requests the deferred interrupt */
    CLOSED_NO_MORE, /* must not come any more */
} mode_t;

/* Survives a reset of the part: not in the memory that the start clears. */
typedef struct {
    uint32_t magic, stage, since_kick_us;
} kept_t;
#define KEPT ((volatile kept_t *)0x20017000u)

extern volatile mode_t mode;
extern volatile uint32_t periods;         /* control interrupts */
extern volatile uint32_t wanted;          /* duty of all switches in FIXED: 0, half or all ticks */
extern volatile uint32_t written_start;   /* cycle at which the period of the last write began */
extern volatile uint32_t missed, resumed; /* triggers missed in LATE; control interrupts since */
extern volatile uint32_t deferred_calls, pre_empted, can_pre_empted;
extern volatile bool sweep_done;
extern volatile bool masked; /* the background holds the interrupts back */

/* Waits for control interrupts. */
void wait_periods(uint32_t count);

/* Runs from the start of the periods. */
void check_pwm(hal_t *hal);
void check_breaks(hal_t *hal);
void check_samples(hal_t *hal);
void check_interrupts(hal_t *hal);
void check_bus(hal_t *hal);

/* Runs before them. */
void check_memory(hal_t *hal);
void check_clocks(hal_t *hal);

#endif
