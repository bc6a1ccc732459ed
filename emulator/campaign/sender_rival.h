/* The second client: a hostile one, or one with protected commands of its own. */
#ifndef CAMPAIGN_SENDER_RIVAL_H
#define CAMPAIGN_SENDER_RIVAL_H

#include "campaign/sender.h"

/* Sends what it sends in the present step. */
void sender_step_rival(sender_t *sender, const transport_receiver_t *receiver);

#endif
