// PDOs: default and random mapping, transmission types, timers; NMT, heartbeat, guarding, SYNC and LSS byte by byte.
#include "support/canopen_bench.h"

#include <algorithm>
#include <random>

extern "C" {
#include "comms/canopen_send.h"
}

namespace {

using namespace canopen_bench;

class CanopenPdo : public CanopenBench {
  protected:
    // Maps objects (index, sub) to a PDO; the abort code of the last step.
    uint32_t map(unsigned communication, unsigned mapping, const std::vector<canopen_object_t> &objects,
                 unsigned type = 255) {
        const uint32_t id = read(communication, 1) & 0x7FFu;
        EXPECT_EQ(write(communication, 1, int32_t(0x80000000u | id)), 0u);
        EXPECT_EQ(write(communication, 2, int32_t(type)), 0u);
        EXPECT_EQ(write(mapping, 0, 0), 0u);
        for (unsigned i = 0; i < objects.size(); i++) {
            const canopen_object_t &of = objects[i];
            const uint32_t bits = 8u * canopen_bytes(&of);
            EXPECT_EQ(write(mapping, i + 1, int32_t(uint32_t(of.index) << 16 | uint32_t(of.sub) << 8 | bits)), 0u);
        }
        const uint32_t refused = write(mapping, 0, int32_t(objects.size()));
        EXPECT_EQ(write(communication, 1, int32_t(id)), 0u);
        return refused;
    }

