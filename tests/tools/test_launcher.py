"""Usage errors: one line that names the error and the valid values, and exit code 2."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from can import CanOperationError

from salient import __main__ as salient_main
from salient import kept_files
from salient.bench.drive import DriveError, OtherDatabase
from salient.bench.faults import FaultError
from salient.bench.programs import EmulatorError
from salient.bench.rig import RigError
from salient.bench.session import SessionError
from salient.cli import make_parser
from salient.machine.path import MachineError
from salient.paths import MACHINES, ROOT

SCENARIO = """
machine = "saturating"
controllers = ["paper"]
duration_s = 0.01
"""


def assert_usage_error(result, *expected_texts: str) -> None:
    assert result.returncode == 2, result
    assert result.stdout == ""
    assert re.fullmatch(r"salient: [^\n]+\n", result.stderr), result.stderr
    for expected in expected_texts:
        assert expected in result.stderr


@pytest.mark.in_turns
@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        ([], ["COMMAND"]),
        (["monitr"], ["unknown command 'monitr': the nearest of 24 are monitor, ", "tools/salient --help"]),
        (["fo'o"], ["unknown command 'fo'o': the nearest of "]),
        (["a\nb"], ["unknown command 'a b': the nearest of "]),
        (["--can", "unix:x", "sim"], ["unrecognised argument --can; must be one of --help, "]),
        (["sim", "--pcae", "free"], ["unrecognised argument --pcae; the nearest of ", " are --pace, ",
                                     "tools/salient sim --help"]),
        (["sim", "-pace", "free"], ["unrecognised argument -pace free; the nearest of ", " are --pace, "]),
        (["pil", "--bond"], ["unrecognised argument --bond; must be one of ", "--bound, --figures", "pil --help"]),
        (["parameters", "load", "x.toml", "--stor2"], ["--stor2; must be one of --help, --store, ", "load --help"]),
        (["run", "start_600", "more"], ["unrecognised argument more (tools/salient run --help)"]),
        (["sim", "--pace", "fast"], ["--pace fast", "lockstep, realtime, free or xN"]),
        (["sim", "--controller", "pid"], ["--controller pid", "traditional, paper or salient"]),
        (["sim", "--control-rate-hz", "30000"], ["--control-rate-hz 30000", "20000, 40000, 50000, 100000"]),
        (["sim", "--encoder-bits", "7"], ["--encoder-bits 7", "0 or 8 to 24"]),
        (["sim", "--seed", "-1"], ["--seed -1", "whole number from 0"]),
        (["sim", "--seed"], ["--seed", "requires a value"]),
        (["sim", "--can", "vcan0"], ["--can vcan0", "unix:PATH or socketcan:INTERFACE"]),
        (["sim", "--can", "socketcan:nowhere0"], ["--can socketcan:nowhere0"]),
        (["sim", "--can", "unix:/no/such/folder/bus"], ["/no/such/folder/bus"]),
        (["sim", "--initial-angle-deg", "400"], ["--initial-angle-deg 400", "-360 to 360"]),
        (["sim", "--bit-rate", "5"], ["--bit-rate 5", "10000"]),
        (["sim", "--machine", "nonesuch"], ["nonesuch", "the nearest of 10 are linear_cosine, "]),
        (["demo", "--machine", "nonesuch.toml"], ["nonesuch.toml"]),
        (["demo", "--out", "/proc/nowhere"], ["/proc/nowhere"]),
        (["run"], ["SCENARIO.toml"]),
        (["run", "nonesuch.toml"], ["nonesuch.toml", "no such file"]),
        (["sweep", "start_6000"], ["scenario 'start_6000': no such file, and no bundled scenario of that name; ",
                                   "must be one of load_step_150, move_90, start_600"]),
        (["log", "--can", "unix:/no/such/bus"], ["unix:/no/such/bus"]),
        (["log", "--out", "can.xyz"], ["can.xyz", ".blf"]),
        (["monitor", "--can", "unix:/no/such/bus"], ["unix:/no/such/bus"]),
        (["test", "--only", "everything"], ["everything", "unit"]),
        (["bench"], ["bench", "benchmark"]),
        (["benchmark", "--runs", "0"], ["--runs 0"]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, list) else None,
)
def test_invalid_command_line_is_rejected(salient, arguments, expected_texts):
    assert_usage_error(salient(*arguments), *expected_texts)


@pytest.mark.parametrize(
    ("text", "expected_texts"),
    [
        (SCENARIO + "duration = 1\n", ["duration", "unknown key", "duration_s"]),
        (SCENARIO.replace("0.01", "-1"), ["duration_s", "-1", "0.001 to 3600"]),
        (SCENARIO.replace("0.01", '"long"'), ["duration_s", "'long'", "must be a number"]),
        (SCENARIO.replace("paper", "pid"), ["controllers", "'pid'", "traditional, paper or salient"]),
        (SCENARIO.replace('["paper"]', '["paper", "paper"]'), ["controllers", "different"]),
        (SCENARIO.replace("saturating", "nonesuch"), ["nonesuch", "the nearest of 10 are "]),
        (SCENARIO.replace('machine = "saturating"', ""), ["machine", "missing"]),
        (SCENARIO + "load_profile = 5\n", ["load_profile: 5: must be a text"]),
        (SCENARIO + '[parameters]\n"" = 1\n', ["parameters.'': unknown parameter; the nearest of "]),
        (SCENARIO + "seed = 1.5\n", ["seed", "1.5", "whole number"]),
        (SCENARIO + "control_rate_hz = 30000\n", ["control_rate_hz", "30000", "20000, 40000, 50000, 100000"]),
        (SCENARIO + "[[speed]]\nat_s = 0\nvalue = 600\n", ["speed.value", "unknown key", "value_rpm"]),
        (SCENARIO + "[[speed]]\nat_s = 0\n", ["speed.value_rpm", "missing"]),
        (SCENARIO + "[[speed]]\nat_s = 0\nvalue_rpm = 9000\n", ["speed.value_rpm", "9000", "0 to 3000"]),
        (SCENARIO + "[load]\nat_s = 0\n", ["load", "[[load]]"]),
        (SCENARIO + "[record]\nstep_us = 0\n", ["record.step_us", "0.1"]),
        (SCENARIO + "[parameters]\ntorque_max = 1\n", ["parameters.torque_max", "torque_max_Nm"]),
        (SCENARIO + "[parameters]\ntorque_max_Nm = 1000\n", ["parameters.torque_max_Nm", "1000", "0 to 100 N m"]),
        (SCENARIO + "[parameters]\ntorque_max_Nm = true\n", ["parameters.torque_max_Nm", "must be a number"]),
        (SCENARIO + '[[fault]]\nkind = "winding_open"\nphase = "d"\nat_s = 0.001\n',
         ["fault.phase", "'d'", "a, b or c", "saturating"]),
        (SCENARIO + 65 * "[[load]]\nat_s = 0.001\ntorque_Nm = 1\n", ["load", "65 changes", "at most 64"]),
        (SCENARIO + 33 * '[[fault]]\nkind = "winding_open"\nphase = "a"\nat_s = 0.001\nduration_s = 0.001\n',
         ["fault", "66 changes", "at most 64"]),
        (SCENARIO + "[record]\nfrom_s = 0.01\n", ["record.from_s", "0.01", "below duration_s"]),
        (SCENARIO + "[bench]\ntruth_period_us = 0\n", ["bench.truth_period_us", "1 to 10000"]),
        (SCENARIO + "[bench]\ntruth_period_us = 10001\n", ["bench.truth_period_us", "1 to 10000"]),
        (SCENARIO + "seed = \n", ["not TOML"]),
        (SCENARIO + "seed = " + 5000 * "9", ["not TOML", "too long"]),
        (SCENARIO + "seed = " + 20000 * "[", ["not TOML", "too deep"]),
    ],
)
def test_invalid_scenario_is_rejected(salient_without_build, tmp_path, text, expected_texts):
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    assert_usage_error(salient_without_build("run", path, "--out", tmp_path / "out"), *expected_texts)


def test_what_the_bench_can_take_is_accepted(salient_without_build, tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO + 64 * "[[load]]\nat_s = 0.001\ntorque_Nm = 1\n" + "[[load]]\nat_s = 0\ntorque_Nm = 1\n"
                    + 32 * '[[fault]]\nkind = "winding_open"\nphase = "a"\nat_s = 0.001\nduration_s = 0.001\n'
                    + "[bench]\ntruth_period_us = 10000\n")
    result = salient_without_build("run", path, "--out", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("arguments", [("run", "start_600"), ("replay", "1")], ids=lambda arguments: arguments[0])
def test_a_file_in_the_place_of_the_folder_is_named(salient_without_build, tmp_path, arguments):
    (tmp_path / "file").write_text("")
    assert_usage_error(salient_without_build(*arguments, "--out", "file"), "--out file", "cannot write there")


def test_unknown_machine_of_a_tab_is_named(salient_without_build):
    assert_usage_error(salient_without_build("tab", "--machine", "nonesuch"), "nonesuch", "the nearest of 10 are ")


@pytest.mark.parametrize(("error", "code"), [
    (RigError("load_torque_Nm 1: queue_full"), 2), (FaultError("winding_open d: unsupported"), 2),
    (MachineError("mine.toml: bad"), 2), (OtherDatabase("another drive.dbc"), 2), (DriveError("no response"), 1),
    (SessionError("the emulator has ended"), 1), (EmulatorError("salient_host ended with -9"), 1),
    (CanOperationError("the drive has ended"), 1),
], ids=lambda value: type(value).__name__)
def test_errors_of_the_package_are_one_line(salient_without_build, monkeypatch, error, code):
    def fail(_: object) -> int:
        raise error

    monkeypatch.setitem(salient_main._COMMANDS, "parameters", fail)
    result = salient_without_build("parameters", "faults", "--can", "unix:bus")
    of_bus = "unix:bus: " if isinstance(error, CanOperationError) else ""
    assert (result.returncode, result.stderr) == (code, f"salient: {of_bus}{error}\n")


def machine_file(folder: Path, name: str, old: str, new: str) -> Path:
    text = (MACHINES / "saturating.toml").read_text()
    assert old in text
    path = folder / f"{name}.toml"
    path.write_text(text.replace('name = "saturating"', f'name = "{name}"').replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "expected_texts"),
    [
        ("resistance_ohm", "resistence_ohm", ["winding.resistence_ohm", "unknown key", "resistance_ohm"]),
        ("inertia_kg_m2 = 0.02", "inertia_kg_m2 = -0.02", ["mechanics.inertia_kg_m2", "-0.02"]),
        ("stator = 6", "stator = 7", ["poles.stator, poles.rotor", "7/4", "7 phases", "3 to 6"]),
        ("stator = 6", "stator = 4", ["poles.stator, poles.rotor", "4/4", "1 phase,", "3 to 6"]),
        ("stator = 6", "stator = 6.0", ["poles.stator, poles.rotor", "6.0/4", "whole numbers"]),
        ('form = "saturating"', 'form = "magic"', ["magnetics.form", "'magic'", "linear_cosine"]),
        ("[converter]", "[converter", ["not TOML"]),
    ],
)
def test_invalid_machine_file_is_rejected(salient_without_build, tmp_path, old, new, expected_texts):
    path = machine_file(tmp_path, "mine", old, new)
    assert_usage_error(salient_without_build("sim", "--machine", path), str(path), *expected_texts)


@pytest.mark.parametrize("option", ["--json", "--a2l", "--eds", "--dbc"])
def test_machine_file_that_is_read_stays(salient_without_build, tmp_path, option):
    path = machine_file(tmp_path, "mine", "", "")
    text = path.read_text()
    assert_usage_error(salient_without_build("machine", path, option, "./mine.toml"), option, "would be overwritten")
    assert path.read_text() == text
    assert_usage_error(salient_without_build("tab", "--machine", path, "--out", path), "--out", "would be overwritten")
    assert path.read_text() == text


def _actions(parser: argparse.ArgumentParser, name: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Commands, with their actions, and their parsers."""
    below = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    for action in below:
        for word, each in action.choices.items():
            yield from _actions(each, f"{name} {word}".strip())
    if not below:
        yield name, parser


