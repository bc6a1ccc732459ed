"""Signals by name from CAN frames, decoded by the DBC files, whole columns at a time."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

import can
import cantools
import numpy as np
from cantools.database.can import Database, Message

from salient.dbc import FIRST_PHASES, drive_dbc_of_node, drive_dbc_of_phases, rig_dbc_of_node
from salient.errors import close_names
from salient.machine.file import load_machine, machine_path
from salient.machine.scaling import database_of, scaling_of
from salient.paths import DRIVE_DBC, RIG_DBC

FrameKey = tuple[int, bool]
_TIME_BYTES, _WORD_BYTES = 8, 8
_FLOAT_BITS = 53
_NULL_ADDRESS, _BROADCAST_FORMAT = 0xFE, 240  # J1939-81, J1939-21


@lru_cache
def drive_database(machine: str | None = None, node: int = 0) -> Database:
    """The DBC of the drive of a machine, given by name or file, with its factors and ranges, without a machine that in
    SI units; and with the identifiers of a node number. MachineError."""
    if machine is None:
        text = drive_dbc_of_phases(DRIVE_DBC.read_text(encoding="ascii"), FIRST_PHASES)
    else:
        path = machine_path(machine)
        text = scaling_of(path, load_machine(path)).dbc()
    return database_of(drive_dbc_of_node(text, node))


@lru_cache
def rig_database(node: int = 0) -> Database:
    """The DBC of the test bench of a drive with a node number."""
    return database_of(rig_dbc_of_node(RIG_DBC.read_text(encoding="ascii"), node))


def near_signals(name: str, known: Iterable[str]) -> str:
    """close_names of a signal: SIGNAL among the signals, MESSAGE.SIGNAL among the message's, or all when there
    is no such message. known: names of which those in the form MESSAGE.SIGNAL count."""
    full = [each for each in known if "." in each]
    message, dot, _ = name.partition(".")
    of_message = [each for each in full if dot and each.startswith(f"{message}.")]
    return close_names(name, of_message or (full if dot else sorted({each.partition(".")[2] for each in full})))


def no_message(name: str, messages: Iterable[Message]) -> KeyError:
    """The error for a message that a node does not send."""
    return KeyError(f"no message '{name}'; {close_names(name, [message.name for message in messages])}")


def value_numbers(database: Database, message: str, signal: str) -> dict[str, int]:
    """Raw value by name of a signal with a value table, in the order of the values."""
    choices: Mapping[int, object] = database.get_message_by_name(message).get_signal_by_name(signal).choices or {}
    return {str(text): int(number) for number, text in sorted(choices.items())}


def signal_range(signal: cantools.database.can.Signal) -> tuple[float, float]:
    """Minimum and maximum in the signal's unit; ValueError when the DBC has none."""
    if signal.minimum is None or signal.maximum is None:
        raise ValueError(f"{signal.name}: no range in the DBC")
    return signal.minimum, signal.maximum


@dataclass(frozen=True)
class Signal:
    """One signal over time: `value[i]`, in `unit`, was on the bus at virtual time `time_s[i]`."""

    name: str
    unit: str
    time_s: np.ndarray
    value: np.ndarray
    choices: Mapping[float, str] | None = None
    """Names by value, not by raw value."""

    def __len__(self) -> int:
        return len(self.value)

    def __repr__(self) -> str:
        """Short: a failed assertion prints it."""
        if not len(self):
            return f"<{self.name}: no value yet>"
        last = self.last_name if self.choices else f"{self.last:g} {self.unit}".rstrip()
        return f"<{self.name}: {len(self)} values, the last one {last} at {self.last_time_s:g} s>"

    @property
    def last(self) -> float:
        """The latest value; not-a-number, for which no comparison is true, before the first."""
        return self.value[-1].item() if len(self.value) else math.nan

    @property
    def last_time_s(self) -> float:
        """Time of the latest value; minus infinity before the first."""
        return self.time_s[-1].item() if len(self.time_s) else -math.inf

    @property
    def last_name(self) -> str:
        """The latest value by its name in the DBC, for signals with named values; "unknown" before the first."""
        return self.name_of(self.last, str(self.last)) if len(self.value) else "unknown"

    def name_of(self, value: float, otherwise: str = "") -> str:
        """The name of a value in the DBC."""
        return (self.choices or {}).get(value, otherwise)

    def between(self, from_s: float, to_s: float) -> Signal:
        """The part with from_s <= time < to_s."""
        inside = (self.time_s >= from_s) & (self.time_s < to_s)
        return Signal(self.name, self.unit, self.time_s[inside], self.value[inside], self.choices)


