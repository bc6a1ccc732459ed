/* Access to the objects of objects.toml, by SDO and PDO alike. Results are abort codes of CiA 301, 0 for success. */
#ifndef COMMS_CANOPEN_OBJECTS_H
#define COMMS_CANOPEN_OBJECTS_H

#include "comms/canopen_entries.h"

/* Bytes of text or domain. */
uint32_t canopen_size_of_bytes(const canopen_context_t *context, const canopen_object_t *object);

/* Bytes of text or domain from `offset` on; less at its end. */
unsigned canopen_read_bytes(const canopen_context_t *context, const canopen_object_t *object, uint32_t offset,
                            uint8_t *data, unsigned bytes);

/* Reads a number. CANOPEN_NO_DATA: an error field without an error; *value is 0. */
uint32_t canopen_read(const canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object,
                      int32_t *value);

/* Whether a number can be written: access, limits, and what depends on other objects. Parameters are checked when they
 * are written. */
uint32_t canopen_check(const canopen_t *canopen, const canopen_object_t *object, int32_t value);

/* Writes a number that has passed canopen_check. */
uint32_t canopen_write(canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object,
                       int32_t value);

/* Abort code of the verdict on a set of parameters. */
uint32_t canopen_verdict(const parameters_verdict_t *verdict);

/* Variables as after reset communication, or with `node` after reset node. */
void canopen_reset_values(canopen_t *canopen, bool node);

#endif
