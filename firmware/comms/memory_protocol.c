#include "comms/memory_protocol.h"

#include "comms/units.h"
#include "drive_codec.h"
#include "fixed/fixed.h"

/* Parts of the responses, as drive.dbc lists them. */
enum {
    MEMORY_SAVING,
    MEMORY_ORIGIN,
    MEMORY_START,
    MEMORY_NEWEST_FAULT,
    MEMORY_SETS,
    MEMORY_STACK_UNUSED,
    MEMORY_CODE_PASSES
};
enum { ORIGIN_DEFAULTS, ORIGIN_MEMORY, ORIGIN_UNUSABLE };
enum {
    LOG_FAULT,
    LOG_STATE,
    LOG_CHECKS,
    LOG_START,
    LOG_TIME,
    LOG_TIME_WRAPS,
    LOG_SPEED,
    LOG_VOLTAGE,
    LOG_CURRENT,
    LOG_TORQUE,
    LOG_CURRENT_A, /* of four phases */
    LOG_ANGLE = LOG_CURRENT_A + 4,
    LOG_SELF_TEST,
    LOG_PHASES,
    LOG_CURRENT_E /* of the others */
};

/* Phase whose current a part of a fault has; HAL_PHASES_MAX or more: none. */
static unsigned phase_of(unsigned part) {
    return part >= LOG_CURRENT_A && part < LOG_ANGLE ? part - LOG_CURRENT_A
           : part >= LOG_CURRENT_E                   ? part - LOG_CURRENT_E + 4
                                                     : HAL_PHASES_MAX;
}

static uint16_t largest(const uint16_t *current_q9) {
    uint16_t largest_q9 = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        largest_q9 = (uint16_t)fixed_max_u32(current_q9[phase], largest_q9);
    }
    return largest_q9;
}

static parameter_status_t memory_item(const nvm_store_t *store, const self_test_t *test, unsigned part,
                                      int32_t *value) {
    switch (part) {
    case MEMORY_SAVING:
        *value = (int32_t)store->saving;
        break;
    case MEMORY_ORIGIN:
        *value = store->loaded ? ORIGIN_MEMORY : store->rejected ? ORIGIN_UNUSABLE : ORIGIN_DEFAULTS;
        break;
    case MEMORY_START:
        *value = (int32_t)store->start;
        break;
    case MEMORY_NEWEST_FAULT:
        *value = (int32_t)nvm_store_newest_fault(store);
        break;
    case MEMORY_SETS:
        *value = (int32_t)store->parameters.sequence;
        break;
    case MEMORY_STACK_UNUSED:
        *value = (int32_t)(test->stack_unused * sizeof(uint32_t));
        break;
    case MEMORY_CODE_PASSES:
        *value = (int32_t)test->code_passes;
        break;
    default:
        return PARAMETER_STATUS_NO_SUCH_ENTRY;
    }
    return PARAMETER_STATUS_DONE;
}

/* False: an entry has no such part. */
static bool fault_part(const nvm_store_fault_t *fault, unsigned part, int32_t *value) {
    switch (part) {
    case LOG_FAULT:
        *value = fault->fault;
        break;
    case LOG_STATE:
        *value = fault->state;
        break;
    case LOG_CHECKS:
        *value = (int32_t)fault->checks;
        break;
    case LOG_START:
        *value = (int32_t)fault->start;
        break;
    case LOG_TIME:
        *value = (int32_t)fault->time_us;
        break;
    case LOG_TIME_WRAPS:
        *value = fault->time_wraps;
        break;
    case LOG_SPEED:
        *value = units_quarter_rpm(units_milli_rpm(fault->speed_q22));
        break;
    case LOG_VOLTAGE:
        *value = fault->dc_link_voltage_q6;
        break;
    case LOG_CURRENT:
        *value = largest(fault->current_q9);
        break;
    case LOG_TORQUE:
        *value = units_torque_q8(fault->torque_reference_q24);
        break;
    case LOG_ANGLE:
        *value = fault->angle;
        break;
    case LOG_SELF_TEST:
        *value = (int32_t)(fault->self_test | (uint32_t)fault->sensors << 16);
        break;
    case LOG_PHASES:
        *value = fault->phases;
        break;
    default:
        if (phase_of(part) >= HAL_PHASES_MAX) {
            return false;
        }
        *value = fault->current_q9[phase_of(part)];
        break;
    }
    return true;
}

static parameter_status_t fault_item(const nvm_store_t *store, const hal_t *hal, uint32_t sequence, unsigned part,
                                     int32_t *value) {
    nvm_store_fault_t fault;
    const bool found = nvm_store_read_fault(store, hal, sequence, &fault) && fault_part(&fault, part, value);
    return found ? PARAMETER_STATUS_DONE : PARAMETER_STATUS_NO_SUCH_ENTRY;
}

bool memory_protocol_respond(const nvm_store_t *store, const self_test_t *test, const hal_t *hal,
                             const hal_can_frame_t *frame, hal_can_frame_t *response_frame) {
    struct drive_parameter_request_t request;
    (void)drive_parameter_request_unpack(&request, frame->data, frame->length);
    struct drive_parameter_response_t response = {
        .operation = request.operation, .index = request.index, .part = request.part, .value = 0};
    parameter_status_t status = PARAMETER_STATUS_UNPROTECTED;

    switch (request.operation) {
    case PARAMETER_OPERATION_SAVE:
    case PARAMETER_OPERATION_RESTORE_DEFAULTS:
        break;
    case PARAMETER_OPERATION_MEMORY:
        status = memory_item(store, test, request.part, &response.value);
        break;
    case PARAMETER_OPERATION_FAULT_LOG:
        status = fault_item(store, hal, (uint32_t)request.value, request.part, &response.value);
        break;
    default:
        return false;
    }
    response.status = (uint8_t)status;
    *response_frame =
        (hal_can_frame_t){.identifier = DRIVE_PARAMETER_RESPONSE_FRAME_ID, .length = DRIVE_PARAMETER_RESPONSE_LENGTH};
    (void)drive_parameter_response_pack(response_frame->data, &response, sizeof response_frame->data);
    return true;
}
