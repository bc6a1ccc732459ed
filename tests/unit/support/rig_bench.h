// A rig on its own local bus, with a stand-in firmware that uses every part of the board, and clients that exchange the
// bus's records. One thread: clients send, then the rig is served, then clients read.
#ifndef RIG_BENCH_H
#define RIG_BENCH_H

#include <gtest/gtest.h>
#include <linux/can.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <limits>
#include <memory>
#include <string>
#include <vector>

extern "C" {
#include "rig/rig.h"
#include "rig_codec.h"
}

struct BusRecord {
    uint64_t time_ns = 0;
    size_t size = 0;
    canfd_frame frame{};

    uint32_t identifier() const { return frame.can_id & CAN_EFF_MASK; }
    bool operator==(const BusRecord &other) const {
        return time_ns == other.time_ns && size == other.size && std::memcmp(&frame, &other.frame, sizeof frame) == 0;
    }
};

class BusClient {
  public:
    explicit BusClient(const std::string &path) : descriptor_(socket(AF_UNIX, SOCK_SEQPACKET, 0)) {
        sockaddr_un address{};
        address.sun_family = AF_UNIX;
        std::strncpy(address.sun_path, path.c_str(), sizeof address.sun_path - 1);
        EXPECT_EQ(connect(descriptor_, reinterpret_cast<sockaddr *>(&address), sizeof address), 0);
    }
    ~BusClient() { close(descriptor_); }
    BusClient(const BusClient &) = delete;

    ssize_t send_bytes(const void *bytes, size_t size) {
        return ::send(descriptor_, bytes, size, MSG_NOSIGNAL | MSG_DONTWAIT);
    }

    bool send(canid_t identifier, const std::vector<uint8_t> &data = {}) {
        uint8_t record[8 + CAN_MTU] = {};
        can_frame frame{};
        frame.can_id = identifier;
        frame.len = static_cast<uint8_t>(data.size());
        std::copy(data.begin(), data.end(), frame.data);
        std::memcpy(record + 8, &frame, sizeof frame);
        return send_bytes(record, sizeof record) == sizeof record;
    }

    bool run_until(uint64_t time_ns, uint8_t sequence = 0) {
        std::vector<uint8_t> data;
        for (int i = 0; i < 6; ++i) {
            data.push_back(static_cast<uint8_t>(time_ns >> (8 * i)));
        }
        data.push_back(sequence);
        return send(RIG_RUN_UNTIL_FRAME_ID | CAN_EFF_FLAG, data);
    }

    bool set(uint8_t variable, int32_t raw, uint32_t at_us = 0) {
        auto value = static_cast<uint32_t>(raw);
        std::vector<uint8_t> data{variable, static_cast<uint8_t>(value), static_cast<uint8_t>(value >> 8),
                                  static_cast<uint8_t>(value >> 16)};
        for (int i = 0; i < 4; ++i) {
            data.push_back(static_cast<uint8_t>(at_us >> (8 * i)));
        }
        return send(RIG_SET_FRAME_ID | CAN_EFF_FLAG, data);
    }

    // Everything that has arrived.
    std::vector<BusRecord> receive() {
        std::vector<BusRecord> records;
        uint8_t bytes[128];
        for (;;) {
            ssize_t size = recv(descriptor_, bytes, sizeof bytes, MSG_DONTWAIT);
            if (size <= 0) {
                gone = size == 0;
                return records;
            }
            BusRecord record;
            for (int i = 0; i < 8; ++i) {
                record.time_ns |= static_cast<uint64_t>(bytes[i]) << (8 * i);
            }
            record.size = static_cast<size_t>(size) - 8;
            std::memcpy(&record.frame, bytes + 8, record.size);
            records.push_back(record);
        }
    }

    bool gone = false;

  private:
    int descriptor_;
};

// Chops phase 0 by its current, reports each 20th period, answers each frame by one with the identifier plus one.
struct StandInFirmware {
    board_t *board = nullptr;
    uint32_t interrupts = 0, backgrounds = 0, missed = 0;
    uint16_t lower = 2500; // compare value of phase 1
    uint64_t takes_ns = 0; // execution time of its interrupt; 0: as the bench sets it
    std::vector<uint64_t> interrupt_times_ns, background_times_ns;
    std::vector<hal_can_frame_t> received;

