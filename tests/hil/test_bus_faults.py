"""A drive on a bus with faults: babbling node, bus-off, lost acknowledgement, second sender of its identifiers.
[SR-38]
"""

from __future__ import annotations

import itertools

import can
import numpy as np
import pytest

from salient.bus.clock import open_bus
from salient.bus.signals import drive_database

pytestmark = pytest.mark.bench_options(controller="traditional")

DRIVE_IDS = frozenset(m.frame_id for m in drive_database().messages if "DRIVE" in m.senders)
RUN_ENDS_S = 0.5
"""Time without a command after which a run ends in the fault command_timeout."""
MOTION_ID = drive_database().get_message_by_name("DRIVE_MOTION").frame_id


def bus_state(bench) -> tuple[str, int, int]:
    """Error state and the transmit and receive error counters by the latest telemetry."""
    return (bench.telemetry["DRIVE_BUS_STATE.bus_state"].last_name,
            int(bench.telemetry["transmit_error_counter"].last), int(bench.telemetry["receive_error_counter"].last))


def running(bench, speed_rpm: float = 600.0):
    """The drive in state run at a speed."""
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.2)
    assert bench.drive.state == "run"
    return bench


# [SR-05]
def test_control_is_bit_identical_under_a_babbling_node_of_identifier_0_until_the_command_times_out(
        make_bench, tmp_path):
    def silence(bench):
        bench.drive.silence()  # the babbling node keeps the commands from the drive: here they are not sent

    def babble(bench):
        bench.rig.babble_load_percent = 100

    def recorded(name, attack):
        bench = make_bench(controller="salient", record=tmp_path / f"{name}.npy", record_step_ns=5_000,
                           record_from_us=150_000)
        bench.drive.parameters["command_timeout_ms"] = 100  # the ramp of the torque begins after the record
        running(bench)
        attack(bench)
        bench.advance_to(280_000_000)  # 100 ms after the last command at 0.19 s or a little later: still in run
        bench.close()
        return np.load(tmp_path / f"{name}.npy")

    babbled = recorded("babbled", babble)
    assert len(babbled) == 26_001
    assert np.array_equal(babbled, recorded("silent", silence))


# [SR-05]
@pytest.mark.parametrize("length", [0, 8])
def test_babbling_node_of_identifier_0_at_full_load_lets_commands_time_out_and_counters_agree(bench, length):
    running(bench)
    before = {name: bench.telemetry[name].last for name in ("unknown_frame", "receive_overflow")}
    bench.rig.babble_length = length
    last_command_s = max(time_ns for time_ns, m in bench.log if m.arbitration_id == 128) * 1e-9
    start_s = bench.time_s
    bench.rig.babble_load_percent = 100
    bench.run_for(0.7)
    assert not [m for time_ns, m in bench.log if m.arbitration_id in DRIVE_IDS and not m.is_extended_id
                and time_ns * 1e-9 > start_s + 0.001], "nothing else is on the bus"
    bench.rig.babble_load_percent = 0
    bench.run_for(0.3)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_timeout")
    fault_s = bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last * 1e-6
    assert last_command_s + RUN_ENDS_S <= fault_s <= start_s + RUN_ENDS_S + 0.001
    babbled = [m for time_ns, m in bench.log if m.arbitration_id == 0 and not m.is_extended_id]
    # The load: 8 bytes, whose stuff bits vary, or none.
    assert len(babbled) == pytest.approx(0.7e6 / (50 + 3) if length == 0 else 0.7e6 / 125, rel=0.05)
    after = {name: bench.telemetry[name].last for name in before}
    assert sum(after.values()) - sum(before.values()) == len(babbled)
    assert after["receive_overflow"] == 0
    assert bus_state(bench) == ("error_active", 0, 0)
    assert bench.telemetry["foreign_identifier_count"].last == 0


