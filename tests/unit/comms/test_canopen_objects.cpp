// Objects of CiA 301: error field, store, restore, consumers, identifiers, dummies, error behaviour; numbers in the
// units of other machines; where a change in memory leads.
#include "support/canopen_bench.h"

#include <algorithm>

extern "C" {
#include "comms/canopen_mapping.h"
#include "comms/canopen_position.h"
#include "comms/canopen_sdo_data.h"
#include "comms/canopen_units.h"
}

namespace {

using namespace canopen_bench;

constexpr uint32_t SAVE = 0x65766173, LOAD = 0x64616F6C;
constexpr unsigned SET_BYTES = 4 * PARAMETER_COUNT, FAULT_PAGE = 2;
constexpr uint32_t MASTER = 0x7F;

class CanopenObjects : public CanopenBench {
  protected:
    // Writes a fault to the log.
    void log(unsigned fault) {
        fault_record_t record{};
        record.fault = fault_t(fault);
        record.time_us = time_us += CYCLE_US;
        nvm_store_follow_fault(&store, &record);
        while (store.waiting_count > 0) {
            nvm_store_step(&store, &memory->hal, &parameters, time_us, true);
        }
    }

    uint32_t field(unsigned sub) { return word(sdo(head(0x40, 0x1003, sub))); }

    void start_anew() {
        canopen_init(&canopen, NODE, 1, time_us);
        commands_init(&commands);
        command = {};
        cycle(2);
        sent();
    }

    // LSS: the first bytes of a request; error code of the response.
    unsigned lss(bytes_t data) {
        data.resize(8);
        sent();
        receive(0x7E5, data);
        const auto frames = sent();
        return frames.empty() ? 0xFFu : frames[0].data[1];
    }

