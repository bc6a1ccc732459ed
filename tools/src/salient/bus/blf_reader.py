"""Frames of a BLF file, object by object.

The reader of python-can adds the start of the recording to each time as a float, which leaves 256 ns of a time since
1970; it does not end on an object of size 0, passes over what it does not understand without a word, and has no error
frames but one kind. Its definitions of the objects are used here; the sizes of all are checked.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta

import can
from can.io import blf
from can.util import dlc2len

from salient.bus.log_input import Damage, LogInput

_SIGNATURE = b"LOBJ"
_CONTAINER_MAX = 1 << 26
"""Bytes of a container, compressed or not; Vector's tools write 128 KiB, python-can as much as is asked for."""
_OBJECT_MAX = 1 << 20
"""Bytes of an object that is looked at; a larger one is no frame and is passed over."""
_HEADER_MAX = 4096
_PADDING_MAX = 3
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_CAN_ERROR, _CAN_OVERLOAD, _CAN_FD_ERROR_64 = 2, 3, 104
_CAN_ERROR_STRUCT = struct.Struct("<HHL")
_KNOWN_MAX = 150
"""Highest type of an object that Vector's tools write, with a margin: events of other buses and of the tools."""
_FRAME_SIZES = (blf.CAN_MSG_STRUCT.size, blf.CAN_FD_MSG_STRUCT.size)
"""Content of an object that is as long as this would be a frame if its type were not damaged."""


class _Objects:
    """Objects from the bytes of containers, which one may continue in the next."""

    def __init__(self, file: LogInput) -> None:
        self._file = file
        self._tail = b""
        self._skip = 0
        self._begin = 0  # of the tail, in the content of all containers
        self.start_ns = 0

    def frames(self, data: bytes) -> Iterator[tuple[int, can.Message]]:
        """The frames of a container's content. Damage."""
        skipped = min(self._skip, len(data))
        self._skip -= skipped
        self._begin += skipped
        data = self._tail + data[skipped:]
        at = 0
        while True:
            if len(data) - at < _PADDING_MAX + blf.OBJ_HEADER_BASE_STRUCT.size and not (
                    data.startswith(_SIGNATURE, at) and len(data) - at >= blf.OBJ_HEADER_BASE_STRUCT.size):
                break
            at = max(at, data.find(_SIGNATURE, at, at + _PADDING_MAX + len(_SIGNATURE)))
            signature, header_size, version, size, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack_from(data, at)
            where = f"byte {self._begin + at} of the uncompressed objects"
            if signature != _SIGNATURE:
                raise Damage(f"{where}: no object begins there")
            if size < max(header_size, blf.OBJ_HEADER_BASE_STRUCT.size):
                raise Damage(f"{where}: an object of size {size}")
            if size > _OBJECT_MAX and kind in _DECODERS:
                raise Damage(f"{where}: a frame of {size} bytes")
            if at + size > len(data):
                if size > _OBJECT_MAX:
                    self._skip, at = at + size - len(data), len(data)
                break
            timed = self._object(data[at : at + size], header_size, version, kind, where)
            if timed is not None:
                yield timed
            at += size
        self._tail = data[at:]
        self._begin += at

    def finish(self) -> None:
        """Damage: an object is not complete."""
        if self._skip or len(self._tail.strip(b"\0")) > _PADDING_MAX:
            raise Damage(f"truncated: byte {self._begin} of the uncompressed objects: an object is not complete")

    def _object(self, data: bytes, header_size: int, version: int, kind: int, where: str
                ) -> tuple[int, can.Message] | None:
        decode = _DECODERS.get(kind)
        content = data[header_size:]
        if decode is None:
            if len(content) in _FRAME_SIZES or not 0 < kind <= _KNOWN_MAX:
                self._file.leave_out(f"{where}: an object of type {kind}, which is no frame")
            return None
        if version == 1 and header_size == 32:
            flags, _, _, stamp = blf.OBJ_HEADER_V1_STRUCT.unpack_from(data, blf.OBJ_HEADER_BASE_STRUCT.size)
        elif version == 2 and header_size == 40:
            flags, _, _, stamp = blf.OBJ_HEADER_V2_STRUCT.unpack_from(data, blf.OBJ_HEADER_BASE_STRUCT.size)
        else:
            raise Damage(f"{where}: a header of version {version} and {header_size} bytes")
        if flags not in (blf.TIME_TEN_MICS, blf.TIME_ONE_NANS):
            raise Damage(f"{where}: a time in unknown unit {flags}")
        stamp_ns = stamp * (10_000 if flags == blf.TIME_TEN_MICS else 1)
        try:
            return self.start_ns + stamp_ns, decode(content)
        except (struct.error, ValueError, IndexError) as error:
            raise Damage(f"{where}: a frame of {len(data)} bytes: {error}") from None


