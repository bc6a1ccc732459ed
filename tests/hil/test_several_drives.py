"""Drives with node numbers of their own on one bus."""

from __future__ import annotations

import can
import numpy as np
import pytest

from salient.bench.arming import arm_frame
from salient.bench.drive import command_frame
from salient.bus.signals import drive_database, rig_database
from salient.dbc import NODE_STEP

pytestmark = pytest.mark.bench_options(drives=2)
COUNTERS = ("unknown_frame", "wrong_length", "wrong_checksum", "wrong_counter", "out_of_range",
            "foreign_identifier_count", "telemetry_dropped")


def counts(drive) -> dict[str, int]:
    return {name: int(drive.telemetry[name].last) for name in COUNTERS}


def start(bench, *speeds_rpm: float) -> None:
    for drive, speed_rpm in zip(bench.drives, speeds_rpm, strict=True):
        drive.speed_reference_rpm = speed_rpm


def speeds_rpm(bench, from_s: float) -> list[np.ndarray]:
    return [rig.truth["speed_rpm"].between(from_s, bench.time_s).value for rig in bench.rigs]


@pytest.mark.both_transports
def test_two_drives_hold_different_speeds_under_different_loads(bench):
    start(bench, 600.0, -300.0)
    bench.run_for(0.1)
    bench.rigs[0].load_torque_Nm = 8.0
    bench.rigs[1].load_torque_Nm = -3.0
    bench.run_for(0.15)
    assert [drive.state for drive in bench.drives] == ["run", "run"]
    for speed_rpm, values, drive, load_Nm in zip((600.0, -300.0), speeds_rpm(bench, bench.time_s - 0.05), bench.drives,
                                                 (8.0, -3.0), strict=True):
        assert len(values) >= 49
        assert np.abs(values - speed_rpm).max() < 0.005 * abs(speed_rpm)
        assert drive.telemetry["speed_rpm"].last == pytest.approx(speed_rpm, rel=0.005)
        assert drive.telemetry["load_torque_estimate_Nm"].last == pytest.approx(load_Nm, abs=0.5)
        assert not any(counts(drive).values())
    assert bench.drive is bench.drives[0] and bench.telemetry is bench.drive.telemetry
    assert bench.rig is bench.rigs[0] and bench.truth is bench.rig.truth


def test_fault_in_one_drive_does_not_touch_the_other(bench):
    start(bench, 600.0, 600.0)
    bench.run_for(0.12)
    bench.rigs[1].fault("encoder_jump", angle_deg=90.0)
    bench.run_until(lambda: bench.drives[1].state == "fault", timeout=0.05)
    fault_s = bench.time_s
    bench.run_for(0.2)
    assert [drive.fault for drive in bench.drives] == ["none", "encoder"]
    first, second = speeds_rpm(bench, fault_s)
    assert np.abs(first - 600.0).max() < 3.0
    assert 0.0 < second[-1] < 550.0
    assert not any(counts(bench.drives[0]).values())
    assert bench.rigs[0].truth.count("RIG_TRUTH_FAULT") == 0 < bench.rigs[1].truth.count("RIG_TRUTH_FAULT")


def test_commands_that_stop_time_out_one_drive_only(bench):
    start(bench, 400.0, 500.0)
    bench.run_for(0.15)
    bench.drives[0].silence()
    bench.run_for(0.7)
    assert [drive.fault for drive in bench.drives] == ["command_timeout", "none"]
    assert bench.drives[1].state == "run"
    assert np.abs(speeds_rpm(bench, 0.15)[1] - 500.0).max() < 2.5


def test_commands_and_arming_of_one_node_do_not_move_another(bench):
    bench.drives[1].speed_reference_rpm = 600.0
    bench.run_for(0.15)
    assert [drive.state for drive in bench.drives] == ["ready", "run"]
    assert [drive.armed for drive in bench.drives] == [False, True]
    assert np.all(speeds_rpm(bench, 0.0)[0] == 0.0)
    assert not any(counts(bench.drives[0]).values())


def test_frames_of_one_node_with_the_identifiers_of_another_are_refused(bench):
    """A gateway that rewrites identifiers: the data IDs differ."""
    other = drive_database(node=1)
    bench.drives[0].off()
    bench.run_for(0.05)
    command, arm = (other.get_message_by_name(name) for name in ("DRIVE_COMMAND", "DRIVE_ARM"))
    for number, frame in enumerate((command_frame(7, "run", 600.0, command), arm_frame(1, "request_run", 0, arm)), 1):
        frame.arbitration_id -= NODE_STEP
        bench.send(frame)
        bench.run_for(0.11)
        assert bench.telemetry["wrong_checksum"].last == number
    assert bench.telemetry["DRIVE_ARMING.attempt"].value.max() == 0


