#include "comms/parameter_protocol.h"

#include "control/machine_tables.h"
#include "drive_codec.h"

#define CHARACTERS_PER_PART 4

static int32_t text_part(const char *text, unsigned part) {
    for (unsigned i = 0; i < part * CHARACTERS_PER_PART; i++) {
        if (text[i] == '\0') {
            return 0;
        }
    }
    uint32_t value = 0;
    text += part * CHARACTERS_PER_PART;
    for (unsigned i = 0; i < CHARACTERS_PER_PART && text[i] != '\0'; i++) {
        value |= (uint32_t)(uint8_t)text[i] << (8 * i);
    }
    return (int32_t)value;
}

void parameter_protocol_respond(const parameters_t *parameters, const hal_can_frame_t *frame,
                                hal_can_frame_t *response_frame) {
    struct drive_parameter_request_t request;
    (void)drive_parameter_request_unpack(&request, frame->data, frame->length);
    struct drive_parameter_response_t response = {
        .operation = request.operation, .index = request.index, .part = request.part, .status = PARAMETER_STATUS_DONE};

    if (request.operation > PARAMETER_OPERATION_UNIT) {
        response.status = PARAMETER_STATUS_UNKNOWN_OPERATION;
    } else if (request.index >= PARAMETER_COUNT) {
        response.status = PARAMETER_STATUS_NO_SUCH_PARAMETER;
    } else {
        const parameter_row_t *row = parameters_row(request.index);
        switch ((parameter_operation_t)request.operation) {
        case PARAMETER_OPERATION_WRITE:
            response.status = PARAMETER_STATUS_UNPROTECTED;
            response.value = parameters->values[request.index];
            break;
        case PARAMETER_OPERATION_MINIMUM:
            response.value = row->minimum;
            break;
        case PARAMETER_OPERATION_MAXIMUM:
            response.value = row->maximum;
            break;
        case PARAMETER_OPERATION_DEFAULT:
            response.value = parameters_default(parameters, request.index);
            break;
        case PARAMETER_OPERATION_FRACTION_BITS:
            // NOLINTNEXTLINE(bugprone-signed-char-misuse): a number, no character
            response.value = machine_tables.parameter_fraction_bits[request.index];
            break;
        case PARAMETER_OPERATION_NAME:
            response.value = text_part(parameters_name(request.index), request.part);
            break;
        case PARAMETER_OPERATION_UNIT:
            response.value = text_part(parameters_unit(request.index), request.part);
            break;
        default: /* PARAMETER_OPERATION_READ */
            response.value = parameters->values[request.index];
            break;
        }
    }
    *response_frame =
        (hal_can_frame_t){.identifier = DRIVE_PARAMETER_RESPONSE_FRAME_ID, .length = DRIVE_PARAMETER_RESPONSE_LENGTH};
    (void)drive_parameter_response_pack(response_frame->data, &response, sizeof response_frame->data);
}
