// End-to-end protection as a sender applies it (e2e.h); the firmware only checks.
#pragma once

#include <cstddef>
#include <cstdint>

extern "C" {
#include "comms/e2e.h"
}

// Writes counter and checksum into a frame of `length` >= E2E_HEADER_BYTES bytes whose data is in place.
inline void e2e_protect(uint16_t data_id, uint8_t counter, uint8_t *bytes, size_t length) {
    bytes[2] = counter;
    const uint8_t id[2] = {uint8_t(data_id), uint8_t(data_id >> 8)};
    const uint16_t crc = e2e_crc16(e2e_crc16(0xFFFF, bytes + 2, length - 2), id, sizeof id);
    bytes[0] = uint8_t(crc);
    bytes[1] = uint8_t(crc >> 8);
}
