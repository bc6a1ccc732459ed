// The emulated bus: frame lengths on the wire, arbitration, order.
#include <gtest/gtest.h>

#include <cstring>
#include <random>
#include <vector>

extern "C" {
#include "rig/can_bus.h"
#include "rig/can_length.h"
}

namespace {

hal_can_frame_t frame(uint32_t identifier, std::vector<uint8_t> data = {}, bool extended = false, bool remote = false) {
    hal_can_frame_t result{};
    result.identifier = identifier;
    result.extended = extended;
    result.remote = remote;
    result.length = static_cast<uint8_t>(data.size());
    std::copy(data.begin(), data.end(), result.data);
    return result;
}

// The bits of a frame one by one, as ISO 11898-1 lists the fields: slow and plain, for comparison.
std::vector<int> wire_bits(const hal_can_frame_t &f, uint16_t *crc_out = nullptr) {
    std::vector<int> bits;
    auto put = [&bits](uint32_t value, int count) {
        for (int i = count - 1; i >= 0; --i) {
            bits.push_back(static_cast<int>(value >> i & 1));
        }
    };
    put(0, 1);
    if (f.extended) {
        put(f.identifier >> 18, 11);
        put(3, 2); // SRR, IDE
        put(f.identifier & 0x3FFFF, 18);
        put(f.remote, 1);
        put(0, 2);
    } else {
        put(f.identifier, 11);
        put(f.remote, 1);
        put(0, 2);
    }
    put(f.length, 4);
    for (int i = 0; i < (f.remote ? 0 : std::min<int>(f.length, 8)); ++i) {
        put(f.data[i], 8);
    }
    uint32_t crc = 0;
    for (int bit : bits) {
        bool invert = bit != static_cast<int>(crc >> 14 & 1);
        crc = crc << 1 & 0x7FFF;
        crc ^= invert ? 0x4599 : 0;
    }
    put(crc, 15);
    if (crc_out) {
        *crc_out = static_cast<uint16_t>(crc);
    }
    return bits;
}

unsigned plain_length(const hal_can_frame_t &f) {
    unsigned length = 0;
    int last = -1, run = 0;
    for (int bit : wire_bits(f)) {
        ++length;
        run = bit == last ? run + 1 : 1;
        last = bit;
        if (run == 5) {
            ++length;
            last = !bit;
            run = 1;
        }
    }
    return length + 10;
}

class CanLength : public testing::Test {
  protected:
    void SetUp() override { can_length_init(&tables); }
    unsigned bits(const hal_can_frame_t &f) const { return can_length_bits(&tables, &f); }
    can_length_t tables;
};

TEST_F(CanLength, KnownCrc) {
    // Worked by hand: the lone 1 of identifier 1 is followed by 7 + 15 zeros, so the remainder is x^22 mod the
    // polynomial; and a frame of zeros has remainder 0.
    uint32_t remainder = 1;
    for (int i = 0; i < 22; ++i) {
        remainder = remainder << 1;
        remainder ^= remainder & 0x8000 ? 0xC599 : 0;
    }
    auto one = frame(1), zero = frame(0);
    EXPECT_EQ(can_length_crc(&tables, &one), remainder);
    EXPECT_EQ(can_length_crc(&tables, &zero), 0);
}

TEST_F(CanLength, ShortestAndLongest) {
    // Identifier 0 without data is 34 zeros, its CRC being 0: a stuff bit after each five.
    EXPECT_EQ(bits(frame(0)), 44u + 6u);
    EXPECT_EQ(bits(frame(0, std::vector<uint8_t>(8, 0))), plain_length(frame(0, std::vector<uint8_t>(8, 0))));
    unsigned shortest = 1000;
    for (uint32_t identifier = 0; identifier < 0x800; ++identifier) {
        shortest = std::min(shortest, bits(frame(identifier, std::vector<uint8_t>(8), false, true)));
    }
    EXPECT_EQ(shortest, 44u);
}

TEST_F(CanLength, EqualsBitByBitForRandomFrames) {
    std::mt19937 random(20250101);
    unsigned longest = 0;
    for (int i = 0; i < 200000; ++i) {
        hal_can_frame_t f{};
        f.extended = random() & 1;
        f.remote = random() % 8 == 0;
        f.identifier = random() & (f.extended ? 0x1FFFFFFF : 0x7FF);
        f.length = static_cast<uint8_t>(random() % 16);
        // By chance hardly anything is stuffed. Long runs are, and runs of four that begin with a stuff bit most.
        unsigned kind = random() % 3, shift = random() % 8;
        for (auto &byte : f.data) {
            unsigned run = random() & 1 ? 0xFF : 0;
            byte = static_cast<uint8_t>(kind == 0 ? run : kind == 1 ? 0xF0F0u >> shift : random());
        }
        uint16_t crc;
        wire_bits(f, &crc);
        ASSERT_EQ(can_length_crc(&tables, &f), crc);
        ASSERT_EQ(bits(f), plain_length(f)) << "identifier " << f.identifier << " length " << int(f.length);
        if (!f.remote && f.length >= 8) {
            unsigned nominal = f.extended ? 128 : 108;
            longest = std::max(longest, bits(f) - nominal);
            // floor((34 + 8 * 8 - 1) / 4) and floor((54 + 8 * 8 - 1) / 4) stuff bits at most (Davis et al., 2007)
            ASSERT_LE(bits(f), nominal + (f.extended ? 29u : 24u));
        }
    }
    EXPECT_GE(longest, 20u) << "the worst cases were not met";
}

class CanBus : public testing::Test {
  protected:
    void SetUp() override { can_bus_init(&bus, 1000000); }

