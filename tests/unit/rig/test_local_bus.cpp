// The local bus with well-behaved, malformed and stalled clients.
#include <sys/stat.h>

#include <atomic>
#include <fstream>
#include <thread>

#include "support/rig_bench.h"

namespace {

constexpr uint64_t MS = 1000000;

std::string open_error(const std::string &address) {
    char error[TRANSPORT_ERROR_SIZE] = "";
    transport_t *transport = transport_open(address.c_str(), error);
    if (transport) {
        transport_close(transport);
        return "";
    }
    return error;
}

TEST(LocalBus, InvalidAddressIsNamedInOneLine) {
    EXPECT_NE(open_error("tcp:1").find("tcp:1"), std::string::npos);
    EXPECT_NE(open_error("unix:").find("must be unix:PATH or socketcan:INTERFACE"), std::string::npos);
    EXPECT_NE(open_error("unix:/no/such/folder/bus").find("/no/such/folder/bus"), std::string::npos);
    EXPECT_NE(open_error("unix:" + std::string(200, 'x')).find("at most 107"), std::string::npos);
    EXPECT_NE(open_error("socketcan:" + std::string(40, 'x')).find("at most 15"), std::string::npos);
    EXPECT_NE(open_error("socketcan:nosuch0"), "");
    for (const char *address : {"tcp:1", "unix:/no/such/folder/bus", "socketcan:nosuch0"}) {
        EXPECT_EQ(open_error(address).find('\n'), std::string::npos);
    }
}

TEST(LocalBus, OnlyItsOwnerCanConnectWhateverTheUmask) {
    for (const mode_t mask : {0u, 022u, 077u, 0777u}) {
        const mode_t before = umask(mask);
        char folder[] = "/tmp/rig_bench_XXXXXX";
        const std::string path = std::string(mkdtemp(folder)) + "/bus";
        chmod(folder, 0700);
        char error[TRANSPORT_ERROR_SIZE] = "";
        transport_t *transport = transport_local_open(path.c_str(), error);
        umask(before);
        ASSERT_NE(transport, nullptr) << error;
        struct stat status;
        ASSERT_EQ(lstat(path.c_str(), &status), 0);
        EXPECT_EQ(status.st_mode, S_IFSOCK | 0600u) << std::oct << mask;
        transport_close(transport);
        std::filesystem::remove_all(folder);
    }
}

TEST(LocalBus, SocketInUseIsRejectedAndLeftUntouched) {
    RigBench bench;
    EXPECT_NE(open_error("unix:" + bench.path).find("in use"), std::string::npos);
    auto client = bench.connect();
    EXPECT_FALSE(bench.run_to(*client, MS).empty());
}

TEST(LocalBus, StaleSocketIsReplacedButAFileIsNot) {
    char folder[] = "/tmp/rig_bench_XXXXXX";
    std::string path = std::string(mkdtemp(folder)) + "/bus";
    // A socket without a server, as after a kill.
    int stale = socket(AF_UNIX, SOCK_SEQPACKET, 0);
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, path.c_str(), sizeof address.sun_path - 1);
    ASSERT_EQ(bind(stale, reinterpret_cast<sockaddr *>(&address), sizeof address), 0);
    close(stale);
    EXPECT_EQ(open_error("unix:" + path), "");
    struct stat status;
    EXPECT_NE(lstat(path.c_str(), &status), 0) << "removed when closed";
    std::ofstream(path) << "precious";
    EXPECT_NE(open_error("unix:" + path).find("not a socket"), std::string::npos);
    EXPECT_EQ(lstat(path.c_str(), &status), 0);
    std::filesystem::remove_all(folder);
}

TEST(LocalBus, EveryClientReceivesEveryFrameIncludingItsOwn) {
    RigBench bench;
    auto first = bench.connect();
    auto second = bench.connect();
    first->send(0x111, {1, 2, 3});
    second->run_until(5 * MS);
    bench.serve();
    auto at_first = first->receive();
    EXPECT_EQ(at_first, second->receive());
    unsigned echoes = 0;
    for (const auto &record : at_first) {
        echoes += record.identifier() == 0x111;
    }
    EXPECT_EQ(echoes, 1u);
}

TEST(LocalBus, ClientReceivesNothingFromBeforeItsConnection) {
    RigBench bench;
    auto first = bench.connect();
    bench.run_to(*first, 5 * MS);
    auto second = bench.connect();
    bench.run_to(*first, 10 * MS);
    auto records = second->receive();
    ASSERT_FALSE(records.empty());
    EXPECT_GE(records.front().time_ns, 5 * MS);
}

