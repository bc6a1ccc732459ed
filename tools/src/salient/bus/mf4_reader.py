"""Frames of an MF4 file with bus logging (CAN_DataFrame, CAN_RemoteFrame, CAN_ErrorFrame), as CANape, CANedge, CANoe,
asammdf and python-can write it: sorted or not, compressed or not, finished or not, data bytes in the record or beside
it.

Neither asammdf nor the reader of python-can, which uses it, are for damaged files: a changed byte ends the process, and
the latter adds the start to each time as a float, which leaves 256 ns.
"""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import can
import numpy as np
from can.util import dlc2len

from salient.bus.log_input import Damage, LogInput
from salient.bus.mf4_blocks import FIRST_BLOCK, Block, Blocks

_KINDS = ("CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame")
_PIECE = 1 << 18
_IN_MEMORY = 1 << 22
"""Bytes of a stream of its own; of more the rest is in a temporary file."""
_RECORD_MAX = 1 << 16
_BYTES_MAX = 64
_VARIABLE_GROUP = 1
_UNFINISHED_COUNTS = 1
_VARIABLE, _MASTER, _VIRTUAL_MASTER = 1, 2, 3
_UNSIGNED_BIG, _SIGNED, _SIGNED_BIG, _FLOAT, _FLOAT_BIG = 1, 2, 3, 4, 5
_BYTE_ARRAY = 10
_LINEAR = 1
_TIME = "time"
_COLUMNS = ("ID", "IDE", "EDL", "BRS", "ESI", "DLC", "DataLength")


@dataclass(frozen=True)
class _Channel:
    """A channel of a record. kind: whether its value is in the record. data: address of what is beside it, or of the
    channel group that has it. factor, offset: of its conversion."""

    address: int
    kind: int
    data_type: int
    bit_offset: int
    byte_offset: int
    bit_count: int
    data: int
    factor: float = 1.0
    offset: float = 0.0

    @property
    def end(self) -> int:
        """Offset after its bytes in the record."""
        return self.byte_offset + (self.bit_offset + self.bit_count + 7) // 8

    def numbers(self, records: np.ndarray) -> np.ndarray:
        """Its value in each record, as whole numbers, or as floats."""
        cells = records[:, self.byte_offset : self.end]
        big = self.data_type in (_UNSIGNED_BIG, _SIGNED_BIG, _FLOAT_BIG)
        if self.data_type in (_FLOAT, _FLOAT_BIG):
            values: np.ndarray = np.ascontiguousarray(cells).view(f"{'>' if big else '<'}f{self.bit_count // 8}")[:, 0]
            return values.astype(float)
        whole = np.zeros(len(records), dtype=np.uint64)
        for byte in (cells.T if big else cells.T[::-1]):
            whole = whole << np.uint64(8) | byte.astype(np.uint64)
        whole >>= np.uint64(self.bit_offset)
        if self.bit_count < 64:
            whole &= np.uint64((1 << self.bit_count) - 1)
        return whole


@dataclass
class _Group:
    """A channel group: its records, and the channels that make a frame. kind: of its frames, or "" where it has none.
    count: of its records, None where the file does not know."""

    address: int
    identifier: int
    size: int
    is_variable: bool
    count: int | None
    kind: str = ""
    channels: dict[str, _Channel] = field(default_factory=dict)


def read_mf4(file: LogInput, path: Path) -> Iterator[tuple[int, can.Message]]:
    """Time in ns, since 1970, and frame, in the order of time. Damage."""
    with ExitStack() as resources:
        stream: IO[bytes]
        if file.is_compressed:
            stream = _store(resources)
            while data := file.read(_PIECE):
                stream.write(data)
        else:
            stream = resources.enter_context(path.open("rb"))
        blocks = Blocks(stream)
        header = blocks.read(FIRST_BLOCK, b"##HD")
        start_ns = header.unpack("<Q")[0]
        groups: list[Iterator[tuple[int, can.Message]]] = []
        damages: list[Damage] = []
        others = 0
        try:
            for data_group in blocks.chain(header.link(0), b"##DG"):
                found, without = _frames_of(blocks, data_group, start_ns, resources)
                groups += [_until_damage(frames, damages) for frames in found]
                others += without
        except Damage as error:  # what is before it can be read
            damages.append(error)
        if not groups and not damages:
            raise Damage("it has no frames (CAN_DataFrame) but signals, which cannot be made frames again" if others
                         else "it has no frames")
        yield from heapq.merge(*groups, key=lambda timed: timed[0])
        if damages:
            raise damages[0]


