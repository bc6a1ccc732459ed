"""The table: a row a figure, with the controllers beside each other and beside what is wanted, possible and printed."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

from salient.bench.config import CONTROLLERS
from salient.experiments.compare.cases import GROUPS, STROKE_DEG
from salient.experiments.compare.metrics import FIGURES
from salient.experiments.compare.runner import Outcome
from salient.experiments.compare.targets import TARGETS, Key, Target

NEVER = "never"


@dataclass(frozen=True)
class Row:
    """A figure of a condition. values: by controller, None where it did not come about; a controller that was not run
    is not there. failed: by controller, how many of its runs have no figures, and why the first one has none."""

    key: Key
    values: Mapping[str, float | None]
    failed: Mapping[str, str]
    target: Target

    @property
    def reached(self) -> bool | None:
        """Whether what is wanted is reached; None when nothing is, or the controller that it is wanted of did not
        run."""
        target = self.target
        if target.wanted is None or target.controller not in {**self.values, **self.failed}:
            return None
        value = self.values.get(target.controller)
        return value is not None and target.controller not in self.failed and value <= target.wanted

    @property
    def words(self) -> str:
        """The figure's words with its statistic and unit."""
        _, _, name, statistic = self.key
        figure = FIGURES[name]
        words = {"median": "median ", "worst": "worst ", "gap": "gap of "}.get(statistic, "") + figure.words
        return f"{words}, {figure.unit}" if figure.unit else words


def make_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """All rows, in the order of groups, conditions and figures."""
    conditions: dict[tuple[str, str], dict[str, list[Outcome]]] = {}
    for outcome in outcomes:
        case = outcome.case
        conditions.setdefault((case.group, case.condition), {}).setdefault(case.controller, []).append(outcome)
    rows = []
    for (group, condition), by_controller in conditions.items():
        for figure, statistic in GROUPS[group].shown:
            key = (group, condition, figure, statistic)
            row = _row(key, by_controller)
            if row is not None:
                rows.append(row)
    return rows


def _row(key: Key, by_controller: Mapping[str, Sequence[Outcome]]) -> Row | None:
    """None when no run has the figure, though some have figures."""
    _, _, figure, statistic = key
    values: dict[str, float | None] = {}
    failed: dict[str, str] = {}
    for controller, outcomes in by_controller.items():
        if statistic == "count":
            values[controller] = float(sum(1 for outcome in outcomes if outcome.failed))
            continue
        without = [outcome for outcome in outcomes if not outcome.figures]
        if without:
            count = f"{len(without)} of {len(outcomes)}: " if len(outcomes) > 1 else ""
            failed[controller] = f"{count}{without[0].failed}"
        taken = [outcome.figures[figure] for outcome in outcomes if figure in outcome.figures]
        if taken:
            values[controller] = _statistic(statistic, taken)
    if not values and len(failed) < len(by_controller):
        return None
    return Row(key, values, failed, TARGETS.get(key, Target()))


def _statistic(statistic: str, values: Sequence[float | None]) -> float | None:
    """A figure that never came about is beyond all others."""
    numbers = sorted(math.inf if value is None else value for value in values)
    if statistic == "gap":
        return max(after - before for before, after in pairwise([*numbers, numbers[0] + STROKE_DEG]))
    value = max(numbers) if statistic == "worst" else statistics.median(numbers)
    return None if math.isinf(value) else value


def shown(figure: str, value: float | None) -> str:
    """A value in its figure's unit, without the unit."""
    if value is None:
        return NEVER
    of = FIGURES[figure]
    return f"{value * of.factor:.{of.decimals}f}"


def printed_words(row: Row) -> str:
    """What the paper prints, by controller in the order of the columns."""
    figure = FIGURES[row.key[2]]
    return " / ".join("-" if value is None else f"{value * figure.factor:.6g}" for value in row.target.printed.values())


def mark(row: Row) -> str:
    """Whether what is wanted is reached, in a word or two."""
    return {True: "reached", False: "NOT REACHED", None: ""}[row.reached]


def limit_words(figure: str, value: float | None) -> str:
    """A wanted value or bound in the unit of its figure."""
    return "" if value is None else f"{value * FIGURES[figure].factor:.6g}"


def table(rows: Sequence[Row]) -> str:
    """Everything as text. Columns: the controllers, wanted, bound, printed, whether reached."""
    columns = controllers_of(rows)
    lines: list[str] = []
    for group, of_group in groupby(rows, key=lambda row: row.key[0]):
        lines += ["", f"{group}: {GROUPS[group].title}",
                  f"{'':<40}" + "".join(f"{name:>12}" for name in (*columns, "wanted", "bound")) + "  printed"]
        for condition, of_condition in groupby(of_group, key=lambda row: row.key[1]):
            shown_rows = list(of_condition)
            lines.append(f"  {condition}")
            lines += [f"    {controller}: {why}" for controller, why in failed_of(shown_rows).items()]
            lines += [line for row in shown_rows for line in _lines(row, columns)]
    return "\n".join(lines[1:])


def controllers_of(rows: Iterable[Row]) -> list[str]:
    """Those that were run, in the order of CONTROLLERS."""
    return in_order(controller for row in rows for controller in (*row.values, *row.failed))


def in_order(controllers: Iterable[str]) -> list[str]:
    """Each once, in the order of CONTROLLERS."""
    named = set(controllers)
    return [controller for controller in CONTROLLERS if controller in named]


def failed_of(rows: Iterable[Row]) -> dict[str, str]:
    """Why figures of a condition are missing, by controller."""
    return {controller: why for row in rows for controller, why in row.failed.items()}


def cell(row: Row, controller: str) -> str:
    """What a controller's column shows; a star: only of the runs that ended well."""
    if controller in row.values:
        return shown(row.key[2], row.values[controller]) + ("*" if controller in row.failed else "")
    return "no figure" if controller in row.failed else ""


def _lines(row: Row, columns: Sequence[str]) -> list[str]:
    figure = row.key[2]
    cells = "".join(f"{cell(row, controller):>12}" for controller in columns)
    limits = f"{limit_words(figure, row.target.wanted):>12}{limit_words(figure, row.target.bound):>12}"
    lines = [f"    {row.words:<36}{cells}{limits}  {printed_words(row):<15}  {mark(row)}".rstrip()]
    if row.reached is False and row.target.reason:
        lines.append(f"      {row.target.reason}")
    return lines


def verdict(rows: Sequence[Row]) -> str:
    """How many of the wanted figures are reached, in a line."""
    marks = [row.reached for row in rows if row.reached is not None]
    return f"{sum(marks)} of {len(marks)} wanted figures reached"
