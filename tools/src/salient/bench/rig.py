"""The test bench over CAN: its variables, set now or at a virtual time.

The names, units, ranges and descriptions of the bench variables come from the signals of RIG_SET in rig.dbc.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import can
from cantools.database.can import Signal
from cantools.database.namedsignalvalue import NamedSignalValue

from salient.bench.client import Client, unknown_attribute
from salient.bench.faults import FaultError, fault_kind, fault_signals
from salient.bench.load_profile import (
    LOAD_PROFILE_VALUE_MAX,
    LOAD_PROFILE_VALUES_MAX,
    load_profile_path,
    read_load_profile,
)
from salient.bus.signals import SignalTable, rig_database, signal_range
from salient.errors import UsageError

_AT_US_MAX = 2**32 - 1
CHANGES_MAX = 64
"""STIMULUS_QUEUE of emulator/rig/stimulus_queue.h: changes of variables that wait for their time; as many of faults."""
_FREE = "free"
"""Named value of a variable that imposes nothing; not-a-number in Python."""


class RigError(UsageError):
    """The bench rejected a value; the text gives the variable and the reason."""


@lru_cache
def _signals() -> dict[str, Signal]:
    """The multiplexed signals of RIG_SET."""
    return {s.name: s for s in rig_database().get_message_by_name("RIG_SET").signals if s.multiplexer_ids}


@lru_cache
def bench_variables() -> dict[str, Signal]:
    """The bench variables by name, with unit and comment; the range is variable_range()'s."""
    return {name: signal for name, signal in _signals().items() if "_coarse_" not in name}


def _coarse(name: str) -> Signal | None:
    """The signal that carries a variable beyond the range of the signal with its name."""
    head, _, unit = name.partition("_Nm")
    return _signals().get(f"{head}_coarse_Nm{unit}")


def variable_range(name: str) -> tuple[float, float]:
    """Minimum and maximum of a bench variable in its unit."""
    return signal_range(_coarse(name) or _variable(name))


