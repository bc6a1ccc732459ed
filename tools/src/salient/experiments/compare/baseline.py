"""This run beside an earlier one: which figures got better and which worse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from salient.experiments.compare.metrics import FIGURES
from salient.experiments.compare.table import Key, Row, shown

_MEASURED_ONLY = ("step_angle_deg", "torque_mean_Nm")
"""Figures that are no merit: neither way is better."""


@dataclass(frozen=True)
class Change:
    """A figure that differs. earlier, now: None when it never came about or its runs failed. percent: of what the
    earlier one is above its figure's zero, positive for the worse; None when one of them is None or that is 0."""

    key: Key
    words: str
    controller: str
    earlier: float | None
    now: float | None
    percent: float | None
    worse: bool


def changes(rows: Sequence[Row], earlier: Mapping[str, Any], beyond_percent: float) -> tuple[list[Change], int]:
    """The figures that differ by more than beyond_percent and their resolution, and how many were in both runs."""
    stored = {(row["group"], row["condition"], row["figure"], row["statistic"]): row for row in earlier["rows"]}
    found, both = [], 0
    for row in rows:
        old = stored.get(row.key)
        if old is None or row.key[2] in _MEASURED_ONLY:
            continue
        for controller in {**row.values, **row.failed}:
            if controller not in old["values"] and controller not in old["failed"]:
                continue
            both += 1
            change = _change(row, controller, old, beyond_percent)
            if change is not None:
                found.append(change)
    return found, both


def _change(row: Row, controller: str, old: Mapping[str, Any], beyond_percent: float) -> Change | None:
    earlier, now = old["values"].get(controller), row.values.get(controller)
    whole = (controller not in old["failed"], controller not in row.failed)
    figure = FIGURES[row.key[2]]
    percent = None
    if whole[0] != whole[1]:
        worse = whole[0]  # a run that fails is worse than any figure
    elif earlier is None or now is None:
        if earlier is now:
            return None
        worse = now is None
    else:
        difference, excess = now - earlier, max(0.0, earlier - figure.zero)
        if (abs(difference) * figure.factor <= figure.resolution
                or 100.0 * abs(difference) <= beyond_percent * excess):
            return None
        percent = 100.0 * difference / excess if excess > 0.0 else None
        worse = difference > 0.0
    return Change(row.key, row.words, controller, earlier, now, percent, worse)


def summary(found: Sequence[Change], both: int, name: str, beyond_percent: float) -> str:
    """The changes as text, the worse ones first."""
    worse = [change for change in found if change.worse]
    better = [change for change in found if not change.worse]
    lines = [f"against {name}: {len(worse)} worse, {len(better)} better, {both - len(found)} within"
             f" {beyond_percent:g} % of {both} figures"]
    for title, part in (("WORSE", worse), ("better", better)):
        lines += [f"  {title}  {change_words(change)}" for change in part]
    return "\n".join(lines)


def change_words(change: Change) -> str:
    """A change in a line."""
    group, condition, figure, _ = change.key
    percent = "" if change.percent is None else f" ({change.percent:+.1f} %)"
    return (f"{group}, {condition}, {change.controller}: {change.words}"
            f" {shown(figure, change.earlier)} -> {shown(figure, change.now)}{percent}")
