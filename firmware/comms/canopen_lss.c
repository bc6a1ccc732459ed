#include "comms/canopen_lss.h"

#include "comms/canopen_send.h"
#include "control/machine_tables.h"
#include "fixed/compiler.h"

#define RESPONSE_ID 0x7E4u
#define IDENTITIES 4u /* vendor, product, revision, serial */
enum {
    SWITCH_GLOBAL = 0x04,
    CONFIGURE_NODE = 0x11,
    CONFIGURE_BIT_RATE = 0x13,
    STORE = 0x17,
    SWITCH_SELECTIVE = 0x40, /* the first of four */
    SELECTED = 0x44,
    IDENTIFY = 0x46, /* the first of six */
    IDENTIFY_WITHOUT_NODE = 0x4C,
    IDENTIFIED = 0x4F,
    IDENTIFIED_WITHOUT_NODE = 0x50,
    FAST_SCAN = 0x51,
    INQUIRE = 0x5A, /* the first of four */
    INQUIRE_NODE = 0x5E
};
#define FROM_BEGIN 0x80u /* bit check of a fast scan that begins */

enum { DONE = 0, REFUSED = 1, STORE_FAILED = 2 };

static uint32_t identity(const canopen_t *canopen, unsigned number) {
    const uint32_t identities[IDENTITIES] = {CANOPEN_VENDOR, CANOPEN_PRODUCT, machine_tables.machine_hash,
                                             canopen->serial};
    return identities[number % IDENTITIES];
}

static void respond(canopen_t *canopen, const canopen_context_t *context, unsigned command, uint32_t value) {
    uint8_t data[8] = {(uint8_t)command};
    canopen_pack(data + 1, 4, (int32_t)value);
    canopen_send(canopen, context, RESPONSE_ID, data, sizeof data);
}

/* Without a node-ID, and without one that is to come. */
static bool has_none(const canopen_t *canopen) {
    return canopen->node == CANOPEN_NODE_NONE && canopen->lss.node == CANOPEN_NODE_NONE;
}

/* The four numbers in order; another request in between begins anew. */
static void select(canopen_t *canopen, const canopen_context_t *context, unsigned number, uint32_t value) {
    canopen_lss_t *lss = &canopen->lss;
    const bool in_order = number == 0 || lss->selected == number;
    lss->selected = in_order && value == identity(canopen, number) ? (uint8_t)(number + 1u) : 0;
    if (lss->selected == IDENTITIES) {
        lss->selected = 0;
        lss->configuring = true;
        respond(canopen, context, SELECTED, 0);
    }
}

/* Vendor, product, lowest and highest revision, lowest and highest serial number. */
static void identify(canopen_t *canopen, const canopen_context_t *context, unsigned step, uint32_t value) {
    static const uint8_t number_of[] = {0, 1, 2, 2, 3, 3};
    canopen_lss_t *lss = &canopen->lss;
    const uint32_t own = identity(canopen, number_of[step]);
    const bool fits = step < 2u ? value == own : (step & 1u) == 0 ? value <= own : value >= own;
    lss->matched = (step == 0 || lss->matched == step) && fits ? (uint8_t)(step + 1u) : 0;
    if (lss->matched == sizeof number_of) {
        lss->matched = 0;
        respond(canopen, context, IDENTIFIED, 0);
    }
}

/* A node without a node-ID answers while the bits of the number from the checked one on are its own. When all are, the
 * scan goes to the next number; after the last of the four it is selected. */
static void scan(canopen_t *canopen, const canopen_context_t *context, const uint8_t *data, uint32_t value) {
    canopen_lss_t *lss = &canopen->lss;
    const unsigned bit = data[5], number = data[6], next = data[7];
    if (lss->configuring || !has_none(canopen)) {
        return;
    }
    if (bit == FROM_BEGIN) {
        lss->selected = 0;
        respond(canopen, context, IDENTIFIED, 0);
    } else if (bit < 32u && number == lss->selected && next < IDENTITIES &&
               (identity(canopen, number) ^ value) >> bit == 0) {
        if (bit == 0) {
            lss->selected = (uint8_t)next;
            lss->configuring = next < number;
        }
        respond(canopen, context, IDENTIFIED, 0);
    }
}

static void store(canopen_t *canopen, const canopen_context_t *context) {
    parameters_verdict_t verdict = {PARAMETER_STATUS_NOT_WHILE_RUNNING, 0, 0};
    if (!context->conditions->running) {
        verdict = parameter_set_one(context->set, context->parameters, context->conditions, PARAMETER_PROTOCOL,
                                    canopen->lss.node);
    }
    if (verdict.status == PARAMETER_STATUS_DONE) {
        parameter_store_save(context->store);
    }
    respond(canopen, context, STORE, verdict.status == PARAMETER_STATUS_DONE ? DONE : STORE_FAILED);
}

static void configure_node(canopen_t *canopen, const canopen_context_t *context, uint8_t node) {
    const bool allowed = (node >= 1u && node <= CANOPEN_NODE_MAX) || node == CANOPEN_NODE_NONE;
    canopen->lss.node = allowed ? node : canopen->lss.node;
    respond(canopen, context, CONFIGURE_NODE, allowed ? DONE : REFUSED);
}

static void configure(canopen_t *canopen, const canopen_context_t *context, const uint8_t *data) {
    switch (data[0]) {
    case CONFIGURE_NODE:
        configure_node(canopen, context, data[1]);
        break;
    case CONFIGURE_BIT_RATE:
        respond(canopen, context, CONFIGURE_BIT_RATE, REFUSED);
        break;
    case STORE:
        store(canopen, context);
        break;
    case INQUIRE_NODE:
        respond(canopen, context, INQUIRE_NODE, canopen->node);
        break;
    default:
        if (data[0] - INQUIRE < (int)IDENTITIES && data[0] >= INQUIRE) {
            respond(canopen, context, data[0], identity(canopen, data[0] - (unsigned)INQUIRE));
        }
        break;
    }
}

COLD bool canopen_lss_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    const uint8_t *data = frame->data;
    if (frame->length != 8u || canopen->nmt == CANOPEN_NMT_OPERATIONAL) {
        return false;
    }
    const uint32_t value = data[1] | (uint32_t)data[2] << 8 | (uint32_t)data[3] << 16 | (uint32_t)data[4] << 24;
    if (data[0] == SWITCH_GLOBAL) {
        canopen->lss.configuring = data[1] == 1u;
        canopen->lss.selected = 0;
        return !canopen->lss.configuring && canopen->node == CANOPEN_NODE_NONE && canopen->lss.node != canopen->node;
    } else if (data[0] >= SWITCH_SELECTIVE && data[0] < SELECTED) {
        select(canopen, context, data[0] - (unsigned)SWITCH_SELECTIVE, value);
    } else if (data[0] >= IDENTIFY && data[0] < IDENTIFY + 6) {
        identify(canopen, context, data[0] - (unsigned)IDENTIFY, value);
    } else if (data[0] == IDENTIFY_WITHOUT_NODE && has_none(canopen)) {
        respond(canopen, context, IDENTIFIED_WITHOUT_NODE, 0);
    } else if (data[0] == FAST_SCAN) {
        scan(canopen, context, data, value);
    } else if (canopen->lss.configuring) {
        configure(canopen, context, data);
    }
    return false;
}
