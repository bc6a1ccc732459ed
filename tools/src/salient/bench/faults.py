"""Faults by place: the kinds that the test bench knows, from the multiplexed signals of RIG_FAULT in rig.dbc.

    fault = bench.fault("current_sensor_gain", phase="b", gain=0.3)
    fault.clear()
    bench.at(0.2).fault("switch_open", phase="b", leg="low", duration_s=0.01)

A kind has the signal of its name, which says whether it begins; <kind>_phase and <kind>_leg where it has those places;
and at most one more, <kind>_<attribute>.

    python -m salient.bench.faults

writes the page of the kinds, docs/reference/bench-faults.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from cantools.database.can import Signal

from salient.bus.signals import rig_database, signal_range
from salient.config import either
from salient.dbc import PHASES
from salient.errors import UsageError, close_names
from salient.paths import REFERENCE

PAGE = REFERENCE / "bench-faults.md"
LEGS = ("high", "low")
_MESSAGE = "RIG_FAULT"


class FaultError(UsageError):
    """A fault that does not exist, has not this place or attribute, or that the bench rejects; the text names
    the nearest kinds, or the places and the attribute that the kind has."""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault. attribute: name and signal of its value; None without one."""

    name: str
    number: int
    text: str
    has_phase: bool
    has_leg: bool
    attribute: tuple[str, Signal] | None

    @property
    def arguments(self) -> tuple[str, ...]:
        """Names of the places and of the attribute."""
        places = [name for name, has in (("phase", self.has_phase), ("leg", self.has_leg)) if has]
        return (*places, *([self.attribute[0]] if self.attribute else []))

    @property
    def choices(self) -> tuple[str, ...] | None:
        """Names of the values of the attribute; None for a number."""
        if self.attribute is None or not self.attribute[1].choices:
            return None
        return tuple(str(name) for _, name in sorted(self.attribute[1].choices.items()))

    @property
    def allowed(self) -> str:
        """Values of the attribute."""
        assert self.attribute is not None
        signal = self.attribute[1]
        if self.choices:
            return either(self.choices)
        low, high = signal_range(signal)
        return f"{low:g} to {high:g} {signal.unit or ''}".rstrip()


@lru_cache
def fault_kinds() -> dict[str, FaultKind]:
    """The kinds by name, in the order of their numbers."""
    groups: dict[int, list[Signal]] = {}
    for signal in rig_database().get_message_by_name(_MESSAGE).signals:
        if signal.multiplexer_ids:
            groups.setdefault(signal.multiplexer_ids[0], []).append(signal)
    kinds = {}
    for number, signals in sorted(groups.items()):
        begins = min(signals, key=lambda signal: len(signal.name))
        others = {signal.name.removeprefix(f"{begins.name}_"): signal for signal in signals if signal is not begins}
        places = [others.pop(place, None) is not None for place in ("phase", "leg")]
        attribute = next(iter(others.items()), None)
        kinds[begins.name] = FaultKind(begins.name, number, begins.comment or "", places[0], places[1], attribute)
    return kinds


def fault_kind(name: str) -> FaultKind:
    """The kind of a name; FaultError names the nearest."""
    kinds = fault_kinds()
    if name not in kinds:
        raise FaultError(f"no fault '{name}'; {close_names(name, sorted(kinds))}")
    return kinds[name]


def attribute_names() -> tuple[str, ...]:
    """The attributes of all kinds, each once."""
    return tuple(sorted({kind.attribute[0] for kind in fault_kinds().values() if kind.attribute}))


def fault_signals(name: str, arguments: Mapping[str, Any], begins: bool, at_us: int) -> dict[str, Any]:
    """The signals of a RIG_FAULT. arguments: all places of the kind, and its attribute when it begins. FaultError."""
    kind = fault_kind(name)
    for argument in arguments:
        if argument not in kind.arguments:
            has = f"it has {', '.join(kind.arguments)}" if kind.arguments else "it has no place and no attribute"
            raise FaultError(f"{name} has no {argument}; {has}")
    for place, choices in (("phase", PHASES), ("leg", LEGS)):
        if place in kind.arguments and arguments.get(place) not in choices:
            given = repr(arguments[place]) if place in arguments else "missing"
            raise FaultError(f"{name}: {place} {given}: must be {either(choices)}")
    signals = {f"{name}_{place}": arguments[place] for place in ("phase", "leg") if place in kind.arguments}
    if kind.attribute:
        attribute, signal = kind.attribute
        value = arguments.get(attribute)
        if begins:
            _check_attribute(kind, value)
        signals[signal.name] = value if begins else max(0.0, signal_range(signal)[0])  # without a meaning at the end
    return {"kind": name, "at_us": at_us, name: "begins" if begins else "ends", **signals}


def _check_attribute(kind: FaultKind, value: Any) -> None:
    assert kind.attribute is not None
    attribute, signal = kind.attribute
    if value is None:
        raise FaultError(f"{kind.name}: {attribute} missing: must be {kind.allowed}")
    if kind.choices:
        good = value in kind.choices
    else:
        low, high = signal_range(signal)
        good = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    if not good:
        raise FaultError(f"{kind.name}: {attribute} {value!r}: must be {kind.allowed}")


# --- The page ---

_INTRODUCTION = """\
# Faults of the test bench

Generated from `emulator/rig/rig.dbc` by `python -m salient.bench.faults`; do not edit.

| from | how |
| --- | --- |
| a test | `bench.fault(KIND, phase=..., leg=..., ATTRIBUTE=..., duration_s=...)`, `bench.at(TIME).fault(...)` |
| a scenario | a table `[[fault]]` with the same names and `at_s` |
| CAN | `RIG_FAULT` |

- Begin and end are exact to the microsecond of virtual time. The CAN log has them as `RIG_TRUTH_FAULT`.
- Up to 64 changes wait for their time. Faults of different kinds and places act together.
- An unknown kind is an error that names the nearest three. An unknown place or attribute lists the valid ones.
- A fault that the machine or the target cannot have is refused as `unsupported`.
- Physics: `emulator/plant/faulted.h`; sensors: `emulator/plant/sensors.h`.

| kind | places | attribute | range | meaning |
| --- | --- | --- | --- | --- |
"""


def page() -> str:
    """Text of the page."""
    rows = []
    for kind in fault_kinds().values():
        has = (("phase a to f", kind.has_phase), ("leg high, low", kind.has_leg))
        places = ", ".join(text for text, present in has if present)
        attribute = f"`{kind.attribute[0]}`" if kind.attribute else ""
        allowed = kind.allowed if kind.attribute else ""
        rows.append(f"| `{kind.name}` | {places} | {attribute} | {allowed} | {kind.text} |")
    return _INTRODUCTION + "\n".join(rows) + "\n"


def main() -> int:
    """Writes the page."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