    void begin_block_upload(unsigned segments) {
        EXPECT_EQ(sdo(head(0xA4, 0x2F00, 0, segments)), head(0xC6, 0x2F00, 0, SET_BYTES));
        receive(0x600 + NODE, {0xA3, 0, 0, 0, 0, 0, 0, 0});
    }
};

TEST_F(CanopenObjects, each_object_has_an_entry_0) {
    for (unsigned at = 0; at < CANOPEN_ROWS; at++) {
        const bool first = at == 0 || canopen_rows[at - 1].index != canopen_rows[at].index;
        EXPECT_EQ(canopen_rows[at].first == 0, first) << std::hex << canopen_rows[at].index;
    }
}

TEST_F(CanopenObjects, the_error_field_has_the_newest_fault_first_and_no_data_beyond) {
    EXPECT_EQ(read(0x1003, 0), 0u);
    EXPECT_EQ(field(1), 0x08000024u);
    log(FAULT_OVER_CURRENT);
    log(FAULT_OVER_VOLTAGE);
    EXPECT_EQ(read(0x1003, 0), 2u);
    EXPECT_EQ(read(0x1003, 1), 0x3210u | FAULT_OVER_VOLTAGE << 16);
    EXPECT_EQ(read(0x1003, 2), 0x2310u | FAULT_OVER_CURRENT << 16);
    EXPECT_EQ(field(3), 0x08000024u);
    for (unsigned i = 0; i < 7; i++) {
        log(FAULT_ENCODER);
    }
    EXPECT_EQ(read(0x1003, 0), 8u);
    EXPECT_EQ(read(0x1003, 8), 0x3210u | FAULT_OVER_VOLTAGE << 16) << "the oldest but one";
    EXPECT_EQ(field(9), 0x06090011u);
}

TEST_F(CanopenObjects, errors_are_deleted_by_zero_alone_and_stay_in_the_log) {
    log(FAULT_OVER_CURRENT);
    EXPECT_EQ(write(0x1003, 0, 1), 0x06090030u);
    EXPECT_EQ(write(0x1003, 0, 255), 0x06090030u);
    EXPECT_EQ(read(0x1003, 0), 1u);
    EXPECT_EQ(write(0x1003, 0, 0), 0u);
    EXPECT_EQ(read(0x1003, 0), 0u);
    EXPECT_EQ(field(1), 0x08000024u);
    EXPECT_EQ(nvm_store_newest_fault(&store), 1u);
    log(FAULT_ENCODER);
    EXPECT_EQ(read(0x1003, 0), 1u);
    EXPECT_EQ(read(0x1003, 1), 0x7305u | FAULT_ENCODER << 16);
}

TEST_F(CanopenObjects, an_entry_of_the_log_that_is_damaged_or_of_no_known_fault_has_no_data) {
    log(FAULT_OVER_CURRENT);
    log(FAULT_COUNT);
    log(FAULT_ENCODER);
    EXPECT_EQ(read(0x1003, 3), 0x2310u | FAULT_OVER_CURRENT << 16);
    memory->hal.nvm.word[FAULT_PAGE][1] ^= 1;
    EXPECT_EQ(field(3), 0x08000024u);
    EXPECT_EQ(field(2), 0x08000024u);
    EXPECT_EQ(read(0x1003, 1), 0x7305u | FAULT_ENCODER << 16);
}

TEST_F(CanopenObjects, parameters_that_have_changed_in_memory_are_not_stored_and_not_read_as_a_set) {
    parameters.values[PARAMETER_SMC_K] ^= 1;
    EXPECT_EQ(write(0x1010, 1, SAVE), 0x06060000u);
    EXPECT_EQ(code_of(sdo(head(0x40, 0x2F00, 0))), 0x06060000u);
    EXPECT_NE(store.saving, NVM_STORE_SAVING);
    parameters.values[PARAMETER_SMC_K] ^= 1;
    EXPECT_EQ(sdo(head(0x40, 0x2F00, 0))[0], 0x41);
    EXPECT_EQ(write(0x1010, 1, SAVE), 0u);
    EXPECT_EQ(store.saving, NVM_STORE_SAVING);
}

TEST_F(CanopenObjects, defaults_that_contradict_the_supply_are_not_restored) {
    const int32_t least = machine_tables.parameter_default[PARAMETER_UNDER_VOLTAGE_V];
    for (const bool fits : {false, true}) {
        EXPECT_EQ(write(0x2000 + PARAMETER_UNDER_VOLTAGE_V, 0, least - 64), 0u);
        EXPECT_EQ(write(0x1011, 1, LOAD), 0u);
        conditions.dc_link_voltage_q6 = fits ? least : least - 1;
        receive(0, {129, NODE});
        cycle(2);
        EXPECT_EQ(parameters.values[PARAMETER_UNDER_VOLTAGE_V], fits ? least : least - 64);
        EXPECT_EQ(store.saving == NVM_STORE_SAVING, fits);
        EXPECT_EQ(sent().front(), (sent_t{0x700 + NODE, {0}})) << "it starts all the same";
    }
}

TEST_F(CanopenObjects, parameters_that_have_changed_in_memory_are_not_restored) {
    EXPECT_EQ(write(0x2000 + PARAMETER_OVER_SPEED_RPM, 0, 2222), 0u);
    EXPECT_EQ(write(0x1011, 1, LOAD), 0u);
    parameters.values[PARAMETER_SMC_K] ^= 1;
    receive(0, {129, NODE});
    cycle(2);
    EXPECT_EQ(parameters.values[PARAMETER_OVER_SPEED_RPM], 2222);
    EXPECT_FALSE(parameters_intact(&parameters)) << "the drive's fault stays";
    EXPECT_NE(store.saving, NVM_STORE_SAVING);
}

TEST_F(CanopenObjects, a_device_that_restarts_hears_nothing_until_it_has) {
    receive(0, {129, NODE});
    conditions.running = true;
    cycle();
    EXPECT_EQ(sdo(head(0x40, 0x1000, 0)), bytes_t{});
    operational();
    EXPECT_EQ(canopen.nmt, CANOPEN_NMT_PRE_OPERATIONAL);
    conditions.running = false;
    cycle(2);
    EXPECT_EQ(read(0x1000, 0), 0x00020192u);
}

TEST_F(CanopenObjects, frames_of_29_bits_are_none) {
    for (const bool extended : {true, false}) {
        hal_can_frame_t frame{};
        frame.extended = extended;
        frame.length = 2;
        frame.data[0] = 1; // start all nodes
        const canopen_context_t now = context();
        canopen_receive(&canopen, &now, &frame);
        EXPECT_EQ(canopen.nmt, extended ? CANOPEN_NMT_PRE_OPERATIONAL : CANOPEN_NMT_OPERATIONAL);
    }
}

TEST_F(CanopenObjects, an_entry_without_a_time_does_not_take_a_node_from_another) {
    EXPECT_EQ(write(0x1016, 1, MASTER << 16), 0u);
    EXPECT_EQ(write(0x1016, 2, MASTER << 16 | 100), 0u);
    EXPECT_EQ(write(0x1016, 1, MASTER << 16 | 100), 0x06040043u);
    EXPECT_EQ(write(0x1016, 1, (MASTER - 1) << 16 | 100), 0u);
}

TEST_F(CanopenObjects, a_heartbeat_has_one_byte) {
    for (const auto &[data, lives] : {std::pair{bytes_t{5}, true}, {bytes_t{}, false}, {bytes_t{5, 5}, false}}) {
        start_anew();
        write(0x1016, 1, MASTER << 16 | 100);
        enable();
        receive(0x700 + MASTER, {5});
        cycle(90);
        receive(0x700 + MASTER, data);
        cycle(50);
        EXPECT_EQ(canopen.drive.state == CANOPEN_OPERATION_ENABLED, lives) << data.size();
    }
}

TEST_F(CanopenObjects, error_behaviour_is_the_state_after_a_lost_master) {
    const canopen_nmt_t after[] = {CANOPEN_NMT_PRE_OPERATIONAL, CANOPEN_NMT_OPERATIONAL, CANOPEN_NMT_STOPPED};
    for (unsigned behaviour = 0; behaviour < 3; behaviour++) {
        start_anew();
        write(0x1029, 1, int32_t(behaviour));
        write(0x1016, 1, MASTER << 16 | 100);
        enable();
        receive(0x700 + MASTER, {5});
        cycle(100);
        EXPECT_EQ(canopen.nmt, CANOPEN_NMT_OPERATIONAL) << behaviour;
        cycle(2);
        EXPECT_EQ(canopen.nmt, after[behaviour]);
        EXPECT_NE(canopen.drive.state, CANOPEN_OPERATION_ENABLED) << behaviour;
    }
    EXPECT_EQ(sdo(head(0x40, 0x1000, 0)), bytes_t{}) << "no SDO in state stopped";
    start_anew();
    EXPECT_EQ(write(0x1029, 1, 3), 0x06090031u);
}

TEST_F(CanopenObjects, nothing_is_enabled_between_a_bus_off_and_its_reaction) {
    operational();
    control(6);
    control(7);
    canopen.bus_off = true;
    control(15);
    EXPECT_EQ(canopen.drive.state, CANOPEN_SWITCHED_ON);
    EXPECT_EQ(commands.arming.armed, 0);
    cycle();
    operational();
    control(15);
    EXPECT_EQ(canopen.drive.state, CANOPEN_OPERATION_ENABLED) << "by a command after it";
}

TEST_F(CanopenObjects, lss_stores_neither_in_a_run_nor_what_has_changed_in_memory) {
    lss({0x04, 1});
    EXPECT_EQ(lss({0x11, 42}), 0u);
    conditions.running = true;
    EXPECT_EQ(lss({0x17}), 2u);
    conditions.running = false;
    parameters.values[PARAMETER_SMC_K] ^= 1;
    EXPECT_EQ(lss({0x17}), 2u);
    EXPECT_EQ(parameters.values[PARAMETER_PROTOCOL], int32_t(NODE));
    EXPECT_NE(store.saving, NVM_STORE_SAVING);
    parameters.values[PARAMETER_SMC_K] ^= 1;
    EXPECT_EQ(lss({0x17}), 0u);
    EXPECT_EQ(parameters.values[PARAMETER_PROTOCOL], 42);
    EXPECT_EQ(store.saving, NVM_STORE_SAVING);
}

// --- PDOs ------------------------------------------------------------------------------------------------------------

// CiA 301, table of restricted CAN-IDs, and below 0x180 the defaults of SYNC, EMCY and TIME.
TEST_F(CanopenObjects, identifiers_of_other_services_are_none_of_pdos) {
    for (unsigned id = 0; id < 0x800; id++) {
        const bool other = id <= 0x180 || (id > 0x580 && id < 0x600) || (id > 0x600 && id < 0x680) || id >= 0x6E0;
        EXPECT_EQ(canopen_mapping_is_free_id(id), !other) << std::hex << id;
    }
}

TEST_F(CanopenObjects, sync_has_its_default_or_a_free_identifier) {
    write(0x1800, 2, 1);
    operational();
    const auto transmits = [&](uint32_t id) {
        sent();
        receive(id, {});
        return !sent().empty();
    };
    for (const unsigned id : {0x81u, 0x100u, 0x180u, 0x581u, 0x6E0u, 0x7E5u}) {
        EXPECT_EQ(write(0x1005, 0, int32_t(id)), 0x06090030u) << id;
    }
    EXPECT_TRUE(transmits(0x80));
    EXPECT_EQ(write(0x1005, 0, 0x6DF), 0u);
    EXPECT_TRUE(transmits(0x6DF));
    EXPECT_FALSE(transmits(0x80));
    EXPECT_EQ(write(0x1005, 0, 0x80), 0u);
    EXPECT_TRUE(transmits(0x80));
}

TEST_F(CanopenObjects, dummies_are_bytes_of_receive_pdos_without_effect) {
    write(0x1403, 1, int32_t(0x80000000u));
    write(0x1603, 0, 0);
    write(0x1803, 1, int32_t(0x80000000u));
    write(0x1A03, 0, 0);
    const int32_t bits[] = {8, 16, 32, 8, 16, 32};
    for (int32_t type = 2; type <= 7; type++) {
        const int32_t dummy = type << 16 | bits[type - 2];
        EXPECT_EQ(write(0x1603, 1, dummy), 0u) << type;
        EXPECT_EQ(write(0x1603, 1, dummy ^ 0x18), 0x06040042u) << type << ": not its length";
        EXPECT_EQ(write(0x1603, 1, dummy | 0x100), 0x06020000u) << type << ": sub-index 1";
        EXPECT_EQ(write(0x1A03, 1, dummy), 0x06020000u) << type << ": to send";
    }
    EXPECT_EQ(write(0x1603, 1, 0x00010001), 0x06020000u) << "a bit";
    EXPECT_EQ(write(0x1603, 1, 0x00080020), 0x06020000u) << "a real number";
    EXPECT_EQ(write(0x1603, 2, 0), 0u) << "an entry of nothing";
    EXPECT_EQ(write(0x1603, 2, 0x60830020), 0u);
    EXPECT_EQ(write(0x1603, 1, 0x00060010), 0u);
    EXPECT_EQ(write(0x1603, 0, 2), 0u);
    EXPECT_EQ(write(0x1403, 1, 0x500 + NODE), 0u);
    operational();
    receive(0x500 + NODE, {0xFF, 0xFF, 0x10, 0x27, 0, 0});
    EXPECT_EQ(read(0x6083, 0), 10000u);
}

TEST_F(CanopenObjects, the_controlword_is_sent_twice_when_it_is_mapped_twice) {
    write(0x1800, 1, int32_t(0x80000000u));
    write(0x1800, 2, 1);
    write(0x1A00, 0, 0);
    write(0x1A00, 1, 0x60400010);
    write(0x1A00, 2, 0x60400010);
    EXPECT_EQ(write(0x1A00, 0, 2), 0u) << "reading enables nothing";
    EXPECT_EQ(write(0x1800, 1, 0x180 + NODE), 0u);
    control(0x106);
    operational();
    sent();
    receive(0x80, {});
    EXPECT_EQ(sent().front(), (sent_t{0x180 + NODE, {0x06, 0x01, 0x06, 0x01}}));
}

TEST_F(CanopenObjects, a_receive_mapping_that_has_changed_in_memory_takes_a_stop_alone) {
    enable();
    canopen.values[CANOPEN_VALUE_RPDO_MAP + CANOPEN_MAPPED_MAX + 1] ^= 1 << 20; // 0x6060 of the second one
    receive(0x300 + NODE, {0x0F, 1, 9});
    EXPECT_EQ(read(0x6040, 0), 0x0Fu) << "no halt";
    EXPECT_EQ(read(0x6060, 0), 3u);
    receive(0x300 + NODE, {0, 0, 9});
    EXPECT_EQ(canopen.drive.state, CANOPEN_SWITCH_ON_DISABLED);
}

TEST_F(CanopenObjects, a_length_that_has_changed_in_memory_takes_nothing_of_a_frame) {
    operational();
    write(0x1401, 2, 1);
    for (const unsigned length : {2u, 3u}) {
        receive(0x300 + NODE, {6, 0, 9});
        canopen.rpdo[1].length = uint8_t(length);
        receive(0x80, {});
        EXPECT_EQ(read(0x6060, 0), length == 3 ? 9u : 3u);
        EXPECT_EQ(read(0x6040, 0), length == 3 ? 6u : 0u);
    }
}

TEST_F(CanopenObjects, a_frame_that_waits_for_a_sync_is_not_taken_of_a_pdo_that_is_not_valid) {
    operational();
    write(0x1401, 2, 1);
    receive(0x300 + NODE, {6, 0, 9});
    canopen.values[CANOPEN_VALUE_RPDO_ID + 1] ^= int32_t(CANOPEN_PDO_NOT_VALID); // a change in memory
    receive(0x80, {});
    EXPECT_EQ(read(0x6060, 0), 3u);
    canopen.values[CANOPEN_VALUE_RPDO_ID + 1] ^= int32_t(CANOPEN_PDO_NOT_VALID);
    receive(0x80, {});
    EXPECT_EQ(read(0x6060, 0), 9u);
}

TEST_F(CanopenObjects, a_transmit_mapping_that_has_changed_in_memory_ends_before_the_change) {
    write(0x1802, 2, 1);
    operational();
    cycle();
    const auto length = [&] {
        sent();
        receive(0x80, {});
        const auto frames = sent();
        return frames.empty() ? size_t(0) : frames[0].data.size();
    };
    const unsigned map = CANOPEN_VALUE_TPDO_MAP + 2 * CANOPEN_MAPPED_MAX;
    EXPECT_EQ(length(), 6u);
    canopen.values[map + 1] ^= 1 << 30; // 0x206C is no object that is mapped in 32 bits
    canopen.values[map + 1] ^= 1 << 31;
    EXPECT_EQ(length(), 2u);
    canopen.values[map + 1] = canopen.values[map + 2] = 0x606C0020;
    canopen.values[CANOPEN_VALUE_TPDO_COUNT + 2] = 3;
    EXPECT_EQ(length(), 6u) << "ten bytes are not sent";
}

// --- SDO -------------------------------------------------------------------------------------------------------------

TEST_F(CanopenObjects, a_confirmation_names_a_segment_that_was_sent_and_a_size_of_blocks) {
    for (const auto &[confirmed, size, code] :
         {std::tuple{11, 10, 0x05040003u}, {10, 0, 0x05040002u}, {10, 128, 0x05040002u}, {10, 127, 0u}, {0, 1, 0u}}) {
        begin_block_upload(10);
        cycle();
        EXPECT_EQ(sent().size(), 10u);
        EXPECT_EQ(code_of(sdo({0xA2, uint8_t(confirmed), uint8_t(size), 0, 0, 0, 0, 0})), code);
        EXPECT_EQ(canopen.sdo.state == CANOPEN_SDO_IDLE, code != 0);
        cycle();
        EXPECT_EQ(sent().empty(), code != 0);
        sdo({0x80, 0, 0, 0, 0, 0, 0, 0});
    }
}

TEST_F(CanopenObjects, a_client_without_checksums_gets_none) {
    for (const bool check : {true, false}) {
        EXPECT_EQ(sdo(head(check ? 0xA4 : 0xA0, 0x1000, 0, 10)), head(0xC6, 0x1000, 0, 4));
        receive(0x600 + NODE, {0xA3, 0, 0, 0, 0, 0, 0, 0});
        cycle();
        EXPECT_EQ(sent().front().data, (bytes_t{0x81, 0x92, 0x01, 0x02, 0, 0, 0, 0}));
        const bytes_t end = sdo({0xA2, 1, 10, 0, 0, 0, 0, 0});
        EXPECT_EQ(end[0], 0xCD) << "three bytes of the segment do not count";
        EXPECT_EQ((end[1] | end[2]) != 0, check);
        sdo({0xA1, 0, 0, 0, 0, 0, 0, 0});
    }
}

TEST_F(CanopenObjects, an_upload_ends_when_its_object_has_changed_in_memory) {
    sdo(head(0x40, 0x1008, 0));
    canopen.sdo.index ^= 0x8000;
    EXPECT_EQ(code_of(sdo({0x60, 0, 0, 0, 0, 0, 0, 0})), 0x06020000u);
    EXPECT_EQ(canopen.sdo.state, CANOPEN_SDO_IDLE);
    begin_block_upload(10);
    canopen.sdo.index ^= 0x8000;
    cycle();
    const auto frames = sent();
    ASSERT_EQ(frames.size(), 1u);
    EXPECT_EQ(code_of(frames[0].data), 0x06020000u);
    EXPECT_EQ(canopen.sdo.state, CANOPEN_SDO_IDLE);
}

TEST_F(CanopenObjects, a_download_whose_object_has_changed_in_memory_writes_nothing) {
    for (const auto &[index, code] : {std::pair{0x6060u, 0u}, {0x6061u, 0x06010002u}, {0xE060u, 0x06070012u}}) {
        sdo(head(0x21, 0x6060, 0, 1));
        canopen.sdo.index = uint16_t(index);
        EXPECT_EQ(code_of(sdo({0x0D, 4, 0, 0, 0, 0, 0, 0})), code);
        EXPECT_EQ(read(0x6060, 0), 4u);
    }
    sdo(head(0x21, 0x6060, 0, 1));
    canopen.sdo.offset = 2;
    EXPECT_EQ(code_of(sdo({0x0D, 9, 0, 0, 0, 0, 0, 0})), 0x06070012u);
    EXPECT_EQ(read(0x6060, 0), 4u);
    canopen.sdo.index = 0xE060;
    const canopen_context_t now = context();
    EXPECT_EQ(canopen_sdo_commit(&canopen, &now), uint32_t(CANOPEN_NO_OBJECT));
}

TEST_F(CanopenObjects, a_size_that_has_changed_in_memory_stages_nothing_beyond_the_set) {
    sdo(head(0x20, 0x2F00, 0));
    canopen.sdo.size |= 1u << 20;
    canopen.sdo.offset = SET_BYTES - 4;
    const uint64_t written = set.written;
    EXPECT_EQ(sdo({0, 1, 2, 3, 4, 5, 6, 7})[0], 0x20);
    EXPECT_EQ(uint32_t(set.values[PARAMETER_COUNT - 1]), 0x04030201u);
    EXPECT_EQ(set.sum, parameters_sum(set.values));
    EXPECT_EQ(set.written, written) << "the last one is tunable";
    EXPECT_EQ(code_of(sdo({0x11, 1, 2, 3, 4, 5, 6, 7})), 0x06070013u);
    EXPECT_TRUE(parameters_intact(&parameters));
    EXPECT_NE(uint32_t(parameters.values[PARAMETER_COUNT - 1]), 0x04030201u);
}

TEST_F(CanopenObjects, bytes_of_a_number_are_read_as_asked_and_end_with_it) {
    sdo(head(0xA0, 0x1000, 0, 10));
    const canopen_context_t now = context();
    uint8_t data[8] = {};
    EXPECT_EQ(canopen_sdo_get(&canopen, &now, 0, data, 2), 2u);
    EXPECT_EQ(bytes_t(data, data + 3), (bytes_t{0x92, 0x01, 0}));
    EXPECT_EQ(canopen_sdo_get(&canopen, &now, 2, data, 7), 2u);
    EXPECT_EQ(bytes_t(data, data + 3), (bytes_t{0x02, 0, 0}));
    EXPECT_EQ(canopen_sdo_get(&canopen, &now, 4, data, 7), 0u);
}

// --- drive -----------------------------------------------------------------------------------------------------------

TEST_F(CanopenObjects, a_reset_of_communication_keeps_a_fault_and_what_is_not_ready) {
    for (const auto &[state, kept] : {std::pair{DRIVE_STATE_INITIALISE, CANOPEN_NOT_READY},
                                      {DRIVE_STATE_FAULT, CANOPEN_FAULT},
                                      {DRIVE_STATE_READY, CANOPEN_SWITCH_ON_DISABLED}}) {
        start_anew();
        values.status.state = state;
        cycle();
        if (state == DRIVE_STATE_READY) {
            enable();
        }
        receive(0, {130, NODE});
        EXPECT_EQ(canopen.drive.state, kept);
        EXPECT_EQ(commands.arming.armed, 0);
    }
}

TEST_F(CanopenObjects, a_command_is_made_once_in_a_telemetry_cycle) {
    operational();
    EXPECT_TRUE(cycle());
    sent();
    values.motion.speed_rpm = 100000;
    const canopen_context_t now = context();
    EXPECT_FALSE(canopen_step(&canopen, &now, &command));
    EXPECT_TRUE(sent().empty());
    time_us += 10 * CYCLE_US;
    EXPECT_TRUE(cycle());
    EXPECT_FALSE(sent().empty());
}

TEST_F(CanopenObjects, modes_are_the_bits_of_their_object) {
    for (const bool position : {false, true}) {
        canopen.measured.has_position = position;
        const auto bits = uint32_t(canopen_demand_modes(&canopen));
        EXPECT_EQ(bits, position ? 0x3ADu : 0x30Cu);
        for (int32_t mode = -128; mode < 128; mode++) {
            const bool has = mode == 0 || (mode >= 1 && mode <= 32 && (bits >> (mode - 1) & 1) != 0);
            EXPECT_EQ(canopen_demand_has_mode(&canopen, mode), has) << mode;
        }
    }
}

TEST_F(CanopenObjects, a_limited_velocity_is_the_internal_limit) {
    enable();
    EXPECT_EQ(status() & 0x800u, 0u);
    values.status.speed_limited = 1;
    cycle();
    EXPECT_NE(status() & 0x800u, 0u);
}

TEST_F(CanopenObjects, a_state_or_a_fault_that_has_changed_in_memory_is_none_of_its_table) {
    values.status.state = DRIVE_STATE_FAULT;
    values.status.fault = FAULT_COUNT;
    cycle();
    EXPECT_TRUE(sent().empty()) << "no emergency";
    EXPECT_EQ(read(0x603F, 0), 0u);
    EXPECT_EQ(canopen.drive.state, CANOPEN_FAULT);
    values.status.fault = FAULT_COUNT - 1;
    cycle();
    EXPECT_EQ(sent().front().identifier, 0x80u + NODE);
    EXPECT_EQ(read(0x603F, 0), canopen_error_codes[FAULT_COUNT - 1]);
    canopen.drive.state = CANOPEN_STATES;
    EXPECT_EQ(canopen_drive_statusword(&canopen) & 0x6Fu, 0u) << "not ready to switch on";
}

TEST_F(CanopenObjects, what_the_drive_owns_and_cannot_be_written_is_refused_twice) {
    canopen_object_t object;
    ASSERT_EQ(canopen_find(0x6041, 0, &object), uint32_t(CANOPEN_DONE));
    const canopen_context_t now = context();
    EXPECT_EQ(canopen_check(&canopen, &object, 0), uint32_t(CANOPEN_READ_ONLY));
    EXPECT_EQ(canopen_write(&canopen, &now, &object, 0), uint32_t(CANOPEN_READ_ONLY));
}

TEST_F(CanopenObjects, homing_methods_are_those_of_the_profile_there_and_back) {
    const int32_t numbers[] = {37, 34, 33, -2, -1};
    for (int32_t parameter = 0; parameter < POSITION_HOMING_METHODS; parameter++) {
        EXPECT_EQ(canopen_homing_number(parameter), numbers[parameter]);
        EXPECT_EQ(canopen_homing_method(numbers[parameter]), position_homing_t(parameter));
    }
    EXPECT_EQ(canopen_homing_method(35), POSITION_HOMING_HERE);
    EXPECT_EQ(canopen_homing_number(POSITION_HOMING_METHODS), 0) << "none";
    EXPECT_EQ(canopen_homing_number(-1), 0);
}

// --- other machines --------------------------------------------------------------------------------------------------

class OtherMachine : public CanopenObjects {
  protected:
    ~OtherMachine() override { machine_tables = present; }

