"""Content of a machine file and its map, and the hash by which a drive says which machine it carries.

Standard library only, as salient.machine.path.
"""

from __future__ import annotations

import json
import tomllib
import zlib
from pathlib import Path
from typing import Any

from salient.machine.path import MachineError

_BYTES_MAX = 30_000_000
"""More than machine files and maps may have."""


def machine_hash(path: Path) -> int:
    """CRC-32 of the values of a machine file, whatever their order, comments and layout, and of its map as it is: what
    DRIVE_MACHINE reports. MachineError: not a file of TOML."""
    content = content_of(path)
    try:
        values = tomllib.loads(content.decode("utf-8-sig"))
        text = json.dumps(_normal(values), sort_keys=True, separators=(",", ":"), default=str)
    except (ValueError, RecursionError) as error:
        raise MachineError(f"{path}: {error}") from None
    crc = zlib.crc32(text.encode())
    for file in map_of(path, content):
        crc = zlib.crc32(content_of(file), crc)
    return crc


def _normal(value: Any) -> Any:
    """A value of a TOML file in which 1 and 1.0 are the same."""
    if isinstance(value, dict):
        return {key: _normal(element) for key, element in value.items()}
    if isinstance(value, list):
        return [_normal(element) for element in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def map_of(path: Path, machine: bytes) -> list[Path]:
    """The flux-linkage map that a machine file of this content names; none in one that is no machine file."""
    try:
        return [path.parent / tomllib.loads(machine.decode("utf-8-sig"))["magnetics"]["file"]]
    except (ValueError, RecursionError, KeyError, TypeError):
        return []


def content_of(path: Path) -> bytes:
    """Bytes of a file; b"none" when it cannot be read or has more than a machine file or map may have."""
    try:
        if path.is_file() and path.stat().st_size <= _BYTES_MAX:
            return path.read_bytes()
    except OSError:
        pass
    return b"none"