class Rig:
    """The bench variables as attributes: assigning one sets it, reading one returns the value assigned last.

    rig.load_torque_Nm = 8 acts now, rig.at(0.13).load_torque_Nm = 8 at exactly 0.13 s of virtual time. RigError when
    the bench rejects the value: out of range, in the past, or more than 64 changes waiting. AttributeError, with the
    nearest variables, when there is no such variable. rig.describe() lists them with unit, range and meaning.
    """

    __slots__ = ("_assigned", "_at_us", "_client")

    _assigned: dict[str, float]
    _at_us: int
    _client: Client

    def __init__(self, client: Client, at_us: int = 0) -> None:
        for name, value in (("_client", client), ("_at_us", at_us), ("_assigned", {})):
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> float:
        value: Any = self._assigned.get(name, _variable(name).initial)
        if value is None:
            raise AttributeError(f"{name} has the value of the machine file until it is set")
        if isinstance(value, NamedSignalValue):
            value = math.nan if str(value) == _FREE else value.value
        number: float = value
        return number

    def __setattr__(self, name: str, value: Any) -> None:
        self.set(name, value)
        self._assigned[name] = value

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *bench_variables()]

    @property
    def truth(self) -> SignalTable:
        """The true signals of this bench."""
        return self._client.truth

    def at(self, time_s: float) -> Rig:
        """The same bench, whose variables change at a virtual time (rounded to microseconds)."""
        return Rig(self._client, round(time_s * 1e6))

    def set(self, name: str, value: float) -> None:
        """Sets a bench variable by its name in rig.dbc."""
        signal = _variable(name)
        is_free = math.isnan(value) and _FREE in (signal.choices or {}).values()
        low, high = variable_range(name)
        if not (is_free or low <= value <= high):
            raise RigError(f"{name} {value:g}: must be {_range(name)}")
        fine_low, fine_high = signal_range(signal)
        if not (is_free or fine_low <= value <= fine_high):
            signal = _coarse(name) or signal
        if not 0 <= self._at_us <= _AT_US_MAX:
            raise RigError(f"{name} at {self._at_us / 1e6:g} s: must be 0 to {_AT_US_MAX / 1e6:g} s")
        message = self._client.rig_database.get_message_by_name("RIG_SET")
        number = _multiplex_number(signal)
        data = message.encode({"quantity": number, signal.name: _FREE if is_free else value, "at_us": self._at_us})
        self._client.send(can.Message(arbitration_id=message.frame_id, is_extended_id=True, data=data))
        reply = self._client.rig_database.get_message_by_name("RIG_SET_REPLY")
        answer = self._client.receive_until(
            lambda m: m.arbitration_id == reply.frame_id and m.is_extended_id and m.data[0] == number
        )
        status = reply.decode_simple(bytes(answer.data))["status"]
        if status != "done":
            raise RigError(f"{name} {value:g}{self._refused(self._at_us, str(status))}")

    def set_load_profile(self, values: str | Sequence[float]) -> None:
        """Sets the load profile, now: torque over one turn of the rotor at equal steps of its angle from 0, times
        load_profile_Nm; or a bundled load profile or CSV file by its name. RigError: not 1 to 256 values of at most
        +-1000. UsageError: no such load profile, or a mistake in its file."""
        if isinstance(values, str):
            values = read_load_profile(load_profile_path(values))
        if not 1 <= len(values) <= LOAD_PROFILE_VALUES_MAX:
            raise RigError(f"load profile of {len(values)} values: must be 1 to {LOAD_PROFILE_VALUES_MAX}")
        for value in values:
            if not abs(value) <= LOAD_PROFILE_VALUE_MAX:
                raise RigError(f"load profile value {value:g}: must be {-LOAD_PROFILE_VALUE_MAX:g} to "
                               f"{LOAD_PROFILE_VALUE_MAX:g}")
        message = self._client.rig_database.get_message_by_name("RIG_LOAD_PROFILE")
        for index, value in enumerate(values):
            data = message.encode({"values": len(values), "index": index, "value": value})
            self._client.send(can.Message(arbitration_id=message.frame_id, is_extended_id=True, data=data))

    def fault(self, kind: str, *, duration_s: float | None = None, **arguments: Any) -> Fault:
        """Begins a fault: its places (phase, leg) and its attribute by name, bench-faults.md. With duration_s it
        ends by itself. FaultError."""
        signals = fault_signals(kind, arguments, True, self._at_us)
        start_us = self._at_us or -(-self._client.time_ns // 1000)
        if duration_s is not None and not 1e-6 <= duration_s <= (_AT_US_MAX - start_us) / 1e6:
            raise FaultError(f"{kind}: duration_s {duration_s:g}: must be at least 1e-06 and end before "
                             f"{_AT_US_MAX / 1e6:g} s")
        self._change_fault(signals)
        fault = Fault(self, kind, {name: arguments[name] for name in ("phase", "leg") if name in arguments})
        if duration_s is not None:
            fault.clear(at_s=start_us / 1e6 + duration_s)
        return fault

    def clear_fault(self, kind: str, **places: str) -> None:
        """Ends a fault at its places; one that is not present stays absent. FaultError."""
        arguments = fault_kind(kind).arguments
        for name in places:
            if name not in ("phase", "leg") or name not in arguments:
                raise FaultError(f"{kind} has no place {name}")
        self._change_fault(fault_signals(kind, places, False, self._at_us))

    def _change_fault(self, signals: dict[str, Any]) -> None:
        kind, at_us = signals["kind"], signals["at_us"]
        if not 0 <= at_us <= _AT_US_MAX:
            raise FaultError(f"{kind} at {at_us / 1e6:g} s: must be 0 to {_AT_US_MAX / 1e6:g} s")
        message = self._client.rig_database.get_message_by_name("RIG_FAULT")
        data = message.encode(signals)
        self._client.send(can.Message(arbitration_id=message.frame_id, is_extended_id=True, data=data))
        reply = self._client.rig_database.get_message_by_name("RIG_FAULT_REPLY")
        answer = self._client.receive_until(
            lambda m: m.arbitration_id == reply.frame_id and m.is_extended_id and m.data[0] == data[0]
        )
        status = reply.decode_simple(bytes(answer.data))["status"]
        if status != "done":
            places = "".join(f" {value}" for name, value in signals.items()
                             if name in (f"{kind}_phase", f"{kind}_leg"))
            raise FaultError(f"{kind}{places}{self._refused(at_us, str(status))}")

    def _refused(self, at_us: int, status: str) -> str:
        """When a request was to have its effect, and why the test bench has refused it."""
        at = f" at {at_us / 1e6:g} s" if at_us else ""
        if status == "in_the_past":
            return f"{at}: in_the_past, it is {self._client.time_ns / 1e9:g} s"
        if status == "no_such_place":
            return f"{at}: no_such_place, a phase that the machine does not have"
        return f"{at}: {status}"

    @staticmethod
    def describe() -> str:
        """One line per bench variable: name, range with unit, meaning."""
        return "\n".join(f"{s.name}: {_range(s.name)}. {s.comment}" for s in bench_variables().values())


@dataclass(frozen=True)
class Fault:
    """A fault that has been asked for; places: phase and leg."""

    rig: Rig
    kind: str
    places: dict[str, str]

    def clear(self, at_s: float | None = None) -> None:
        """Ends it, now or at a virtual time (rounded to microseconds)."""
        rig = Rig(self.rig._client) if at_s is None else self.rig.at(at_s)
        rig.clear_fault(self.kind, **self.places)


def _variable(name: str) -> Signal:
    if name not in bench_variables():
        raise unknown_attribute(name, bench_variables())
    return bench_variables()[name]


def _multiplex_number(signal: Signal) -> int:
    assert signal.multiplexer_ids  # as bench_variables selects
    return signal.multiplexer_ids[0]


def _range(name: str) -> str:
    low, high = variable_range(name)
    return f"{low:g} to {high:g} {_variable(name).unit or ''}".rstrip()
