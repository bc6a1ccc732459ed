// A machine image against the same machine compiled in, and images that are not whole.
#include <cstdio>
#include <cstring>
#include <fstream>
#include <functional>
#include <iterator>
#include <string>
#include <vector>

#include <unistd.h>

#include <gtest/gtest.h>

extern "C" {
#include "control/machine_tables.h"
#include "hal.h"
#include "host/machine_image.h"
}

namespace {

using bytes_t = std::vector<char>;

constexpr size_t CRC_AT = 12, SIZES_AT = 16, HEADER_BYTES = 32;
enum { TABLES, PLANT, MAP, NAME };

std::string image_path() {
    return std::string(MACHINE_FOLDER) + "/" + machine_plant.name + "/machine.image";
}

bytes_t image_bytes() {
    std::ifstream file(image_path(), std::ios::binary);
    return {std::istreambuf_iterator<char>(file), {}};
}

uint32_t word_at(const bytes_t &bytes, size_t at) {
    uint32_t word;
    std::memcpy(&word, &bytes[at], sizeof word);
    return word;
}

void put_word(bytes_t &bytes, size_t at, uint32_t word) {
    std::memcpy(&bytes[at], &word, sizeof word);
}

// Bitwise from the polynomial's definition: the remainder of the message, most significant bit first.
uint32_t crc32(const char *bytes, size_t count) {
    const auto reversed = [](uint32_t value, int bits) {
        uint32_t result = 0;
        for (int bit = 0; bit < bits; bit++) {
            result |= (value >> bit & 1u) << (bits - 1 - bit);
        }
        return result;
    };
    uint32_t remainder = 0xffffffffu;
    for (size_t i = 0; i < count; i++) {
        remainder ^= reversed(uint8_t(bytes[i]), 8) << 24;
        for (int bit = 0; bit < 8; bit++) {
            remainder = remainder << 1 ^ (remainder >> 31 ? 0x04c11db7u : 0);
        }
    }
    return ~reversed(remainder, 32);
}

void seal(bytes_t &bytes) {
    put_word(bytes, CRC_AT, crc32(&bytes[SIZES_AT], bytes.size() - SIZES_AT));
}

struct outcome_t {
    bool good;
    std::string line;
};

// Opens the bytes as a file and fills tables from it.
outcome_t opened(const bytes_t &bytes) {
    const std::string path = testing::TempDir() + "machine_image_" + std::to_string(getpid());
    std::ofstream(path, std::ios::binary).write(bytes.data(), std::streamsize(bytes.size()));
    static machine_image_t image;
    static machine_tables_t tables;
    testing::internal::CaptureStderr();
    bool good = machine_image_open(&image, path.c_str());
    if (good) {
        good = machine_image_tables(&image, &machine_tables_structure, &tables);
        machine_image_close(&image);
    }
    std::string line = testing::internal::GetCapturedStderr();
    std::remove(path.c_str());
    return {good, line};
}

// One line that contains `expected`.
void expect_refused(const bytes_t &bytes, const std::string &expected, const std::string &what) {
    const outcome_t outcome = opened(bytes);
    ASSERT_FALSE(outcome.good) << what;
    ASSERT_EQ(outcome.line.rfind("salient: ", 0), 0u) << what << ": " << outcome.line;
    ASSERT_EQ(outcome.line.find('\n'), outcome.line.size() - 1) << what << ": " << outcome.line;
    ASSERT_NE(outcome.line.find(expected), std::string::npos) << what << ": " << outcome.line;
}

TEST(MachineImage, is_the_machine_compiled_in) {
    static machine_image_t image;
    static machine_tables_t tables;
    ASSERT_TRUE(machine_image_open(&image, image_path().c_str()));
    ASSERT_TRUE(machine_image_tables(&image, &machine_tables_structure, &tables));
    EXPECT_EQ(std::memcmp(&tables, &machine_tables, sizeof tables), 0);
    EXPECT_STREQ(image.machine.name, machine_plant.name);
    const flux_map_t *map = image.machine.magnetics.map, *compiled = machine_plant.magnetics.map;
    ASSERT_EQ(map != nullptr, compiled != nullptr);
    EXPECT_EQ(map != nullptr, machine_plant.magnetics.form == MAGNETICS_MAP);
    if (map) {
        EXPECT_EQ(std::memcmp(map, compiled, sizeof *map), 0);
    }
    image.machine.name = machine_plant.name;
    image.machine.magnetics.map = compiled;
    EXPECT_EQ(std::memcmp(&image.machine, &machine_plant, sizeof machine_plant), 0);
    machine_image_close(&image);
}

TEST(MachineImage, every_change_of_a_byte_is_noticed) {
    const bytes_t whole = image_bytes();
    ASSERT_TRUE(opened(whole).good);
    const size_t step = whole.size() / 500; // every byte of the header, and some of each part
    for (size_t at = 0; at < whole.size(); at += at < HEADER_BYTES ? 1 : step) {
        bytes_t changed = whole;
        changed[at] = char(changed[at] ^ (1 << at % 8));
        expect_refused(changed,
                       at < 8        ? "not a machine image"
                       : at < CRC_AT ? "another version"
                                     : "damaged",
                       "byte " + std::to_string(at));
    }
}

TEST(MachineImage, a_file_that_is_cut_or_longer_is_refused) {
    const bytes_t whole = image_bytes();
    for (size_t size = 0; size < whole.size(); size += size < 2 * HEADER_BYTES ? 1 : whole.size() / 100) {
        expect_refused(bytes_t(whole.begin(), whole.begin() + std::ptrdiff_t(size)),
                       size < HEADER_BYTES ? "not a machine image" : "damaged", std::to_string(size) + " bytes");
    }
    bytes_t longer = whole;
    longer.push_back('\0');
    expect_refused(longer, "damaged", "one byte more");
    seal(longer);
    expect_refused(longer, "wrong size", "one byte more, and the checksum of it");
}

// With the right checksum: what the image states must be what it has.
TEST(MachineImage, sizes_and_values_that_bound_memory_are_checked) {
    const bytes_t whole = image_bytes();
    const size_t plant_at = HEADER_BYTES + word_at(whole, SIZES_AT);
    const auto refused = [&](const std::string &expected, const std::string &what,
                             const std::function<void(bytes_t &)> &change) {
        bytes_t changed = whole;
        change(changed);
        seal(changed);
        expect_refused(changed, expected, what);
    };
    for (size_t part = TABLES; part <= NAME; part++) {
        for (const uint32_t by : {1u, 0xffffffffu, 0x7fffffffu, 0x80000000u}) {
            refused("wrong size", "part " + std::to_string(part), [&](bytes_t &bytes) {
                put_word(bytes, SIZES_AT + 4 * part, word_at(bytes, SIZES_AT + 4 * part) + by);
            });
        }
        // A byte of one part counted to the next.
        refused(part == NAME ? "damaged" : "wrong size", "border of part " + std::to_string(part), [&](bytes_t &bytes) {
            put_word(bytes, SIZES_AT + 4 * part, word_at(bytes, SIZES_AT + 4 * part) - 1);
            const size_t next = SIZES_AT + 4 * ((part + 1) % 4);
            put_word(bytes, next, word_at(bytes, next) + 1);
        });
    }
    refused("wrong size", "name without an end", [](bytes_t &bytes) { bytes.back() = 'x'; });
    for (const uint32_t phases : {0u, HAL_PHASES_MAX + 1u, 0xffffffffu}) {
        refused("out of range", "phases", [&](bytes_t &bytes) { put_word(bytes, plant_at + 8, phases); });
    }
    for (const uint32_t form : {machine_plant.magnetics.form == MAGNETICS_MAP ? 0u : 3u, 4u, 0xffffffffu}) {
        refused("out of range", "form", [&](bytes_t &bytes) { put_word(bytes, plant_at + 44, form); });
    }
}

TEST(MachineImage, what_is_no_file_is_named_with_the_reason) {
    machine_image_t image;
    const std::pair<const char *, const char *> cases[] = {
        {"/no/such/file", "No such file"}, {"/", "not a machine image"}, {"/dev/zero", "not a machine image"}};
    for (const auto &[path, expected] : cases) {
        testing::internal::CaptureStderr();
        EXPECT_FALSE(machine_image_open(&image, path));
        const std::string line = testing::internal::GetCapturedStderr();
        EXPECT_EQ(line.rfind(std::string("salient: ") + path + ": ", 0), 0u) << line;
        EXPECT_NE(line.find(expected), std::string::npos) << line;
    }
}

} // namespace
