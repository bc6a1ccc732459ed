// Machine tables in the memory: what a start finds, what writing leaves, and which tables no drive uses. [SR-61]
#include <cstring>
#include <functional>
#include <memory>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "layout_hash.h"
#include "storage/parameters.h"
#include "storage/table_store.h"
#include "support/power_cuts.h"
}

namespace {

constexpr unsigned FIRST_PAGE = 6, SLOT_PAGES = 5;
constexpr uint32_t RATE_HZ = 40000;
constexpr size_t BYTES = sizeof(machine_tables_t);

// The program's tables with a mark in a value that nothing checks.
machine_tables_t tables_of(uint32_t number) {
    machine_tables_t tables = machine_tables;
    tables.machine_hash = number;
    tables.pulse_index_scale += number;
    return tables;
}

class TableStore : public testing::Test {
  protected:
    TableStore() {
        nvm_init(&hal->nvm);
        table_store_init(&store, hal.get());
    }

    void start() {
        nvm_power_on(&hal->nvm);
        table_store_init(&store, hal.get());
    }

    // Steps until the store is not busy; each takes one operation of the memory at most.
    void settle() {
        for (unsigned steps = 0; table_store_busy(&store) && !hal->nvm.power_lost && steps < 100; steps++) {
            const uint32_t before = hal->nvm.operations;
            table_store_step(&store, hal.get(), true);
            EXPECT_LE(hal->nvm.operations - before, 1u);
        }
    }

    void begin() {
        table_store_begin(&store, hal.get());
        settle();
    }

    // In parts of a length; false when the store refuses one, or the power is lost.
    bool take(const machine_tables_t &tables, unsigned length = TABLE_STORE_TAKE_MAX, size_t end = BYTES) {
        const auto *bytes = reinterpret_cast<const uint8_t *>(&tables);
        for (size_t at = 0; at < end; at += length) {
            if (!table_store_take(&store, bytes + at, unsigned(std::min<size_t>(length, end - at)))) {
                return false;
            }
            settle();
        }
        return !hal->nvm.power_lost;
    }

    bool write(const machine_tables_t &tables, unsigned length = TABLE_STORE_TAKE_MAX) {
        begin();
        if (!take(tables, length) || !table_store_end(&store)) {
            return false;
        }
        settle();
        return store.state == TABLE_STORE_WRITTEN;
    }

    // Number of the tables that a start has, 0: the program's own.
    uint32_t started() {
        const machine_tables_t built_in = tables_of(0);
        const auto tables = std::make_unique<machine_tables_t>();
        const bool stored = table_store_load(hal.get(), RATE_HZ, &built_in, tables.get());
        const machine_tables_t expected = tables_of(tables->machine_hash);
        EXPECT_EQ(std::memcmp(tables.get(), &expected, sizeof expected), 0) << "a mixture";
        EXPECT_EQ(stored, tables->machine_hash != 0);
        return tables->machine_hash;
    }

