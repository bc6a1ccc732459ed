/* Clock of the emulated board's PWM timer. A tick is an integer number of nanoseconds, so that edges are exact. */
#ifndef PLANT_PWM_TIMER_H
#define PLANT_PWM_TIMER_H

#ifndef PWM_TIMER_TICK_NS /* another one for comparisons with a target of that clock */
#define PWM_TIMER_TICK_NS 5
#endif
#define PWM_TIMER_CLOCK_HZ (1000000000 / PWM_TIMER_TICK_NS)

#endif
