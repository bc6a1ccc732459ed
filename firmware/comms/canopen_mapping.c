#include "comms/canopen_mapping.h"

#include <string.h>

#include "fixed/compiler.h"

#define TYPE_EVENT 254

/* Index, sub-index and bits of what a PDO has after a reset, besides control or statusword. */
#define MAPPED(index, sub, bits) ((int32_t)((uint32_t)(index) << 16 | (uint32_t)(sub) << 8 | (bits)))
static const int32_t receive_mapped[CANOPEN_PDOS] = {0, MAPPED(0x6060, 0, 8), MAPPED(0x60FF, 0, 32),
                                                     MAPPED(0x6071, 0, 16)};
static const int32_t transmit_mapped[CANOPEN_PDOS] = {0, MAPPED(0x6061, 0, 8), MAPPED(0x606C, 0, 32),
                                                      MAPPED(0x6077, 0, 16)};
#define MAPPED_CONTROLWORD MAPPED(0x6040, 0, 16)
#define MAPPED_STATUSWORD MAPPED(0x6041, 0, 16)
#define INHIBIT_INITIAL 100 /* 10 ms, of those with a measured value */

COLD void canopen_mapping_restart(canopen_t *canopen) {
    (void)memset(canopen->rpdo, 0, sizeof canopen->rpdo);
    (void)memset(canopen->tpdo, 0, sizeof canopen->tpdo);
}

COLD void canopen_mapping_reset(canopen_t *canopen) {
    int32_t *values = canopen->values;
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        const unsigned map = pdo * CANOPEN_MAPPED_MAX;
        values[CANOPEN_VALUE_RPDO_ID + pdo] = (int32_t)(0x200u + 0x100u * pdo + canopen->node);
        values[CANOPEN_VALUE_TPDO_ID + pdo] =
            (int32_t)(0x180u + 0x100u * pdo + canopen->node) | (int32_t)CANOPEN_PDO_NO_REMOTE;
        values[CANOPEN_VALUE_RPDO_MAP + map] = MAPPED_CONTROLWORD;
        values[CANOPEN_VALUE_TPDO_MAP + map] = MAPPED_STATUSWORD;
        values[CANOPEN_VALUE_RPDO_MAP + map + 1u] = receive_mapped[pdo];
        values[CANOPEN_VALUE_TPDO_MAP + map + 1u] = transmit_mapped[pdo];
        values[CANOPEN_VALUE_RPDO_COUNT + pdo] = values[CANOPEN_VALUE_TPDO_COUNT + pdo] = pdo == 0 ? 1 : 2;
        values[CANOPEN_VALUE_TPDO_INHIBIT + pdo] = pdo < 2u ? 0 : INHIBIT_INITIAL;
    }
    canopen_mapping_restart(canopen);
}

COLD bool canopen_mapping_is_free_id(uint32_t id) {
    return id > 0x180u && id < 0x6E0u && (id <= 0x580u || id >= 0x600u) && (id <= 0x600u || id > 0x67Fu);
}

COLD uint32_t canopen_mapping_find(int32_t mapped, unsigned access, canopen_object_t *object) {
    const uint32_t map = (uint32_t)mapped;
    const unsigned index = map >> 16, sub = map >> 8 & UINT8_MAX, bits = map & UINT8_MAX;
    if (index >= CANOPEN_I8 && index <= CANOPEN_U32 && sub == 0 && access == CANOPEN_RPDO) {
        *object =
            (canopen_object_t){.row = {.type = (uint8_t)index, .access = CANOPEN_CONSTANT}, .index = (uint16_t)index};
    } else {
        const uint32_t found = canopen_find(index, sub, object);
        if (found != CANOPEN_DONE) {
            return CANOPEN_NO_OBJECT;
        }
        if ((object->row.access & access) == 0) {
            return CANOPEN_NOT_MAPPABLE;
        }
    }
    return bits == 8u * canopen_bytes(object) ? CANOPEN_DONE : CANOPEN_MAPPING_LENGTH;
}

/* All objects of a mapping are good, and not longer than a frame; the controlword is among them once, so that no single
 * frame enables the drive. */
static uint32_t check_count(const canopen_t *canopen, unsigned map, int32_t count, unsigned access) {
    unsigned bytes = 0, controls = 0;
    for (unsigned i = 0; i < (unsigned)count; i++) {
        canopen_object_t object;
        const uint32_t found = canopen_mapping_find(canopen->values[map + i], access, &object);
        if (found != CANOPEN_DONE) {
            return found;
        }
        bytes += canopen_bytes(&object);
        controls += canopen_slot(&object) == CANOPEN_VALUE_CONTROLWORD ? 1u : 0u;
    }
    return bytes > 8u                                ? CANOPEN_MAPPING_LENGTH
           : controls > 1u && access == CANOPEN_RPDO ? CANOPEN_INCOMPATIBLE
                                                     : CANOPEN_DONE;
}