def _until_damage(frames: Iterator[tuple[int, can.Message]], damages: list[Damage]
                  ) -> Iterator[tuple[int, can.Message]]:
    """The frames of a channel group; what damages it is told when the others have ended, too."""
    try:
        yield from frames
    except Damage as error:
        damages.append(error)


# --- structure --------------------------------------------------------------------------------------------------------


def _frames_of(blocks: Blocks, data_group: Block, start_ns: int, resources: ExitStack
               ) -> tuple[list[Iterator[tuple[int, can.Message]]], int]:
    """The frames of the channel groups of a data group, and the number of groups without any."""
    identifier_size = data_group.content[0] if data_group.content else 0
    if identifier_size not in (0, 1, 2, 4, 8):
        raise Damage(f"byte {data_group.address}: identifiers of {identifier_size} bytes")
    groups = [_group(blocks, block) for block in blocks.chain(data_group.link(1), b"##CG")]
    with_frames = [group for group in groups if group.kind and group.count != 0]
    if not with_frames:
        return [], len(groups)
    if identifier_size == 0:
        streams = {groups[0].address: blocks.data(data_group.link(2))}
        with_frames = [group for group in with_frames if group is groups[0]]
    else:
        streams = _sorted(blocks.data(data_group.link(2)), groups, identifier_size, resources)
    found = []
    for group in with_frames:
        beside = group.channels.get("DataBytes")
        variable: IO[bytes] | None = None
        if beside is not None and beside.kind == _VARIABLE:
            of_group = streams.get(beside.data)
            variable = _stored(of_group if of_group is not None else blocks.data(beside.data), resources)
        found.append(_frames(group, streams[group.address], variable, start_ns))
    return found, len(groups) - len(with_frames)


def _group(blocks: Blocks, block: Block) -> _Group:
    identifier, count, flags, data_bytes, invalidation_bytes = block.unpack("<QQH6xLL")
    is_variable = bool(flags & _VARIABLE_GROUP)
    size = data_bytes + invalidation_bytes
    known = None if blocks.unfinished & _UNFINISHED_COUNTS else count
    group = _Group(block.address, identifier, size, is_variable, known)
    if is_variable:
        return group
    for channel_block in blocks.chain(block.link(1), b"##CN"):
        _take_channel(blocks, channel_block, group)
    if not group.kind:
        return group
    if not 0 < size <= _RECORD_MAX:
        raise Damage(f"byte {block.address}: records of {size} bytes")
    if _TIME not in group.channels or ("ID" not in group.channels and group.kind != _KINDS[2]):
        raise Damage(f"byte {block.address}: {group.kind} without time or identifier")
    for channel in group.channels.values():
        _check_channel(channel, size)
    return group


def _take_channel(blocks: Blocks, block: Block, group: _Group) -> None:
    """Notes a channel that makes a frame, or is its time."""
    kind, _, data_type, bit_offset, byte_offset, bit_count = block.unpack("<BBBBLL")
    if kind in (_MASTER, _VIRTUAL_MASTER):
        factor, offset = _conversion(blocks, block.link(4))
        group.channels[_TIME] = _Channel(block.address, kind, data_type, bit_offset, byte_offset, bit_count, 0, factor,
                                         offset)
        return
    name = blocks.text(block.link(2)) if block.link(2) else ""
    frame, _, member = name.partition(".")
    if frame not in _KINDS:
        return
    group.kind = frame
    if member in (*_COLUMNS, "DataBytes"):
        group.channels[member] = _Channel(block.address, kind, data_type, bit_offset, byte_offset, bit_count,
                                          block.link(5))
    elif not member and block.link(1):
        for of_frame in blocks.chain(block.link(1), b"##CN"):
            _take_channel(blocks, of_frame, group)


