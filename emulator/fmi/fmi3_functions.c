/* FMI 3.0 co-simulation (Modelica Association, "Functional Mock-up Interface Specification" 3.0): life cycle,
 * variables, steps, states. fmi3_unsupported.c has the functions that this unit does not support.
 *
 * Time: the plant counts whole nanoseconds from the start time; communication points are rounded
 * individually, so that rounding errors do not accumulate. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi/fmu_instance.h"

#define NS_PER_S 1e9
/* Time of the plant, 104 days, beyond which communication points would not be exact. */
#define TIME_MAX_NS 9007199254740992.0
#define LOG_LENGTH 256

fmi3Status fmu_instance_error(const fmu_instance_t *instance, const char *format, ...) {
    if (instance != NULL && instance->log != NULL) {
        char message[LOG_LENGTH];
        va_list arguments;
        va_start(arguments, format);
        vsnprintf(message, sizeof message, format, arguments);
        va_end(arguments);
        instance->log(instance->environment, fmi3Error, FMU_LOG_CATEGORY, message);
    }
    return fmi3Error;
}

/* True when a function may be called in the mode of the instance; logs an error otherwise. */
static bool in_mode(const fmu_instance_t *instance, unsigned modes, const char *function) {
    if (instance == NULL) {
        return false;
    }
    if ((instance->state.mode & modes) == 0) {
        const char *now = instance->state.mode == FMU_INSTANTIATED     ? "before initialization"
                          : instance->state.mode == FMU_INITIALIZATION ? "during initialization"
                          : instance->state.mode == FMU_STEP           ? "between steps"
                                                                       : "after termination";
        fmu_instance_error(instance, "%s: not allowed %s", function, now);
        return false;
    }
    return true;
}

/* --- Life cycle --- */

const char *fmi3GetVersion(void) {
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    (void)loggingOn; /* no debug messages exist, and errors are always logged */
    if (instance == NULL) {
        return fmi3Error;
    }
    for (size_t index = 0; index < nCategories; index++) {
        if (strcmp(categories[index], FMU_LOG_CATEGORY) != 0) {
            return fmu_instance_error(instance, "fmi3SetDebugLogging: category '%s': there is only %s",
                                      categories[index], FMU_LOG_CATEGORY);
        }
    }
    return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
                                         fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)instanceName, (void)resourcePath, (void)visible, (void)loggingOn, (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables, (void)intermediateUpdate;
    const fmu_instance_t caller = {.environment = instanceEnvironment, .log = logMessage};
    if (instantiationToken == NULL || strcmp(instantiationToken, fmu_instantiation_token) != 0) {
        fmu_instance_error(&caller, "fmi3InstantiateCoSimulation: instantiation token '%s' is not this unit's '%s'",
                           instantiationToken == NULL ? "" : instantiationToken, fmu_instantiation_token);
        return NULL;
    }
    if (eventModeUsed) {
        fmu_instance_error(&caller, "fmi3InstantiateCoSimulation: there is no event mode");
        return NULL;
    }
    if (nRequiredIntermediateVariables > 0) {
        fmu_instance_error(&caller, "fmi3InstantiateCoSimulation: there are no intermediate variables");
        return NULL;
    }
    fmu_instance_t *instance = malloc(sizeof *instance);
    if (instance == NULL) {
        fmu_instance_error(&caller, "fmi3InstantiateCoSimulation: no memory");
        return NULL;
    }
    *instance = caller;
    fmi3Reset(instance);
    return instance;
}

void fmi3FreeInstance(fmi3Instance instance) {
    free(instance);
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    fmu_instance_t *self = instance;
    if (self == NULL) {
        return fmi3Error;
    }
    self->state.mode = FMU_INSTANTIATED;
    self->state.start_s = 0.0;
    self->state.stop_ns = UINT64_MAX;
    fmu_model_reset(&self->state.model);
    return fmi3OK;
}