static uint32_t check_id(const canopen_t *canopen, unsigned value, unsigned pdo, uint32_t wanted) {
    const uint32_t extra = wanted & ~(CANOPEN_PDO_NOT_VALID | CANOPEN_PDO_NO_REMOTE | CANOPEN_PDO_ID);
    const uint32_t present = canopen_mapping_id(canopen, value, pdo);
    const bool changed = ((wanted ^ present) & CANOPEN_PDO_ID) != 0;
    const bool valid = (wanted & CANOPEN_PDO_NOT_VALID) == 0;
    if (extra != 0 || (valid && !canopen_mapping_is_free_id(wanted & CANOPEN_PDO_ID))) {
        return CANOPEN_VALUE;
    }
    return changed && valid && (present & CANOPEN_PDO_NOT_VALID) == 0 ? CANOPEN_STATE : CANOPEN_DONE;
}

static uint32_t check_type(int32_t type) {
    return type <= CANOPEN_PDO_SYNC_MAX || type >= TYPE_EVENT ? CANOPEN_DONE : CANOPEN_VALUE;
}

static uint32_t check_entry(const canopen_t *canopen, unsigned id, unsigned count, unsigned pdo, int32_t value,
                            unsigned access) {
    canopen_object_t mapped;
    if (canopen_mapping_is_valid(canopen, id, pdo) || canopen->values[count + pdo] != 0) {
        return CANOPEN_STATE;
    }
    return value == 0 ? CANOPEN_DONE : canopen_mapping_find(value, access, &mapped);
}

COLD uint32_t canopen_mapping_check(const canopen_t *canopen, const canopen_object_t *object, int32_t value) {
    const unsigned pdo = object->instance, map = pdo * CANOPEN_MAPPED_MAX;
    switch (object->row.value) {
    case CANOPEN_VALUE_RPDO_ID:
    case CANOPEN_VALUE_TPDO_ID:
        return check_id(canopen, object->row.value, pdo, (uint32_t)value);
    case CANOPEN_VALUE_RPDO_TYPE:
    case CANOPEN_VALUE_TPDO_TYPE:
        return check_type(value);
    case CANOPEN_VALUE_TPDO_INHIBIT:
        return canopen_mapping_is_valid(canopen, CANOPEN_VALUE_TPDO_ID, pdo) ? CANOPEN_STATE : CANOPEN_DONE;
    case CANOPEN_VALUE_RPDO_COUNT:
        return canopen_mapping_is_valid(canopen, CANOPEN_VALUE_RPDO_ID, pdo)
                   ? CANOPEN_STATE
                   : check_count(canopen, CANOPEN_VALUE_RPDO_MAP + map, value, CANOPEN_RPDO);
    case CANOPEN_VALUE_TPDO_COUNT:
        return canopen_mapping_is_valid(canopen, CANOPEN_VALUE_TPDO_ID, pdo)
                   ? CANOPEN_STATE
                   : check_count(canopen, CANOPEN_VALUE_TPDO_MAP + map, value, CANOPEN_TPDO);
    case CANOPEN_VALUE_RPDO_MAP:
        return check_entry(canopen, CANOPEN_VALUE_RPDO_ID, CANOPEN_VALUE_RPDO_COUNT, pdo, value, CANOPEN_RPDO);
    case CANOPEN_VALUE_TPDO_MAP:
        return check_entry(canopen, CANOPEN_VALUE_TPDO_ID, CANOPEN_VALUE_TPDO_COUNT, pdo, value, CANOPEN_TPDO);
    default:
        return CANOPEN_DONE;
    }
}

COLD void canopen_mapping_written(canopen_t *canopen, const canopen_object_t *object) {
    const unsigned pdo = object->instance % CANOPEN_PDOS;
    const unsigned value = object->row.value;
    if (value == CANOPEN_VALUE_RPDO_ID || value == CANOPEN_VALUE_RPDO_TYPE || value == CANOPEN_VALUE_RPDO_TIMER) {
        canopen->rpdo[pdo] = (canopen_rpdo_t){0};
    } else if (value == CANOPEN_VALUE_TPDO_ID || value == CANOPEN_VALUE_TPDO_TYPE) {
        canopen->tpdo[pdo] = (canopen_tpdo_t){0};
    }
}
