"""MF4 files: the signals of both DBCs over virtual time, with units, names of states and comments.

A message is a channel group of its name; the signals that a multiplexer selects are groups of their own, because each
has only the frames that carry it.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import can
import numpy as np

from salient.bus.signals import SignalTable, drive_database, rig_database
from salient.errors import UsageError
from salient.machine.file import MachineError

_DEFLATE = 1


class Mf4Log:
    """An MF4 file, written when it is closed; until then 16 bytes of memory for each frame.

    Frames that the DBCs do not define are left out: other identifiers and lengths, remote, error and flexible data rate
    frames.
    """

    def __init__(self, path: Path, machine: str | None, node: int) -> None:
        try:
            import asammdf
        except ImportError:
            raise UsageError(f"--out {path}: MF4 requires the Python package asammdf") from None
        self._mdf: Any = asammdf.MDF(version="4.10")
        self._mdf.start_time = datetime.fromtimestamp(0, UTC)  # virtual time has no date
        self._signal = asammdf.Signal
        try:
            self._databases = (drive_database(machine, node), rig_database(node))
        except MachineError as error:
            raise UsageError(str(error)) from None
        self._tables = tuple(SignalTable(database) for database in self._databases)
        self._path = path
        path.open("wb").close()  # a path that cannot be written is reported before hours of recording

    def write(self, time_ns: int, message: can.Message) -> None:
        for table in self._tables:
            table.add(time_ns, message)

    def close(self) -> None:
        for name, comment, channels in self._groups():
            self._mdf.append(channels, acq_name=name, comment=comment, common_timebase=True)
        self._mdf.save(self._path, overwrite=True, compression=_DEFLATE)
        self._mdf.close()

    def _groups(self) -> Iterator[tuple[str, str, list[Any]]]:
        """Name, comment and channels of each group that has frames."""
        for database, table in zip(self._databases, self._tables, strict=True):
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
