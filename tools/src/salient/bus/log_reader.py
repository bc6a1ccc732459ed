"""Frames of a log file, and the conversion of a log into another format. Every command that reads logs does it here."""

from __future__ import annotations

import contextlib
import sqlite3
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import can
from cantools.database.can import Database

from salient.bus.blf_reader import read_blf
from salient.bus.clock import nodes_of_messages
from salient.bus.databases import messages_of
from salient.bus.log import DECODED_SUFFIXES, open_log, parts_of
from salient.bus.log_input import Damage, LogInput
from salient.bus.mf4_reader import read_mf4
from salient.bus.signals import FrameKey, FrameKeys, frame_key
from salient.bus.text_logs import Frames, nanoseconds, read_text
from salient.config import READABLE_SUFFIXES, Rotation, either
from salient.errors import RunFailed, UsageError
from salient.paths import keep_sources

_TIME_MAX_NS = 1 << 62  # a century and a half; the columns of signals have 64 bits


class LogDamaged(RunFailed):
    """A log was read up to its damage, or without what is no frame of it; the text says where, and how many frames
    there were."""


class NoKnownFrame(RunFailed):
    """A log has no frame of a drive, its test bench or another node with a database."""


class KnownFrames:
    """Whether the frames of a log belong to a drive or its test bench, with a node number or any (None), or to other
    nodes, by their databases."""

    def __init__(self, node: int | None, others: Sequence[Database] = ()) -> None:
        self._node = node
        self._lengths = {frame_key(message): message.length for message in messages_of(others)}
        self._names = {frame_key(message): message.name for message in messages_of(others)}
        self._keys = FrameKeys(messages_of(others))
        self._short: dict[FrameKey, tuple[int, int]] = {}
        self._others: set[int] = set()
        self._count = 0
        self.found = False

    def add(self, message: can.Message) -> None:
        """Takes a frame."""
        self._count += 1
        if (self.found and not self._lengths) or message.is_error_frame or message.is_remote_frame:
            return
        of_file = self._keys.find(message.arbitration_id, message.is_extended_id)
        length = self._lengths.get(of_file)
        if length is not None and length > len(message.data):
            self._short[of_file] = self._short.get(of_file, (0, 0))[0] + 1, len(message.data)
        self.found = self.found or (length is not None and length <= len(message.data))
        if self.found or message.is_fd:
            return
        key = (message.arbitration_id, message.is_extended_id, len(message.data))
        nodes = nodes_of_messages().get(key, frozenset())
        self.found = bool(nodes) if self._node is None else self._node in nodes
        if not self.found and len(nodes) == 1:  # the time of the test bench is common to all drives
            self._others |= nodes

    @property
    def short(self) -> str:
        """Messages of other nodes with fewer bytes than their database states, for a line; empty without any."""
        return ", ".join(f"{count} frames of {self._names[key]} ({length} instead of {self._lengths[key]} bytes)"
                         for key, (count, length) in sorted(self._short.items()))

    def require(self, where: str, end: str = "") -> None:
        """NoKnownFrame: there was none. end: of the message."""
        if self.found:
            return
        node = "" if self._node is None else f" with node number {self._node} (--node)"
        files = " or of the messages of --dbc" if self._lengths else ""
        others = f", but of node {' and '.join(map(str, sorted(self._others)))}" if self._others else ""
        short = f"; too short: {self.short}" if self._short else ""
        raise NoKnownFrame(f"{where}: none of {self._count} frames is of a drive{node}{files}{others}{short}{end}")


