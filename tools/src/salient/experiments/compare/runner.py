"""Executes the runs of a comparison in parallel and extracts their metrics."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from can import CanError

from salient.bench.drive import DriveError
from salient.bench.programs import EmulatorError
from salient.bench.session import SessionError
from salient.experiments.compare import every_machine
from salient.experiments.compare.case import Case
from salient.experiments.compare.cases import GROUPS
from salient.experiments.compare.finished_runs import FinishedRuns, programs_digest
from salient.experiments.compare.metrics import EXTRACTORS, Metrics, failures, peak_current_max_A
from salient.experiments.metrics import MetricsError
from salient.experiments.results import rounded
from salient.experiments.scenario import run_scenario
from salient.experiments.tasks import Task, check_build, execute
from salient.machine.file import load_machine, machine_path
from salient.progress import Progress

_PROGRESS_LINES_MAX = 20
"""Without a terminal, which would show the progress in place."""


@dataclass(frozen=True)
class RunMetrics:
    """Metrics of a case. failed: why there are none, or the limits that they violate; "" for a good run. trace: (times
    in s, torques in N m) through the extremes of short slices, None unless case.traced."""

    case: Case
    metrics: Metrics
    failed: str
    trace: tuple[list[float], list[float]] | None = None


def run_all(cases: Sequence[Case], jobs: int, stream: TextIO, finished: FinishedRuns | None = None,
            scheduler: str | None = None) -> list[RunMetrics]:
    """Metrics in the order of `cases`, independent of the number of jobs; prints the progress on `stream`.

    A run that ends in a fault, or whose metrics cannot be computed, is marked as failed. Runs in `finished` are not
    executed, the others are added to it. scheduler: see tasks.run. UsageError for parameters that the drive does not
    have.
    """
    descriptions = [repr((case.extractor, case.traced, case.window_s, case.scenario)) for case in cases]
    first_cases: dict[str, int] = {}  # description of the run -> number of its first case
    first_of = [first_cases.setdefault(description, number) for number, description in enumerate(descriptions)]
    results: dict[int, tuple[Metrics, str, Any]] = {}
    for description, number in first_cases.items():
        known = finished.get(cases[number], description) if finished else None
        if known is not None:
            results[number] = known
    numbers = sorted(number for number in first_cases.values() if number not in results)
    lines = len(numbers) if stream.isatty() else min(len(numbers), _PROGRESS_LINES_MAX)
    listed = [Task(str(number), (cases[number], programs_digest(cases[number]))) for number in numbers]
    with Progress(lines, stream) as progress:
        for done, (task, result) in enumerate(execute(listed, _run, scheduler, jobs), start=1):
            case, number = cases[int(task.key)], int(task.key)
            results[number] = result
            if finished:
                finished.add(case, descriptions[number], *result)
            if done * lines // len(numbers) > (done - 1) * lines // len(numbers):
                progress.step(f"{case.group}: {case.condition} by {case.controller}")
    return _with_ratios([RunMetrics(case, *results[first]) for case, first in zip(cases, first_of, strict=True)])


def _with_ratios(runs: Sequence[RunMetrics]) -> list[RunMetrics]:
    """Adds the ratios of the groups to the metrics of all samples but the first of each condition."""
    first_of: dict[tuple[str, ...], Metrics] = {}
    completed = []
    for run in runs:
        case, added = run.case, {}
        first = first_of.setdefault((case.group, case.condition, case.controller, case.extractor), run.metrics)
        for metric, ratio in GROUPS[case.group].ratios.items():
            if first is not run.metrics and metric in run.metrics and metric in first:
                added[ratio] = _ratio(run.metrics[metric], first[metric])
        completed.append(replace(run, metrics={**run.metrics, **added}))
    return completed


def _ratio(value: float | None, of: float | None) -> float | None:
    """None when the event did not occur in the run itself; 0 relative to 0 is 1."""
    if value is None or of is None or (of == 0.0 and value > 0.0):
        return None
    return value / of if of > 0.0 else 1.0


def _run(task: tuple[Case, str]) -> tuple[Metrics, str, Any]:
    """Of a case, and the digest of the programs that everybody must have."""
    case, programs = task
    check_build(programs_digest(case), programs)
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        try:
            result = run_scenario(case.scenario, Path(folder))
            if result.fault != "none":
                return {}, f"fault {result.fault}", None
            assert result.recording is not None  # every case is recorded
            metrics: Metrics = rounded(EXTRACTORS[case.extractor](case.scenario, result.recording, case.window_s))
        except (EmulatorError, SessionError, DriveError, CanError, MetricsError) as error:
            return {}, str(error), None
        failed = ""
        if case.extractor in ("robustness", "random_load"):
            machine = load_machine(machine_path(case.scenario.machine))
            failed = "; ".join(failures(metrics, peak_current_max_A(machine)))
        if case.extractor == "every_machine":
            failed = "; ".join(every_machine.failures(metrics, case.controller))
        return metrics, failed, _trace(case, result.recording) if case.traced else None


def _trace(case: Case, recording: Any) -> tuple[list[float], list[float]]:
    from salient.experiments.plots import extremes

    first_s, last_s = case.window_s
    window = (recording["time_s"] >= first_s - 1e-9) & (recording["time_s"] <= last_s + 1e-9)
    time_s, torque_Nm = extremes(recording["time_s"][window], recording["torque_Nm"][window], slices=800)
    return rounded(time_s.tolist()), rounded([float(value) for value in torque_Nm])
