"""Lines of signals that are chosen by name, of drive, test bench and other nodes."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import can
import cantools
from cantools.database.can import Database

from salient.bus.signals import BusSignals, Signal, SignalTable, is_enumeration, near_signals, raw_range
from salient.errors import UsageError

_DECIMALS_MAX = 4
_UNKNOWN = "-"
_INDENT = " " * 12  # of a time


@dataclass
class _Column:
    """One signal: MESSAGE.SIGNAL, the name by which it was chosen, and the text of its latest value."""

    full_name: str
    title: str
    table: int
    definition: cantools.database.can.Signal
    text: str = _UNKNOWN

    def show(self, signal: Signal) -> None:
        """Takes over the latest value, if there is one."""
        if len(signal):
            number = _number(self.definition, signal.last)
            self.text = signal.name_of(signal.last, number)

    def cell(self) -> str:
        """Name, value of constant width, and unit."""
        return f"{self.title} {self.text:>{_width(self.definition)}} {self.definition.unit or ''}".rstrip()


class SelectedSignals:
    """The latest values of signals of some databases, filled frame by frame; a slow signal keeps its value."""

    def __init__(self, databases: Sequence[Database], names: Sequence[str], width: int,
                 others: Sequence[Database] = ()) -> None:
        """names: MESSAGE.SIGNAL, or SIGNAL where one message has it, or MESSAGE for all its signals; UsageError: none
        or several do. width: characters of a line, after which it continues on the next. others: of other nodes."""
        self._width = width
        self._columns = _columns((*databases, *others), names)
        self._tables = [*map(SignalTable, databases), *map(BusSignals, others)]

    def add(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame."""
        for table in self._tables:
            table.add(time_ns, message)

    def line(self, time_ns: int) -> str:
        """The values at a time, on as many lines as they need."""
        for column in self._columns:
            column.show(self._tables[column.table][column.full_name])
        for table in self._tables:
            table.clear()
        lines = [f"{time_ns * 1e-9:10.4f} s"]
        for cell in (column.cell() for column in self._columns):
            if len(lines[-1]) + 2 + len(cell) > self._width and len(lines[-1]) > len(_INDENT):
                lines.append(_INDENT)
            lines[-1] += f"  {cell}"
        return "\n".join(lines)


def _columns(databases: Sequence[Database], names: Sequence[str]) -> list[_Column]:
    known = {f"{message.name}.{signal.name}": (table, signal)
             for table, database in enumerate(databases)
             for message in sorted(database.messages, key=lambda m: m.frame_id) for signal in message.signals}
    return [_Column(full_name, full_name if full_name.partition(".")[0] == name else name, *known[full_name])
            for name in names for full_name in _resolve(name, known)]


def _resolve(name: str, known: Collection[str]) -> list[str]:
    """The MESSAGE.SIGNAL that a name means, or all of a message."""
    if of_message := [full_name for full_name in known if full_name.partition(".")[0] == name]:
        return of_message
    found = [full_name for full_name in known if name in (full_name, full_name.partition(".")[2])]
    if len(found) == 1:
        return found
    if found:
        raise UsageError(f"--signals {name}: in several messages: {', '.join(found)}")
    raise UsageError(f"--signals {name}: no such signal; {near_signals(name, known)}")


def _number(definition: cantools.database.can.Signal, value: float) -> str:
    return f"{value:.6g}" if definition.is_float else f"{value:.{_decimals(definition)}f}"


def _decimals(definition: cantools.database.can.Signal) -> int:
    """Decimals of the least significant bit."""
    scale = abs(float(definition.scale)) or 1.0
    return min(_DECIMALS_MAX, max(0, math.ceil(-math.log10(scale) - 1e-9)))


def _width(definition: cantools.database.can.Signal) -> int:
    """Characters of the widest value that the signal can have."""
    if definition.choices and is_enumeration(definition):
        return max(len(str(text)) for text in definition.choices.values())
    if definition.is_float:
        return len("-1.23457e-05")
    raw = raw_range(definition)
    offset, scale = float(definition.offset), float(definition.scale)
    limits = (definition.minimum, definition.maximum)
    if None in limits or limits[0] == limits[1]:
        limits = (raw[0] * scale + offset, raw[1] * scale + offset)
    return max(len(_number(definition, float(limit))) for limit in limits if limit is not None)
