"""Databases of the other nodes of a bus: DBC files of their makers, beside the drive's and its test bench's."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal, InvalidOperation
from itertools import count
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can import Database, Message, Signal
from cantools.database.can.formats.dbc import ATTRIBUTE_DEFINITION_VFRAMEFORMAT

from salient.bus.signals import FrameKey, big_endian_bit, drive_database, frame_key, raw_range, rig_database
from salient.errors import SHOWN_MAX, UsageError, shown
from salient.machine.map_import.text import decode
from salient.toml_file import TextFileError, read_bytes

OPTION = "--dbc"
_REASON_MAX = 160  # characters of what the parser says
_FILE_BYTES_MAX = 100_000_000
_MESSAGE_BYTES_MAX = 100_000
"""Length of a message of a transport protocol; J1939 has 1785 bytes, ISO 15765 4095."""
_RANGE_MAX, _RANGES_MAX = 4096, 100_000
"""Values of a multiplexer in a range, and in all ranges of a file: a signal is there with any of them."""
_CYCLE_MAX_MS = 1_000_000_000
_FRAME_BYTES_MAX = 64
_BITS_MAX = 64
"""Length of a signal that is decoded."""
_MULTIPLEXER_MAX = 2**_BITS_MAX - 1
_PARSERS = ("cantools", "textparser")
_FRAME_FORMAT, _PLACE = "VFrameFormat", "place"
_LISTED = ("GenMsgSendType", _FRAME_FORMAT)
"""Attributes whose numbers the parser takes for places in their lists."""
_DEFINITION = re.compile(r'(?m)^\s*BA_DEF_(?:REL_)?\s+(?:\w+_\s+)?"([^"]*)"\s+(\w+)\s*((?:"[^"]*"|[^";])*);')
_STATEMENT = re.compile(r'''(?mx) ^[ \t]* (?:
    BA_(?P<default>DEF_DEF_)?(?:REL_)? \s+ "(?P<name>[^"]*)" \s+ [^";]*? (?P<value>"[^"]*"|[^\s";]+) \s* ;
    | VAL_ \s+ \w+ \s+ (?:\w+ \s+)? (?P<names>(?:[^\s";]+ \s+ "[^"]*" \s*)+) ;)''')


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
    if reason := _too_large(text):
        raise UsageError(f"{OPTION} {path}: no valid DBC: {reason}")
    logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of is an error here
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=False, prune_choices=False)
    except Exception as error:  # the parser raises whatever a text leads it to
        raise UsageError(f"{OPTION} {path}: no valid DBC: {_reason(error, text)[:_REASON_MAX]}") from None
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
        _check_names(path, message)
        _check_cycle(path, message)
        _check(path, message)
        _name_signals(path, message)
    if not database.messages:
        raise UsageError(f"{OPTION} {path}: no valid DBC: it defines no message that a frame carries")
    return database


def _too_large(text: str) -> str:
    """Refuses numbers for each of whose units the parser takes time and memory; empty without any."""
    bits_max = 8 * _MESSAGE_BYTES_MAX
    for name, length in re.findall(r"(?m)^[ \t]*BO_ +\S+ +(\w+) *: *([0-9]+)", text):
        if _above(length, _MESSAGE_BYTES_MAX):
            return f"{name} has {length[:SHOWN_MAX]} bytes, at most {_MESSAGE_BYTES_MAX}"
    for name, start, length in re.findall(r"(?m)^[ \t]*SG_ +(\w+)[^:\n]*: *([0-9]+)\|([0-9]+)@", text):
        if _above(start, bits_max) or _above(length, bits_max):
            return f"{name} has {length[:SHOWN_MAX]} bits from bit {start[:SHOWN_MAX]} on, at most {bits_max}"
    every = 0
    for name, ranges in re.findall(r"(?m)^[ \t]*SG_MUL_VAL_ +\S+ +(\w+) +\w+ +([^;]*);", text):
        for low, high in re.findall(r"([0-9]+) *- *([0-9]+)", ranges):
            values = _RANGE_MAX + 1
            if not (_above(low, _MULTIPLEXER_MAX) or _above(high, _MULTIPLEXER_MAX)):
                values = max(0, int(high) - int(low) + 1)
            if values > _RANGE_MAX:
                return f"{name} is there from {low[:SHOWN_MAX]} to {high[:SHOWN_MAX]}, at most {_RANGE_MAX} values"
            every += values
    return "" if every <= _RANGES_MAX else f"{every} values in ranges SG_MUL_VAL_, at most {_RANGES_MAX}"


def _above(digits: str, limit: int) -> bool:
    """Whether a number is larger, which may have more digits than Python converts."""
    digits = digits.lstrip("0")
    return len(digits) > len(str(limit)) or int(digits or "0") > limit


def _reason(error: Exception, text: str) -> str:
    """Words of the parser about a text where these are meant for a reader, else the statement that it fails for."""
    cause = getattr(error, "e_dbc", None) or error
    words = " ".join(str(cause).split())
    if type(cause).__module__.partition(".")[0] in _PARSERS and words:
        return words
    return _mistake(text) or f"the parser ends with {type(cause).__name__}{f': {words}' if words else ''}"


def _mistake(text: str) -> str:
    """The first statement with a value that its definition does not have, and that the parser takes for one; empty
    when there is none."""
    kinds = {name: (kind, len(re.findall(r'"[^"]*"', rest))) for name, kind, rest in _DEFINITION.findall(text)}
    if kinds.get(_FRAME_FORMAT, ("", 0))[0] == "INT":
        kinds[_FRAME_FORMAT] = _PLACE, len(ATTRIBUTE_DEFINITION_VFRAMEFORMAT.choices)
    for found in _STATEMENT.finditer(text):
        line, name, value = text.count("\n", 0, found.start()) + 1, found["name"], (found["value"] or "").strip('"')
        if found["names"] is not None:
            wrong = next((each for each in re.findall(r'([^\s"]+)\s+"[^"]*"', found["names"])
                          if not re.fullmatch(r"[-+]?[0-9]+", each)), None)
            if wrong is not None:
                return f"line {line}: VAL_ names {shown(wrong)}: must be a whole number"
            continue
        if name not in kinds:
            return f"line {line}: the attribute {shown(name)} is not defined (BA_DEF_)"
        kind, entries = kinds[name]
        try:
            by_text = kind == "STRING" or (kind == "ENUM" and found["default"])
            number = None if by_text else Decimal(value)
        except InvalidOperation:
            return f"line {line}: the attribute {shown(name)} is {shown(value)}: must be a number"
        if name in _LISTED and kind in ("ENUM", _PLACE) and number is not None and not 0 <= number < entries:
            return f"line {line}: the attribute {shown(name)} is {value}: must be 0 to {entries - 1}, as its list has"
    return ""


def _say(path: Path, text: str) -> None:
    print(f"salient: {OPTION} {path}: {text}", file=sys.stderr, flush=True)


def _check_names(path: Path, message: Message) -> None:
    """UsageError: an attribute gives a message, its sender or a signal a name that a command cannot have."""
    for name in (message.name, *message.senders, *(signal.name for signal in message.signals)):
        if not isinstance(name, str) or not re.fullmatch(r"[^\s.\x00-\x1f]+", name):
            raise UsageError(f"{OPTION} {path}: no valid DBC: {shown(name)} is no name of a message, signal or node "
                             "(attributes System...LongSymbol)")


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
        elif not _has_finite_values(signal):
            reason = "has values beyond a floating-point number of 64 bits by its factor and offset"
        if reason:
            _say(path, f"{message.name}.{signal.name} {reason} and is left out")
            message.signals.remove(signal)
            continue
        _drop_what_no_frame_has(signal)
    while selected := next((signal for signal in message.signals if not _is_selected(message, signal)), None):
        _say(path, f"{message.name}.{selected.name} is selected by {selected.multiplexer_signal}, which no frame has, "
                   "and is left out")
        message.signals.remove(selected)


def _is_selected(message: Message, signal: Signal) -> bool:
    """Whether the chain of multiplexers that select a signal ends."""
    by_name = {each.name: each for each in message.signals}
    for _ in message.signals:
        if not signal.multiplexer_ids or signal.multiplexer_signal is None:
            return True
        if signal.multiplexer_signal not in by_name:
            return False
        signal = by_name[signal.multiplexer_signal]
    return False


def _has_finite_values(signal: Signal) -> bool:
    """Whether factor and offset make no number too large of those that the bits of a signal have; a floating-point
    signal is infinite by its own bits, too, which is no mistake of the database."""
    raw = (0, 1) if signal.is_float else raw_range(signal)
    try:
        return all(math.isfinite(number * float(signal.scale) + float(signal.offset)) for number in raw)
    except OverflowError:  # a whole number of hundreds of digits
        return False


def _drop_what_no_frame_has(signal: Signal) -> None:
    """Removes names of values that are wider than a signal, and limits that are no numbers."""
    if signal.choices and any(abs(number) >> _BITS_MAX for number in signal.choices):
        kept = ((number, text) for number, text in signal.choices.items() if not abs(number) >> _BITS_MAX)
        signal.choices = OrderedDict(kept)
    if not all(_is_number(limit) for limit in (signal.minimum, signal.maximum)):
        signal.minimum = signal.maximum = None


def _is_number(limit: float | None) -> bool:
    try:
        return limit is None or math.isfinite(limit)
    except OverflowError:
        return False


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