PARSERS = dict(_actions(make_parser()))
_PLACES = ("FILE", "DIR", "TOML")
_VALUES = {"machine": "saturating", "scenario": "start_600", "file": "other.toml", "value": "1", "what": "1"}
"""For arguments that a command needs."""


def _file_options(command: str) -> list[argparse.Action]:
    return [action for action in PARSERS[command]._actions
            if any(place in str(action.metavar) for place in _PLACES)]


def _pairs() -> Iterator[tuple[str, str, str]]:
    """Command, option with a file that is read, option of one that is written, or a file in the folder --out."""
    for command in PARSERS:
        names = {action.dest for action in _file_options(command)}
        written = kept_files.WRITTEN.get(command, ())
        for source in sorted(names & set(kept_files.READ) - set(written)):
            for target in (*written, *kept_files.FOLDERS.get(command, ())):
                yield command, source, target


def test_every_option_with_a_file_is_known_as_read_or_written():
    """A command that writes a file names it in kept_files, whose check is before the command."""
    assert set(kept_files.WRITTEN) | set(kept_files.FOLDERS) <= set(PARSERS)
    for command in PARSERS:
        written = {*kept_files.WRITTEN.get(command, ()), *(["out"] if command in kept_files.FOLDERS else [])}
        for action in _file_options(command):
            known = action.dest in {*written, *kept_files.READ} or (command, action.dest) in _READS_NOTHING
            assert known, f"{command} --{action.dest}"


