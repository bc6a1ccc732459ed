"""CAN databases: the attributes (BA_) of their messages and signals, the databases of other node numbers, and a hash.
The drive sends the hash of the database of node 0, so that tools notice a different one."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can.database import Database
from cantools.database.can.message import Message
from cantools.database.can.signal import Signal


@lru_cache
def load_database(path: Path) -> Database:
    """A DBC file, loaded once."""
    database = cantools.database.load_file(path, strict=True)
    assert isinstance(database, Database)  # as every DBC gives
    return database


def attributes(owner: Message | Signal) -> dict[str, Any]:
    """Values of the attributes that the database sets, by name."""
    if owner.dbc is None:
        return {}
    return {name: attribute.value for name, attribute in owner.dbc.attributes.items()}


def phases_above(message: Message) -> int:
    """Only a machine of more phases than these has the message (attribute PhasesAbove); 0: every machine."""
    return int(attributes(message).get("PhasesAbove", 0))


PHASES = ("a", "b", "c", "d", "e", "f")
"""Names of the phases, of which a machine has the first three to all (HAL_PHASES_MAX of the host in hal/hal.h)."""
PHASES_MIN, PHASES_MAX = 3, len(PHASES)
"""With fewer there is an angle at which no phase has a torque in the wanted direction."""
FIRST_PHASES = 4
"""Phases that every drive's messages, and an image for a board unless stated, have room for."""
_PHASES_ABOVE = re.compile(r'^BA_ "PhasesAbove" BO_ (\d+) (\d+);', re.MULTILINE)


def drive_dbc_of_phases(text: str, phases: int) -> str:
    """The DBC of a drive of a machine with this number of phases: without the messages of machines of more."""
    for identifier, above in _PHASES_ABOVE.findall(text):
        if phases <= int(above):
            text = re.sub(rf"^BO_ {identifier} .*\n(?: SG_ .*\n)*\n?", "", text, flags=re.MULTILINE)
            text = re.sub(rf'^(?:(?:CM_|BA_ "\w+") (?:BO_|SG_)|VAL_) {identifier} .*\n', "", text, flags=re.MULTILINE)
    return text


NODE_STEP = 16
"""From the identifiers and data IDs of a drive to the next node number's (firmware/comms/node.h)."""
RIG_NODE_STEP = 0x100
"""Likewise of the test bench (TRANSPORT_NODE_SHIFT of emulator/rig/transport_frame.h)."""
RIG_OF_ALL = ("RIG_RUN_UNTIL", "RIG_CLOCK", "RIG_STAMP")
"""Messages of the test bench that all drives of a bus share: time."""
_STATEMENT = re.compile(r'^(BO_|(?:CM_|BA_ "\w+") (?:BO_|SG_)|VAL_|SIG_VALTYPE_|SG_MUL_VAL_) (\d+) ', re.MULTILINE)
_DATA_ID = re.compile(r'^(BA_ "E2EDataId" BO_ \d+) (\d+);', re.MULTILINE)
_NODE = re.compile(r'^(CM_ BU_ DRIVE "The drive with node number) 0\b[^"]*', re.MULTILINE)


def drive_dbc_of_node(text: str, node: int) -> str:
    """The DBC of a drive with another node number, from the DBC of node 0."""
    if node == 0:
        return text
    text = _NODE.sub(rf"\g<1> {node}.", text)
    text = _DATA_ID.sub(lambda m: f"{m[1]} {int(m[2]) + NODE_STEP * node};", text)
    return _with_identifiers(text, lambda identifier: identifier + NODE_STEP * node)


def rig_dbc_of_node(text: str, node: int) -> str:
    """The DBC of the test bench of a drive with another node number, from the DBC of node 0."""
    shared = {int(number) for number, name in re.findall(r"^BO_ (\d+) (\w+):", text, re.MULTILINE)
              if name in RIG_OF_ALL}
    return _with_identifiers(text, lambda number: number + (0 if number in shared else RIG_NODE_STEP * node))


def _with_identifiers(text: str, change: Callable[[int], int]) -> str:
    return _STATEMENT.sub(lambda m: f"{m[1]} {change(int(m[2]))} ", text)


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
