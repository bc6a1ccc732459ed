"""The identity of a drive: version, hash of its DBC, and the machine that the tools find by it."""

from __future__ import annotations

import argparse
import re
import shutil
import signal
from pathlib import Path

import asammdf
import pytest

from salient.bench import parameter_file, scope
from salient.bench.emulator import EmulatorProcess
from salient.bench.session import Session
from salient.bus import identity
from salient.bus.identity import Carrier, OtherDatabase, machines_of
from salient.bus.log import write_logs
from salient.bus.log_reader import convert
from salient.bus.monitor import monitor, record
from salient.bus.signals import drive_database
from salient.cli import make_parser
from salient.config import DEFAULTS, BenchConfig
from salient.dbc import database_hash
from salient.errors import UsageError
from salient.machine import cache
from salient.machine.content import machine_hash
from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.paths import EXAMPLE_MACHINES, ROOT
from salient.version import VERSION
from salient.view.command import LogFeed


def test_drive_reports_version_and_hash(bench, capsys):
    bench.run_for(0.22)
    parts = [bench.telemetry[f"firmware_{part}"].last for part in ("major", "minor", "patch")]
    assert ".".join(f"{part:g}" for part in parts) == VERSION
    assert bench.telemetry["dbc_hash"].last == database_hash(drive_database())
    assert bench.telemetry["machine_hash"].last == machine_hash(machine_path(bench.machine or DEFAULTS["machine"]))
    assert bench.telemetry.count("DRIVE_IDENTITY") == bench.telemetry.count("DRIVE_MACHINE") == 3
    assert "carries" not in capsys.readouterr().err


def test_identity_is_sent_between_the_slow_frames(bench):
    """Sent 5 ms after the cycles with all other frames, after the four 1 ms frames."""
    bench.run_for(0.11)
    identifiers = {m.frame_id: m.name for m in drive_database().messages}
    sent = [(time_ns, identifiers[m.arbitration_id]) for time_ns, m in bench.log
            if not m.is_extended_id and m.arbitration_id in identifiers]
    at = [i for i, (_, name) in enumerate(sent) if name == "DRIVE_IDENTITY"]
    assert [sent[i][0] // 1_000_000 for i in at] == [5, 105]
    for i in at:
        assert [name for _, name in sent[i - 4 : i]] == [
            "DRIVE_STATUS", "DRIVE_MOTION", "DRIVE_TORQUE", "DRIVE_CURRENTS",
        ]  # fmt: skip


OTHER = str(ROOT / "tests" / "machines" / "largest.toml")
SUPPLY_V = 1000.0
CARRIES = rf"the drive with node number 0 \(firmware {re.escape(VERSION)}\) carries "


@pytest.fixture(autouse=True)
def termination():
    """The commands for a shell take a request to terminate as an interrupt."""
    former = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, former)


@pytest.fixture
def other_drive(tmp_path):
    """The bus of a running drive of a machine that is neither bundled nor of the examples, and whose file has gone."""
    file, can = tmp_path / "own.toml", f"unix:{tmp_path}/can.sock"
    shutil.copy(OTHER, file)
    with EmulatorProcess(BenchConfig(pace="x2", machine=str(file)), can):
        file.unlink()
        yield can


@pytest.fixture
def nothing_kept(monkeypatch, tmp_path):
    """Forgets the machines with which drives have been started."""

    def forget():
        monkeypatch.setattr(cache, "FOLDER", tmp_path / "machines")
        identity._first.cache_clear()

    yield forget
    identity._first.cache_clear()


def supply_V(path: Path) -> float:
    """Last voltage of the DC link in an MF4 file."""
    with asammdf.MDF(path) as file:
        group, index = next(iter(sorted(file.whereis("bus_voltage_V"))))
        return float(file.get(group=group, index=index).samples[-1])


def watch(can: str, machine: str | None) -> int:
    """`tools/salient monitor` for 0.2 s; its exit code."""
    stated = [] if machine is None else ["--machine", machine]
    arguments = ["monitor", "--can", can, "--every-s", "0.05", "--duration-s", "0.2", *stated]
    return monitor(make_parser().parse_args(arguments))


