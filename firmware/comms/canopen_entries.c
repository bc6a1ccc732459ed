#include "comms/canopen_entries.h"

#include "fixed/compiler.h"

/* Number of rows that begin at or before an entry. */
static unsigned rows_until(unsigned index, unsigned sub) {
    unsigned low = 0, high = CANOPEN_ROWS;
    while (low < high) {
        const unsigned middle = (low + high) / 2u;
        const canopen_row_t *row = &canopen_rows[middle];
        if (row->index < index || (row->index == index && row->first <= sub)) {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

/* First index of those alike; 0: there is no such object. */
static unsigned base_index(unsigned index) {
    const unsigned rows = rows_until(index, UINT8_MAX);
    if (rows == 0) {
        return 0;
    }
    const canopen_row_t *row = &canopen_rows[rows - 1u];
    return index - row->index < row->instances ? row->index : 0;
}

static void find_parameter(unsigned index, canopen_object_t *object) {
    const parameter_row_t *limits = parameters_row(index);
    object->row = (canopen_row_t){.index = CANOPEN_PARAMETERS,
                                  .instances = 1,
                                  .count = 1,
                                  .type = CANOPEN_I32,
                                  .access = CANOPEN_WRITE | CANOPEN_TPDO | CANOPEN_FROM,
                                  .value = CANOPEN_FROM_PARAMETER,
                                  .minimum = limits->minimum,
                                  .maximum = limits->maximum};
    object->instance = (uint8_t)index;
    object->element = 0;
}

COLD uint32_t canopen_find(unsigned index, unsigned sub, canopen_object_t *object) {
    object->index = (uint16_t)index;
    object->sub = (uint8_t)sub;
    if (index - CANOPEN_PARAMETERS < PARAMETER_COUNT) {
        find_parameter(index - CANOPEN_PARAMETERS, object);
        return sub == 0 ? CANOPEN_DONE : CANOPEN_NO_ENTRY;
    }
    const unsigned base = base_index(index);
    if (base == 0) {
        return CANOPEN_NO_OBJECT;
    }
    const canopen_row_t *row = &canopen_rows[rows_until(base, sub) - 1u]; /* each object has an entry 0 */
    if (sub - row->first >= row->count) {
        return CANOPEN_NO_ENTRY;
    }
    object->row = *row;
    object->instance = (uint8_t)(index - base);
    object->element = (uint8_t)(sub - object->row.first);
    return CANOPEN_DONE;
}

COLD unsigned canopen_bytes(const canopen_object_t *object) {
    switch (object->row.type) {
    case CANOPEN_I8:
    case CANOPEN_U8:
        return 1;
    case CANOPEN_I16:
    case CANOPEN_U16:
        return 2;
    case CANOPEN_I32:
    case CANOPEN_U32:
        return 4;
    default:
        return 0;
    }
}

COLD bool canopen_is_signed(const canopen_object_t *object) {
    return object->row.type == CANOPEN_I8 || object->row.type == CANOPEN_I16 || object->row.type == CANOPEN_I32;
}

COLD unsigned canopen_slot(const canopen_object_t *object) {
    const canopen_row_t *row = &object->row;
    if ((row->access & (CANOPEN_FROM | CANOPEN_CONSTANT)) != 0) {
        return CANOPEN_VALUE_COUNT;
    }
    return row->value + (unsigned)object->instance * row->count + object->element;
}

COLD int32_t canopen_unpack(const canopen_object_t *object, const uint8_t *data) {
    const unsigned bytes = canopen_bytes(object);
    uint32_t value = 0;
    for (unsigned i = 0; i < bytes; i++) {
        value |= (uint32_t)data[i] << (8u * i);
    }
    if (canopen_is_signed(object) && bytes < sizeof value && (value >> (8u * bytes - 1u) & 1u) != 0) {
        value |= UINT32_MAX << (8u * bytes);
    }
    return (int32_t)value;
}

COLD void canopen_pack(uint8_t *data, unsigned bytes, int32_t value) {
    for (unsigned i = 0; i < bytes; i++) {
        data[i] = (uint8_t)((uint32_t)value >> (8u * i));
    }
}