    unsigned bits(const hal_can_frame_t &f) const { return can_length_bits(&bus.lengths, &f); }

    // Runs until nothing is left to send.
    std::vector<std::pair<uint64_t, can_bus_delivery_t>> run() {
        std::vector<std::pair<uint64_t, can_bus_delivery_t>> result;
        while (bus.next_event_ns != CAN_BUS_NEVER) {
            uint64_t now_ns = bus.next_event_ns;
            can_bus_delivery_t delivery;
            if (can_bus_step(&bus, &delivery)) {
                result.emplace_back(now_ns, delivery);
            }
        }
        return result;
    }

    bool transmit(const hal_can_frame_t &f) { return can_bus_transmit(&bus, &f); }
    bool push(const hal_can_frame_t &f) { return can_bus_push(&bus, &f); }

    static can_bus_t bus; // too large for the stack
};

can_bus_t CanBus::bus;

TEST_F(CanBus, CompletesAfterItsBitsAndKeepsTheInterframeSpace) {
    EXPECT_EQ(bus.next_event_ns, CAN_BUS_NEVER);
    auto first = frame(0x123, {1, 2, 3}), second = frame(0x124, {4});
    transmit(first);
    EXPECT_TRUE(bus.start_requested);
    can_bus_start(&bus, 5000);
    EXPECT_FALSE(bus.start_requested);
    transmit(second);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 2u);
    uint64_t first_end_ns = 5000 + 1000 * bits(first);
    EXPECT_EQ(deliveries[0].first, first_end_ns);
    EXPECT_EQ(deliveries[1].first, first_end_ns + 1000 * (3 + bits(second)));
    EXPECT_EQ(std::memcmp(&deliveries[1].second.frame, &second, sizeof second), 0);
}

TEST_F(CanBus, StartsAtTheEndOfTheInterframeSpaceWhenQueuedInIt) {
    auto f = frame(0x7FF);
    transmit(f);
    can_bus_start(&bus, 0);
    can_bus_delivery_t delivery;
    uint64_t end_ns = bus.next_event_ns;
    ASSERT_TRUE(can_bus_step(&bus, &delivery));
    push(f);
    can_bus_start(&bus, end_ns + 1000);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 1u);
    EXPECT_EQ(deliveries[0].first, end_ns + 1000 * (3 + bits(f)));
    EXPECT_FALSE(deliveries[0].second.from_drive);
    // Long after that, without delay.
    transmit(f);
    can_bus_start(&bus, 90000000);
    EXPECT_EQ(run().at(0).first, 90000000 + 1000 * bits(f));
}