@pytest.mark.in_turns
def test_every_tool_finds_the_machine_of_a_drive(other_drive, tmp_path, capsys):
    assert watch(other_drive, None) == 0
    read_V = {float(text) for text in re.findall(r"DC link +([\d.]+) V", capsys.readouterr().out)}
    assert min(read_V) == max(read_V) == pytest.approx(SUPPLY_V, rel=0.01)
    assert record(other_drive, tmp_path / "x.mf4", 0.15, None) == 0
    assert supply_V(tmp_path / "x.mf4") == pytest.approx(SUPPLY_V, rel=0.01)
    assert record(other_drive, tmp_path / "x.blf", 0.15, None) == 0
    convert(tmp_path / "x.blf", tmp_path / "y.mf4", None)
    assert supply_V(tmp_path / "y.mf4") == pytest.approx(SUPPLY_V, rel=0.01)
    log = LogFeed(tmp_path / "x.blf", Carrier("x.blf", None), 0)
    assert log.info["machine"]["name"] == "largest"
    assert log.info["database_hash"] == database_hash(drive_database(OTHER))
    with Session(other_drive, lockstep=False) as session:
        assert session.telemetry["bus_voltage_V"].last == pytest.approx(SUPPLY_V, rel=0.01)
        assert session.drive.parameters["torque_max_Nm"] == pytest.approx(
            derive(load_machine(OTHER)).parameters["torque_max_Nm"], rel=0.01)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("tool", ["monitor", "log", "convert", "view", "parameters", "scope", "session"])
def test_every_tool_refuses_another_machine_than_stated_in_one_line(other_drive, nothing_kept, tmp_path, tool):
    record(other_drive, tmp_path / "x.blf", 0.15, None)
    options = argparse.Namespace(can=other_drive, machine="saturating", node=0, action="save", list=False,
                                 signals=[], trigger=None, file=tmp_path / "p.toml",
                                 out=tmp_path / "scope", dbc=[])
    runs = {
        "monitor": lambda machine: watch(other_drive, machine),
        "log": lambda machine: record(other_drive, tmp_path / "x.mf4", 0.2, machine),
        "convert": lambda machine: convert(tmp_path / "x.blf", tmp_path / "y.mf4", machine),
        "view": lambda machine: LogFeed(tmp_path / "x.blf", Carrier(str(tmp_path / "x.blf"), machine), 0),
        "parameters": lambda machine: parameter_file.run(argparse.Namespace(**{**vars(options), "machine": machine})),
        "scope": lambda machine: scope.run(argparse.Namespace(**{**vars(options), "machine": machine})),
        "session": lambda machine: Session(other_drive, lockstep=False, machine=machine),
    }
    option = "machine=" if tool == "session" else "--machine"
    with pytest.raises(OtherDatabase, match=rf"{CARRIES}.*largest\.toml.*, not {option} saturating") as refused:
        runs[tool]("saturating")
    assert isinstance(refused.value, UsageError) and "\n" not in str(refused.value)
    nothing_kept()
    with pytest.raises(OtherDatabase, match=rf"{CARRIES}a machine that is not known here.*with {option}$"):
        runs[tool](None)
    assert sorted(path.name for path in tmp_path.glob("*.mf4")) == []
    assert not (tmp_path / "p.toml").exists()


@pytest.fixture(params=["finite_element", "linear_cosine"])
def bundled_drive(request, tmp_path):
    """The bus of a running drive of a bundled machine that has the DBC of the default one; its name."""
    can = f"unix:{tmp_path}/can.sock"
    assert database_hash(drive_database(request.param)) == database_hash(drive_database())
    with EmulatorProcess(BenchConfig(pace="x2", machine=request.param), can):
        yield can, request.param


def test_machines_of_one_database_are_told_apart(bundled_drive, tmp_path, capsys):
    can, name = bundled_drive
    record(can, tmp_path / "x.blf", 0.25, None)
    assert LogFeed(tmp_path / "x.blf", Carrier("x.blf", None), 0).info["machine"]["name"] == name
    with Session(can, lockstep=False) as session:
        assert session.machine == name
    assert capsys.readouterr().err == ""
    LogFeed(tmp_path / "x.blf", Carrier("x.blf", "linear_trapezoid"), 0)
    told = capsys.readouterr().err
    assert re.search(rf"x\.blf: {CARRIES}{name}, not linear_trapezoid", told) and told.count("\n") == 1