def _conversion(blocks: Blocks, address: int) -> tuple[float, float]:
    """Factor and offset. Damage: it is not linear."""
    if not address:
        return 1.0, 0.0
    block = blocks.read(address, b"##CC", is_shared=True)
    kind = block.unpack("<B")[0]
    if kind == _LINEAR:
        offset, factor = block.unpack("<24x2d")
        return factor, offset
    if kind:
        raise Damage(f"byte {address}: a conversion of the time that is not linear")
    return 1.0, 0.0


def _check_channel(channel: _Channel, size: int) -> None:
    """Damage, unless a record can have it."""
    if channel.kind == _VIRTUAL_MASTER:
        return
    bits = channel.bit_count
    is_bytes = channel.data_type >= _BYTE_ARRAY and channel.kind != _VARIABLE
    fits = bits % 8 == 0 and channel.bit_offset == 0 if is_bytes else (
        bits > 0 and channel.bit_offset < 8 and channel.bit_offset + bits <= 64)
    if channel.data_type in (_FLOAT, _FLOAT_BIG):
        fits = bits in (16, 32, 64) and channel.bit_offset == 0
    if not fits or channel.end > size:
        raise Damage(f"byte {channel.address}: a channel of {bits} bits at byte {channel.byte_offset} of {size}")


# --- records ----------------------------------------------------------------------------------------------------------


def _store(resources: ExitStack) -> IO[bytes]:
    """An empty file that has no name."""
    return resources.enter_context(tempfile.SpooledTemporaryFile(_IN_MEMORY))


def _stored(pieces: Iterator[bytes], resources: ExitStack) -> IO[bytes]:
    """A stream that can be read at any place; where it is damaged, what is before."""
    store = _store(resources)
    try:
        for piece in pieces:
            store.write(piece)
    except Damage:  # told where its first value is missing
        pass
    return store


def _sorted(pieces: Iterator[bytes], groups: list[_Group], identifier_size: int, resources: ExitStack
            ) -> dict[int, Iterator[bytes]]:
    """The records of each channel group, by its address, of data in which they are mixed."""
    by_identifier = {group.identifier: group for group in groups}
    stores = {group.address: _store(resources) for group in groups}
    data, at, passed = b"", 0, 0
    damage: Damage | None = None
    try:
        for piece in pieces:
            data, at, passed = data[at:] + piece, 0, passed + at
            while (end := _record_end(data, at, by_identifier, identifier_size, passed)) is not None:
                group = by_identifier[int.from_bytes(data[at : at + identifier_size], "little")]
                stores[group.address].write(data[at + identifier_size : end])
                at = end
        if at < len(data):
            damage = Damage(f"truncated: byte {passed + at} of the data: a record without its end")
    except Damage as error:
        damage = error

    def read(store: IO[bytes]) -> Iterator[bytes]:
        store.seek(0)
        while piece := store.read(_PIECE):
            yield piece
        if damage is not None:
            raise damage

    return {address: read(store) for address, store in stores.items()}


def _record_end(data: bytes, at: int, groups: dict[int, _Group], identifier_size: int, passed: int) -> int | None:
    """Where a record ends; None where it is not complete."""
    begin = at + identifier_size
    if len(data) < begin:
        return None
    group = groups.get(int.from_bytes(data[at:begin], "little"))
    if group is None:
        raise Damage(f"byte {passed + at} of the data: a record of no channel group")
    if not group.is_variable:
        end = begin + group.size
    elif len(data) < begin + 4:
        return None
    else:
        end = begin + 4 + int.from_bytes(data[begin : begin + 4], "little")
    if end - begin > _RECORD_MAX + 4:
        raise Damage(f"byte {passed + at} of the data: a record of {end - begin} bytes")
    return end if end <= len(data) else None


