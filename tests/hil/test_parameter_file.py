"""tools/salient parameters: a running drive's parameters to a file and back, and its log of faults."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from salient.__main__ import main
from salient.bench import parameter_file
from salient.bench.emulator import EmulatorProcess, parameter_table
from salient.bench.session import Session
from salient.config import BenchConfig
from salient.errors import UsageError
from salient.machine.parameter_table import CHOICES, read_table


@pytest.fixture
def can(tmp_path: Path) -> Iterator[str]:
    """Bus of a drive whose time moves by itself, slowly: a client that does not keep up loses frames."""
    bus = f"unix:{tmp_path}/bus.sock"
    with EmulatorProcess(BenchConfig(pace="x0.2", memory=tmp_path / "memory.bin"), bus):
        yield bus


def parameters(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "salient", "parameters", *map(str, arguments)], text=True,
                          capture_output=True, stdin=subprocess.DEVNULL)


@pytest.mark.parametrize(("text", "mistake"), [
    (f"current_trip_A = 1{'0' * 400}", "current_trip_A: 100000"), (f"controller = 1{'0' * 400}", "controller: 100000"),
    ("current_trip_A = inf", "current_trip_A: inf: must be"), ("controller = 0.5", "controller: 0.5: must be "),
    ("current_trip_A = nan", "current_trip_A: nan: must be a number from 1.0 to 79.0 A"),
])  # fmt: skip
def test_a_number_that_no_parameter_has_is_a_mistake_of_the_file(tmp_path: Path, text: str, mistake: str):
    file = tmp_path / "drive.toml"
    file.write_text(text)
    rows = {row.name: row for row in parameter_table(BenchConfig())}
    with pytest.raises(UsageError) as caught:
        parameter_file.read(file, rows)
    assert str(caught.value).startswith(f"{file}: {mistake}") and "\n" not in str(caught.value)


@pytest.mark.in_turns
def test_saved_file_has_every_parameter_with_its_unit_and_is_equal_to_the_drive(can, tmp_path: Path):
    file = tmp_path / "drive.toml"
    saved = parameters("save", file, "--can", can)
    assert (saved.returncode, saved.stderr) == (0, "")
    with Session(can, lockstep=False) as session:
        rows = session.drive.parameters.rows
        assert list(tomllib.loads(file.read_text())) == list(rows)
    assert "current_trip_A = 75.0  # A, 1.0 to 79.0\n" in file.read_text()
    compared = parameters("compare", file, "--can", can)
    assert (compared.returncode, compared.stdout) == (0, f"0 of {len(rows)} parameters differ\n")


@pytest.mark.in_turns
def test_values_that_select_something_have_names(can, tmp_path: Path):
    file = tmp_path / "drive.toml"
    assert parameters("save", file, "--can", can).returncode == 0
    text = file.read_text()
    assert 'controller = "salient"  # traditional, paper or salient\n' in text
    assert 'bp_mode = "network_with_learning"  # off, fixed_gains, ' in text
    file.write_text('bp_mode = "fixed_gains"\nload_source = 0\n')
    compared = parameters("compare", file, "--can", can)
    assert compared.stdout.splitlines() == [f"bp_mode: network_with_learning in the drive, fixed_gains in {file}",
                                            "1 of 2 parameters differ"]
    assert parameters("load", file, "--can", can).stdout == "bp_mode = fixed_gains\nload_source = observer\n"
    with Session(can, lockstep=False) as session:
        assert session.drive.parameters["bp_mode"] == 1
    file.write_text('bp_mode = "fixed"\ncontroller = 3\ncurrent_trip_A = "salient"\n')
    assert parameters("load", file, "--can", can).stderr.splitlines() == [
        f"salient: {file}: bp_mode: 'fixed': must be off, fixed_gains, network_without_learning or "
        "network_with_learning",
        f"salient: {file}: controller: 3: must be traditional, paper or salient",
        f"salient: {file}: current_trip_A: 'salient': must be a number from 1.0 to 79.0 A"]


def test_names_of_values_are_those_of_the_table():
    rows = {row.name: row for row in read_table()}
    for name, values in CHOICES.items():
        row = rows[name]
        assert (row.minimum, row.maximum, row.fraction_bits, row.unit) == (0, len(values) - 1, 0, "")
        for number, value in enumerate(values):
            assert re.search(rf"\b{number} (of (the|a) )?{value.replace('_', ' ')}\b", row.text), (name, value)


@pytest.mark.in_turns
def test_loaded_file_is_in_the_drive_and_differences_are_listed(can, tmp_path: Path):
    file = tmp_path / "drive.toml"
    file.write_text("over_speed_rpm = 1234\ncurrent_trip_A = 60.3\n")
    before = parameters("compare", file, "--can", can)
    assert before.returncode == 1
    assert before.stdout.splitlines() == [f"over_speed_rpm: 3600 in the drive, 1234 in {file} r/min",
                                          f"current_trip_A: 75.0 in the drive, 60.3 in {file} A",
                                          "2 of 2 parameters differ"]
    loaded = parameters("load", file, "--can", can)
    assert (loaded.returncode, loaded.stderr) == (0, "")
    assert loaded.stdout.splitlines() == ["over_speed_rpm = 1234", "current_trip_A = 60.3"]
    assert parameters("compare", file, "--can", can).returncode == 0
    with Session(can, lockstep=False) as session:
        session.rig.drive_reset = 1
        session.run_for(0.05)
    assert parameters("compare", file, "--can", can).returncode == 1
    assert parameters("load", file, "--store", "--can", can).returncode == 0
    with Session(can, lockstep=False) as session:
        session.rig.drive_reset = 1
        session.run_for(0.05)
    assert parameters("compare", file, "--can", can).returncode == 0


@pytest.mark.in_turns
def test_each_bad_entry_is_one_line_and_nothing_is_set(can, tmp_path: Path):
    file = tmp_path / "drive.toml"
    file.write_text('over_speed_rpm = 1234\nspeed = 5\ncurrent_trip_A = 99\ncurrent_limit_A = "much"\n'
                    "angle_adaptation = true\ncommand_timeout_ms = nan\n")
    for action in ("load", "compare"):
        result = parameters(action, file, "--can", can)
        assert (result.returncode, result.stdout) == (2, "")
        lines = result.stderr.splitlines()
        assert len(lines) == 5 and all(line.startswith(f"salient: {file}: ") for line in lines)
        texts = [line.removeprefix(f"salient: {file}: ") for line in lines]
        assert texts[0].startswith("'speed': unknown parameter; the nearest of ")
        assert texts[1] == "current_trip_A: 99: must be a number from 1.0 to 79.0 A"
        assert texts[2] == "current_limit_A: 'much': must be a number from 1.0 to 79.0 A"
        assert texts[3] == "angle_adaptation: True: must be a number from 0 to 1"
        assert texts[4].startswith("command_timeout_ms: nan: must be a number from ")
    with Session(can, lockstep=False) as session:
        assert session.drive.parameters["over_speed_rpm"] == 3600


@pytest.mark.in_turns
@pytest.mark.parametrize(("content", "expected"), [("over_speed_rpm = = 3", "not TOML"), (None, "no such file")])
def test_file_that_cannot_be_read_is_named(can, tmp_path: Path, content: str | None, expected: str):
    file = tmp_path / "drive.toml"
    if content:
        file.write_text(content)
    result = parameters("load", file, "--can", can)
    assert result.returncode == 2
    assert result.stderr.startswith(f"salient: {file}: {expected}") and result.stderr.count("\n") == 1


def test_load_into_a_drive_that_runs_fails_with_exit_code_1(monkeypatch, capsys, bench, tmp_path: Path):
    """With the session of a bench, whose drive keeps running."""
    file = tmp_path / "drive.toml"
    file.write_text("over_speed_rpm = 1234\n")
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
    monkeypatch.setattr(parameter_file, "Session", lambda *_, **__: contextlib.nullcontext(bench))
    monkeypatch.setattr(sys, "argv", ["salient", "parameters", "load", str(file), "--can", "unix:x"])
    assert main() == 1
    assert capsys.readouterr().err == "salient: over_speed_rpm 1234: not_while_running\n"


def test_faults_are_listed(can):
    none = parameters("faults", "--can", can)
    assert (none.returncode, none.stdout) == (0, "no fault in the log\n")
    with Session(can, lockstep=False) as session:
        session.drive.wait_until_ready()
        session.rig.supply_voltage_V = 320
        session.run_until(lambda: session.drive.state == "fault", 1.0)
    listed = parameters("faults", "--can", can)
    assert listed.returncode == 0
    assert listed.stdout.startswith("    1  start 1  ") and "over_voltage in state ready" in listed.stdout


@pytest.mark.parametrize(("arguments", "expected"), [
    (["store", "x.toml"], "unknown action 'store': must be one of save, compare, load, faults"),
    (["load"], "the following arguments are required: FILE.toml"),
    (["save", "x.toml", "--can", "bus"], "--can bus: must be unix:PATH or socketcan:INTERFACE"),
    (["faults", "--can", "unix:/no/such/bus"], "unix:/no/such/bus: no drive answers there"),
])
def test_usage_error_is_one_line_and_exit_code_2(arguments: list[str], expected: str):
    result = parameters(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.count("\n") == 1 and expected in result.stderr