def test_a_log_without_the_machine_is_one_of_the_first_with_its_database(bundled_drive, tmp_path, capsys):
    can, _ = bundled_drive
    with Session(can, lockstep=False) as session:
        session.run_for(0.25)
        machine_id = drive_database().get_message_by_name("DRIVE_MACHINE").frame_id
        write_logs([timed for timed in session.log if timed[1].arbitration_id != machine_id], tmp_path / "x.blf")
    assert LogFeed(tmp_path / "x.blf", Carrier("x.blf", None), 0).info["machine"]["name"] == "saturating"
    assert capsys.readouterr().err == ""


def test_the_hash_of_a_machine_is_one_of_its_values(tmp_path):
    file, map_file = tmp_path / "map86.toml", tmp_path / "map86.csv"
    for copy in (file, map_file):
        shutil.copy(EXAMPLE_MACHINES / copy.name, copy)
    text = file.read_text(encoding="utf-8")
    before = machine_hash(file)
    value = re.search(r"^inertia_kg_m2 = .*$", text, re.MULTILINE)[0]
    rewritten = "\ufeff# another comment\n" + text.replace("\n[", "\n\n\n[").replace(" = ", "   =  ")
    file.write_text(rewritten, encoding="utf-8")
    assert machine_hash(file) == before
    file.write_text(text.replace(value, "inertia_kg_m2 = 0.0123"), encoding="utf-8")
    assert machine_hash(file) != before
    file.write_text(text, encoding="utf-8")
    map_file.write_bytes(map_file.read_bytes() + b"\n")
    assert machine_hash(file) != before


def test_a_log_without_an_identity_says_whose_signals_it_has(other_drive, tmp_path, capsys):
    record(other_drive, tmp_path / "x.blf", 0.15, None)
    with Session(other_drive, lockstep=False) as session:
        write_logs([timed for timed in session.log if timed[1].arbitration_id != 1792], tmp_path / "x.blf")
    convert(tmp_path / "x.blf", tmp_path / "y.mf4", None)
    assert "no DRIVE_IDENTITY" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["saturating", *sorted(path.stem for path in EXAMPLE_MACHINES.glob("*.toml"))])
def test_machines_with_a_name_are_known(nothing_kept, name):
    nothing_kept()
    assert next(machines_of(database_hash(drive_database(name)))) == name


def test_a_machine_is_kept_with_its_map(tmp_path, nothing_kept):
    nothing_kept()
    for suffix in ("toml", "csv"):
        shutil.copy(EXAMPLE_MACHINES / f"map86.{suffix}", tmp_path)
    file = tmp_path / "map86.toml"
    file.write_text(file.read_text(encoding="utf-8") + "\n[drive]\nspeed_max_rpm = 3456.0\n", encoding="utf-8")
    reported = database_hash(drive_database(str(file)))
    cache.machine_image(str(file))
    file.unlink()
    (tmp_path / "map86.csv").unlink()
    (found,) = machines_of(reported)
    assert Path(found).is_relative_to(cache.FOLDER) and database_hash(drive_database(found)) == reported


@pytest.mark.parametrize("reference", ["speed_reference_rpm", "torque_reference_Nm"])
def test_references_go_to_a_running_drive_of_any_known_machine(other_drive, reference):
    with Session(other_drive, lockstep=False) as session:
        setattr(session.drive, reference, 10.0)
        session.run_until(lambda: session.drive.state == "run", timeout=600.0)


def test_in_lockstep_references_end_with_the_first_report_of_another_database(make_bench, capsys):
    bench = make_bench(machine=OTHER)
    with Session(bench.address) as session:
        session.drive.speed_reference_rpm = 0.0
        with pytest.raises(OtherDatabase, match=r"carries .*largest\.toml.*machine="):
            session.run_for(0.2)
        assert session.time_s <= 0.12
        session.run_for(0.6)  # no further command is due
        assert session.drive.state in ("ready", "fault")
    assert len(capsys.readouterr().err.splitlines()) == 1