def read_blf(file: LogInput) -> Iterator[tuple[int, can.Message]]:
    """Time in ns, since 1970 where the file states its start, and frame. Damage."""
    stated, start_ns = _read_header(file)
    objects = _Objects(file)
    objects.start_ns = start_ns
    while True:
        begin = file.position
        header = file.read(blf.OBJ_HEADER_BASE_STRUCT.size)
        if not header.strip(b"\0") and len(header) < blf.OBJ_HEADER_BASE_STRUCT.size:
            break
        data, end = _container(file, header, begin)
        yield from objects.frames(data)
        if end is not None:
            raise end
    objects.finish()
    if stated != file.position:
        raise Damage(f"truncated: byte {file.position}: the end of the file, of which the header states {stated} bytes")


def _read_header(file: LogInput) -> tuple[int, int]:
    """The size that a file states, and the start of its recording in ns."""
    data = file.read(blf.FILE_HEADER_STRUCT.size)
    if len(data) < blf.FILE_HEADER_STRUCT.size or not data.startswith(b"LOGG"):
        raise Damage("byte 0: no header of BLF")
    header = blf.FILE_HEADER_STRUCT.unpack(data)
    if not len(data) <= header[1] <= _HEADER_MAX:
        raise Damage(f"byte 4: a header of {header[1]} bytes")
    file.read(header[1] - len(data))
    year, month, _, day, hour, minute, second, millisecond = header[14:22]
    try:
        start = datetime(year, month, day, hour, minute, second, millisecond * 1000, tzinfo=UTC)
    except ValueError:
        return header[10], 0  # without a date
    return header[10], (start - _EPOCH) // timedelta(milliseconds=1) * 1_000_000


def _container(file: LogInput, header: bytes, begin: int) -> tuple[bytes, Damage | None]:
    """The content of an object of the file, and where it is damaged; none of one that is no container."""
    if len(header) < blf.OBJ_HEADER_BASE_STRUCT.size:
        raise Damage(f"truncated: byte {begin}: an object is not complete")
    signature, header_size, _, size, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack(header)
    if signature != _SIGNATURE or size < max(header_size, len(header)):
        raise Damage(f"byte {begin}: no container begins there" if signature != _SIGNATURE
                     else f"byte {begin}: a container of size {size}")
    if size > _CONTAINER_MAX:
        raise Damage(f"byte {begin}: a container of {size} bytes")
    content = file.read(size - len(header))
    file.read(size % 4)  # padding
    is_cut = len(content) < size - len(header)
    cut = Damage(f"truncated: byte {file.position}: the container at byte {begin} has {size} bytes")
    if kind != blf.LOG_CONTAINER:
        if is_cut:
            raise cut
        return header + content + bytes(size % 4), None  # of a file without containers
    if len(content) < blf.LOG_CONTAINER_STRUCT.size:
        raise cut
    method, length = blf.LOG_CONTAINER_STRUCT.unpack_from(content)
    content = content[blf.LOG_CONTAINER_STRUCT.size :]
    if length > _CONTAINER_MAX:
        raise Damage(f"byte {begin}: a container with {length} bytes of objects")
    if method == blf.ZLIB_DEFLATE:
        content, is_whole = _inflated(content, length, begin, is_cut)
    elif method == blf.NO_COMPRESSION:
        is_whole = True
    else:
        raise Damage(f"byte {begin}: a container compressed by unknown method {method}")
    if is_cut:
        return content, cut
    if not is_whole or len(content) != length:
        raise Damage(f"byte {begin}: a container that does not have the {length} bytes of objects that it states")
    return content, None


def _inflated(content: bytes, length: int, begin: int, is_cut: bool) -> tuple[bytes, bool]:
    """Decompressed objects, not more than their stated length, and whether that was all. Objects of a container with
    a wrong checksum are not known to be right; objects before the end of a file are."""
    decompressor = zlib.decompressobj()
    try:
        data = decompressor.decompress(content, length + 1)
        data += decompressor.decompress(decompressor.unconsumed_tail, 1) if len(data) == length else b""
    except zlib.error as error:
        raise Damage(f"byte {begin}: a container that cannot be decompressed: {error}") from None
    return data, is_cut or decompressor.eof


# --- objects ----------------------------------------------------------------------------------------------------------


_CODE_MAX = 15
"""Largest code of a length, which has 4 bits on the bus and a byte in the file: more than that means no more."""


def _check_size(content: bytes, size: int) -> None:
    if len(content) > size:
        raise ValueError(f"{len(content)} bytes of content instead of {size}")