TEST(LocalBus, RecordsThatAreNotFramesAreIgnoredAndCounted) {
    testing::internal::CaptureStderr();
    {
        RigBench bench;
        auto client = bench.connect();
        auto malformed = bench.connect();
        std::vector<uint8_t> bytes(9000, 0xFF);
        for (size_t size : {1, 7, 8, 9, 23, 25, 79, 81, 9000}) {
            malformed->send_bytes(bytes.data(), size);
        }
        uint8_t record[8 + CAN_MTU] = {};
        record[8] = 0x00;
        record[9] = 0x08; // identifier 0x800 without the extended flag
        malformed->send_bytes(record, sizeof record);
        record[9] = 0;
        record[12] = 16; // length
        malformed->send_bytes(record, sizeof record);
        uint8_t flexible[8 + CANFD_MTU] = {};
        flexible[12] = 65;
        malformed->send_bytes(flexible, sizeof flexible);
        for (const auto &entry : bench.run_to(*client, 5 * MS)) {
            EXPECT_NE(entry.identifier(), 0u);
        }
        EXPECT_TRUE(bench.firmware.received.empty());
        EXPECT_FALSE(malformed->receive().empty()) << "still connected";
        malformed->send(0x123);
        bench.run_to(*client, 6 * MS);
        EXPECT_EQ(bench.firmware.received.size(), 1u);
    }
    EXPECT_NE(testing::internal::GetCapturedStderr().find("sent 12 records that are not frames"), std::string::npos);
}

TEST(LocalBus, FlexibleAndErrorFramesAreRelayedAndNotDelivered) {
    RigBench bench;
    auto client = bench.connect();
    auto other = bench.connect();
    uint8_t flexible[8 + CANFD_MTU] = {};
    flexible[8] = 0x45;
    flexible[12] = 64;
    flexible[13] = CANFD_BRS;
    flexible[16 + 63] = 0xA5;
    client->send_bytes(flexible, sizeof flexible);
    client->send(CAN_ERR_FLAG | 4, {1, 2, 3, 4, 5, 6, 7, 8});
    bench.serve();
    auto records = other->receive();
    ASSERT_EQ(records.size(), 2u) << "without time passing";
    EXPECT_EQ(records[0].size, size_t{CANFD_MTU});
    EXPECT_EQ(std::memcmp(&records[0].frame, flexible + 8, CANFD_MTU), 0);
    EXPECT_EQ(records[1].frame.can_id, CAN_ERR_FLAG | 4u);
    bench.run_to(*client, MS);
    EXPECT_TRUE(bench.firmware.received.empty());
}

TEST(LocalBus, RemoteAndRawLengthsArrive) {
    RigBench bench;
    auto client = bench.connect();
    client->send(0x123 | CAN_RTR_FLAG, {1, 2, 3}); // its data is ignored
    for (uint8_t raw = 9; raw <= 15; ++raw) {
        uint8_t record[8 + CAN_MTU] = {};
        record[8] = raw;
        record[12] = raw % 2 ? raw : 8; // in either field
        record[15] = raw % 2 ? 0 : raw;
        client->send_bytes(record, sizeof record);
    }
    auto records = bench.run_to(*client, 5 * MS);
    ASSERT_EQ(bench.firmware.received.size(), 8u);
    EXPECT_TRUE(bench.firmware.received[0].remote);
    EXPECT_EQ(bench.firmware.received[0].length, 3);
    EXPECT_EQ(bench.firmware.received[0].data[0], 0);
    for (unsigned i = 1; i < 8; ++i) {
        EXPECT_EQ(bench.firmware.received[i].length, 8 + i);
    }
    for (const auto &record : records) {
        if (record.identifier() == 9) {
            EXPECT_EQ(record.frame.len, 8);
            EXPECT_EQ(record.frame.__res1, 9) << "len8_dlc";
        }
    }
}

TEST(LocalBus, FramesOfAStalledClientAreDroppedInATimedPace) {
    // Neither time nor the other clients wait.
    RigBench bench("x1000");
    auto reader = bench.connect();
    auto stalled = bench.connect();
    reader->set(6, 20); // three truth frames each 20 us
    uint64_t frames = 0;
    testing::internal::CaptureStderr();
    while (bench.rig->board.time_ns < 400 * MS) {
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
        frames += reader->receive().size();
    }
    stalled.reset();
    ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    EXPECT_GT(frames, 59000u);
    EXPECT_NE(testing::internal::GetCapturedStderr().find("client 2"), std::string::npos);
}

TEST(LocalBus, StalledClientIsDisconnectedInTheFreePace) {
    // One that reads at any rate is not: time waits for it.
    RigBench bench("free");
    auto reader = bench.connect();
    auto stalled = bench.connect();
    reader->set(6, 20); // three truth frames each 20 us
    uint64_t frames = 0;
    testing::internal::CaptureStderr();
    while (bench.rig->board.time_ns < 400 * MS) {
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
        frames += reader->receive().size();
    }
    EXPECT_GT(frames, 59000u);
    EXPECT_NE(testing::internal::GetCapturedStderr().find("client 2 of " + bench.path + " disconnected"),
              std::string::npos);
    while (!stalled->gone && !stalled->receive().empty()) {
    }
    EXPECT_TRUE(stalled->gone);
}

