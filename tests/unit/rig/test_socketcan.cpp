// Frames and timestamps of the SocketCAN transport. One end of a socket pair stands in for the interface; the real one
// is used by the tests that run where there is PF_CAN.
#include "support/rig_bench.h"

namespace {

constexpr uint64_t MS = 1000000;

class SocketCan : public testing::Test {
  protected:
    void SetUp() override {
        int pair[2];
        ASSERT_EQ(socketpair(AF_UNIX, SOCK_SEQPACKET, 0, pair), 0);
        int bytes = 4 << 20;
        setsockopt(pair[0], SOL_SOCKET, SO_SNDBUFFORCE, &bytes, sizeof bytes);
        bench = std::make_unique<RigBench>(transport_socketcan_attach(pair[0]), "lockstep");
        client = pair[1];
    }
    void TearDown() override { close(client); }

    void send(canid_t identifier, const std::vector<uint8_t> &data) {
        can_frame frame{};
        frame.can_id = identifier;
        frame.len = static_cast<uint8_t>(data.size());
        std::copy(data.begin(), data.end(), frame.data);
        ASSERT_EQ(::send(client, &frame, sizeof frame, 0), ssize_t{sizeof frame});
    }

    void run_until(uint64_t time_ns) {
        std::vector<uint8_t> data(7);
        std::memcpy(data.data(), &time_ns, 6);
        send(RIG_RUN_UNTIL_FRAME_ID | CAN_EFF_FLAG, data);
        bench->serve();
    }

    // Assigns a time to each frame on the interface, as rig.dbc specifies for a logger.
    std::vector<std::pair<uint64_t, uint32_t>> timed(const std::vector<uint32_t> &sent_on_bus,
                                                     const std::vector<uint32_t> &sent_off_bus) {
        std::vector<std::pair<uint64_t, uint32_t>> result;
        uint64_t next_ns = 0;
        size_t on_bus = 0, off_bus = 0;
        can_frame frame;
        while (recv(client, &frame, sizeof frame, MSG_DONTWAIT) == sizeof frame) {
            uint32_t identifier = frame.can_id & CAN_EFF_MASK;
            uint64_t time_ns = 0;
            std::memcpy(&time_ns, frame.data, 6);
            if (identifier == RIG_STAMP_FRAME_ID) {
                if (frame.data[6] == RIG_STAMP_SUBJECT_NEXT_CHOICE ||
                    frame.data[6] == RIG_STAMP_SUBJECT_NEXT_OF_ANY_NODE_CHOICE) {
                    next_ns = time_ns;
                } else if (frame.data[6] == RIG_STAMP_SUBJECT_OLDEST_ON_BUS_CHOICE) {
                    result.emplace_back(time_ns, sent_on_bus.at(on_bus++));
                } else {
                    result.emplace_back(time_ns, sent_off_bus.at(off_bus++));
                }
            } else {
                result.emplace_back(identifier == RIG_CLOCK_FRAME_ID ? time_ns : next_ns, identifier);
            }
        }
        return result;
    }

    std::unique_ptr<RigBench> bench;
    int client = -1;
};

TEST_F(SocketCan, TimestampsGiveTheSameListAsTheLocalBus) {
    send(0x100, {1, 2});
    send(RIG_SET_FRAME_ID | CAN_EFF_FLAG, {1, 0, 0, 1, 0, 0, 0, 0});
    send(0x200, {3});
    run_until(10 * MS);
    auto here = timed({0x100, 0x200}, {RIG_SET_FRAME_ID, RIG_RUN_UNTIL_FRAME_ID});

    RigBench local;
    auto client = local.connect();
    client->send(0x100, {1, 2});
    client->send(RIG_SET_FRAME_ID | CAN_EFF_FLAG, {1, 0, 0, 1, 0, 0, 0, 0});
    client->send(0x200, {3});
    std::vector<std::pair<uint64_t, uint32_t>> there;
    for (const auto &record : local.run_to(*client, 10 * MS)) {
        there.emplace_back(record.time_ns, record.identifier());
    }
    EXPECT_EQ(here, there);
    EXPECT_GT(here.size(), 30u);
}

TEST_F(SocketCan, FramesOfABabblingNodeAreSentWithTheirTime) {
    const uint8_t babble_load_percent = 46;
    send(RIG_SET_FRAME_ID | CAN_EFF_FLAG, {babble_load_percent, 0x10, 0x27, 0, 0, 0, 0, 0}); // 100 %
    send(0x100, {1, 2});
    run_until(10 * MS);
    unsigned babbled = 0;
    uint64_t last_ns = 0;
    for (const auto &[time_ns, identifier] : timed({0x100}, {RIG_SET_FRAME_ID, RIG_RUN_UNTIL_FRAME_ID})) {
        if (identifier == 0) {
            EXPECT_GT(time_ns, last_ns);
            last_ns = time_ns;
            ++babbled;
        } else {
            EXPECT_NE(identifier, 0x100u) << "has no time: it does not win arbitration";
        }
    }
    EXPECT_NEAR(babbled, 10000 / 140, 8); // with many stuff bits: zeros
}

TEST_F(SocketCan, UnstampedTransportSendsTheFramesOfTheEmulatorAndNoOthers) {
    bench->transport->unstamped = true;
    send(0x100, {1, 2});
    run_until(10 * MS);
    std::vector<uint32_t> identifiers;
    can_frame frame;
    while (recv(client, &frame, sizeof frame, MSG_DONTWAIT) == sizeof frame) {
        identifiers.push_back(frame.can_id & CAN_EFF_MASK);
    }
    EXPECT_EQ(std::count(identifiers.begin(), identifiers.end(), RIG_STAMP_FRAME_ID), 0);
    EXPECT_EQ(identifiers.back(), uint32_t{RIG_CLOCK_FRAME_ID});
    EXPECT_GT(identifiers.size(), 30u);
}

TEST_F(SocketCan, InterfaceThatGoesAwayEndsTheRig) {
    close(client);
    client = -1;
    EXPECT_FALSE(rig_serve(bench->rig.get(), 0));
    ASSERT_NE(bench->transport->failure, nullptr);
}

} // namespace
