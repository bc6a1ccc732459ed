"""Comparison of a run with a baseline, an earlier run: which metrics got better and which worse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from salient.experiments.compare.metrics import METRICS
from salient.experiments.compare.table import Row, format_value
from salient.experiments.compare.targets import Key

_INFORMATIVE = ("step_angle_deg", "torque_mean_Nm")
"""Metrics of which neither direction is better."""


@dataclass(frozen=True)
class Change:
    """A metric that differs from the baseline.

    before, now: None when the event did not occur or the runs failed.
    percent: change relative to the same metric in the baseline, positive for worse; None when a value is missing or the
    baseline is 0.
    excess_percent: change relative to the excess of the baseline over the metric's reference, None without excess. The
    threshold applies to it. It equals percent for metrics whose reference is 0.
    """

    key: Key
    label: str
    controller: str
    before: float | None
    now: float | None
    percent: float | None
    excess_percent: float | None
    worse: bool


def changes(rows: Sequence[Row], baseline: Mapping[str, Any], beyond_percent: float) -> tuple[list[Change], int]:
    """The metrics that differ by more than beyond_percent and their resolution, and the number of metrics in both
    runs. baseline: content of its compare.json."""
    stored = {(row["group"], row["condition"], row["figure"], row["statistic"]): row for row in baseline["rows"]}
    found, both = [], 0
    for row in rows:
        old = stored.get(row.key)
        if old is None or row.key[2] in _INFORMATIVE:
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
    before, now = old["values"].get(controller), row.values.get(controller)
    complete_before, complete_now = controller not in old["failed"], controller not in row.failed
    metric = METRICS[row.key[2]]
    percent = excess_percent = None
    if complete_before != complete_now:
        worse = complete_before  # a failed run is worse than any value
    elif before is None or now is None:
        if before is now:
            return None
        worse = now is None
    else:
        difference, excess = now - before, max(0.0, before - metric.reference)
        if (abs(difference) * metric.factor <= metric.resolution
                or 100.0 * abs(difference) <= beyond_percent * excess):
            return None
        percent = 100.0 * difference / before if before > 0.0 else None
        excess_percent = 100.0 * difference / excess if excess > 0.0 else None
        worse = difference > 0.0
    return Change(row.key, row.label, controller, before, now, percent, excess_percent, worse)


def summary(found: Sequence[Change], both: int, name: str, beyond_percent: float) -> str:
    """The changes as text, worse ones first."""
    worse = [change for change in found if change.worse]
    better = [change for change in found if not change.worse]
    lines = [f"baseline {name}: {len(worse)} worse, {len(better)} better, {both - len(found)} of {both} metrics"
             f" unchanged (within {beyond_percent:g} %)"]
    for title, part in (("WORSE", worse), ("better", better)):
        lines += [f"  {title}  {change_text(change)}" for change in part]
    return "\n".join(lines)


def change_text(change: Change) -> str:
    """A change in one line. Percentages refer to the same metric in the baseline; a metric with a reference other than
    0 also shows the change of its excess."""
    group, condition, name, _ = change.key
    metric = METRICS[name]
    percent = "" if change.percent is None else f" ({change.percent:+.1f} %)"
    if metric.reference and change.percent is not None and change.excess_percent is not None:
        percent = (f" ({change.percent:+.2f} %; {change.excess_percent:+.1f} % of the excess over"
                   f" {metric.reference * metric.factor:g})")
    return (f"{group}, {condition}, {change.controller}: {change.label}"
            f" {format_value(name, change.before)} -> {format_value(name, change.now)}{percent}")
