// The emulated bus: frame lengths on the wire, arbitration, order.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <random>
#include <vector>

extern "C" {
#include "rig/can_bus.h"
#include "rig/can_length.h"
#include "rig/can_wire.h"
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
    void SetUp() override { can_bus_init(&bus, 1000000, 1); }
    void TearDown() override { can_bus_close(&bus); }

    void restart(uint32_t bit_rate = 1000000) {
        can_bus_close(&bus);
        can_bus_init(&bus, bit_rate, 1);
    }

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

    bool transmit(const hal_can_frame_t &f) { return can_bus_transmit(&bus, 0, &f); }
    bool push(const hal_can_frame_t &f, uint32_t client = 1) { return can_bus_push(&bus, client, &f); }

    // Delivery at the next event, or nothing; the event's time.
    std::pair<uint64_t, bool> step() {
        uint64_t now_ns = bus.next_event_ns;
        return {now_ns, can_bus_step(&bus, &delivered)};
    }

    // Runs all events up to a time; the deliveries with theirs.
    std::vector<std::pair<uint64_t, can_bus_delivery_t>> run_to(uint64_t time_ns) {
        std::vector<std::pair<uint64_t, can_bus_delivery_t>> result;
        while (bus.next_event_ns <= time_ns) {
            auto [now_ns, complete] = step();
            if (complete) {
                result.emplace_back(now_ns, delivered);
            }
        }
        return result;
    }

    can_node_t &client(unsigned index) { return bus.clients[index]->node; }

    can_bus_t bus;
    can_bus_delivery_t delivered;
};

constexpr uint64_t US = 1000; // one bit at 1 Mbit/s

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
    ASSERT_TRUE(transmit(frame(0x200)));
    ASSERT_TRUE(transmit(frame(0x300, {1})));
    ASSERT_TRUE(transmit(frame(0x300, {2})));
    EXPECT_FALSE(transmit(frame(0x100))) << "three mailboxes are taken";
    can_bus_start(&bus, 0);
    can_bus_delivery_t delivery;
    ASSERT_TRUE(can_bus_step(&bus, &delivery));
    EXPECT_EQ(delivery.frame.identifier, 0x200u);
    EXPECT_FALSE(transmit(frame(0x300, {3}))) << "from mailbox 0 it would leave first";
    ASSERT_TRUE(transmit(frame(0x300, {4}, true))) << "29 bits are another identifier";
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 3u);
    EXPECT_EQ(deliveries[0].second.frame.data[0], 4) << "which begins with zeros, and wins";
    EXPECT_EQ(deliveries[1].second.frame.data[0], 1);
    EXPECT_EQ(deliveries[2].second.frame.data[0], 2);
    ASSERT_TRUE(transmit(frame(0x300, {3}))) << "free again when their frames are complete";
}

TEST_F(CanBus, FrameOfAnIdentifierTakesAFreeMailboxAboveTheOthers) {
    ASSERT_TRUE(transmit(frame(0x100)));
    ASSERT_TRUE(transmit(frame(0x300, {1})));
    can_bus_start(&bus, 0);
    can_bus_delivery_t delivery;
    ASSERT_TRUE(can_bus_step(&bus, &delivery));
    ASSERT_TRUE(transmit(frame(0x300, {2}))) << "the third, not the first";
    ASSERT_TRUE(transmit(frame(0x200)));
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 3u);
    EXPECT_EQ(deliveries[1].second.frame.data[0], 1);
    EXPECT_EQ(deliveries[2].second.frame.data[0], 2);
}

TEST_F(CanBus, PortThatChoosesItsMailboxMayLetAFrameOvertake) {
    const hal_can_frame_t first = frame(0x300, {1}), second = frame(0x300, {2});
    ASSERT_TRUE(can_bus_transmit_from(&bus, 0, 1, &first));
    EXPECT_FALSE(can_bus_transmit_from(&bus, 0, 1, &second)) << "taken";
    ASSERT_TRUE(can_bus_transmit_from(&bus, 0, 0, &second));
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 2u);
    EXPECT_EQ(deliveries[0].second.frame.data[0], 2);
    EXPECT_EQ(deliveries[1].second.frame.data[0], 1);
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
            restart();
            transmit(drive_wins ? c.winner : c.loser);
            push(drive_wins ? c.loser : c.winner);
            can_bus_start(&bus, 0);
            auto deliveries = run();
            ASSERT_EQ(deliveries.size(), 2u);
            EXPECT_EQ(deliveries[0].second.from_drive, drive_wins);
        }
    }
    restart();
    push(frame(0x100));
    transmit(frame(0x100));
    can_bus_start(&bus, 0);
    EXPECT_TRUE(run().at(0).second.from_drive) << "equal: the drive";
}

