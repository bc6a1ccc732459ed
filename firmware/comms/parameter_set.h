/* A set of parameters over CAN: written to a copy, checked as a whole, and applied in one piece or not at all.
 *
 *   host    DRIVE_ARM request_configuration, DRIVE_ARM confirm_configuration: arming.h
 *   host    PARAMETER_SET_CONTROL begin      the staged set is that in effect; begin_defaults: the defaults
 *   host    PARAMETER_WRITE index, value     any number of them: into the staged set
 *   host    PARAMETER_SET_CONTROL apply      with the CRC-32 of all writes, which is wrong when one is missing
 *   drive   PARAMETER_RESPONSE set_control   done, or why not, with the parameters for which the set is refused
 *
 * Parameters in effect or staged that have changed in memory (PARAMETER_STATUS_MEMORY) are neither copied, applied nor
 * stored. apply ends the state armed for configuration, whatever its result; so do abandon, and save, which stores the
 * parameters in effect. In a run a set may change tunable parameters only (parameters.h).
 */
#ifndef COMMS_PARAMETER_SET_H
#define COMMS_PARAMETER_SET_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_can.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"

/* All zero: nothing is staged. */
typedef struct {
    bool begun;
    uint32_t crc;     /* of the writes since begin */
    uint64_t written; /* bit i: parameter i */
    int32_t values[PARAMETER_COUNT];
    uint32_t sum; /* parameters_sum() of them */
} parameter_set_t;

/* Takes a PARAMETER_WRITE that has passed commands_receive. [background] */
void parameter_set_write(parameter_set_t *set, const hal_can_frame_t *frame);

/* Stages, checks and applies a set of one parameter, index 0..PARAMETER_COUNT-1, in place of a staged one. [background]
 */
parameters_verdict_t parameter_set_one(parameter_set_t *set, parameters_t *parameters,
                                       const parameters_conditions_t *conditions, unsigned index, int32_t value);

/* Begins a set: staged are the values in effect, or with `defaults` the defaults. False, with nothing begun, when those
 * in effect have changed in memory. [background] */
bool parameter_set_begin(parameter_set_t *set, const parameters_t *parameters, bool defaults);

/* Stages a value, or a byte of one; index 0..PARAMETER_COUNT-1, offset below 4 PARAMETER_COUNT. [background] */
void parameter_set_stage(parameter_set_t *set, unsigned index, int32_t value);
void parameter_set_stage_byte(parameter_set_t *set, unsigned offset, uint8_t byte);

/* Checks the staged set, applies it when it passes, and ends it. [background] */
parameters_verdict_t parameter_set_finish(parameter_set_t *set, parameters_t *parameters,
                                          const parameters_conditions_t *conditions);

/* Executes a PARAMETER_SET_CONTROL that has passed commands_receive and writes its response. armed: for configuration.
 * True when that state ends. [background] */
bool parameter_set_control(parameter_set_t *set, bool armed, parameters_t *parameters, nvm_store_t *store,
                           const parameters_conditions_t *conditions, const hal_can_frame_t *frame,
                           hal_can_frame_t *response_frame);

#endif