_READS_NOTHING = {(command, "out") for command in ("campaign", "replay", "wheel", "docs", "machine")}
"""Folders of commands without a file that is read; `machine --import` looks at its own."""


@pytest.mark.parametrize(("command", "source", "target"), list(_pairs()))
@pytest.mark.parametrize("link", [os.link, os.symlink])
def test_no_command_overwrites_what_it_reads(salient_without_build, tmp_path, command, source, target, link):
    is_folder = target in kept_files.FOLDERS.get(command, ())
    mine = tmp_path / "mine.toml"
    mine.write_text("[magnetics]\nfile = 'map.csv'\n")
    other = tmp_path / "out" / target.replace("*", "x") if is_folder else tmp_path / "other.csv"
    if (command, target) == ("identify", "out"):
        other = tmp_path / "other.toml"
    other.parent.mkdir(parents=True, exist_ok=True)
    link(mine, other)
    values = {source: mine, "out" if is_folder else target: tmp_path / "out" if is_folder else other}
    line: list[object] = command.split()
    for action in PARSERS[command]._actions:
        if action.dest in values or action.required or action.dest == "scenario":
            value = values.get(action.dest, _VALUES.get(action.dest))
            line += [*action.option_strings[:1], value]
    done = salient_without_build(*line)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.endswith(f": {mine} is read, and would be overwritten; name another file\n"), done.stderr
    assert mine.read_text() == other.read_text() == "[magnetics]\nfile = 'map.csv'\n"


