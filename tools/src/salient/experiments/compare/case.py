"""A run of the comparison and a group of runs, and the scenarios that groups share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from salient.config import CONTROLLERS
from salient.experiments.metrics import RIPPLE_WINDOW_S
from salient.experiments.scenario import Scenario
from salient.machine.definition import Machine
from salient.machine.file import load_machine, machine_path

MAGNETICS = ("saturating", "linear_cosine", "linear_trapezoid")
MACHINES = (*MAGNETICS, "finite_element")

LOAD_NM = 8.0
STEP_AT_S = 0.13


@dataclass(frozen=True)
class Case:
    """One run and its metrics.

    extractor: key of compare/metrics.EXTRACTORS. sample: distinguishes the runs of a condition, "" for a single run.
    traced: keep the torque over the paper's window for a plot. window_s: of the ripple, for extractors whose
    recordings are longer. strokes: by which the load step is later than STEP_AT_S. relative_to: the condition whose
    first sample ratios are relative to, "" for its own.
    """

    group: str
    condition: str
    controller: str
    extractor: str
    scenario: Scenario
    sample: str = ""
    traced: bool = False
    window_s: tuple[float, float] = RIPPLE_WINDOW_S
    strokes: float = 0.0
    relative_to: str = ""


@dataclass(frozen=True)
class Group:
    """A part of the comparison.

    columns: (metric, statistic) of its rows, as far as its runs have them. The statistic is "" for a single run, else
    median, worst (maximum), spread (maximum over median), gap (widest between angles, modulo STROKE_DEG) or count (of
    failed runs). long: runs only when named. worst: metrics of which the ten worst runs are named below the table.
    ratios: metric -> its quotient by the metric of the first sample with the same extractor, of the condition or of
    the one that it is relative to, a metric of its own.
    """

    title: str
    cases: Callable[[bool], Iterator[Case]]
    columns: tuple[tuple[str, str], ...]
    long: bool = False
    worst: tuple[str, ...] = ()
    ratios: Mapping[str, str] = field(default_factory=dict)


@lru_cache
def machine_of(name: str) -> Machine:
    """A bundled machine."""
    return load_machine(machine_path(name))


def make_scenario(**fields: Any) -> Scenario:
    """A scenario of the comparison."""
    return Scenario(name="compare", **fields)


def by_controller(group: str, condition: str, extractor: str, scenario: Scenario, sample: str = "",
                  controllers: Sequence[str] = CONTROLLERS, strokes: float = 0.0) -> Iterator[Case]:
    """One run per controller."""
    for controller in controllers:
        yield Case(group, condition, controller, extractor, replace(scenario, controller=controller), sample,
                   strokes=strokes)
