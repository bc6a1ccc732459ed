"""A small part of kills.py: build/venv/bin/python tests/tools/kills.py kills every command, 80 times each."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from kills import KINDS, kill_all, left_of, unreadable_files, wait_until_nothing

from salient.cli import make_parser


def test_every_command_is_killed():
    commands = next(action.choices for action in make_parser()._actions if action.dest == "command")
    assert set(commands) <= {kind.line.split()[0] for kind in KINDS.values() if kind.module == "salient"}


@pytest.mark.in_turns
def test_kills_leave_nothing_and_the_next_start_works(tmp_path: Path, capsys):
    assert kill_all(["sim", "sweep"], tmp_path, instants=1, seed=7, signals=("SIGTERM", "SIGKILL")) == 0
    assert "4 kills of 2 commands" in capsys.readouterr().out


def test_what_is_left_is_found(tmp_path: Path):
    """A process, a file, a socket and a result that cannot be read."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    with subprocess.Popen([sys.executable, "-c", "import signal; print(1, flush=True); signal.pause()"],
                          env={"MARK": tmp_path.name}, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        (temporary / "half").touch()
        (tmp_path / "own.sock").touch()
        (tmp_path / "truth.npy").write_bytes(b"half")
        found = left_of(f"MARK={tmp_path.name}", temporary, tmp_path)
        process.send_signal(signal.SIGKILL)
    assert [line.split()[0] for line in found] == ["process", "file", "socket"]
    assert unreadable_files(tmp_path)[0].startswith(f"unreadable {tmp_path / 'truth.npy'}")
    (temporary / "half").unlink()
    (tmp_path / "own.sock").unlink()
    assert wait_until_nothing(lambda: left_of(f"MARK={tmp_path.name}", temporary, tmp_path)) == []