def convert(source: Path, target: Path, machine: str | None, node: int = 0, rotation: Rotation | None = None,
            others: Sequence[Database] = ()) -> tuple[int, str]:
    """Writes the frames of a log to another, whose suffix is the format; returns their number and the place.
    rotation, others: see open_log.

    UsageError: a file cannot be read or written, or the log would be overwritten; OtherDatabase: see Carrier; then
    there is no target. LogDamaged: see read_log; the target has the frames before. NoKnownFrame: there is none of a
    drive, and of a format with decoded signals no target either.
    """
    keep_sources(f"--out {target}", [target] if rotation is None else parts_of(target), source)
    frames = read_log(source)
    first = next(frames, None)  # a file of another format leaves an existing target as it is
    if first is None:
        raise NoKnownFrame(f"--convert {source}: the log has no frame")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {target}: {error.strerror}") from None
    decodes = target.suffix in DECODED_SUFFIXES
    known = KnownFrames(node if decodes else None, others)
    log = open_log(target, machine, node, str(source), rotation, others)
    count, damage = 0, ""
    try:
        try:
            while first is not None:
                log.write(*first)
                known.add(first[1])
                count += 1
                first = next(frames, None)
        except LogDamaged as error:
            damage = str(error)
        if decodes and not known.found:
            log.discard()
        else:
            log.close()
    except (UsageError, RunFailed):
        log.discard()
        raise
    except OSError as error:
        raise UsageError(f"--out {target}: {error.strerror}") from None
    known.require(damage or f"--convert {source}", "" if decodes else f"; they are in {log.place}")
    if decodes and known.short:
        print(f"salient: --convert {source}: left out as too short for --dbc: {known.short}", file=sys.stderr)
    if damage:
        raise LogDamaged(f"{damage}, which are in {log.place}")
    return count, log.place


def read_log(path: Path, option: str = "--convert") -> Iterator[tuple[int, can.Message]]:
    """Time in ns and frame, in the order of the file.

    UsageError: the suffix or the file cannot be read, or no frame is before its damage; LogDamaged, after the
    frames that can be read: the rest cannot be, or something that is no frame was left out. Both begin with the option.
    The work is bounded by the size of the file, the memory by a constant.
    """
    suffix = Path(path.stem).suffix.lower() if path.suffix.lower() == ".gz" else path.suffix.lower()
    if suffix not in READABLE_SUFFIXES:
        raise UsageError(f"{option} {path}: the suffix must be {either(READABLE_SUFFIXES)}, or one of them and .gz")
    count = 0
    left_out = ""
    try:
        with contextlib.closing(LogInput(path)) as file:
            for time_ns, message in _frames(file, path, suffix):
                _check(time_ns, message, count)
                yield time_ns, message
                count += 1
            left_out = file.left_out
    except Damage as damage:
        if count == 0:
            raise UsageError(f"{option} {path}: not readable as {suffix}: {damage}") from None
        raise LogDamaged(f"{option} {path}: {damage}; {count} frames before") from None
    except OSError as error:
        raise UsageError(f"{option} {path}: {error.strerror or error}") from None
    if left_out:
        raise LogDamaged(f"{option} {path}: {left_out}; {count} frames")


def _frames(file: LogInput, path: Path, suffix: str) -> Frames:
    if suffix == ".blf":
        return read_blf(file)
    if suffix == ".mf4":
        return read_mf4(file, path)
    if suffix == ".db":
        return _read_database(path)
    return read_text(file, suffix)


def _check(time_ns: int, message: can.Message, count: int) -> None:
    """Damage: no bus can have a frame, or its time is centuries off. count: frames before."""
    length = len(message.data)
    longest = 64 if message.is_fd else 8
    if message.arbitration_id > (0x1FFFFFFF if message.is_extended_id or message.is_error_frame else 0x7FF):
        raise Damage(f"after frame {count}: identifier {message.arbitration_id:X} is too large")
    if length > longest or not 0 <= message.dlc <= (64 if message.is_fd else 15):
        raise Damage(f"after frame {count}: a frame of length {message.dlc} with {length} data bytes")
    if abs(time_ns) > _TIME_MAX_NS:
        raise Damage(f"after frame {count}: a time of {time_ns * 1e-9:.6g} s")


def _read_database(path: Path) -> Frames:
    """The frames of an SQLite file that python-can has written; it does not say that a frame has a flexible data rate,
    and has times as floats."""
    connection = sqlite3.connect(f"file:{path.resolve().as_posix().replace('?', '%3f').replace('#', '%23')}?mode=ro",
                                 uri=True)
    count = 0
    try:
        cursor = connection.execute("SELECT ts, arbitration_id, extended, remote, error, dlc, data FROM messages")
        for time_s, identifier, extended, remote, error, dlc, data in cursor:
            count += 1
            yield nanoseconds(repr(float(time_s))), can.Message(
                arbitration_id=int(identifier), is_extended_id=bool(extended), is_remote_frame=bool(remote),
                is_error_frame=bool(error), is_fd=len(data or b"") > 8, dlc=int(dlc),
                data=b"" if remote else bytes(data or b""))
    except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
        raise Damage(f"after row {count}: {error}") from None
    finally:
        connection.close()