def test_equal_drives_with_equal_commands_have_their_own_noise(bench):
    for rig in bench.rigs:
        rig.current_noise_A = 0.5
    start(bench, 600.0, 600.0)
    bench.run_for(0.1)
    first, second = speeds_rpm(bench, 0.0)
    assert not np.array_equal(first, second)
    assert np.abs(first - second)[-20:].max() < 3.0


def test_equal_runs_of_two_drives_have_equal_logs(make_bench):
    logs = []
    for _ in range(2):
        bench = make_bench(drives=2, seed=4)
        start(bench, 600.0, -600.0)
        bench.at(0.05).load_torque_Nm = 5.0
        bench.rigs[1].at(0.06).load_torque_Nm = 2.0
        bench.run_for(0.1)
        logs.append([(time_ns, m.arbitration_id, bytes(m.data)) for time_ns, m in bench.log])
    assert logs[0] == logs[1] and len(logs[0]) > 500


def test_first_of_two_drives_has_the_bits_of_a_drive_alone(make_bench):
    """Its plant does not depend on what else the bus carries."""
    speeds = []
    for drives in (1, 2):
        bench = make_bench(drives=drives, telemetry_period_ms=4)
        bench.drive.speed_reference_rpm = 600.0
        bench.at(0.1).load_torque_Nm = 6.0
        bench.run_for(0.2)
        speeds.append(bench.truth["speed_rpm"].value)
    assert np.array_equal(*speeds) and speeds[0][-1] == pytest.approx(600.0, rel=0.005)


def test_bus_off_of_one_drive_leaves_the_other_on_the_bus(bench):
    start(bench, 300.0, 300.0)
    bench.run_for(0.1)
    bench.rigs[1].transmit_error_counter = 256
    bench.run_for(0.8)
    assert [drive.telemetry["bus_off_count"].last for drive in bench.drives] == [0, 1]
    assert [drive.state for drive in bench.drives] == ["run", "fault"]
    assert bench.drives[0].telemetry["transmit_error_counter"].last == 0


def test_disconnected_drive_is_silent_and_the_other_is_not(bench):
    bench.run_for(0.05)
    bench.rigs[0].bus_connection = 0
    bench.run_for(0.2)
    last_s = [drive.telemetry["DRIVE_STATUS.time_us"].last_time_s for drive in bench.drives]
    assert last_s[0] < 0.06 and last_s[1] > 0.24


def test_two_drives_share_the_bus_without_a_loss(bench):
    """By arbitration: every frame of both is there, none at the same time as another."""
    bench.run_for(1.0)
    for drive in bench.drives:
        assert drive.telemetry.count("DRIVE_STATUS") == 250
        assert drive.telemetry.count("DRIVE_HEARTBEAT") == 10
        assert not any(counts(drive).values())
    times_ns = [time_ns for time_ns, m in bench.log if not m.is_extended_id]
    assert np.diff(times_ns).min() >= 47_000  # the shortest frame of a drive has more bits


@pytest.mark.both_transports
@pytest.mark.bench_options(drives=1, node=5)
def test_drive_with_a_node_number_uses_its_identifiers_only(bench):
    bench.drive.speed_reference_rpm = 600.0
    bench.run_for(0.12)
    bench.rig.load_torque_Nm = 4.0
    bench.run_for(0.08)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(600.0, rel=0.005)
    of_drive = {m.frame_id for m in drive_database(node=5).messages}
    of_rig = {m.frame_id for m in rig_database(5).messages}
    seen = {(m.arbitration_id, m.is_extended_id) for _, m in bench.log}
    assert {i for i, extended in seen if not extended} <= of_drive
    assert {i for i, extended in seen if extended} <= of_rig
    assert bench.drive.parameters["command_timeout_ms"] == 50.0
    assert not any(counts(bench.drive).values())


@pytest.mark.bench_options(drives=8, telemetry_period_ms=20)
def test_eight_drives_run_on_one_bus(bench):
    for number, drive in enumerate(bench.drives):
        drive.speed_reference_rpm = 100.0 * (number + 1)
    bench.run_for(0.25)
    for number, values in enumerate(speeds_rpm(bench, bench.time_s - 0.02)):
        assert np.abs(values / (100.0 * (number + 1)) - 1.0).max() < 0.005, number


@pytest.mark.bench_options(drives=1)
def test_frames_of_another_node_are_no_errors(bench):
    bench.run_for(0.01)
    for identifier in (0x090, 0x1F0, 0x2A3, 0x590, 0x670, 0x711):
        bench.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=bytes(8)))
    bench.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=bytes(8)))
    bench.run_for(0.2)
    assert counts(bench.drive) == dict.fromkeys(COUNTERS, 0) | {"unknown_frame": 1}
    assert bench.drive.state == "ready"
