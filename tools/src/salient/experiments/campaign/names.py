"""Names of the numbers in results."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from salient.bus.signals import drive_database, rig_database, value_numbers

STATES = ("initialise", "ready", "run", "fault")
SECTORS = 6
_OF_TARGETS = {"code_flipped", "stack_guard_flipped"}
_REASONS = {
    "gate_on": {1: "outside of run", 2: "without safe torque off lines", 3: "without a control interrupt"},
    "no_command": {1: "not armed", 2: "after off", 3: "without a command",
                   5: "fault cleared", 6: "in run without a command", 8: "after a reset"},
    "torque_in_silence": {4: "not gone", 7: "grown"},
    "cleared": {0: "at the start", 3: "with its cause", 4: "by an earlier request", 5: "before the encoder counts",
                6: "before both lines were off"},
    "wrong_telemetry": {**dict.fromkeys(range(4), "current"), 8: "link voltage", 9: "speed"},
    "wrong_snapshot": {16: "speed", 17: "link voltage", 18: "current"},
    "quick_stop": {1: "faster", 2: "gates on", 3: "not at rest"},
    "not_recovered": {1: "not in run", 2: "not at the speed", 3: "fault again", 4: "with a phase left out"},
}


@lru_cache
def causes() -> dict[int, str]:
    """Names of the drive's faults by number."""
    return {number: name for name, number in value_numbers(drive_database(), "DRIVE_STATUS", "fault").items()}


@lru_cache
def kinds() -> dict[int, str]:
    """Names of the bench's faults by number."""
    numbers = value_numbers(rig_database(), "RIG_FAULT", "kind")
    return {number: name for name, number in numbers.items()}


def violation(of: dict[str, Any]) -> str:
    """The class of a violation: its rule, and what distinguishes it."""
    rule, number = of["rule"], of["number"]
    if rule in ("wrong_cause", "not_first", "false_alarm"):
        return f"{rule}: {causes().get(number, number)}"
    return f"{rule}: {_REASONS[rule][number]}" if number in _REASONS.get(rule, {}) else str(rule)


def cell(number: int) -> str:
    """Fault, state and sector of a cell."""
    rest, sector = divmod(number, SECTORS)
    kind, state = divmod(rest, len(STATES))
    return f"{kinds()[kind]} in {STATES[state]}, sector {sector}"


def cells() -> list[int]:
    """All cells that there are on the host."""
    part = len(STATES) * SECTORS
    possible = sorted(kind for kind, name in kinds().items() if name not in _OF_TARGETS)
    return [kind * part + index for kind in possible for index in range(part)]
