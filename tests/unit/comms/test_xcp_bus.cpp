// XCP on a bus of three mailboxes: telemetry and responses of parameters leave as without a measurement.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <deque>
#include <map>
#include <memory>
#include <random>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "comms/comms.h"
#include "drive/telemetry_collect.h"
#include "drive_codec.h"
#include "hal_nvm.h"
}
#include "support/frames.h"

// A bus on which a frame, once it has begun, is not interrupted; it keeps its mailbox until its end.
struct hal {
    struct sent_t {
        hal_can_frame_t frame;
        uint32_t time_us;
    };
    std::deque<hal_can_frame_t> received;
    std::vector<hal_can_frame_t> mailboxes;
    std::vector<sent_t> sent;
    unsigned foreign = 0; // frames of other nodes that wait, all of a higher priority
    unsigned left = 0;    // steps of the frame on the bus
    bool own = false;     // it is the drive's: its mailbox is the first one
    hal_can_error_state_t state = HAL_CAN_ERROR_ACTIVE;

    void step(uint32_t time_us, unsigned steps_of_frame) {
        if (left > 0 && --left == 0 && own) {
            sent.push_back({mailboxes.front(), time_us});
            mailboxes.erase(mailboxes.begin());
        }
        if (left > 0 || (foreign == 0 && mailboxes.empty())) {
            return;
        }
        own = foreign == 0;
        foreign -= own ? 0 : 1;
        left = steps_of_frame;
        if (own) {
            std::iter_swap(mailboxes.begin(),
                           std::min_element(mailboxes.begin(), mailboxes.end(),
                                            [](const auto &a, const auto &b) { return a.identifier < b.identifier; }));
        }
    }
};

extern "C" {
bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    if (hal->received.empty()) {
        return false;
    }
    *frame = hal->received.front();
    hal->received.pop_front();
    return true;
}
uint32_t hal_can_receive_overflows(const hal_t *) {
    return 0;
}
uint64_t hal_nvm_read(const hal_t *, unsigned, unsigned) {
    return HAL_NVM_ERASED;
}
bool hal_nvm_program(hal_t *, unsigned, unsigned, uint64_t) {
    return false;
}
bool hal_nvm_erase(hal_t *, unsigned) {
    return false;
}
uint32_t hal_random_u32(hal_t *) {
    return 4711;
}
bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    if (hal->mailboxes.size() == HAL_CAN_MAILBOXES) {
        return false;
    }
    hal->mailboxes.push_back(*frame);
    return true;
}
void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    *status = {};
    status->state = hal->state;
    status->transmitting = !hal->mailboxes.empty();
}
void hal_can_rejoin(hal_t *) {}
}

namespace {

constexpr uint32_t STEP_US = 25;
constexpr unsigned STEPS_OF_FRAME = 5;

hal_can_frame_t xcp_command(const std::vector<uint8_t> &bytes, unsigned node = 0) {
    hal_can_frame_t frame{};
    frame.identifier = DRIVE_XCP_COMMAND_FRAME_ID + node * 16;
    frame.length = uint8_t(bytes.size());
    std::copy(bytes.begin(), bytes.end(), frame.data);
    return frame;
}

// A drive and its bus.
struct World {
    explicit World(unsigned node = 0) : node(node) {
        std::memset(drive.get(), 0, sizeof *drive);
        drive->control.state_machine.state = DRIVE_STATE_RUN;
        parameters_init(&drive->parameters);
        parameters_set(&drive->parameters, PARAMETER_TELEMETRY_PERIOD_MS, 1);
        comms_init(&comms, node, 0);
        xcp_init(&comms.xcp, drive.get(), DRIVE_WORDS, &drive->sampler);
    }

