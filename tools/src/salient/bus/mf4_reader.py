"""Frames of an MF4 file with bus logging (CAN_DataFrame, CAN_RemoteFrame, CAN_ErrorFrame), as CANape, CANedge, CANoe,
asammdf and python-can write it.

asammdf decodes. Before that all blocks are looked at: it follows the links of a damaged file without an end, and makes
arrays of sizes that a file merely states. The reader of python-can adds the start to each time as a float, which leaves
256 ns, and decodes each number of each frame by itself.
"""

from __future__ import annotations

import heapq
import struct
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, Any

import can
import numpy as np
from can.util import dlc2len

from salient.bus.log_input import Damage, LogInput
from salient.errors import optional_package

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_BLOCK = struct.Struct("<4s4xQQ")
_FIRST_BLOCK = 64
_LINKS_MAX = 1 << 16
_INFLATED_MAX = 1 << 26
"""Bytes of a compressed block; the standard has 4 MiB."""
_CHUNK_FRAMES = 10_000
_KINDS = ("CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame")
_CHAINED = {b"##HD": (0,), b"##DG": (0, 1), b"##CG": (0, 1), b"##CN": (0, 1), b"##FH": (0,), b"##AT": (0,),
            b"##EV": (0,), b"##CH": (0, 1), b"##DL": (0,), b"##HL": (0,), b"##LD": (0,)}
"""Links by which a reader goes on: to the next, and into what belongs to a block. Two never lead to one block."""


def read_mf4(file: LogInput, path: Path) -> Iterator[tuple[int, can.Message]]:
    """Time in ns, since 1970, and frame, in the order of time. Damage."""
    asammdf = optional_package("asammdf", f"{path}: MF4")
    with tempfile.TemporaryFile() if file.is_compressed else path.open("rb") as stream:
        if file.is_compressed:
            while data := file.read(1 << 20):
                stream.write(data)
        _check_blocks(stream)
        stream.seek(0)
        try:
            mdf: Any = asammdf.MDF(stream)
        except Exception as error:  # whatever asammdf meets in a damaged file
            raise Damage(f"its blocks cannot be read: {_reason(error)}") from None
        with closing(mdf):
            yield from _merged(mdf)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


# --- blocks -----------------------------------------------------------------------------------------------------------


