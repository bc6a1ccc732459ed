"""tools/examples/run_600_rpm.c and .py on a real SocketCAN interface: nothing of this project in the sender."""

from __future__ import annotations

import subprocess
import sys

import pytest

from salient.bench.emulator import EmulatorProcess
from salient.bus.clock import VirtualTimeReader, open_bus
from salient.bus.signals import SignalTable, drive_database
from salient.config import BenchConfig
from salient.paths import ROOT

EXAMPLES = ROOT / "tools" / "examples"


@pytest.mark.in_turns
@pytest.mark.socketcan
@pytest.mark.parametrize("language", ["c", "py"])
def test_the_example_runs_the_drive_and_stops_it(tmp_path, request, language):
    address = request.config.getoption("--salient-can")
    command = [sys.executable, EXAMPLES / "run_600_rpm.py"]
    if language == "c":
        command = [tmp_path / "run_600_rpm"]
        subprocess.run(["cc", "-o", *command, EXAMPLES / "run_600_rpm.c"], check=True)
    telemetry = SignalTable(drive_database(), "DRIVE")
    # A hundredth of real time: the VM is slow, and a sender that is late for 50 ms of the drive's time stops it.
    with EmulatorProcess(BenchConfig(pace="x0.01"), address), open_bus(address) as bus:
        reader = VirtualTimeReader(bus)
        example = subprocess.Popen([*command, address.partition(":")[2], "0.3"], text=True, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE)
        while example.poll() is None:
            timed = reader.receive(0.1)
            if timed is not None:
                telemetry.add(*timed)
        output, errors = example.communicate()
    assert (errors, example.returncode) == ("", 0)
    assert output.splitlines()[-1] == ("state 1" if language == "c" else "state ready")
    assert abs(telemetry["speed_rpm"].value.max() - 600.0) < 3.0
    assert telemetry["DRIVE_STATUS.state"].last_name == "ready"
    assert telemetry["DRIVE_STATUS.fault"].last_name == "none"
