"""MF4 files: the signals of both DBCs over virtual time, with units, names of states and comments.

A message is a channel group of its name; the signals that a multiplexer selects are groups of their own, because each
has only the frames that carry it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import can
import numpy as np
from cantools.database.can import Database

from salient.bus.file_log import FileLog
from salient.bus.identity import Carrier, OtherDatabase, hash_of
from salient.bus.signals import SignalTable, drive_database, rig_database
from salient.errors import UsageError

_DEFLATE = 1
_S_NS = 1_000_000_000
_DAY_NS = 86_400 * _S_NS
_DATED_NS = 365 * _DAY_NS
"""Earlier times are those since the start of a drive."""
_FRAME_BYTES = 16


class Mf4Log(FileLog):
    """An MF4 file, written when it is closed; until then 16 bytes of memory for each frame. Its comment names the
    machine.

    write raises OtherDatabase, as Carrier does: with the first report of another machine than the one that is stated,
    or of an unknown one, and then there is no file; or when the drive becomes another one, and the file ends there.

    Frames that the DBCs do not define are left out: other identifiers and lengths, remote, error and flexible data rate
    frames.
    """

    def __init__(self, path: Path, carrier: Carrier, node: int, source: str) -> None:
        super().__init__(path)
        try:
            import asammdf
        except ImportError:
            raise UsageError(f"--out {path}: MF4 requires the Python package asammdf "
                             "(pip install asammdf)") from None
        self._mdf: Any = asammdf.MDF(version="4.10")
        self._signal = asammdf.Signal
        self._carrier, self._node = carrier, node
        self._frames = tuple(SignalTable(database) for database in self._databases(None))
        self._source = source
        self._start_ns: int | None = None
        path.open("wb").close()  # a path that cannot be written is reported before hours of recording

    _refused = _closed = False

    def _databases(self, machine: str | None) -> tuple[Database, Database]:
        return drive_database(machine, self._node), rig_database(self._node)

    def write(self, time_ns: int, message: can.Message) -> None:
        try:
            self._carrier.take(message)
        except OtherDatabase:
            if self._carrier.machine is None:
                self.path.unlink(missing_ok=True)
                self._refused = True
            raise
        if self._start_ns is None:  # virtual time has no date; as floats, times since 1970 lose 256 ns
            self._start_ns = time_ns // _DAY_NS * _DAY_NS if time_ns >= _DATED_NS else 0
        for table in self._frames:
            table.add(time_ns - self._start_ns, message)

    @property
    def size(self) -> int:
        return _FRAME_BYTES * sum(map(SignalTable.frames, self._frames))

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if self._refused:
            self._mdf.close()
            return
        self._mdf.header.start_time = datetime.fromtimestamp((self._start_ns or 0) // _S_NS, UTC)
        machine = self._carrier.likely
        if self._carrier.machine is None and len(self._frames[0]["DRIVE_STATUS.state"]):
            print(f"salient: {self._source}: no DRIVE_IDENTITY: {self.path} has the signals of {machine}; "
                  "--machine states another", file=sys.stderr)
        self._mdf.header.comment = f"machine {machine}, DBC {hash_of(machine):08x}"
        for name, comment, channels in self._groups(machine):
            self._mdf.append(channels, acq_name=name, comment=comment, common_timebase=True)
        self._mdf.save(self.path, overwrite=True, compression=_DEFLATE)
        self._mdf.close()

    def _groups(self, machine: str) -> Iterator[tuple[str, str, list[Any]]]:
        """Name, comment and channels of each group that has frames."""
        for database, table in zip(self._databases(machine), self._frames, strict=True):
            table.decode_with(database)
            for message in sorted(database.messages, key=lambda m: m.frame_id):
                by_selector = sorted(message.signals, key=lambda signal: signal.multiplexer_ids or [])
                for _, signals in groupby(by_selector, key=lambda signal: signal.multiplexer_ids):
                    channels = [self._channel(table, message.name, signal) for signal in signals]
                    if len(channels[0]):
                        yield message.name, message.comment or "", channels

    def _channel(self, table: SignalTable, message: str, definition: Any) -> Any:
        signal = table[f"{message}.{definition.name}"]
        conversion: dict[str, object] | None = None
        if signal.choices:
            conversion = {"default": b""}
            for index, (number, text) in enumerate(signal.choices.items()):
                conversion |= {f"val_{index}": number, f"text_{index}": text.encode()}
        samples = signal.value.astype(np.int64) if signal.choices else signal.value
        return self._signal(samples, signal.time_s, unit=signal.unit, name=signal.name, conversion=conversion,
                            comment=definition.comment or "")
