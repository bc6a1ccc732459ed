"""MF4 files with bus logging as loggers write them while they record: structure first, then data, in one pass."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import can
from can.util import len2dlc

START_NS = 1_700_000_000_123_456_789
_KINDS = ("CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame")
_TICK_S = 1e-7


@dataclass(frozen=True)
class Layout:
    """How a file has its frames. unsorted: the records of all kinds in one data group, each with its identifier.
    beside: data bytes are not in the record. block_bytes: of a data block, 0 for all in one. compression: method, 0
    deflate, 1 of transposed records. is_finished: the writer has ended. big_endian: numbers of the records."""

    unsorted: bool = True
    beside: bool = True
    block_bytes: int = 0
    compression: int | None = None
    is_finished: bool = True
    big_endian: bool = False


class _File:
    """Blocks one after the other; links are set when their targets are known."""

    def __init__(self, is_finished: bool) -> None:
        word = b"MDF     " if is_finished else b"UnFinMF "
        self.data = bytearray(word + b"4.11    test    " + struct.pack("<4xHHI", 411, 0, 0) + bytes(24))
        self.data[60:62] = struct.pack("<H", 0 if is_finished else 5)  # counts, and length of the last data block

    def add(self, kind: bytes, links: Sequence[int] = (), content: bytes = b"", length: int | None = None) -> int:
        self.data += bytes(-len(self.data) % 8)
        address = len(self.data)
        size = 24 + 8 * len(links) + len(content)
        self.data += struct.pack("<4s4xQQ", kind, size if length is None else length, len(links))
        self.data += struct.pack(f"<{len(links)}Q", *links) + content
        return address

    def text(self, text: str) -> int:
        return self.add(b"##TX", (), (text.encode() + b"\0").ljust(len(text) // 8 * 8 + 8, b"\0"))

    def link(self, address: int, index: int, target: int) -> None:
        self.data[address + 24 + 8 * index : address + 32 + 8 * index] = struct.pack("<Q", target)


def bus_logging(frames: Sequence[tuple[int, can.Message]], layout: Layout) -> tuple[bytes, list[int]]:
    """A file, and for each frame the place after its last byte; a compressed one's means nothing. Times are whole
    ticks of 100 ns after START_NS."""
    file = _File(layout.is_finished)
    header = file.add(b"##HD", [0] * 6, struct.pack("<QhhBBBBdd", START_NS, 0, 0, 0, 0, 0, 0, 0.0, 0.0))
    source = file.add(b"##SI", [file.text("CAN1"), 0, 0], struct.pack("<BBB5x", 2, 2, 0))
    history = file.add(b"##FH", [0, 0], struct.pack("<QhhB3x", START_NS, 0, 0, 0))
    file.link(header, 1, history)
    kinds = [kind for kind in _KINDS if any(_kind(message) == kind for _, message in frames)]
    number = {kind: 1 + 2 * index for index, kind in enumerate(kinds)}
    groups = {kind: _group(file, kind, number[kind] if layout.unsorted else 0, source, layout,
                           sum(_kind(message) == kind for _, message in frames)) for kind in kinds}
    if layout.unsorted:
        return _mixed(file, header, frames, groups, number, layout)
    after = 0
    for kind in reversed(kinds):
        group, data_bytes = groups[kind]
        records = [_record(time_ns, message, layout, place) for time_ns, message, place in _places(frames, kind)]
        data, _ = _data(file, b"##DT", records, layout)
        if data_bytes:
            values = [_value(message) for _, message in frames if _kind(message) == kind]
            file.link(data_bytes, 5, _data(file, b"##SD", values, layout)[0])
        after = file.add(b"##DG", [after, group, data, 0], bytes(8))
    file.link(header, 0, after)
    return bytes(file.data), []


def _mixed(file: _File, header: int, frames: Sequence[tuple[int, can.Message]], groups: dict[str, tuple[int, int]],
           number: dict[str, int], layout: Layout) -> tuple[bytes, list[int]]:
    first = 0
    for kind in reversed(groups):
        group, data_bytes = groups[kind]
        if data_bytes:
            sizes = [4 + len(message.data) for _, message in frames if _kind(message) == kind and layout.is_finished]
            values = file.add(b"##CG", [first, 0, 0, 0, 0, 0],
                              struct.pack("<QQHHIQ", number[kind] + 1, len(sizes), 1, 0, 0, sum(sizes)))
            file.link(data_bytes, 5, values)
            first = values
        file.link(group, 0, first)
        first = group
    data_group = file.add(b"##DG", [0, first, 0, 0], b"\1" + bytes(7))
    file.link(header, 0, data_group)
    places = dict.fromkeys(groups, 0)
    parts, ends = [], []
    for time_ns, message in frames:
        kind, text = _kind(message), b""
        if groups[kind][1]:
            value = _value(message)
            text = bytes([number[kind] + 1]) + value
            parts.append(bytes([number[kind]]) + _record(time_ns, message, layout, places[kind]) + text)
            places[kind] += len(value)
        else:
            parts.append(bytes([number[kind]]) + _record(time_ns, message, layout, 0))
    data, begin = _data(file, b"##DT", parts, layout)
    file.link(data_group, 2, data)
    for part in parts:
        begin += len(part)
        ends.append(begin)
    return bytes(file.data), ends


def _kind(message: can.Message) -> str:
    return _KINDS[2] if message.is_error_frame else _KINDS[1] if message.is_remote_frame else _KINDS[0]


def _places(frames: Sequence[tuple[int, can.Message]], kind: str) -> list[tuple[int, can.Message, int]]:
    found, place = [], 0
    for time_ns, message in frames:
        if _kind(message) == kind:
            found.append((time_ns, message, place))
            place += 4 + len(message.data)
    return found


def _value(message: can.Message) -> bytes:
    return struct.pack("<I", len(message.data)) + bytes(message.data)


def _record(time_ns: int, message: can.Message, layout: Layout, place: int) -> bytes:
    """Time, identifier with its flag of 29 bits above, length code and length in a byte each, flags, data bytes."""
    order = ">" if layout.big_endian else "<"
    word = message.arbitration_id | message.is_extended_id << 31
    ticks = (time_ns - START_NS) // 100
    code = len2dlc(message.dlc) if message.is_fd else message.dlc
    flags = message.is_fd | message.bitrate_switch << 1 | message.error_state_indicator << 2 | 1 << 4
    record = struct.pack(f"{order}QIBBB", ticks, word, code, len(message.data), flags)
    if message.is_remote_frame:
        return record
    return record + (struct.pack("<Q", place) if layout.beside else bytes(message.data).ljust(64, b"\0"))


def _group(file: _File, kind: str, number: int, source: int, layout: Layout, count: int) -> tuple[int, int]:
    """Addresses of a channel group, and of its channel of the data bytes where they are beside the record."""
    whole, has_data = int(layout.big_endian), kind != _KINDS[1]
    members = [("ID", 8, 0, 29), ("IDE", 11 if not layout.big_endian else 8, 7, 1), ("DLC", 12, 0, 8),
               ("DataLength", 13, 0, 8), ("EDL", 14, 0, 1), ("BRS", 14, 1, 1), ("ESI", 14, 2, 1),
               ("BusChannel", 14, 4, 4)]
    after, data_bytes = 0, 0
    if has_data:
        width = 64 if layout.beside else 512
        after = data_bytes = _channel(file, f"{kind}.DataBytes", 1 if layout.beside else 0, 10, (15, 0, width))
    for name, *place in reversed(members):
        after = _channel(file, f"{kind}.{name}", 0, whole, place, after=after)
    size = 15 + (8 if layout.beside else 64) * has_data
    frame = _channel(file, kind, 0, 10, (8, 0, 8 * (size - 8)), inner=after)
    ticks = file.add(b"##CC", [0] * 4, struct.pack("<BBHHHdddd", 1, 0, 0, 0, 2, 0.0, 0.0, 0.0, _TICK_S))
    time = _channel(file, "t", 2, whole, (0, 0, 64), after=frame, conversion=ticks)
    stated = count if layout.is_finished else 0
    group = file.add(b"##CG", [0, time, file.text(kind), source, 0, 0],
                     struct.pack("<QQHHIII", number, stated, 6, ord("."), 0, size, 0))
    return group, data_bytes if layout.beside else 0


def _channel(file: _File, name: str, kind: int, data_type: int, place: Sequence[int],  # noqa: PLR0913 - members
             *, after: int = 0, inner: int = 0, conversion: int = 0) -> int:
    """place: byte, bit and number of bits. after: the next channel, inner: the first one of its structure."""
    begin, bit, bits = place
    text = file.text(name)
    flags = 0x400 if "." in name or inner else 0
    return file.add(b"##CN", [after, inner, text, 0, conversion, 0, 0, 0],
                    struct.pack("<BBBBIIIIBBH6d", kind, int(kind == 2), data_type, bit, begin, bits, flags, 0, 0, 0, 0,
                                *[0.0] * 6))


def _data(file: _File, kind: bytes, parts: list[bytes], layout: Layout) -> tuple[int, int]:
    """The address of a data block or of a list of them, and of the first byte."""
    data = b"".join(parts)
    if not layout.block_bytes:
        address = file.add(kind, (), data, None if layout.is_finished else 24)
        return address, address + 24
    width = max(1, len(parts[0]))
    blocks = []
    for begin in range(0, len(data), layout.block_bytes):
        piece = data[begin : begin + layout.block_bytes]
        if layout.compression is None:
            blocks.append(file.add(kind, (), piece))
            continue
        method, lines = layout.compression, len(piece) // width
        cells = width * lines
        turned = piece if method == 0 else b"".join(piece[at:cells:width] for at in range(width)) + piece[cells:]
        packed = zlib.compress(turned)
        blocks.append(file.add(b"##DZ", (), struct.pack("<2sBBIQQ", kind[2:], method, 0, width if method else 0,
                                                        len(piece), len(packed)) + packed))
    places = range(0, len(data), layout.block_bytes)
    address = file.add(b"##DL", [0, *blocks], struct.pack(f"<B3xI{len(blocks)}Q", 0, len(blocks), *places))
    if layout.compression is not None:
        address = file.add(b"##HL", [address], struct.pack("<HB5x", 0, layout.compression))
    return address, blocks[0] + 24
