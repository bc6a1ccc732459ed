// Objects with one bit changed, as the memory of a processor may have them.
#pragma once

#include <cstdint>
#include <cstring>

// Calls f with a copy of the object for each of its bits, which is changed in it.
template <typename T, typename F> void with_each_bit_flipped(const T &object, F &&f) {
    for (size_t bit = 0; bit < 8 * sizeof object; bit++) {
        uint8_t bytes[sizeof object];
        std::memcpy(bytes, &object, sizeof object);
        bytes[bit / 8] = uint8_t(bytes[bit / 8] ^ 1u << bit % 8);
        T flipped;
        std::memcpy(&flipped, bytes, sizeof object);
        f(flipped);
    }
}
