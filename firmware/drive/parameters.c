#include "drive/parameters.h"

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
#include "drive/parameters.def"
#undef PARAMETER
};

/* Name and unit of each parameter in turn; pointers to them would take half as much flash again. */
static const char texts[] =
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text) name "\0" unit "\0"
#include "drive/parameters.def"
#undef PARAMETER
    ;

static_assert((int)PARAMETER_COUNT <= MACHINE_PARAMETERS_MAX, "the machine's tables have a default of each parameter");

void parameters_init(parameters_t *parameters) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        parameters->values[i] = machine_tables.parameter_default[i];
    }
    parameters->controller_default = machine_tables.parameter_default[PARAMETER_CONTROLLER];
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

void parameters_set_controller(parameters_t *parameters, int32_t controller) {
    const parameter_row_t *row = &rows[PARAMETER_CONTROLLER];
    parameters->controller_default = fixed_clamp(controller, row->minimum, row->maximum);
    parameters->values[PARAMETER_CONTROLLER] = parameters->controller_default;
    parameters->revision++;
}

int32_t parameters_default(const parameters_t *parameters, unsigned index) {
    return index == PARAMETER_CONTROLLER ? parameters->controller_default : machine_tables.parameter_default[index];
}

parameter_status_t parameters_set(parameters_t *parameters, unsigned index, int32_t value) {
    if (index >= PARAMETER_COUNT) {
        return PARAMETER_STATUS_NO_SUCH_PARAMETER;
    }
    if (value < rows[index].minimum || value > rows[index].maximum) {
        return PARAMETER_STATUS_OUT_OF_RANGE;
    }
    parameters->values[index] = value;
    parameters->revision++;
    return PARAMETER_STATUS_DONE;
}

bool parameters_restore(parameters_t *parameters, const int32_t values[PARAMETER_COUNT]) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        if (values[i] < rows[i].minimum || values[i] > rows[i].maximum) {
            return false;
        }
    }
    memcpy(parameters->values, values, sizeof parameters->values);
    parameters->revision++;
    return true;
}

void parameters_restore_defaults(parameters_t *parameters) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        parameters->values[i] = parameters_default(parameters, i);
    }
    parameters->revision++;
}

COLD uint32_t parameters_identity(void) {
    return crc32_continue(crc32_continue(0, texts, sizeof texts), rows, sizeof rows);
}

parameter_status_t parameters_get(const parameters_t *parameters, unsigned index, int32_t *value) {
    if (index >= PARAMETER_COUNT) {
        return PARAMETER_STATUS_NO_SUCH_PARAMETER;
    }
    *value = parameters->values[index];
    return PARAMETER_STATUS_DONE;
}
