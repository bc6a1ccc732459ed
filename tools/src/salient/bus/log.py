"""Logs on virtual time, in the format of their suffix: BLF (every kind of frame, nanoseconds), ASC and candump text (to
be read, and to be compared; microseconds), MF4 (signals instead of frames)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

import can
from can.io import ASCWriter, BLFWriter
from can.util import len2dlc

from salient.config import LOG_SUFFIXES, either
from salient.errors import UsageError

_ASC_START = "Thu Jan 1 00:00:00.000 1970"
"""Virtual time has no date."""


class Log(Protocol):
    """A log file that is being written."""

    def write(self, time_ns: int, message: can.Message) -> None:
        """Appends a frame; times do not fall."""

    def close(self) -> None:
        """Completes the file."""


class BlfLog:
    """A BLF file whose bytes depend on the frames and their virtual times alone."""

    def __init__(self, path: Path) -> None:
        self._writer = BLFWriter(path)
        # Otherwise the first frame's time becomes the origin, and its fraction of a millisecond is lost.
        self._writer.start_timestamp = 0.0

    def write(self, time_ns: int, message: can.Message) -> None:
        plain = can.Message(
            # The writer truncates to whole nanoseconds: half of one is added against the rounding of the float.
            timestamp=(time_ns + 0.5) * 1e-9,
            arbitration_id=message.arbitration_id,
            is_extended_id=message.is_extended_id,
            is_remote_frame=message.is_remote_frame,
            is_error_frame=message.is_error_frame,
            is_fd=message.is_fd,
            bitrate_switch=message.bitrate_switch,
            error_state_indicator=message.error_state_indicator,
            dlc=message.dlc,
            data=message.data,
        )
        self._writer.on_message_received(plain)

    def close(self) -> None:
        self._writer.stop()


class AscLog:
    """An ASC file, all frames received on channel 1. The writer of python-can notes the time of day and counts from the
    first frame."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="ascii", newline="\n")
        self._file.write(f"date {_ASC_START}\nbase hex  timestamps absolute\ninternal events logged\n"
                         f"Begin Triggerblock {_ASC_START}\n   0.000000 Start of measurement\n")

    def write(self, time_ns: int, message: can.Message) -> None:
        self._file.write(f"{_microseconds(time_ns):>11} {_asc_event(message)}\n")

    def close(self) -> None:
        self._file.write("End TriggerBlock\n")
        self._file.close()


class CandumpLog:
    """Text as `candump -L` writes it: (seconds.microseconds) interface identifier#data."""

    def __init__(self, path: Path, interface: str = "can0") -> None:
        self._file = path.open("w", encoding="ascii", newline="\n")
        self._interface = interface

    def write(self, time_ns: int, message: can.Message) -> None:
        self._file.write(candump_line(time_ns, message, self._interface) + "\n")

    def close(self) -> None:
        self._file.close()


def candump_line(time_ns: int, message: can.Message, interface: str = "can0") -> str:
    """One frame as candump's log format has it; time cut off to microseconds."""
    identifier = message.arbitration_id | (0x20000000 if message.is_error_frame else 0)
    wide = message.is_extended_id or message.is_error_frame
    text = f"({_microseconds(time_ns)}) {interface} {identifier:0{8 if wide else 3}X}"
    data = bytes(message.data).hex().upper()
    if message.is_fd:
        flags = (1 if message.bitrate_switch else 0) | (2 if message.error_state_indicator else 0)
        return f"{text}##{flags:X}{data}"
    raw_length = f"_{message.dlc:X}" if message.dlc > 8 else ""
    if message.is_remote_frame:
        data = f"R{min(message.dlc, 8) or ''}"
    return f"{text}#{data}{raw_length}"


def _microseconds(time_ns: int) -> str:
    """Seconds, cut off to microseconds."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{nanoseconds // 1000:06d}"


def _asc_event(message: can.Message) -> str:
    """One frame as an event of ASC."""
    if message.is_error_frame:
        return "1  ErrorFrame"
    identifier = f"{message.arbitration_id:X}{'x' if message.is_extended_id else ''}"
    data = bytes(message.data).hex(" ").upper()
    if message.is_fd:
        brs, esi = int(message.bitrate_switch), int(message.error_state_indicator)
        return ASCWriter.FORMAT_MESSAGE_FD.format(
            channel=1, dir="Rx", id=identifier, symbolic_name="", brs=brs, esi=esi, dlc=len2dlc(message.dlc),
            data_length=len(message.data), data=data, message_duration=0, message_length=0,
            flags=0x1000 | brs << 13 | esi << 14, crc=0, bit_timing_conf_arb=0, bit_timing_conf_data=0,
            bit_timing_conf_ext_arb=0, bit_timing_conf_ext_data=0)
    kind = "r" if message.is_remote_frame else "d"
    return ASCWriter.FORMAT_MESSAGE.format(
        channel=1, id=identifier, dir="Rx", dtype=f"{kind} {message.dlc:x}", data=data).rstrip()


def open_log(path: Path, machine: str | None = None, node: int = 0, source: str = "") -> Log:
    """A log file by its suffix. machine, node: those whose DBC decodes the frames of an MF4 file, by default the
    machine that the drive reports. source: of the frames, for messages. UsageError: the suffix is none of
    LOG_SUFFIXES, or the file cannot be made."""
    if path.suffix not in LOG_SUFFIXES:
        raise UsageError(f"--out {path}: the suffix must be {either(LOG_SUFFIXES)}")
    try:
        if path.suffix == ".mf4":
            from salient.bus.mf4 import Mf4Log  # asammdf loads pandas: a second that only this format needs

            return Mf4Log(path, machine, node, source or str(path))
        formats: dict[str, Callable[[Path], Log]] = {".blf": BlfLog, ".asc": AscLog, ".log": CandumpLog}
        return formats[path.suffix](path)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}") from None


def write_logs(frames: Iterable[tuple[int, can.Message]], *paths: Path) -> None:
    """Writes the same frames to each path."""
    logs = [open_log(path) for path in paths]
    for time_ns, message in frames:
        for log in logs:
            log.write(time_ns, message)
    for log in logs:
        log.close()
