#include "comms/trace_protocol.h"

#include <stddef.h>

#include "comms/units.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* Items of a period, two in a part, as drive.dbc lists them: the first phases', then the others'. */
enum { FIRST_PHASES = 4, MORE_PHASES = 2 };
enum { DC_LINK_VOLTAGE = FIRST_PHASES, ANGLE, SPEED, TORQUE_REFERENCE, UPPER };
enum { LOWER = UPPER + FIRST_PHASES, FIRST_ITEMS = LOWER + FIRST_PHASES, ITEMS = FIRST_ITEMS + 3 * MORE_PHASES };

/* As measure.c. */
static int32_t scaled(uint16_t counts, int32_t scale_q18) {
    return fixed_multiply_high(counts << 14, scale_q18);
}

static int32_t duty_q15(const control_parameters_t *parameters, uint16_t compare) {
    return (int32_t)fixed_divide((int64_t)compare << 15, parameters->period_ticks);
}

static int32_t current_q9(const control_parameters_t *parameters, const fault_trace_period_t *period, unsigned phase) {
    return scaled(period->adc.phase_current_counts[phase], parameters->current_scale_q18);
}

static uint16_t item_of_more(const control_parameters_t *parameters, const fault_trace_period_t *period,
                             unsigned number) {
    const unsigned quantity = number / MORE_PHASES, phase = FIRST_PHASES + number % MORE_PHASES;
    const hal_pwm_compare_t *compare = &period->compare;
    return phase >= HAL_PHASES_MAX ? 0
           : quantity == 0         ? (uint16_t)current_q9(parameters, period, phase)
           : quantity == 1         ? (uint16_t)duty_q15(parameters, compare->upper[phase])
                                   : (uint16_t)duty_q15(parameters, compare->lower[phase]);
}

static uint16_t item(const control_parameters_t *parameters, const fault_trace_period_t *period, unsigned number) {
    int32_t value = 0;
    if (number >= FIRST_ITEMS) {
        return item_of_more(parameters, period, number - FIRST_ITEMS);
    }
    if (number >= LOWER) {
        value = duty_q15(parameters, period->compare.lower[number - LOWER]);
    } else if (number >= UPPER) {
        value = duty_q15(parameters, period->compare.upper[number - UPPER]);
    } else if (number == TORQUE_REFERENCE) {
        value = (int32_t)(period->motion >> 16);
    } else if (number == SPEED) {
        value = units_quarter_rpm(units_milli_rpm((int16_t)period->motion * (1 << 16)));
    } else if (number == ANGLE) {
        value = period->adc.load_torque_counts;
    } else if (number == DC_LINK_VOLTAGE) {
        value = scaled(period->adc.bus_voltage_counts, parameters->voltage_scale_q18);
    } else {
        value = current_q9(parameters, period, number);
    }
    return (uint16_t)value;
}

bool trace_protocol_respond(const fault_trace_t *trace, const control_parameters_t *parameters,
                            const hal_can_frame_t *frame, hal_can_frame_t *response_frame) {
    struct drive_parameter_request_t request;
    (void)drive_parameter_request_unpack(&request, frame->data, frame->length);
    if (request.operation != PARAMETER_OPERATION_FAULT_TRACE) {
        return false;
    }
    struct drive_parameter_response_t response = {.operation = request.operation,
                                                  .index = request.index,
                                                  .part = request.part,
                                                  .status = PARAMETER_STATUS_NO_SUCH_ENTRY};
    const unsigned items = machine_tables.phases > FIRST_PHASES ? ITEMS : FIRST_ITEMS;
    const fault_trace_period_t *period = fault_trace_period(trace, request.index);
    if (period != NULL && request.part < items / 2u) {
        const uint32_t low = item(parameters, period, 2u * request.part);
        const uint32_t high = item(parameters, period, 2u * request.part + 1u);
        response.value = (int32_t)(high << 16 | low);
        response.status = PARAMETER_STATUS_DONE;
    }
    *response_frame =
        (hal_can_frame_t){.identifier = DRIVE_PARAMETER_RESPONSE_FRAME_ID, .length = DRIVE_PARAMETER_RESPONSE_LENGTH};
    (void)drive_parameter_response_pack(response_frame->data, &response, sizeof response_frame->data);
    return true;
}
