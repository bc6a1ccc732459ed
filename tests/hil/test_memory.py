"""The memory of the drive over CAN: parameters and faults that survive a reset, power cuts while the drive stores."""

from __future__ import annotations

import contextlib
import itertools

import pytest

from salient.bench.drive import DriveError
from salient.bench.rig import RigError
from salient.errors import UsageError


def reset(bench) -> None:
    """Also until the frames that were waiting in the mailboxes have left."""
    bench.rig.drive_reset = 1
    bench.run_for(0.02)


def test_saved_parameters_survive_a_reset_and_others_do_not(bench):
    parameters = bench.drive.parameters
    parameters["over_speed_rpm"] = 1234
    parameters["current_trip_A"] = 60.5
    assert parameters.origin == "defaults"
    parameters.save()
    parameters["over_speed_rpm"] = 2000
    reset(bench)
    assert parameters["over_speed_rpm"] == 1234
    assert parameters["current_trip_A"] == 60.5
    assert parameters.origin == "memory"
    reset(bench)
    assert parameters["over_speed_rpm"] == 1234


def test_restored_defaults_act_at_once_and_are_stored_only_when_saved(bench):
    parameters = bench.drive.parameters
    default = parameters["over_speed_rpm"]
    parameters["over_speed_rpm"] = 1234
    parameters.save()
    parameters.restore_defaults()
    assert all(parameters[name] == row.default for name, row in parameters.rows.items())
    reset(bench)
    assert parameters["over_speed_rpm"] == 1234
    parameters.restore_defaults()
    parameters.save()
    reset(bench)
    assert parameters["over_speed_rpm"] == default


@pytest.mark.parametrize("operation", ["save", "restore_defaults"])
def test_not_while_the_drive_runs(bench, operation: str):
    bench.drive.parameters["over_speed_rpm"] = 1234
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.02)
    with pytest.raises(DriveError, match=f"{operation}: not_while_running"):
        getattr(bench.drive.parameters, operation)()
    assert bench.drive.state == "run" and bench.drive.parameters["over_speed_rpm"] == 1234
    bench.drive.off()
    reset(bench)
    assert bench.drive.parameters.origin == "defaults"


def test_reset_opens_the_switches_starts_anew_and_leaves_the_motor_turning(bench):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    before = bench.truth["speed_rpm"].last
    assert before == pytest.approx(600, abs=3)
    bench.drive.silence()
    bench.run_for(0.002)  # the last command has arrived
    bench.rig.drive_reset = 1
    bench.run_for(0.004)
    assert bench.telemetry["DRIVE_STATUS.time_us"].last == pytest.approx(4000, abs=1500)
    assert bench.drive.state in ("initialise", "ready")
    bench.run_for(0.016)
    assert bench.drive.state == "ready"
    assert all(bench.truth[f"current_{phase}_A"].last == 0.0 for phase in "abc")
    assert 0.8 * before < bench.truth["speed_rpm"].last < before
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)


def test_reset_at_a_virtual_time_is_exact(bench):
    bench.at(0.0300125).drive_reset = 1
    bench.run_for(0.05)
    status = bench.telemetry["DRIVE_STATUS.time_us"]
    offsets = status.time_s - status.value * 1e-6
    assert max(offsets[status.time_s < 0.03]) < 0.001
    assert 0.030 < min(offsets[status.time_s > 0.0325]) < 0.031


def provoke(bench) -> None:
    """An over-voltage in the run, and the end of its cause."""
    bench.drive.speed_reference_rpm = 400
    bench.run_for(0.05)
    bench.rig.supply_voltage_V = 310
    bench.run_until(lambda: bench.drive.state == "fault", 0.1)
    bench.rig.supply_voltage_V = 240
    bench.run_for(0.05)


# [SR-60]
def test_fault_log_has_the_snapshot_of_each_fault_and_survives_a_reset(bench):
    assert list(bench.drive.fault_log) == []
    provoke(bench)
    cause = {name: bench.telemetry[f"DRIVE_FAULT_SNAPSHOT.{name}"].last
             for name in ("speed_rpm", "bus_voltage_V", "current_max_A", "torque_reference_Nm")}
    time_us = bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last
    [first] = bench.drive.fault_log
    assert (first.number, first.start, first.fault, first.checks, first.state) == (
        1, 1, "over_voltage", ("over_voltage",), "run")
    assert first.time_s == time_us / 1e6
    assert {name: getattr(first, name) for name in cause} == cause
    assert first.bus_voltage_V > 300 and 300 < first.speed_rpm < 500
    reset(bench)
    assert list(bench.drive.fault_log) == [first]
    provoke(bench)
    [kept, second] = bench.drive.fault_log
    assert kept == first
    assert (second.number, second.start, second.fault) == (2, 2, "over_voltage")