TEST_F(CanBus, ClientIsAQueueThatItsHeadRepresents) {
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
    EXPECT_EQ(can_bus_client_backlog(&bus, 1), CAN_BUS_CLIENT_QUEUE);
    can_bus_start(&bus, 0);
    EXPECT_EQ(run().size(), CAN_BUS_CLIENT_QUEUE);
    EXPECT_EQ(can_bus_client_backlog(&bus, 1), 0u);
}

TEST_F(CanBus, BitRateScalesAndDoesNotDrift) {
    restart(83333);
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

TEST_F(CanBus, EachClientIsANodeOfItsOwn) {
    push(frame(0x700), 1);
    push(frame(0x701), 1);
    push(frame(0x600), 2);
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 3u);
    EXPECT_EQ(deliveries[0].second.frame.identifier, 0x600u) << "not behind the first client's frames";
    EXPECT_TRUE(deliveries[0].second.from_client);
    EXPECT_EQ(deliveries[2].second.frame.identifier, 0x701u);
    can_bus_remove_clients(
        &bus, [](void *, uint32_t number) { return number == 2; }, nullptr);
    EXPECT_FALSE(can_bus_has_client(&bus, 1));
    EXPECT_TRUE(can_bus_has_client(&bus, 2));
}

TEST_F(CanBus, FramesThatAreEqualInEveryBitAreOneFrame) {
    push(frame(0x123, {1, 2}), 1);
    push(frame(0x123, {1, 2}), 2);
    transmit(frame(0x123, {1, 2}));
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 1u);
    EXPECT_TRUE(deliveries[0].second.from_drive);
    EXPECT_FALSE(deliveries[0].second.to_drives);
    EXPECT_EQ(bus.drives[0].node.transmit_errors + client(0).transmit_errors + client(1).transmit_errors, 0u);
}

// Start of frame and identifier 0x555 alternate; RTR, IDE, r0 and two bits of the length are five zeros, so a stuff bit
// follows; bits 18 and 19 end the length 1; bit 20 is the first data bit: dominant in 0x55, recessive in 0xD5. Its
// error flag is bits 21 to 26. The receivers see the sixth dominant bit at bit 25: their flags are bits 26 to 31. With
// eight bits of delimiter the error frame ends after 40 bits, and the next frame starts at bit 43.
TEST_F(CanBus, SameIdentifierWithOtherDataIsABitErrorAndBothCountersClimb) {
    const auto dominant = frame(0x555, {0x55}), recessive = frame(0x555, {0xD5});
    transmit(recessive);
    push(dominant);
    can_bus_start(&bus, 0);
    for (unsigned i = 0; i < 16; ++i) {
        EXPECT_EQ(step(), std::make_pair((43 * i + 40) * US, false));
        EXPECT_EQ(bus.drives[0].node.transmit_errors, 8 * (i + 1));
        EXPECT_EQ(client(0).transmit_errors, 8 * (i + 1));
        EXPECT_EQ(step().first, 43 * (i + 1) * US);
    }
    // Both are error passive now: they wait for eight bits more, and the one with the bit error has no flag that others
    // see. The other one completes, is error active again, and the first one follows after another eight bits.
    const uint64_t start_ns = (43 * 16 + 8) * US, length = bits(dominant);
    EXPECT_EQ(step().first, start_ns);
    EXPECT_EQ(step(), std::make_pair(start_ns + length * US, true));
    EXPECT_EQ(delivered.frame.data[0], 0x55);
    EXPECT_TRUE(delivered.to_drives) << "the drive sees its own identifier";
    EXPECT_EQ(bus.drives[0].node.transmit_errors, 136u);
    EXPECT_EQ(client(0).transmit_errors, 127u);
    auto rest = run();
    ASSERT_EQ(rest.size(), 1u);
    EXPECT_EQ(rest[0].first, start_ns + (length + 3 + 8 + bits(recessive)) * US);
    EXPECT_EQ(bus.drives[0].node.transmit_errors, 135u);
}

TEST_F(CanBus, ThreeNodesWithOneIdentifierAllDeliverInTheEnd) {
    push(frame(0x100, {1}), 1);
    push(frame(0x100, {2}), 2);
    push(frame(0x100, {3}), 3);
    can_bus_start(&bus, 0);
    EXPECT_EQ(run_to(100 * 1000 * US).size(), 3u);
}

