"""Databases of the other nodes of a bus: DBC files of their makers, beside the drive's and its test bench's."""

from __future__ import annotations

import logging
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can import Database, Message

from salient.bus.signals import FrameKey, big_endian_bit, drive_database, frame_key, rig_database
from salient.errors import UsageError, shown
from salient.machine.map_import.text import decode
from salient.toml_file import TextFileError, read_bytes

OPTION = "--dbc"
_REASON_MAX = 160  # characters of what the parser says
_FILE_BYTES_MAX = 100_000_000
_MESSAGE_BYTES_MAX = 100_000
"""Length of a message of a transport protocol; J1939 has 1785 bytes, ISO 15765 4095."""
_CYCLE_MAX_MS = 1_000_000_000
_FRAME_BYTES_MAX = 64
_BITS_MAX = 64
"""Length of a signal that is decoded."""


def load_databases(paths: Sequence[Path], node: int = 0) -> tuple[Database, ...]:
    """The databases of files, beside the databases of the drive with a node number and its test bench.

    A message whose name another one has is named FILE:MESSAGE; its first sender is the node to which it belongs, FILE
    where the file names none (`node_of`). UsageError, a line that begins with the option: a file cannot be read or is
    no DBC; it defines no message, or an identifier twice, or one that another database defines, the drive's included.
    """
    owners: dict[FrameKey, tuple[str, str]] = {}
    names: set[str] = set()
    for database, owner in ((drive_database(None, node), f"the drive with node number {node} (--node)"),
                            (rig_database(node), "its test bench")):
        for message in database.messages:
            owners[frame_key(message)] = owner, message.name
            names.add(message.name)
    reserved = {sender for database in (drive_database(None), rig_database()) for message in database.messages
                for sender in message.senders}
    loaded = []
    for path in paths:
        database = _load(path)
        for message in database.messages:
            owner, other = owners.setdefault(frame_key(message), (str(path), message.name))
            if (owner, other) != (str(path), message.name):
                raise UsageError(f"{OPTION} {path}: {message.name} has the identifier "
                                 f"{identifier_text(*frame_key(message))} of {other} of {owner}")
        label = re.sub(r"\W", "_", path.stem)
        _name_messages(database, path, label, names, reserved)
        loaded.append(database)
    return tuple(loaded)


def node_of(message: Message) -> str:
    """The node that sends a message of load_databases."""
    return message.senders[0]


def identifier_text(identifier: int, is_extended: bool) -> str:
    """An identifier in hexadecimal digits, as many as it may have."""
    return f"{identifier:0{8 if is_extended else 3}X}"


def _load(path: Path) -> Database:
    try:
        text = decode(read_bytes(path, _FILE_BYTES_MAX))
    except TextFileError as error:
        raise UsageError(f"{OPTION} {path}: {error}") from None
    for name, length in re.findall(r"(?m)^[ \t]*BO_ +\S+ +(\w+) *: *([0-9]+)", text):
        if int(length) > _MESSAGE_BYTES_MAX:  # the parser takes time and memory for each bit of it
            raise UsageError(f"{OPTION} {path}: no valid DBC: {name} has {shown(int(length))} bytes, at most "
                             f"{_MESSAGE_BYTES_MAX}")
    logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of is an error here
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=False, prune_choices=False)
    except Exception as error:  # the parser raises whatever a text leads it to
        reason = " ".join(str(getattr(error, "e_dbc", error)).split()) or type(error).__name__
        raise UsageError(f"{OPTION} {path}: no valid DBC: {reason[:_REASON_MAX]}") from None
    assert isinstance(database, Database)
    if not database.messages:
        raise UsageError(f"{OPTION} {path}: no valid DBC: it defines no message")
    occurrences = Counter(map(frame_key, database.messages))
    for message in list(database.messages):
        if occurrences[frame_key(message)] > 1:
            raise UsageError(f"{OPTION} {path}: no valid DBC: {message.name} has the identifier "
                             f"{identifier_text(*frame_key(message))} of another message of the file")
        if message.length > _FRAME_BYTES_MAX:  # of a transport protocol: J1939, ISO 15765
            _say(path, f"{message.name} has {message.length} bytes, a frame at most {_FRAME_BYTES_MAX}, and is left "
                       "out")
            database.messages.remove(message)
            continue
        _check_cycle(path, message)
        _check(path, message)
        _name_signals(path, message)
    if not database.messages:
        raise UsageError(f"{OPTION} {path}: no valid DBC: it defines no message that a frame carries")
    return database


def _say(path: Path, text: str) -> None:
    print(f"salient: {OPTION} {path}: {text}", file=sys.stderr, flush=True)


def _check_cycle(path: Path, message: Message) -> None:
    """Leaves a cycle time out, with a line, that is no time: its attribute can have any type and value."""
    cycle: Any = message.cycle_time
    if cycle is None or (isinstance(cycle, int | float) and 0 <= cycle <= _CYCLE_MAX_MS):
        return
    _say(path, f"{message.name} has the cycle time {shown(cycle)}, which is left out; it is a number of ms from 0 to "
               f"{_CYCLE_MAX_MS}")
    message.cycle_time = None


def _check(path: Path, message: Message) -> None:
    """Leaves signals out, with a line, that a frame of the message cannot carry or that have too many bits."""
    for signal in list(message.signals):
        big_endian = signal.byte_order == "big_endian"
        first = big_endian_bit(signal) if big_endian else signal.start
        reason = ""
        if not 0 <= first < first + signal.length <= 8 * message.length:
            reason = f"is beyond the {message.length} bytes of the message"
        elif signal.is_float and signal.length not in (16, 32, 64):
            reason = f"is a floating-point number of {signal.length} bits"
        elif signal.length > _BITS_MAX:
            reason = f"has {signal.length} bits, more than {_BITS_MAX},"
        if reason:
            _say(path, f"{message.name}.{signal.name} {reason} and is left out")
            message.signals.remove(signal)


def _name_signals(path: Path, message: Message) -> None:
    """Gives signals of one name others by their number."""
    names = {signal.name for signal in message.signals}
    counts: Counter[str] = Counter()
    for signal in message.signals:
        counts[signal.name] += 1
        if counts[signal.name] == 1:
            continue
        name = next(name for number in count(counts[signal.name]) if (name := f"{signal.name}_{number}") not in names)
        _say(path, f"{message.name} has several signals {signal.name}; the one of bit {signal.start} is {name}")
        names.add(name)
        signal.name = name


def _name_messages(database: Database, path: Path, label: str, names: set[str], reserved: Iterable[str]) -> None:
    """Gives the messages names and nodes that no other has. label: of the file."""
    for message in database.messages:
        if message.name in names:
            message.name = f"{label}:{message.name}"
        if message.name in names:
            message.name = f"{message.name}_{identifier_text(*frame_key(message))}"
        names.add(message.name)
    if not any(message.senders for message in database.messages):
        print(f"salient: {OPTION} {path}: names no node that sends: its messages are those of {label}",
              file=sys.stderr, flush=True)
    for message in database.messages:
        sender = next(iter(message.senders), label)
        message.senders.insert(0, f"{label}:{sender}" if sender in reserved else sender)


def messages_of(databases: Iterable[Database]) -> Iterator[Message]:
    """The messages of some databases, by identifier within each."""
    for database in databases:
        yield from sorted(database.messages, key=lambda message: message.frame_id)
