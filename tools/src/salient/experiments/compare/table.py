"""The table: one row per metric, a column per controller, with target, theoretical limit and published values."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

from salient.config import CONTROLLERS
from salient.experiments.compare.cases import GROUPS, STROKE_DEG, TITLES
from salient.experiments.compare.metrics import METRICS
from salient.experiments.compare.runner import RunMetrics
from salient.experiments.compare.targets import TARGETS, Key, Target, target_of

NEVER = "never"
_WORST = 10


@dataclass(frozen=True)
class Row:
    """A metric of a condition.

    values: by controller, None when the event did not occur; controllers without a run are missing. failed: by
    controller, how many of its runs have no metrics, and why the first one has none. samples: number of runs of the
    target's controller.
    """

    key: Key
    values: Mapping[str, float | None]
    failed: Mapping[str, str]
    target: Target
    samples: int = 1

    @property
    def reached(self) -> bool | None:
        """True when the target is reached. None when there is no target, its controller did not run, or the runs are
        fewer than the target is defined over."""
        target = self.target
        if target.limit is None or target.controller not in {**self.values, **self.failed} or self.too_few_samples:
            return None
        value = self.values.get(target.controller)
        return value is not None and target.controller not in self.failed and value <= target.limit

    @property
    def too_few_samples(self) -> bool:
        """True when there is a target, but too few runs to judge it."""
        return self.target.limit is not None and 0 < self.samples < self.target.samples

    @property
    def label(self) -> str:
        """The metric's label with statistic and unit."""
        _, _, name, statistic = self.key
        metric = METRICS[name]
        prefixes = {"median": "median ", "worst": "max. ", "gap": "gap of ", "spread": "max. over median of "}
        label = prefixes.get(statistic, "") + metric.label
        return f"{label}, {metric.unit}" if metric.unit and statistic != "spread" else label


def make_rows(runs: Iterable[RunMetrics], targets: Mapping[Key, Target] = TARGETS) -> list[Row]:
    """All rows, in the order of groups, conditions and metrics."""
    conditions: dict[tuple[str, str], dict[str, list[RunMetrics]]] = {}
    for run in runs:
        case = run.case
        conditions.setdefault((case.group, case.condition), {}).setdefault(case.controller, []).append(run)
    rows = []
    for (group, condition), by_controller in conditions.items():
        for metric, statistic in GROUPS[group].columns:
            row = _row((group, condition, metric, statistic), by_controller, targets)
            if row is not None:
                rows.append(row)
    return rows


def _row(key: Key, by_controller: Mapping[str, Sequence[RunMetrics]],
         targets: Mapping[Key, Target]) -> Row | None:
    """None when no run has the metric, though some have metrics."""
    _, _, metric, statistic = key
    values: dict[str, float | None] = {}
    failed: dict[str, str] = {}
    for controller, runs in by_controller.items():
        if statistic == "count":
            values[controller] = float(sum(1 for run in runs if run.failed))
            continue
        without = [run for run in runs if not run.metrics]
        if without:
            count = f"{len(without)} of {len(runs)}: " if len(runs) > 1 else ""
            failed[controller] = f"{count}{without[0].failed}"
        samples = [run.metrics[metric] for run in runs if metric in run.metrics]
        if samples:
            values[controller] = _statistic(statistic, samples)
    if not values and len(failed) < len(by_controller):
        return None
    target = target_of(targets, key)
    return Row(key, values, failed, target, len(by_controller.get(target.controller, ())))


def _statistic(statistic: str, values: Sequence[float | None]) -> float | None:
    """None (the event did not occur) sorts above all numbers."""
    numbers = sorted(math.inf if value is None else value for value in values)
    if statistic == "gap":
        return max(after - before for before, after in pairwise([*numbers, numbers[0] + STROKE_DEG]))
    if statistic == "spread":
        median = statistics.median(numbers)
        value = numbers[-1] / median if 0.0 < median < math.inf else math.inf
    else:
        value = max(numbers) if statistic == "worst" else statistics.median(numbers)
    return None if math.isinf(value) else value


