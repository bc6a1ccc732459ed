"""Failed tests of somebody else's suite: each report begins with the last stimulus before the failure."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pytest
from matplotlib.image import imread

from salient.bench.arming import arm_frame
from salient.bench.drive import command_frame
from salient.bench.failure import plot_moment
from salient.bench.stimulus import Stimulus, last_before, stimuli, stimuli_of
from salient.bus.signals import drive_database

pytestmark = pytest.mark.in_turns

STIMULI = {
    "speed": ("bench.drive.speed_reference_rpm = 430", "run in speed mode, speed_reference_rpm = 430 r/min"),
    "reversal": ("bench.drive.speed_reference_rpm = -250", "run in speed mode, speed_reference_rpm = -250 r/min"),
    "torque_mode": ("bench.drive.torque_reference_Nm = 2.5", "run in torque mode, torque_reference_Nm = 2.5 N m"),
    "stop": ("bench.drive.stop()", "request stop"),
    "off": ("bench.drive.off()", "request off"),
    "clear_fault": ("bench.drive.clear_fault()", "request clear_fault"),
    "load": ("bench.load_torque_Nm = 3.25", "load_torque_Nm = 3.25 N m"),
    "coarse_load": ("bench.load_torque_Nm = -400", "load_torque_Nm = -400 N m"),
    "variable": ("bench.rig.supply_voltage_V = 170", "supply_voltage_V = 170 V"),
    "named_variable": ("bench.rig.sto_1 = 1", "sto_1 = torque_off"),
    "free": ("bench.held_speed_rpm = float('nan')", "held_speed_rpm = free"),
    "profile": ("bench.rig.set_load_profile([0.5, 1, 0.5, 0])", "load profile of 4 values"),
    "fault": ('bench.fault("winding_open", phase="b")', "fault winding_open begins, phase b"),
    "fault_of_a_leg": ('bench.fault("switch_open", phase="a", leg="low")',
                       "fault switch_open begins, phase a, leg low"),
    "fault_with_a_value": ('bench.fault("current_sensor_gain", phase="c", gain=0.3)',
                           "fault current_sensor_gain begins, phase c, gain 0.3"),
    "fault_ends": ('bench.clear_fault("winding_open", phase="a")', "fault winding_open ends, phase a"),
    "parameter": ('bench.drive.parameters["speed_kp"] = 7', "parameters set: speed_kp = 7 N m s"),
    "frame": ('bench.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\\1\\2"))',
              "frame 123: 01 02"),
    "short_frame": ('bench.send(can.Message(arbitration_id=128, is_extended_id=False, data=b"\\1\\2"))',
                    "DRIVE_COMMAND, wrong length or format: frame 080: 01 02"),
    "wrong_checksum": ('bench.send(can.Message(arbitration_id=128, is_extended_id=False, data=bytes(7)))',
                       "DRIVE_COMMAND, wrong checksum: frame 080: 00 00 00 00 00 00 00"),
}
"""Last statement of a test -> its text in the report."""
OTHERS = '''
def test_scheduled(bench):
    running(bench)
    bench.at(0.055).load_torque_Nm = 4
    bench.at(0.07).fault("encoder_stuck", duration_s=0.5)
    bench.run_for(0.02)
    assert bench.time_s < 0

def test_silence(bench):
    running(bench)
    bench.drive.silence()
    bench.run_for(0.1)
    assert bench.time_s < 0

def test_refused(bench):
    running(bench)
    bench.fault("current_sensor_gain", phase="d", gain=0.3)

def test_tripped(bench):
    running(bench)
    bench.fault("encoder_stuck")
    bench.run_for(0.05)
    bench.load_torque_Nm = 4
    bench.run_for(0.05)
    assert bench.time_s < 0

def test_not_ready(bench):
    bench.rig.sto_1 = 1
    bench.drive.speed_reference_rpm = 400
    bench.run_for(0.1)
    assert bench.time_s < 0

def test_short_fault(bench):
    running(bench)
    bench.fault("supply_sagged", duration_s=0.01, depth_percent=30)
    bench.run_for(0.02)
    assert bench.time_s < 0

def test_nothing(bench):
    bench.run_for(0.05)
    assert bench.time_s < 0

@pytest.mark.bench_options(drives=2)
def test_two_drives(bench):
    running(bench)
    bench.drives[1].speed_reference_rpm = 300
    bench.run_for(0.05)
    assert bench.time_s < 0
'''
SUITE = '''
import can, pytest

def running(bench):
    bench.drive.speed_reference_rpm = 400
    bench.run_for(0.05)
''' + "".join(f'''
def test_{name}(bench):
    running(bench)
    {statement}
    bench.run_for(0.006)
    assert bench.time_s < 0
''' for name, (statement, _) in STIMULI.items()) + OTHERS


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[str]]]:
    """The folder, and the report of each test."""
    root = tmp_path_factory.mktemp("suite")
    (root / "pytest.ini").write_text("[pytest]\n")
    (root / "test_stimuli.py").write_text(SUITE)
    run = subprocess.run([sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "no:cacheprovider"], cwd=root,
                         capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stdout + run.stderr
    reports = {}
    for part in re.split(r"^_+ (?=test_\w+ _+$)", run.stdout, flags=re.MULTILINE)[1:]:
        name, _, text = part.partition(" ")
        report = re.split(r"^-+ salient bench -+$", text, flags=re.MULTILINE)[1]
        reports[name.removeprefix("test_")] = report.strip().splitlines()
    return root, reports


def notes(root: Path, name: str) -> dict:
    folder = root / "build" / "failures" / f"test_stimuli.py_test_{name}" / "0"
    return json.loads((folder / "bench.json").read_text())


def test_every_test_has_failed_and_has_its_report(suite):
    assert len(suite[1]) == len(STIMULI) + OTHERS.count("def test_")


@pytest.mark.parametrize("name", STIMULI)
def test_the_last_stimulus_is_in_the_first_three_lines(suite, name):
    root, reports = suite
    report = reports[name]
    text = STIMULI[name][1]
    head = [line for line in report[:3] if text in line and line.startswith("last stimulus: ")]
    assert len(head) == 1, report
    of_file = [stimulus for stimulus in notes(root, name)["stimuli"] if stimulus["text"] == text]
    assert len(of_file) == 1
    assert of_file[0]["time_s"] == pytest.approx(0.05, abs=0.03 if name == "parameter" else 1e-9)
    assert notes(root, name)["last_stimulus"] == head[0].removeprefix("last stimulus: ")


@pytest.mark.parametrize("name", STIMULI)
def test_everything_stands_in_its_order_in_report_and_page(suite, name):
    root, reports = suite
    found = [f"{each['time_s']:.6f} s {each['text']}" for each in notes(root, name)["stimuli"]]
    first = reports[name].index("everything that was done:") + 1
    assert reports[name][first:first + len(found)] == [f"    {line}" for line in found]
    assert found[0] == "0.000000 s run in speed mode, speed_reference_rpm = 400 r/min"
    expected = [STIMULI[name][1]]
    if name == "clear_fault":
        expected.insert(0, "request off")
    assert [line.partition(" s ")[2] for line in found[1:]] == expected
    page = (root / "build" / "failures" / f"test_stimuli.py_test_{name}" / "0" / "failure.html").read_text()
    assert page.index(found[-1]) < page.index("The error")


def test_a_scheduled_act_is_at_its_time_and_one_to_come_is_not_the_last(suite):
    root, reports = suite
    assert [(round(each["time_s"], 6), each["text"]) for each in notes(root, "scheduled")["stimuli"][1:]] == [
        (0.055, "load_torque_Nm = 4 N m (scheduled at 0.050000 s)"),
        (0.07, "fault encoder_stuck begins (scheduled at 0.050000 s)"),
        (0.57, "fault encoder_stuck ends (scheduled at 0.050000 s) (not yet)")]
    assert "0.070000 s fault encoder_stuck begins" in reports["scheduled"][0]
    assert "before it 0.055000 s load_torque_Nm = 4 N m" in reports["scheduled"][0]


def test_commands_that_cease_are_a_stimulus(suite):
    assert "no more commands, the last one at 0.0" in suite[1]["silence"][0]


def test_a_refused_fault_is_named_with_the_reason(suite):
    assert "fault current_sensor_gain begins, phase d, gain 0.3 (refused: " in suite[1]["refused"][0]


def test_a_trip_is_named_with_the_stimulus_before_it_although_others_came_later(suite):
    head = suite[1]["tripped"][1]
    assert "load_torque_Nm = 4 N m" in suite[1]["tripped"][0]
    found = re.fullmatch(r"the drive: tripped: encoder, reported at 0\.(\d+) s, (\d+\.\d+) ms after fault encoder_stuck"
                         r" begins", head)
    assert found is not None, head
    assert 0.05 < float(f"0.{found[1]}") == pytest.approx(0.05 + float(found[2]) / 1e3, abs=2e-6)
    assert notes(suite[0], "tripped")["drive"] == head.removeprefix("the drive: ")


def test_a_drive_that_is_not_ready_is_named_with_its_check(suite):
    assert suite[1]["not_ready"][1] == "the drive: not ready: its check sto fails"


def test_the_end_of_a_fault_is_named_with_its_beginning(suite):
    head = suite[1]["short_fault"][0]
    assert "0.060000 s fault supply_sagged ends" in head
    assert "; it began at 0.050000 s" in head


def test_a_drive_that_runs_has_no_line_of_its_own(suite):
    assert not [line for line in suite[1]["load"] if line.startswith("the drive")]


def test_nothing_done_is_said(suite):
    assert suite[1]["nothing"][0] == "last stimulus: none"


def test_drives_are_told_apart_by_their_nodes(suite):
    lines = [line.strip() for line in suite[1]["two_drives"]]
    assert "0.000000 s node 0: run in speed mode, speed_reference_rpm = 400 r/min" in lines
    assert "node 1: run in speed mode, speed_reference_rpm = 300 r/min" in lines[0]


def test_repeated_commands_are_one_stimulus_and_a_command_that_was_not_sent_yet_is_another(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.2)
    bench.drive.speed_reference_rpm = 350
    assert [str(stimulus) for stimulus in stimuli_of(bench)] == [
        "0.000000 s run in speed mode, speed_reference_rpm = 300 r/min",
        "0.200000 s run in speed mode, speed_reference_rpm = 350 r/min"]
    from_log = stimuli(bench.log, bench.time_ns, bench.machine, bench.nodes)
    assert [stimulus.text for stimulus in from_log] == ["run in speed mode, speed_reference_rpm = 300 r/min"]
    assert from_log[0].time_s == pytest.approx(0.0, abs=1e-3)


def test_acts_of_another_client_are_in_the_list():
    message = drive_database().get_message_by_name("DRIVE_COMMAND")
    frames = [(1_000_000 * ms, command_frame(ms, "run", 120.0 if ms < 40 else -60.0, message))
              for ms in range(0, 80, 10)]
    found = stimuli(frames, 80_000_000, None, (0,))
    assert [(stimulus.time_s, stimulus.text.partition(" = ")[2]) for stimulus in found] == [
        (0.0, "120 r/min"), (0.04, "-60 r/min")]
    assert last_before(found, 0.039) is found[0] and last_before(found, -1.0) is None


@pytest.mark.parametrize(("arms_ns", "is_shown"), [(-1, False), (0, False), (1_000_000, False), (500_000_000, True)])
def test_arming_is_a_stimulus_only_without_a_request_to_run(arms_ns, is_shown):
    run_ns = 10_000_000
    frames = [(run_ns + step_ns, command_frame(number % 256, "run", 120.0))
              for number, step_ns in enumerate(range(0, 600_000_000, 10_000_000))]
    frames = sorted([*frames, (run_ns + arms_ns, arm_frame(0, "request_run"))], key=lambda timed: timed[0])
    texts = [stimulus.text for stimulus in stimuli(frames, frames[-1][0], None, (0,))]
    assert texts == ["run in speed mode, speed_reference_rpm = 120 r/min", *["arming: request_run"] * is_shown]


def test_a_frame_of_unknown_content_ends_no_report():
    frames = [(0, can.Message(arbitration_id=identifier & 0x1FFFFFFF, is_extended_id=extended, data=bytes([255] * 8)))
              for identifier, extended in ((2667577347, True), (2667577351, True), (1536, False), (132, False))]
    texts = [stimulus.text for stimulus in stimuli(frames, 1, "saturating", (0,))]
    assert len(texts) >= 3 and all("FF FF" in text.upper() for text in texts)


def green_pixels(path: Path) -> int:
    """Pixels in the colour that only marks of stimuli have, which a thin line mixes with white."""
    red, green, blue = np.moveaxis(imread(path)[:, :, :3], 2, 0)
    return int(np.count_nonzero((green > red + 0.15) & (green > blue + 0.03)))


def test_a_plot_marks_each_stimulus_in_its_window_and_the_one_before(tmp_path, bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    found = {}
    for name, times_s in (("none", ()), ("one", (0.07,)), ("two", (0.07, 0.08)), ("before", (0.02,)),
                          ("later", (0.2,))):
        acts = [Stimulus(time_s, "load_torque_Nm = 4 N m") for time_s in times_s]
        plot_moment(bench, bench.time_s, "failure", tmp_path / f"{name}.png", acts)
        found[name] = green_pixels(tmp_path / f"{name}.png")
    assert found["none"] == found["later"] == 0
    assert 0 < found["before"] < 100, "a mark at the edge, without a line"
    assert found["one"] > 200 and found["two"] == pytest.approx(2 * found["one"], rel=0.3), found
