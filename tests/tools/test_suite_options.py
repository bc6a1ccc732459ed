"""Options of the pytest plugin: what tests run on, how often, and where a drive is alone on its bus."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from salient.bench import session as session_module
from salient.bench import stubs
from salient.bench.emulator import EmulatorProcess
from salient.config import BenchConfig

SUITE = '''
import pytest

def test_speed(bench):
    bench.drive.speed_reference_rpm = 150
    bench.run_until(lambda: abs(bench.telemetry["speed_rpm"].last - 150) < 5, timeout=5)
    assert bench.drive.fault == "none"
    bench.drive.stop()
    bench.run_for(0.1)

def test_load(bench):
    bench.load_torque_Nm = 3

@pytest.mark.bench_options(controller="paper")
def test_controller(bench):
    assert bench.simulator.ready["controller"] == "paper"

def add_load(bench):
    bench.rig.load_torque_Nm = 3

def test_load_in_a_function(bench):
    add_load(bench)

@pytest.mark.bench_each(machine=["saturating", "linear_cosine"])
def test_machines(bench, request):
    assert bench.options.machine in request.node.name
'''


def run(folder: Path, *options: str) -> list[str]:
    """The results of the tests, and reasons."""
    (folder / "test_some.py").write_text(SUITE)
    done = subprocess.run([sys.executable, "-m", "pytest", "-v", "-rs", "-p", "no:cacheprovider", *options, "."],
                          cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()


def outcome(lines: list[str], word: str) -> set[str]:
    return {line.split("::")[1].split()[0] for line in lines if "::" in line and f" {word}" in line}


@pytest.mark.in_turns
def test_tests_run_once_for_each_machine_and_controller(tmp_path):
    lines = run(tmp_path, "--salient-controller=paper", "--salient-controller=salient")
    assert outcome(lines, "PASSED") == {
        "test_speed[paper]", "test_speed[salient]", "test_load[paper]", "test_load[salient]", "test_controller",
        "test_load_in_a_function[paper]", "test_load_in_a_function[salient]",
        *(f"test_machines[{machine}-{controller}]" for machine in ("saturating", "linear_cosine")
          for controller in ("paper", "salient"))}


@pytest.mark.in_turns
def test_drive_alone_on_its_bus_runs_what_does_not_need_the_bench(tmp_path):
    address = f"unix:{tmp_path}/drive.sock"
    with EmulatorProcess(BenchConfig(pace="x0.5", drive_only=True), address):
        lines = run(tmp_path, f"--salient-can={address}")
    assert outcome(lines, "PASSED") == {"test_speed"}
    assert outcome(lines, "SKIPPED") == {"test_load", "test_controller", "test_load_in_a_function",
                                         "test_machines[saturating]", "test_machines[linear_cosine]"}
    reasons = "\n".join(lines)
    for what in ("bench.load_torque_Nm", "option controller", "bench.rig", "option machine"):
        assert f"needs the test bench ({what}), and on {address} there is a drive alone" in reasons


@pytest.mark.in_turns
@pytest.mark.parametrize(("option", "error"), [
    ("--salient-program=nowhere", "--salient-program nowhere: must be an executable file"),
    ("--salient-controller=pid", "invalid choice: 'pid'"),
])
def test_invalid_option_is_refused(tmp_path, option, error):
    done = subprocess.run([sys.executable, "-m", "pytest", option, "."], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 4 and error in done.stderr


def test_stub_file_is_that_of_the_databases():
    assert stubs.FILE.read_text() == stubs.text(), "python -m salient.bench.stubs writes it"


def test_load_profile_is_set_by_name(bench):
    bench.rig.set_load_profile("compressor_one_cylinder")
    bench.rig.load_profile_Nm = 2
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.2)
    load_Nm = bench.truth["load_torque_Nm"].value
    assert load_Nm.max() - load_Nm.min() > 1


def test_test_at_a_breakpoint_for_ten_minutes_passes(bench, monkeypatch):
    """The clock of this process runs 1000 times as fast while a debugger holds the emulator."""
    started_s, real = time.monotonic(), time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: started_s + 1000.0 * (real() - started_s))
    monkeypatch.setattr(session_module, "_ALIVE_CHECK_S", 0.02)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    held = threading.Event()
    checks = iter(range(40))

    def is_alive() -> bool:
        if next(checks, None) is None and not held.is_set():
            assert time.monotonic() - started_s > 600
            held.set()
            os.kill(bench.simulator.pid, signal.SIGCONT)
        return bench.simulator.is_alive

    monkeypatch.setattr(bench, "_is_alive", is_alive)
    os.kill(bench.simulator.pid, signal.SIGSTOP)
    bench.run_for(0.05)
    assert held.is_set() and bench.time_ns == 100_000_000
    assert bench.drive.state == "run"
