// Paces other than lock-step, without looking at the wall clock: what they do in virtual time.
#include "support/rig_bench.h"

namespace {

constexpr uint64_t MS = 1000000;

TEST(Pacing, Names) {
    pacing_t pacing;
    EXPECT_TRUE(pacing_parse(&pacing, "lockstep"));
    EXPECT_EQ(pacing.kind, PACING_LOCKSTEP);
    EXPECT_TRUE(pacing_parse(&pacing, "free"));
    EXPECT_EQ(pacing.kind, PACING_FREE);
    EXPECT_TRUE(pacing_parse(&pacing, "realtime"));
    EXPECT_EQ(pacing.factor, 1.0);
    EXPECT_TRUE(pacing_parse(&pacing, "x0.25"));
    EXPECT_EQ(pacing.kind, PACING_TIMED);
    EXPECT_EQ(pacing.factor, 0.25);
    for (const char *text :
         {"", "x", "x0", "x-1", "x1e3", "xnan", "xinf", "x0x10", "x1.2.3", "x.", "x1001", "10", "Free", "x 1"}) {
        EXPECT_FALSE(pacing_parse(&pacing, text)) << text;
    }
}

TEST(Pacing, FreeRunsToItsEndAndNoFurther) {
    RigBench bench("free", 12345678);
    while (rig_serve(bench.rig.get(), 0)) {
    }
    EXPECT_EQ(bench.rig->board.time_ns, 12345678u);
    EXPECT_EQ(bench.firmware.interrupts, 493u);
    rig_finish(bench.rig.get());
    EXPECT_EQ(bench.rig->plant.time_ns, 12345678u);
}

TEST(Pacing, MovingTimeStillAnswersRunUntilAtItsTime) {
    RigBench bench("free");
    auto client = bench.connect();
    client->run_until(3456789, 5);
    for (int i = 0; i < 6; ++i) {
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
    }
    uint64_t answered_ns = 0;
    for (const auto &record : client->receive()) {
        if (record.identifier() == RIG_CLOCK_FRAME_ID) {
            answered_ns = record.time_ns;
        }
    }
    EXPECT_EQ(answered_ns, 3456789u);
}

TEST(Pacing, FloodDelaysOnlyItsSender) {
    RigBench bench("free");
    auto flooder = bench.connect();
    auto other = bench.connect();
    unsigned sent = 0;
    auto fill = [&] {
        while (flooder->send(0x7F8, {1})) {
            ++sent;
        }
    };
    fill();
    other->send(0x7F0, {2}); // wins arbitration against any frame of the flooder
    uint64_t other_completed_ns = 0;
    while (bench.rig->board.time_ns < 500 * MS) {
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
        fill();
        flooder->receive();
        for (const auto &record : other->receive()) {
            if (record.identifier() == 0x7F0) {
                other_completed_ns = record.time_ns;
            }
        }
    }
    EXPECT_GT(other_completed_ns, 0u);
    EXPECT_LT(other_completed_ns, 2 * MS); // the clients are read each millisecond
    // The bus takes some 14 short frames a millisecond, and no more were taken from the flooder.
    EXPECT_GT(bench.firmware.received.size(), 500u * 8);
    EXPECT_LT(bench.firmware.received.size(), 500u * 18);
    EXPECT_EQ(bench.rig->board.receive_overflows, 0u);
    EXPECT_LE(can_bus_client_backlog(&bench.rig->bus, 1), size_t{RIG_MOVING_BACKLOG_MAX});
    EXPECT_LE(can_bus_client_backlog(&bench.rig->bus, 2), size_t{RIG_MOVING_BACKLOG_MAX});
    EXPECT_EQ(bench.firmware.interrupts, 20000u) << "control is not disturbed";
}

TEST(Pacing, FloodOfAHigherPriorityStarvesTheOthersOnTheBus) {
    RigBench bench("free");
    auto flooder = bench.connect();
    auto other = bench.connect();
    const auto fill = [&] {
        while (flooder->send(0x000, {1})) {
        }
    };
    other->send(0x7F0, {2});
    fill();
    unsigned completed = 0;
    while (bench.rig->board.time_ns < 100 * MS) {
        ASSERT_TRUE(rig_serve(bench.rig.get(), 0));
        fill();
        flooder->receive();
        for (const auto &record : other->receive()) {
            completed += record.identifier() == 0x7F0;
        }
    }
    EXPECT_EQ(completed, 0u);
    EXPECT_EQ(can_bus_client_backlog(&bench.rig->bus, 2), 1u) << "its controller still holds it";
}

} // namespace
