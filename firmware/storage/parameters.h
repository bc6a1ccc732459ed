/* The drive's parameters, addressed by index over CAN; parameters.def is their table.
 *
 * A value is a raw 32-bit integer; its LSB is 2^-fraction_bits of its unit. Fraction bits and defaults are the
 * machine's (machine_tables): parameters.def has them for a machine whose units are the SI units.
 */
#ifndef STORAGE_PARAMETERS_H
#define STORAGE_PARAMETERS_H

#include <stdbool.h>
#include <stdint.h>

#include "control/commutation.h"
#include "drive_enumerations.h"

#define PARAMETER_NAME_MAX 24 /* characters */

typedef enum {
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text) PARAMETER_##index,
#include "storage/parameters.def"
#undef PARAMETER
    PARAMETER_COUNT
} parameter_index_t;

typedef struct {
    int32_t minimum; /* both limits are inclusive */
    int32_t maximum;
} parameter_row_t;

/* The values of one drive. Read `values` directly; write through the functions, so that every change is noticed. */
typedef struct {
    int32_t values[PARAMETER_COUNT];
    int32_t controller_default;
    uint32_t control_rate_hz; /* of the board; no parameter, but as constant */
    uint32_t sum;             /* of the three: parameters_intact() */
    uint32_t revision;        /* incremented by every change, so that derived values can be recomputed */
} parameters_t;

/* Sets every value to the machine's default. */
void parameters_init(parameters_t *parameters);

/* The table's row; index 0..PARAMETER_COUNT-1. */
const parameter_row_t *parameters_row(unsigned index);

/* Name over CAN, at most PARAMETER_NAME_MAX ASCII characters; index 0..PARAMETER_COUNT-1. */
const char *parameters_name(unsigned index);

/* Unit, ASCII, empty for a plain number; index 0..PARAMETER_COUNT-1. */
const char *parameters_unit(unsigned index);

/* Sets one value before the drive starts, clamped to the row's limits; afterwards a whole set is applied. index
 * 0..PARAMETER_COUNT-1. */
void parameters_set(parameters_t *parameters, unsigned index, int32_t value);

/* Sets the controller of this drive as default and present value, clamped to the row's limits. */
void parameters_set_controller(parameters_t *parameters, int32_t controller);

/* Sets the control rate of this drive's board, Hz. */
void parameters_set_control_rate(parameters_t *parameters, uint32_t control_rate_hz);

/* The default of this drive: the machine's, but for the controller. index 0..PARAMETER_COUNT-1. */
int32_t parameters_default(const parameters_t *parameters, unsigned index);

/* Values that a set of parameters is checked against. */
typedef struct {
    bool running;               /* the drive runs or is about to: tunable parameters only */
    int32_t dc_link_voltage_q6; /* measured, V, Q9.6 */
} parameters_conditions_t;

typedef struct {
    parameter_status_t status;
    uint8_t index, other; /* parameters for which the set is refused; other: of a contradiction */
} parameters_verdict_t;

/* True for a parameter that may be changed in a run; index 0..PARAMETER_COUNT-1. */
bool parameters_tunable(unsigned index);

/* Checks a set that is to replace the present one, in this order (written: bit i, the set has parameter i; the others
 * have their present values):
 *   PARAMETER_STATUS_OUT_OF_RANGE        a value is not within its limits
 *   PARAMETER_STATUS_NOT_WHILE_RUNNING   in a run, a parameter is written that is not tunable, be it with its present
 *                                        value
 *   PARAMETER_STATUS_CONTRADICTION       a value is not below another one, or is above it; a current limit above the
 *                                        trip only when the limit changes: lowering the trip alone is how it is tested;
 *                                        or angles of commutation that can drive backwards (commutation.h)
 *   PARAMETER_STATUS_EXCLUDES_SUPPLY     a threshold of the DC-link voltage changes so that the present voltage, which
 *                                        is within the present thresholds, would fail it
 */
parameters_verdict_t parameters_check(const parameters_t *present, const int32_t values[PARAMETER_COUNT],
                                      uint64_t written, const parameters_conditions_t *conditions);

/* Angles of commutation of a set. */
commutation_angles_t parameters_commutation_angles(const int32_t values[PARAMETER_COUNT]);

/* Sum of the values of a set, modulo 2^32: another one after a change of any one of them. */
uint32_t parameters_sum(const int32_t values[PARAMETER_COUNT]);

/* False when a value has changed in memory since it was set; such parameters are neither copied nor stored. */
bool parameters_intact(const parameters_t *parameters);

/* Sets every value at once. */
void parameters_apply(parameters_t *parameters, const int32_t values[PARAMETER_COUNT]);

/* True when each value of a set is within its limits. */
bool parameters_within_limits(const int32_t values[PARAMETER_COUNT]);

/* As parameters_apply; false, with nothing changed, when a value is out of range. */
bool parameters_restore(parameters_t *parameters, const int32_t values[PARAMETER_COUNT]);

/* CRC-32 of names, units and limits: differs from another list's. */
uint32_t parameters_identity(void);

#endif