# [SR-32]
@pytest.mark.both_transports
def test_frames_of_a_babbling_node_are_in_the_log_at_their_times(bench):
    bench.drive.off()
    bench.run_for(0.01)
    bench.rig.babble_load_percent = 100
    bench.rig.babble_length = 0
    for _ in range(20):
        bench.run_for(0.001)  # what an interface keeps for a receiver is limited
    times = [time_ns for time_ns, m in bench.log if m.arbitration_id == 0 and not m.is_extended_id]
    assert len(times) == pytest.approx(20_000 / 53, abs=4)
    assert {after - before for before, after in itertools.pairwise(times)} == {53_000}


# [SR-32]
def test_heartbeat_and_commands_pass_a_babbling_node_of_the_lowest_priority(bench):
    running(bench)
    bench.rig.babble_identifier = 0x7FF
    bench.rig.babble_load_percent = 100
    bench.run_for(0.5)
    assert bench.drive.state == "run"
    heartbeats = [time_ns for time_ns, m in bench.log if m.arbitration_id == 1793 and time_ns > 200_000_000]
    assert len(heartbeats) in (4, 5, 6)
    assert bench.telemetry["telemetry_dropped"].last == 0


@pytest.mark.in_turns
def test_bus_off_100_times_and_back_and_the_drive_never_runs_by_itself(bench):
    """The sender of commands continues throughout: it requests run all the time."""
    running(bench)
    bench.rig.transmit_error_counter = 256
    for count in range(2, 101):
        bench.run_for(0.34)  # the longest back-off, 128 x 11 bits, and a telemetry cycle
        assert bench.drive.state == "fault" or count == 2
        bench.rig.transmit_error_counter = 256
    bench.run_for(0.6)
    assert bench.telemetry["bus_off_count"].last == 100
    assert bus_state(bench) == ("error_active", 0, 0)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_timeout")
    bench.drive.clear_fault()
    bench.run_for(0.02)
    assert bench.drive.state == "ready"
    running(bench)


def test_first_bus_off_is_left_after_10_ms_and_128_times_11_bits(bench):
    running(bench)
    start_ns = bench.time_ns
    bench.rig.transmit_error_counter = 256
    bench.run_for(0.02)
    own = [time_ns - start_ns for time_ns, m in bench.log
           if m.arbitration_id in DRIVE_IDS and not m.is_extended_id and time_ns > start_ns + 1_000_000]
    # Seen by the next of the steps of 1 ms, and left by a step; then one frame.
    assert 10_000_000 + 1_408_000 <= own[0] <= 12_000_000 + 1_408_000 + 150_000
    assert bench.telemetry["bus_off_count"].last in (0, 1)  # sent each 100 ms


@pytest.mark.in_turns
def test_bus_off_again_as_soon_as_the_controller_has_rejoined_is_left_by_the_next_attempt(bench):
    running(bench)
    for again_ms in range(20):  # within the steps of 1 ms in which the drive reads the state of the controller
        bench.rig.transmit_error_counter = 256
        bench.run_for(0.0119 + again_ms * 1e-4)
        bench.rig.transmit_error_counter = 256
        bench.run_for(0.7)  # the longest wait, twice
        begin_ns = bench.time_ns
        bench.run_for(1.01)  # error free: the next wait is the first one again
        heard = [time_ns for time_ns, m in bench.log if m.arbitration_id in DRIVE_IDS and not m.is_extended_id]
        assert heard[-1] > begin_ns + 990_000_000


def test_run_request_that_continues_through_bus_off_is_not_taken_up_again(bench):
    running(bench)
    bench.rig.transmit_error_counter = 256
    bench.run_for(0.8)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_timeout")
    bench.drive.clear_fault()
    bench.run_for(0.02)
    assert bench.drive.state == "ready"


# [SR-05] [SR-38]
def test_lost_acknowledgement_is_error_passive_never_bus_off_and_the_command_times_out(bench):
    running(bench)
    bench.rig.bus_connection = 0
    bench.run_for(1.0)
    assert not [m for time_ns, m in bench.log
                if m.arbitration_id in DRIVE_IDS and not m.is_extended_id and time_ns > 202_000_000]
    bench.rig.bus_connection = 1
    bench.run_for(0.2)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_timeout")
    cause_us = bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last
    assert 190_000 + RUN_ENDS_S * 1e6 <= cause_us <= 200_100 + RUN_ENDS_S * 1e6
    state, transmit_errors, _ = bus_state(bench)
    assert state == "error_active"
    assert transmit_errors < 128, "each acknowledged frame reduces it by 1"
    assert bench.telemetry["bus_off_count"].last == 0


