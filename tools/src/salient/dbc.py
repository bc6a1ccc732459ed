"""CAN databases: the attributes (BA_) of their messages and signals, and a hash. The drive sends
the hash of its database, so that tools notice a different one."""

from __future__ import annotations

import json
import re
import zlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # importing cantools takes longer than the rest of the first start of a machine file
    from cantools.database.can.database import Database
    from cantools.database.can.message import Message
    from cantools.database.can.signal import Signal

_MESSAGE = re.compile(r"BO_ (\d+) (\w+): (\d+) (\w+)")
_SIGNAL = re.compile(r' SG_ (\w+) : (\d+)\|(\d+)@1([+-]) \(([^,]+),([^)]+)\) \[([^|]+)\|([^]]+)\] "([^"]*)" ')
_CHOICES = re.compile(r"VAL_ (\d+) (\w+) (.*);")
_CHOICE = re.compile(r'(\d+) "([^"]*)"')


def attributes(owner: Message | Signal) -> dict[str, Any]:
    """Values of the attributes that the database sets, by name."""
    if owner.dbc is None:
        return {}
    return {name: attribute.value for name, attribute in owner.dbc.attributes.items()}


def database_hash(database: Database) -> int:
    """CRC-32 of the messages and signals in normal form: sorted, without comments, attributes and layout of the file.

    Two databases of equal hash decode every frame to the same names, values and units.
    """
    messages = [
        [m.frame_id, m.is_extended_frame, m.name, m.length, sorted(m.senders), sorted(map(_normal, m.signals))]
        for m in sorted(database.messages, key=lambda m: (m.frame_id, m.is_extended_frame))
    ]
    return _hash(messages)


def text_hash(text: str) -> int:
    """database_hash of a DBC file like the drive's, from its text: no extended identifiers, multiplexers, floats or
    big-endian signals. ValueError for a line of another kind."""
    messages: list[list[Any]] = []
    choices = {(int(found[1]), found[2]): sorted((int(number), name) for number, name in _CHOICE.findall(found[3]))
               for found in map(_CHOICES.fullmatch, text.splitlines()) if found}
    for line in text.splitlines():
        if (found := _MESSAGE.fullmatch(line)) and int(found[1]) < 2**11:
            messages.append([int(found[1]), False, found[2], int(found[3]), [found[4]], []])
        elif found := _SIGNAL.match(line):
            name, start, length, sign, *numbers, unit = found.groups()
            messages[-1][5].append([
                name, int(start), int(length), "little_endian", sign == "-", False, False, [],
                repr([float(number) for number in numbers]), unit, choices.get((messages[-1][0], name), []),
            ])  # fmt: skip
        elif line.startswith(("BO_ ", " SG_ ", "SIG_VALTYPE_", "BO_TX_BU_", "SG_MUL_VAL_")):
            raise ValueError(f"a CAN database with lines that its hash does not cover: {line}")
    return _hash([[*head, sorted(signals)] for *head, signals in sorted(messages)])


def _hash(messages: list[list[Any]]) -> int:
    return zlib.crc32(json.dumps(messages, separators=(",", ":")).encode())


def _normal(signal: Signal) -> list[object]:
    numbers = [None if x is None else float(x) for x in (signal.scale, signal.offset, signal.minimum, signal.maximum)]
    choices = sorted((int(number), str(text)) for number, text in (signal.choices or {}).items())
    return [
        signal.name, signal.start, signal.length, signal.byte_order, signal.is_signed, signal.is_float,
        signal.is_multiplexer, signal.multiplexer_ids or [], repr(numbers), signal.unit or "", choices,
    ]  # fmt: skip
