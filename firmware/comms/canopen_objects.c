#include "comms/canopen_objects.h"

#include "comms/canopen_demand.h"
#include "comms/canopen_drive.h"
#include "comms/canopen_mapping.h"
#include "comms/canopen_position.h"
#include "comms/canopen_units.h"
#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

#define SAVE 0x65766173
#define LOAD 0x64616F6C
#define CAN_STORE 1 /* saves on command */
#define ERRORS_MAX 8u
#define SYNC_ID 0x80
#define POLARITIES 0xC0
#define PROFILE_TRAPEZOID 0
#define PROFILE_JERK_LIMITED 3

/* LSBs of following_error_deg and position_window_deg in a revolution. */
#define ERRORS_PER_REV (360 << 7)
#define WINDOWS_PER_REV (360 << 15)

COLD uint32_t canopen_size_of_bytes(const canopen_context_t *context, const canopen_object_t *object) {
    if (object->row.type != CANOPEN_STRING) {
        return sizeof context->set->values;
    }
    uint32_t size = 0;
    for (const char *text = canopen_strings[object->row.initial]; text[size] != '\0'; size++) {
    }
    return size;
}

COLD unsigned canopen_read_bytes(const canopen_context_t *context, const canopen_object_t *object, uint32_t offset,
                                 uint8_t *data, unsigned bytes) {
    const uint8_t *from = object->row.type == CANOPEN_STRING ? (const uint8_t *)canopen_strings[object->row.initial]
                                                             : (const uint8_t *)context->set->values;
    const uint32_t size = canopen_size_of_bytes(context, object);
    unsigned count = 0;
    for (; count < bytes && offset + count < size; count++) {
        data[count] = from[offset + count];
    }
    return count;
}

/* Faults of the log since 0 was written to their number. */
static uint32_t error_count(const canopen_t *canopen, const canopen_context_t *context) {
    const uint32_t newest = nvm_store_newest_fault(context->store);
    return newest > canopen->error_base ? fixed_min_u32(newest - canopen->error_base, ERRORS_MAX) : 0;
}

/* 0: there is no such fault, or its entry of the log cannot be read. */
static int32_t error_field(const canopen_t *canopen, const canopen_context_t *context, unsigned element) {
    nvm_store_fault_t fault;
    if (element >= error_count(canopen, context) ||
        !nvm_store_read_fault(context->store, context->hal, nvm_store_newest_fault(context->store) - element, &fault) ||
        fault.fault >= FAULT_COUNT) {
        return 0;
    }
    return (int32_t)(canopen_error_codes[fault.fault] | (uint32_t)fault.fault << 16);
}

/* Objects of the position loop. */
static int32_t read_position(const canopen_t *canopen, const canopen_context_t *context,
                             const canopen_object_t *object) {
    const int32_t *parameters = context->parameters->values;
    switch (object->row.value) {
    case CANOPEN_FROM_POSITION_DEMAND:
        return canopen_position_units(canopen, canopen->place.reference);
    case CANOPEN_FROM_POSITION:
        return canopen_position_units(canopen, canopen->place.position);
    case CANOPEN_FROM_POSITION_ERROR:
        return canopen_position_units(canopen, canopen->place.error);
    case CANOPEN_FROM_FOLLOWING_WINDOW:
        return canopen_distance_units(canopen, parameters[PARAMETER_FOLLOWING_ERROR_DEG], ERRORS_PER_REV);
    case CANOPEN_FROM_POSITION_WINDOW:
        return canopen_distance_units(canopen, parameters[PARAMETER_POSITION_WINDOW_DEG], WINDOWS_PER_REV);
    case CANOPEN_FROM_HOMING_METHOD:
        return canopen_homing_number(parameters[PARAMETER_HOMING_METHOD]);
    default: /* CANOPEN_FROM_HOMING_SPEED */
        return canopen_rpm_units(canopen, parameters[PARAMETER_HOMING_SPEED_RPM]);
    }
}

