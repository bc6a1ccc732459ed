/* An instance of the functional mock-up unit as the FMI functions see it. */
#ifndef FMI_FMU_INSTANCE_H
#define FMI_FMU_INSTANCE_H

#include <fmi3Functions.h>

#include "fmi/fmu_model.h"

typedef enum { FMU_INSTANTIATED = 1, FMU_INITIALIZATION = 2, FMU_STEP = 4, FMU_TERMINATED = 8 } fmu_mode_t;

/* Everything that fmi3GetFMUState keeps. */
typedef struct {
    fmu_model_t model;
    fmu_mode_t mode;
    double start_s;   /* of the importer's time; the plant's begins at 0 */
    uint64_t stop_ns; /* of the plant's time; UINT64_MAX: none */
} fmu_state_t;

typedef struct {
    fmu_state_t state;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} fmu_instance_t;

/* The only log category. */
#define FMU_LOG_CATEGORY "logStatusError"

/* Logs one formatted line and gives back fmi3Error. `instance` may be NULL: nothing is logged then. */
__attribute__((format(printf, 2, 3))) fmi3Status fmu_instance_error(const fmu_instance_t *instance, const char *format,
                                                                    ...);

#endif