    // A list of `frames` frames at every control period.
    void measure(unsigned frames) {
        std::vector<std::vector<uint8_t>> commands = {
            {0xFF, 0}, {0xF8, 0, 4}, {0xF7, 4}, {0xD5, 0, 1, 0}, {0xD4, 0, 0, 0, uint8_t(frames)}};
        const uint32_t key = ~4711u;
        for (unsigned i = 0; i < 4; i++) {
            commands[2].push_back(uint8_t(key >> 8 * i));
        }
        for (unsigned odt = 0; odt < frames; odt++) {
            commands.push_back({0xD3, 0, 0, 0, uint8_t(odt), 1});
        }
        for (unsigned odt = 0; odt < frames; odt++) {
            commands.push_back({0xE2, 0, 0, 0, uint8_t(odt), 0});
            commands.push_back({0xE1, 0xFF, 4, 0, uint8_t(4 * odt), 0, 0, 0});
        }
        commands.push_back({0xE0, 0x10, 0, 0, 0, 0, 1, 0});
        commands.push_back({0xDE, 1, 0, 0});
        const xcp_context_t context = {&drive->parameters, &conditions, &comms.set, &drive->store};
        for (const auto &bytes : commands) {
            const hal_can_frame_t frame = xcp_command(bytes);
            hal_can_frame_t response{};
            ASSERT_TRUE(xcp_receive(&comms.xcp, &bus, &frame, &context, time_us, &response));
            ASSERT_EQ(response.data[0], 0xFF) << unsigned(bytes[0]);
        }
    }

    void step() {
        bus.step(time_us, STEPS_OF_FRAME);
        if ((drive->sampler.event & SAMPLER_IN_CONTROL) != 0) {
            sampler_record(&drive->sampler, drive.get(), DRIVE_WORDS, time_us, 0);
        }
        if (comms_telemetry_due(&comms, time_us)) {
            bus_monitor_step(&comms.bus, &bus, time_us);
            drive_telemetry_t values;
            telemetry_collect(drive.get(), &bus, time_us, &values);
            comms_telemetry(&comms, &bus, &values);
        }
        const comms_objects_t objects = {&drive->parameters, conditions,        &drive->store,
                                         &drive->trace,      &drive->self_test, &drive->control_parameters};
        comms_background(&comms, &bus, &objects, DRIVE_STATE_READY, time_us);
        time_us += STEP_US;
    }

    bool is_xcp(const hal_can_frame_t &frame) const {
        return frame.identifier == DRIVE_XCP_RESPONSE_FRAME_ID + node * 16;
    }

    std::vector<hal::sent_t> sent(bool of_xcp) const {
        std::vector<hal::sent_t> frames;
        std::copy_if(bus.sent.begin(), bus.sent.end(), std::back_inserter(frames),
                     [&](const auto &sent) { return is_xcp(sent.frame) == of_xcp; });
        return frames;
    }

    unsigned node;
    hal bus;
    std::unique_ptr<drive_t> drive = std::make_unique<drive_t>();
    comms_t &comms = drive->comms;
    parameters_conditions_t conditions{};
    uint32_t time_us = 0;
};

// Percent of the bus that others take, parameters' requests a second, and the latest that a frame comes: a frame that
// waits behind one of the measurement may meet the next cycle of telemetry, which passes it.
struct load_t {
    unsigned foreign, requests;
    uint32_t late_us;
};

class XcpBus : public testing::TestWithParam<load_t> {
  protected:
    // Two sessions, one of which measures, with the same requests and the same frames of other nodes.
    void run(World &plain, World &measured) {
        connect(plain);
        ASSERT_NO_FATAL_FAILURE(measured.measure(8));
        std::mt19937 random(3);
        for (unsigned k = 0; k < 2200000 / STEP_US; k++) {
            const bool foreign = random() % (100 * STEPS_OF_FRAME) < GetParam().foreign;
            const bool asks = random() % (1000000 / STEP_US) < GetParam().requests;
            const unsigned index = unsigned(random() % PARAMETER_COUNT);
            for (World *world : {&plain, &measured}) {
                world->bus.foreign += foreign;
                if (asks) {
                    world->bus.received.push_back(frames::parameter_request(PARAMETER_OPERATION_READ, index, 0, 0));
                }
                world->step();
            }
        }
    }

    static void connect(World &world) {
        const xcp_context_t context = {&world.drive->parameters, &world.conditions, &world.comms.set,
                                       &world.drive->store};
        const hal_can_frame_t frame = xcp_command({0xFF, 0});
        hal_can_frame_t response{};
        ASSERT_TRUE(xcp_receive(&world.comms.xcp, &world.bus, &frame, &context, 0, &response));
    }

