/* Clock of the emulated board's PWM timer: 200 MHz, or what the build sets, in whole MHz. A tick is a rational number
 * of nanoseconds; a time that is not whole is rounded to the nearest one. All times of one period count from its start,
 * so that nothing accumulates, and the periods of the drive's control rates are whole. */
#ifndef PLANT_PWM_TIMER_H
#define PLANT_PWM_TIMER_H

#include <stdint.h>

#ifndef SALIENT_PWM_CLOCK_MHZ
#define SALIENT_PWM_CLOCK_MHZ 200
#endif
#define PWM_TIMER_CLOCK_HZ (SALIENT_PWM_CLOCK_MHZ * 1000000)
#define PWM_TIMER_NS_PER_US 1000u

/* Length of a tick; as an integer where it is whole. */
#if 1000 % SALIENT_PWM_CLOCK_MHZ == 0
#define PWM_TIMER_TICK_NS (1000 / SALIENT_PWM_CLOCK_MHZ)
#endif
#define PWM_TIMER_TICK_REAL_NS (1000.0 / SALIENT_PWM_CLOCK_MHZ)

/* Time after as many ticks, to the nearest nanosecond. ticks < 2^54. */
static inline uint64_t pwm_timer_ns(uint64_t ticks) {
#if 1000 % SALIENT_PWM_CLOCK_MHZ == 0
    return ticks * PWM_TIMER_TICK_NS;
#else
    return (ticks * PWM_TIMER_NS_PER_US + SALIENT_PWM_CLOCK_MHZ / 2u) / SALIENT_PWM_CLOCK_MHZ;
#endif
}

/* Whole ticks within a time, which may have been rounded. time_ns < 2^54. */
static inline uint64_t pwm_timer_ticks(uint64_t time_ns) {
#if 1000 % SALIENT_PWM_CLOCK_MHZ == 0
    return time_ns / PWM_TIMER_TICK_NS;
#else
    return (time_ns * SALIENT_PWM_CLOCK_MHZ + SALIENT_PWM_CLOCK_MHZ / 2u) / PWM_TIMER_NS_PER_US;
#endif
}

#endif
