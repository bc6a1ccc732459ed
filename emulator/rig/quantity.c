#include "rig/quantity.h"

#include <string.h>

#include "rig_codec.h"

/* One signal of RIG_SET: range check and conversion are the generated codec's. */
#define READ(signal)                                                                                                   \
    in_range = rig_set_##signal##_is_in_range(message.signal);                                                         \
    setting->value = rig_set_##signal##_decode(message.signal);                                                        \
    break

uint8_t quantity_decode(const uint8_t data[8], quantity_setting_t *setting) {
    struct rig_set_t message;
    memset(&message, 0, sizeof message);
    rig_set_unpack(&message, data, RIG_SET_LENGTH);
    setting->quantity = message.quantity;
    setting->at_us = message.at_us;
    setting->value = 0.0;
    bool in_range = false;
    switch (message.quantity) {
    case RIG_SET_QUANTITY_LOAD_TORQUE_NM_CHOICE:
        READ(load_torque_nm);
    case RIG_SET_QUANTITY_SUPPLY_VOLTAGE_V_CHOICE:
        READ(supply_voltage_v);
    case RIG_SET_QUANTITY_ENCODER_FAULT_CHOICE:
        READ(encoder_fault);
    case RIG_SET_QUANTITY_INTERRUPT_TIME_US_CHOICE:
        READ(interrupt_time_us);
    case RIG_SET_QUANTITY_CURRENT_SENSOR_GAIN_CHOICE:
        READ(current_sensor_gain);
    case RIG_SET_QUANTITY_TRUTH_PERIOD_US_CHOICE:
        READ(truth_period_us);
    case RIG_SET_QUANTITY_CURRENT_NOISE_A_CHOICE:
        READ(current_noise_a);
    case RIG_SET_QUANTITY_CURRENT_SENSOR_OFFSET_A_CHOICE:
        READ(current_sensor_offset_a);
    case RIG_SET_QUANTITY_CURRENT_SENSOR_LIMIT_A_CHOICE:
        READ(current_sensor_limit_a);
    case RIG_SET_QUANTITY_CURRENT_SENSOR_DELAY_US_CHOICE:
        READ(current_sensor_delay_us);
    case RIG_SET_QUANTITY_ENCODER_ECCENTRICITY_DEG_CHOICE:
        READ(encoder_eccentricity_deg);
    case RIG_SET_QUANTITY_FLUX_LINKAGE_GAIN_CHOICE:
        READ(flux_linkage_gain);
    case RIG_SET_QUANTITY_RESISTANCE_GAIN_CHOICE:
        READ(resistance_gain);
    case RIG_SET_QUANTITY_INERTIA_GAIN_CHOICE:
        READ(inertia_gain);
    case RIG_SET_QUANTITY_FRICTION_GAIN_CHOICE:
        READ(friction_gain);
    case RIG_SET_QUANTITY_ENCODER_OFFSET_DEG_CHOICE:
        READ(encoder_offset_deg);
    case RIG_SET_QUANTITY_MINIMUM_PULSE_NS_CHOICE:
        READ(minimum_pulse_ns);
    default:
        return RIG_SET_REPLY_STATUS_NO_SUCH_QUANTITY_CHOICE;
    }
    return in_range ? RIG_SET_REPLY_STATUS_DONE_CHOICE : RIG_SET_REPLY_STATUS_OUT_OF_RANGE_CHOICE;
}

bool quantity_queue_add(quantity_queue_t *queue, uint64_t at_ns, const quantity_setting_t *setting) {
    if (queue->count == QUANTITY_QUEUE) {
        return false;
    }
    unsigned place = queue->count++;
    for (; place > 0 && queue->entry[place - 1].at_ns > at_ns; --place) {
        queue->entry[place] = queue->entry[place - 1];
    }
    queue->entry[place].at_ns = at_ns;
    queue->entry[place].setting = *setting;
    return true;
}

uint64_t quantity_queue_next_ns(const quantity_queue_t *queue) {
    return queue->count > 0 ? queue->entry[0].at_ns : QUANTITY_NEVER;
}

quantity_setting_t quantity_queue_take(quantity_queue_t *queue) {
    quantity_setting_t setting = queue->entry[0].setting;
    memmove(&queue->entry[0], &queue->entry[1], --queue->count * sizeof queue->entry[0]);
    return setting;
}
