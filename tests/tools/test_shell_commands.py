"""tools/salient command: a drive and its test bench from a shell."""

from __future__ import annotations

import re
import signal
import subprocess
import sys

import pytest

from salient.__main__ import main
from salient.bench.emulator import EmulatorProcess
from salient.bus.clock import VirtualTimeReader, open_bus
from salient.bus.signals import SignalTable, drive_database, rig_database
from salient.config import BenchConfig


class Shell:
    """A drive that has its own time, and commands to it."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.started: list[subprocess.Popen[str]] = []

    def start(self, *arguments: object, first_line: str | None = None) -> subprocess.Popen[str]:
        line = [sys.executable, "-u", "-m", "salient", "command", *map(str, arguments), "--can", self.address]
        process = subprocess.Popen(line, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        self.started.append(process)
        if first_line is not None:
            assert process.stdout is not None
            assert process.stdout.readline() == f"{first_line}\n", process.communicate()
        return process

    def __call__(self, *arguments: object) -> tuple[str, str, int]:
        return finish(self.start(*arguments))

    def signals(self) -> tuple[SignalTable, SignalTable]:
        """Drive and bench for 0.15 s from now."""
        drive, rig = SignalTable(drive_database(), "DRIVE"), SignalTable(rig_database(), "RIG")
        with open_bus(self.address) as bus:
            reader, end_ns, time_ns = VirtualTimeReader(bus), None, 0
            while end_ns is None or time_ns < end_ns:
                time_ns, message = reader.receive(None)
                end_ns = end_ns or time_ns + 150_000_000
                drive.add(time_ns, message)
                rig.add(time_ns, message)
        return drive, rig

    def state(self) -> tuple[str, str]:
        """State and fault of the drive."""
        drive, _ = self.signals()
        return drive["DRIVE_STATUS.state"].last_name, drive["DRIVE_STATUS.fault"].last_name


def finish(process: subprocess.Popen[str]) -> tuple[str, str, int]:
    output, errors = process.communicate(timeout=120)
    return output, errors, process.returncode


@pytest.fixture
def shell(tmp_path):
    made = Shell(f"unix:{tmp_path}/can.sock")
    # Below real time: the time-out of commands leaves a margin for a loaded computer.
    with EmulatorProcess(BenchConfig(pace="x0.3"), made.address):
        yield made
        for process in made.started:
            process.kill()
            process.communicate()


@pytest.mark.in_turns
@pytest.mark.parametrize(("arguments", "running", "speed_rpm"), [
    (("speed", "600"), "running: speed 600 r/min, for 0.5 s", 600.0),
    (("speed", "-300"), "running: speed -300 r/min, for 0.5 s", -300.0),
    (("torque", "0.5"), "running: torque 0.5 N m, for 0.5 s", None)])
def test_drive_runs_for_the_duration_and_is_stopped(shell, arguments, running, speed_rpm):
    output, errors, code = shell(*arguments, "--duration-s", "0.5")
    assert (errors, code) == ("", 0)
    first, stopping, last = output.splitlines()
    assert (first, last) == (running, "state ready")
    reached = float(re.fullmatch(r"stopping from (-?[0-9.]+) r/min", stopping)[1])
    assert reached == pytest.approx(speed_rpm, abs=1.0) if speed_rpm else reached > 20.0
    assert shell.state() == ("ready", "none")


@pytest.mark.in_turns
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_stops_the_drive(shell, number):
    process = shell.start("speed", "300", first_line="running: speed 300 r/min, until Ctrl-C")
    assert shell.state() == ("run", "none")
    process.send_signal(number)
    output, errors, code = finish(process)
    assert (errors, code) == ("", 0)
    assert output.splitlines()[0].startswith("stopping from ") and output.splitlines()[1:] == ["state ready"]
    assert shell.state() == ("ready", "none")


@pytest.mark.in_turns
def test_stop_takes_the_place_of_the_command_that_runs_the_drive(shell):
    running = shell.start("speed", "300", first_line="running: speed 300 r/min, until Ctrl-C")
    for refused in (("speed", "200"), ("torque", "1"), ("clear",), ("arm",)):
        output, errors, code = shell(*refused)
        assert (output, code) == ("", 1)
        assert errors == (f"salient: {shell.address}: another sender commands the drive; 'tools/salient command stop' "
                          "takes its place\n")
    assert shell.state() == ("run", "none")
    assert shell("load", "1") == ("load 1 N m\n", "", 0)
    assert shell("stop") == ("state ready\n", "", 0)
    assert finish(running) == ("another sender has taken the place of this command\n", "", 0)
    assert shell.state() == ("ready", "none")
    assert shell("stop") == ("the drive does not run: state ready\n", "", 0)


@pytest.mark.in_turns
def test_command_that_is_killed_leaves_a_fault_that_clear_clears(shell):
    process = shell.start("speed", "300", first_line="running: speed 300 r/min, until Ctrl-C")
    process.kill()
    output, errors, code = shell("stop")
    assert (errors, code) == ("", 0) and output.endswith("state fault\n")
    output, errors, code = shell("speed", "300")
    assert (output, code) == ("", 1)
    assert errors == ("salient: the drive is in state fault (command_timeout); 'tools/salient command clear' clears "
                      "it\n")
    assert shell("clear") == ("cleared command_timeout: state ready\n", "", 0)
    assert shell("clear") == ("no fault: state ready\n", "", 0)


def test_output_that_nobody_reads_stops_the_drive(shell):
    process = shell.start("speed", "300")
    process.stdout.close()
    assert process.wait(timeout=120) == 0
    assert shell.state() == ("ready", "none")


@pytest.mark.in_turns
def test_load_acts_on_the_shaft_and_a_bus_without_its_bench_is_named(shell):
    assert shell("load", "3") == ("load 3 N m\n", "", 0)
    _, rig = shell.signals()
    assert rig["load_torque_Nm"].last == pytest.approx(3.0, abs=0.01)
    for arguments, said in ((("load", "3"), "no test bench answers on this bus"),
                            (("speed", "300"), "no drive with node number 2 on this bus")):
        assert shell(*arguments, "--node", "2") == ("", f"salient: {shell.address}: {said}\n", 1)


def test_arm_shows_challenge_and_response(shell):
    output, errors, code = shell("arm")
    assert (errors, code) == ("", 0)
    challenge, response = (int(text, 16) for text in re.findall("0x([0-9A-F]{8})", output))
    assert challenge and challenge ^ response == 0xFFFFFFFF
    assert shell.state() == ("ready", "none")


@pytest.mark.in_turns
@pytest.mark.parametrize(("machine", "reference", "limits"), [
    ("saturating", ("speed", "9000"), "-3000 to 3000 r/min"), ("saturating", ("torque", "-200"), "-128 to 128 N m"),
    ("fan12", ("torque", "0.6"), "-0.5 to 0.5 N m"), ("traction", ("speed", "2900"), "-2852.84 to 2852.84 r/min")])
def test_reference_beyond_the_range_of_the_drive_is_refused(tmp_path, machine, reference, limits):
    shell = Shell(f"unix:{tmp_path}/can.sock")
    with EmulatorProcess(BenchConfig(pace="x0.3", machine=machine), shell.address):
        assert shell(*reference) == ("", f"salient: {' '.join(reference)}: must be {limits}\n", 2)


def test_reference_is_in_the_units_of_the_machine_that_the_drive_carries(tmp_path):
    shell = Shell(f"unix:{tmp_path}/can.sock")
    with EmulatorProcess(BenchConfig(pace="x0.3", machine="traction"), shell.address):
        output, errors, code = shell("torque", "300", "--duration-s", "0.2")
        assert (output.splitlines()[0], errors, code) == ("running: torque 300 N m, for 0.2 s", "", 0)


@pytest.mark.parametrize(("arguments", "texts"), [
    ([], ["ACTION"]),
    (["fly"], ["unknown action 'fly'", "speed, torque, position, load, stop, clear, arm"]),
    (["speed"], ["RPM"]),
    (["speed", "fast"], ["fast", "number"]),
    (["speed", "nan"], ["nan", "number"]),
    (["torque", "inf"], ["inf", "number"]),
    (["load", "three"], ["three", "number"]),
    (["stop", "now"], ["now"]),
    (["stop", "--duration-s", "1"], ["--duration-s"]),
    (["speed", "300", "--duration-s", "0"], ["--duration-s 0"]),
    (["speed", "300", "--node", "8"], ["--node 8"]),
    (["speed", "300", "--machine", "nonesuch"], ["nonesuch", "no bundled machine of that name; the nearest of "]),
    (["speed", "300", "--can", "vcan0"], ["--can vcan0", "unix:PATH or socketcan:INTERFACE"]),
    (["arm", "--can", "unix:/no/such/bus"], ["unix:/no/such/bus", "no drive answers there"])])
def test_mistake_is_one_line_and_exit_code_2(monkeypatch, capsys, arguments, texts):
    monkeypatch.setattr(sys, "argv", ["salient", "command", *arguments])
    try:
        code = main()
    except SystemExit as end:
        code = end.code
    output, errors = capsys.readouterr()
    assert (code, output, len(errors.splitlines())) == (2, "", 1), errors
    assert all(text in errors for text in texts), errors
