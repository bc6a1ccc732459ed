#include "comms/comms.h"

#include "comms/parameter_protocol.h"

#define US_PER_MS 1000u

void comms_init(comms_t *comms, uint8_t phases, uint32_t control_rate_hz, uint32_t time_us) {
    *comms = (comms_t){0};
    commands_init(&comms->commands);
    telemetry_init(&comms->telemetry, phases, control_rate_hz, time_us);
}

static void flush(comms_t *comms, hal_t *hal) {
    telemetry_flush(&comms->telemetry, hal);
    const hal_can_frame_t *frame;
    while (frame_queue_head(&comms->telemetry.queue) == NULL && (frame = frame_queue_head(&comms->responses)) != NULL &&
           hal_can_transmit(hal, frame)) {
        frame_queue_drop_head(&comms->responses);
    }
}

static bool receive(comms_t *comms, hal_t *hal, parameters_t *parameters, bool writable, uint32_t time_us) {
    hal_can_frame_t frame;
    for (int i = 0; i < COMMS_FRAMES_PER_CALL; i++) {
        if (frame_queue_room(&comms->responses) == 0 || !hal_can_receive(hal, &frame)) {
            return false;
        }
        switch (commands_take(&comms->commands, &frame, time_us, &comms->command)) {
        case COMMANDS_COMMAND:
            return true;
        case COMMANDS_PARAMETER_REQUEST: {
            hal_can_frame_t response;
            parameter_protocol_answer(parameters, writable, &frame, &response);
            frame_queue_put(&comms->responses, &response);
            break;
        }
        case COMMANDS_REFUSED:
        default:
            break;
        }
    }
    return false;
}

bool comms_background(comms_t *comms, hal_t *hal, parameters_t *parameters, bool writable, uint32_t time_us) {
    commands_watch(&comms->commands, time_us, (uint32_t)parameters->values[PARAMETER_COMMAND_TIMEOUT_MS] * US_PER_MS);
    const bool commanded = receive(comms, hal, parameters, writable, time_us);
    flush(comms, hal);
    return commanded;
}

void comms_telemetry(comms_t *comms, hal_t *hal, const telemetry_snapshot_t *snapshot) {
    telemetry_cycle(&comms->telemetry, snapshot, &comms->commands.counters, hal_can_receive_overflows(hal));
    flush(comms, hal);
}
