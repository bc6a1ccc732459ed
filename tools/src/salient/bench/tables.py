"""Machine tables for a running drive, over CAN: `tools/salient tables`. From its next start on the drive has another
machine, without another program (firmware/storage/table_store.h).

They are programmed by XCP (firmware/comms/xcp_program.h), so that any calibration tool that programs memories does it,
too; `--out` writes the bytes for one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from salient.bench.sampler import program_of
from salient.bench.session import SILENCE_MAX_S, Session
from salient.bench.xcp import AREA_TABLES, XcpError, connected, load_client
from salient.drive_layout import Layout, layout_file
from salient.errors import UsageError
from salient.machine.cache import machine_image
from salient.machine.image import HEADER, TABLES
from salient.machine.path import machine_path
from salient.paths import write_whole
from salient.progress import Progress, steps_of

if TYPE_CHECKING:
    from pyxcp.master.master import Master

    from salient.machine.drive_data import DriveData

PROGRAM_BYTES = 6
"""Data of a command, behind its code and count."""
_ABSOLUTE = 0
_OF_THE_BOARD: dict[str, Callable[[DriveData], float]] = {
    "current range of the sensors": lambda data: data.adc_current_A,
    "voltage range of the sensor": lambda data: data.adc_voltage_V,
    "current trip of the comparators": lambda data: data.comparator_trip_A,
    "encoder_bits": lambda data: data.encoder_bits,
    "control_rate_hz": lambda data: data.control_rate_hz,
}  # fmt: skip
"""Facts of a machine file that the program of a board has, which tables do not change."""


def run(options: argparse.Namespace) -> int:
    """Writes the tables, to a file or to a drive; the exit code. UsageError: a mistake in the file or the options, or a
    file of another board; RunFailed: the drive does not take them. Then it has those that it had."""
    tables = tables_of(options.file)
    if options.out is not None:
        try:
            write_whole(options.out, tables)
        except OSError as error:
            raise UsageError(f"--out {options.out}: {error.strerror}") from None
        print(f"{len(tables)} bytes for the address {AREA_TABLES:#x}: {options.out}")
        return 0
    load_client()
    with Session(options.can, lockstep=False, machine=options.machine, node=options.node,
                 silence_max_s=SILENCE_MAX_S, machine_option="--machine") as session:
        check_board(session.machine, options.file)
        write(session, tables)
    print(f"{len(tables)} bytes of tables written: from its next start on the drive is that of {options.file}")
    return 0


def tables_of(file: str) -> bytes:
    """The tables of a machine by name or file as a program has them in memory. UsageError: a mistake in the file."""
    image = machine_image(str(machine_path(file))).read_bytes()
    return TABLES.in_memory(image[HEADER.size:HEADER.size + TABLES.size])


def check_board(present: str | None, file: str) -> None:
    """UsageError when a machine file has another board than the machine that the drive carries."""
    from salient.machine.drive_data import derive
    from salient.machine.file import load_machine

    if present is None:
        return
    given, carried = (derive(load_machine(str(machine_path(name)))) for name in (file, present))
    for name, fact in _OF_THE_BOARD.items():
        ours, theirs = fact(given), fact(carried)
        if ours != theirs:
            raise UsageError(f"{file}: {name} {ours:g}: {theirs:g} in the drive, whose machine is {present}: tables "
                             "change the motor, not the board")


def write(session: Session, tables: bytes) -> None:
    """Programs the tables into the memory of the session's drive. RunFailed: the drive takes none, runs, or has other
    sources than these tools; it keeps the tables that it has."""
    with connected(session) as master:
        _check_sources(master)
        _require_programming(session, master)
        master.programStart()
        master.setMta(AREA_TABLES)
        master.programClear(_ABSOLUTE, len(tables))
        parts = [tables[at:at + PROGRAM_BYTES] for at in range(0, len(tables), PROGRAM_BYTES)]
        with Progress(steps_of(len(parts), sys.stderr), sys.stderr, items=len(parts)) as progress:
            for part in parts:
                master.program(part, len(part), last=True)
                progress.item("tables")
        master.program(b"", 0, last=True)


def read(session: Session) -> bytes:
    """The tables in effect."""
    with connected(session) as master:
        _check_sources(master)
        master.setMta(AREA_TABLES)
        return bytes(master.fetch(TABLES.offsets[-1]))


def _check_sources(master: Master) -> None:
    """XcpError: the drive's program is of other headers than these tools, whatever its processor is."""
    text, own = program_of(master), Layout(layout_file()).hash
    if text[7:15] != f"{own:08x}":
        raise XcpError(f"the drive ({text}) is of other sources than these tools ({own:08x}): its tables have another "
                       "layout")


def _require_programming(session: Session, master: Master) -> None:
    if session.drive.state == "run":
        raise XcpError("the drive runs: it takes tables at rest")
    if not master.slaveProperties.supportsPgm:
        raise XcpError("the drive has tables of its own alone: built without tables at run time, or emulated without "
                       "--memory")
