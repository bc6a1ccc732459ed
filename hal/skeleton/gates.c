/* Gates: compare values, and the breaks that open the switches without the firmware. */
#include "hal_memory.h"
#include "hal_pwm.h"
#include "skeleton/board.h"

/* FILL IN: clock of the PWM timer; half a control period must be a whole number of its ticks. */
uint32_t hal_pwm_clock_hz(const hal_t *hal) {
    (void)hal;
    return 100000000;
}

/* FILL IN: centre-aligned timers, all phases started in one cycle, updates at the start of the period only. */
void hal_pwm_start(hal_t *hal, uint16_t period_ticks) {
    hal->period_ticks = period_ticks;
}

/* FILL IN: buffered compare values of the next period; enables the outputs unless there is a break; restarts what
 * watches that values are renewed. */
void hal_pwm_write(hal_t *hal, const hal_pwm_compare_t *compare) {
    (void)hal;
    (void)compare;
}

/* FILL IN: outputs off at once; buffered and acting compare values cleared. */
void hal_pwm_open_all(hal_t *hal) {
    (void)hal;
}

/* FILL IN: latched causes. Here: both lines of STO, so that no run begins. */
uint32_t hal_pwm_break(const hal_t *hal) {
    (void)hal;
    return HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2;
}

/* FILL IN: clears the causes that have gone. */
void hal_pwm_clear_break(hal_t *hal) {
    (void)hal;
}

/* FILL IN: compares the registers of timers, breaks and converters with what has been written. Here: not intact. */
bool hal_registers_intact(const hal_t *hal) {
    (void)hal;
    return false;
}
