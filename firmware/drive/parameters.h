/* The drive's parameters, addressed by index over CAN; parameters.def is their table.
 *
 * A value is a raw 32-bit integer; its LSB is 2^-fraction_bits of its unit. Fraction bits and defaults are those of the
 * machine (machine_tables): parameters.def has them for a machine whose units are the SI units.
 */
#ifndef DRIVE_PARAMETERS_H
#define DRIVE_PARAMETERS_H

#include <stdbool.h>
#include <stdint.h>

#include "drive_enumerations.h"

#define PARAMETER_NAME_MAX 24 /* characters */

typedef enum {
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text) PARAMETER_##index,
#include "drive/parameters.def"
#undef PARAMETER
    PARAMETER_COUNT
} parameter_index_t;

typedef struct {
    int32_t minimum; /* both limits are inclusive */
    int32_t maximum;
} parameter_row_t;

/* The values of one drive. Read `values` directly; write through the functions, so that the limits apply. */
typedef struct {
    int32_t values[PARAMETER_COUNT];
    int32_t controller_default;
    uint32_t revision; /* incremented by every write, so that derived values can be recomputed */
} parameters_t;

/* Sets every value to the machine's default. */
void parameters_init(parameters_t *parameters);

/* The table's row; index 0..PARAMETER_COUNT-1. */
const parameter_row_t *parameters_row(unsigned index);

/* Name over CAN, at most PARAMETER_NAME_MAX ASCII characters; index 0..PARAMETER_COUNT-1. */
const char *parameters_name(unsigned index);

/* Unit, ASCII, empty for a plain number; index 0..PARAMETER_COUNT-1. */
const char *parameters_unit(unsigned index);

/* Sets the controller of this drive as default and present value, clamped to the row's limits. */
void parameters_set_controller(parameters_t *parameters, int32_t controller);

/* The default of this drive: that of the machine, but for the controller. index 0..PARAMETER_COUNT-1. */
int32_t parameters_default(const parameters_t *parameters, unsigned index);

/* Writes a value: PARAMETER_STATUS_DONE, or, with nothing changed, PARAMETER_STATUS_NO_SUCH_PARAMETER or
 * PARAMETER_STATUS_OUT_OF_RANGE. */
parameter_status_t parameters_set(parameters_t *parameters, unsigned index, int32_t value);

/* Sets every value at once. False, with nothing changed, when one of them is out of range. */
bool parameters_restore(parameters_t *parameters, const int32_t values[PARAMETER_COUNT]);

/* Sets every value to the default of this drive. */
void parameters_restore_defaults(parameters_t *parameters);

/* CRC-32 of names, units and limits: differs from that of another list. */
uint32_t parameters_identity(void);

/* Reads a value: PARAMETER_STATUS_DONE, or, with *value unchanged, PARAMETER_STATUS_NO_SUCH_PARAMETER. */
parameter_status_t parameters_get(const parameters_t *parameters, unsigned index, int32_t *value);

#endif