    std::unique_ptr<hal_t> hal = std::make_unique<hal_t>();
    table_store_t store{};
};

TEST_F(TableStore, an_erased_memory_starts_with_the_tables_of_the_program) {
    EXPECT_EQ(started(), 0u);
    EXPECT_FALSE(table_store_busy(&store));
    EXPECT_TRUE(table_store_offered(&store));
    EXPECT_FALSE(table_store_offered(&(const table_store_t &)table_store_t{}));
}

TEST_F(TableStore, the_tables_that_were_written_last_are_those_of_the_next_start_whatever_the_parts_are_long) {
    for (uint32_t number = 1; number <= TABLE_STORE_TAKE_MAX; number++) {
        EXPECT_TRUE(write(tables_of(number), number)) << number;
        EXPECT_EQ(started(), number);
        start();
    }
}

TEST_F(TableStore, writes_two_slots_in_turn_and_no_other_page) {
    write(tables_of(1));
    for (unsigned page = 0; page < FIRST_PAGE; page++) {
        for (unsigned word = 0; word < HAL_NVM_PAGE_WORDS; word++) {
            ASSERT_EQ(hal->nvm.word[page][word], HAL_NVM_ERASED);
        }
    }
    for (uint32_t number = 2; number <= 5; number++) {
        const auto before = hal->nvm;
        ASSERT_TRUE(write(tables_of(number)));
        const unsigned other = number % 2 == 0 ? 0 : 1; // the slot that is kept
        for (unsigned page = 0; page < HAL_NVM_PAGES; page++) {
            const bool kept = page < FIRST_PAGE || (page - FIRST_PAGE) / SLOT_PAGES == other;
            EXPECT_TRUE(!kept || std::memcmp(before.word[page], hal->nvm.word[page], sizeof before.word[page]) == 0)
                << number << ", " << page;
        }
    }
}

TEST_F(TableStore, takes_bytes_only_after_a_begin_as_many_as_there_are_and_none_while_it_is_busy) {
    const machine_tables_t tables = tables_of(1);
    const auto *bytes = reinterpret_cast<const uint8_t *>(&tables);
    EXPECT_FALSE(table_store_take(&store, bytes, 1));
    EXPECT_FALSE(table_store_end(&store));
    table_store_begin(&store, hal.get());
    EXPECT_TRUE(table_store_busy(&store));
    EXPECT_FALSE(table_store_take(&store, bytes, 1)) << "it erases";
    settle();
    EXPECT_FALSE(table_store_take(&store, bytes, 0));
    EXPECT_FALSE(table_store_take(&store, bytes, TABLE_STORE_TAKE_MAX + 1));
    EXPECT_TRUE(table_store_take(&store, bytes, 6));
    EXPECT_FALSE(table_store_busy(&store));
    EXPECT_TRUE(table_store_take(&store, bytes + 6, 6));
    EXPECT_TRUE(table_store_busy(&store));
    EXPECT_FALSE(table_store_take(&store, bytes + 12, 6)) << "a word waits";
    EXPECT_FALSE(table_store_end(&store));
    settle();
    EXPECT_EQ(store.taken, 12u);
    EXPECT_FALSE(table_store_end(&store)) << "the others are missing";
    begin();
    ASSERT_TRUE(take(tables, 6, BYTES - 1));
    EXPECT_FALSE(table_store_end(&store)) << "one byte is missing";
    EXPECT_FALSE(table_store_take(&store, bytes + BYTES - 1, 2)) << "one too many";
    EXPECT_TRUE(table_store_take(&store, bytes + BYTES - 1, 1));
    EXPECT_EQ(started(), 0u) << "before the end";
    settle();
    EXPECT_TRUE(table_store_end(&store));
    EXPECT_FALSE(table_store_end(&store));
    settle();
    EXPECT_EQ(started(), 1u);
    EXPECT_FALSE(table_store_take(&store, bytes, 1)) << "another begin is needed";
}

TEST_F(TableStore, has_no_operation_of_the_memory_while_this_is_not_writable_or_nothing_is_due) {
    table_store_begin(&store, hal.get());
    for (int i = 0; i < 100; i++) {
        table_store_step(&store, hal.get(), false);
    }
    EXPECT_EQ(hal->nvm.operations, 0u);
    EXPECT_TRUE(table_store_busy(&store));
    settle();
    const uint32_t operations = hal->nvm.operations;
    EXPECT_GT(operations, 0u);
    for (int i = 0; i < 100; i++) {
        table_store_step(&store, hal.get(), true);
    }
    EXPECT_EQ(hal->nvm.operations, operations);
}

TEST_F(TableStore, a_transfer_that_is_given_up_leaves_the_tables_of_before_and_the_next_one_is_written) {
    const size_t ends[] = {0, 6, 600, BYTES - 2, BYTES};
    uint32_t newest = 0;
    for (const size_t end : ends) {
        begin();
        ASSERT_TRUE(take(tables_of(100), 6, end));
        EXPECT_EQ(started(), newest) << end;
        if (end != 600) {
            start();
        }
        ASSERT_TRUE(write(tables_of(++newest))) << end;
        EXPECT_EQ(started(), newest);
    }
}

TEST_F(TableStore, a_cut_at_any_operation_leaves_the_tables_of_before_or_the_new_ones) {
    write(tables_of(1));
    write(tables_of(2));
    const nvm_t before = hal->nvm;
    const uint32_t operations = [&] {
        const uint32_t from = hal->nvm.operations;
        write(tables_of(3));
        return hal->nvm.operations - from;
    }();
    EXPECT_EQ(operations, SLOT_PAGES + NVM_RING_OVERHEAD + 1 + (BYTES + 7) / 8);
    for (unsigned kind = 0; kind < NVM_CUT_KINDS; kind++) {
        // Every 97th of the words in the middle, which are alike.
        for (uint32_t cut = 1; cut <= operations; cut += cut < 10 || cut + 100 > operations ? 1 : 97) {
            hal->nvm = before;
            hal->nvm.random = cut;
            start();
            hal->nvm.cut_kind = nvm_cut_t(kind);
            hal->nvm.cut_after = cut;
            write(tables_of(3));
            ASSERT_TRUE(hal->nvm.power_lost);
            start();
            const uint32_t now = started();
            ASSERT_TRUE(now == 2 || (now == 3 && cut == operations)) << now << ", " << kind << ", " << cut;
            if (cut % 50 < 2) {
                ASSERT_TRUE(write(tables_of(4)));
                ASSERT_EQ(started(), 4u);
            }
        }
    }
}

TEST_F(TableStore, a_damaged_bit_of_the_newest_tables_gives_those_before_and_of_both_the_program_s) {
    write(tables_of(1));
    write(tables_of(2));
    std::mt19937 random(1);
    for (int trial = 0; trial < 100; trial++) {
        const nvm_t before = hal->nvm;
        const unsigned word = trial < 4 ? unsigned(trial) : random() % (NVM_RING_OVERHEAD + (BYTES + 7) / 8);
        const uint64_t bit = UINT64_C(1) << random() % 64;
        hal->nvm.word[FIRST_PAGE + SLOT_PAGES + word / HAL_NVM_PAGE_WORDS][word % HAL_NVM_PAGE_WORDS] ^= bit;
        ASSERT_EQ(started(), 1u) << word;
        hal->nvm.word[FIRST_PAGE + word / HAL_NVM_PAGE_WORDS][word % HAL_NVM_PAGE_WORDS] ^= bit;
        ASSERT_EQ(started(), 0u) << word;
        hal->nvm = before;
    }
    EXPECT_EQ(started(), 2u);
}

TEST_F(TableStore, a_word_that_the_memory_does_not_take_ends_the_transfer_and_the_tables_of_before_stay) {
    write(tables_of(1));
    hal->deaf_word = &hal->nvm.word[FIRST_PAGE + SLOT_PAGES + 1][7];
    EXPECT_FALSE(write(tables_of(2)));
    EXPECT_EQ(store.state, TABLE_STORE_FAILED);
    EXPECT_FALSE(table_store_busy(&store));
    EXPECT_EQ(started(), 1u);
    hal->deaf_word = nullptr;
    EXPECT_TRUE(write(tables_of(3)));
    EXPECT_EQ(started(), 3u);
    // The last words: checksum and commit.
    for (const unsigned back : {1u, 2u}) {
        start();
        const unsigned at = NVM_RING_OVERHEAD + 1 + unsigned((BYTES + 7) / 8) - back;
        hal->deaf_word = &hal->nvm.word[FIRST_PAGE + at / HAL_NVM_PAGE_WORDS][at % HAL_NVM_PAGE_WORDS];
        const nvm_t before = hal->nvm;
        EXPECT_FALSE(write(tables_of(4))) << back;
        EXPECT_EQ(store.state, TABLE_STORE_FAILED);
        EXPECT_EQ(started(), 3u);
        hal->nvm = before;
    }
}

TEST_F(TableStore, a_page_that_cannot_be_written_ends_the_transfer) {
    write(tables_of(1));
    hal->worn_page = FIRST_PAGE + SLOT_PAGES;
    table_store_begin(&store, hal.get());
    settle();
    EXPECT_EQ(store.state, TABLE_STORE_FAILED);
    EXPECT_EQ(started(), 1u);
}

TEST_F(TableStore, tables_of_another_program_or_size_are_not_used) {
    const machine_tables_t tables = tables_of(7);
    const uint64_t own = uint64_t(BYTES) << 32 | LAYOUT_HASH;
    for (const uint64_t identity : {own, own ^ 1, own ^ UINT64_C(1) << 32}) {
        nvm_init(&hal->nvm);
        nvm_ring_t ring;
        nvm_ring_init(&ring, hal.get(), FIRST_PAGE, NVM_RING_OVERHEAD + 1 + (BYTES + 7) / 8);
        for (nvm_ring_result_t result = NVM_RING_BUSY; result == NVM_RING_BUSY;) {
            uint64_t word = identity;
            const unsigned index = nvm_ring_payload_index(&ring);
            if (index >= 1 && 8 * (index - 1) < BYTES) {
                std::memcpy(&word, reinterpret_cast<const char *>(&tables) + 8 * (index - 1),
                            std::min<size_t>(8, BYTES - 8 * (index - 1)));
            }
            result = nvm_ring_step(&ring, hal.get(), word);
        }
        EXPECT_EQ(started(), identity == own ? 7u : 0u);
    }
}

TEST_F(TableStore, whole_tables_that_no_drive_can_use_leave_those_of_the_program) {
    write(tables_of(1));
    machine_tables_t wrong = tables_of(2);
    wrong.phases = 0;
    ASSERT_TRUE(write(wrong));
    EXPECT_EQ(started(), 0u);
    ASSERT_TRUE(write(tables_of(3)));
    EXPECT_EQ(started(), 3u);
}

// --- Usable tables ---

using change_t = std::function<void(machine_tables_t &)>;

bool usable_after(const change_t &change, uint32_t rate_hz = RATE_HZ) {
    machine_tables_t tables = machine_tables;
    change(tables);
    return table_store_usable(&tables, &machine_tables, rate_hz);
}

TEST(UsableTables, those_of_the_program_are_and_none_with_a_value_that_leads_out_of_an_array_or_divides_by_zero) {
    EXPECT_TRUE(usable_after([](machine_tables_t &) {}));
    const std::pair<const char *, change_t> changes[] = {
        {"no phase", [](auto &t) { t.phases = 0; }},
        {"two phases", [](auto &t) { t.phases = 2; }},
        {"seven phases", [](auto &t) { t.phases = HAL_PHASES_MAX + 1; }},
        {"no pole", [](auto &t) { t.rotor_poles = 0; }},
        {"unit of speed", [](auto &t) { t.speed_exponent = 4; }},
        {"shortest pulse", [](auto &t) { t.minimum_pulse_ns = 2001; }},
        {"curvature of the torque", [](auto &t) { t.torque_format.curvature_shift = 9; }},
        {"result of the torque", [](auto &t) { t.torque_format.result_shift = 13; }},
        {"curvature of the flux", [](auto &t) { t.flux_format.curvature_shift = 9; }},
        {"result of the flux", [](auto &t) { t.flux_format.result_shift = 13; }},
        {"rise of the current", [](auto &t) { t.current_slew_rate_A_s = 0; }},
        {"torque of the windows", [](auto &t) { t.sharing_torque = 0; }},
        {"range of the reference", [](auto &t) { t.speed_reference_max = 0; }},
        {"highest speed", [](auto &t) { t.speed_max_q22 = 0; }},
        {"first row", [](auto &t) { t.row[0].start = 1; }},
        {"last row", [](auto &t) { t.row[MACHINE_ROWS - 1].start--; }},
        {"last row twice", [](auto &t) { t.row[MACHINE_ROWS].start++; }},
        {"reciprocal of the last row", [](auto &t) { t.row[MACHINE_ROWS - 1].reciprocal = 1; }},
        {"and of its copy", [](auto &t) { t.row[MACHINE_ROWS].reciprocal = 1; }},
        {"rows that descend", [](auto &t) { std::swap(t.row[7].start, t.row[8].start); }},
        {"equal rows", [](auto &t) { t.row[7].start = t.row[8].start; }},
        {"narrow row", [](auto &t) { t.row[7].start = t.row[8].start - (1u << 17) + 1; }},
        {"wrong reciprocal", [](auto &t) { t.row[0].reciprocal++; }},
        {"row of the last bin", [](auto &t) { t.angle_bin_row[MACHINE_ANGLE_BINS - 1] = MACHINE_ROWS - 1; }},
        {"row far outside", [](auto &t) { t.angle_bin_row[0] = 255; }},
        {"row after the start of its bin", [](auto &t) { t.angle_bin_row[0] = 1; }},
        {"row that ends before its bin", [](auto &t) { t.angle_bin_row[MACHINE_ANGLE_BINS - 1] = 0; }},
        {"default above its limit",
         [](auto &t) {
             t.parameter_default[PARAMETER_CONTROLLER] = parameters_row(PARAMETER_CONTROLLER)->maximum + 1;
         }},
        {"default below its limit",
         [](auto &t) {
             t.parameter_default[PARAMETER_CONTROLLER] = parameters_row(PARAMETER_CONTROLLER)->minimum - 1;
         }},
        {"control rate", [](auto &t) { t.control_rate_min_hz = RATE_HZ + 1; }},
        {"range of the current", [](auto &t) { t.current_range_q9 += 2; }},
        {"range of the current", [](auto &t) { t.current_range_q9 -= 2; }},
        {"range of the voltage", [](auto &t) { t.voltage_range_q6 += 2; }},
        {"unit of the current alone", [](auto &t) { t.parameter_fraction_bits[PARAMETER_CURRENT_LIMIT_A]++; }},
        {"unit of the voltage alone", [](auto &t) { t.parameter_fraction_bits[PARAMETER_OVER_VOLTAGE_V]--; }},
        {"unit far away", [](auto &t) { t.parameter_fraction_bits[PARAMETER_CURRENT_LIMIT_A] += 32; }},
        {"unit as far below", [](auto &t) { t.parameter_fraction_bits[PARAMETER_CURRENT_LIMIT_A] -= 32; }},
    };
    for (const auto &[name, change] : changes) {
        EXPECT_FALSE(usable_after(change)) << name;
    }
    EXPECT_TRUE(usable_after([](auto &t) { t.control_rate_min_hz = RATE_HZ; }));
    EXPECT_FALSE(usable_after([](auto &t) { t.control_rate_min_hz = RATE_HZ; }, RATE_HZ - 1));
}

// Each with the reciprocals of its widths and with the bins of rows that ascend, so that nothing else is wrong.
TEST(UsableTables, rows_that_do_not_ascend_or_have_a_width_beyond_the_limits_are_not) {
    // Two rows share the width of the last two, in which the last bins begin.
    const auto shared = [](uint32_t width) {
        return usable_after([&](machine_tables_t &t) {
            const size_t row = MACHINE_ROWS - 3;
            t.row[row + 1].start = t.row[row].start + width;
            for (size_t i = row; i < row + 2; i++) {
                const uint32_t own = t.row[i + 1].start - t.row[i].start;
                t.row[i].reciprocal = own > 0 ? int32_t((INT64_C(1) << 46) / own) : 0;
            }
            for (uint32_t bin = 0; bin < MACHINE_ANGLE_BINS; bin++) {
                if (bin << MACHINE_ANGLE_BIN_BITS >= t.row[row].start) {
                    t.angle_bin_row[bin] = uint8_t(row + (bin << MACHINE_ANGLE_BIN_BITS >= t.row[row + 1].start));
                }
            }
        });
    };
    const uint32_t narrowest = 1u << 17, both = 0x80000000u - machine_tables.row[MACHINE_ROWS - 3].start;
    EXPECT_TRUE(shared(both / 2));
    EXPECT_TRUE(shared(narrowest));
    EXPECT_TRUE(shared(both - narrowest));
    EXPECT_FALSE(shared(narrowest - 1));
    EXPECT_FALSE(shared(both - narrowest + 1));
    EXPECT_FALSE(shared(0x80000000u)) << "a descent of half a revolution from the next row on";
    EXPECT_FALSE(shared(0x80000001u)) << "wider than half a revolution";
}

TEST(UsableTables, more_than_two_rows_that_begin_within_a_bin_are_not) {
    machine_tables_t tables = machine_tables;
    const uint32_t bin = 1u << MACHINE_ANGLE_BIN_BITS;
    // Equidistant rows but for the ones of one bin.
    const auto build = [&](unsigned within) {
        uint32_t start[MACHINE_ROWS];
        for (unsigned row = 0; row < MACHINE_ROWS - 1; row++) {
            start[row] = row * (0x80000000u / (MACHINE_ROWS - 1));
        }
        start[MACHINE_ROWS - 1] = 0x80000000u;
        for (unsigned row = 0; row < within; row++) {
            start[10 + row] = 20 * bin + (row + 1) * (bin / 8);
        }
        for (unsigned row = 0; row <= MACHINE_ROWS; row++) {
            const unsigned at = std::min<unsigned>(row, MACHINE_ROWS - 1);
            const uint32_t width = at < MACHINE_ROWS - 1 ? start[at + 1] - start[at] : 0;
            tables.row[row] = {start[at], width > 0 ? int32_t((INT64_C(1) << 46) / width) : 0};
        }
        for (unsigned i = 0; i < MACHINE_ANGLE_BINS; i++) {
            uint8_t row = 0;
            while (row + 2u < MACHINE_ROWS && start[row + 1] <= i * bin) {
                row++;
            }
            tables.angle_bin_row[i] = row;
        }
    };
    build(2);
    EXPECT_TRUE(table_store_usable(&tables, &machine_tables, RATE_HZ));
    build(3);
    EXPECT_FALSE(table_store_usable(&tables, &machine_tables, RATE_HZ));
}

TEST(UsableTables, the_same_range_of_a_sensor_in_another_unit_is) {
    for (const unsigned places : {1u, 2u, 3u}) {
        const auto coarser = [&](machine_tables_t &t, int of) {
            t.current_range_q9 = uint16_t((machine_tables.current_range_q9 >> places) + of);
            t.parameter_fraction_bits[PARAMETER_CURRENT_LIMIT_A] =
                int8_t(machine_tables.parameter_fraction_bits[PARAMETER_CURRENT_LIMIT_A] - int(places));
        };
        EXPECT_TRUE(usable_after([&](auto &t) { coarser(t, 0); })) << places;
        EXPECT_FALSE(usable_after([&](auto &t) { coarser(t, 3); })) << places;
        machine_tables_t built_in = machine_tables;
        coarser(built_in, 0);
        EXPECT_TRUE(table_store_usable(&machine_tables, &built_in, RATE_HZ)) << "the other way round";
    }
}

// A flipped bit of the store's own state writes no page that is not its own.
TEST_F(TableStore, a_flipped_bit_of_its_state_writes_within_its_slots_or_not_at_all) {
    write(tables_of(1));
    begin();
    take(tables_of(2), 6, 600);
    const table_store_t before = store;
    const auto nvm = std::make_unique<nvm_t>(hal->nvm);
    for (unsigned bit = 0; bit < 8 * sizeof store; bit++) {
        if (bit / 8 == offsetof(table_store_t, ring) + offsetof(nvm_ring_t, first_page)) {
            continue; // which the ring has no second copy of
        }
        store = before;
        reinterpret_cast<uint8_t *>(&store)[bit / 8] ^= uint8_t(1u << bit % 8);
        const uint8_t bytes[TABLE_STORE_TAKE_MAX] = {1, 2, 3, 4, 5, 6};
        table_store_take(&store, bytes, sizeof bytes);
        settle();
        table_store_take(&store, bytes, sizeof bytes);
        settle();
        table_store_end(&store);
        settle();
        for (unsigned page = 0; page < FIRST_PAGE; page++) {
            ASSERT_EQ(std::memcmp(nvm->word[page], hal->nvm.word[page], sizeof nvm->word[page]), 0) << bit;
        }
        if (bit % 8 == 0) {
            EXPECT_LE(started(), 1u) << bit;
        }
        hal->nvm = *nvm;
    }
}

} // namespace
