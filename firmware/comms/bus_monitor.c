#include "comms/bus_monitor.h"

#include <assert.h>

#include "comms/counter.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "drive_enumerations.h"
#include "drive_telemetry.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

static_assert((int)HAL_CAN_ERROR_ACTIVE == (int)BUS_STATE_ERROR_ACTIVE &&
                  (int)HAL_CAN_ERROR_PASSIVE == (int)BUS_STATE_ERROR_PASSIVE &&
                  (int)HAL_CAN_BUS_OFF == (int)BUS_STATE_BUS_OFF,
              "HAL and drive.dbc have the same numbers");

/* [SR-38] */
COLD void bus_monitor_init(bus_monitor_t *monitor, uint32_t time_us) {
    *monitor = (bus_monitor_t){.wait_us = BUS_MONITOR_WAIT_MIN_US, .since_us = time_us};
}

/* [SR-38] */
COLD static void enter_bus_off(bus_monitor_t *monitor, uint32_t time_us) {
    counter_add(&monitor->bus_off_count, 1);
    monitor->since_us = time_us;
    monitor->run_inhibited = true;
}

/* An attempt that has not succeeded when the next wait is over has failed: bus-off again before it was seen to end.
 * [SR-38] */
COLD static void wait_in_bus_off(bus_monitor_t *monitor, hal_t *hal, uint32_t time_us) {
    if (time_us - monitor->since_us < monitor->wait_us) {
        return;
    }
    hal_can_rejoin(hal);
    monitor->since_us = time_us;
    const uint32_t doubled_us = 2 * monitor->wait_us;
    monitor->wait_us = fixed_min_u32(doubled_us, BUS_MONITOR_WAIT_MAX_US);
}

/* [SR-37] [SR-38] */
COLD void bus_monitor_step(bus_monitor_t *monitor, hal_t *hal, uint32_t time_us) {
    const bool was_off = monitor->status.state == HAL_CAN_BUS_OFF;
    hal_can_status(hal, &monitor->status);
    if (monitor->conflict && time_us - monitor->foreign_us >= BUS_MONITOR_CONFLICT_US) {
        monitor->conflict = false;
    }
    if (monitor->status.state == HAL_CAN_BUS_OFF) {
        if (!was_off) {
            enter_bus_off(monitor, time_us);
        }
        wait_in_bus_off(monitor, hal, time_us);
    } else if (was_off || monitor->status.state != HAL_CAN_ERROR_ACTIVE) {
        monitor->since_us = time_us;
    } else if (time_us - monitor->since_us >= BUS_MONITOR_ERROR_FREE_US) {
        monitor->wait_us = BUS_MONITOR_WAIT_MIN_US; /* and remains so until bus-off, when the clock comes round too */
    }
}

/* [SR-37] */
COLD void bus_monitor_check(bus_monitor_t *monitor, const hal_can_frame_t *frame, uint32_t time_us) {
    bool own = frame->identifier == DRIVE_PARAMETER_RESPONSE_FRAME_ID;
    for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
        const drive_telemetry_message_t *message = &drive_telemetry_messages[i];
        own = own || (frame->identifier == message->identifier && machine_tables.phases > message->phases_above);
    }
    if (!own || frame->extended || frame->remote) {
        return;
    }
    counter_add(&monitor->foreign_count, 1);
    monitor->conflict = true;
    monitor->foreign_us = time_us;
}
