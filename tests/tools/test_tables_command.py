"""tools/salient tables: the tables of a machine file for a running drive, or in a file."""

from __future__ import annotations

import sys

import pytest

from salient.__main__ import main
from salient.bench.emulator import EmulatorProcess
from salient.bench.session import SILENCE_MAX_S, Session
from salient.bench.tables import tables_of
from salient.config import BenchConfig
from salient.machine.image import TABLES

OTHER = "linear_cosine"


def emulated(tmp_path, **options):
    """A drive that has its own time, and its address."""
    address = f"unix:{tmp_path}/can.sock"
    return EmulatorProcess(BenchConfig(pace="x0.3", **options), address), address


def carried(address: str) -> str | None:
    """The machine that the drive reports."""
    with Session(address, lockstep=False, silence_max_s=SILENCE_MAX_S) as session:
        return session.machine


@pytest.fixture
def command(monkeypatch):
    """The command with its arguments; its exit code."""
    def run(*arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["salient", "tables", *map(str, arguments)])
        return main()

    return run


def only_line(capsys) -> str:
    """The one line of a command that has failed."""
    line, = [line for line in capsys.readouterr().err.splitlines() if "/20 tables" not in line]
    return line.removeprefix("salient: ")


def test_tables_are_written_to_a_running_drive_whose_next_start_has_them(tmp_path, command, capsys):
    memory = tmp_path / "memory.bin"
    drive, address = emulated(tmp_path, memory=memory)
    with drive:
        assert command(OTHER, "--can", address) == 0
        assert f"tables written: from its next start on the drive is that of {OTHER}" in capsys.readouterr().out
        assert carried(address) == "saturating"
        assert command("fan12", "--can", address) == 2
        assert only_line(capsys) == ("fan12: current range of the sensors 10: 80 in the drive, whose machine is "
                                     "saturating: tables change the motor, not the board")
    drive, address = emulated(tmp_path, memory=memory)
    with drive:
        assert carried(address) == OTHER


def test_a_drive_without_a_memory_is_named_in_one_line(tmp_path, command, capsys):
    drive, address = emulated(tmp_path)
    with drive:
        assert command(OTHER, "--can", address) == 1
        assert only_line(capsys).startswith("the drive has tables of its own alone")


def test_tables_in_a_file_are_those_that_a_drive_has_in_its_memory(tmp_path, command, capsys):
    file = tmp_path / "tables.bin"
    assert command(OTHER, "--out", file) == 0
    assert file.read_bytes() == tables_of(OTHER)
    assert len(file.read_bytes()) == TABLES.offsets[-1]
    assert capsys.readouterr().out == f"{TABLES.offsets[-1]} bytes for the address 0x40000000: {file}\n"


@pytest.mark.parametrize(("arguments", "text"), [
    (["nowhere"], "machine 'nowhere': no such file"),
    (["nowhere.toml"], "nowhere.toml"),
    ([OTHER, "--out", "/proc/none/tables.bin"], "--out /proc/none/tables.bin: "),
    ([OTHER, "--can", "unix:/tmp/no-drive-here.sock"], "unix:/tmp/no-drive-here.sock"),
])
def test_mistake_is_one_line_and_exit_code_2(command, capsys, arguments, text):
    assert command(*arguments) == 2
    assert text in only_line(capsys)