/* Whole nanoseconds from the start time to `time_s`. False: not a number, before the start time or too far after it. */
static bool time_from_start(const fmu_state_t *state, double time_s, uint64_t *time_ns) {
    const double rounded_ns = round((time_s - state->start_s) * NS_PER_S);
    if (!(rounded_ns >= 0.0 && rounded_ns <= TIME_MAX_NS)) {
        return false;
    }
    *time_ns = (uint64_t)rounded_ns;
    return true;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    (void)toleranceDefined, (void)tolerance; /* the step limits of the plant apply */
    fmu_instance_t *self = instance;
    if (!in_mode(self, FMU_INSTANTIATED, "fmi3EnterInitializationMode")) {
        return fmi3Error;
    }
    if (!isfinite(startTime)) {
        return fmu_instance_error(self, "fmi3EnterInitializationMode: start time %g is not a finite number", startTime);
    }
    self->state.start_s = startTime;
    if (stopTimeDefined && !time_from_start(&self->state, stopTime, &self->state.stop_ns)) {
        return fmu_instance_error(self, "fmi3EnterInitializationMode: stop time %g s is not from %g to %g s", stopTime,
                                  startTime, startTime + TIME_MAX_NS / NS_PER_S);
    }
    self->state.model.values.time_s = startTime;
    self->state.mode = FMU_INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    fmu_instance_t *self = instance;
    if (!in_mode(self, FMU_INITIALIZATION, "fmi3ExitInitializationMode")) {
        return fmi3Error;
    }
    self->state.mode = FMU_STEP;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    fmu_instance_t *self = instance;
    if (!in_mode(self, FMU_STEP, "fmi3Terminate")) {
        return fmi3Error;
    }
    self->state.mode = FMU_TERMINATED;
    return fmi3OK;
}

/* --- Variables --- */

/* Variable of a value reference; NULL, after a line in the log, when there is none. */
static const fmu_variable_t *find_variable(const fmu_instance_t *instance, fmi3ValueReference reference,
                                           fmu_type_t type, const char *function) {
    if (reference >= fmu_variable_count || fmu_variables[reference].type != type) {
        fmu_instance_error(instance, "%s: value reference %u: no variable of this type", function, (unsigned)reference);
        return NULL;
    }
    return &fmu_variables[reference];
}

/* Variable of a value reference that may be set in the present mode; NULL, after a line in the log, otherwise. */
static const fmu_variable_t *find_settable(const fmu_instance_t *instance, fmi3ValueReference reference,
                                           fmu_type_t type, const char *function) {
    const fmu_variable_t *variable = find_variable(instance, reference, type, function);
    if (variable == NULL || variable->causality == FMU_INPUT) {
        return variable;
    }
    if (variable->causality != FMU_PARAMETER) {
        fmu_instance_error(instance, "%s: %s is not an input or a parameter", function, variable->name);
        return NULL;
    }
    return in_mode(instance, FMU_INSTANTIATED | FMU_INITIALIZATION, function) ? variable : NULL;
}

/* True when there is one value per value reference: no variable is an array. */
static bool counts_match(const fmu_instance_t *instance, size_t references, size_t values, const char *function) {
    if (references != values) {
        fmu_instance_error(instance, "%s: %zu values for %zu scalar variables", function, values, references);
        return false;
    }
    return true;
}

static bool may_get(const fmu_instance_t *instance, size_t references, size_t values, const char *function) {
    return instance != NULL && counts_match(instance, references, values, function);
}

static bool may_set(const fmu_instance_t *instance, size_t references, size_t values, const char *function) {
    return in_mode(instance, FMU_INSTANTIATED | FMU_INITIALIZATION | FMU_STEP, function) &&
           counts_match(instance, references, values, function);
}