TEST_F(CanBus, SecondSenderOfItsIdentifierDrivesANodeToBusOff) {
    // Each pair of frames starts together. The sender of the recessive bit gains 8 - 1, the other one less.
    bool off = false;
    for (unsigned i = 0; i < 200 && !off; ++i) {
        transmit(frame(0x180, {0xFF}));
        push(frame(0x180, {0x00}));
        can_bus_start(&bus, bus.shared.idle_from_ns + 100 * US);
        run_to(bus.shared.idle_from_ns + 5000 * US);
        off = bus.drives[0].node.bus_off;
    }
    EXPECT_TRUE(off);
    EXPECT_FALSE(client(0).bus_off);
}

// Alone on the bus: error in the acknowledge slot, eight bits before the end of frame; flag 6, delimiter 8, interframe
// space 3: the next frame starts 9 bits after the end of the complete frame; eight more once error passive.
TEST_F(CanBus, AloneIsErrorPassiveAndNeverBusOff) {
    can_bus_disconnect(&bus, 0, true);
    const auto f = frame(0x155, {1, 2, 3});
    transmit(f);
    can_bus_start(&bus, 0);
    uint64_t start_ns = 0;
    for (unsigned i = 1; i <= 1000; ++i) {
        EXPECT_EQ(step(), std::make_pair(start_ns + (bits(f) + 6) * US, false));
        ASSERT_EQ(bus.drives[0].node.transmit_errors, i < 16 ? 8 * i : 128u);
        start_ns += (bits(f) + 9 + (i < 16 ? 0 : 8)) * US;
        while (bus.drives[0].alone.state == can_line_t::CAN_LINE_IDLE) {
            step();
        }
        ASSERT_EQ(bus.drives[0].alone.frame_start_ns, start_ns);
    }
    EXPECT_TRUE(can_node_is_passive(&bus.drives[0].node));
    push(frame(0x100)); // the rest of the bus works
    can_bus_start(&bus, start_ns);
    auto deliveries = run_to(start_ns + 1000 * US);
    ASSERT_EQ(deliveries.size(), 1u);
    EXPECT_FALSE(deliveries[0].second.to_drives);
    can_bus_disconnect(&bus, 0, false);
    deliveries = run_to(start_ns + 2000 * US);
    ASSERT_EQ(deliveries.size(), 1u) << "its frame is acknowledged at last";
    EXPECT_TRUE(deliveries[0].second.from_drive);
    EXPECT_EQ(bus.drives[0].node.transmit_errors, 127u);
}

TEST_F(CanBus, BusOffEndsOnRequestAfter128Times11RecessiveBits) {
    transmit(frame(0x100));
    transmit(frame(0x101));
    can_bus_set_transmit_errors(&bus, 0, 256);
    EXPECT_TRUE(bus.drives[0].node.bus_off);
    EXPECT_FALSE(transmit(frame(0x102)));
    can_bus_start(&bus, 0);
    push(frame(0x200)); // works without the drive, which does not see it
    can_bus_start(&bus, 1000 * US);
    auto deliveries = run_to(5000 * US);
    ASSERT_EQ(deliveries.size(), 1u);
    EXPECT_FALSE(deliveries[0].second.to_drives);
    EXPECT_TRUE(bus.drives[0].node.bus_off) << "not by itself";
    can_bus_rejoin(&bus, 0, 10000 * US);
    can_bus_start(&bus, 10000 * US);
    EXPECT_EQ(bus.next_event_ns, (10000 + 128 * 11) * US);
    EXPECT_TRUE(run().empty()) << "its mailboxes were emptied";
    EXPECT_FALSE(bus.drives[0].node.bus_off);
    EXPECT_EQ(bus.drives[0].node.transmit_errors, 0u);
    EXPECT_TRUE(transmit(frame(0x102)));
}

TEST_F(CanBus, ResetOfADriveCutsItsFrameOffWithAnErrorAndEmptiesItsMailboxes) {
    for (unsigned cut = 1; cut < bits(frame(0x100, {1, 2, 3, 4})); ++cut) {
        restart();
        for (uint32_t identifier : {0x100, 0x101, 0x102}) {
            transmit(frame(identifier, {1, 2, 3, 4}));
        }
        push(frame(0x200));
        can_bus_start(&bus, 0);
        can_bus_reset_drive(&bus, 0, cut * US);
        can_bus_start(&bus, cut * US);
        ASSERT_TRUE(transmit(frame(0x300)) && transmit(frame(0x301)) && transmit(frame(0x302))) << "all are free";
        const auto deliveries = run();
        ASSERT_EQ(deliveries.size(), 4u) << cut;
        const uint64_t error_ns = (cut + 6 + 6 + 8 + 3) * US;
        EXPECT_EQ(deliveries[0].second.frame.identifier, 0x200u);
        EXPECT_EQ(deliveries[0].first, error_ns + bits(frame(0x200)) * US);
        EXPECT_EQ(deliveries[0].second.to_drives, 1u);
        EXPECT_EQ(deliveries[3].second.frame.identifier, 0x302u);
        EXPECT_EQ(client(0).transmit_errors + bus.drives[0].node.transmit_errors, 0u);
        EXPECT_EQ(bus.drives[0].node.receive_errors, 0u) << "it was not there";
    }
}

