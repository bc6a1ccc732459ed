"""A bus for candump: frames of the drive, and none of the test bench but replies."""

from __future__ import annotations

import json
import subprocess
import sys

import can
import pytest

from salient.bench.emulator import EmulatorProcess
from salient.bench.programs import command_line
from salient.bus.clock import RIG_CLOCK_ID, VirtualTimeReader, open_bus
from salient.bus.signals import drive_database, rig_database
from salient.config import BenchConfig
from salient.machine.cache import machine_image

ALIVE_CHECK_S = 1.0
RUN_NS = 5_000_000  # what the receive buffer of a SocketCAN client holds


def frames_of_a_run(address: str, **options) -> list[tuple[int, can.Message]]:
    """Frames of the first 5 ms, with their times, up to RIG_CLOCK."""
    config = BenchConfig(can=address, pace="lockstep", machine_image=machine_image("saturating"), **options)
    with subprocess.Popen(command_line(config), stdout=subprocess.PIPE) as process:
        try:
            assert json.loads(process.stdout.readline())["ready"]
            with open_bus(address, receive_own_messages=False) as bus:
                message = rig_database().get_message_by_name("RIG_RUN_UNTIL")
                bus.send(can.Message(arbitration_id=message.frame_id,
                                     data=message.encode({"time_ns": RUN_NS, "sequence": 7})))
                reader, frames = VirtualTimeReader(bus), []
                while not frames or frames[-1][1].arbitration_id != RIG_CLOCK_ID:
                    frame = reader.receive(ALIVE_CHECK_S)
                    assert process.poll() is None
                    frames += [frame] if frame else []
                return frames
        finally:
            process.terminate()


@pytest.mark.both_transports
def test_bus_of_the_drive_only_has_no_frame_of_the_bench_but_replies(request, tmp_path):
    interface = request.config.getoption("--salient-can")
    address = f"unix:{tmp_path}/bus" if interface == "local" else interface
    frames = frames_of_a_run(address, drive_only=True)
    of_drive = {message.frame_id for message in drive_database().messages}
    assert {message.arbitration_id for _, message in frames[:-1]} <= of_drive
    assert not any(message.is_extended_id for _, message in frames[:-1])
    times_ns = [time_ns for time_ns, _ in frames[:-1]]
    assert times_ns == sorted(times_ns)
    everything = frames_of_a_run(address)
    drives = [message for _, message in everything if not message.is_extended_id]
    assert len(everything) > len(drives) + 10  # shows that the bench sends otherwise
    # On SocketCAN the reader needs the first frame to find that there are no stamps.
    missing = 0 if interface == "local" else 1
    assert [bytes(message.data) for _, message in frames[:-1]] == [bytes(message.data) for message in drives[missing:]]


SUITE = """
def test_of_any_drive(bench):
    bench.drive.speed_reference_rpm = 150
    # The client's time, which is not the drive's: as long as a slow computer may need.
    bench.run_until(lambda: abs(bench.telemetry["speed_rpm"].last - 150) < 5, timeout=600)
    bench.drive.stop()

def test_of_the_bench(bench):
    bench.load_torque_Nm = 3
"""


@pytest.mark.in_turns
@pytest.mark.both_transports
def test_suite_on_the_bus_of_a_drive_alone_skips_what_needs_the_bench(request, tmp_path):
    interface = request.config.getoption("--salient-can")
    address = f"unix:{tmp_path}/bus" if interface == "local" else interface
    (tmp_path / "test_some.py").write_text(SUITE)
    # A hundredth of real time: the time-out of commands, 50 ms of the drive, is 5 s of a slow computer.
    with EmulatorProcess(BenchConfig(pace="x0.01", drive_only=True), address):
        done = subprocess.run([sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider",
                               f"--salient-can={address}", "."], cwd=tmp_path, capture_output=True, text=True)
    assert "1 passed, 1 skipped" in done.stdout, done.stdout + done.stderr
    assert f"needs the test bench (bench.load_torque_Nm), and on {address} there is a drive alone" in done.stdout
