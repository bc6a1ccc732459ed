"""The drive's triggered buffer (firmware/interrupts/sampler.h): variables at the rate of its interrupts, by XCP.

    scope = bench.scope(["torque_reference_Nm", "current_a_A"], trigger="torque_reference_Nm > 5")
    bench.load_torque_Nm = 8
    recording = scope.read()
    recording.time_s, recording["current_a_A"]
"""

from __future__ import annotations

import math
import operator
import re
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from salient.bench.client import LoggingClient
from salient.bench.recording import Recording
from salient.bench.variables import Quantity, Variables, short_names
from salient.bench.xcp import AREA_SCOPE, AREA_TEXT, connected
from salient.config import either
from salient.errors import RunFailed, UsageError, shown

if TYPE_CHECKING:
    from pyxcp.master.master import Master

CHANNELS_MAX = 8
DIVIDER_MAX = 65_535
TIMEOUT_S = 1.0
_CONTROL = 1
"""sampler_event_t."""
_COMMANDS = {"stop": 0, "arm": 1, "trigger": 2}
_WORDS = ("command", "event", "divider", "before", "condition", "level", "variable", "left", "right", "signed",
          "channels", "channel")
"""Words in the area of XCP, as xcp_scope_word_t; the last is the first of CHANNELS_MAX."""
_AT_ONCE, _AT_LEAST, _AT_MOST, _RISING, _FALLING, _EQUAL, _CHANGED = range(7)
"""sampler_condition_t."""
_WORD_BYTES, _WORD_BITS = 4, 32
_POLL_S = 2e-3
_EXPRESSION = re.compile(r"\s*(?P<name>[\w.\[\]]+)\s*(?P<operator>>=|<=|==|>|<|rises to|falls to|changes)"
                         r"\s*(?P<value>[\w.+-]*)\s*")


class ScopeError(RunFailed):
    """The trigger has not come in time, or the drive has another layout of its memory."""


@dataclass(frozen=True)
class Trigger:
    """A condition of the buffer. quantity: None for the first period."""

    quantity: Quantity | None = None
    condition: int = _AT_ONCE
    level: int = 0


def parse_trigger(text: str, variables: Variables) -> Trigger:
    """The trigger of an expression: NAME > VALUE, with >, >=, <, <=, ==, `rises to` or `falls to` (from beyond the
    value at the event before), or NAME changes. VALUE is in the signal's unit, or the name of an enumeration's value.
    UsageError: a mistake, which it names, or a value that the variable cannot have."""
    found = _EXPRESSION.fullmatch(text)
    if found is None or bool(found["value"]) == (found["operator"] == "changes"):
        raise UsageError(f"trigger '{text}': must be 'SIGNAL > VALUE', with >, >=, <, <=, ==, 'rises to' or 'falls to',"
                         " or 'SIGNAL changes'")
    quantity = variables.quantity(found["name"])
    if found["operator"] == "changes":
        return Trigger(quantity, _CHANGED)
    raw = _raw(found["value"], quantity, text)
    condition, rounded = {
        ">": (_AT_LEAST, math.floor(raw) + 1), ">=": (_AT_LEAST, math.ceil(raw)), "rises to": (_RISING, math.ceil(raw)),
        "<": (_AT_MOST, math.ceil(raw) - 1), "<=": (_AT_MOST, math.floor(raw)), "falls to": (_FALLING, math.floor(raw)),
        "==": (_EQUAL, round(raw)),
    }[found["operator"]]
    bits = 8 * quantity.variable.bytes
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if quantity.variable.is_signed else (0, (1 << bits) - 1)
    if not least <= rounded <= most:
        raise UsageError(f"trigger '{text}': {quantity.name} is from {least * quantity.factor:g} to "
                         f"{most * quantity.factor:g} {quantity.unit}".rstrip())
    return Trigger(quantity, condition, rounded)


def _raw(text: str, quantity: Quantity, expression: str) -> float:
    names = quantity.variable.names
    short = short_names(names)
    for of in (names, short):
        if text in of.values():
            return next(value for value, name in of.items() if name == text)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        reason = f"must be a number or {either(list(short.values()))}" if names else "must be a number"
        raise UsageError(f"trigger '{expression}': {text} {reason}")
    return value / quantity.factor


_RING = ("record_words", "capacity", "place", "trigger_left", "trigger_events")
"""Members of sampler_t."""