/* Objects that parts of the drive own. */
static int32_t read_drive(const canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object) {
    const canopen_measured_t *measured = &canopen->measured;
    switch (object->row.value) {
    case CANOPEN_FROM_PARAMETER:
        return context->parameters->values[object->instance];
    case CANOPEN_FROM_ERROR_CODE:
        return canopen_drive_error_code(canopen);
    case CANOPEN_FROM_STATUSWORD:
        return canopen_drive_statusword(canopen);
    case CANOPEN_FROM_MODE_DISPLAY:
        return canopen->drive.mode;
    case CANOPEN_FROM_VELOCITY_DEMAND:
        return canopen_velocity(canopen, canopen_demand_velocity(canopen));
    case CANOPEN_FROM_VELOCITY:
        return canopen_velocity(canopen, canopen_speed_of_machine(measured->speed));
    case CANOPEN_FROM_TORQUE_DEMAND:
        return fixed_clamp(canopen_torque_of_q8(measured->reference_q8), INT16_MIN, INT16_MAX);
    case CANOPEN_FROM_TORQUE:
        return fixed_clamp(canopen_torque_of_q8(measured->torque_q8), INT16_MIN, INT16_MAX);
    case CANOPEN_FROM_VOLTAGE:
        return (int32_t)canopen_milli_volts(measured->voltage_q6);
    case CANOPEN_FROM_RATED_TORQUE:
        return (int32_t)canopen_rated_torque();
    case CANOPEN_FROM_MAX_TORQUE:
        return fixed_clamp(canopen_torque(context->parameters->values[PARAMETER_TORQUE_MAX_NM]), 0, UINT16_MAX);
    case CANOPEN_FROM_MODES:
        return canopen_demand_modes(canopen);
    default:
        return read_position(canopen, context, object);
    }
}

static int32_t read_from(const canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object) {
    switch (object->row.value) {
    case CANOPEN_FROM_ERROR_REGISTER:
        return canopen_drive_error_register(canopen);
    case CANOPEN_FROM_ERROR_COUNT:
        return (int32_t)error_count(canopen, context);
    case CANOPEN_FROM_ERROR_FIELD:
        return error_field(canopen, context, object->element);
    case CANOPEN_FROM_STORE:
    case CANOPEN_FROM_RESTORE:
        return CAN_STORE;
    case CANOPEN_FROM_EMERGENCY_ID:
        return 0x80 + canopen->node;
    case CANOPEN_FROM_SDO_REQUEST_ID:
        return 0x600 + canopen->node;
    case CANOPEN_FROM_SDO_RESPONSE_ID:
        return 0x580 + canopen->node;
    case CANOPEN_FROM_REVISION:
        return (int32_t)machine_tables.machine_hash;
    case CANOPEN_FROM_SERIAL:
        return canopen->serial;
    case CANOPEN_FROM_DROPPED:
        return canopen->dropped;
    default:
        return read_drive(canopen, context, object);
    }
}

COLD uint32_t canopen_read(const canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object,
                           int32_t *value) {
    const unsigned slot = canopen_slot(object);
    const bool from = (object->row.access & CANOPEN_FROM) != 0;
    *value = (object->row.access & CANOPEN_CONSTANT) != 0 ? object->row.initial
             : slot < CANOPEN_VALUE_COUNT                 ? canopen->values[slot]
                                                          : read_from(canopen, context, object);
    return from && object->row.value == CANOPEN_FROM_ERROR_FIELD && *value == 0 ? CANOPEN_NO_DATA : CANOPEN_DONE;
}

static uint32_t check_limits(const canopen_object_t *object, int32_t value) {
    const canopen_row_t *row = &object->row;
    const bool below = canopen_is_signed(object) ? value < row->minimum : (uint32_t)value < (uint32_t)row->minimum;
    const bool above = canopen_is_signed(object) ? value > row->maximum : (uint32_t)value > (uint32_t)row->maximum;
    return below ? CANOPEN_BELOW : above ? CANOPEN_ABOVE : CANOPEN_DONE;
}