/* Before the first step the outputs follow the variables that are set. */
static fmi3Status after_set(fmu_instance_t *instance) {
    if (instance->state.mode != FMU_STEP) {
        fmu_model_restart(&instance->state.model);
    }
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Float64 values[], size_t nValues) {
    const fmu_instance_t *self = instance;
    if (!may_get(self, nValueReferences, nValues, "fmi3GetFloat64")) {
        return fmi3Error;
    }
    for (size_t index = 0; index < nValues; index++) {
        const fmu_variable_t *variable = find_variable(self, valueReferences[index], FMU_FLOAT64, "fmi3GetFloat64");
        if (variable == NULL) {
            return fmi3Error;
        }
        memcpy(&values[index], (const char *)&self->state.model.values + variable->offset, sizeof values[index]);
    }
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Boolean values[], size_t nValues) {
    const fmu_instance_t *self = instance;
    if (!may_get(self, nValueReferences, nValues, "fmi3GetBoolean")) {
        return fmi3Error;
    }
    for (size_t index = 0; index < nValues; index++) {
        const fmu_variable_t *variable = find_variable(self, valueReferences[index], FMU_BOOLEAN, "fmi3GetBoolean");
        if (variable == NULL) {
            return fmi3Error;
        }
        memcpy(&values[index], (const char *)&self->state.model.values + variable->offset, sizeof values[index]);
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Float64 values[], size_t nValues) {
    fmu_instance_t *self = instance;
    if (!may_set(self, nValueReferences, nValues, "fmi3SetFloat64")) {
        return fmi3Error;
    }
    for (size_t index = 0; index < nValues; index++) {
        const fmu_variable_t *variable = find_settable(self, valueReferences[index], FMU_FLOAT64, "fmi3SetFloat64");
        if (variable == NULL) {
            return fmi3Error;
        }
        const double value = values[index];
        if (!isfinite(value) || value < variable->minimum || value > variable->maximum) {
            return fmu_instance_error(self, "fmi3SetFloat64: %s: %g is not a finite number from %g to %g",
                                      variable->name, value, variable->minimum, variable->maximum);
        }
        memcpy((char *)&self->state.model.values + variable->offset, &value, sizeof value);
    }
    return after_set(self);
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Boolean values[], size_t nValues) {
    fmu_instance_t *self = instance;
    if (!may_set(self, nValueReferences, nValues, "fmi3SetBoolean")) {
        return fmi3Error;
    }
    for (size_t index = 0; index < nValues; index++) {
        const fmu_variable_t *variable = find_settable(self, valueReferences[index], FMU_BOOLEAN, "fmi3SetBoolean");
        if (variable == NULL) {
            return fmi3Error;
        }
        memcpy((char *)&self->state.model.values + variable->offset, &values[index], sizeof values[index]);
    }
    return after_set(self);
}

/* --- Steps --- */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    (void)noSetFMUStatePriorToCurrentPoint;
    fmu_instance_t *self = instance;
    if (!in_mode(self, FMU_STEP, "fmi3DoStep")) {
        return fmi3Error;
    }
    fmu_state_t *state = &self->state;
    *eventHandlingNeeded = false;
    *terminateSimulation = false;
    *earlyReturn = false;
    *lastSuccessfulTime = state->model.values.time_s;
    const double to_s = currentCommunicationPoint + communicationStepSize;
    uint64_t from_ns, to_ns;
    /* Tolerance of one nanosecond: the importer may accumulate its communication points with other rounding. */
    if (!time_from_start(state, currentCommunicationPoint, &from_ns) || from_ns > state->model.plant.time_ns + 1 ||
        from_ns + 1 < state->model.plant.time_ns) {
        return fmu_instance_error(self, "fmi3DoStep: a step from %.12g s, but the last one ended at %.12g s",
                                  currentCommunicationPoint, state->model.values.time_s);
    }
    if (!(communicationStepSize > 0.0) || !time_from_start(state, to_s, &to_ns)) {
        return fmu_instance_error(self, "fmi3DoStep: step size %g s is not above 0 and below %g s",
                                  communicationStepSize, TIME_MAX_NS / NS_PER_S);
    }
    if (state->stop_ns != UINT64_MAX && to_ns > state->stop_ns + 1) {
        return fmu_instance_error(self, "fmi3DoStep: a step to %.12g s is beyond the stop time", to_s);
    }
    fmu_model_advance(&state->model, to_ns);
    state->model.values.time_s = to_s;
    *lastSuccessfulTime = to_s;
    return fmi3OK;
}

/* --- States --- */

static void copy_state(fmu_state_t *to, const fmu_state_t *from) {
    *to = *from;
    fmu_model_rebind(&to->model);
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    const fmu_instance_t *self = instance;
    if (self == NULL || FMUState == NULL) {
        return fmu_instance_error(self, "fmi3GetFMUState: nowhere to put the state");
    }
    if (*FMUState == NULL) {
        *FMUState = malloc(sizeof(fmu_state_t));
        if (*FMUState == NULL) {
            return fmu_instance_error(self, "fmi3GetFMUState: no memory");
        }
    }
    copy_state(*FMUState, &self->state);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    fmu_instance_t *self = instance;
    if (self == NULL || FMUState == NULL) {
        return fmu_instance_error(self, "fmi3SetFMUState: no state");
    }
    copy_state(&self->state, FMUState);
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    (void)instance;
    if (FMUState != NULL) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}