def _can_message(content: bytes) -> can.Message:
    _check_size(content, blf.CAN_MSG_STRUCT.size)
    return _classic(content)


def _can_message2(content: bytes) -> can.Message:
    _check_size(content, blf.CAN_MSG_STRUCT.size + 8)
    return _classic(content)


def _identified(identifier: int) -> tuple[int, bool]:
    number = identifier & 0x1FFFFFFF  # the two bits above it are reserved
    return number, bool(identifier & blf.CAN_MSG_EXT) or number > 0x7FF


def _classic(content: bytes) -> can.Message:
    _, flags, dlc, word, data = blf.CAN_MSG_STRUCT.unpack_from(content)
    identifier, is_extended = _identified(word)
    is_remote = bool(flags & blf.REMOTE_FLAG)
    return can.Message(arbitration_id=identifier, is_extended_id=is_extended, is_remote_frame=is_remote,
                       is_rx=not flags & blf.DIR, dlc=min(dlc, _CODE_MAX), data=b"" if is_remote else data[:dlc])


def _can_error(content: bytes) -> can.Message:
    _check_size(content, _CAN_ERROR_STRUCT.size)
    _CAN_ERROR_STRUCT.unpack_from(content)
    return can.Message(is_error_frame=True, is_extended_id=False)


def _can_error_ext(content: bytes) -> can.Message:
    _check_size(content, blf.CAN_ERROR_EXT_STRUCT.size)
    members = blf.CAN_ERROR_EXT_STRUCT.unpack_from(content)
    identifier, is_extended = _identified(members[7])
    length = min(members[5], 8)
    return can.Message(arbitration_id=identifier, is_extended_id=is_extended, is_error_frame=True, dlc=length,
                       data=members[9][:length])


def _can_fd_message(content: bytes) -> can.Message:
    _check_size(content, blf.CAN_FD_MSG_STRUCT.size + 4)  # reserved ones at the end, which python-can does not write
    _, flags, dlc, word, _, _, fd_flags, valid, data = blf.CAN_FD_MSG_STRUCT.unpack_from(content)
    is_fd = bool(fd_flags & blf.EDL)
    return _fd(word, dlc, data[:valid], (is_fd, bool(fd_flags & blf.BRS), bool(fd_flags & blf.ESI)), valid,
               bool(flags & blf.REMOTE_FLAG), not flags & blf.DIR)


def _can_fd_message_64(content: bytes) -> can.Message:
    members = blf.CAN_FD_MSG_64_STRUCT.unpack_from(content)
    _, dlc, valid, _, word, _, flags = members[:7]
    _check_size(content, blf.CAN_FD_MSG_64_STRUCT.size + 64 + 64)  # data, and what may follow them
    end = members[13] - 32 if members[13] > 32 else len(content)
    data = content[blf.CAN_FD_MSG_64_STRUCT.size : max(end, blf.CAN_FD_MSG_64_STRUCT.size)][:valid]
    return _fd(word, dlc, data.ljust(valid, b"\0"), (bool(flags & 0x1000), bool(flags & 0x2000), bool(flags & 0x4000)),
               valid, bool(flags & 0x10), not members[12])


def _fd(word: int, dlc: int, data: bytes, fd_flags: tuple[bool, bool, bool], valid: int, is_remote: bool, is_rx: bool
        ) -> can.Message:
    identifier, is_extended = _identified(word)
    is_fd, brs, esi = fd_flags
    dlc = min(dlc, _CODE_MAX)
    if valid > (dlc2len(dlc) if is_fd else 8):
        raise ValueError(f"{valid} data bytes with the code {dlc}")
    return can.Message(arbitration_id=identifier, is_extended_id=is_extended, is_remote_frame=is_remote, is_rx=is_rx,
                       is_fd=is_fd, bitrate_switch=is_fd and brs, error_state_indicator=is_fd and esi,
                       dlc=dlc2len(dlc) if is_fd else dlc, data=b"" if is_remote else data)


def _can_fd_error_64(content: bytes) -> can.Message:
    if len(content) < 40:
        raise ValueError(f"{len(content)} bytes of content")
    return can.Message(is_error_frame=True, is_extended_id=False)


_DECODERS: dict[int, Callable[[bytes], can.Message]] = {
    blf.CAN_MESSAGE: _can_message,
    _CAN_ERROR: _can_error,
    blf.CAN_ERROR_EXT: _can_error_ext,
    blf.CAN_MESSAGE2: _can_message2,
    blf.CAN_FD_MESSAGE: _can_fd_message,
    blf.CAN_FD_MESSAGE_64: _can_fd_message_64,
    _CAN_FD_ERROR_64: _can_fd_error_64,
}