    std::vector<canopen_object_t> mappable(unsigned access) {
        std::vector<canopen_object_t> found;
        for (unsigned index = 0x1000; index < 0x7000; index++) {
            canopen_object_t object;
            if (canopen_find(index, 0, &object) == CANOPEN_DONE && (object.row.access & access) != 0) {
                found.push_back(object);
            }
        }
        return found;
    }
};

TEST_F(CanopenPdo, nothing_is_taken_or_sent_before_operational) {
    receive(0x200 + NODE, {6, 0});
    receive(0x80, {});
    cycle(5);
    EXPECT_TRUE(sent().empty());
    EXPECT_EQ(canopen.drive.state, CANOPEN_SWITCH_ON_DISABLED);
    operational();
    cycle();
    const auto frames = sent();
    ASSERT_EQ(frames.size(), 4u) << "each once";
    EXPECT_EQ(frames[0], (sent_t{0x180 + NODE, {0x50, 0x02}}));
    EXPECT_EQ(frames[1], (sent_t{0x280 + NODE, {0x50, 0x02, 3}}));
    cycle(20); // standstill and velocity reached
    sent();
    cycle(50);
    EXPECT_TRUE(sent().empty()) << "no change";
    receive(0x200 + NODE, {6, 0});
    EXPECT_EQ(canopen.drive.state, CANOPEN_READY_TO_SWITCH_ON);
    cycle();
    EXPECT_EQ(sent().front(), (sent_t{0x180 + NODE, {0x31, 0x12}}));
}

TEST_F(CanopenPdo, mapping_is_changed_by_the_procedure_of_the_standard_alone) {
    EXPECT_EQ(write(0x1A00, 0, 0), 0x08000022u) << "valid";
    EXPECT_EQ(write(0x1800, 1, 0x1A5), 0x08000022u) << "another identifier while valid";
    EXPECT_EQ(write(0x1800, 1, int32_t(0x80000000u | 0x1A5)), 0u);
    EXPECT_EQ(write(0x1A00, 1, 0x606C0020), 0x08000022u) << "counted";
    EXPECT_EQ(write(0x1A00, 0, 0), 0u);
    EXPECT_EQ(write(0x1A00, 1, 0x60FF0010), 0x06040042u) << "not its length";
    EXPECT_EQ(write(0x1A00, 1, 0x60830020), 0u);
    EXPECT_EQ(write(0x1A00, 1, 0x10170010), 0x06040041u) << "not mappable";
    EXPECT_EQ(write(0x1A00, 1, 0x50000010), 0x06020000u) << "no object";
    EXPECT_EQ(write(0x1600, 1, 0x60410010), 0x08000022u);
    for (unsigned sub : {1u, 2u, 3u}) {
        EXPECT_EQ(write(0x1A00, sub, 0x606C0020), 0u);
    }
    EXPECT_EQ(write(0x1A00, 0, 3), 0x06040042u) << "twelve bytes";
    EXPECT_EQ(write(0x1A00, 0, 2), 0u);
    EXPECT_EQ(write(0x1A00, 0, 4), 0x06020000u) << "one of nothing";
    EXPECT_EQ(write(0x1400, 1, int32_t(0x80000000u | 0x205)), 0u);
    EXPECT_EQ(write(0x1600, 0, 0), 0u);
    EXPECT_EQ(write(0x1600, 2, 0x60400010), 0u);
    EXPECT_EQ(write(0x1600, 0, 2), 0x06040043u) << "the controlword twice";
    for (int32_t id : {0x0, 0x7F, 0x80, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x701, 0x7FF}) {
        EXPECT_EQ(write(0x1800, 1, id), 0x06090030u) << id;
    }
    EXPECT_EQ(write(0x1800, 1, int32_t(0x20000181)), 0x06090030u) << "29 bits";
    EXPECT_EQ(write(0x1800, 2, 241), 0x06090030u);
}

TEST_F(CanopenPdo, random_mapping_carries_the_values_of_the_objects) {
    std::mt19937 random(4711);
    const auto receivable = mappable(CANOPEN_RPDO), transmittable = mappable(CANOPEN_TPDO);
    ASSERT_GT(receivable.size(), 8u);
    ASSERT_GT(transmittable.size(), PARAMETER_COUNT + 8u);
    operational();
    for (unsigned round = 0; round < 300; round++) {
        const unsigned pdo = unsigned(random() % 4);
        for (bool receives : {true, false}) {
            const auto &all = receives ? receivable : transmittable;
            std::vector<canopen_object_t> chosen;
            unsigned bytes = 0;
            for (unsigned tries = 0; tries < 12 && chosen.size() < 8; tries++) {
                const canopen_object_t &object = all[random() % all.size()];
                const bool twice = receives && std::any_of(chosen.begin(), chosen.end(), [&](const auto &other) {
                                       return other.index == object.index;
                                   });
                if (bytes + canopen_bytes(&object) <= 8 && !twice && object.index != 0x6040) {
                    chosen.push_back(object);
                    bytes += canopen_bytes(&object);
                }
            }
            ASSERT_EQ(
                map((receives ? 0x1400 : 0x1800) + pdo, (receives ? 0x1600 : 0x1A00) + pdo, chosen, receives ? 255 : 1),
                0u);
            sent();
            if (!receives) {
                cycle();
                sent();
                receive(0x80, {});
                const auto frames = sent();
                const auto frame = std::find_if(frames.begin(), frames.end(), [&](const sent_t &one) {
                    return one.identifier == 0x180 + 0x100 * pdo + NODE;
                });
                ASSERT_NE(frame, frames.end());
                bytes_t expected;
                for (const auto &object : chosen) {
                    const bytes_t response = sdo(head(0x40, object.index, object.sub));
                    expected.insert(expected.end(), response.begin() + 4,
                                    response.begin() + 4 + canopen_bytes(&object));
                }
                EXPECT_EQ(frame->data, expected);
                continue;
            }
            // Values within their limits are taken, all of them; one beyond, and none is.
            bytes_t data;
            std::vector<int32_t> wanted, before;
            bool good = true;
            for (const auto &object : chosen) {
                const int32_t low = object.row.minimum, high = object.row.maximum;
                const int32_t value = random() % 8 == 0 ? int32_t(random()) : random() % 2 ? low : high;
                uint8_t raw[4];
                canopen_pack(raw, canopen_bytes(&object), value);
                data.insert(data.end(), raw, raw + canopen_bytes(&object));
                wanted.push_back(canopen_unpack(&object, raw));
                good = good && canopen_check(&canopen, &object, wanted.back()) == CANOPEN_DONE;
                before.push_back(canopen_unpack(&object, sdo(head(0x40, object.index, 0)).data() + 4));
            }
            receive(0x200 + 0x100 * pdo + NODE, data);
            for (unsigned i = 0; i < chosen.size(); i++) {
                const bytes_t now = sdo(head(0x40, chosen[i].index, 0));
                EXPECT_EQ(canopen_unpack(&chosen[i], now.data() + 4), good ? wanted[i] : before[i]) << round;
            }
        }
    }
}

TEST_F(CanopenPdo, the_controlword_of_a_frame_finds_its_mode_and_reference) {
    canopen_object_t word, mode, target;
    canopen_find(0x6040, 0, &word);
    canopen_find(0x6060, 0, &mode);
    canopen_find(0x60FF, 0, &target);
    operational();
    ASSERT_EQ(map(0x1402, 0x1602, {word, mode, target}), 0u);
    receive(0x400 + NODE, {6, 0, 9, 0x58, 2, 0, 0});
    receive(0x400 + NODE, {15, 0, 9, 0x58, 2, 0, 0});
    EXPECT_EQ(canopen.drive.state, CANOPEN_OPERATION_ENABLED);
    EXPECT_EQ(canopen.drive.mode, 9);
    EXPECT_EQ(canopen.drive.target, 600000);
    receive(0x400 + NODE, {15, 1, 2, 1, 0, 0, 0});
    EXPECT_EQ(read(0x6040, 0), 15u) << "a mode that it has not: nothing is taken";
    EXPECT_EQ(canopen.drive.target, 600000);
    cycle();
    sent();
    receive(0x400 + NODE, {0, 0});
    cycle();
    EXPECT_EQ(sent().front(), (sent_t{0x80 + NODE, {0x10, 0x82, 0, 0, 0, 0, 0, 0}})) << "short";
    EXPECT_EQ(canopen.drive.state, CANOPEN_OPERATION_ENABLED);
    receive(0x400 + NODE, {0, 0, 9, 1, 0, 0, 0, 0});
    EXPECT_EQ(canopen.drive.state, CANOPEN_SWITCH_ON_DISABLED) << "long: its start counts";
}

TEST_F(CanopenPdo, a_stop_is_taken_beside_a_value_that_is_refused) {
    for (const unsigned word : {0x00u, 0x02u, 0x06u, 0x07u}) {
        enable();
        receive(0x300 + NODE, {0x0F, 1, 0x7F}); // halt, with a mode that there is not
        EXPECT_EQ(read(0x6040, 0), 0x0Fu);
        receive(0x300 + NODE, {uint8_t(word), 0, 0x7F});
        EXPECT_EQ(read(0x6040, 0), word);
        EXPECT_EQ(read(0x6060, 0), 3u);
        cycle(30);
        EXPECT_EQ(command.request, COMMAND_OFF) << word;
        control(0);
        receive(0x300 + NODE, {0x06, 0, 0x7F});
        EXPECT_EQ(read(0x6040, 0), 0u) << "nothing but a stop";
    }
    control(6);
    receive(0x300 + NODE, {0x02, 0, 0x7F});
    control(15);
    EXPECT_EQ(canopen.drive.state, CANOPEN_SWITCH_ON_DISABLED) << "what was prepared is withdrawn";
    canopen.drive.state = CANOPEN_FAULT;
    receive(0x300 + NODE, {0x80, 0, 0x7F});
    EXPECT_NE(read(0x6040, 0), 0x80u) << "no reset";
}

TEST_F(CanopenPdo, a_controlword_finds_the_references_of_its_sync) {
    canopen_object_t target, word;
    canopen_find(0x607A, 0, &target);
    canopen_find(0x6040, 0, &word);
    EXPECT_EQ(map(0x1400, 0x1600, {word}, 1), 0u);
    EXPECT_EQ(map(0x1401, 0x1601, {target}, 1), 0u);
    values.status.controller = DRIVE_CONTROLLER_SALIENT;
    cycle();
    EXPECT_EQ(write(0x6060, 0, 1), 0u);
    enable();
    receive(0x200 + NODE, {0x1F, 0}); // new set-point
    receive(0x300 + NODE, {0, 0, 2, 0});
    EXPECT_FALSE(canopen.position.moving) << "not before the SYNC";
    receive(0x80, {});
    EXPECT_TRUE(canopen.position.moving);
    EXPECT_EQ(canopen.position.move.target, POSITION_ONE_REV) << "not the target before";
}

TEST_F(CanopenPdo, a_pdo_without_a_mapping_is_none) {
    EXPECT_EQ(map(0x1800, 0x1A00, {}), 0u);
    EXPECT_EQ(map(0x1400, 0x1600, {}), 0u);
    EXPECT_EQ(map(0x1801, 0x1A01, {}, 1), 0u);
    operational();
    cycle();
    receive(0x80, {});
    receive(0x200 + NODE, {6, 0});
    cycle(5);
    for (const sent_t &frame : sent()) {
        EXPECT_NE(frame.identifier, 0x180u + NODE);
        EXPECT_NE(frame.identifier, 0x280u + NODE);
        EXPECT_NE(frame.identifier, 0x80u + NODE) << "nor an emergency for its length";
    }
}

TEST_F(CanopenPdo, a_length_that_does_not_fit_is_one_emergency_and_hides_no_other) {
    operational();
    cycle();
    sent();
    unsigned lengths = 0, faults = 0;
    const auto count = [&] {
        for (const sent_t &frame : sent()) {
            lengths += frame.identifier == 0x80u + NODE && frame.data[0] == 0x20 && frame.data[1] == 0x82;
            faults += frame.identifier == 0x80u + NODE && frame.data[7] == 0 && frame.data[3] == FAULT_OVER_CURRENT;
        }
    };
    for (unsigned i = 0; i < 20; i++) {
        receive(0x200 + NODE, {0, 0, 0});
        receive(0x200 + NODE, {0, 0, 0});
        cycle();
        count();
    }
    EXPECT_EQ(lengths, 1u);
    write(0x1015, 0, 1000);
    for (unsigned i = 0; i < 6; i++) {
        receive(0x200 + NODE, {0, 0});
        receive(0x200 + NODE, {0, 0, 0});
    }
    values.status.state = DRIVE_STATE_FAULT;
    values.status.fault = FAULT_OVER_CURRENT;
    for (unsigned i = 0; i < 1000; i++) {
        cycle();
        count();
    }
    EXPECT_EQ(lengths, 4u) << "what had no place with the inhibit time is the oldest";
    EXPECT_EQ(faults, 1u);
}

TEST_F(CanopenPdo, a_pdo_that_is_not_valid_has_any_identifier) {
    EXPECT_EQ(write(0x1400, 1, int32_t(0x80000000u)), 0u);
    EXPECT_EQ(read(0x1400, 1), 0x80000000u);
    EXPECT_EQ(write(0x1400, 1, 0), 0x06090030u) << "valid with the identifier of NMT";
    EXPECT_EQ(write(0x1400, 1, 0x601), 0x06090030u);
    EXPECT_EQ(write(0x1400, 1, int32_t(0xA0000000u)), 0x06090030u) << "29 bits";
    EXPECT_EQ(write(0x1400, 1, 0x200 + NODE), 0u);
    EXPECT_EQ(write(0x1800, 1, int32_t(0x80000000u)), 0u);
}

TEST_F(CanopenPdo, transmission_types_and_timers) {
    operational();
    cycle();
    sent();
    const auto count = [&](unsigned pdo) {
        const auto frames = sent();
        return std::count_if(frames.begin(), frames.end(),
                             [&](const sent_t &one) { return one.identifier == 0x180 + 0x100 * pdo + NODE; });
    };
    write(0x1800, 2, 3);
    for (unsigned i = 0; i < 9; i++) {
        receive(0x80, {});
    }
    EXPECT_EQ(count(0), 3) << "every third SYNC";
    write(0x1801, 2, 0);
    cycle();
    receive(0x80, {});
    EXPECT_EQ(count(1), 1);
    receive(0x80, {});
    EXPECT_EQ(count(1), 0) << "no change";
    write(0x1802, 5, 20);
    cycle(200);
    EXPECT_NEAR(double(count(2)), 10, 1) << "event timer";
    for (unsigned i = 0; i < 100; i++) {
        values.motion.speed_rpm += 1000;
        cycle();
        if (i % 10 == 9) {
            EXPECT_LE(count(2), 1) << "inhibit time";
        }
    }
    write(0x1400, 2, 1);
    receive(0x200 + NODE, {6, 0});
    EXPECT_EQ(canopen.drive.state, CANOPEN_SWITCH_ON_DISABLED);
    receive(0x80, {});
    EXPECT_EQ(canopen.drive.state, CANOPEN_READY_TO_SWITCH_ON) << "with the SYNC";
}

TEST_F(CanopenPdo, a_receive_pdo_that_stays_away_is_lost_once_and_once_more_after_it_came) {
    operational();
    write(0x1400, 5, 20);
    for (unsigned loss = 0; loss < 2; loss++) {
        receive(0x200 + NODE, {0, 0});
        sent();
        size_t lost = 0;
        for (unsigned i = 0; i < 200; i++) {
            cycle();
            lost += emergencies().size();
        }
        EXPECT_EQ(lost, 1u) << loss;
    }
}

TEST_F(CanopenPdo, each_emergency_is_an_inhibit_time_after_the_one_before) {
    operational();
    cycle(500);
    write(0x1015, 0, 200); // 20 ms
    sent();
    for (unsigned i = 0; i < 4; i++) {
        canopen_emergency(&canopen, 0x1000 + i, FAULT_NONE);
    }
    std::vector<unsigned> at;
    for (unsigned ms = 0; ms < 200; ms++) {
        cycle();
        at.insert(at.end(), emergencies().size(), ms);
    }
    EXPECT_EQ(at, (std::vector<unsigned>{0, 20, 40, 60}));
}

TEST_F(CanopenPdo, nmt_heartbeat_and_guarding) {
    EXPECT_EQ(canopen.nmt, CANOPEN_NMT_PRE_OPERATIONAL);
    write(0x1017, 0, 10);
    cycle(10);
    EXPECT_EQ(sent().back(), (sent_t{0x700 + NODE, {127}}));
    receive(0, {1, NODE + 1});
    EXPECT_EQ(canopen.nmt, CANOPEN_NMT_PRE_OPERATIONAL) << "of another node";
    receive(0, {2, NODE});
    EXPECT_EQ(canopen.nmt, CANOPEN_NMT_STOPPED);
    EXPECT_EQ(sdo(head(0x40, 0x1000, 0)), bytes_t{}) << "no SDO";
    cycle(10);
    EXPECT_EQ(sent().back(), (sent_t{0x700 + NODE, {4}}));
    receive(0x700 + NODE, {}, true);
    EXPECT_TRUE(sent().empty()) << "heartbeat or guarding";
    receive(0, {130, 0});
    cycle();
    EXPECT_EQ(sent().front(), (sent_t{0x700 + NODE, {0}}));
    for (unsigned toggle : {0x00u, 0x80u, 0x00u}) {
        receive(0x700 + NODE, {}, true);
        EXPECT_EQ(sent().front(), (sent_t{0x700 + NODE, {uint8_t(toggle | 127)}}));
    }
}

TEST_F(CanopenPdo, a_reset_of_communication_forgets_toggle_transfer_and_watched_nodes_and_keeps_the_profile) {
    write(0x6083, 0, 4321);
    write(0x1016, 1, 0x7F << 16 | 100);
    receive(0x77F, {5});
    receive(0x700 + NODE, {}, true);
    ASSERT_TRUE(canopen.guard.watched && canopen.guard_toggle && canopen.consumer[0].watched);
    ASSERT_EQ(sdo(head(0x40, 0x1008, 0))[0], 0x41) << "a text, by segments";
    receive(0, {130, NODE});
    EXPECT_FALSE(canopen.guard.watched || canopen.consumer[0].watched);
    cycle();
    sent();
    EXPECT_EQ(code_of(sdo({0x60, 0, 0, 0, 0, 0, 0, 0})), 0x05040001u) << "no transfer goes on";
    receive(0x700 + NODE, {}, true);
    EXPECT_EQ(sent().front(), (sent_t{0x700 + NODE, {127}})) << "the toggle begins with 0";
    EXPECT_EQ(read(0x1016, 1), 0u);
    EXPECT_EQ(read(0x6083, 0), 4321u);
    receive(0, {129, NODE});
    cycle(2);
    EXPECT_NE(read(0x6083, 0), 4321u) << "a reset of the node takes the profile's values";
}

TEST_F(CanopenPdo, lss_selects_and_sets_the_node) {
    const auto lss = [&](unsigned command, uint32_t value) {
        receive(0x7E5, {uint8_t(command), uint8_t(value), uint8_t(value >> 8), uint8_t(value >> 16),
                        uint8_t(value >> 24), 0, 0, 0});
        const auto frames = sent();
        return frames.empty() ? bytes_t{} : frames[0].data;
    };
    const uint32_t identity[] = {CANOPEN_VENDOR, CANOPEN_PRODUCT, machine_tables.machine_hash, 1};
    EXPECT_EQ(lss(0x5E, 0), bytes_t{}) << "not selected";
    for (unsigned wrong = 0; wrong < 5; wrong++) {
        bytes_t response;
        for (unsigned i = 0; i < 4; i++) {
            response = lss(0x40 + i, identity[i] + (i == wrong ? 1 : 0));
        }
        EXPECT_EQ(response.empty(), wrong < 4) << wrong;
    }
    EXPECT_EQ(lss(0x5E, 0)[1], NODE);
    EXPECT_EQ(lss(0x11, 0)[1], 1) << "no node-ID";
    EXPECT_EQ(lss(0x11, 128)[1], 1);
    EXPECT_EQ(lss(0x11, 42)[1], 0);
    EXPECT_EQ(lss(0x13, 0)[1], 1) << "bit rate";
    EXPECT_NE(store.saving, NVM_STORE_SAVING);
    EXPECT_EQ(lss(0x17, 0)[1], 0);
    EXPECT_EQ(store.saving, NVM_STORE_SAVING) << "beyond the next start";
    EXPECT_EQ(parameters.values[PARAMETER_PROTOCOL], 42);
    EXPECT_EQ(canopen.node, NODE);
    receive(0, {130, 0});
    cycle();
    EXPECT_EQ(sent().front(), (sent_t{0x700 + 42, {0}}));
    const uint32_t range[] = {identity[0], identity[1], identity[2], identity[2], 0, 5};
    bytes_t response;
    for (unsigned i = 0; i < 6; i++) {
        response = lss(0x46 + i, range[i]);
    }
    EXPECT_EQ(response[0], 0x4F);
    for (unsigned i = 0; i < 6; i++) {
        response = lss(0x46 + i, i == 4 ? 2 : range[i]);
    }
    EXPECT_EQ(response, bytes_t{});
}

TEST_F(CanopenPdo, lss_selects_by_four_numbers_that_no_switch_of_all_devices_interrupts) {
    const uint32_t identity[] = {CANOPEN_VENDOR, CANOPEN_PRODUCT, machine_tables.machine_hash, 1};
    for (const bool interrupted : {true, false}) {
        for (unsigned i = 0; i < 4; i++) {
            if (interrupted && i == 3) {
                receive(0x7E5, {0x04, 0, 0, 0, 0, 0, 0, 0});
            }
            receive(0x7E5, {uint8_t(0x40 + i), uint8_t(identity[i]), uint8_t(identity[i] >> 8),
                            uint8_t(identity[i] >> 16), uint8_t(identity[i] >> 24), 0, 0, 0});
        }
        EXPECT_EQ(sent().empty(), interrupted);
    }
}

TEST_F(CanopenPdo, lss_fast_scan_finds_a_device_without_a_node_and_gives_it_one) {
    const auto lss = [&](bytes_t data) {
        data.resize(8);
        receive(0x7E5, data);
        const auto frames = sent();
        return frames.empty() ? 0u : unsigned(frames[0].data[0]);
    };
    const auto scan = [&](uint32_t value, unsigned bit, unsigned number, unsigned next) {
        return lss({0x51, uint8_t(value), uint8_t(value >> 8), uint8_t(value >> 16), uint8_t(value >> 24), uint8_t(bit),
                    uint8_t(number), uint8_t(next)});
    };
    const uint32_t identity[] = {CANOPEN_VENDOR, CANOPEN_PRODUCT, machine_tables.machine_hash, 1};
    EXPECT_EQ(scan(0, 128, 0, 0), 0u) << "it has a node-ID";
    EXPECT_EQ(lss({0x4C}), 0u);
    lss({0x04, 1});
    EXPECT_EQ(lss({0x11, 255}), 0x11u);
    EXPECT_EQ(scan(0, 128, 0, 0), 0u) << "until reset communication";
    receive(0, {130, 0});
    cycle();
    EXPECT_TRUE(sent().empty()) << "no boot-up";
    for (const auto &frame : {sent_t{0, {1, 0}}, sent_t{0x600 + NODE, {0x40, 0, 0x10, 0, 0, 0, 0, 0}},
                              sent_t{0x6FF, {0x40, 0, 0x10, 0, 0, 0, 0, 0}}, sent_t{0x2FF, {6, 0}}}) {
        receive(frame.identifier, frame.data);
        cycle();
        EXPECT_TRUE(sent().empty()) << frame.identifier;
        EXPECT_EQ(canopen.nmt, CANOPEN_NMT_INITIALISING);
    }
    receive(0x7E5, {}, true);
    EXPECT_EQ(lss({0x04, 0}), 0u) << "no node-ID is to come";
    cycle();
    EXPECT_TRUE(sent().empty());
    EXPECT_EQ(canopen.nmt, CANOPEN_NMT_INITIALISING);
    values.status.fault = 3;
    values.status.state = DRIVE_STATE_FAULT;
    cycle();
    EXPECT_TRUE(sent().empty()) << "no emergency without a COB-ID";
    EXPECT_EQ(lss({0x4C}), 0x50u);
    EXPECT_EQ(scan(0, 128, 0, 0), 0x4Fu);
    EXPECT_EQ(scan(identity[1], 0, 1, 2), 0u) << "out of order";
    EXPECT_EQ(scan(0, 0, 4, 0), 0u);
    EXPECT_EQ(scan(0, 32, 0, 0), 0u);
    EXPECT_EQ(scan(identity[0], 0, 0, 4), 0u) << "no such number is next";
    for (unsigned number = 0; number < 4; number++) {
        uint32_t found = 0;
        for (unsigned bit = 32; bit-- > 0;) {
            found |= scan(found, bit, number, number) == 0x4F ? 0 : 1u << bit;
        }
        EXPECT_EQ(found, identity[number]);
        EXPECT_EQ(scan(found ^ 1, 0, number, (number + 1) % 4), 0u) << "another device's";
        EXPECT_FALSE(canopen.lss.configuring);
        EXPECT_EQ(scan(found, 0, number, (number + 1) % 4), 0x4Fu);
    }
    EXPECT_EQ(lss({0x5E}), 0x5Eu) << "it is selected";
    EXPECT_EQ(scan(0, 128, 0, 0), 0u);
    for (unsigned inquiry = 0x5A; inquiry < 0x5E; inquiry++) {
        EXPECT_EQ(lss({uint8_t(inquiry)}), inquiry);
    }
    EXPECT_EQ(lss({0x59}), 0u);
    EXPECT_EQ(lss({0x5F}), 0u);
    EXPECT_EQ(lss({0x11, 42}), 0x11u);
    EXPECT_EQ(lss({0x4C}), 0u) << "a node-ID is to come";
    EXPECT_EQ(lss({0x17}), 0x17u);
    EXPECT_EQ(parameters.values[PARAMETER_PROTOCOL], 42);
    lss({0x04, 0});
    cycle();
    EXPECT_EQ(sent().front(), (sent_t{0x700 + 42, {0}}));
    EXPECT_EQ(scan(0, 128, 0, 0), 0u);
    receive(0x600 + 42, {0x40, 0, 0x10, 0, 0, 0, 0, 0});
    EXPECT_EQ(sent().front().identifier, 0x580u + 42u);
}

TEST_F(CanopenPdo, a_device_starts_without_a_node_when_that_is_stored) {
    canopen_init(&canopen, 255, 1, time_us);
    cycle();
    EXPECT_TRUE(sent().empty());
    receive(0x7E5, {0x51, 0, 0, 0, 0, 128, 0, 0});
    EXPECT_EQ(sent().front(), (sent_t{0x7E4, {0x4F, 0, 0, 0, 0, 0, 0, 0}}));
}

} // namespace