class SignalTable(Mapping[str, Signal]):
    """The signals of the messages that one node sends, or all without a sender, filled frame by frame. A multiplexed
    signal has the frames that carry it.

    table["speed_rpm"] is the signal of that name in the message with the lowest identifier that has one;
    table["DRIVE_FAULT_SNAPSHOT.speed_rpm"] names its message. KeyError names the nearest.
    """

    def __init__(self, database: Database, sender: str | None = None) -> None:
        self._sender = sender
        self._times: dict[tuple[int, bool], array[int]] = {}
        self._data: dict[tuple[int, bool], bytearray] = {}
        self._length: dict[tuple[int, bool], int] = {}
        self._width: dict[tuple[int, bool], int] = {}
        self.frames = 0
        """Number of frames of all messages."""
        self.memory_bytes = 0
        """Memory of their times and data."""
        self.decode_with(database)
        for key, message in self._messages.items():
            self._times[key], self._data[key] = array("q"), bytearray()
            self._length[key] = message.length
            self._width[key] = max(_WORD_BYTES, message.length)

    def decode_with(self, database: Database) -> None:
        """Decodes by another database from here on, what there is already as well: another machine's, which has the
        same messages with other factors."""
        self._messages: dict[FrameKey, Message] = {}
        self._names: dict[str, tuple[FrameKey, cantools.database.can.Signal]] = {}
        for message in sorted(database.messages, key=lambda m: m.frame_id):
            if self._sender is not None and self._sender not in message.senders:
                continue
            key = frame_key(message)
            self._messages[key] = message
            for signal in message.signals:
                self._names.setdefault(signal.name, (key, signal))
                self._names[f"{message.name}.{signal.name}"] = (key, signal)

    def add(self, time_ns: int, message: can.Message) -> None:
        """Adds a frame if the node sends it and its length is as in the DBC."""
        key = (message.arbitration_id, message.is_extended_id)
        data = message.data
        if self._length.get(key) != len(data) or message.is_remote_frame or message.is_fd or message.is_error_frame:
            return
        self._times[key].append(time_ns)
        self._data[key] += data if len(data) == 8 else data.ljust(8, b"\0")
        self.frames += 1
        self.memory_bytes += _TIME_BYTES + _WORD_BYTES

    def clear(self) -> None:
        """Forgets all frames."""
        for key, times in self._times.items():
            if times:
                self._times[key], self._data[key] = array("q"), bytearray()
        self.frames = self.memory_bytes = 0

    def __getitem__(self, name: str) -> Signal:
        if name not in self._names:
            raise KeyError(f"no signal '{name}'; {near_signals(name, self._names)}")
        raw, time_ns = self._columns(name)
        signal = self._names[name][1]
        return Signal(signal.name, signal.unit or "", time_ns / 1e9, physical(raw, signal), names_of_values(signal))

    def _columns(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Data and times of the frames that carry a signal; data: see raw_bits."""
        key, signal = self._names[name]
        frames = np.frombuffer(bytes(self._data[key]), dtype=np.uint8).reshape(-1, self._width[key])
        time_ns = np.array(self._times[key], dtype=np.int64)
        message = self._messages[key]
        while (multiplexer := multiplexer_of(message, signal)) is not None:
            carries = np.isin(raw_bits(frames, multiplexer), signal.multiplexer_ids or [])
            frames, time_ns = frames[carries], time_ns[carries]
            signal = multiplexer
        return frames, time_ns

    def exact(self, name: str) -> list[int] | None:
        """Whole values of a signal whose bits are more than the ones of a float; None of another one."""
        signal = self._names[name][1]
        scale, offset = float(signal.scale), float(signal.offset)
        if signal.is_float or signal.length <= _FLOAT_BITS or not (scale.is_integer() and offset.is_integer()):
            return None
        return [int(scale) * value + int(offset) for value in whole(self._columns(name)[0], signal).tolist()]

    def times_ns(self, name: str) -> np.ndarray:
        """Times of a signal without the rounding to the floats of `Signal`."""
        return self._columns(name)[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def count(self, message_name: str) -> int:
        """Number of frames of a message; KeyError when the node sends none of that name."""
        return len(self._times[self._key_of(message_name)])

    def _key_of(self, message_name: str) -> tuple[int, bool]:
        for key, message in self._messages.items():
            if message.name == message_name:
                return key
        raise no_message(message_name, self._messages.values())


class LatestSignals(SignalTable):
    """The latest frame of each message: for what runs for days."""

    def __init__(self, database: Database, sender: str) -> None:
        super().__init__(database, sender)
        self._latest: dict[tuple[int, bool], tuple[int, bytearray]] = {}
        self._counts = dict.fromkeys(self._length, 0)

    def add(self, time_ns: int, message: can.Message) -> None:
        key = (message.arbitration_id, message.is_extended_id)
        if self._length.get(key) != len(message.data) or message.is_remote_frame or message.is_error_frame:
            return
        self._latest[key] = (time_ns, message.data)
        self._counts[key] += 1

    def __getitem__(self, name: str) -> Signal:
        if name in self._names and (key := self._names[name][0]) in self._latest:
            time_ns, data = self._latest[key]
            self._times[key], self._data[key] = array("q", [time_ns]), data.ljust(8, b"\0")
        return super().__getitem__(name)

    def count(self, message_name: str) -> int:
        return self._counts[self._key_of(message_name)]


class BusSignals(SignalTable):
    """The signals of a database of other nodes: flexible data rate frames count, and frames that are longer than the
    message, as frames of a flexible data rate have to be."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self._keys = FrameKeys(database.messages)

    def add(self, time_ns: int, message: can.Message) -> None:
        key = self._keys.find(message.arbitration_id, message.is_extended_id)
        length = self._length.get(key)
        if length is None or length > len(message.data) or message.is_remote_frame or message.is_error_frame:
            return
        self._times[key].append(time_ns)
        self._data[key] += message.data[: self._width[key]].ljust(self._width[key], b"\0")
        self.frames += 1
        self.memory_bytes += _TIME_BYTES + self._width[key]


def frame_key(message: Message) -> FrameKey:
    """Key of the frames of a message of a database: identifier, and whether it is extended."""
    return message.frame_id, message.is_extended_frame


class FrameKeys:
    """The messages to which frames belong. A message of J1939 (VFrameFormat J1939PG) whose source is the null address,
    as in databases of the standard, comes from any source with any priority, one for a destination to any."""

    def __init__(self, messages: Iterable[Message]) -> None:
        listed = list(messages)
        self.exact = {frame_key(message) for message in listed}
        self._groups = {group_of(message.frame_id): frame_key(message) for message in listed
                        if is_of_any_source(message)}
        self.of_any_source = frozenset(self._groups.values())

    def find(self, identifier: int, is_extended: bool) -> FrameKey:
        """The key of the message of an identifier; itself without such a message."""
        key = identifier, is_extended
        if not is_extended or not self._groups or key in self.exact:
            return key
        return self._groups.get(group_of(identifier), key)


def is_of_any_source(message: Message) -> bool:
    """Whether frames of a message come from any source address."""
    return message.protocol == "j1939" and message.is_extended_frame and message.frame_id & 0xFF == _NULL_ADDRESS


def group_of(identifier: int) -> int:
    """Parameter group of a J1939 identifier, without source, priority and destination."""
    return identifier & (0x03FFFF00 if identifier >> 16 & 0xFF >= _BROADCAST_FORMAT else 0x03FF0000)


def names_of_values(signal: cantools.database.can.Signal) -> dict[float, str] | None:
    """Names of a signal by physical value; None without any."""
    scale, offset = float(signal.scale), float(signal.offset)
    return {int(number) * scale + offset: str(text) for number, text in (signal.choices or {}).items()} or None


def is_enumeration(signal: cantools.database.can.Signal) -> bool:
    """Whether a signal has named values only: in a quantity, with a unit or a factor, names are exceptions."""
    return bool(signal.choices) and not signal.unit and signal.scale == 1 and signal.offset == 0


def multiplexer_of(message: Message, signal: cantools.database.can.Signal) -> cantools.database.can.Signal | None:
    """The signal of a message that selects another, by its multiplexer_ids; None when that is always there."""
    if not signal.multiplexer_ids or signal.multiplexer_signal is None:
        return None
    return message.get_signal_by_name(signal.multiplexer_signal)


def physical(frames: np.ndarray, signal: cantools.database.can.Signal) -> np.ndarray:
    """Physical values of a signal, as floats. frames: see raw_bits."""
    if signal.is_float:
        bits = {16: "<u2", 32: "<u4", 64: "<u8"}[signal.length]
        field = raw_bits(frames, signal).astype(bits).view(bits.replace("u", "f"))
        with np.errstate(all="ignore"):  # infinite and not-a-number are values of its bits
            return np.asarray(field.astype(float) * float(signal.scale) + float(signal.offset))
    return whole(frames, signal) * float(signal.scale) + float(signal.offset)


def raw_range(signal: cantools.database.can.Signal) -> tuple[int, int]:
    """The least and the largest whole number that the bits of a signal have."""
    bits = signal.length - (1 if signal.is_signed else 0)
    return -(1 << bits) if signal.is_signed else 0, (1 << bits) - 1


def whole(frames: np.ndarray, signal: cantools.database.can.Signal) -> np.ndarray:
    """The bits of a signal as whole numbers, with its sign. frames: see raw_bits."""
    field = raw_bits(frames, signal)
    if not signal.is_signed:
        return field
    shift = np.int64(64 - signal.length)
    signed: np.ndarray = (field.astype(np.int64) << shift) >> shift
    return signed


def big_endian_bit(signal: cantools.database.can.Signal) -> int:
    """Bits from the first one of a frame to the most significant one of a big-endian signal."""
    return 8 * (signal.start // 8) + 7 - signal.start % 8


def raw_bits(frames: np.ndarray, signal: cantools.database.can.Signal) -> np.ndarray:
    """The bits of a signal as whole numbers without sign, uint64. frames: uint8 of shape (number of frames, bytes of a
    frame), at least 8 bytes and contiguous."""
    if signal.byte_order == "little_endian":
        at = signal.start
    else:  # in reversed bytes it is a little-endian one
        frames = np.ascontiguousarray(frames[:, ::-1])
        at = 8 * frames.shape[1] - big_endian_bit(signal) - signal.length
    first = min(at // 8, frames.shape[1] - _WORD_BYTES)
    words = frames.view("<u8")[:, 0] if frames.shape[1] == _WORD_BYTES else np.ascontiguousarray(
        frames[:, first : first + _WORD_BYTES]).view("<u8")[:, 0]
    shift = at - 8 * first
    field: np.ndarray = words >> np.uint64(shift)
    if shift + signal.length > 64:
        field = field | frames[:, first + _WORD_BYTES].astype(np.uint64) << np.uint64(64 - shift)
    return field & np.uint64((1 << signal.length) - 1) if signal.length < 64 else field
