/* [SR-56] */
#include "comms/parameter_set.h"

#include "comms/e2e.h"
#include "drive_codec.h"
#include "fixed/crc32.h"

/* [SR-56] [SR-57] */
static void begin(parameter_set_t *set, const parameters_t *parameters, bool defaults) {
    set->begun = true;
    set->crc = 0;
    set->written = defaults ? UINT64_MAX : 0;
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        set->values[i] = defaults ? parameters_default(parameters, i) : parameters->values[i];
    }
    set->sum = parameters_sum(set->values);
}

static void stage(parameter_set_t *set, unsigned index, int32_t value) {
    set->sum += (uint32_t)value - (uint32_t)set->values[index];
    set->values[index] = value;
    set->written |= index < 64 ? UINT64_C(1) << index : 0; /* the others are tunable */
}

void parameter_set_write(parameter_set_t *set, const hal_can_frame_t *frame) {
    struct drive_parameter_write_t message;
    (void)drive_parameter_write_unpack(&message, frame->data, frame->length);
    stage(set, message.index, message.value);
    set->crc = crc32_continue(set->crc, frame->data + E2E_HEADER_BYTES, frame->length - E2E_HEADER_BYTES);
}

/* [SR-56] [SR-57] */
static parameters_verdict_t apply(const parameter_set_t *set, uint32_t crc, parameters_t *parameters,
                                  const parameters_conditions_t *conditions) {
    if (!set->begun || crc != set->crc) {
        return (parameters_verdict_t){PARAMETER_STATUS_INCOMPLETE, 0, 0};
    }
    if (set->sum != parameters_sum(set->values)) {
        return (parameters_verdict_t){PARAMETER_STATUS_MEMORY, 0, 0};
    }
    const parameters_verdict_t verdict = parameters_check(parameters, set->values, set->written, conditions);
    if (verdict.status == PARAMETER_STATUS_DONE) {
        parameters_apply(parameters, set->values);
    }
    return verdict;
}

bool parameter_set_begin(parameter_set_t *set, const parameters_t *parameters, bool defaults) {
    if (!parameters_intact(parameters)) {
        return false;
    }
    begin(set, parameters, defaults);
    return true;
}

void parameter_set_stage(parameter_set_t *set, unsigned index, int32_t value) {
    stage(set, index, value);
}

void parameter_set_stage_byte(parameter_set_t *set, unsigned offset, uint8_t byte) {
    const unsigned index = offset / sizeof set->values[0], shift = 8u * (offset % sizeof set->values[0]);
    const uint32_t kept = (uint32_t)set->values[index] & ~((uint32_t)UINT8_MAX << shift);
    stage(set, index, (int32_t)(kept | (uint32_t)byte << shift));
}

parameters_verdict_t parameter_set_finish(parameter_set_t *set, parameters_t *parameters,
                                          const parameters_conditions_t *conditions) {
    const parameters_verdict_t verdict = apply(set, set->crc, parameters, conditions);
    set->begun = false;
    return verdict;
}

parameters_verdict_t parameter_set_one(parameter_set_t *set, parameters_t *parameters,
                                       const parameters_conditions_t *conditions, unsigned index, int32_t value) {
    if (!parameter_set_begin(set, parameters, false)) {
        return (parameters_verdict_t){PARAMETER_STATUS_MEMORY, 0, 0};
    }
    stage(set, index, value);
    return parameter_set_finish(set, parameters, conditions);
}

/* [SR-56] [SR-57] */
static parameters_verdict_t save(nvm_store_t *store, bool running) {
    if (running) {
        return (parameters_verdict_t){PARAMETER_STATUS_NOT_WHILE_RUNNING, 0, 0};
    }
    parameter_store_save(store);
    return (parameters_verdict_t){PARAMETER_STATUS_DONE, 0, 0};
}

bool parameter_set_control(parameter_set_t *set, bool armed, parameters_t *parameters, nvm_store_t *store,
                           const parameters_conditions_t *conditions, const hal_can_frame_t *frame,
                           hal_can_frame_t *response_frame) {
    struct drive_parameter_set_control_t message;
    (void)drive_parameter_set_control_unpack(&message, frame->data, frame->length);
    const parameter_set_step_t step = (parameter_set_step_t)message.step;
    parameters_verdict_t verdict = {armed ? PARAMETER_STATUS_DONE : PARAMETER_STATUS_NOT_ARMED, 0, 0};
    const bool begins = step == PARAMETER_SET_STEP_BEGIN || step == PARAMETER_SET_STEP_BEGIN_DEFAULTS;
    if (armed) {
        if (!parameters_intact(parameters)) {
            verdict.status = PARAMETER_STATUS_MEMORY;
        } else if (begins) {
            begin(set, parameters, step == PARAMETER_SET_STEP_BEGIN_DEFAULTS);
        } else if (step == PARAMETER_SET_STEP_APPLY) {
            verdict = apply(set, message.check, parameters, conditions);
        } else if (step == PARAMETER_SET_STEP_SAVE) {
            verdict = save(store, conditions->running);
        }
    }
    const struct drive_parameter_response_t response = {
        .operation = PARAMETER_OPERATION_SET_CONTROL,
        .index = verdict.index,
        .part = verdict.other,
        .status = (uint8_t)verdict.status,
        .value = (int32_t)(message.counter * 256u + message.step),
    };
    *response_frame =
        (hal_can_frame_t){.identifier = DRIVE_PARAMETER_RESPONSE_FRAME_ID, .length = DRIVE_PARAMETER_RESPONSE_LENGTH};
    (void)drive_parameter_response_pack(response_frame->data, &response, sizeof response_frame->data);
    return armed && !begins;
}