TEST_F(CanBus, LowestIdentifierOfTheMailboxesFirstAndEqualOnesInOrder) {
    ASSERT_TRUE(transmit(frame(0x300, {1})));
    ASSERT_TRUE(transmit(frame(0x300, {2})));
    ASSERT_TRUE(transmit(frame(0x200)));
    EXPECT_FALSE(transmit(frame(0x100))) << "three mailboxes are taken";
    can_bus_start(&bus, 0);
    can_bus_delivery_t delivery;
    ASSERT_TRUE(can_bus_step(&bus, &delivery));
    EXPECT_EQ(delivery.frame.identifier, 0x200u);
    ASSERT_TRUE(transmit(frame(0x300, {3}))) << "free again when its frame is complete";
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 3u);
    for (unsigned i = 0; i < 3; ++i) {
        EXPECT_EQ(deliveries[i].second.frame.data[0], i + 1);
    }
}

TEST_F(CanBus, ArbitrationFieldDecidesBetweenDriveAndClients) {
    struct {
        hal_can_frame_t winner, loser;
    } cases[] = {
        {frame(0x100), frame(0x101)},
        {frame(0x100), frame(0x100, {}, false, true)},                            // data before remote
        {frame(0x100), frame(0x100 << 18, {}, true)},                             // standard before extended
        {frame(0x100, {}, false, true), frame(0x100 << 18, {}, true)},            // even a remote one
        {frame((0x100 << 18) | 1, {}, true), frame(0x101)},                       // but the base counts first
        {frame((0x100 << 18) | 1, {}, true), frame((0x100 << 18) | 2, {}, true)}, // then the extension
        {frame((0x100 << 18) | 1, {}, true), frame((0x100 << 18) | 1, {}, true, true)},
    };
    for (const auto &c : cases) {
        for (bool drive_wins : {false, true}) {
            can_bus_init(&bus, 1000000);
            transmit(drive_wins ? c.winner : c.loser);
            push(drive_wins ? c.loser : c.winner);
            can_bus_start(&bus, 0);
            auto deliveries = run();
            ASSERT_EQ(deliveries.size(), 2u);
            EXPECT_EQ(deliveries[0].second.from_drive, drive_wins);
        }
    }
    can_bus_init(&bus, 1000000);
    push(frame(0x100));
    transmit(frame(0x100));
    can_bus_start(&bus, 0);
    EXPECT_TRUE(run().at(0).second.from_drive) << "equal: the drive";
}

TEST_F(CanBus, ClientsAreOneQueueThatItsHeadRepresents) {
    push(frame(0x700));
    push(frame(0x001));
    transmit(frame(0x300));
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 3u);
    EXPECT_EQ(deliveries[0].second.frame.identifier, 0x300u);
    EXPECT_EQ(deliveries[1].second.frame.identifier, 0x700u);
    EXPECT_EQ(deliveries[2].second.frame.identifier, 0x001u);
}

TEST_F(CanBus, ClientQueueIsBounded) {
    for (unsigned i = 0; i < CAN_BUS_CLIENT_QUEUE; ++i) {
        ASSERT_TRUE(push(frame(i & 0x7FF)));
    }
    EXPECT_FALSE(push(frame(0)));
    EXPECT_EQ(can_bus_client_backlog(&bus), CAN_BUS_CLIENT_QUEUE);
    can_bus_start(&bus, 0);
    EXPECT_EQ(run().size(), CAN_BUS_CLIENT_QUEUE);
    EXPECT_EQ(can_bus_client_backlog(&bus), 0u);
}

TEST_F(CanBus, BitRateScalesAndDoesNotDrift) {
    can_bus_init(&bus, 83333);
    auto f = frame(0x2A5, {0x5A, 0xA5});
    for (int i = 0; i < 1000; ++i) {
        push(f);
    }
    can_bus_start(&bus, 0);
    auto deliveries = run();
    // Each frame begins on a whole nanosecond, so at most one is lost to rounding a frame.
    double exact_ns = 1000.0 * (bits(f) + 3) * 1e9 / 83333 - 3e9 / 83333;
    EXPECT_LE(deliveries.back().first, exact_ns);
    EXPECT_GE(deliveries.back().first, exact_ns - 1001);
}

} // namespace
