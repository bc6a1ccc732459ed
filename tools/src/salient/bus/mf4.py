"""MF4 files: the signals of the databases over virtual time, with units, names of states and comments.

A message is a channel group of its name; the signals that a multiplexer selects are groups of their own, because each
has only the frames that carry it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import can
import numpy as np
from cantools.database.can import Database, Signal

from salient.bus.decoded_log import DecodedLog
from salient.bus.identity import Carrier, hash_of
from salient.bus.signals import SignalTable, is_enumeration
from salient.errors import optional_package

_DEFLATE = 1
_S_NS = 1_000_000_000
_DAY_NS = 86_400 * _S_NS
_DATED_NS = 365 * _DAY_NS
"""Earlier times are those since the start of a drive."""


class Mf4Log(DecodedLog):
    """An MF4 file, written when it is closed; until then 16 bytes of memory for each frame. Its comment names the
    machine."""

    def __init__(self, path: Path, carrier: Carrier, node: int, source: str, others: Sequence[Database] = ()) -> None:
        super().__init__(path, carrier, node, source, others)
        asammdf = optional_package("asammdf", f"--out {path}: MF4")
        self._mdf: Any = asammdf.MDF(version="4.10")
        self._signal = asammdf.Signal
        self._start_ns: int | None = None
        path.open("wb").close()  # a path that cannot be written is reported before hours of recording

    def write(self, time_ns: int, message: can.Message) -> None:
        if self._start_ns is None:  # virtual time has no date; as floats, times since 1970 lose 256 ns
            self._start_ns = time_ns // _DAY_NS * _DAY_NS if time_ns >= _DATED_NS else 0
        self._take(time_ns - self._start_ns, message)

    @property
    def size(self) -> int:
        return self._waiting_bytes

    def _write_kept(self) -> None:
        self._mdf.header.start_time = datetime.fromtimestamp((self._start_ns or 0) // _S_NS, UTC)
        machine = self._carrier.likely
        self._mdf.header.comment = f"machine {machine}, DBC {hash_of(machine):08x}"
        for name, comment, channels in self._groups(machine):
            self._mdf.append(channels, acq_name=name, comment=comment, common_timebase=True)
        self._mdf.save(self.path, overwrite=True, compression=_DEFLATE)

    def _finish(self) -> None:
        self._mdf.close()

    def _groups(self, machine: str) -> Iterator[tuple[str, str, list[Any]]]:
        """Name, comment and channels of each group that has frames."""
        for database, table in zip(self._databases(machine), self._tables, strict=True):
            table.decode_with(database)
            for message in sorted(database.messages, key=lambda m: m.frame_id):
                by_selector = sorted(message.signals, key=_selection)
                for _, signals in groupby(by_selector, key=_selection):
                    channels = [self._channel(table, message.name, signal) for signal in signals]
                    if len(channels[0]):
                        yield message.name, message.comment or "", channels

    def _channel(self, table: SignalTable, message: str, definition: Any) -> Any:
        signal = table[f"{message}.{definition.name}"]
        conversion: dict[str, object] | None = None
        samples = signal.value
        if signal.choices and is_enumeration(definition):
            conversion = names_conversion(signal.choices)
            samples = samples.astype(np.int64)
        return self._signal(samples, signal.time_s, unit=signal.unit, name=signal.name, conversion=conversion,
                            comment=definition.comment or "")


def names_conversion(names: Mapping[int, str] | Mapping[float, str]) -> dict[str, object]:
    """asammdf's conversion of numbers to names."""
    conversion: dict[str, object] = {"default": b""}
    for index, (number, text) in enumerate(names.items()):
        conversion |= {f"val_{index}": int(number), f"text_{index}": text.encode()}
    return conversion


def _selection(signal: Signal) -> tuple[str, list[int]]:
    """Condition under which a frame carries a signal: multiplexer and its values."""
    return signal.multiplexer_signal or "", signal.multiplexer_ids or []