def _frames(group: _Group, pieces: Iterator[bytes], variable: IO[bytes] | None, start_ns: int
            ) -> Iterator[tuple[int, can.Message]]:
    """The frames of a channel group."""
    rest, done = b"", 0
    try:
        for piece in pieces:
            rest += piece
            count = len(rest) // group.size
            if group.count is not None and done + count > group.count:
                count = group.count - done
            if not count:
                continue
            records = np.frombuffer(rest, dtype=np.uint8, count=count * group.size).reshape(count, group.size)
            rest = rest[count * group.size :]
            yield from _decoded(group, records, done, variable, start_ns)
            done += count
    except Damage as error:
        if group.count is not None and done >= group.count:  # of another group of the data
            return
        raise error from None
    if group.count is not None and done < group.count:
        raise Damage(f"truncated: record {done} of {group.kind}, of {group.count}")
    if len(rest) >= group.size:
        raise Damage(f"record {done} of {group.kind}: there are more than the file states")


def _times_ns(channel: _Channel, records: np.ndarray, first: int) -> list[int]:
    """Times from the start in whole nanoseconds."""
    raw = (np.arange(first, first + len(records), dtype=np.uint64) if channel.kind == _VIRTUAL_MASTER
           else channel.numbers(records))
    factor_ns = channel.factor * 1e9
    if raw.dtype.kind == "f" or abs(factor_ns - round(factor_ns)) > 1e-9 * abs(factor_ns):
        times_s = channel.offset + channel.factor * raw.astype(float)
        if not np.all(np.abs(times_s) < 1e10):
            raise ValueError("a time that is no number of some centuries")
        return [round(time_s * 1e9) for time_s in times_s.tolist()]
    offset_ns = round(channel.offset * 1e9)
    return [offset_ns + round(factor_ns) * value for value in raw.tolist()]


def _decoded(group: _Group, records: np.ndarray, first: int, variable: IO[bytes] | None, start_ns: int
             ) -> Iterator[tuple[int, can.Message]]:
    kind, channels, count = group.kind, group.channels, len(records)
    is_remote, is_error = kind == _KINDS[1], kind == _KINDS[2]
    try:
        times_ns = _times_ns(channels[_TIME], records, first)
    except (ValueError, OverflowError) as error:
        raise Damage(f"record {first} of {kind}: {error}") from None
    columns = {name: channels[name].numbers(records).tolist() if name in channels
               else [-1 if name == "DataLength" else 0] * count for name in _COLUMNS}
    data = channels.get("DataBytes")
    places = data.numbers(records).tolist() if data is not None and data.kind == _VARIABLE else []
    for row, time_ns in enumerate(times_ns):
        word, length = columns["ID"][row], columns["DataLength"][row]
        if data is None or is_remote:
            payload = b""
        elif variable is not None:
            payload = _beside(variable, places[row], first + row, kind)
        else:
            payload = records[row, data.byte_offset : data.end].tobytes()[:_BYTES_MAX]
        if length > len(payload) and data is not None and not is_remote:
            raise Damage(f"record {first + row} of {kind}: {length} data bytes of {len(payload)}")
        is_fd = bool(columns["EDL"][row])
        code = columns["DLC"][row] or max(length, 0)
        payload = payload[: length if length >= 0 else dlc2len(code)]
        yield start_ns + time_ns, can.Message(
            arbitration_id=word & 0x1FFFFFFF,
            is_extended_id=bool(columns["IDE"][row]) if "IDE" in channels else bool(word >> 31 or word > 0x7FF),
            is_remote_frame=is_remote, is_error_frame=is_error, is_fd=is_fd, bitrate_switch=bool(columns["BRS"][row]),
            error_state_indicator=bool(columns["ESI"][row]), dlc=len(payload) if is_fd else code, data=payload)


def _beside(store: IO[bytes], place: int, record: int, kind: str) -> bytes:
    """Data bytes that are beside the record."""
    end = store.seek(0, 2)
    store.seek(min(place, end))
    length = int.from_bytes(store.read(4), "little")
    if place + 4 + length > end or length > _BYTES_MAX:
        raise Damage(f"record {record} of {kind}: its data bytes are not at byte {place} of {end}")
    return store.read(length)
