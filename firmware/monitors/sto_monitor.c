#include "monitors/sto_monitor.h"

#include "fixed/compiler.h"
#include "hal_pwm.h"

/* [SR-03] */
COLD bool sto_monitor_failed(sto_monitor_t *monitor, uint32_t break_causes, uint32_t time_us) {
    const bool off_1 = (break_causes & HAL_PWM_BREAK_STO_1) != 0;
    const bool off_2 = (break_causes & HAL_PWM_BREAK_STO_2) != 0;
    if (off_1 == off_2) {
        monitor->agreed_us = time_us;
    }
    if (off_1 && off_2) {
        monitor->failed = false;
    } else if (time_us - monitor->agreed_us > STO_DISCREPANCY_US) {
        monitor->failed = true;
    }
    return monitor->failed;
}
