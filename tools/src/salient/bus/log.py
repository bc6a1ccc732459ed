"""Logs, in the format of their suffix: BLF (every kind of frame, nanoseconds), ASC and candump text (to be read, and to
be compared; microseconds), and decoded signals instead of frames: MF4, CSV and Parquet."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import can
from can.io import ASCWriter, BLFWriter, blf
from can.util import len2dlc
from cantools.database.can import Database

from salient.bus.file_log import FileLog, Log
from salient.bus.identity import Carrier
from salient.config import LOG_SUFFIXES, Rotation, either
from salient.errors import RunFailed, UsageError

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MS_NS = 1_000_000
_ASC_START = "Thu Jan 1 00:00:00.000 1970"
"""Virtual time has no date."""
_BLF_START_OFFSET = 40
"""Offset of the start in the header of a file."""
_NUMBER_DIGITS = 4  # of a file of a rotated log
DECODED_SUFFIXES = (".mf4", ".csv", ".parquet")


class _BlfWriter(BLFWriter):
    """The writer of python-can with times in whole nanoseconds: as floats, those since 1970 lose 256 ns."""

    time_ns = 0
    """Time of the next frame, from the start."""

    def _add_object(self, obj_type: int, data: bytes, timestamp: float | None = None) -> None:
        header_size = blf.OBJ_HEADER_BASE_STRUCT.size + blf.OBJ_HEADER_V1_STRUCT.size
        self._buffer += [
            blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", header_size, 1, header_size + len(data), obj_type),
            blf.OBJ_HEADER_V1_STRUCT.pack(blf.TIME_ONE_NANS, 0, 0, self.time_ns),
            data,
            bytes(len(data) % 4),
        ]
        self._buffer_size += header_size + len(data) + len(data) % 4
        self.object_count += 1
        self.stop_timestamp = timestamp
        if self._buffer_size >= self.max_container_size:
            self._flush()


class BlfLog(FileLog):
    """A BLF file whose bytes depend on the frames and their times alone. A log that begins before time 0 has the time
    of its first frame, in whole milliseconds, as its start."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._writer = _BlfWriter(path)
        self._writer.start_timestamp = 0.0
        self._start_ns: int | None = None

    def write(self, time_ns: int, message: can.Message) -> None:
        """Appends a frame. RunFailed: its time is before the start, which BLF cannot have."""
        if self._start_ns is None:
            self._start_ns = min(0, time_ns // _MS_NS * _MS_NS)
        if time_ns < self._start_ns:
            raise RunFailed(f"--out {self.path}: BLF has no time before its start, as {time_ns * 1e-9:.6f} s is; "
                            ".log and .asc have")
        self._writer.time_ns = time_ns - self._start_ns
        self._writer.on_message_received(can.Message(
            timestamp=time_ns * 1e-9,
            arbitration_id=message.arbitration_id,
            is_extended_id=message.is_extended_id,
            is_remote_frame=message.is_remote_frame,
            is_error_frame=message.is_error_frame,
            is_fd=message.is_fd,
            bitrate_switch=message.bitrate_switch,
            error_state_indicator=message.error_state_indicator,
            dlc=message.dlc,
            data=message.data,
        ))

    @property
    def size(self) -> int:
        return self._writer.file_size()

    def close(self) -> None:
        self._writer.stop()
        if self._start_ns:  # python-can has no date before 1990
            start = _EPOCH + timedelta(milliseconds=self._start_ns // _MS_NS)
            with self.path.open("r+b") as file:
                file.seek(_BLF_START_OFFSET)
                file.write(struct.pack("<8H", start.year, start.month, start.isoweekday() % 7, start.day, start.hour,
                                       start.minute, start.second, start.microsecond // 1000))
            self._start_ns = 0


class TextLog(FileLog):
    """A log of one line for each frame."""

    def __init__(self, path: Path, header: str = "") -> None:
        super().__init__(path)
        self._file = path.open("w", encoding="utf-8", newline="\n")
        self._size = self._file.write(header)

    def add(self, text: str) -> None:
        """Appends text."""
        self._size += self._file.write(text)

    @property
    def size(self) -> int:
        return self._size

    def close(self) -> None:
        self._file.close()


class AscLog(TextLog):
    """An ASC file, all frames received on channel 1. The writer of python-can notes the time of day and counts from the
    first frame."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, f"date {_ASC_START}\nbase hex  timestamps absolute\ninternal events logged\n"
                         f"Begin Triggerblock {_ASC_START}\n   0.000000 Start of measurement\n")

    def write(self, time_ns: int, message: can.Message) -> None:
        """Appends a frame."""
        self.add(f"{_microseconds(time_ns):>11} {_asc_event(message)}\n")

    def close(self) -> None:
        if not self._file.closed:
            self.add("End TriggerBlock\n")
        super().close()


class CandumpLog(TextLog):
    """Text as `candump -L` writes it: (seconds.microseconds) interface identifier#data."""

    def __init__(self, path: Path, interface: str = "can0") -> None:
        super().__init__(path)
        self._interface = interface

    def write(self, time_ns: int, message: can.Message) -> None:
        """Appends a frame."""
        self.add(candump_line(time_ns, message, self._interface) + "\n")


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
    seconds, microseconds = divmod(abs(time_ns) // 1000, 1_000_000)
    return f"{'-' if time_ns <= -1000 else ''}{seconds}.{microseconds:06d}"


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


def parts_of(path: Path) -> list[Path]:
    """The files there are that a RotatingLog of this path would write, should it be long enough."""
    name = re.compile(rf"{re.escape(path.stem)}_[0-9]{{{_NUMBER_DIGITS},}}{re.escape(path.suffix)}")
    return [each for each in path.parent.glob("*") if name.fullmatch(each.name)]


class RotatingLog:
    """A log that continues in another file, FILE_0001, FILE_0002, ..., when one has its size or its time; each is
    complete. A frame is in one of them."""

    def __init__(self, path: Path, rotation: Rotation, make: Callable[[Path], Log]) -> None:
        self._path, self._rotation, self._make = path, rotation, make
        self._files = 0
        self._finished = 0
        self._first_ns: int | None = None
        self._log = self._next()

    def _next(self) -> Log:
        self._files += 1
        return self._make(self._file(self._files))

    def _file(self, number: int) -> Path:
        return self._path.with_stem(f"{self._path.stem}_{number:0{_NUMBER_DIGITS}d}")

    def write(self, time_ns: int, message: can.Message) -> None:
        """Appends a frame, to the next file when this one is full."""
        if self._first_ns is None:
            self._first_ns = time_ns
        elif (time_ns - self._first_ns if self._rotation.is_time else self._log.size) >= self._rotation.limit:
            self._finished += self._log.size
            self._log.close()
            self._log, self._first_ns = self._next(), time_ns
        self._log.write(time_ns, message)

    @property
    def size(self) -> int:
        return self._finished + self._log.size

    @property
    def place(self) -> str:
        first, last = self._file(1), self._file(self._files)
        return str(first) if first == last else f"{first} to {last.name}"

    def close(self) -> None:
        self._log.close()

    def discard(self) -> None:
        """Completes and removes all files."""
        self._log.discard()
        for number in range(1, self._files):
            self._file(number).unlink(missing_ok=True)


def open_log(path: Path, machine: str | None = None, node: int = 0, source: str = "",
             rotation: Rotation | None = None, others: Sequence[Database] = ()) -> Log:
    """A log by its suffix. machine, node: those whose DBC decodes the frames of MF4, CSV and Parquet, by default the
    machine that the drive reports; others: databases of other nodes, likewise. source: of the frames, for messages.
    rotation: see RotatingLog. UsageError: the suffix is not one of LOG_SUFFIXES, or the file cannot be made."""
    if path.suffix not in LOG_SUFFIXES:
        raise UsageError(f"--out {path}: the suffix must be {either(LOG_SUFFIXES)}")
    carrier = Carrier(source or str(path), machine, node) if path.suffix in DECODED_SUFFIXES else None

    def make(file: Path) -> Log:
        if carrier is not None:
            return _decoded_log(file, carrier, node, source or str(path), others)
        formats: dict[str, Callable[[Path], Log]] = {".blf": BlfLog, ".asc": AscLog, ".log": CandumpLog}
        return formats[path.suffix](file)

    try:
        return make(path) if rotation is None else RotatingLog(path, rotation, make)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}") from None


def _decoded_log(path: Path, carrier: Carrier, node: int, source: str, others: Sequence[Database]) -> Log:
    if path.suffix == ".mf4":
        from salient.bus.mf4 import Mf4Log  # asammdf loads pandas: a second that only this format needs

        return Mf4Log(path, carrier, node, source, others)
    from salient.bus.signal_tables import CsvLog, ParquetLog

    return (CsvLog if path.suffix == ".csv" else ParquetLog)(path, carrier, node, source, others)


def write_logs(frames: Iterable[tuple[int, can.Message]], *paths: Path) -> None:
    """Writes the same frames to each path."""
    logs = [open_log(path) for path in paths]
    for time_ns, message in frames:
        for log in logs:
            log.write(time_ns, message)
    for log in logs:
        log.close()