def format_value(metric: str, value: float | None) -> str:
    """A value in the unit of its metric, without the unit."""
    if value is None:
        return NEVER
    of = METRICS[metric]
    return f"{value * of.factor:.{of.decimals}f}"


def format_published(row: Row) -> str:
    """The published values, by controller in the order of the columns."""
    metric = METRICS[row.key[2]]
    return " / ".join("-" if value is None else f"{value * metric.factor:.6g}"
                      for value in row.target.published.values())


def format_limit(metric: str, value: float | None) -> str:
    """A target or theoretical limit in the unit of its metric."""
    return "" if value is None else f"{value * METRICS[metric].factor:.6g}"


def status(row: Row) -> str:
    """Whether the target is reached, as text."""
    if row.too_few_samples:
        return f"not judged ({row.samples} of {row.target.samples} {row.target.sample_unit})"
    return {True: "reached", False: "NOT REACHED", None: ""}[row.reached]


def table(rows: Sequence[Row], titles: Mapping[str, str] = TITLES) -> str:
    """All rows as text, titles by group. Columns: the controllers, target, theoretical limit, published values,
    status."""
    columns = controllers_of(rows)
    lines: list[str] = []
    for group, of_group in groupby(rows, key=lambda row: row.key[0]):
        lines += ["", f"{group}: {titles[group]}",
                  f"{'':<40}" + "".join(f"{name:>12}" for name in (*columns, "target", "limit")) + "  published"]
        for condition, of_condition in groupby(of_group, key=lambda row: row.key[1]):
            condition_rows = list(of_condition)
            lines.append(f"  {condition}")
            lines += [f"    {controller}: {reason}" for controller, reason in failed_of(condition_rows).items()]
            lines += [line for row in condition_rows for line in _lines(row, columns)]
    return "\n".join(lines[1:])


def controllers_of(rows: Iterable[Row]) -> list[str]:
    """The controllers with runs, in the order of CONTROLLERS."""
    return in_order(controller for row in rows for controller in (*row.values, *row.failed))


def in_order(controllers: Iterable[str]) -> list[str]:
    """Each controller once, in the order of CONTROLLERS."""
    named = set(controllers)
    return [controller for controller in CONTROLLERS if controller in named]


def failed_of(rows: Iterable[Row]) -> dict[str, str]:
    """Why metrics of a condition are missing, by controller."""
    return {controller: reason for row in rows for controller, reason in row.failed.items()}


def cell(row: Row, controller: str) -> str:
    """The text in a controller's column; an asterisk marks statistics without the failed runs."""
    if controller in row.values:
        return format_value(row.key[2], row.values[controller]) + ("*" if controller in row.failed else "")
    return "no value" if controller in row.failed else ""


def _lines(row: Row, columns: Sequence[str]) -> list[str]:
    metric = row.key[2]
    cells = "".join(f"{cell(row, controller):>12}" for controller in columns)
    limits = f"{format_limit(metric, row.target.limit):>12}{format_limit(metric, row.target.bound):>12}"
    lines = [f"    {row.label:<36}{cells}{limits}  {format_published(row):<15}  {status(row)}".rstrip()]
    if row.reached is False and row.target.reason:
        lines.append(f"      {row.target.reason}")
    return lines


def worst(runs: Sequence[RunMetrics]) -> list[str]:
    """The runs with the largest values of the metrics of which groups name them, a line each below one of the group."""
    lines = []
    for name, group in GROUPS.items():
        for metric in group.worst:
            found = [run for run in runs if run.case.group == name and run.metrics.get(metric) is not None]
            found.sort(key=lambda run: -float(run.metrics[metric] or 0.0))
            if found:
                lines.append(f"{name}: largest {METRICS[metric].label}")
            lines += [f"  {format_value(metric, run.metrics[metric]):>12}  {run.case.condition}: {run.case.sample}"
                      for run in found[:_WORST]]
    return lines


def summary(rows: Sequence[Row]) -> str:
    """The number of targets reached, in one line."""
    judged = [row.reached for row in rows if row.reached is not None]
    skipped = sum(row.too_few_samples for row in rows)
    text = f"{sum(judged)} of {len(judged)} targets reached"
    return f"{text}, {skipped} not judged (too few samples)" if skipped else text
