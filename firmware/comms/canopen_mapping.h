/* Communication and mapping parameters of the PDOs (canopen_pdo.h). */
#ifndef COMMS_CANOPEN_MAPPING_H
#define COMMS_CANOPEN_MAPPING_H

#include "comms/canopen_entries.h"

#define CANOPEN_PDO_NOT_VALID 0x80000000u
#define CANOPEN_PDO_NO_REMOTE 0x40000000u
#define CANOPEN_PDO_ID 0x7FFu
#define CANOPEN_PDO_SYNC_MAX 240 /* of a transmission type by SYNC */
#define CANOPEN_MAPPED_MAX 8u

/* COB-ID of a PDO; value: its object's, for the first one. */
static inline uint32_t canopen_mapping_id(const canopen_t *canopen, unsigned value, unsigned pdo) {
    return (uint32_t)canopen->values[value + pdo];
}

static inline bool canopen_mapping_is_valid(const canopen_t *canopen, unsigned value, unsigned pdo) {
    return (canopen_mapping_id(canopen, value, pdo) & CANOPEN_PDO_NOT_VALID) == 0;
}

/* Identifiers, mappings and state as after reset communication. */
void canopen_mapping_reset(canopen_t *canopen);

/* Forgets what was received and sent: the PDOs are as none had been. */
void canopen_mapping_restart(canopen_t *canopen);

/* False for identifiers that CiA 301 reserves for other services. */
bool canopen_mapping_is_free_id(uint32_t identifier);

/* Finds an object that may be mapped. mapped: index, sub-index and bits; access: CANOPEN_RPDO or CANOPEN_TPDO. Types 2
 * to 7 (CiA 301) stand for bytes of receive PDOs without effect: CANOPEN_CONSTANT. */
uint32_t canopen_mapping_find(int32_t mapped, unsigned access, canopen_object_t *object);

/* Whether a value may be written to an object of a PDO; CANOPEN_DONE for other objects. */
uint32_t canopen_mapping_check(const canopen_t *canopen, const canopen_object_t *object, int32_t value);

/* An object has been written. */
void canopen_mapping_written(canopen_t *canopen, const canopen_object_t *object);

#endif