// Counts the calls of the rig's transport->give_up: one when a client's queue is found full, then one in each round of
// the wait for room.
class WaitCounter {
  public:
    explicit WaitCounter(RigBench &bench) : transport(*bench.rig->config.transport) {
        give_up = transport.give_up;
        context = transport.give_up_context;
        transport.give_up_context = this;
        transport.give_up = [](void *counter) { return static_cast<WaitCounter *>(counter)->count(); };
    }
    ~WaitCounter() {
        transport.give_up = give_up;
        transport.give_up_context = context;
    }
    WaitCounter(const WaitCounter &) = delete;

    std::atomic<unsigned> calls = 0;

  private:
    bool count() {
        ++calls;
        calls.notify_one();
        return give_up(context);
    }

    transport_t &transport;
    bool (*give_up)(void *context);
    void *context;
};

TEST(LocalBus, TimeWaitsForAClientThatReads) {
    // It reads only when its queue is full and time waits; lock-step waits for any client, the free pace for one that
    // reads.
    for (const char *pace : {"lockstep", "free"}) {
        SCOPED_TRACE(pace);
        RigBench bench(pace);
        WaitCounter waits(bench);
        auto client = bench.connect();
        client->set(6, 20);
        client->run_until(400 * MS);
        uint64_t frames = 0, last_ns = 0;
        std::atomic<bool> done = false;
        std::thread server([&] {
            while (bench.rig->board.time_ns < 400 * MS && rig_serve(bench.rig.get(), 0)) {
            }
            done = true;
            ++waits.calls;
            waits.calls.notify_one();
        });
        for (unsigned seen = 0; !done;) {
            waits.calls.wait(seen);
            seen = waits.calls;
            for (const auto &record : client->receive()) {
                frames += 1;
                EXPECT_GE(record.time_ns, last_ns);
                last_ns = record.time_ns;
            }
        }
        server.join();
        frames += client->receive().size();
        EXPECT_GT(frames, 60000u) << "20,000 truths of three frames: none is lost";
        EXPECT_GT(waits.calls, 1u) << "the queue was full";
        EXPECT_FALSE(client->gone);
    }
}

TEST(LocalBus, StopRequestEndsTheWaitForAStalledClient) {
    RigBench bench;
    WaitCounter waits(bench);
    bench.rig->config.stop.context = &waits;
    // The second call comes from within the wait.
    bench.rig->config.stop.requested = [](void *context) { return static_cast<WaitCounter *>(context)->calls >= 2; };
    auto client = bench.connect();
    client->set(6, 20);
    client->run_until(100'000 * MS);
    while (bench.rig->board.time_ns < 100'000 * MS && rig_serve(bench.rig.get(), 0)) {
    }
    EXPECT_LT(bench.rig->board.time_ns, 100'000 * MS);
    EXPECT_FALSE(client->gone);
}

TEST(LocalBus, SixtyFourClientsAndNotMore) {
    RigBench bench;
    std::vector<std::unique_ptr<BusClient>> clients;
    testing::internal::CaptureStderr();
    for (int i = 0; i < 65; ++i) {
        clients.push_back(bench.connect());
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    }
    EXPECT_NE(testing::internal::GetCapturedStderr().find("64 clients"), std::string::npos);
    bench.run_to(*clients[0], 5 * MS);
    EXPECT_FALSE(clients[63]->receive().empty());
    clients[64]->receive();
    EXPECT_TRUE(clients[64]->gone);
}

TEST(LocalBus, ClientsMayLeaveAtAnyTime) {
    // Every kind of departure between every kind of traffic; the keeper's time continues.
    RigBench bench;
    auto keeper = bench.connect();
    for (unsigned i = 0; i < 200; ++i) {
        auto visitor = bench.connect();
        auto other = bench.connect();
        if (i & 1) {
            visitor->send(0x100, {1});
        }
        if (i & 2) {
            visitor->set(1, 100);
        }
        if (i & 4) {
            visitor->run_until((i + 1) * MS);
        }
        if (i & 8) {
            visitor.reset();
        }
        if (i & 16) {
            visitor = nullptr;
            uint8_t nothing = 0;
            other->send_bytes(&nothing, 0); // an empty record ends the connection
        }
        auto records = bench.run_to(*keeper, (i + 1) * MS);
        ASSERT_EQ(records.back().identifier(), RIG_CLOCK_FRAME_ID);
    }
}

} // namespace