# [SR-60]
def test_fault_log_has_the_last_16_faults(bench):
    bench.drive.wait_until_ready()
    for _ in range(18):
        bench.rig.supply_voltage_V = 310
        bench.run_until(lambda: bench.drive.state == "fault", 0.1)
        bench.rig.supply_voltage_V = 240
        bench.run_for(0.03)
        bench.drive.clear_fault()
        bench.run_until(lambda: bench.drive.state == "ready", 0.1)
    log = list(bench.drive.fault_log)
    assert [fault.number for fault in log] == list(range(3, 19))
    assert all(a.time_s < b.time_s for a, b in itertools.pairwise(log))


# [SR-59]
def test_power_cut_while_saving_leaves_the_old_set_or_the_new_one(bench):
    bench.rig.truth_period_us = 0
    parameters = bench.drive.parameters
    names = list(parameters.rows)
    parameters.save()
    old = {name: parameters[name] for name in names}
    operations = 60  # a set takes 32, the number of the start 3
    seen = set()
    for operation in range(1, operations, 3):
        low = operation % 2 == 0
        for name in ("over_speed_rpm", "current_limit_A", "torque_slew_rate_Nm_s"):
            parameters[name] = parameters.row(name).minimum + (20 if low else 30)
        new = {name: parameters[name] for name in names}
        bench.rig.memory_cut_kind = operation // 3 % 3
        bench.rig.memory_cut_operation = operation
        with contextlib.suppress(DriveError):  # of a drive that has started again and stores nothing
            parameters.save()
        bench.run_for(0.02)
        bench.rig.memory_cut_operation = 0
        reset(bench)
        found = {name: parameters[name] for name in names}
        assert found in (old, new), operation
        assert bench.drive.state == "ready"
        seen.add(found == new)
        old = found
    assert seen == {True, False}


def test_memory_file_is_kept_from_one_drive_to_the_next(make_bench, tmp_path):
    file = tmp_path / "memory.bin"
    first = make_bench(memory=file)
    first.drive.parameters["over_speed_rpm"] = 1234
    first.drive.parameters.save()
    provoke(first)
    first.close()
    second = make_bench(memory=file)
    second.run_for(0.02)
    assert second.drive.parameters["over_speed_rpm"] == 1234
    assert [(fault.start, fault.fault) for fault in second.drive.fault_log] == [(1, "over_voltage")]
    second.close()
    # A damaged set, the only one: the drive does not start before one is stored.
    content = bytearray(file.read_bytes())
    content[32] ^= 1
    file.write_bytes(content)
    third = make_bench(memory=file)
    third.run_for(0.02)
    assert third.drive.state == "initialise" and third.drive.start_inhibited_by == "parameter_memory"
    assert third.drive.parameters.origin == "unusable"
    assert third.drive.parameters["over_speed_rpm"] == third.drive.parameters.row("over_speed_rpm").default
    third.drive.speed_reference_rpm = 300
    third.run_for(0.05)
    assert third.drive.state == "initialise"
    third.drive.off()
    third.drive.parameters.save()
    third.run_for(0.01)
    assert third.drive.state == "ready" and third.drive.start_inhibited_by == "none"


# [SR-58]
def test_set_of_another_machine_is_not_loaded(make_bench, tmp_path):
    file = tmp_path / "memory.bin"
    first = make_bench(memory=file)
    first.drive.parameters.save()
    first.close()
    other = make_bench(memory=file, machine="finite_element")
    other.run_for(0.02)
    assert other.drive.start_inhibited_by == "parameter_memory"


def test_memory_file_of_a_wrong_size_is_refused(make_bench, tmp_path):
    file = tmp_path / "memory.bin"
    file.write_bytes(b"text")
    with pytest.raises(UsageError, match=rf"--memory {file}: not the memory of a drive, 32768 bytes"):
        make_bench(memory=file)
    assert file.read_bytes() == b"text"


def test_reset_value_out_of_range_is_refused(bench):
    with pytest.raises(RigError, match="drive_reset 2: must be 0 to 1"):
        bench.rig.drive_reset = 2