def test_the_map_of_a_machine_file_is_read(salient_without_build, tmp_path):
    path = machine_file(tmp_path, "mine", "", "")
    path.write_text('[magnetics]\nform = "map"\nfile = "map.csv"\n')
    (tmp_path / "map.csv").write_text("a")
    assert_usage_error(salient_without_build("machine", path, "--json", "map.csv"), "--json map.csv",
                       "would be overwritten")
    assert (tmp_path / "map.csv").read_text() == "a"


@pytest.mark.parametrize("second", ["./one", "link"])
def test_no_file_is_written_twice(salient_without_build, tmp_path, second):
    (tmp_path / "link").symlink_to("one")
    assert_usage_error(salient_without_build("machine", "saturating", "--json", "one", "--eds", second),
                       f"--eds {Path(second)}: --json one writes the same file; name another one")
    assert not (tmp_path / "one").exists()


def test_a_name_too_long_for_files_is_the_mistake_of_its_machine_file(salient_without_build, tmp_path):
    path = machine_file(tmp_path, "mine", "", "")
    path.write_text(path.read_text().replace('name = "mine"', f'name = "{300 * "x"}"'))
    assert_usage_error(salient_without_build("machine", path), f"{path}: name: 'xxx", "underscores, at most 100")


@pytest.mark.parametrize(("arguments", "text"), [
    (("--trigger", "speed_rpm > 5"), "--trigger speed_rpm > 5: only with --signals"),
    (("--signals", "speed_rpm", "--dbc", "a.dbc"), "--dbc a.dbc: not with --signals"),
])
def test_scope_ignores_no_option(salient_without_build, arguments, text):
    assert_usage_error(salient_without_build("scope", "--can", "unix:none", *arguments), text)


