"""tools/examples: each script waits for the drive, does what its docstring describes, and ends without warnings."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

from salient.bench.emulator import EmulatorProcess
from salient.bus.clock import open_bus
from salient.bus.signals import SignalTable, drive_database
from salient.config import BenchConfig
from salient.paths import ROOT

EXAMPLES = ROOT / "tools" / "examples"


def start(script, *arguments):
    return subprocess.Popen([sys.executable, "-W", "error", str(EXAMPLES / script), *arguments], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.fixture
def channel(tmp_path):
    return f"unix:{tmp_path}/can.sock"


def test_read_telemetry_waits_for_the_drive_and_prints_decoded_frames(channel):
    example = start("read_telemetry.py", channel)
    with EmulatorProcess(BenchConfig(pace="realtime"), channel):
        output, errors = example.communicate()
    assert (errors, example.returncode) == ("", 0)
    lines = output.splitlines()
    assert len(lines) == 20
    assert any(" DRIVE_MOTION {'speed_rpm': 0.0" in line for line in lines)


def test_run_600_rpm_runs_the_drive_and_switches_it_off(channel):
    telemetry = SignalTable(drive_database(), "DRIVE")
    # One tenth of real time: the time-out of commands leaves a wide margin for a loaded computer.
    with EmulatorProcess(BenchConfig(pace="x0.1"), channel):
        example = start("run_600_rpm.py", channel, "0.3")
        output, errors = example.communicate()
        with open_bus(channel) as bus:
            while telemetry.count("DRIVE_STATUS") < 20:
                message = bus.recv()
                telemetry.add(message.time_ns, message)
    assert (errors, example.returncode) == ("", 0)
    assert output.splitlines()[-2].endswith(" 600.0 r/min") and output.splitlines()[-1] == "state ready"
    assert telemetry["DRIVE_STATUS.state"].last_name == "ready"
    assert telemetry["DRIVE_STATUS.fault"].last_name == "none"


@pytest.mark.parametrize("script", ["read_telemetry.py", "run_600_rpm.py"])
def test_end_of_the_drive_is_reported_in_one_line(channel, script):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(channel.removeprefix("unix:"))
        server.listen()
        example = start(script, channel)
        for _ in range(2):  # the readiness check, then the script's own connection
            server.accept()[0].close()
    output, errors = example.communicate()
    assert (output, errors, example.returncode) == ("", f"{channel}: the drive has ended\n", 1)
