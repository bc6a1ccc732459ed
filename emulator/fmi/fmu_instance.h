/* Instance of the functional mock-up unit. */
#ifndef FMI_FMU_INSTANCE_H
#define FMI_FMU_INSTANCE_H

#include <fmi3Functions.h>

#include "fmi/fmu_model.h"

typedef enum { FMU_INSTANTIATED = 1, FMU_INITIALIZATION = 2, FMU_STEP = 4, FMU_TERMINATED = 8 } fmu_mode_t;

/* State that fmi3GetFMUState saves. */
typedef struct {
    fmu_model_t model;
    fmu_mode_t mode;
    double start_s;   /* start time of the importer; the plant's is 0 */
    uint64_t stop_ns; /* stop time of the plant; UINT64_MAX: none */
} fmu_state_t;

typedef struct {
    fmu_state_t state;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} fmu_instance_t;

/* The only log category. */
#define FMU_LOG_CATEGORY "logStatusError"

/* Logs one formatted line, unless `instance` is NULL, and returns fmi3Error. */
__attribute__((format(printf, 2, 3))) fmi3Status fmu_instance_error(const fmu_instance_t *instance, const char *format,
                                                                    ...);

#endif
