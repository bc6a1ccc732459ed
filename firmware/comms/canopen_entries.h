/* Entries of the object dictionary (objects.toml). Results are abort codes of CiA 301, 0 for success. */
#ifndef COMMS_CANOPEN_ENTRIES_H
#define COMMS_CANOPEN_ENTRIES_H

#include "comms/canopen_types.h"

typedef enum {
    CANOPEN_DONE = 0,
    CANOPEN_TOGGLE = 0x05030000,
    CANOPEN_COMMAND = 0x05040001,
    CANOPEN_BLOCK_SIZE = 0x05040002,
    CANOPEN_SEQUENCE = 0x05040003,
    CANOPEN_CRC = 0x05040004,
    CANOPEN_READ_ONLY = 0x06010002,
    CANOPEN_NO_OBJECT = 0x06020000,
    CANOPEN_NOT_MAPPABLE = 0x06040041,
    CANOPEN_MAPPING_LENGTH = 0x06040042,
    CANOPEN_INCOMPATIBLE = 0x06040043,
    CANOPEN_HARDWARE = 0x06060000,
    CANOPEN_LENGTH = 0x06070010,
    CANOPEN_TOO_LONG = 0x06070012,
    CANOPEN_TOO_SHORT = 0x06070013,
    CANOPEN_NO_ENTRY = 0x06090011,
    CANOPEN_VALUE = 0x06090030,
    CANOPEN_ABOVE = 0x06090031,
    CANOPEN_BELOW = 0x06090032,
    CANOPEN_OUT_OF_ORDER = 0x06090036,
    CANOPEN_NOT_STORED = 0x08000020,
    CANOPEN_STATE = 0x08000022,
    CANOPEN_NO_DATA = 0x08000024
} canopen_abort_t;

/* An entry of the dictionary: its row, and which of the alike it is. */
typedef struct {
    canopen_row_t row;
    uint8_t instance, element;
    uint16_t index;
    uint8_t sub;
} canopen_object_t;

/* Finds an entry: CANOPEN_NO_OBJECT, CANOPEN_NO_ENTRY. */
uint32_t canopen_find(unsigned index, unsigned sub, canopen_object_t *object);

/* Bytes of a number; 0 for texts and domains. */
unsigned canopen_bytes(const canopen_object_t *object);

/* The place of a variable in values[]; CANOPEN_VALUE_COUNT for any other entry. */
unsigned canopen_slot(const canopen_object_t *object);

/* A number from its bytes, low byte first, sign extended; and the reverse. */
int32_t canopen_unpack(const canopen_object_t *object, const uint8_t *data);
void canopen_pack(uint8_t *data, unsigned bytes, int32_t value);

/* True for a type that has a sign. */
bool canopen_is_signed(const canopen_object_t *object);

#endif
