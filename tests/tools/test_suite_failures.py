"""Remains of failed tests in somebody else's suite, and the command that runs them again."""

from __future__ import annotations

import html
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import can
import numpy as np
import pytest

from salient.bench.failure import LEFT, changes, save
from salient.experiments.compare.every_machine import EXAMPLES

pytestmark = pytest.mark.in_turns

SUITE = '''
import os, signal
import pytest

@pytest.fixture
def running(bench):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.06)
    raise RuntimeError("the set-up is wrong")

def test_setup(running):
    pass

@pytest.mark.bench_options(seed=77)
def test_call(bench):
    bench.drive.speed_reference_rpm = 300
    bench.at(0.055).load_torque_Nm = 4
    bench.run_for(0.06)
    assert bench.truth["speed_rpm"].last > 1e6

@pytest.fixture
def stopped(bench):
    yield bench
    bench.drive.stop()
    bench.run_for(0.01)
    assert bench.drive.state == "somewhere"

def test_teardown(stopped):
    stopped.run_for(0.06)

def test_killed(bench):
    bench.run_for(0.06)
    os.kill(bench.simulator.pid, signal.SIGKILL)
    bench.run_for(0.06)

@pytest.mark.bench_each(machine=["linear_cosine"], controller=["paper"])
def test_timeout(bench):
    assert bench.options.machine == "linear_cosine"
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.03)
    bench.fault("encoder_stuck")
    bench.run_until(lambda: bench.drive.state == "never", timeout=0.06)
'''
KINDS = {
    "test_setup": ("setup", "the set-up is wrong"),
    "test_call": ("call", "assert "),
    "test_teardown": ("teardown", "AssertionError: assert "),
    "test_killed": ("call", "has ended"),
    "test_timeout[linear_cosine-paper]": ("call", "condition not met within 0.06 s"),
}


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suite of its own, run by two processes, with the report that CI systems read."""
    root = tmp_path_factory.mktemp("suite")
    (root / "pytest.ini").write_text("[pytest]\n")
    (root / "tests").mkdir()
    (root / "tests" / "test_kinds.py").write_text(SUITE)
    run = subprocess.run([sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "no:cacheprovider",
                          "--junitxml=report.xml"], cwd=root, capture_output=True, text=True)
    assert run.returncode == 1, run.stdout
    (root / "output").write_text(run.stdout)
    return root


def properties(suite: Path) -> dict[str, dict[str, str]]:
    """Properties of the failed cases of the report."""
    cases = ElementTree.parse(suite / "report.xml").getroot().iter("testcase")
    return {case.get("name"): {p.get("name"): p.get("value") for p in case.iter("property")} for case in cases
            if case.find("failure") is not None or case.find("error") is not None}


def test_report_has_folder_seed_and_replay_of_every_failure(suite):
    found = properties(suite)
    assert set(found) == set(KINDS)
    for name, values in found.items():
        assert Path(values["salient_folder"]).parent == suite / "build" / "failures"
        assert values["salient_seed"] == ("77" if name == "test_call" else "1")
        assert values["salient_folder"] in (suite / "output").read_text()


@pytest.mark.parametrize("name", KINDS)
def test_failure_leaves_its_folder_and_replays(suite, name):
    values = properties(suite)[name]
    folder = Path(values["salient_folder"])
    failure = json.loads((folder / "failure.json").read_text())
    phase, error = KINDS[name]
    assert (failure["phase"], failure["test"]) == (phase, f"tests/test_kinds.py::{name}")
    assert error in "\n".join(failure["error"])
    bench = json.loads((folder / "0" / "bench.json").read_text())
    expected_s = 0.09 if "timeout" in name else 0.07 if phase == "teardown" else 0.06
    assert bench["virtual_time_s"] == pytest.approx(expected_s)
    with can.LogReader(folder / "0" / "can.blf") as log:
        assert len(list(log)) == len((folder / "0" / "can.log").read_text().splitlines()) > 300
    assert all((folder / "0" / name).read_bytes().startswith(b"\x89PNG") for name in ("failure.png", "last_second.png"))
    page = html.unescape((folder / "0" / "failure.html").read_text())
    assert f"<h1>tests/test_kinds.py::{name}</h1>" in page and error in page and values["salient_replay"] in page
    truth = np.load(folder / "0" / "truth.npy")
    # A simulator that is killed has not written the rows of its last block.
    assert bench["virtual_time_s"] - 0.06 * (name == "test_killed") <= truth["time_s"][-1] + 1e-4
    assert truth["time_s"][0] == 0.0 and len(truth) > (20 if name == "test_killed" else 1000)
    if "timeout" in name:
        assert 0.03 < bench["first_fault"]["time_s"] < 0.09
        assert bench["first_fault"]["fault"] == "encoder"
        assert any("DRIVE_STATUS.state: run -> fault" in change for change in bench["first_fault"]["changes"])
        assert (folder / "0" / "first_fault.png").exists()
    else:
        assert "first_fault" not in bench
    before = [text.partition(" s ")[2] for text in bench["changes_before_the_failure"]]
    if name == "test_call":
        assert any("load_torque_Nm: 0 N m -> 4 N m" in change for change in before), before
        assert not any("torque_reference_Nm" in change for change in before), before

    replay = subprocess.run(["bash", "-c", values["salient_replay"]], cwd=failure["replay_in"], capture_output=True,
                            text=True)
    assert replay.returncode == 1, replay
    again = json.loads((folder / "failure.json").read_text())
    assert (again["phase"], error in "\n".join(again["error"])) == (phase, True)
    assert json.loads((folder / "0" / "bench.json").read_text()) | {"simulator": ""} == bench | {"simulator": ""}


def test_teardown_that_fails_after_the_call_has_a_folder_of_its_own(tmp_path):
    machine = EXAMPLES / "fan12.toml"
    (tmp_path / "test_two.py").write_text(
        "import pathlib, pytest\n"
        "@pytest.fixture\ndef broken(make_bench):\n"
        f"    yield make_bench(machine=pathlib.Path({str(machine)!r}))\n    raise RuntimeError('second')\n"
        "def test_both(broken):\n    broken.run_for(0.01)\n    assert False, 'first'\n")
    subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path], cwd=tmp_path,
                   capture_output=True, text=True)
    errors = {path.parent.name: "\n".join(json.loads(path.read_text())["error"])
              for path in (tmp_path / "build" / "failures").rglob("failure.json")}
    assert set(errors) == {"test_two.py_test_both", "test_two.py_test_both_teardown"}
    assert "first" in errors["test_two.py_test_both"] and "second" in errors["test_two.py_test_both_teardown"]
    note = json.loads((tmp_path / "build" / "failures" / "test_two.py_test_both" / "0" / "bench.json").read_text())
    assert note["machine"] == str(machine)


OF_EQUAL_NAMES = '''
import pytest

NAMES = ["1", "+1", "r/min", "r min", "n" * 300]

@pytest.mark.parametrize("speed", NAMES, ids=NAMES)
def test_speed(bench, speed):
    assert speed == "none"
'''


def test_every_parameter_of_a_test_has_a_folder_whatever_its_characters_and_length(tmp_path):
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_names.py").write_text(OF_EQUAL_NAMES)
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"], cwd=tmp_path,
                          capture_output=True, text=True, check=False)
    assert "nothing saved" not in done.stdout and "5 failed" in done.stdout
    folders = sorted((tmp_path / "build" / "failures").iterdir())
    tests = [json.loads((folder / "failure.json").read_text())["test"] for folder in folders]
    assert sorted(tests) == sorted(f"test_names.py::test_speed[{each}]" for each in (
        "1", "+1", "r/min", "r min", "n" * 300))
    assert folders[0].name == "test_names.py_test_speed_1"


def test_a_folder_that_is_used_again_has_nothing_of_the_earlier_failure(tmp_path, bench):
    for name in (*LEFT, "notes.txt"):
        (tmp_path / name).write_text("of an earlier failure")
    bench.run_for(0.001)
    save(bench, tmp_path, {"replay": "none"}, None)
    assert not (tmp_path / "first_fault.png").exists() and not (tmp_path / "truth.npy").exists()
    assert "The first fault" not in (tmp_path / "failure.html").read_text()
    assert (tmp_path / "notes.txt").exists()


def test_passed_test_leaves_nothing(tmp_path, bench):
    bench.run_for(0.001)
    assert {path.name for path in tmp_path.iterdir()} == {"can0.sock", "recording0.npy"}


def test_recordings_of_passed_tests_are_removed(tmp_path_factory):
    assert list(tmp_path_factory.getbasetemp().glob("test_passed_test_leaves_nothing*/*.npy")) == []


def test_torque_reference_is_a_change_in_torque_mode_only(make_bench):
    bench = make_bench(machine="saturating")
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.1)
    in_speed_mode = changes(bench, bench.time_s)
    bench.drive.torque_reference_Nm = 2.0
    bench.run_for(0.04)
    assert not any("torque_reference_Nm" in change for change in in_speed_mode)
    found = changes(bench, bench.time_s)
    assert any("DRIVE_STATUS.mode: speed -> torque" in change for change in found)
    assert any(re.search(r"DRIVE_TORQUE\.torque_reference_Nm: .* -> 1\.996", change) for change in found), found


MANY = """
import gc
import pytest
from salient.bench.session import Session

@pytest.mark.parametrize("number", range(8))
def test_passes_or_fails(bench, number):
    gc.collect()
    assert sum(isinstance(one, Session) for one in gc.get_objects()) == 1
    bench.run_for(0.01)
    assert number % 4 != 3, "of the suite"
"""


def test_a_suite_keeps_the_bench_of_the_present_test_only(tmp_path):
    (tmp_path / "test_many.py").write_text(MANY)
    result = subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=line", tmp_path],
                            cwd=tmp_path, capture_output=True, text=True)
    assert "2 failed, 6 passed" in result.stdout, result.stdout
    assert result.stdout.count("- AssertionError: of the suite") == 2, result.stdout
