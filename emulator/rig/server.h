/* The rig's clients: takes their frames, holds back those for the bus until time runs, and answers RIG_RUN_UNTIL. */
#ifndef RIG_SERVER_H
#define RIG_SERVER_H

#include <stdbool.h>

#include "rig/rig_state.h"

/* No clients; the rest of the rig is initialised. Keeps a pointer to the rig in the transport. */
void server_init(rig_t *rig);

/* One round, as rig_serve. */
bool server_round(rig_t *rig, int timeout_ms);

#endif