/* Store and restore have a signature; of errors none but the deletion of all is written (CiA 301, 7.5.2.4). */
static uint32_t check_signature(const canopen_object_t *object, int32_t value) {
    switch (object->row.value) {
    case CANOPEN_FROM_STORE:
        return value == SAVE ? CANOPEN_DONE : CANOPEN_NOT_STORED;
    case CANOPEN_FROM_RESTORE:
        return value == LOAD ? CANOPEN_DONE : CANOPEN_NOT_STORED;
    case CANOPEN_FROM_ERROR_COUNT:
        return value == 0 ? CANOPEN_DONE : CANOPEN_VALUE;
    default:
        return CANOPEN_DONE;
    }
}

/* A node is watched by one entry; one without a node or a time is not used (CiA 301, 7.5.2.19). */
static uint32_t check_consumer(const canopen_t *canopen, unsigned entry, int32_t value) {
    for (unsigned i = 0; i < CANOPEN_CONSUMERS && value >> 16 != 0 && (value & UINT16_MAX) != 0; i++) {
        const int32_t other = canopen->values[CANOPEN_VALUE_CONSUMER + i];
        if (i != entry && other >> 16 == value >> 16 && (other & UINT16_MAX) != 0) {
            return CANOPEN_INCOMPATIBLE;
        }
    }
    return CANOPEN_DONE;
}

/* Values of a variable within its limits that are not allowed. */
static uint32_t check_choice(const canopen_t *canopen, const canopen_object_t *object, int32_t value) {
    bool allowed;
    switch (object->row.value) {
    case CANOPEN_VALUE_MODE:
        allowed = canopen_demand_has_mode(canopen, value);
        break;
    case CANOPEN_VALUE_QUICK_STOP_OPTION:
        allowed = value != 3 && value != 4;
        break;
    case CANOPEN_VALUE_PROFILE_TYPE:
        allowed = value == PROFILE_TRAPEZOID || value == PROFILE_JERK_LIMITED;
        break;
    case CANOPEN_VALUE_POSITION_MIN:
        return value < canopen->values[CANOPEN_VALUE_POSITION_MAX] ? CANOPEN_DONE : CANOPEN_OUT_OF_ORDER;
    case CANOPEN_VALUE_POSITION_MAX:
        return value > canopen->values[CANOPEN_VALUE_POSITION_MIN] ? CANOPEN_DONE : CANOPEN_OUT_OF_ORDER;
    case CANOPEN_VALUE_POLARITY:
        allowed = (value & ~POLARITIES) == 0;
        break;
    case CANOPEN_VALUE_CONSUMER:
        return check_consumer(canopen, object->element, value);
    case CANOPEN_VALUE_SYNC_ID:
        allowed = canopen_mapping_is_free_id((uint32_t)value) || value == SYNC_ID;
        break;
    default:
        return canopen_mapping_check(canopen, object, value);
    }
    return allowed ? CANOPEN_DONE : CANOPEN_VALUE;
}

COLD uint32_t canopen_check(const canopen_t *canopen, const canopen_object_t *object, int32_t value) {
    if ((object->row.access & CANOPEN_WRITE) == 0) {
        return CANOPEN_READ_ONLY;
    }
    const uint32_t limits = check_limits(object, value);
    if (limits != CANOPEN_DONE || (object->row.access & CANOPEN_CONSTANT) != 0) { /* a constant is what it is */
        return limits;
    }
    return (object->row.access & CANOPEN_FROM) != 0 ? check_signature(object, value)
                                                    : check_choice(canopen, object, value);
}

COLD uint32_t canopen_verdict(const parameters_verdict_t *verdict) {
    switch (verdict->status) {
    case PARAMETER_STATUS_DONE:
        return CANOPEN_DONE;
    case PARAMETER_STATUS_OUT_OF_RANGE:
        return CANOPEN_VALUE;
    case PARAMETER_STATUS_NOT_WHILE_RUNNING:
        return CANOPEN_STATE;
    case PARAMETER_STATUS_MEMORY:
        return CANOPEN_HARDWARE;
    default: /* a contradiction of parameters, or of one and the supply */
        return CANOPEN_INCOMPATIBLE;
    }
}

static uint32_t write_parameter(const canopen_context_t *context, unsigned index, int32_t value) {
    const parameters_verdict_t verdict =
        parameter_set_one(context->set, context->parameters, context->conditions, index, value);
    return canopen_verdict(&verdict);
}

