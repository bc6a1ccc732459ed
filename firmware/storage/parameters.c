#include "storage/parameters.h"

#include <assert.h>
#include <string.h>

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/crc32.h"
#include "fixed/fixed.h"

#define Q FIXED_CONSTANT

static const parameter_row_t rows[PARAMETER_COUNT] = {
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text)                             \
    [PARAMETER_##index] = {minimum, maximum},
#include "storage/parameters.def"
#undef PARAMETER
};

static const bool tunable[PARAMETER_COUNT] = {
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text)
#define TUNABLE_PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text)                     \
    [PARAMETER_##index] = true,
#include "storage/parameters.def"
#undef PARAMETER
};

/* The mask of what has been written ends with 64: from there on a parameter needs none. */
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text)                             \
    static_assert((int)PARAMETER_##index < 64, "the mask of what has been written");
#define TUNABLE_PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text)
#include "storage/parameters.def"
#undef PARAMETER

/* Name and unit of each parameter in turn; pointers to them would take half as much flash again. */
static const char texts[] =
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text) name "\0" unit "\0"
#include "storage/parameters.def"
#undef PARAMETER
    ;

static_assert((int)PARAMETER_COUNT <= MACHINE_PARAMETERS_MAX, "the machine's tables have a default of each parameter");

/* [SR-57] */
COLD uint32_t parameters_sum(const int32_t values[PARAMETER_COUNT]) {
    uint32_t sum = 0;
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        sum += (uint32_t)values[i];
    }
    return sum;
}

/* Another one than 0 for memory that has been cleared. [SR-57] */
static uint32_t sum_of(const parameters_t *parameters) {
    return ~(parameters_sum(parameters->values) + (uint32_t)parameters->controller_default +
             parameters->control_rate_hz);
}

/* [SR-57] */
bool parameters_intact(const parameters_t *parameters) {
    return parameters->sum == sum_of(parameters);
}

/* [SR-57] */
void parameters_init(parameters_t *parameters) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        parameters->values[i] = machine_tables.parameter_default[i];
    }
    parameters->controller_default = machine_tables.parameter_default[PARAMETER_CONTROLLER];
    parameters->control_rate_hz = 0;
    parameters->sum = sum_of(parameters);
    parameters->revision = 0;
}

const parameter_row_t *parameters_row(unsigned index) {
    return &rows[index];
}

static const char *text_after(unsigned texts_before) {
    const char *text = texts;
    for (; texts_before > 0; text++) {
        texts_before -= *text == '\0';
    }
    return text;
}

const char *parameters_name(unsigned index) {
    return text_after(2 * index);
}

const char *parameters_unit(unsigned index) {
    return text_after(2 * index + 1);
}

/* [SR-57] */
void parameters_set(parameters_t *parameters, unsigned index, int32_t value) {
    parameters->values[index] = fixed_clamp(value, rows[index].minimum, rows[index].maximum);
    parameters->sum = sum_of(parameters);
    parameters->revision++;
}

void parameters_set_controller(parameters_t *parameters, int32_t controller) {
    parameters_set(parameters, PARAMETER_CONTROLLER, controller);
    parameters->controller_default = parameters->values[PARAMETER_CONTROLLER];
    parameters->sum = sum_of(parameters);
}

void parameters_set_control_rate(parameters_t *parameters, uint32_t control_rate_hz) {
    parameters->control_rate_hz = control_rate_hz;
    parameters->sum = sum_of(parameters);
}

int32_t parameters_default(const parameters_t *parameters, unsigned index) {
    return index == PARAMETER_CONTROLLER ? parameters->controller_default : machine_tables.parameter_default[index];
}

bool parameters_tunable(unsigned index) {
    return tunable[index];
}

static bool in_range(const int32_t values[PARAMETER_COUNT], unsigned index) {
    return values[index] >= rows[index].minimum && values[index] <= rows[index].maximum;
}

/* [SR-56] */
static parameters_verdict_t check_each(const int32_t values[PARAMETER_COUNT], uint64_t written, bool running) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        if (!in_range(values, i)) {
            return (parameters_verdict_t){PARAMETER_STATUS_OUT_OF_RANGE, (uint8_t)i, 0};
        }
    }
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        if (running && !parameters_tunable(i) && (written >> i & 1) != 0) {
            return (parameters_verdict_t){PARAMETER_STATUS_NOT_WHILE_RUNNING, (uint8_t)i, 0};
        }
    }
    return (parameters_verdict_t){PARAMETER_STATUS_DONE, 0, 0};
}

/* Pairs of parameters with one unit: the first is not above the second, or below it. */
static const struct {
    uint8_t low, high;
    bool below;
} orders[] = {
    {PARAMETER_CURRENT_LIMIT_A, PARAMETER_CURRENT_TRIP_A, false},
    {PARAMETER_UNDER_VOLTAGE_V, PARAMETER_OVER_VOLTAGE_V, true},
    {PARAMETER_TURN_ON_ANGLE_DEG, PARAMETER_TURN_OFF_ANGLE_DEG, true},
    {PARAMETER_TURN_OFF_ANGLE_DEG, PARAMETER_OUTGOING_OFF_ANGLE_DEG, false},
    {PARAMETER_TORQUE_BAND_INNER_NM, PARAMETER_TORQUE_BAND_OUTER_NM, false},
    {PARAMETER_POSITION_MIN_REV, PARAMETER_POSITION_MAX_REV, true},
};

