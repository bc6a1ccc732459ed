// CRC-32 against its check value and a bit-by-bit computation.
#include <cstdint>
#include <random>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/crc32.h"
}

namespace {

uint32_t bit_by_bit(const std::vector<uint8_t> &bytes) {
    uint32_t crc = UINT32_MAX;
    for (const uint8_t byte : bytes) {
        crc ^= byte;
        for (int bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ ((crc & 1) != 0 ? 0xedb88320u : 0);
        }
    }
    return ~crc;
}

TEST(Crc32, of_the_check_text_is_that_of_ieee_802_3) {
    EXPECT_EQ(crc32_continue(0, "123456789", 9), 0xCBF43926u);
}

TEST(Crc32, in_two_parts_is_that_of_the_whole) {
    std::mt19937 random(1);
    for (unsigned count = 0; count < 600; count++) {
        std::vector<uint8_t> bytes(count);
        for (uint8_t &byte : bytes) {
            byte = static_cast<uint8_t>(random());
        }
        const unsigned first = count / 3;
        const uint32_t begun = crc32_continue(0, bytes.data(), first);
        EXPECT_EQ(crc32_continue(begun, bytes.data() + first, count - first), bit_by_bit(bytes));
    }
}

} // namespace
