"""The traffic of a bus: load, and of each message its cycle time beside the expected one, whether it is missing, and
what no database defines. Memory does not grow with the frames."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import can
from cantools.database.can import Database, Message

from salient.bus.databases import identifier_text, messages_of, node_of
from salient.bus.frame_bits import BitRates
from salient.bus.signals import FrameKey, FrameKeys, drive_database, frame_key, rig_database
from salient.config import NODE_MAX
from salient.dbc import attributes

MISSING_CYCLES = 2.5
"""After as many cycles without it a message is missing: one lost frame is not enough, three cycles always are."""
_UNKNOWN_MAX = 4096
"""Identifiers that no database defines, of which each is counted; of the further ones only all together."""
_EVENTS_MAX = 1000
_SLOT_NS = 100_000_000
"""Slot of the greatest load."""
_BACK_NS = 1_000_000_000
"""A time that is earlier by more is another recording, or the drive has restarted."""
_STEADY = 4
"""Equal intervals in a row, after which a period that can be set is known."""
_STEADY_WITHIN = 0.05
_MS_NS = 1_000_000
_DRIVE = "DRIVE"
_IF_ACTIVE = "ifactive"
_NOT_CYCLIC = ("onchange", "onwrite", "triggered", "event", "spontan")
"""Parts of send types (GenMsgSendType) with which a message may pause; the latter, where it is not cyclic as well."""


@dataclass(frozen=True)
class Definition:
    """A message as its database defines it. node: the sender. cycle_ns: expected, 0 without one. pauses: its absence is
    no fault. settable: the cycle is the default of a parameter. is_of_file: of another node than a drive's, and frames
    may be longer."""

    node: str
    name: str
    length: int
    cycle_ns: int = 0
    pauses: bool = False
    settable: bool = False
    is_of_file: bool = False


@dataclass(frozen=True)
class Event:
    """Beginning or end at a time."""

    time_ns: int
    text: str


@dataclass(frozen=True)
class MessageReport:
    """A message in a span of time. cycle_ns: mean, None below two frames; shortest_ns, longest_ns: of all intervals so
    far. expected_ns: 0 without an expectation. state: "" or "missing", "never", "wrong length". share: of the bus."""

    identifier: str
    name: str
    frames: int
    cycle_ns: float | None
    expected_ns: int
    shortest_ns: int
    longest_ns: int
    state: str
    share: float


@dataclass(frozen=True)
class NodeReport:
    """The messages of a node. is_silent: all that are expected are missing."""

    name: str
    share: float
    is_silent: bool
    messages: tuple[MessageReport, ...]


@dataclass(frozen=True)
class Report:
    """A span of time on the bus. load, peak: parts of its time; peak: the greatest load of 100 ms so far. unknown: of
    no database, the most frequent first. further_unknown: frames of further identifiers."""

    time_ns: int
    duration_ns: int
    load: float
    peak: float
    frames: int
    errors: int
    nodes: tuple[NodeReport, ...]
    unknown: tuple[MessageReport, ...]
    further_unknown: int


@dataclass(eq=False)
class _Entry:
    """A message that can come, or an identifier that has come."""

    definition: Definition | None
    expected_ns: int = 0
    frames: int = 0
    last_ns: int | None = None
    shortest_ns: int = 1 << 62
    longest_ns: int = 0
    intervals: int = 0
    sum_ns: int = 0
    busy_ns: float = 0.0
    is_missing: bool = False
    is_due: bool = False
    wrong_lengths: int = 0
    is_learned: bool = False
    steady: int = 0
    steady_ns: int = 0
    before: tuple[int, int, int, float] = field(default=(0, 0, 0, 0.0))
    """Frames, intervals, their sum and the time on the bus at the last report."""

    @property
    def is_watched(self) -> bool:
        """Whether its absence is told; of a period that can be set, once it is known."""
        definition = self.definition
        return (definition is not None and self.expected_ns > 0 and not definition.pauses
                and (not definition.settable or self.is_learned))

    @property
    def is_steady(self) -> bool:
        """False while a period is being set."""
        return self.definition is None or not self.definition.settable or self.steady >= _STEADY

    def take_interval(self, interval_ns: int) -> None:
        self.intervals += 1
        self.sum_ns += interval_ns
        self.shortest_ns = min(self.shortest_ns, interval_ns)
        self.longest_ns = max(self.longest_ns, interval_ns)
        self.take_period(interval_ns)

    def take_period(self, interval_ns: int) -> None:
        """Takes the period over that the sender keeps, where it can be set."""
        if self.definition is None or not self.definition.settable:
            return
        if abs(interval_ns - self.steady_ns) > _STEADY_WITHIN * self.steady_ns:
            self.steady_ns, self.steady = interval_ns, 1
            return
        self.steady += 1
        if self.steady == _STEADY:
            self.is_learned = True
            self.expected_ns = max(1, round(self.steady_ns / _MS_NS)) * _MS_NS


class Traffic:
    """Takes the frames of a bus in their order. Times are the frames'; of a bus that is silent `advance` moves
    them."""

    def __init__(self, rates: BitRates, databases: Sequence[Database] = (), node: int = 0) -> None:
        """databases: of load_databases. node: of the drive; messages of the other node numbers are known, too."""
        self._rates = rates
        self._known = known_messages(node, databases)
        self._keys = FrameKeys(messages_of(databases))
        self._off_bus = _rig_identifiers()
        self._entries: dict[FrameKey, _Entry] = {}
        self._by_node: dict[str, dict[FrameKey, _Entry]] = {}
        for key, definition in sorted(self._known.items()):
            if (definition.is_of_file or definition.node == _DRIVE) and key not in self._keys.of_any_source:
                self._new_entry(key)
        self._unknown: dict[FrameKey, _Entry] = {}
        self._further_unknown = 0
        self._due: list[tuple[float, FrameKey]] = []
        self._events: deque[Event] = deque(maxlen=_EVENTS_MAX)
        self._silent: set[str] = set()
        self.first_ns: int | None = None
        self.now_ns = 0
        self._frames, self._errors, self._busy_ns = 0, 0, 0.0
        self._before: tuple[int, int, int, float] | None = None  # time, frames, errors and busy time at the last report
        self._slot, self._slot_ns, self._peak = 0, 0.0, 0.0

    # --- frames ----------------------------------------------------------------------------------------------------

    def add(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame; frames of test benches are not on the bus."""
        key = (message.arbitration_id, message.is_extended_id)
        if key in self._off_bus and not message.is_error_frame:
            self.advance(time_ns)
            return
        if self.first_ns is None:
            self.first_ns = self.now_ns = time_ns
            self._before = (time_ns, 0, 0, 0.0)
        self.advance(time_ns)
        busy_ns = self._rates.duration_ns(message)
        self._frames += 1
        self._busy_ns += busy_ns
        self._take_load(time_ns, busy_ns)
        if message.is_error_frame:
            self._errors += 1
            return
        entry = self._entries.get(key) or self._new_entry(key)
        if entry is None:
            self._further_unknown += 1
            return
        entry.busy_ns += busy_ns
        if message.is_remote_frame:
            return
        self._take(entry, key, time_ns, len(message.data))

    def _take_load(self, time_ns: int, busy_ns: float) -> None:
        slot = time_ns // _SLOT_NS
        if slot != self._slot:
            self._peak = max(self._peak, self._slot_ns / _SLOT_NS)
            self._slot, self._slot_ns = slot, 0.0
        self._slot_ns += busy_ns

    def _new_entry(self, key: FrameKey) -> _Entry | None:
        """The entry of an identifier that comes for the first time; None for an unknown one beyond the limit."""
        definition = self._known.get(self._keys.find(*key))
        if definition is not None and (key in self._known or len(self._entries) < len(self._known) + _UNKNOWN_MAX):
            entry = self._entries[key] = _Entry(definition, definition.cycle_ns)
            self._by_node.setdefault(definition.node, {})[key] = entry
            return entry
        known = self._unknown.get(key)
        if known is None and len(self._unknown) < _UNKNOWN_MAX:
            known = self._unknown[key] = _Entry(None)
        return known

    def _take(self, entry: _Entry, key: FrameKey, time_ns: int, length: int) -> None:
        definition = entry.definition
        if definition is not None and length != definition.length and (
                length < definition.length or not definition.is_of_file):
            entry.wrong_lengths += 1
        entry.frames += 1
        last_ns, entry.last_ns = entry.last_ns, time_ns
        if entry.is_missing and last_ns is not None:
            self._return(entry, time_ns, last_ns)
            entry.take_period(time_ns - last_ns)
        elif last_ns is not None and time_ns >= last_ns:
            entry.take_interval(time_ns - last_ns)
        if not entry.is_due and entry.is_watched and entry.is_steady:
            entry.is_due = True
            heapq.heappush(self._due, (time_ns + MISSING_CYCLES * entry.expected_ns, key))

    # --- absence ---------------------------------------------------------------------------------------------------

    def advance(self, time_ns: int) -> None:
        """Time has passed: what should have come since then is missing."""
        if self.first_ns is None:
            return
        if time_ns < self.now_ns - _BACK_NS:
            self._begin_again(time_ns)
        while self._due and self._due[0][0] <= time_ns:
            _, key = heapq.heappop(self._due)
            entry = self._entries[key]
            assert entry.last_ns is not None
            due_ns = entry.last_ns + MISSING_CYCLES * entry.expected_ns
            if due_ns > time_ns:
                heapq.heappush(self._due, (due_ns, key))
                continue
            entry.is_due = False
            entry.is_missing = True
            self._tell_missing(entry, round(due_ns))
        self.now_ns = max(self.now_ns, time_ns)

    def _tell_missing(self, entry: _Entry, time_ns: int) -> None:
        definition = entry.definition
        assert definition is not None and entry.last_ns is not None
        node = definition.node
        self._events.append(Event(time_ns, f"{node}: {definition.name} is missing since {_seconds(entry.last_ns)} "
                                           f"(cycle {_ms(entry.expected_ns)})"))
        entries = self._by_node[node].values()
        watched = [each for each in entries if each.is_watched and each.last_ns is not None]
        if len(watched) > 1 and all(each.is_missing for each in watched) and node not in self._silent:
            self._silent.add(node)
            last_ns = max(each.last_ns for each in entries if each.last_ns is not None)
            self._events.append(Event(time_ns, f"{node}: the node is silent since {_seconds(last_ns)}"))

    def _return(self, entry: _Entry, time_ns: int, last_ns: int) -> None:
        definition = entry.definition
        assert definition is not None
        entry.is_missing = False
        self._silent.discard(definition.node)
        self._events.append(Event(time_ns, f"{definition.node}: {definition.name} is back after "
                                           f"{_seconds(time_ns - last_ns)}"))

    def _begin_again(self, time_ns: int) -> None:
        """Time is an earlier one."""
        self._events.append(Event(time_ns, f"time went back from {_seconds(self.now_ns)}"))
        self._due.clear()
        for entry in (*self._entries.values(), *self._unknown.values()):
            entry.last_ns, entry.is_missing, entry.is_due = None, False, False
        self._silent.clear()
        if self._before is not None:
            self._before = (time_ns - (self.now_ns - self._before[0]), *self._before[1:])
        assert self.first_ns is not None
        self.first_ns += time_ns - self.now_ns
        self.now_ns = time_ns

    def take_events(self) -> list[Event]:
        """Events since the last call, at most the latest 1000."""
        events = list(self._events)
        self._events.clear()
        return events

    # --- reports ---------------------------------------------------------------------------------------------------

    def report(self) -> Report:
        """Report on the time since the last report; a message without a frame in it has the cycle of all."""
        return self._report(is_total=False)

    def total(self) -> Report:
        """Report on all time."""
        return self._report(is_total=True)

    def _report(self, is_total: bool) -> Report:
        first_ns = self.now_ns if self.first_ns is None else self.first_ns
        start = (first_ns, 0, 0, 0.0) if is_total or self._before is None else self._before
        duration_ns = self.now_ns - start[0]
        nodes = [NodeReport(name, sum(message.share for message in messages), name in self._silent, tuple(messages))
                 for name, entries in self._by_node.items()
                 if (messages := [self._message(key, entry, duration_ns, is_total)
                                  for key, entry in sorted(entries.items(), key=lambda item: item[0])
                                  if self._is_shown(entry, entries.values())])]
        unknown = [self._message(key, entry, duration_ns, is_total) for key, entry in self._unknown.items()]
        report = Report(
            self.now_ns, duration_ns, _part(self._busy_ns - start[3], duration_ns),
            max(self._peak, self._slot_ns / _SLOT_NS), self._frames - start[1], self._errors - start[2], tuple(nodes),
            tuple(sorted(unknown, key=lambda message: -message.frames)), self._further_unknown)
        if not is_total and self.first_ns is not None:
            self._before = (self.now_ns, self._frames, self._errors, self._busy_ns)
            for entry in (*self._entries.values(), *self._unknown.values()):
                entry.before = (entry.frames, entry.intervals, entry.sum_ns, entry.busy_ns)
        return report

    @staticmethod
    def _is_shown(entry: _Entry, of_node: Iterable[_Entry]) -> bool:
        """Whether it has come, or should have; the messages of a drive only once it has been heard."""
        definition = entry.definition
        if entry.frames or definition is None:
            return True
        return (entry.expected_ns > 0 and not definition.pauses
                and (definition.is_of_file or any(each.frames for each in of_node)))

    def _message(self, key: FrameKey, entry: _Entry, duration_ns: int, is_total: bool) -> MessageReport:
        before = (0, 0, 0, 0.0) if is_total else entry.before
        intervals, sum_ns = entry.intervals - before[1], entry.sum_ns - before[2]
        if not intervals:
            intervals, sum_ns = entry.intervals, entry.sum_ns
        state = ("never" if not entry.frames else "missing" if entry.is_missing
                 else "wrong length" if entry.wrong_lengths else "")
        return MessageReport(
            identifier_text(*key), entry.definition.name if entry.definition else "", entry.frames - before[0],
            sum_ns / intervals if intervals else None, entry.expected_ns,
            entry.shortest_ns if entry.intervals else 0, entry.longest_ns, state,
            _part(entry.busy_ns - before[3], duration_ns))