TEST_F(CanBus, ResetOfADriveEndsBusOffAndDoesNotReceiveTheFrameUnderWay) {
    can_bus_set_transmit_errors(&bus, 0, 256);
    push(frame(0x200));
    push(frame(0x201));
    can_bus_start(&bus, 0);
    can_bus_reset_drive(&bus, 0, 10 * US);
    can_bus_start(&bus, 10 * US);
    EXPECT_FALSE(bus.drives[0].node.bus_off);
    EXPECT_EQ(bus.drives[0].node.transmit_errors, 0u);
    const auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 2u);
    EXPECT_EQ(deliveries[0].first, bits(frame(0x200)) * US) << "the frame of another node ends as it would";
    EXPECT_EQ(deliveries[0].second.to_drives, 0u);
    EXPECT_EQ(deliveries[1].second.to_drives, 1u);
}

TEST_F(CanBus, ResetOfOneOfTwoSendersOfAFrameLeavesItToTheOther) {
    transmit(frame(0x100, {1, 2}));
    push(frame(0x100, {1, 2}));
    can_bus_start(&bus, 0);
    can_bus_reset_drive(&bus, 0, 30 * US);
    can_bus_start(&bus, 30 * US);
    const auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 1u);
    EXPECT_EQ(deliveries[0].first, bits(frame(0x100, {1, 2})) * US);
    EXPECT_FALSE(deliveries[0].second.from_drive);
    EXPECT_TRUE(deliveries[0].second.from_client);
}

TEST_F(CanBus, OnAFullBusEachFrameEndsWithElevenRecessiveBits) {
    can_bus_set_transmit_errors(&bus, 0, 256);
    for (unsigned i = 0; i < 300; ++i) {
        push(frame(0x200, {static_cast<uint8_t>(i)}));
    }
    can_bus_rejoin(&bus, 0, 10 * US);
    can_bus_start(&bus, 10 * US);
    unsigned frames = 0;
    while (bus.drives[0].node.bus_off) {
        frames += step().second;
        ASSERT_LE(frames, 128u);
    }
    EXPECT_EQ(frames, 128u);
}

TEST_F(CanBus, ClientsLeaveBusOffByThemselves) {
    push(frame(0x100));
    can_node_set_transmit_errors(&client(0), 250);
    bus.faults.fault = CAN_FAULT_CORRUPTED;
    can_bus_start(&bus, 0);
    step();
    EXPECT_TRUE(client(0).bus_off);
    bus.faults.fault = CAN_FAULT_NONE;
    push(frame(0x101));
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 1u);
    EXPECT_GE(deliveries[0].first, 128u * 11 * US);
    EXPECT_EQ(deliveries[0].second.frame.identifier, 0x101u) << "what was in the mailbox is lost";
}

TEST_F(CanBus, CorruptedFrameIsRepeatedAfterAnErrorFrame) {
    bus.faults.fault = CAN_FAULT_CORRUPTED;
    std::vector<uint64_t> lengths;
    for (unsigned i = 0; i < 500; ++i) {
        restart();
        bus.faults.fault = CAN_FAULT_CORRUPTED;
        bus.faults.random_state = i;
        const auto f = frame(0x2A5, {0x5A, 0xA5, 0x00, 0xFF});
        push(f);
        can_bus_start(&bus, 0);
        auto [end_ns, complete] = step();
        ASSERT_FALSE(complete);
        ASSERT_EQ(client(0).transmit_errors, 8u);
        ASSERT_EQ(bus.drives[0].node.receive_errors, 1u);
        // Control field to the sixth last bit of the CRC, flag 6 to 12, delimiter 8.
        ASSERT_GE(end_ns, (13 + 1 + 6 + 8) * US);
        ASSERT_LE(end_ns, (bits(f) - 10 - 6 + 12 + 8) * US);
        lengths.push_back(end_ns);
        auto deliveries = run();
        ASSERT_EQ(deliveries.size(), 1u) << "repeated once";
        ASSERT_EQ(deliveries[0].first, end_ns + (3 + bits(f)) * US);
        ASSERT_EQ(client(0).transmit_errors, 7u);
        ASSERT_EQ(bus.drives[0].node.receive_errors, 0u);
    }
    std::sort(lengths.begin(), lengths.end());
    EXPECT_LT(lengths.front() + 40 * US, lengths.back()) << "any bit";
}

