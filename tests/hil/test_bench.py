"""The fixture `bench` and its classes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from signal import SIGCONT, SIGKILL, SIGSTOP

import can
import numpy as np
import pytest

from salient.bench import session as session_module
from salient.bench.drive import DriveError
from salient.bench.emulator import EmulatorProcess
from salient.bench.programs import EmulatorError
from salient.bench.rig import RigError, bench_variables
from salient.bench.session import Session, SessionError
from salient.bus.signals import drive_database, rig_database
from salient.config import BenchConfig
from salient.errors import UsageError

FAILING_TEST = """
import pytest

@pytest.mark.bench_options(controller="paper", seed=77)
def test_that_fails(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.06)
    assert bench.truth["speed_rpm"].last > 1e6
"""


@pytest.mark.both_transports
def test_time_advances_only_on_request(bench):
    assert bench.time_ns == 0
    bench.run_for(0.0123)
    assert bench.time_ns == 12_300_000
    bench.advance_to(12_300_000)
    assert bench.time_ns == 12_300_000
    bench.run_for(1e-9)
    assert bench.time_ns == 12_300_001


def test_default_controller_is_salient(bench):
    assert bench.simulator.ready["controller"] == "salient"
    bench.run_for(0.005)
    assert bench.telemetry["DRIVE_STATUS.controller"].last_name == "salient"


@pytest.mark.both_transports
def test_drive_runs_and_carries_a_load(bench):
    bench.drive.speed_reference_rpm = 300
    bench.at(0.08).load_torque_Nm = 4
    bench.run_for(0.15)
    assert bench.drive.state == "run"
    assert bench.drive.fault == "none"
    assert bench.truth["speed_rpm"].last == pytest.approx(300, abs=6)
    assert bench.telemetry["speed_rpm"].last == pytest.approx(bench.truth["speed_rpm"].last, abs=3)
    load = bench.truth["load_torque_Nm"]
    assert set(load.value[load.time_s < 0.08]) == {0.0}
    assert set(load.value[load.time_s > 0.0801]) == {4.0}


def test_load_acts_immediately(bench):
    bench.run_for(0.0105)
    bench.load_torque_Nm = 2.5
    assert bench.load_torque_Nm == 2.5
    bench.run_for(0.001)
    assert bench.truth["load_torque_Nm"].last == 2.5


def test_run_until_stops_at_the_condition_or_the_timeout(bench):
    bench.drive.speed_reference_rpm = 300
    reached_s = bench.run_until(lambda: bench.truth["speed_rpm"].last > 150, timeout=0.1)
    assert 0.01 < reached_s == bench.time_s < 0.05
    with pytest.raises(AssertionError, match="within 0.01 s, at .* s of virtual time"):
        bench.run_until(lambda: False, timeout=0.01)


@pytest.mark.parametrize("duration_s", [-1, -1e-8, float("nan"), float("inf"), "1", None, True])
def test_time_that_cannot_pass_is_refused(bench, duration_s):
    for run, name in ((bench.run_for, "run_for: duration_s"), (bench.leave_running, "leave_running: duration_s"),
                      (lambda value: bench.run_until(lambda: True, timeout=value), "run_until: timeout"),
                      (lambda value: bench.run_until(lambda: False, timeout=0.01, step_s=value), "run_until: step_s")):
        with pytest.raises(UsageError, match=f"^{name} {re.escape(repr(duration_s))}: must be a number of seconds"):
            run(duration_s)
    assert bench.time_ns == 0


def test_step_of_no_time_is_refused(bench):
    with pytest.raises(UsageError, match="^run_until: step_s 0: must be a number of seconds from 1e-09"):
        bench.run_until(lambda: False, timeout=0.01, step_s=0)


def test_value_instead_of_a_condition_is_refused(bench):
    bench.run_for(0.005)
    with pytest.raises(UsageError, match=r"^run_until: condition (np\.)?False_?: must be a function"):
        bench.run_until(bench.truth["speed_rpm"].last > 150, timeout=0.1)
    with pytest.raises(UsageError, match="^run_until: condition 'speed_rpm > 150': must be a function"):
        bench.run_until("speed_rpm > 150", timeout=0.1)


def test_commands_are_sent_cyclically_until_silence(bench):
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.2)
    times_ns = [t for t, m in bench.log if m.arbitration_id == 0x080]
    assert len(times_ns) == 20
    # A frame waits for the one on the bus and then takes its transmission time: at most 135 bits each.
    assert all(0 < t - 10_000_000 * i < 270_000 for i, t in enumerate(times_ns))
    bench.drive.silence()
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.6)
    assert bench.drive.fault == "command_timeout"


def test_signals_have_units_times_and_names(bench):
    bench.run_for(0.0205)
    speed = bench.truth["speed_rpm"]
    assert (speed.name, speed.unit) == ("speed_rpm", "r/min")
    assert np.array_equal(speed.time_s, np.arange(1, 21) / 1e3)
    assert len(speed.between(0.005, 0.010)) == 5
    assert bench.telemetry["DRIVE_STATUS.state"].last_name == bench.drive.state == "ready"
    assert bench.telemetry["bus_voltage_V"].last == pytest.approx(240, abs=0.5)
    with pytest.raises(KeyError, match="no signal 'speed'; the nearest of .* are .*speed_rpm"):
        bench.telemetry["speed"]
    none = bench.telemetry["DRIVE_FAULT_CAUSE.fault"]
    assert (len(none), np.isnan(none.last), none.last_name) == (0, True, "unknown")


def test_signals_agree_with_cantools(bench):
    """Vectorised decoding equals frame-by-frame decoding by cantools."""
    bench.drive.speed_reference_rpm = 150
    bench.load_torque_Nm = -3  # negative values are covered
    bench.run_for(0.05)
    for table, database in ((bench.telemetry, drive_database()), (bench.truth, rig_database())):
        for message in database.messages:
            if f"{message.name}.{message.signals[0].name}" not in table:
                continue
            frames = [m for _, m in bench.log
                      if m.arbitration_id == message.frame_id and m.is_extended_id == message.is_extended_frame]
            for signal in message.signals:
                decoded = [message.decode(bytes(m.data), decode_choices=False) for m in frames]
                expected = [signals[signal.name] for signals in decoded if signal.name in signals]
                assert table[f"{message.name}.{signal.name}"].value == pytest.approx(expected), signal.name


def test_invalid_values_are_rejected(bench):
    bench.run_for(0.01)
    with pytest.raises(RigError, match="load_torque_Nm 50000: must be -10000 to 10000 N m"):
        bench.load_torque_Nm = 50000
    with pytest.raises(RigError, match="load_torque_Nm 1 at 0.005 s: in_the_past, it is "):
        bench.at(0.005).load_torque_Nm = 1
    with pytest.raises(DriveError, match="speed_reference_rpm 5000: must be -3000 to 3000 r/min"):
        bench.drive.speed_reference_rpm = 5000
    with pytest.raises(DriveError, match="request 'fly': must be off, run, stop or clear_fault"):
        bench.drive.ask("fly")


def test_queue_of_settings_is_bounded(bench):
    for i in range(64):
        bench.at(0.1 + i * 1e-3).load_torque_Nm = 1
    with pytest.raises(RigError, match="queue_full"):
        bench.at(0.2).load_torque_Nm = 1


def test_two_benches_run_independently(make_bench):
    benches = [make_bench(controller=controller) for controller in ("traditional", "paper")]
    for bench in benches:
        bench.drive.speed_reference_rpm = 150
    for _ in range(10):
        for bench in benches:
            bench.run_for(0.005)
    assert all(bench.truth["speed_rpm"].last == pytest.approx(150, abs=4) for bench in benches)


def test_session_follows_a_free_running_drive(tmp_path):
    """A session follows the time of a free-running drive and commands it. Its commands must follow each other within 50
    ms of virtual time."""
    can_bus = f"unix:{tmp_path}/can.sock"
    with EmulatorProcess(BenchConfig(pace="x2"), can_bus), Session(can_bus, lockstep=False) as session:
        session.drive.speed_reference_rpm = 150
        session.run_until(lambda: abs(session.telemetry["speed_rpm"].last - 150) < 5, timeout=5)
        assert session.drive.state == "run"


def stop_until_checked(process: EmulatorProcess, checks: int) -> Callable[[], bool]:
    """Stops a process as a debugger does; it continues after the given number of liveness checks by a session."""
    os.kill(process.pid, SIGSTOP)
    remaining = iter(range(checks))

    def is_alive() -> bool:
        if next(remaining, None) is None:
            os.kill(process.pid, SIGCONT)
        return process.is_alive

    return is_alive


def test_session_waits_for_an_emulator_at_a_breakpoint(bench, monkeypatch):
    monkeypatch.setattr(session_module, "_ALIVE_CHECK_S", 0.01)
    monkeypatch.setattr(bench, "_is_alive", stop_until_checked(bench.simulator, checks=10))
    bench.run_for(0.01)
    assert bench.time_ns == 10_000_000


def test_session_fails_when_the_emulator_is_killed(make_bench, monkeypatch):
    monkeypatch.setattr(session_module, "_ALIVE_CHECK_S", 0.01)
    bench = make_bench()
    process = bench.simulator

    def kill_and_check() -> bool:
        os.kill(process.pid, SIGKILL)
        return process.is_alive

    os.kill(process.pid, SIGSTOP)
    monkeypatch.setattr(bench, "_is_alive", kill_and_check)
    with pytest.raises((SessionError, can.CanError), match="has ended"):
        bench.run_for(0.01)
    with pytest.raises(EmulatorError, match="ended with -9"):
        bench.close()
    process._process.returncode = 0  # the fixture closes it again


@pytest.mark.in_turns
def test_failure_leaves_log_plot_seed_and_replay_command(tmp_path):
    (tmp_path / "test_failing.py").write_text(FAILING_TEST)
    failures = tmp_path / "failures"
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--salient-failures", failures,
         tmp_path / "test_failing.py"],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert result.returncode == 1
    (folder,) = (path.parent for path in failures.rglob("bench.json"))
    assert f"): {folder}" in result.stdout
    assert "test_failing.py::test_that_fails" in result.stdout
    notes = json.loads((folder / "bench.json").read_text())
    assert notes["seed"] == 77
    assert "--seed 77" in notes["simulator"]
    assert notes["virtual_time_s"] == pytest.approx(0.06)
    assert "-m pytest" in notes["replay"]
    assert (folder / "failure.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "failure.html").read_text()
    assert f"tools/salient view --replay {folder}" in page and "test_failing.py::test_that_fails" in page
    with can.LogReader(folder / "can.blf") as log:
        assert len(list(log)) == len((folder / "can.log").read_text().splitlines()) > 300


def test_markers_select_by_transport(tmp_path):
    (tmp_path / "test_some.py").write_text(
        "import pytest\n"
        "@pytest.mark.both_transports\ndef test_both(): pass\n"
        "@pytest.mark.socketcan\ndef test_interface(): pass\n"
        "def test_local(): pass\n"
    )
    everywhere = {"test_both", "test_local"}
    for can_bus, names in (("local", everywhere), ("socketcan:x", everywhere | {"test_interface"})):
        result = subprocess.run(
            [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", f"--salient-can={can_bus}", tmp_path],
            capture_output=True, text=True, cwd=tmp_path,
        )  # fmt: skip
        assert {line.split("::")[1].split()[0] for line in result.stdout.splitlines() if "PASSED" in line} == names


def test_invalid_transport_is_rejected(tmp_path):
    result = subprocess.run([sys.executable, "-m", "pytest", "--salient-can=vcan0", tmp_path], capture_output=True,
                            text=True, cwd=Path(tmp_path))
    assert result.returncode == 4
    assert "--salient-can vcan0: must be local, unix:PATH or socketcan:INTERFACE" in result.stderr


@pytest.mark.parametrize(("name", "nearest"), [
    ("phase_a_open", ""), ("load_torqe_Nm", "load_torque_Nm, "), ("load_torque", "load_torque_Nm, "),
    ("Load_torque_Nm", "load_torque_Nm, "), ("_load_torque_Nm", "load_torque_Nm, "),
])  # fmt: skip
def test_unknown_bench_variable_is_rejected_with_the_nearest_names(bench, name, nearest):
    for rig in (bench.rig, bench.at(0.1)):
        with pytest.raises(AttributeError, match=f"no attribute '{name}'; the nearest of .* are {nearest}"):
            setattr(rig, name, 8)
        with pytest.raises(AttributeError, match=f"no attribute '{name}'"):
            getattr(rig, name)


def test_misspelt_attribute_is_rejected_with_the_valid_names(bench):
    with pytest.raises(AttributeError, match="no attribute 'load_torque'; the nearest of .* are load_torque_Nm, "):
        bench.load_torque = 8
    with pytest.raises(AttributeError, match="no attribute 'speed_rpm'; the nearest of .* are .*speed_reference_rpm"):
        bench.drive.speed_rpm = 600
    with pytest.raises(AttributeError, match="no attribute 'stop'"):
        bench.drive.stop = True  # a method
    with pytest.raises(AttributeError, match="no attribute 'telemetri'; the nearest of .* are telemetry, "):
        _ = bench.telemetri
    with pytest.raises(AttributeError, match="no attribute 'lowest_speed'; the nearest of .* are lowest_speed_rpm, "):
        _ = bench.drive.lowest_speed


def test_error_within_a_property_is_its_own(bench, monkeypatch):
    monkeypatch.setattr(type(bench), "time_s", property(lambda self: self.time_ns.missing))
    with pytest.raises(AttributeError, match="'int' object has no attribute 'missing'"):
        _ = bench.time_s


def test_misspelt_signal_names_the_nearest(bench):
    for name, nearest in (("sped_rpm", "speed_rpm"), ("RIG_TRUTH_MOTION.torqe_Nm", "RIG_TRUTH_MOTION.torque_Nm")):
        with pytest.raises(KeyError) as caught:
            bench.truth[name]
        assert f"no signal '{name}'; " in str(caught.value) and nearest in str(caught.value)
        assert len(str(caught.value)) < 160
    with pytest.raises(KeyError, match="no signal 'bus_voltage'; the nearest of .* are bus_voltage_V, "):
        bench.telemetry["bus_voltage"]
    with pytest.raises(KeyError, match="no message 'DRIVE_STATE'; the nearest of .*DRIVE_STATUS"):
        bench.telemetry.count("DRIVE_STATE")


def test_misspelt_option_names_the_nearest(make_bench):
    with pytest.raises(UsageError, match="bench option 'contlr': no such option; .* are controller, "):
        make_bench(contlr="paper")


def test_bench_variables_are_those_of_the_database(bench):
    """Every variable has a description and a range, and starts from its initial value or from the machine file."""
    variables = bench_variables()
    assert set(variables) <= set(dir(bench.rig))
    assert all(signal.comment and signal.minimum < signal.maximum for signal in variables.values())
    assert bench.rig.encoder_fault == 0
    assert bench.rig.truth_period_us == 1000
    assert bench.rig.inertia_gain == 1.0
    with pytest.raises(AttributeError, match="machine file"):
        bench.rig.supply_voltage_V  # noqa: B018
    bench.rig.supply_voltage_V = 200
    assert bench.rig.supply_voltage_V == 200
    for name, signal in variables.items():
        setattr(bench.rig, name, signal.minimum)
        assert name in bench.rig.describe()


def test_every_message_and_signal_of_the_bench_has_a_comment():
    for message in rig_database().messages:
        assert message.comment, message.name
        assert [signal.name for signal in message.signals if not signal.comment] == []