def known_messages(node: int, databases: Iterable[Database]) -> dict[FrameKey, Definition]:
    """The messages of the bus: of all node numbers of drives, that with `node` without it in its name, and of databases
    of other nodes, which come before them."""
    found: dict[FrameKey, Definition] = {}
    for number in sorted(range(NODE_MAX + 1), key=lambda each: each == node):
        of_node = "" if number == node else f" (node {number})"
        for message in drive_database(None, number).messages:
            found[frame_key(message)] = _definition(message, f"{message.senders[0]}{of_node}", is_of_file=False)
    for database in databases:
        for message in database.messages:
            found[frame_key(message)] = _definition(message, node_of(message), is_of_file=True)
    return found


def _rig_identifiers() -> frozenset[FrameKey]:
    return frozenset(frame_key(message) for node in range(NODE_MAX + 1) for message in rig_database(node).messages)


def _definition(message: Message, node: str, *, is_of_file: bool) -> Definition:
    send_type = (message.send_type or "").lower()
    pauses = _IF_ACTIVE in send_type or ("cyclic" not in send_type and any(part in send_type for part in _NOT_CYCLIC))
    settable = not is_of_file and int(attributes(message).get("TelemetryRate", 0)) != 0
    cycle_ns = (message.cycle_time or 0) * _MS_NS
    return Definition(node, message.name, message.length, cycle_ns, pauses, settable, is_of_file)




def _part(busy_ns: float, duration_ns: int) -> float:
    return busy_ns / duration_ns if duration_ns > 0 else 0.0


def _seconds(time_ns: int) -> str:
    return f"{time_ns * 1e-9:.4f} s"


def _ms(time_ns: float) -> str:
    return f"{time_ns / _MS_NS:.6g} ms"
