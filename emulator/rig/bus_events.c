#include "rig/bus_events.h"

#include "rig/truth.h"

void bus_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    can_bus_delivery_t delivery;
    const bool complete = can_bus_step(&rig->bus, &delivery);
    rig->scheduler.due_ns[EVENT_CAN] = rig->bus.next_event_ns;
    if (!complete) {
        return;
    }
    transport_frame_t frame;
    transport_frame_from_hal(&delivery.frame, &frame);
    if (delivery.to_clients) {
        transport_send(rig->config.transport, now_ns,
                       delivery.from_client ? TRANSPORT_FROM_CLIENT_ON_BUS
                                            : (delivery.from_drive ? TRANSPORT_FROM_EMULATOR : TRANSPORT_FROM_OTHER),
                       &frame);
    }
    for (; rig; rig = rig->next) {
        if (((unsigned)delivery.to_drives >> rig->board.bus_drive & 1u) != 0) {
            board_deliver(&rig->board, &delivery.frame);
        }
    }
}

void truth_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    transport_frame_t frames[TRUTH_FRAMES_MAX];
    rig->scheduler.due_ns[EVENT_TRUTH] += rig->truth_period_ns;
    plant_advance(&rig->plant, now_ns);
    const unsigned count = truth_pack(&rig->plant, &rig->heat, frames);
    for (unsigned i = 0; i < count; ++i) {
        transport_frame_set_node(&frames[i], rig->config.node);
        transport_send(rig->config.transport, now_ns, TRANSPORT_FROM_EMULATOR, &frames[i]);
    }
}
