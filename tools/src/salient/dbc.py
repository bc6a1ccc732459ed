"""CAN databases: the attributes (BA_) of their messages and signals, and a hash. The drive sends
the hash of its database, so that tools notice a different one."""

from __future__ import annotations

import json
import zlib
from typing import Any

from cantools.database.can.database import Database
from cantools.database.can.message import Message
from cantools.database.can.signal import Signal


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
    return zlib.crc32(json.dumps(messages, separators=(",", ":")).encode())


def _normal(signal: Signal) -> list[object]:
    numbers = [None if x is None else float(x) for x in (signal.scale, signal.offset, signal.minimum, signal.maximum)]
    choices = sorted((int(number), str(text)) for number, text in (signal.choices or {}).items())
    return [
        signal.name, signal.start, signal.length, signal.byte_order, signal.is_signed, signal.is_float,
        signal.is_multiplexer, signal.multiplexer_ids or [], repr(numbers), signal.unit or "", choices,
    ]  # fmt: skip
