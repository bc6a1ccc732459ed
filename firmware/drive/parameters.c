#include "drive/parameters.h"

#include "fixed/fixed.h"

#define Q FIXED_CONSTANT

static const parameter_row_t rows[PARAMETER_COUNT] = {
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text)                             \
    [PARAMETER_##index] = {name, unit, fraction_bits, minimum, maximum, default_value},
#include "drive/parameters.def"
#undef PARAMETER
};

void parameters_init(parameters_t *parameters) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        parameters->values[i] = rows[i].default_value;
        parameters->defaults[i] = rows[i].default_value;
    }
    parameters->revision = 0;
}

const parameter_row_t *parameters_row(unsigned index) {
    return &rows[index];
}

void parameters_set_default(parameters_t *parameters, unsigned index, int32_t value) {
    parameters->defaults[index] = fixed_clamp(value, rows[index].minimum, rows[index].maximum);
    parameters->values[index] = parameters->defaults[index];
    parameters->revision++;
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

parameter_status_t parameters_get(const parameters_t *parameters, unsigned index, int32_t *value) {
    if (index >= PARAMETER_COUNT) {
        return PARAMETER_STATUS_NO_SUCH_PARAMETER;
    }
    *value = parameters->values[index];
    return PARAMETER_STATUS_DONE;
}
