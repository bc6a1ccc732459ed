/* Discrepancy of the two lines of safe torque off.
 *
 * The hardware opens the switches by either line alone; the firmware only reports that. Lines that differ for longer
 * than STO_DISCREPANCY_US are a broken wire, a welded contact or a switch that opens one of them only: the fault lasts
 * until both lines have been seen without energy at the same time, which shows that both work.
 */
#ifndef MONITORS_STO_MONITOR_H
#define MONITORS_STO_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#define STO_DISCREPANCY_US 200000u

typedef struct {
    uint32_t agreed_us; /* when the lines were last seen alike */
    bool failed;
} sto_monitor_t;

/* Takes the causes of a break (HAL_PWM_BREAK_*) at time_us; true while the discrepancy is a fault. To be called at
 * least once in 71 minutes. [background] */
bool sto_monitor_failed(sto_monitor_t *monitor, uint32_t break_causes, uint32_t time_us);

#endif
