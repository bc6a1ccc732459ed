// Drive and bench with a bus at 100 % load, without sockets. The environment variable SALIENT_FULL_LOAD_S sets the
// virtual time; without it the test takes a moment. An hour:
//
//     SALIENT_FULL_LOAD_S=3600 build/host/bin/test_full_bus_load
#include <gtest/gtest.h>

#include <cstdlib>
#include <memory>

extern "C" {
#include "drive/drive.h"
#include "drive_codec.h"
#include "host/hal_host.h"
#include "rig/rig.h"
#include "rig/transport.h"
}
#include "support/emulator_machines.h"
#include "support/frames.h"

namespace {

constexpr uint64_t MS = 1000000;
constexpr double S_DEFAULT = 3;

// A transport whose only client arms the drive and sends a command every ten rounds of 1 ms.
struct Sender {
    transport_t transport{}; // first
    uint64_t rounds = 0;
    uint64_t frames[3] = {0, 0, 0}; // drive, babbling node, commands
    uint32_t worst_wait_us = 0;
    uint32_t challenge = 0;
    bool requested = false, confirmed = false;

    Sender() {
        transport.descriptors = [](transport_t *, struct pollfd *) { return size_t{0}; };
        transport.flush = [](transport_t *) {};
        transport.close = [](transport_t *) {};
        transport.connected = [](transport_t *, uint32_t) { return true; };
        transport.in_use = [](transport_t *) { return true; };
        transport.read = [](transport_t *base, const transport_receiver_t *receiver) {
            auto *self = reinterpret_cast<Sender *>(base);
            const auto take = [receiver](const hal_can_frame_t &sent) {
                transport_frame_t frame;
                transport_frame_from_hal(&sent, &frame);
                EXPECT_TRUE(receiver->take(receiver->context, 1, &frame));
            };
            if (self->rounds++ % 10 == 0 && self->rounds > 2) {
                take(frames::command(static_cast<uint8_t>(self->rounds / 10), COMMAND_RUN, 600000));
            }
            if (self->rounds > 12 && !self->requested) {
                take(frames::arm(7, ARMING_STEP_REQUEST_RUN));
                self->requested = true;
            } else if (self->challenge != 0 && !self->confirmed) {
                take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~self->challenge));
                self->confirmed = true;
            }
            return size_t{0};
        };
        transport.send = [](transport_t *base, uint64_t, transport_origin_t origin, const transport_frame_t *frame) {
            hal_can_frame_t sent;
            transport_frame_to_hal(frame, &sent);
            if (origin == TRANSPORT_FROM_EMULATOR && sent.identifier == DRIVE_ARMING_FRAME_ID && !sent.extended) {
                drive_arming_t arming;
                drive_arming_unpack(&arming, sent.data, sent.length);
                reinterpret_cast<Sender *>(base)->challenge = arming.challenge;
            }
            if (!transport_frame_is_rig(frame)) {
                ++reinterpret_cast<Sender *>(base)->frames[origin == TRANSPORT_FROM_EMULATOR ? 0
                                                           : origin == TRANSPORT_FROM_OTHER  ? 1
                                                                                             : 2];
            }
        };
    }
};

TEST(FullBusLoad, commands_pass_a_full_bus_of_a_higher_identifier_and_control_is_undisturbed) {
    const char *seconds = std::getenv("SALIENT_FULL_LOAD_S");
    const uint64_t end_ns = static_cast<uint64_t>((seconds ? std::atof(seconds) : S_DEFAULT) * 1e9);
    Sender sender;
    auto rig = std::make_unique<rig_t>();
    rig_config_t config{};
    config.machine = &machine_plant;
    config.encoder_bits = 17;
    config.adc_bits = 12;
    config.seed = 1;
    config.bit_rate = 1000000;
    ASSERT_TRUE(pacing_parse(&config.pacing, "free"));
    config.stop_at_ns = RIG_NEVER;
    config.stop.descriptors[0] = config.stop.descriptors[1] = -1;
    config.transport = &sender.transport;
    rig_init(rig.get(), &config);
    struct Joined {
        drive_t drive;
        hal_t hal;
    };
    auto joined = std::make_unique<Joined>();
    joined->hal.board = &rig->board;
    const drive_t *drive = &joined->drive;
    const drive_config_t drive_config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_TRADITIONAL};
    ASSERT_TRUE(drive_init(&joined->drive, &joined->hal, &drive_config));
    const rig_firmware_t firmware = {.control_interrupt =
                                         [](void *context) {
                                             auto *board = static_cast<Joined *>(context);
                                             drive_control_interrupt(&board->drive, &board->hal);
                                         },
                                     .deferred_interrupt =
                                         [](void *context) {
                                             auto *board = static_cast<Joined *>(context);
                                             drive_deferred_interrupt(&board->drive, &board->hal);
                                         },
                                     .background =
                                         [](void *context) {
                                             auto *board = static_cast<Joined *>(context);
                                             drive_background(&board->drive, &board->hal);
                                         },
                                     .context = joined.get()};
    rig_join(rig.get(), &firmware);

    const uint64_t settled_ns = 300 * MS;
    while (rig->board.time_ns < settled_ns) {
        ASSERT_TRUE(rig_serve(rig.get(), 0));
    }
    ASSERT_EQ(drive->control.state_machine.state, DRIVE_STATE_RUN);
    // Above the commands, below all telemetry: with a frame of eight bytes the bus is never free for the drive.
    rig->bus.babble.load = 100;
    rig->bus.babble.identifier = 0x100;
    can_bus_babble(&rig->bus, rig->board.time_ns);
    const uint64_t from_drive = sender.frames[0];
    uint64_t babbled = 0, seen = 0;
    while (rig->board.time_ns < end_ns) {
        ASSERT_TRUE(rig_serve(rig.get(), 0));
        ASSERT_EQ(drive->control.state_machine.state, DRIVE_STATE_RUN);
        ASSERT_NEAR(rig->plant.speed_rad_s, 600 * 2 * M_PI / 60, 0.5);
        // The drive's counter saturates: it is followed and set back.
        uint16_t &unknown = joined->drive.comms.commands.counters.unknown_frame;
        seen += unknown;
        unknown = 0;
    }
    babbled = sender.frames[1];
    const double load_s = static_cast<double>(end_ns - settled_ns) * 1e-9;
    EXPECT_LE(sender.frames[0] - from_drive, 4u) << "those in mailboxes that had won arbitration";
    EXPECT_GT(static_cast<double>(babbled), load_s * 1e6 / 131 * 0.98); // bits of a frame with eight bytes, about
    EXPECT_LT(static_cast<double>(babbled), load_s * 1e6 / 111);
    EXPECT_NEAR(static_cast<double>(babbled), static_cast<double>(seen), 2) << "counted by both sides";
    EXPECT_NEAR(static_cast<double>(sender.frames[2]), static_cast<double>(end_ns / (10 * MS)), 2);
    EXPECT_EQ(rig->board.receive_overflows, 0u);
    EXPECT_EQ(drive->control.protection.late_interrupts, 0u);
    EXPECT_EQ(drive->control.deferred_request.skipped_total, 0u);
    EXPECT_EQ(rig->bus.drives[0].node.transmit_errors + rig->bus.drives[0].node.receive_errors, 0u);
    EXPECT_EQ(can_bus_client_backlog(&rig->bus, 1), 0u);
    EXPECT_EQ(drive->comms.bus.foreign_count, 0u);
    rig_close(rig.get());
}

} // namespace