static uint32_t write_max_torque(const canopen_context_t *context, int32_t value) {
    const int32_t raw = canopen_torque_q24(value * 1000);
    const parameter_row_t *limits = parameters_row(PARAMETER_TORQUE_MAX_NM);
    return raw > limits->maximum ? CANOPEN_ABOVE : write_parameter(context, PARAMETER_TORQUE_MAX_NM, raw);
}

/* A correct signature stores: not in a run, and no values that have changed in memory. */
static uint32_t write_store(const canopen_context_t *context) {
    if (context->conditions->running) {
        return CANOPEN_STATE;
    }
    if (!parameters_intact(context->parameters)) {
        return CANOPEN_HARDWARE;
    }
    parameter_store_save(context->store);
    return CANOPEN_DONE;
}

/* Parameters of the position loop in units of the profile. */
static uint32_t write_position(const canopen_t *canopen, const canopen_context_t *context,
                               const canopen_object_t *object, int32_t value) {
    switch (object->row.value) {
    case CANOPEN_FROM_FOLLOWING_WINDOW:
        return write_parameter(context, PARAMETER_FOLLOWING_ERROR_DEG,
                               canopen_distance(canopen, value, ERRORS_PER_REV));
    case CANOPEN_FROM_POSITION_WINDOW:
        return write_parameter(context, PARAMETER_POSITION_WINDOW_DEG,
                               canopen_distance(canopen, value, WINDOWS_PER_REV));
    case CANOPEN_FROM_HOMING_METHOD: /* one that the drive has not is beyond the parameter's range */
        return write_parameter(context, PARAMETER_HOMING_METHOD, (int32_t)canopen_homing_method(value));
    case CANOPEN_FROM_HOMING_SPEED:
        return write_parameter(context, PARAMETER_HOMING_SPEED_RPM, canopen_rpm(canopen, value));
    default:
        return CANOPEN_READ_ONLY;
    }
}

static uint32_t write_from(canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object,
                           int32_t value) {
    switch (object->row.value) {
    case CANOPEN_FROM_PARAMETER:
        return write_parameter(context, object->instance, value);
    case CANOPEN_FROM_MAX_TORQUE:
        return write_max_torque(context, value);
    case CANOPEN_FROM_STORE:
        return write_store(context);
    case CANOPEN_FROM_RESTORE:
        canopen->restore = true;
        return CANOPEN_DONE;
    case CANOPEN_FROM_ERROR_COUNT:
        canopen->error_base = nvm_store_newest_fault(context->store);
        return CANOPEN_DONE;
    default:
        return write_position(canopen, context, object, value);
    }
}

COLD uint32_t canopen_write(canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object,
                            int32_t value) {
    const unsigned slot = canopen_slot(object);
    if (slot >= CANOPEN_VALUE_COUNT) {
        const bool constant = (object->row.access & CANOPEN_CONSTANT) != 0;
        return constant ? CANOPEN_DONE : write_from(canopen, context, object, value);
    }
    canopen->values[slot] = value;
    if (slot == CANOPEN_VALUE_CONTROLWORD) {
        canopen_drive_control(canopen, context);
    } else if (slot - CANOPEN_VALUE_CONSUMER < CANOPEN_CONSUMERS) {
        canopen->consumer[slot - CANOPEN_VALUE_CONSUMER] = (canopen_watch_t){0};
    } else {
        canopen_demand_target(canopen, slot);
        canopen_mapping_written(canopen, object);
    }
    return CANOPEN_DONE;
}

COLD void canopen_reset_values(canopen_t *canopen, bool node) {
    for (unsigned at = 0; at < CANOPEN_ROWS; at++) {
        const canopen_row_t *row = &canopen_rows[at];
        const bool variable = (row->access & (CANOPEN_FROM | CANOPEN_CONSTANT)) == 0;
        if (variable && (node || (row->access & CANOPEN_COMMUNICATION) != 0)) {
            for (unsigned i = 0; i < (unsigned)row->instances * row->count; i++) {
                canopen->values[row->value + i] = row->initial;
            }
        }
    }
    canopen_mapping_reset(canopen);
}
