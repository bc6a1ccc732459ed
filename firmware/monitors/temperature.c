#include "monitors/temperature.h"

#include <string.h>

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "storage/fault.h"

#define DERATE_CODES (TEMPERATURE_DERATE_K * (1 << TEMPERATURE_CODE_BITS) / HAL_ADC_TEMPERATURE_SPAN_K)

/* At most 2^16: the limits of the table are below the largest code of a sound sensor. */
static int32_t code(int32_t limit_C) {
    return (limit_C - HAL_ADC_TEMPERATURE_ZERO_C) * (1 << TEMPERATURE_CODE_BITS) / HAL_ADC_TEMPERATURE_SPAN_K;
}

/* [SR-17] */
COLD temperature_parameters_t temperature_configure(const int32_t *values) {
    return (temperature_parameters_t){
        .limit = {code(values[PARAMETER_WINDING_LIMIT_C]), code(values[PARAMETER_INVERTER_LIMIT_C])},
        .torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM],
    };
}

/* [SR-18] */
COLD void temperature_init(temperature_t *temperature, uint32_t time_us) {
    *temperature = (temperature_t){.step_us = time_us - TEMPERATURE_STEP_US, .torque_limit_q24 = INT32_MAX};
    for (unsigned sensor = 0; sensor < HAL_ADC_TEMPERATURES; sensor++) {
        temperature->invalid[sensor] = TEMPERATURE_INVALID_MAX - 1;
    }
}

/* The highest valid reading of a part; not below the one before while a reading is not valid. [SR-17] [SR-18] */
static int32_t read_part(temperature_t *temperature, const hal_t *hal, temperature_part_t part, unsigned phases) {
    const unsigned first = part == TEMPERATURE_WINDING ? HAL_ADC_WINDING : HAL_ADC_INVERTER;
    const int32_t before = temperature->hottest[part];
    int32_t hottest = 0;
    for (unsigned phase = 0; phase < phases; phase++) {
        const uint16_t reading = hal_adc_temperature(hal, first + phase);
        uint8_t *invalid = &temperature->invalid[first + phase];
        if (reading >= HAL_ADC_TEMPERATURE_CODE_MIN && reading <= HAL_ADC_TEMPERATURE_CODE_MAX) {
            *invalid = 0;
            hottest = fixed_max(reading, hottest);
            continue;
        }
        hottest = fixed_max(before, hottest);
        if (*invalid < TEMPERATURE_INVALID_MAX) {
            ++*invalid;
        }
        if (*invalid == TEMPERATURE_INVALID_MAX) {
            temperature->failed_sensors[part] |= (uint8_t)(1u << phase);
        }
    }
    return hottest;
}

/* [SR-17] [SR-18] */
COLD void temperature_step(const temperature_parameters_t *parameters, temperature_t *temperature, const hal_t *hal,
                           unsigned phases, uint32_t time_us) {
    if (time_us - temperature->step_us < TEMPERATURE_STEP_US) {
        return;
    }
    temperature->step_us = time_us;
    (void)memset(temperature->failed_sensors, 0, sizeof temperature->failed_sensors);
    int32_t least_room = DERATE_CODES;
    for (temperature_part_t part = 0; part < TEMPERATURE_PARTS; part++) {
        const int32_t hottest = read_part(temperature, hal, part, phases);
        const int32_t room = parameters->limit[part] - hottest;
        temperature->hottest[part] = hottest;
        temperature->hot[part] = temperature->hot[part] ? room < DERATE_CODES : room <= 0;
        least_room = fixed_min(room, least_room);
    }
    const int64_t part_of_max =
        (int64_t)fixed_non_negative(parameters->torque_max_q24) * fixed_non_negative(least_room);
    temperature->torque_limit_q24 = (int32_t)fixed_divide(part_of_max, DERATE_CODES);
}

/* [SR-17] [SR-18] */
COLD uint32_t temperature_faults(const temperature_t *temperature) {
    const uint8_t *sensors = temperature->failed_sensors;
    const unsigned failed = sensors[TEMPERATURE_WINDING] | sensors[TEMPERATURE_INVERTER];
    return (temperature->hot[TEMPERATURE_WINDING] ? (uint32_t)FAULT_BIT(FAULT_WINDING_OVERLOAD) : 0) |
           (temperature->hot[TEMPERATURE_INVERTER] ? (uint32_t)FAULT_BIT(FAULT_INVERTER_OVERLOAD) : 0) |
           (failed != 0 ? (uint32_t)FAULT_BIT(FAULT_TEMPERATURE_SENSOR) : 0);
}
