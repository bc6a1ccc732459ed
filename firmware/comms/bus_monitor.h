/* Supervision of the CAN bus: leaves bus-off with a back-off, and recognises foreign use of the drive's identifiers.
 *
 * Bus-off: the first attempt to rejoin comes BUS_MONITOR_WAIT_MIN_US after bus-off is seen; each further one, after
 * another bus-off or one that has not ended, doubles the wait, up to BUS_MONITOR_WAIT_MAX_US. Once the controller has
 * been error active for BUS_MONITOR_ERROR_FREE_US without interruption, the wait is the first one again.
 */
#ifndef COMMS_BUS_MONITOR_H
#define COMMS_BUS_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_can.h"

#define BUS_MONITOR_WAIT_MIN_US 10000u
#define BUS_MONITOR_WAIT_MAX_US 320000u
#define BUS_MONITOR_ERROR_FREE_US 1000000u
#define BUS_MONITOR_CONFLICT_US 1000000u /* a foreign frame is a conflict for so long */

typedef struct {
    hal_can_status_t status; /* of the last step */
    uint16_t bus_off_count;  /* since start; saturates at 65535 */
    uint16_t foreign_count;  /* frames of others with an identifier of the drive, likewise */
    uint32_t wait_us;        /* before the next attempt */
    uint32_t since_us;       /* bus-off: when it was seen, or the last attempt; else last not error active */
    bool conflict;           /* a foreign frame within BUS_MONITOR_CONFLICT_US */
    uint32_t foreign_us;     /* time of the last one */
    bool run_inhibited;      /* bus-off since the last command other than run */
} bus_monitor_t;

void bus_monitor_init(bus_monitor_t *monitor, uint32_t time_us);

/* Reads the controller's state; requests to leave bus-off when it is time. To be called each millisecond: rejoining
 * takes longer. [background] */
void bus_monitor_step(bus_monitor_t *monitor, hal_t *hal, uint32_t time_us);

/* Counts a received frame that is not for the drive if it is a data frame with an identifier that only the drive
 * transmits: a conflict. [background] */
void bus_monitor_check(bus_monitor_t *monitor, const hal_can_frame_t *frame, uint32_t time_us);

#endif