class _Blocks:
    """The blocks of a file, by the links between them."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._size = stream.seek(0, 2)

    def read(self, address: int) -> tuple[bytes, list[int], int]:
        """Kind, links and length. Damage: it is no block that the file has."""
        self._stream.seek(min(address, self._size))  # a link of 64 bits may lead beyond what a file can have
        header = self._stream.read(_BLOCK.size)
        if len(header) < _BLOCK.size:
            raise Damage(f"truncated: byte {address}: a block begins there, the file has {self._size} bytes")
        kind, length, count = _BLOCK.unpack(header)
        if not kind.startswith(b"##") or count > _LINKS_MAX or length < _BLOCK.size + 8 * count:
            raise Damage(f"byte {address}: no block of MF4 begins there")
        if address + length > self._size:
            raise Damage(f"truncated: byte {address}: a block of {length} bytes, the file has {self._size}")
        return kind, list(struct.unpack(f"<{count}Q", self._stream.read(8 * count))), length

    def content(self, address: int, links: int, length: int) -> bytes:
        """What follows the links."""
        begin = _BLOCK.size + 8 * links
        self._stream.seek(address + begin)
        return self._stream.read(length - begin)


def _check_blocks(stream: IO[bytes]) -> None:
    """Damage: a link leads to no block, or back; a block is not complete, or decompresses to another length."""
    blocks = _Blocks(stream)
    stream.seek(0)
    identification = stream.read(_FIRST_BLOCK)
    if len(identification) < _FIRST_BLOCK or identification[:8].strip() not in (b"MDF", b"UnFinMF"):
        raise Damage("byte 0: no header of MF4")
    if identification[8:9] != b"4":
        raise Damage("byte 8: no version 4 of MDF")
    kinds: dict[int, bytes] = {}
    chained: set[int] = set()
    waiting = [_FIRST_BLOCK]
    while waiting:
        address = waiting.pop()
        if address in kinds:
            continue
        kind, links, length = blocks.read(address)
        if address == _FIRST_BLOCK and kind != b"##HD":
            raise Damage(f"byte {address}: no header block of MF4")
        kinds[address] = kind
        for index in _CHAINED.get(kind, ()):
            target = links[index] if index < len(links) else 0
            if target and (target in chained or target == _FIRST_BLOCK):
                raise Damage(f"byte {address}: its link leads back to byte {target}")
            if target:
                chained.add(target)
        if kind == b"##DZ":
            _check_inflated(blocks.content(address, len(links), length), address)
        waiting += [link for link in links if link]


def _check_inflated(content: bytes, address: int) -> None:
    if len(content) < 24:
        raise Damage(f"byte {address}: a compressed block of {len(content)} bytes")
    length, size = struct.unpack_from("<QQ", content, 8)
    try:
        if length > _INFLATED_MAX or size > len(content) - 24:
            raise ValueError(f"{length} bytes in {size}")
        decompressor = zlib.decompressobj()
        data = decompressor.decompress(content[24 : 24 + size], length + 1)
        decompressor.decompress(decompressor.unconsumed_tail, 1)
        if len(data) != length or not decompressor.eof:
            raise ValueError(f"not the {length} bytes that it states")
    except (zlib.error, ValueError) as error:
        raise Damage(f"byte {address}: a compressed block that cannot be decompressed: {error}") from None


# --- frames -----------------------------------------------------------------------------------------------------------


def _merged(mdf: Any) -> Iterator[tuple[int, can.Message]]:
    start_ns = _start_ns(mdf)
    groups = []
    for index, group in enumerate(mdf.groups):
        names = {channel.name for channel in group.channels}
        kind = next((kind for kind in _KINDS if kind in names), None)
        if kind is not None and group.channel_group.cycles_nr:
            groups.append(_group(mdf, index, kind, start_ns))
    if not groups:
        raise Damage("it has no frames (CAN_DataFrame) but signals, which cannot be made frames again" if mdf.groups
                     else "it has no frames")
    yield from heapq.merge(*groups, key=lambda timed: timed[0])


def _start_ns(mdf: Any) -> int:
    header: Any = mdf.header
    try:
        return int((header.start_time.astimezone(UTC) - _EPOCH) // timedelta(microseconds=1)) * 1000 + int(
            header.abs_time % 1000)
    except (OverflowError, ValueError, OSError):
        raise Damage(f"byte {_FIRST_BLOCK}: its start is no date") from None


def _group(mdf: Any, index: int, kind: str, start_ns: int) -> Iterator[tuple[int, can.Message]]:
    """The frames of a channel group, some at a time."""
    count = mdf.groups[index].channel_group.cycles_nr
    done = 0
    while done < count:
        try:
            signal = mdf.get(kind, index, record_offset=done, record_count=_CHUNK_FRAMES, raw=True)
            frames = list(_decoded(signal, kind, start_ns))
        except Exception as error:  # whatever asammdf and NumPy meet in a damaged file
            raise Damage(f"record {done} of {kind}: {_reason(error)}") from None
        if not frames:
            raise Damage(f"truncated: record {done} of {kind}, of {count}")
        yield from frames
        done += len(frames)


def _decoded(signal: Any, kind: str, start_ns: int) -> Iterator[tuple[int, can.Message]]:
    names = signal.samples.dtype.names or ()
    count = len(signal.samples)

    def column(name: str, default: int = 0) -> list[int]:
        full = f"{kind}.{name}"
        return [default] * count if full not in names else [int(value) for value in signal.samples[full]]

    flags = {name: column(name) for name in ("IDE", "EDL", "BRS", "ESI", "DLC")}
    identifiers, lengths = column("ID"), column("DataLength", -1)
    data = signal.samples[f"{kind}.DataBytes"] if f"{kind}.DataBytes" in names else None
    has_ide = f"{kind}.IDE" in names
    for row, time_s in enumerate(signal.timestamps.tolist()):
        word, length = identifiers[row], lengths[row]
        is_fd = bool(flags["EDL"][row])
        is_remote, is_error = kind == "CAN_RemoteFrame", kind == "CAN_ErrorFrame"
        payload = b"" if data is None or is_remote else np.asarray(data[row]).astype(np.uint8).tobytes()
        if length > len(payload) and data is not None and not is_remote:
            raise ValueError(f"{length} data bytes of {len(payload)}")
        code = flags["DLC"][row] or max(length, 0)
        payload = payload[: length if length >= 0 else dlc2len(code)]
        yield start_ns + round(time_s * 1e9), can.Message(
            arbitration_id=word & 0x1FFFFFFF,
            is_extended_id=bool(flags["IDE"][row]) if has_ide else bool(word >> 31 or word > 0x7FF),
            is_remote_frame=is_remote, is_error_frame=is_error, is_fd=is_fd, bitrate_switch=bool(flags["BRS"][row]),
            error_state_indicator=bool(flags["ESI"][row]), dlc=len(payload) if is_fd else code, data=payload)
