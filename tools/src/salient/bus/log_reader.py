"""Frames of a log file, and the conversion of a log into another format."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import can
from can.io import ASCReader, BLFReader
from can.io.blf import BLFParseError
from can.util import len2dlc

from salient.bus.log import open_log
from salient.config import LOG_SUFFIXES, either
from salient.errors import UsageError

_READABLE = tuple(suffix for suffix in LOG_SUFFIXES if suffix != ".mf4")
_CANDUMP = re.compile(
    r"\((?P<s>\d+)\.(?P<fraction>\d{1,9})\) \S+ (?P<identifier>[\dA-F]{3}|[\dA-F]{8})#"
    r"(?:#(?P<flags>[\dA-F])(?P<flexible>(?:[\dA-F]{2}){0,64})"
    r"|(?:R(?P<remote>[0-8]?)|(?P<data>(?:[\dA-F]{2}){0,8}))(?:_(?P<raw_length>[9A-F]))?)(?: [RT])?\n",
    re.ASCII | re.IGNORECASE)
_ERROR_FLAG = 0x20000000
_ASC_END = b"end triggerblock"


class _Truncated(Exception):
    """The end of a log is missing."""


def convert(source: Path, target: Path, machine: str | None, node: int = 0) -> int:
    """Writes the frames of a log to another, whose suffix is the format; returns their number. UsageError: a file
    cannot be read or written, or is truncated; OtherDatabase: see Carrier; then there is no target."""
    if source.resolve() == target.resolve():
        raise UsageError(f"--out {target}: must be another file than --convert {source}")
    frames = read_log(source)
    first = next(frames, None)  # a file of another format leaves an existing target as it is
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {target}: {error.strerror}") from None
    log = open_log(target, machine, node, str(source))
    count = 0
    try:
        while first is not None:
            log.write(*first)
            count += 1
            first = next(frames, None)
        log.close()
    except UsageError:
        log.close()
        target.unlink(missing_ok=True)
        raise
    except OSError as error:
        raise UsageError(f"--out {target}: {error.strerror}") from None
    return count


def read_log(path: Path, option: str = "--convert") -> Iterator[tuple[int, can.Message]]:
    """Time in ns and frame, in the order of the file. UsageError: the suffix, the file or its content is none that can
    be read, or the end is missing; it begins with the option."""
    if path.suffix not in _READABLE:
        reason = " (MF4 has signals, no frames)" if path.suffix == ".mf4" else ""
        raise UsageError(f"{option} {path}: the suffix must be {either(_READABLE)}{reason}")
    read: Callable[[Path], Iterator[tuple[int, can.Message]]]
    read = {".blf": _read_blf, ".asc": _read_asc, ".log": _read_candump}[path.suffix]
    try:
        yield from read(path)
    except _Truncated as error:
        raise UsageError(f"{option} {path}: truncated: {error}") from None
    except OSError as error:
        raise UsageError(f"{option} {path}: {error.strerror}") from None
    except (BLFParseError, struct.error, zlib.error, ValueError, IndexError) as error:
        raise UsageError(f"{option} {path}: not readable as {path.suffix}: {error or 'unknown content'}") from None


def _read_blf(path: Path) -> Iterator[tuple[int, can.Message]]:
    size = path.stat().st_size
    with BLFReader(path) as reader:
        if reader.file_size != size:
            raise _Truncated(f"its header states {reader.file_size} bytes, the file has {size}")
        for message in reader:
            yield round(message.timestamp * 1e9), message


def _read_asc(path: Path) -> Iterator[tuple[int, can.Message]]:
    with path.open("rb") as file:
        if not file.read(5).lower() == b"date ":
            raise ValueError("it does not begin with a date")
        size = path.stat().st_size
        file.seek(max(0, size - 200))
        if _ASC_END not in file.read().lower():
            raise _Truncated("'End TriggerBlock' is missing")
    with ASCReader(path) as reader:
        for message in reader:
            if reader.timestamps_format == "relative":
                raise ValueError("only absolute time stamps are read")
            if message.is_fd and message.is_remote_frame:  # how the reader takes a frame without data
                message.is_remote_frame, message.dlc = False, 0
            elif not message.is_fd and message.dlc > 8:  # the reader takes the code for one of flexible data rate
                message.dlc = len2dlc(message.dlc)
            yield round(message.timestamp * 1e9), message


def _read_candump(path: Path) -> Iterator[tuple[int, can.Message]]:
    with path.open(encoding="ascii", newline="\n") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith("\n"):
                raise _Truncated(f"line {number} has no end")
            match = _CANDUMP.fullmatch(line)
            if match is None:
                raise ValueError(f"line {number}: {line.strip()[:60]!r} is no frame as candump -L writes it")
            yield int(match["s"]) * 10**9 + int(match["fraction"].ljust(9, "0")), _candump_message(match)


def _candump_message(match: re.Match[str]) -> can.Message:
    identifier = int(match["identifier"], 16)
    wide = len(match["identifier"]) > 3
    flags = int(match["flags"] or "0", 16)
    data = bytes.fromhex(match["data"] or match["flexible"] or "")
    length = int(match["raw_length"] or match["remote"] or "0", 16) or len(data)
    return can.Message(
        timestamp=0.0, arbitration_id=identifier & 0x1FFFFFFF,
        is_error_frame=wide and bool(identifier & _ERROR_FLAG), is_extended_id=wide and not identifier & _ERROR_FLAG,
        is_remote_frame=match["remote"] is not None, is_fd=match["flags"] is not None,
        bitrate_switch=bool(flags & 1), error_state_indicator=bool(flags & 2), dlc=length, data=data)