    static void interrupt(void *context) {
        auto *self = static_cast<StandInFirmware *>(context);
        ++self->interrupts;
        self->missed += board_missed_triggers(self->board);
        self->interrupt_times_ns.push_back(self->board->time_ns);
        hal_pwm_compare_t compare{};
        bool on = self->board->adc.phase_current_counts[1] < 512;
        compare.upper[1] = on ? 1700 : 0;
        compare.lower[1] = self->lower;
        board_pwm_write(self->board, &compare);
        if (self->takes_ns > 0) {
            self->board->interrupt_took_ns = self->takes_ns;
        }
    }

    static void background(void *context) {
        auto *self = static_cast<StandInFirmware *>(context);
        self->background_times_ns.push_back(self->board->time_ns);
        if (++self->backgrounds % 20 == 0) {
            hal_can_frame_t frame{};
            frame.identifier = 0x180;
            frame.length = 8;
            std::memcpy(frame.data, &self->interrupts, 4);
            std::memcpy(frame.data + 4, &self->board->encoder.counts, 4);
            board_can_transmit(self->board, &frame);
        }
        hal_can_frame_t frame;
        while (board_can_receive(self->board, &frame)) {
            self->received.push_back(frame);
            ++frame.identifier;
            board_can_transmit(self->board, &frame);
        }
    }
};

class RigBench {
  public:
    explicit RigBench(const char *pace = "lockstep", uint64_t stop_at_ns = RIG_NEVER) {
        char folder[] = "/tmp/rig_bench_XXXXXX";
        folder_ = mkdtemp(folder);
        path = folder_ + "/bus";
        char error[TRANSPORT_ERROR_SIZE] = "";
        transport = transport_local_open(path.c_str(), error);
        EXPECT_NE(transport, nullptr) << error;
        init(pace, stop_at_ns);
    }

    // On any transport, which the bench then owns.
    RigBench(transport_t *other, const char *pace) : transport(other) { init(pace, RIG_NEVER); }

    ~RigBench() {
        rig_close(rig.get());
        transport_close(transport);
        if (!folder_.empty()) {
            std::filesystem::remove_all(folder_);
        }
    }

    std::unique_ptr<BusClient> connect() const { return std::make_unique<BusClient>(path); }

    // Serves until no request is left.
    void serve() {
        uint64_t before_ns;
        do {
            before_ns = rig->board.time_ns;
            ASSERT_TRUE(rig_serve(rig.get(), 0));
        } while (rig->board.time_ns != before_ns || rig->server.run_count > 0);
    }

    std::vector<BusRecord> run_to(BusClient &client, uint64_t time_ns) {
        client.run_until(time_ns);
        serve();
        EXPECT_EQ(rig->board.time_ns, time_ns);
        return client.receive();
    }

    std::string path;
    transport_t *transport = nullptr;
    std::unique_ptr<rig_t> rig = std::make_unique<rig_t>();
    StandInFirmware firmware;

  private:
    void init(const char *pace, uint64_t stop_at_ns) {
        rig_config_t config{};
        config.machine = &machine_plant;
        config.encoder_bits = 17;
        config.adc_bits = 12;
        config.seed = 1;
        config.bit_rate = 1000000;
        EXPECT_TRUE(pacing_parse(&config.pacing, pace));
        config.stop_at_ns = stop_at_ns;
        config.stop.descriptors[0] = config.stop.descriptors[1] = -1;
        config.transport = transport;
        rig_init(rig.get(), &config);
        plant_set_trip(&rig->plant, std::numeric_limits<double>::infinity()); // the stand-in freewheels as a generator
        firmware.board = &rig->board;
        board_pwm_start(&rig->board, 2500);
        rig_firmware_t callbacks{StandInFirmware::interrupt, nullptr, StandInFirmware::background, &firmware, nullptr};
        rig_join(rig.get(), &callbacks);
    }

    std::string folder_;
};

#endif
