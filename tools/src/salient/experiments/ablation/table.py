"""The table of an ablation: ratios of what is measured without and with a mechanism, next to their scatter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from salient.experiments.ablation.cases import PARTS, Case
from salient.experiments.ablation.measure import MEASURES, Values

RUNS_MIN = 8
"""Parts with fewer runs are not looked at by themselves."""

Results = Mapping[int, Values | str]
"""By number of the case: metrics, or why there are none."""


@dataclass(frozen=True)
class Cost:
    """Ratios of one measure over the runs of a part: geometric mean, and the geometric mean of the worst tenth."""

    mean: float
    worst: float

    def beyond(self, scatter: Cost) -> bool:
        """It costs more than the scatter."""
        return self.mean > scatter.mean or self.worst > scatter.worst

    def __str__(self) -> str:
        return f"{self.mean:.2f} ({self.worst:.2f})"


NOTHING = Cost(1.0, 1.0)


def logarithms(without: Results, reference: Results, numbers: Sequence[int], measure: str) -> np.ndarray:
    """Logarithms of the ratios of a measure, over the runs that have it in both."""
    floor = MEASURES[measure]
    ratios = []
    for number in numbers:
        of, to = without.get(number, ""), reference.get(number, "")
        if isinstance(of, Mapping) and isinstance(to, Mapping) and measure in of and measure in to:
            ratios.append(math.log((of[measure] + floor) / (to[measure] + floor)))
    return np.asarray(ratios)


def cost(ratios: np.ndarray) -> Cost:
    """Cost by the logarithms of ratios."""
    if ratios.size == 0:
        return NOTHING
    worst = np.sort(ratios)[-math.ceil(ratios.size / 10):]
    return Cost(math.exp(float(ratios.mean())), math.exp(float(worst.mean())))


def scatter(seeds: Sequence[Results], numbers: Sequence[int], measure: str) -> Cost:
    """Scatter of the same drive with other seeds: the largest of all pairs; the mean at least its standard error."""
    mean = worst = 0.0
    for one in range(len(seeds)):
        for other in range(len(seeds)):
            ratios = logarithms(seeds[one], seeds[other], numbers, measure)
            if one != other and ratios.size > 0:
                of = cost(ratios)
                mean = max(mean, math.log(of.mean), float(ratios.std()) / math.sqrt(ratios.size))
                worst = max(worst, math.log(of.worst))
    return Cost(math.exp(mean), math.exp(worst))


@dataclass(frozen=True)
class Row:
    """Cost of the removal of a mechanism. own: by measure, in the parts that it was made for, and the scatter there;
    most: the part and measure whose mean is the furthest beyond its scatter; changed, failed: numbers of runs."""

    name: str
    own: dict[str, tuple[Cost, Cost]]
    most: tuple[str, str, Cost, Cost] | None
    runs: int
    changed: int
    failed: int

    @property
    def is_missed(self) -> bool:
        """Its removal costs more than the scatter where it was made for, or makes drives fail."""
        return self.failed > 0 or any(of.beyond(by) for of, by in self.own.values())


class Ablation:
    """Results of a set of runs with the whole drive, by seed; rows of mechanisms."""

    def __init__(self, cases: Sequence[Case], seeds: Sequence[Results]) -> None:
        self._cases, self._seeds = cases, seeds

    def numbers(self, parts: Sequence[str]) -> list[int]:
        """Cases of any of the parts."""
        return [case.number for case in self._cases if not set(parts).isdisjoint(case.parts)]

    def row(self, name: str, parts: Sequence[str], without: Results) -> Row:
        """The row of a mechanism that was made for some parts."""
        reference = self._seeds[0]
        own = self.numbers(parts)
        by_measure = {measure: (cost(logarithms(without, reference, own, measure)), scatter(self._seeds, own, measure))
                      for measure in MEASURES}
        most, most_by = None, 0.0
        for part in PARTS:
            numbers = self.numbers([part])
            for measure in MEASURES if len(numbers) >= RUNS_MIN else ():
                of, by = (cost(logarithms(without, reference, numbers, measure)),
                          scatter(self._seeds, numbers, measure))
                if math.log(of.mean) > most_by * math.log(by.mean):
                    most, most_by = (measure, part, of, by), math.log(of.mean) / max(math.log(by.mean), 1e-9)
        both = [number for number in reference if number in without]
        return Row(name, by_measure, most, len(both), sum(without[number] != reference[number] for number in both),
                   _failures(without, both) - _failures(reference, both))


def _failures(results: Results, numbers: Sequence[int]) -> int:
    """Runs that ended in a fault, or whose speed had not settled before the load."""
    return sum("start" not in results[number] for number in numbers)


def head() -> str:
    """Head of the table, in Markdown."""
    return (f"| without | made for | runs that change | {' | '.join(MEASURES)} | failures | most in | needed by |\n"
            f"|{' --- |' * (len(MEASURES) + 6)}\n")


def line(row: Row, parts: Sequence[str], need: str) -> str:
    """A row in Markdown; what is beyond the scatter is bold."""
    cells = [f"**{of}**" if of.beyond(by) else str(of) for of, by in row.own.values()]
    most = "" if row.most is None else f"{row.most[0]}, {row.most[1]}: {row.most[2]}, scatter {row.most[3]}"
    return (f"| {row.name} | {'; '.join(parts)} | {row.changed} of {row.runs} | {' | '.join(cells)} | {row.failed:+d} "
            f"| {most} | {need} |\n")