TEST_F(CanBus, DuplicatedFrameIsReceivedTwice) {
    bus.faults.fault = CAN_FAULT_DUPLICATED;
    const auto f = frame(0x100, {1});
    push(f);
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 2u);
    // Flag of the transmitter and, a bit later, of the receivers: 7 bits; delimiter 8; interframe space 3.
    EXPECT_EQ(deliveries[1].first, (2 * bits(f) + 7 + 8 + 3) * US);
    EXPECT_TRUE(deliveries[1].second.to_drives && deliveries[0].second.to_drives);
    EXPECT_FALSE(deliveries[0].second.from_client);
    EXPECT_TRUE(deliveries[1].second.from_client);
    EXPECT_EQ(client(0).transmit_errors, 7u);
}

TEST_F(CanBus, LostFrameIsOnTheBusButNotReceived) {
    bus.faults.fault = CAN_FAULT_LOST;
    bus.faults.sender = CAN_FAULT_OF_DRIVE;
    push(frame(0x100));
    transmit(frame(0x101));
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 2u);
    EXPECT_TRUE(deliveries[0].second.to_drives && deliveries[0].second.to_clients);
    EXPECT_FALSE(deliveries[1].second.to_clients);
    EXPECT_EQ(bus.drives[0].node.transmit_errors, 0u) << "acknowledged";
}

TEST_F(CanBus, DelayedFrameStaysInItsSender) {
    bus.faults.fault = CAN_FAULT_DELAYED;
    bus.faults.delay_ns = 500 * US;
    bus.faults.sender = CAN_FAULT_OF_OTHERS;
    push(frame(0x100));
    transmit(frame(0x300));
    can_bus_start(&bus, 0);
    auto deliveries = run();
    ASSERT_EQ(deliveries.size(), 2u);
    EXPECT_EQ(deliveries[0].second.frame.identifier, 0x300u);
    EXPECT_EQ(deliveries[1].first, 500 * US + bits(frame(0x100)) * US);
}

TEST_F(CanBus, FaultsChooseTheirShareOfTheFrames) {
    bus.faults.fault = CAN_FAULT_LOST;
    bus.faults.per_mille = 250;
    for (unsigned i = 0; i < 4000; ++i) {
        push(frame(0x100, {static_cast<uint8_t>(i)}));
    }
    can_bus_start(&bus, 0);
    unsigned lost = 0;
    for (const auto &[time_ns, delivery] : run()) {
        lost += !delivery.to_drives;
    }
    EXPECT_NEAR(lost, 1000, 150);
}

TEST_F(CanBus, BabblingNodeTakesItsShareOfTheBus) {
    for (unsigned load : {100u, 50u, 10u}) {
        restart();
        bus.babble.load = load;
        bus.babble.length = 8;
        can_bus_babble(&bus, 0);
        push(frame(0x001));
        can_bus_start(&bus, 0);
        double busy = 0;
        unsigned others = 0;
        for (const auto &[time_ns, delivery] : run_to(1000 * 1000 * US)) {
            busy += delivery.frame.identifier == 0 ? bits(delivery.frame) + 3 : 0;
            others += delivery.frame.identifier != 0;
        }
        EXPECT_NEAR(busy / 1e6, load / 100.0, 0.005);
        EXPECT_EQ(others, load == 100 ? 0u : 1u) << "identifier 0 always wins";
        EXPECT_EQ(bus.babbler.transmit_errors, 0u);
    }
    bus.babble.load = 0;
    can_bus_babble(&bus, 2000 * 1000 * US);
    can_bus_start(&bus, 2000 * 1000 * US);
    EXPECT_TRUE(run().empty());
}

TEST_F(CanLength, WireHasTheSameBits) {
    std::mt19937 random(20250102);
    for (int i = 0; i < 20000; ++i) {
        hal_can_frame_t f{};
        f.extended = random() & 1;
        f.remote = random() % 8 == 0;
        f.identifier = random() & (f.extended ? 0x1FFFFFFF : 0x7FF);
        f.length = static_cast<uint8_t>(random() % 16);
        for (auto &byte : f.data) {
            byte = static_cast<uint8_t>(random() % 3 ? random() : 0);
        }
        can_wire_t wire;
        can_wire_of(&tables, &f, &wire);
        ASSERT_EQ(wire.bits + 10, bits(f));
        ASSERT_GE(wire.arbitration_bits, f.extended ? 33u : 14u);
    }
}

} // namespace
