"""The identity of a drive: version, hash of its DBC, and the tools' reaction to a mismatch."""

from __future__ import annotations

import salient.bench.session
from salient.bench.session import Session
from salient.bus.signals import drive_database
from salient.dbc import database_hash
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