def test_import_writes_nothing_outside_its_folder(salient_without_build, tmp_path):
    """A name is a part of paths before the machine file that has it is checked."""
    path = machine_file(tmp_path, "mine", "", "")
    path.write_text(path.read_text().replace('name = "mine"', 'name = "../mine"'))
    shutil.copy(MACHINES / "finite_element.csv", tmp_path / "table.csv")
    before = {each: each.read_bytes() for each in tmp_path.iterdir()}
    assert_usage_error(salient_without_build("machine", path, "--import", "table.csv", "--out", "imported"), str(path),
                       "name: '../mine': must be a word of letters, digits and underscores")
    assert {each: each.read_bytes() for each in tmp_path.iterdir()} == before


def test_path_of_a_bus_that_is_too_long_is_told(salient_without_build):
    assert_usage_error(salient_without_build("monitor", "--can", f"unix:{200 * 'x'}"),
                       "no drive answers there (AF_UNIX path too long)")


def test_baseline_that_is_too_deep_is_told(salient_without_build, tmp_path):
    (tmp_path / "compare.json").write_text(100_000 * "[")
    assert_usage_error(salient_without_build("compare", "--baseline", "compare.json"), "compare.json: not JSON")


def test_bus_in_use_is_reported(salient, make_bench):
    bench = make_bench()
    assert_usage_error(salient("sim", "--can", bench.address), bench.address.removeprefix("unix:"))


def test_missing_compiler_is_reported(salient, tmp_path):
    tools = tmp_path / "bin"
    tools.mkdir()
    for tool in ("sh", "dirname", "readlink", "python3"):
        (tools / tool).symlink_to(shutil.which(tool, path="/usr/bin:/bin"))
    assert_usage_error(salient("sim", "--no-install", PATH=str(tools)), "missing", "gcc (compiler)", "--no-install")


def test_missing_python_is_reported(salient, tmp_path):
    """Without a Python that is new enough the shell part of the launcher reports it."""
    text = (ROOT / "tools" / "salient").read_text()
    copy = tmp_path / "salient"
    copy.write_text(text.replace("/usr/bin/python3 python3", "/nonexistent/python3"))
    copy.chmod(0o755)
    result = subprocess.run([copy, "sim", "--no-install"], capture_output=True, text=True, env=os.environ)
    assert_usage_error(result, "python3", "python3-venv")
