"""A speed reference beyond the range of the drive: the client refuses it, the firmware limits it and says so."""

from pathlib import Path

import pytest

from salient.bench.drive import DriveError
from salient.bus import e2e
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.machine.scaling import scaling_of

DIRECTIONS = [("traditional", 1), ("paper", 1), ("salient", 1), ("salient", -1)]
FRAME_MAX_RPM = 3000.0
"""Largest speed of a frame that every drive takes."""


@pytest.fixture
def slow(tmp_path):
    """The saturating machine for a highest speed of 900 r/min; its over_speed_rpm is 1.2 times that."""
    text = machine_path("saturating").read_text(encoding="utf-8").replace('"saturating"', '"slow"', 1)
    path = tmp_path / "slow.toml"
    path.write_text(text.replace("speed_base_rpm = 1500.0", "speed_base_rpm = 450.0\nspeed_max_rpm = 900.0"),
                    encoding="utf-8")
    return str(path)


def command_by_frames(bench, speed_rpm, duration_s):
    """Commands a speed that the client refuses in frames that continue its own, as another host would."""
    command = bench.drive_database.get_message_by_name("DRIVE_COMMAND")
    lsb_rpm = command.get_signal_by_name("speed_reference_rpm").scale
    drive = bench.drive
    drive.silence()
    payload = b"\1" + round(speed_rpm / float(lsb_rpm)).to_bytes(3, "little", signed=True)
    frame = e2e.protected_frame(command, 0, {"request": 1, "speed_reference_rpm": 0.0})
    for _ in range(round(duration_s / 0.01)):
        frame.data = bytearray(e2e.protect(e2e.data_id(command), drive._counter, payload))
        drive._counter = (drive._counter + 1) % 256
        bench.send(frame)
        bench.run_for(0.01)


def is_limited(bench):
    return bench.telemetry["DRIVE_STATUS.speed_limited"].last == 1


@pytest.mark.in_turns
@pytest.mark.parametrize(("controller", "sign"), DIRECTIONS)
def test_a_command_beyond_the_highest_speed_is_limited_to_it_and_reported(make_bench, slow, controller, sign):
    bench = make_bench(machine=slow, controller=controller)
    bench.drive.speed_reference_rpm = sign * 890.0
    bench.run_for(0.1)
    assert bench.drive.state == "run" and not is_limited(bench)
    command_by_frames(bench, sign * FRAME_MAX_RPM, 0.5)
    assert bench.drive.state == "run", bench.drive.fault
    assert is_limited(bench)
    assert bench.telemetry["DRIVE_MOTION.speed_reference_rpm"].last == pytest.approx(sign * 900.0, abs=0.002)
    assert bench.truth["speed_rpm"].last == pytest.approx(sign * 900.0, abs=3.0)
    bench.drive.speed_reference_rpm = sign * 900.0
    bench.run_for(0.1)
    assert bench.drive.state == "run" and not is_limited(bench), "the largest command of the database is in range"


@pytest.mark.parametrize(("controller", "sign"), DIRECTIONS)
def test_over_speed_that_is_lowered_limits_the_reference_to_seven_eighths(make_bench, controller, sign):
    bench = make_bench(controller=controller)
    bench.drive.parameters["over_speed_rpm"] = 400
    bench.drive.speed_reference_rpm = sign * 340.0
    bench.run_for(0.2)
    assert bench.drive.state == "run" and not is_limited(bench)
    bench.drive.speed_reference_rpm = sign * 600.0
    bench.run_for(0.2)
    assert bench.drive.state == "run", bench.drive.fault
    assert is_limited(bench)
    assert bench.truth["speed_rpm"].last == pytest.approx(sign * 350.0, abs=2.0)
    bench.drive.speed_reference_rpm = sign * 300.0
    bench.run_for(0.3)
    assert not is_limited(bench)


def test_a_ramp_ends_at_the_limit(make_bench, slow):
    bench = make_bench(machine=slow)
    bench.drive.parameters["speed_ramp_rpm_s"] = 3000
    bench.drive.speed_reference_rpm = 100.0
    bench.run_for(0.1)
    command_by_frames(bench, FRAME_MAX_RPM, 0.2)
    assert bench.telemetry["DRIVE_MOTION.speed_reference_rpm"].last == pytest.approx(700.0, abs=40.0)
    command_by_frames(bench, FRAME_MAX_RPM, 0.3)
    assert bench.telemetry["DRIVE_MOTION.speed_reference_rpm"].last == pytest.approx(900.0, abs=0.002)
    assert bench.drive.state == "run" and is_limited(bench)
    bench.drive.stop()
    bench.run_for(0.01)
    assert not is_limited(bench), "stop has no reference"


@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_a_negative_reference_of_a_controller_that_drives_forward_only_is_reported(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.drive.speed_reference_rpm = -100.0
    bench.run_for(0.05)
    assert bench.drive.state == "run" and is_limited(bench)
    assert bench.telemetry["DRIVE_MOTION.speed_reference_rpm"].last == 0.0
    bench.drive.torque_reference_Nm = 1.0
    bench.run_for(0.02)
    assert not is_limited(bench), "torque mode has no speed reference"


def test_client_refuses_a_speed_beyond_the_range_in_one_line_that_names_it(make_bench, slow):
    bench = make_bench(machine=slow)
    for speed_rpm in (900.01, -900.01, FRAME_MAX_RPM):
        with pytest.raises(DriveError, match=f"^speed_reference_rpm {speed_rpm:g}: must be -900 to 900 r/min$"):
            bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.02)
    assert bench.drive.state != "run"


@pytest.mark.in_turns
@pytest.mark.parametrize("over_speed_rpm", [1080.0, 1000.0, 910.0])
def test_range_of_the_database_is_what_the_drive_follows_with_the_parameters_of_the_file(make_bench, slow,
                                                                                         over_speed_rpm):
    path = Path(slow)
    path.write_text(f"{path.read_text(encoding='utf-8')}over_speed_rpm = {over_speed_rpm}\n", encoding="utf-8")
    scaling = scaling_of(slow, load_machine(slow))
    assert scaling.speed_range_rpm == pytest.approx(min(900.0, 7.0 / 8.0 * over_speed_rpm), abs=0.001)
    bench = make_bench(machine=slow)
    bench.drive.speed_reference_rpm = -scaling.speed_range_rpm
    bench.run_for(0.3)
    assert bench.drive.state == "run" and not is_limited(bench)
    assert bench.truth["speed_rpm"].last == pytest.approx(-scaling.speed_range_rpm, abs=2.0)
