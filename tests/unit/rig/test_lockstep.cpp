// Lock-step: time stands still until a client requests it; results depend neither on the wall clock nor on the way time
// is divided into requests.
#include "support/rig_bench.h"

namespace {

constexpr uint64_t MS = 1000000;

std::vector<BusRecord> without_clock(const std::vector<BusRecord> &records) {
    std::vector<BusRecord> result;
    for (const auto &record : records) {
        if (record.identifier() != RIG_CLOCK_FRAME_ID && record.identifier() != RIG_RUN_UNTIL_FRAME_ID) {
            result.push_back(record);
        }
    }
    return result;
}

TEST(RigLockstep, TimeStandsStillUntilRequested) {
    RigBench bench;
    auto client = bench.connect();
    client->send(0x123, {1});
    for (int i = 0; i < 10; ++i) {
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    }
    EXPECT_EQ(bench.rig->board.time_ns, 0u);
    EXPECT_EQ(bench.firmware.interrupts, 0u);

    client->run_until(10 * MS, 77);
    bench.serve();
    auto records = client->receive();
    ASSERT_FALSE(records.empty());
    EXPECT_EQ(records.front().identifier(), RIG_RUN_UNTIL_FRAME_ID) << "the client sees its own frame";
    EXPECT_EQ(records.front().time_ns, 0u);
    EXPECT_EQ(records.back().identifier(), RIG_CLOCK_FRAME_ID);
    EXPECT_EQ(records.back().time_ns, 10 * MS);
    EXPECT_EQ(records.back().frame.data[6], 77);
    EXPECT_EQ(bench.firmware.interrupts, 400u) << "first one after 25 us, the last at 10 ms itself";
    for (size_t i = 1; i < records.size(); ++i) {
        EXPECT_GE(records[i].time_ns, records[i - 1].time_ns);
    }
}

TEST(RigLockstep, PastTimeIsAnsweredWithThePresentTime) {
    RigBench bench;
    auto client = bench.connect();
    bench.run_to(*client, 5 * MS);
    client->run_until(2 * MS, 9);
    client->run_until(5 * MS, 10);
    bench.serve();
    auto records = client->receive();
    ASSERT_EQ(records.size(), 4u);
    for (int i : {1, 3}) {
        EXPECT_EQ(records[i].identifier(), RIG_CLOCK_FRAME_ID);
        EXPECT_EQ(records[i].time_ns, 5 * MS);
        EXPECT_EQ(records[i].frame.data[6], 9 + i / 2);
    }
}

// The same commands: alone, in pieces, with a second client that only listens.
std::vector<BusRecord> experiment(unsigned pieces, bool listener) {
    RigBench bench;
    auto client = bench.connect();
    auto other = listener ? bench.connect() : nullptr;
    std::vector<BusRecord> all;
    client->set(1, 30000);
    client->set(1, 50000, 7300);
    client->set(2, 200000, 11111);
    client->set(4, 3000, 15000);
    client->set(4, 0, 16000);
    for (unsigned i = 0; i < 5; ++i) {
        client->send(0x100 + i * 0x100, {static_cast<uint8_t>(i)});
    }
    for (unsigned i = 1; i <= pieces; ++i) {
        auto records = without_clock(bench.run_to(*client, 30 * MS * i / pieces));
        all.insert(all.end(), records.begin(), records.end());
        if (other) {
            other->receive();
        }
    }
    return all;
}

TEST(RigLockstep, SameInputsGiveTheSameFramesForAnyDivisionOfTime) {
    auto reference = experiment(1, false);
    ASSERT_GT(reference.size(), 100u);
    EXPECT_EQ(reference, experiment(1, false));
    EXPECT_EQ(reference, experiment(30, false));
    EXPECT_EQ(reference, experiment(7, true)); // 30 ms / 7 is not a multiple of any period of the rig
    EXPECT_EQ(reference, experiment(1000, true));
}

TEST(RigLockstep, FramesThatArriveWhileTimeRunsWaitUntilItStandsStill) {
    // The frame after RUN_UNTIL is in the socket before time runs, yet begins only when time stands still again.
    RigBench bench;
    auto client = bench.connect();
    client->run_until(10 * MS);
    client->send(0x123, {5});
    client->run_until(20 * MS);
    bench.serve();
    ASSERT_EQ(bench.firmware.received.size(), 1u);
    uint64_t completed_ns = 0;
    for (const auto &record : client->receive()) {
        if (record.identifier() == 0x123) {
            completed_ns = record.time_ns;
        }
    }
    EXPECT_GT(completed_ns, 10 * MS);
    EXPECT_LT(completed_ns, 10 * MS + 200000);
}

TEST(RigLockstep, OrderOnTheBusFollowsConnectionNotArrival) {
    std::vector<BusRecord> logs[2];
    for (int order : {0, 1}) {
        RigBench bench;
        auto first = bench.connect();
        auto second = bench.connect();
        for (int i = 0; i < 2; ++i) {
            auto &sender = (i == order) ? first : second;
            sender->send(i == order ? 0x201 : 0x202, {1});
            sender->send(i == order ? 0x101 : 0x102, {2});
            ASSERT_TRUE(rig_serve(bench.rig.get(), 0)); // each is read before the other is sent
        }
        logs[order] = without_clock(bench.run_to(*first, 5 * MS));
    }
    EXPECT_EQ(logs[0], logs[1]);
    std::vector<uint32_t> identifiers;
    for (const auto &record : logs[0]) {
        uint32_t id = record.identifier();
        if (id == 0x201 || id == 0x101 || id == 0x202 || id == 0x102) {
            identifiers.push_back(id);
        }
    }
    EXPECT_EQ(identifiers.at(0), 0x201u);
    EXPECT_EQ(identifiers.at(1), 0x101u);
}

TEST(RigLockstep, FramesSentBeforeAnothersRunUntilAreTakenBeforeIt) {
    RigBench bench;
    auto keeper = bench.connect();
    auto other = bench.connect();
    bench.run_to(*keeper, MS);
    other->set(1, 12345);
    other->send(0x321);
    auto late = bench.connect(); // connected and read before time runs, without a request for time
    late->send(0x322);
    bench.run_to(*keeper, 2 * MS);
    EXPECT_DOUBLE_EQ(bench.rig->plant.load_torque_Nm, 1.2345);
    EXPECT_EQ(bench.firmware.received.size(), 2u);
    EXPECT_EQ(late->receive().back().time_ns, 2 * MS);
}

TEST(RigLockstep, TwoTimekeepersAreAnsweredAtTheirTimes) {
    RigBench bench;
    auto first = bench.connect();
    auto second = bench.connect();
    first->run_until(3 * MS, 1);
    second->run_until(2 * MS, 2);
    bench.serve();
    std::vector<std::pair<uint64_t, int>> clocks;
    for (const auto &record : first->receive()) {
        if (record.identifier() == RIG_CLOCK_FRAME_ID) {
            clocks.emplace_back(record.time_ns, record.frame.data[6]);
        }
    }
    ASSERT_EQ(clocks.size(), 2u);
    EXPECT_EQ(clocks[0], std::make_pair(uint64_t{2 * MS}, 2));
    EXPECT_EQ(clocks[1], std::make_pair(uint64_t{3 * MS}, 1));
}

TEST(RigLockstep, ClientThatLeavesChangesNothingForTheOthers) {
    auto reference = [] {
        RigBench bench;
        auto client = bench.connect();
        auto visitor = bench.connect();
        visitor->send(0x155, {1});
        auto log = bench.run_to(*client, 10 * MS);
        auto rest = bench.run_to(*client, 20 * MS);
        log.insert(log.end(), rest.begin(), rest.end());
        return log;
    }();
    RigBench bench;
    auto client = bench.connect();
    auto visitor = bench.connect();
    visitor->send(0x155, {1});
    visitor.reset(); // its frame is still unread
    auto log = bench.run_to(*client, 10 * MS);
    auto rest = bench.run_to(*client, 20 * MS);
    log.insert(log.end(), rest.begin(), rest.end());
    EXPECT_EQ(log, reference);
    EXPECT_EQ(bench.firmware.received.size(), 1u);
}

TEST(RigLockstep, RunOfAClientThatLeftContinuesWithoutOtherClients) {
    RigBench bench;
    auto client = bench.connect();
    client->run_until(50 * MS);
    client.reset();
    bench.serve();
    EXPECT_EQ(bench.rig->board.time_ns, 50 * MS);
}

TEST(RigLockstep, RunOfAClientThatLeftIsAbandonedForAnotherClient) {
    RigBench bench;
    auto client = bench.connect();
    ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    client->run_until(1000'000 * MS);
    client->run_until(2000'000 * MS); // unread when the client leaves
    client.reset();
    auto other = bench.connect();
    other->run_until(0, 3);
    bench.serve();
    EXPECT_LE(bench.rig->board.time_ns, RIG_STOP_STEP_NS);
    unsigned answers = 0;
    for (const auto &record : other->receive()) {
        answers += record.identifier() == RIG_CLOCK_FRAME_ID && record.frame.data[6] == 3;
    }
    EXPECT_EQ(answers, 1u);
    const uint64_t now_ns = bench.rig->board.time_ns;
    bench.run_to(*other, now_ns + 5 * MS);
}

TEST(RigLockstep, RunOfAClientThatLeftIsAbandonedForAConnectedClient) {
    RigBench bench;
    auto other = bench.connect();
    auto client = bench.connect();
    other->run_until(30 * MS, 1);
    client->run_until(1000'000 * MS);
    ASSERT_TRUE(rig_serve(bench.rig.get(), 0)); // both are taken, time runs to 30 ms
    client.reset();
    other->receive();
    bench.run_to(*other, 40 * MS);
}

TEST(RigLockstep, RunIsNotAbandonedWhileItsClientLives) {
    RigBench bench;
    auto client = bench.connect();
    client->run_until(100 * MS);
    auto other = bench.connect();
    ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    EXPECT_EQ(bench.rig->board.time_ns, 100 * MS);
}

TEST(RigLockstep, StopIsCheckedEachTenMillisecondsAndWhenItsDescriptorIsReadable) {
    RigBench bench;
    auto client = bench.connect();
    int ends[2];
    ASSERT_EQ(pipe(ends), 0);
    unsigned checks = 0;
    bench.rig->config.stop.descriptors[0] = ends[0];
    bench.rig->config.stop.context = &checks;
    bench.rig->config.stop.requested = [](void *context) { return ++*static_cast<unsigned *>(context) > 11; };
    for (unsigned i = 1; i <= 100; ++i) {
        bench.run_to(*client, i * MS);
    }
    EXPECT_EQ(checks, 10u) << "once in ten milliseconds, however short the runs";
    bench.run_to(*client, 110 * MS);
    EXPECT_EQ(checks, 11u);
    ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    EXPECT_EQ(checks, 11u) << "no time passed, no descriptor readable";
    ASSERT_EQ(write(ends[1], "x", 1), 1);
    EXPECT_FALSE(rig_serve(bench.rig.get(), 0));
    EXPECT_EQ(checks, 12u);
    close(ends[0]);
    close(ends[1]);
}

TEST(RigLockstep, FloodFillsTheReceiveQueueAndIsCounted) {
    RigBench bench;
    auto client = bench.connect();
    // The interrupt keeps the background out for 9.99 ms, while a frame comes every 53 us.
    client->set(4, 999000);
    for (int i = 0; i < 150; ++i) {
        ASSERT_TRUE(client->send(0x000));
    }
    bench.run_to(*client, 9 * MS);
    EXPECT_EQ(bench.rig->board.receive_overflows, 150u - HAL_CAN_RECEIVE_QUEUE);
    EXPECT_TRUE(bench.firmware.received.empty());
    bench.run_to(*client, 11 * MS);
    EXPECT_EQ(bench.firmware.received.size(), size_t{HAL_CAN_RECEIVE_QUEUE});
}

TEST(RigLockstep, ClientThatFloodsTheBusQueueIsDisconnected) {
    RigBench bench;
    auto client = bench.connect();
    auto flooder = bench.connect();
    testing::internal::CaptureStderr();
    bool connected = true;
    for (unsigned i = 0; connected && i < 2 * CAN_BUS_CLIENT_QUEUE; ++i) {
        if (!flooder->send(0x7FF)) {
            if (errno == EPIPE || errno == ECONNRESET) {
                connected = false;
            }
            ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
        }
    }
    EXPECT_FALSE(connected);
    EXPECT_NE(testing::internal::GetCapturedStderr().find("client 2"), std::string::npos);
    client->receive();
    EXPECT_EQ(bench.run_to(*client, MS).back().identifier(), RIG_CLOCK_FRAME_ID);
}

} // namespace
