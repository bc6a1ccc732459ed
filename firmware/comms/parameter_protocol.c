#include "comms/parameter_protocol.h"

#include "drive_codec.h"

#define OPERATION(name) DRIVE_PARAMETER_REQUEST_OPERATION_##name##_CHOICE
#define STATUS(name) DRIVE_PARAMETER_RESPONSE_STATUS_##name##_CHOICE

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

static uint8_t write_value(parameters_t *parameters, bool writable, unsigned index, int32_t value) {
    if (!writable) {
        return STATUS(NOT_WHILE_RUNNING);
    }
    return parameters_set(parameters, index, value) == PARAMETER_DONE ? STATUS(DONE) : STATUS(OUT_OF_RANGE);
}

void parameter_protocol_answer(parameters_t *parameters, bool writable, const hal_can_frame_t *request,
                               hal_can_frame_t *response) {
    struct drive_parameter_request_t asked;
    drive_parameter_request_unpack(&asked, request->data, request->length);
    struct drive_parameter_response_t answer = {
        .operation = asked.operation, .index = asked.index, .part = asked.part, .status = STATUS(DONE)};

    if (asked.operation > OPERATION(UNIT)) {
        answer.status = STATUS(UNKNOWN_OPERATION);
    } else if (asked.index >= PARAMETER_COUNT) {
        answer.status = STATUS(NO_SUCH_PARAMETER);
    } else {
        const parameter_row_t *row = parameters_row(asked.index);
        switch (asked.operation) {
        case OPERATION(WRITE):
            answer.status = write_value(parameters, writable, asked.index, asked.value);
            answer.value = parameters->values[asked.index];
            break;
        case OPERATION(MINIMUM):
            answer.value = row->minimum;
            break;
        case OPERATION(MAXIMUM):
            answer.value = row->maximum;
            break;
        case OPERATION(DEFAULT):
            answer.value = parameters->defaults[asked.index];
            break;
        case OPERATION(FRACTION_BITS):
            answer.value = row->fraction_bits;
            break;
        case OPERATION(NAME):
            answer.value = text_part(row->name, asked.part);
            break;
        case OPERATION(UNIT):
            answer.value = text_part(row->unit, asked.part);
            break;
        case OPERATION(READ):
        default:
            answer.value = parameters->values[asked.index];
            break;
        }
    }
    *response =
        (hal_can_frame_t){.identifier = DRIVE_PARAMETER_RESPONSE_FRAME_ID, .length = DRIVE_PARAMETER_RESPONSE_LENGTH};
    drive_parameter_response_pack(response->data, &answer, sizeof response->data);
}
