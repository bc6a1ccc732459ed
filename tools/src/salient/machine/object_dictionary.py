"""The object dictionary of the drive as a CANopen device: firmware/comms/objects.toml and the parameters."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from salient.machine.parameter_table import read_table
from salient.paths import OBJECTS

TYPES = {"i8": 2, "i16": 3, "i32": 4, "u8": 5, "u16": 6, "u32": 7, "string": 9, "domain": 15}
"""Types of CiA 301 by their name in the file."""
BITS = {"i8": 8, "i16": 16, "i32": 32, "u8": 8, "u16": 16, "u32": 32}
KINDS = ("var", "array", "record")
ACCESS = ("const", "ro", "rw")
RESETS = ("communication", "node")
PARAMETER_BASE = 0x2000
"""Index of the first parameter."""
PARAMETER = "PARAMETER"
"""Value of `source` of a parameter's object."""
_KEY = re.compile(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?")
_FIELDS = {"name", "kind", "type", "access", "pdo", "initial", "from", "value", "reset", "minimum", "maximum", "text",
           "instances", "count", "string"}


class DictionaryError(Exception):
    """A row of the file is wrong; the message names it."""


def type_range(of: str) -> tuple[int, int]:
    """Least and largest value of a type of a number."""
    bits = BITS[of]
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if of.startswith("i") else (0, (1 << bits) - 1)


@dataclass(frozen=True)
class Entry:
    """An entry: `count` sub-indices from `sub` on of `instances` indices from `index` on. source: CANOPEN_FROM_*, ""
    for a variable or a constant; value: CANOPEN_VALUE_*, "" for others. minimum, maximum: of what can be written."""

    index: int
    sub: int
    name: str
    type: str
    access: str
    pdo: str
    initial: int
    source: str
    value: str
    reset: str
    minimum: int
    maximum: int
    text: str
    instances: int
    count: int
    string: str

    @property
    def key(self) -> str:
        """Index and sub-index as in CiA 301."""
        return f"{self.index:04X}:{self.sub:02X}"


@dataclass(frozen=True)
class Object:
    """An index with its entries."""

    index: int
    name: str
    kind: str
    instances: int
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class Dictionary:
    """The objects by ascending index, without the parameters; device: numbers of [device]; error_codes: code of each
    fault by its name in drive.dbc."""

    objects: tuple[Object, ...]
    device: dict[str, int]
    error_codes: dict[str, int]

    def entries(self) -> list[Entry]:
        """All entries by index and sub-index."""
        return [entry for each in self.objects for entry in each.entries]


@lru_cache
def read_dictionary() -> Dictionary:
    """The file; DictionaryError names a row that is wrong."""
    content = tomllib.loads(OBJECTS.read_text(encoding="utf-8"))
    rows: dict[int, dict[int | None, dict[str, Any]]] = {}
    for key, row in content["objects"].items():
        match = _KEY.fullmatch(key)
        if match is None:
            raise DictionaryError(f"{OBJECTS.name}: {key} is not an index, as 1018 or 1018sub1")
        if unknown := set(row) - _FIELDS:
            raise DictionaryError(f"{OBJECTS.name}: {key}: {unknown.pop()} is not known")
        rows.setdefault(int(match[1], 16), {})[int(match[2], 16) if match[2] else None] = row
    objects = tuple(_object(index, rows[index]) for index in sorted(rows))
    return Dictionary(objects, content["device"], content["error_codes"])


def _object(index: int, rows: dict[int | None, dict[str, Any]]) -> Object:
    head = rows.pop(None, None)
    if head is None:
        raise DictionaryError(f"{OBJECTS.name}: {index:04X} has sub-indices and no name")
    kind = head.get("kind", "var")
    if kind not in KINDS or (kind == "var") == bool(rows):
        raise DictionaryError(f"{OBJECTS.name}: {index:04X}: kind {kind} does not fit its sub-indices")
    instances = head.get("instances", 1)
    entries = (_entry(index, 0, head, instances),) if kind == "var" else tuple(
        _entry(index, sub, rows[sub], instances) for sub in sorted(key for key in rows if key is not None))
    return Object(index, head["name"], kind, instances, entries)


def _entry(index: int, sub: int, row: dict[str, Any], instances: int) -> Entry:
    where = f"{OBJECTS.name}: {index:04X}:{sub:02X}"
    kind, access = row.get("type", ""), row.get("access", "")
    if kind not in TYPES or access not in ACCESS or ("reset" in row and row["reset"] not in RESETS):
        raise DictionaryError(f"{where}: type, access or reset is not known")
    if ("value" in row) != ("reset" in row) or ("value" in row and "from" in row):
        raise DictionaryError(f"{where}: a variable has value and reset, and no from")
    fixed = access == "const" or (access == "rw" and row.get("minimum") == row.get("maximum") == row.get("initial"))
    if not ({"value", "from", "string"} & set(row) or fixed):
        raise DictionaryError(f"{where}: has neither value nor from nor a constant")
    low, high = type_range(kind) if kind in BITS else (0, 0)
    minimum, maximum = row.get("minimum", low), row.get("maximum", high)
    initial = row.get("initial", 0)
    if kind in BITS and not low <= minimum <= maximum <= high:
        raise DictionaryError(f"{where}: limits are out of order or beyond {kind}")
    if kind in BITS and not low <= initial <= high:
        raise DictionaryError(f"{where}: initial {initial} is beyond {kind}")
    return Entry(index, sub, row["name"], kind, access, row.get("pdo", ""), initial, row.get("from", ""),
                 row.get("value", ""), row.get("reset", ""), minimum, maximum, row.get("text", ""), instances,
                 row.get("count", 1), row.get("string", ""))


def parameter_entries() -> list[Entry]:
    """The objects of the parameters, in raw values."""
    return [Entry(PARAMETER_BASE + row.index, 0, row.name, "i32", "rw", "t", row.default, PARAMETER, "", "",
                  row.minimum, row.maximum, row.text, 1, 1, "") for row in read_table()]
