"""tools/examples: each does what its docstring describes, and ends without warnings."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from dataclasses import replace

import pytest
from matplotlib.image import imread

from salient.bench.emulator import EmulatorProcess
from salient.bus.clock import open_bus
from salient.bus.signals import SignalTable, drive_database
from salient.config import BenchConfig
from salient.experiments.scenario import load_scenarios, run_scenario
from salient.machine.eds import write_eds
from salient.paths import DRIVE_DBC, ROOT, SCENARIOS

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


@pytest.mark.in_turns
def test_plot_speed_runs_the_drive_and_draws_its_speed(channel, tmp_path):
    # One tenth of real time, as below; the plot has the drive's time.
    with EmulatorProcess(BenchConfig(pace="x0.1"), channel):
        done = run(tmp_path, sys.executable, "-W", "error", EXAMPLES / "plot_speed.py", channel, MPLBACKEND="Agg")
    assert (done.returncode, done.stderr) == (0, "")
    image = imread(tmp_path / "speed.png")
    curve = (abs(image[:, :, :3] - (0x1f / 255, 0x77 / 255, 0xb4 / 255)) < 0.1).all(axis=2)
    rows, columns = curve.nonzero()
    top = columns[rows <= rows.min() + 2]  # at 600 r/min for most of the time
    assert 0.5 < len(set(top)) / (columns.max() - columns.min()) < 0.8


@pytest.mark.in_turns
def test_canopen_speed_runs_the_drive_and_stops_it(channel, tmp_path):
    write_eds(tmp_path / "drive.eds", "saturating")
    with EmulatorProcess(BenchConfig(pace="realtime", protocol="canopen"), channel):
        example = start("canopen_speed.py", str(tmp_path / "drive.eds"), channel)
        output, errors = example.communicate()
    assert (errors, example.returncode) == ("", 0)
    assert any(line.startswith("600 r/min") for line in output.splitlines())
    assert output.splitlines()[-1] == "stopped"


def test_the_script_of_the_quick_start_is_the_example():
    text = (ROOT / "docs" / "start" / "can.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    own = (EXAMPLES / "plot_speed.py").read_text(encoding="utf-8").split('"""\n', 1)[1]
    path = 'Path(__file__).resolve().parents[2] / "firmware" / "comms" / "drive.dbc"'
    own = own.replace("from pathlib import Path\n", "")
    assert shown == own.replace(path, '"/path/to/clone/firmware/comms/drive.dbc"')


@pytest.mark.in_turns
def test_run_600_rpm_runs_the_drive_and_stops_it(channel):
    telemetry = SignalTable(drive_database(), "DRIVE")
    # One tenth of real time: the time-out of commands leaves a wide margin for a loaded computer.
    with EmulatorProcess(BenchConfig(pace="x0.1"), channel):
        example = start("run_600_rpm.py", channel, "0.5")
        output, errors = example.communicate()
        with open_bus(channel) as bus:
            while telemetry.count("DRIVE_STATUS") < 20:
                message = bus.recv()
                telemetry.add(message.time_ns, message)
    assert (errors, example.returncode) == ("", 0)
    assert any(line.endswith(" 600.0 r/min") for line in output.splitlines())
    assert output.splitlines()[-1] == "state ready"
    assert telemetry["DRIVE_STATUS.state"].last_name == "ready"
    assert telemetry["DRIVE_STATUS.fault"].last_name == "none"


def test_who_reads_the_page_alone_needs_no_more_than_these_lines():
    """40 lines of Python with python-can and cantools, 60 of C with the kernel's headers: none of this project."""
    scripts = {name: (EXAMPLES / name).read_text() for name in ("run_600_rpm.py", "read_telemetry.py")}
    assert len(scripts["run_600_rpm.py"].splitlines()) <= 40
    for name, script in scripts.items():
        modules = {found[1] for found in re.finditer(r"^\s*(?:import|from) (\w+)", script, re.MULTILINE)}
        assert modules - sys.stdlib_module_names == {"can", "cantools"}, name
    source = (EXAMPLES / "run_600_rpm.c").read_text()
    assert len(source.splitlines()) <= 60
    assert not re.findall(r'#include "|#include <(?:can|hal|comms)', source)


def test_c_example_compiles_without_a_warning_and_names_the_interface_that_is_missing(tmp_path):
    program = tmp_path / "run_600_rpm"
    done = run(tmp_path, "cc", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-o", program, EXAMPLES / "run_600_rpm.c")
    assert (done.returncode, done.stderr) == (0, "")
    for arguments, named in (([], "run_600_rpm INTERFACE [SECONDS]: "), (["nowhere0"], "nowhere0: ")):
        done = run(tmp_path, program, *arguments)
        assert (done.returncode, done.stdout) == (1, "") and done.stderr.startswith(named)
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.in_turns
@pytest.mark.parametrize("script", ["read_telemetry.py", "run_600_rpm.py"])
def test_end_of_the_drive_is_reported_in_one_line(channel, script):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(channel.removeprefix("unix:"))
        server.listen()
        example = start(script, channel)
        server.accept()[0].close()
    output, errors = example.communicate()
    assert (output, errors, example.returncode) == ("", f"{channel}: the drive has ended\n", 1)


def run(folder, *command, **environment):
    return subprocess.run([str(part) for part in command], cwd=folder, env={**os.environ, **environment}, text=True,
                          capture_output=True)


@pytest.mark.in_turns
def test_first_test_passes(tmp_path):
    shutil.copy(EXAMPLES / "test_first.py", tmp_path)
    done = run(tmp_path, sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", ".")
    assert (done.returncode, "1 passed" in done.stdout) == (0, True), done.stdout


@pytest.mark.in_turns
def test_torque_loop_holds_the_speed(tmp_path):
    done = run(tmp_path, sys.executable, EXAMPLES / "torque_loop.py")
    assert (done.returncode, done.stderr) == (0, "")
    found = re.fullmatch(r"return (-[0-9.]+), speed ([0-9]+) r/min\n", done.stdout)
    assert found is not None and -60 < float(found[1]) < -5 and 297 <= int(found[2]) <= 303


def test_log_is_analysed_with_pandas(tmp_path):
    scenario = replace(load_scenarios(SCENARIOS / "start_600.toml")[2], duration_s=0.3, record=None)
    log = run_scenario(scenario, tmp_path).log_path
    done = run(tmp_path, sys.executable, "-W", "error", EXAMPLES / "analyse_log.py", log, DRIVE_DBC)
    assert (done.returncode, done.stderr) == (0, "")
    last = done.stdout.splitlines()[-1].split()
    assert last[0] == "0.2" and abs(float(last[2])) < 0.5 and int(last[1]) > 50


@pytest.mark.in_turns
def test_sweep_writes_its_table(tmp_path):
    done = run(tmp_path, EXAMPLES / "sweep.sh", "--shard", "1/15", SALIENT=f"{sys.executable} -m salient")
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "out" / "sweep" / "sweep.csv").read_text().splitlines()
    assert lines[0].startswith("machine,controller,observer_bandwidth_rad_s,current_noise_A,seed,settling_time_s")
    assert len(lines) == 3  # of 30 runs
