"""The identity of a drive: version, hash of its DBC, and the tools' reaction to a mismatch."""

from __future__ import annotations

import pytest

import salient.bench.session
from salient.bench.drive import OtherDatabase
from salient.bench.emulator import EmulatorProcess
from salient.bench.session import Session
from salient.bus.signals import drive_database
from salient.config import BenchConfig
from salient.dbc import database_hash
from salient.errors import UsageError
from salient.paths import ROOT
from salient.version import VERSION


def test_drive_reports_version_and_hash(bench, capsys):
    bench.run_for(0.22)
    parts = [bench.telemetry[f"firmware_{part}"].last for part in ("major", "minor", "patch")]
    assert ".".join(f"{part:g}" for part in parts) == VERSION
    assert bench.telemetry["dbc_hash"].last == database_hash(drive_database())
    assert bench.telemetry.count("DRIVE_IDENTITY") == 3
    assert "drive.dbc" not in capsys.readouterr().err


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


def test_session_reports_a_mismatched_dbc_once(bench, capsys, monkeypatch):
    monkeypatch.setattr(salient.bench.session, "database_hash", lambda database: 0x12345678)
    with Session(bench.address) as session:
        session.run_for(0.3)
    lines = [line for line in capsys.readouterr().err.splitlines() if "drive.dbc" in line]
    assert len(lines) == 1
    assert f"firmware {VERSION} was built from another drive.dbc" in lines[0]
    assert "here 12345678" in lines[0]


OTHER = str(ROOT / "tests" / "machines" / "largest.toml")


@pytest.mark.parametrize("reference", ["speed_reference_rpm", "torque_reference_Nm"])
def test_no_reference_goes_to_a_running_drive_of_another_database(tmp_path, reference):
    can = f"unix:{tmp_path}/can.sock"
    with EmulatorProcess(BenchConfig(pace="x2", machine=OTHER), can), Session(can, lockstep=False) as session:
        with pytest.raises(OtherDatabase, match=r"^unix:\S+: firmware \S+ was built from another drive") as refused:
            setattr(session.drive, reference, 10.0)
        assert isinstance(refused.value, UsageError) and "\n" not in str(refused.value)
        session.run_for(0.2)
        assert session.drive.state == "ready"
        assert session.telemetry["command_accepted"].last == 0
        session.drive.off()  # has no scaling
        session.run_until(lambda: session.telemetry["command_accepted"].last > 0, timeout=600.0)
        assert session.drive.state == "ready"


def test_references_go_to_a_running_drive_of_the_same_database(tmp_path):
    can = f"unix:{tmp_path}/can.sock"
    config = BenchConfig(pace="x2", machine=OTHER)
    with EmulatorProcess(config, can), Session(can, lockstep=False, machine=OTHER) as session:
        session.drive.speed_reference_rpm = 10.0
        session.run_until(lambda: session.drive.state == "run", timeout=600.0)


def test_in_lockstep_references_end_with_the_first_report_of_another_database(make_bench):
    bench = make_bench(machine=OTHER)
    with Session(bench.address) as session:
        session.drive.speed_reference_rpm = 0.0
        with pytest.raises(OtherDatabase):
            session.run_for(0.2)
        assert session.time_s <= 0.12
        session.run_for(0.6)  # no further command is due
        assert session.drive.state in ("ready", "fault")