def test_error_passive_and_the_counter_are_reported(bench):
    """Each frame that is transmitted reduces the counter by 1: a cycle has four, that at 100 ms the report as well."""
    bench.run_for(0.0985)
    bench.rig.transmit_error_counter = 200
    bench.run_for(0.005)
    state, transmit_errors, receive_errors = bus_state(bench)
    assert (state, receive_errors) == ("error_passive", 0)
    assert 190 <= transmit_errors <= 197
    bench.run_for(0.1)
    assert bus_state(bench) == ("error_active", 0, 0)


# [SR-37]
def test_second_sender_of_a_telemetry_identifier_is_a_fault_that_outlasts_it_by_a_second(bench):
    running(bench)
    with open_bus(bench.address) as other:
        start_us = bench.time_ns / 1000
        other.send(can.Message(arbitration_id=MOTION_ID, is_extended_id=False, data=bytes(8)))
        bench.run_for(0.01)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "identifier_conflict")
    assert 50 <= bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last - start_us <= 1500
    assert bench.telemetry["DRIVE_FAULT_MASK.identifier_conflict"].last == 1
    bench.drive.clear_fault()
    bench.run_for(0.9)
    assert bench.drive.state == "fault"
    bench.drive.clear_fault()
    bench.run_for(0.2)
    bench.drive.clear_fault()
    bench.run_for(0.02)
    assert bench.drive.state == "ready"
    assert bench.telemetry["foreign_identifier_count"].last == 1


# [SR-37]
def test_babbling_second_sender_collides_and_both_counters_climb(bench):
    """Whenever both transmit the identifier at once, the data differ: bit errors, up to bus-off."""
    running(bench)
    bench.rig.babble_identifier = MOTION_ID
    bench.rig.babble_load_percent = 100
    bench.run_for(1.0)
    bench.rig.babble_load_percent = 0
    bench.run_for(0.5)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "identifier_conflict")
    assert bench.telemetry["bus_off_count"].last >= 1
    assert bench.telemetry["foreign_identifier_count"].last > 1000


# [SR-32]
@pytest.mark.parametrize(("fault", "sender"), [("lost", "others"), ("corrupted", "all"), ("delayed", "all"),
                                           ("duplicated", "all")])
def test_drive_runs_on_while_one_frame_in_ten_is_disturbed(bench, fault, sender):
    numbers = {"lost": 1, "corrupted": 2, "delayed": 3, "duplicated": 4, "all": 0, "others": 2}
    bench.rig.frame_fault_per_mille = 100
    bench.rig.frame_delay_us = 2000
    bench.rig.frame_fault_sender = numbers[sender]
    running(bench)
    bench.rig.frame_fault = numbers[fault]
    bench.run_for(1.0)
    assert bench.drive.state == "run"
    assert bench.telemetry["speed_rpm"].last == pytest.approx(600, abs=5)
    bench.rig.frame_fault = 0
    bench.run_for(0.3)
    counted = bench.telemetry["command_accepted"].last
    sent = len([m for _, m in bench.log if m.arbitration_id == 128])
    if fault == "lost":
        assert 0.8 * sent < counted < 0.98 * sent
    elif fault == "duplicated":
        assert bench.telemetry["wrong_counter"].last == pytest.approx(0.07 * sent, abs=0.06 * sent)
    if fault == "corrupted":
        assert bus_state(bench)[0] == "error_active"
        assert bench.telemetry["bus_off_count"].last == 0


# [SR-32]
def test_equal_seeds_disturb_equal_frames(make_bench):
    def counters(seed):
        bench = make_bench(seed=seed)
        bench.rig.frame_fault_per_mille = 200
        bench.rig.frame_fault_sender = 1
        bench.rig.frame_fault = 1
        bench.run_for(0.1)
        times = [time_ns for time_ns, m in bench.log if m.arbitration_id == 384]
        bench.close()
        return times

    assert counters(1) == counters(1)
    assert counters(1) != counters(2)