/* [SR-56] */
static parameters_verdict_t check_orders(const parameters_t *present, const int32_t values[PARAMETER_COUNT]) {
    for (unsigned i = 0; i < sizeof orders / sizeof orders[0]; i++) {
        const unsigned low = orders[i].low;
        const bool kept = low == PARAMETER_CURRENT_LIMIT_A && values[low] == present->values[low];
        const int32_t excess = values[low] - values[orders[i].high]; /* of values within their limits */
        if (excess >= (orders[i].below ? 0 : 1) && !kept) {
            return (parameters_verdict_t){PARAMETER_STATUS_CONTRADICTION, orders[i].low, orders[i].high};
        }
    }
    return (parameters_verdict_t){PARAMETER_STATUS_DONE, 0, 0};
}

COLD commutation_angles_t parameters_commutation_angles(const int32_t values[PARAMETER_COUNT]) {
    return (commutation_angles_t){
        .turn_on = commutation_angle_from_degrees(values[PARAMETER_TURN_ON_ANGLE_DEG]),
        .turn_off = commutation_angle_from_degrees(values[PARAMETER_TURN_OFF_ANGLE_DEG]),
        .outgoing_off = commutation_angle_from_degrees(values[PARAMETER_OUTGOING_OFF_ANGLE_DEG]),
    };
}

static bool same(const parameters_t *present, const int32_t values[PARAMETER_COUNT], unsigned index) {
    return values[index] == present->values[index];
}

/* Angles of turn-on and turn-off that are new. [SR-56] */
static parameters_verdict_t check_direction(const parameters_t *present, const int32_t values[PARAMETER_COUNT]) {
    const bool kept = same(present, values, PARAMETER_TURN_ON_ANGLE_DEG) &&
                      same(present, values, PARAMETER_TURN_OFF_ANGLE_DEG) &&
                      same(present, values, PARAMETER_OUTGOING_OFF_ANGLE_DEG);
    const commutation_angles_t angles = parameters_commutation_angles(values);
    const commutation_parameters_t commutation =
        commutation_configure(&angles, machine_tables.phases, machine_tables.rotor_poles);
    if (!kept && !commutation_drives_forward(&commutation, &machine_tables, values[PARAMETER_CURRENT_LIMIT_A])) {
        return (parameters_verdict_t){PARAMETER_STATUS_CONTRADICTION, PARAMETER_TURN_ON_ANGLE_DEG,
                                      PARAMETER_TURN_OFF_ANGLE_DEG};
    }
    return (parameters_verdict_t){PARAMETER_STATUS_DONE, 0, 0};
}

/* Nothing can be said about a drive without its supply. [SR-56] */
static parameters_verdict_t check_supply(const parameters_t *present, const int32_t values[PARAMETER_COUNT],
                                         int32_t voltage_q6) {
    const bool supplied = voltage_q6 >= present->values[PARAMETER_UNDER_VOLTAGE_V] &&
                          voltage_q6 <= present->values[PARAMETER_OVER_VOLTAGE_V];
    if (supplied && voltage_q6 < values[PARAMETER_UNDER_VOLTAGE_V]) {
        return (parameters_verdict_t){PARAMETER_STATUS_EXCLUDES_SUPPLY, PARAMETER_UNDER_VOLTAGE_V, 0};
    }
    if (supplied && voltage_q6 > values[PARAMETER_OVER_VOLTAGE_V]) {
        return (parameters_verdict_t){PARAMETER_STATUS_EXCLUDES_SUPPLY, PARAMETER_OVER_VOLTAGE_V, 0};
    }
    return (parameters_verdict_t){PARAMETER_STATUS_DONE, 0, 0};
}

/* [SR-56] */
parameters_verdict_t parameters_check(const parameters_t *present, const int32_t values[PARAMETER_COUNT],
                                      uint64_t written, const parameters_conditions_t *conditions) {
    parameters_verdict_t verdict = check_each(values, written, conditions->running);
    if (verdict.status == PARAMETER_STATUS_DONE) {
        verdict = check_orders(present, values);
    }
    if (verdict.status == PARAMETER_STATUS_DONE) {
        verdict = check_direction(present, values);
    }
    if (verdict.status == PARAMETER_STATUS_DONE) {
        verdict = check_supply(present, values, conditions->dc_link_voltage_q6);
    }
    return verdict;
}

/* [SR-56] */
void parameters_apply(parameters_t *parameters, const int32_t values[PARAMETER_COUNT]) {
    (void)memcpy(parameters->values, values, sizeof parameters->values);
    parameters->sum = sum_of(parameters);
    parameters->revision++;
}

bool parameters_within_limits(const int32_t values[PARAMETER_COUNT]) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        if (!in_range(values, i)) {
            return false;
        }
    }
    return true;
}

/* [SR-58] */
bool parameters_restore(parameters_t *parameters, const int32_t values[PARAMETER_COUNT]) {
    if (!parameters_within_limits(values)) {
        return false;
    }
    parameters_apply(parameters, values);
    return true;
}

COLD uint32_t parameters_identity(void) {
    return crc32_continue(crc32_continue(0, texts, sizeof texts), rows, sizeof rows);
}
