"""Logs on virtual time: BLF (every kind of frame, nanoseconds) and candump text (to be read, and to be compared)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import can
from can.io import BLFWriter

from salient.errors import UsageError

SUFFIXES = (".blf", ".log")


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
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    identifier = message.arbitration_id | (0x20000000 if message.is_error_frame else 0)
    wide = message.is_extended_id or message.is_error_frame
    text = f"({seconds}.{nanoseconds // 1000:06d}) {interface} {identifier:0{8 if wide else 3}X}"
    data = bytes(message.data).hex().upper()
    if message.is_fd:
        flags = (1 if message.bitrate_switch else 0) | (2 if message.error_state_indicator else 0)
        return f"{text}##{flags:X}{data}"
    if message.is_remote_frame:
        return f"{text}#R{message.dlc or ''}"
    raw_length = f"_{message.dlc:X}" if message.dlc > 8 else ""
    return f"{text}#{data}{raw_length}"


def open_log(path: Path) -> BlfLog | CandumpLog:
    """A log file by its suffix; UsageError when it is neither or cannot be made."""
    if path.suffix not in SUFFIXES:
        raise UsageError(f"--out {path}: the file's suffix must be {' or '.join(SUFFIXES)} (candump text)")
    try:
        return BlfLog(path) if path.suffix == ".blf" else CandumpLog(path)
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