@dataclass(frozen=True)
class _Ring:
    """A complete buffer. begin: address, bytes; the others: see sampler_t."""

    begin: int
    record_words: int
    capacity: int
    place: int
    trigger_left: int
    trigger_events: int

    @property
    def bytes(self) -> int:
        return _WORD_BYTES * self.record_words * self.capacity


class Scope:
    """An armed buffer of a session's drive. recording: what the last read() has returned; title: its trigger; replaced:
    the buffer, of which a drive has one, has been armed anew since."""

    def __init__(self, session: LoggingClient, quantities: Sequence[Quantity], period_s: float, divider: int,
                 title: str) -> None:
        self.recording: Recording | None = None
        self.replaced = False
        self.title = title
        self._session = session
        self._quantities = list(quantities)
        self._period_s, self._divider = period_s, divider

    def trigger(self) -> None:
        """Triggers now, whatever the condition."""
        with connected(self._session) as master:
            _write(master, "command", _COMMANDS["trigger"])

    def read(self, timeout: float = TIMEOUT_S) -> Recording:
        """Lets time pass until the buffer is complete, and reads it. ScopeError: it is not within `timeout` seconds of
        virtual time, and stays armed; or it is replaced."""
        if self.replaced:
            raise ScopeError(f"the buffer of the trigger '{self.title}' has been armed anew since")
        deadline_ns = self._session.time_ns + round(1e9 * timeout)
        with connected(self._session) as master:
            while not self._is_complete(master):
                if self._session.time_ns >= deadline_ns:
                    raise ScopeError(f"the trigger has not come, or the buffer is not complete, within {timeout:g} s")
                self._session.run_for(_POLL_S)
            ring = self._ring(master)
            read = _fetched(master, ring.begin, ring.bytes)
        return self._decoded(ring, read)

    def is_complete(self) -> bool:
        """The buffer is to be read."""
        with connected(self._session) as master:
            return self._is_complete(master)

    def parts(self, words: int = sys.maxsize) -> Iterator[Recording | None]:
        """Reads a complete buffer, with what else the caller does between two parts of so many words: None after each,
        at last the recording."""
        with connected(self._session) as master:
            ring = self._ring(master)
        read = bytearray()
        while len(read) < ring.bytes:
            with connected(self._session) as master:
                read += _fetched(master, ring.begin + len(read), min(_WORD_BYTES * words, ring.bytes - len(read)))
            yield None
        yield self._decoded(ring, bytes(read))

    def _ring(self, master: Master) -> _Ring:
        variables = variables_of(self._session)
        values = (_member(master, variables, f"sampler.{name}") for name in _RING)
        return _Ring(variables.layout.bits("sampler.ring").start // 8, *values)

    def _decoded(self, ring: _Ring, read: bytes) -> Recording:
        records = np.roll(np.frombuffer(read, "<u4"), -ring.place).reshape(ring.capacity, ring.record_words)
        self.recording = self._recording(records, ring.capacity - ring.trigger_left, ring.trigger_events)
        return self.recording

    def _is_complete(self, master: Master) -> bool:
        variables = variables_of(self._session)
        return _member(master, variables, "sampler.state") == _state(variables, "SAMPLER_COMPLETE")

    def _recording(self, records: np.ndarray, before: int, late: int) -> Recording:
        events = (np.arange(len(records)) - before) * self._divider + late
        values = {quantity.name: _values(records[:, column], quantity)
                  for column, quantity in enumerate(self._quantities)}
        return Recording(events * self._period_s, values, {each.name: each.unit for each in self._quantities},
                         {each.name: each.variable.names for each in self._quantities if each.variable.names})


def arm(session: LoggingClient, signals: Sequence[str], trigger: str | None = None, *, before: float = 0.25,
        divider: int = 1) -> Scope:
    """Arms the buffer: 1 to CHANNELS_MAX signals (salient.bench.variables), at every `divider`-th control period, from
    the part `before` of the buffer in front of the trigger on (parse_trigger; None: at once), or from now on.
    UsageError: one of these is wrong; ScopeError: the drive's memory has another layout than the program here."""
    variables = variables_of(session)
    if isinstance(signals, str) or not 1 <= len(signals) <= CHANNELS_MAX:
        raise UsageError(f"signals: must be 1 to {CHANNELS_MAX} names")
    quantities = [variables.quantity(name) for name in signals]
    condition = Trigger() if trigger is None else parse_trigger(trigger, variables)
    _check(divider, before)
    with connected(session) as master:
        check_layout(master, variables)
        words = len(variables.layout.bits("sampler.ring")) // (8 * _WORD_BYTES) - CHANNELS_MAX
        capacity = -(-words // len(quantities))  # the last record begins within them
        records_before = min(int(before * capacity), capacity - 2)
        of = condition.quantity or quantities[0]
        first = of.variable.address % _WORD_BYTES
        setup = {"event": _CONTROL, "divider": divider, "before": records_before,
                 "condition": condition.condition, "level": condition.level, "variable": of.variable.address,
                 "left": _WORD_BITS - 8 * (first + of.variable.bytes), "right": _WORD_BITS - 8 * of.variable.bytes,
                 "signed": of.variable.is_signed, "channels": len(quantities)}
        for name, value in setup.items():
            _write(master, name, int(value))
        for number, quantity in enumerate(quantities):
            _write(master, "channel", quantity.variable.address // _WORD_BYTES * _WORD_BYTES, number)
        _write(master, "command", _COMMANDS["arm"])
    return Scope(session, quantities, 1.0 / _control_rate_hz(session), divider, trigger or "at once")


def _check(divider: Any, before: Any) -> None:
    if not isinstance(divider, int) or not 1 <= divider <= DIVIDER_MAX:
        raise UsageError(f"divider {shown(divider)}: must be a whole number from 1 to {DIVIDER_MAX}")
    if not isinstance(before, int | float) or not 0.0 <= before < 1.0:
        raise UsageError(f"before {shown(before)}: must be from 0 to below 1, the part before the trigger")


@lru_cache
def _variables(build: str, machine: str | None) -> Variables:
    return Variables(build, machine)


def variables_of(session: LoggingClient) -> Variables:
    """The variables of a session's drive, in the memory of its build; of a drive that runs by itself, of the host's."""
    options = getattr(session, "options", None)
    return _variables("host" if options is None else options.build, session.machine)


def check_layout(master: Master, variables: Variables) -> None:
    """ScopeError: the drive's memory has another layout than a build's."""
    text = program_of(master)
    layout = variables.layout
    if text[7:15] != f"{layout.hash:08x}" or text[23:31] != f"{layout.size // _WORD_BYTES:08x}":
        raise ScopeError(f"the drive ({text}) is of other sources than this build, or of another processor: its "
                         "variables are elsewhere in its memory")


def program_of(master: Master) -> str:
    """The drive's EPK (firmware/comms/xcp.h): hashes of its headers and of its DBC, and the size of its memory."""
    master.setMta(AREA_TEXT)
    return bytes(master.fetch(len("salient") + 24)).decode("ascii", "replace")


def _write(master: Master, word: str, value: int, number: int = 0) -> None:
    master.setMta(AREA_SCOPE + _WORD_BYTES * (_WORDS.index(word) + number))
    master.download(struct.pack("<I", operator.index(value) & 0xFFFFFFFF))


def _fetched(master: Master, address: int, size: int) -> bytes:
    master.setMta(address)
    return bytes(master.fetch(size))


def _member(master: Master, variables: Variables, path: str) -> int:
    variable = variables.quantity(path).variable
    return int.from_bytes(bytes(master.shortUpload(variable.bytes, variable.address)), "little",
                          signed=variable.is_signed)


def _state(variables: Variables, name: str) -> int:
    names = variables.quantity("sampler.state").variable.names
    return next(value for value, each in names.items() if each == name)


def _values(words: np.ndarray, quantity: Quantity) -> np.ndarray:
    """The variable within words: floats in its unit, or integers where it has none."""
    variable = quantity.variable
    columns = np.ascontiguousarray(words).view(f"<{'i' if variable.is_signed else 'u'}{variable.bytes}")
    raw = columns.reshape(len(words), -1)[:, variable.address % _WORD_BYTES // variable.bytes]
    return raw.astype(np.int64) if quantity.factor == 1.0 else raw * quantity.factor


def _control_rate_hz(session: LoggingClient) -> float:
    """By the drive's heartbeat, which comes every 100 ms."""
    deadline_ns = session.time_ns + 200_000_000
    while not session.telemetry.count("DRIVE_HEARTBEAT"):
        if session.time_ns >= deadline_ns:
            raise ScopeError("no heartbeat of the drive within 0.2 s: its control rate is not known")
        session.run_for(_POLL_S)
    return float(session.telemetry["DRIVE_HEARTBEAT.control_rate_hz"].last)
