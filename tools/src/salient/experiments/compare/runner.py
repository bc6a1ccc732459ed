"""Executes the runs of a comparison in parallel and extracts their metrics."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from can import CanError

from salient.bench.drive import DriveError
from salient.bench.load_profile import load_profile_path
from salient.bench.programs import EmulatorError, executable, reference_executable
from salient.bench.session import SessionError
from salient.experiments import metrics as run_metrics
from salient.experiments import tasks
from salient.experiments.compare import every_machine, mismatch, reference
from salient.experiments.compare import metrics as compare_metrics
from salient.experiments.compare.case import Case
from salient.experiments.compare.cases import GROUPS
from salient.experiments.compare.metrics import EXTRACTORS, Metrics, failures, peak_current_max_A
from salient.experiments.metrics import MetricsError
from salient.experiments.results import rounded
from salient.experiments.scenario import run_scenario
from salient.machine.cache import machine_image
from salient.machine.file import load_machine, machine_path
from salient.progress import Progress, steps_of

_METRICS_MODULES = (run_metrics, compare_metrics, every_machine, mismatch, reference)


@dataclass(frozen=True)
class RunMetrics:
    """Metrics of a case. failed: why there are none, or the limits that they violate; "" for a good run. trace: (times
    in s, torques in N m) through the extremes of short slices, None unless case.traced."""

    case: Case
    metrics: Metrics
    failed: str
    trace: tuple[list[float], list[float]] | None = None


def run_all(cases: Sequence[Case], jobs: int | None, stream: TextIO, out: Path, afresh: bool = False,
            scheduler: str | None = None) -> list[RunMetrics]:
    """Metrics in the order of `cases`, independent of the number of jobs; prints the progress on `stream`.

    A run that ends in a fault, or whose metrics cannot be computed, is marked as failed. out, afresh, scheduler, jobs:
    see tasks.run. UsageError for parameters that the drive does not have.
    """
    pairs = {(case.scenario.machine, case.scenario.true_machine) for case in cases}
    images = {pair: machine_image(*pair) for pair in pairs}
    keys = [_key(case, images[case.scenario.machine, case.scenario.true_machine]) for case in cases]
    by_key = dict(zip(keys, cases, strict=True))
    listed = [tasks.Task(key, (case, _programs_digest(case))) for key, case in by_key.items()]
    results: dict[str, tuple[Metrics, str, Any]] = {}
    with Progress(steps_of(len(listed), stream), stream, len(listed)) as progress:
        for task, result in tasks.run(listed, _run, out, scheduler=scheduler, jobs=jobs, afresh=afresh):
            results[task.key] = result
            case, _ = task.arguments
            progress.item(f"{case.group}: {case.condition} by {case.controller}")
    return _with_ratios([RunMetrics(case, *results[key]) for key, case in zip(keys, cases, strict=True)])


def _key(case: Case, image: Path) -> str:
    """Dependencies of the result of a run: its description, the programs, the image of its machine, the code of the
    metrics and its load profile."""
    profile = case.scenario.load_profile
    metrics = [Path(str(module.__file__)) for module in _METRICS_MODULES]
    files = (image, *metrics, *(() if profile is None else (load_profile_path(profile),)))
    description = repr((case.extractor, case.traced, case.window_s, case.scenario))
    parts = [_programs_digest(case), *map(tasks.file_digest, files), description]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def _programs_digest(case: Case) -> str:
    """Digest of the programs that the run of a case executes."""
    files = (executable(), *((reference_executable(),) if case.extractor == "every_machine" else ()))
    return hashlib.sha256(" ".join(map(tasks.file_digest, files)).encode()).hexdigest()


def _with_ratios(runs: Sequence[RunMetrics]) -> list[RunMetrics]:
    """Adds the ratios of the groups to the metrics of all samples but the first that they are relative to."""
    first_of: dict[tuple[str, ...], Metrics] = {}
    completed = []
    for run in runs:
        case, added = run.case, {}
        of = case.relative_to or case.condition
        first = first_of.setdefault((case.group, of, case.controller, case.extractor), run.metrics)
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
    """Runs a case; task: it, and the digest of the programs that everybody must have."""
    case, programs = task
    tasks.check_build(_programs_digest(case), programs)
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