    const machine_tables_t present = machine_tables;
};

TEST_F(OtherMachine, speeds_of_a_slow_or_fast_one_are_those_of_its_shaft) {
    for (uint8_t exponent = 0; exponent <= 3; exponent++) {
        machine_tables.speed_exponent = exponent;
        for (const int32_t milli : {-1000000, -8, 0, 8, 1000000}) {
            EXPECT_EQ(canopen_machine_speed(milli), milli / (1 << exponent)) << unsigned(exponent);
            EXPECT_EQ(canopen_speed_of_machine(milli), milli * (1 << exponent)) << unsigned(exponent);
        }
    }
}

TEST_F(OtherMachine, one_without_torque_divides_by_the_least_one) {
    machine_tables.parameter_default[PARAMETER_TORQUE_MAX_NM] = 0;
    EXPECT_EQ(canopen_torque(7), 7000);
    machine_tables.parameter_default[PARAMETER_TORQUE_MAX_NM] = 2;
    EXPECT_EQ(canopen_torque(7), 3500);
}

TEST_F(OtherMachine, millivolts_follow_from_any_count_of_fraction_bits) {
    for (const auto &[bits, expected] : {std::pair{6, 15625u}, {1, 500000u}, {0, 1000000u}, {-1, 2000000u}}) {
        machine_tables.parameter_fraction_bits[PARAMETER_OVER_VOLTAGE_V] = int8_t(bits);
        EXPECT_EQ(canopen_milli_volts(1000), expected) << bits;
    }
}

} // namespace