    static std::map<uint32_t, std::vector<hal::sent_t>> by_identifier(const std::vector<hal::sent_t> &sent) {
        std::map<uint32_t, std::vector<hal::sent_t>> of;
        for (const hal::sent_t &frame : sent) {
            of[frame.frame.identifier].push_back(frame);
        }
        return of;
    }
};

TEST_P(XcpBus, telemetry_and_responses_leave_as_without_a_measurement_or_one_frame_later) {
    World plain, measured;
    ASSERT_NO_FATAL_FAILURE(run(plain, measured));
    const auto expected = by_identifier(plain.sent(false));
    auto found = by_identifier(measured.sent(false));
    EXPECT_EQ(expected.size(), found.size());
    uint32_t latest_us = 0, frames = 0;
    double sum_us = 0;
    const bool alone = GetParam().foreign == 0;
    for (const auto &[identifier, of] : expected) {
        if (!alone && identifier >= DRIVE_IDENTITY_FRAME_ID) {
            continue; // gives way when a cycle is late, and is counted
        }
        const auto &others = found[identifier];
        ASSERT_NEAR(double(of.size()), double(others.size()), 1) << identifier;
        for (size_t i = 0; i < std::min(of.size(), others.size()); i++) {
            if (alone || identifier != DRIVE_BUS_COUNTERS_FRAME_ID) {
                ASSERT_EQ(std::memcmp(of[i].frame.data, others[i].frame.data, 8), 0) << identifier << ", " << i;
            }
            const uint32_t late_us = std::max(others[i].time_us, of[i].time_us) - of[i].time_us;
            latest_us = std::max(latest_us, late_us);
            sum_us += late_us;
            frames++;
        }
    }
    EXPECT_GT(frames, 2000u);
    EXPECT_LE(latest_us, GetParam().late_us);
    EXPECT_LE(sum_us / frames, STEP_US * STEPS_OF_FRAME);
    EXPECT_NEAR(plain.comms.telemetry.dropped, measured.comms.telemetry.dropped, alone ? 0 : 5);
    EXPECT_EQ(plain.sent(true).size(), 0u);
    const bool has_rest = GetParam().foreign < 50; // telemetry takes half of the bus
    EXPECT_EQ(measured.sent(true).size() > 100, has_rest);
    EXPECT_GT(measured.drive->sampler.lost, 100u) << "the measurement takes what is left of the bus";
}

TEST_P(XcpBus, without_other_traffic_the_order_is_the_same) {
    if (GetParam().foreign + GetParam().requests > 0) {
        return;
    }
    World plain, measured;
    ASSERT_NO_FATAL_FAILURE(run(plain, measured));
    const auto expected = plain.sent(false), found = measured.sent(false);
    for (size_t i = 0; i < std::min(expected.size(), found.size()); i++) {
        ASSERT_EQ(expected[i].frame.identifier, found[i].frame.identifier) << i;
    }
}

constexpr uint32_t FRAME_US = STEP_US * STEPS_OF_FRAME, CYCLE_US = 1000;
INSTANTIATE_TEST_SUITE_P(Loads, XcpBus,
                         testing::Values(load_t{0, 0, FRAME_US}, load_t{0, 400, CYCLE_US}, load_t{70, 50, 0}));

TEST(XcpBusAlone, frames_of_a_measurement_come_in_order_whatever_else_is_sent) {
    World world;
    ASSERT_NO_FATAL_FAILURE(world.measure(3));
    for (unsigned k = 0; k < 40000; k++) {
        world.step();
    }
    const auto frames = world.sent(true);
    ASSERT_GT(frames.size(), 500u);
    unsigned part = 0, overloads = 0;
    for (const auto &each : frames) {
        if (each.frame.data[0] == 0xFD) {
            ASSERT_EQ(part, 0u) << "an overload is told between two records";
            overloads++;
            continue;
        }
        ASSERT_EQ(each.frame.data[0], part);
        ASSERT_EQ(each.frame.length, part == 0 ? 7 : 5);
        part = (part + 1) % 3;
    }
    EXPECT_GT(overloads, 0u);
    EXPECT_EQ(overloads, world.drive->comms.xcp.daq.overloads);
}

TEST(XcpBusAlone, an_upload_of_255_bytes_passes_beside_telemetry_on_any_node) {
    for (const unsigned node : {0, 3, 7}) {
        World world(node);
        for (unsigned i = 0; i < 255; i++) {
            reinterpret_cast<uint8_t *>(&world.drive->trace)[i] = uint8_t(7 * i + 1);
        }
        const auto at = uint32_t(offsetof(drive_t, trace));
        for (unsigned k = 0; k < 800; k++) { // after frames that give way to any other
            world.step();
        }
        const uint8_t address[] = {uint8_t(at), uint8_t(at >> 8), uint8_t(at >> 16), uint8_t(at >> 24)};
        world.bus.received.push_back(xcp_command({0xFF, 0}, node));
        world.bus.received.push_back(xcp_command({0xFD}, node == 0 ? 1 : 0)); // of another drive
        world.bus.received.push_back(
            xcp_command({0xF6, 0, 0, 0, address[0], address[1], address[2], address[3]}, node));
        world.bus.received.push_back(xcp_command({0xF5, 255}, node));
        for (unsigned k = 0; k < 4000; k++) {
            world.step();
        }
        const auto frames = world.sent(true);
        ASSERT_EQ(frames.size(), 2u + 37);
        unsigned i = 0;
        for (size_t frame = 2; frame < frames.size(); frame++) {
            EXPECT_EQ(frames[frame].frame.data[0], 0xFF);
            for (unsigned byte = 1; byte < frames[frame].frame.length; byte++, i++) {
                ASSERT_EQ(frames[frame].frame.data[byte], uint8_t(7 * i + 1)) << i;
            }
        }
        EXPECT_EQ(i, 255u);
        EXPECT_EQ(world.comms.telemetry.dropped, 0);
    }
}

TEST(XcpBusAlone, an_upload_whose_address_has_changed_in_memory_ends_and_the_session_goes_on) {
    World world;
    world.bus.received.push_back(xcp_command({0xFF, 0}));
    world.bus.received.push_back(xcp_command({0xF6, 0, 0, 0, 0, 0, 0, 0}));
    world.bus.received.push_back(xcp_command({0xF5, 255}));
    world.step();
    ASSERT_GT(world.comms.xcp.upload_left, 0);
    world.comms.xcp.address |= XCP_AREA;
    for (unsigned k = 0; k < 4000; k++) {
        world.step();
    }
    EXPECT_EQ(world.comms.xcp.upload_left, 0);
    const size_t frames = world.sent(true).size();
    EXPECT_GE(frames, 2u + 25) << "what was read before";
    EXPECT_LT(frames, 2u + 37);
    world.bus.received.push_back(xcp_command({0xFD}));
    for (unsigned k = 0; k < 400; k++) {
        world.step();
    }
    EXPECT_EQ(world.sent(true).size(), frames + 1);
}

TEST(XcpBusAlone, a_command_without_room_for_its_response_is_dropped_and_counted) {
    World world;
    world.bus.foreign = 1000;
    for (unsigned i = 0; i < 40; i++) {
        world.bus.received.push_back(frames::parameter_request(PARAMETER_OPERATION_READ, 0, 0, 0));
    }
    for (unsigned k = 0; k < 20; k++) {
        world.step();
    }
    ASSERT_TRUE(world.bus.received.empty());
    const unsigned dropped = world.comms.telemetry.dropped;
    world.bus.received.push_back(xcp_command({0xFF, 0}));
    world.step();
    EXPECT_FALSE(world.comms.xcp.connected);
    EXPECT_EQ(world.comms.telemetry.dropped, dropped + 1);
    world.bus.foreign = 0;
    for (unsigned k = 0; k < 4000; k++) {
        world.step();
    }
    world.bus.received.push_back(xcp_command({0xFF, 0}));
    world.step();
    EXPECT_TRUE(world.comms.xcp.connected);
}

TEST(XcpBusAlone, remote_and_extended_frames_are_no_commands) {
    World world;
    hal_can_frame_t frame = xcp_command({0xFF, 0});
    frame.extended = true;
    world.bus.received.push_back(frame);
    frame.extended = false;
    frame.remote = true;
    world.bus.received.push_back(frame);
    world.step();
    EXPECT_FALSE(world.comms.xcp.connected);
    frame.remote = false;
    world.bus.received.push_back(frame);
    world.step();
    EXPECT_TRUE(world.comms.xcp.connected);
}

TEST(XcpBusAlone, bus_off_ends_the_session_and_the_measurement) {
    World world;
    ASSERT_NO_FATAL_FAILURE(world.measure(2));
    for (unsigned k = 0; k < 100; k++) {
        world.step();
    }
    ASSERT_TRUE(world.comms.xcp.daq.running);
    world.bus.state = HAL_CAN_BUS_OFF;
    for (unsigned k = 0; k < 100; k++) {
        world.step();
    }
    EXPECT_FALSE(world.comms.xcp.connected || world.comms.xcp.daq.running);
    EXPECT_EQ(world.drive->sampler.event, 0u);
}

} // namespace
