/* The drive's parameters: one row each in the table of parameters.c, addressed by index over CAN.
 *
 * A value is a raw 32-bit integer; its LSB is 2^-fraction_bits of its unit. Add a parameter by adding an index here and
 * a row there, before PARAMETER_COUNT: indices are what logs and scripts of the user hold.
 */
#ifndef DRIVE_PARAMETERS_H
#define DRIVE_PARAMETERS_H

#include <stdint.h>

#define PARAMETER_NAME_MAX 24 /* characters */

typedef enum {
    PARAMETER_CONTROLLER,
    PARAMETER_SPEED_RAMP_RPM_S,
    PARAMETER_TORQUE_MAX_NM,
    PARAMETER_CURRENT_LIMIT_A,
    PARAMETER_CURRENT_TRIP_A,
    PARAMETER_BUS_OVER_VOLTAGE_V,
    PARAMETER_BUS_UNDER_VOLTAGE_V,
    PARAMETER_OVER_SPEED_RPM,
    PARAMETER_COMMAND_TIMEOUT_MS,
    PARAMETER_TURN_ON_ANGLE_DEG,
    PARAMETER_TURN_OFF_ANGLE_DEG,
    PARAMETER_OUTGOING_OFF_ANGLE_DEG,
    PARAMETER_HAND_OVER_ANGLE_DEG,
    PARAMETER_TORQUE_BAND_INNER_NM,
    PARAMETER_TORQUE_BAND_OUTER_NM,
    PARAMETER_SPEED_KP,
    PARAMETER_SPEED_KI,
    PARAMETER_SMC_K,
    PARAMETER_SMC_EPSILON,
    PARAMETER_SMC_DELTA,
    PARAMETER_OBSERVER_BANDWIDTH_RAD_S,
    PARAMETER_BP_MODE,
    PARAMETER_BP_SEED,
    PARAMETER_BP_ETA,
    PARAMETER_BP_ALPHA,
    PARAMETER_BP_ERROR_SCALE_NM,
    PARAMETER_BP_KP_MAX,
    PARAMETER_BP_KI_MAX,
    PARAMETER_BP_KD_MAX,
    PARAMETER_BP_ASSIST_BAND_NM,
    PARAMETER_INERTIA_KG_M2,
    PARAMETER_FRICTION_NM_S,
    PARAMETER_RESISTANCE_OHM,
    PARAMETER_LOAD_SOURCE,
    PARAMETER_OBSERVER_WAKING,
    PARAMETER_OBSERVER_WAKE_RAD_S,
    PARAMETER_OBSERVER_STEADY_RAD_S,
    PARAMETER_PULSES_PER_PERIOD,
    PARAMETER_TORQUE_SHARING,
    PARAMETER_SHARE_ON_ANGLE_DEG,
    PARAMETER_SHARE_OFF_ANGLE_DEG,
    PARAMETER_SHARE_ON_EARLY_DEG,
    PARAMETER_SHARE_OFF_EARLY_DEG,
    PARAMETER_TORQUE_RESERVE_NM,
    PARAMETER_FLUX_OBSERVER_GAIN,
    PARAMETER_ANGLE_TRIM,
    PARAMETER_ANGLE_TRIM_RATE_1_S,
    PARAMETER_BP_TRIM_MODE,
    PARAMETER_BP_TRIM_LIMIT_NM,
    PARAMETER_BP_TRIM_KP_MAX,
    PARAMETER_BP_TRIM_KI_MAX,
    PARAMETER_BP_TRIM_KD_MAX,
    PARAMETER_COUNT
} parameter_index_t;

typedef struct {
    const char *name; /* at most PARAMETER_NAME_MAX ASCII characters */
    const char *unit; /* ASCII, empty for a plain number */
    uint8_t fraction_bits;
    int32_t minimum; /* both ends allowed */
    int32_t maximum;
    int32_t initial; /* the default, unless the machine gives another (parameters_set_default) */
} parameter_row_t;

/* The values of one drive. Read `values` directly; write through the functions, so that ranges hold. */
typedef struct {
    int32_t values[PARAMETER_COUNT];
    int32_t defaults[PARAMETER_COUNT];
    uint32_t changes; /* rises with every write, so that what is derived from a parameter can be computed again */
} parameters_t;

typedef enum { PARAMETER_DONE, PARAMETER_NO_SUCH, PARAMETER_OUT_OF_RANGE } parameter_status_t;

/* Every value at the table's default. */
void parameters_init(parameters_t *parameters);

/* The table's row; index 0..PARAMETER_COUNT-1. */
const parameter_row_t *parameters_row(unsigned index);

/* Makes `value` the default of this drive and its present value, held within the row's limits: for what the machine or
 * the configuration decides. index 0..PARAMETER_COUNT-1. */
void parameters_set_default(parameters_t *parameters, unsigned index, int32_t value);

/* Writes a value; refused, and nothing changed, when there is no such index or the value is beyond the limits. */
parameter_status_t parameters_set(parameters_t *parameters, unsigned index, int32_t value);

/* Reads a value; *value is left alone when there is no such index. */
parameter_status_t parameters_get(const parameters_t *parameters, unsigned index, int32_t *value);

#endif
