#include "comms/comms.h"

#include "comms/memory_protocol.h"
#include "comms/parameter_protocol.h"

#define US_PER_MS 1000u

void comms_init(comms_t *comms, uint32_t time_us) {
    *comms = (comms_t){0};
    bus_monitor_init(&comms->bus, time_us);
    commands_init(&comms->commands);
    telemetry_init(&comms->telemetry, time_us);
}

static void flush(comms_t *comms, hal_t *hal) {
    telemetry_flush(&comms->telemetry, hal);
    const hal_can_frame_t *frame;
    while (frame_queue_peek(&comms->telemetry.queue) == NULL && (frame = frame_queue_peek(&comms->responses)) != NULL &&
           hal_can_transmit(hal, frame)) {
        frame_queue_pop(&comms->responses);
    }
}

static bool receive(comms_t *comms, hal_t *hal, parameters_t *parameters, bool writable, uint32_t time_us) {
    hal_can_frame_t frame;
    for (int i = 0; i < COMMS_FRAMES_PER_CALL; i++) {
        if (frame_queue_free(&comms->responses) == 0 || !hal_can_receive(hal, &frame)) {
            return false;
        }
        switch (commands_receive(&comms->commands, &frame, time_us, &comms->command)) {
        case COMMANDS_COMMAND:
            return true;
        case COMMANDS_PARAMETER_REQUEST: {
            hal_can_frame_t response;
            if (!memory_protocol_respond(comms->store, hal, parameters, writable, &frame, &response)) {
                parameter_protocol_respond(parameters, writable, &frame, &response);
            }
            frame_queue_push(&comms->responses, &response);
            break;
        }
        case COMMANDS_REJECTED:
            bus_monitor_check(&comms->bus, &frame, time_us);
            break;
        default:
            break;
        }
    }
    return false;
}

bool comms_background(comms_t *comms, hal_t *hal, parameters_t *parameters, bool writable, uint32_t time_us) {
    commands_check_timeout(&comms->commands, time_us,
                           (uint32_t)parameters->values[PARAMETER_COMMAND_TIMEOUT_MS] * US_PER_MS);
    const bool commanded = receive(comms, hal, parameters, writable, time_us);
    flush(comms, hal);
    return commanded;
}

void comms_telemetry(comms_t *comms, hal_t *hal, drive_telemetry_t *values) {
    telemetry_cycle(&comms->telemetry, values);
    flush(comms, hal);
}
