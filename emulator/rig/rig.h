/* The test bench: joins plant, board, CAN bus and clients on one virtual clock.
 *
 * Several drives on one bus are a list of rigs. The first one has the bus, the clients and the pacing; each has a
 * plant, a board, variables and faults of its own.
 *
 * One thread, next event first (scheduler.h). Events of the same instant come in the order of scheduler_event_t, then
 * the clients. The plant is advanced exactly to the events that touch it, and to no others, so that the way a client
 * divides time into RIG_RUN_UNTILs does not change a bit of the result.
 *
 * In lock-step, time stands still until a client sends RIG_RUN_UNTIL; clients are not read while time runs. Frames for
 * the bus that were sent while it stood still wait in the node of their client, in its order, and take part in
 * arbitration when time runs, whatever the moment they arrived; a client's frames that were sent before another
 * client's RIG_RUN_UNTIL are taken before it. The RIG_RUN_UNTIL of a client that has disconnected is abandoned, within
 * RIG_STOP_STEP_NS, when another client is connected; without one it runs to its end. In the other paces clients are
 * read each RIG_READ_STEP_NS of virtual time.
 */
#ifndef RIG_H
#define RIG_H

#include <stdbool.h>
#include <stdint.h>

#include "rig/rig_state.h"

/* A bench at time 0: machine at rest, supply on, no load, no firmware. The rig must not be moved afterwards. */
void rig_init(rig_t *rig, const rig_config_t *config);

/* A bench for another drive on the bus of `first`, which is at time 0: of the configuration, what concerns bus, clients
 * and pacing is not used. There are at most CAN_BUS_DRIVES_MAX drives, with different nodes. */
void rig_add(rig_t *first, rig_t *rig, const rig_config_t *config);

/* Joins the firmware, which must have started the timer (hal_pwm_start); its first interrupt is one period away. */
void rig_join(rig_t *rig, const rig_firmware_t *firmware);

/* The processor serves no trigger of a control interrupt before time_ns: they are lost, like those during an
 * interrupt. */
void rig_busy_until(rig_t *rig, uint64_t time_ns);

/* One round, of the first rig as the next two. Lock-step: takes the clients' frames; runs to the earliest requested
 * time, or waits up to timeout_ms (negative: indefinitely) when none is requested. Other paces: runs to the next
 * reading point. False at the end: stop requested, stop_at_ns reached, or config.transport->failure. */
bool rig_serve(rig_t *rig, int timeout_ms);

/* Advances the plant, and its observer, to the present time and sends the frames that are still in batches. */
void rig_finish(rig_t *rig);

/* Frees what the rig allocated for its clients. */
void rig_close(rig_t *rig);

#endif
