"""Makes the runs, several at a time, and keeps of each what the comparison needs."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from can import CanError

from salient.bench.drive import DriveError
from salient.bench.emulator import EmulatorError
from salient.bench.session import SessionError
from salient.experiments.compare.cases import RIPPLE_FROM_S, Case
from salient.experiments.compare.metrics import MEASURES, SHORT_WINDOW_S, Figures, failures
from salient.experiments.metrics import MetricsError
from salient.experiments.results import rounded
from salient.experiments.scenario import run_scenario
from salient.progress import Progress

_LINES_MAX = 20  # of progress, where it cannot be shown in place


@dataclass(frozen=True)
class Outcome:
    """What came of a case. failed: why there are no figures, or what they did not keep to; "" when all is well.
    trace: (times in s, torques in N m) through the extremes of many short slices, None when not asked for."""

    case: Case
    figures: Figures
    failed: str
    trace: tuple[list[float], list[float]] | None = None


def run_all(cases: Sequence[Case], jobs: int, stream: TextIO) -> list[Outcome]:
    """Outcomes in the order of `cases`, whatever the number of jobs; how far it is goes to `stream`.

    A run that ends in a fault, or from which a figure cannot be taken, says so in its outcome. UsageError for what the
    drive does not know.
    """
    kinds: dict[str, int] = {}  # what is run -> its first case
    first_of = [kinds.setdefault(repr((case.measure, case.traced, case.scenario)), number)
                for number, case in enumerate(cases)]
    numbers = sorted(kinds.values())
    lines = len(numbers) if stream.isatty() else min(len(numbers), _LINES_MAX)
    results: dict[int, tuple[Figures, str, Any]] = {}
    with (ProcessPoolExecutor(jobs, initializer=_leave_interrupts_to_parent) as workers,
          Progress(lines, stream) as progress):
        futures = {workers.submit(_run, cases[number]): number for number in numbers}
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                case = cases[futures[future]]
                results[futures[future]] = future.result()
                if done * lines // len(numbers) > (done - 1) * lines // len(numbers):
                    progress.step(f"{case.group}: {case.condition} by {case.controller}")
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return [Outcome(case, *results[first]) for case, first in zip(cases, first_of, strict=True)]


def _leave_interrupts_to_parent() -> None:
    """For a worker: Ctrl-C reaches the whole group, and one process answering it is enough."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(case: Case) -> tuple[Figures, str, Any]:
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        try:
            result = run_scenario(case.scenario, Path(folder))
            if result.fault != "none":
                return {}, f"fault {result.fault}", None
            figures = rounded(MEASURES[case.measure](case.scenario, result.recording))
        except (EmulatorError, SessionError, DriveError, CanError, MetricsError) as error:
            return {}, str(error), None
        failed = "; ".join(failures(figures)) if case.measure == "robustness" else ""
        return figures, failed, _trace(result.recording) if case.traced else None


def _trace(recording: Any) -> tuple[list[float], list[float]]:
    from salient.experiments.plots import extremes

    window = ((recording["time_s"] >= RIPPLE_FROM_S - 1e-9)
              & (recording["time_s"] <= RIPPLE_FROM_S + SHORT_WINDOW_S + 1e-9))
    time_s, torque_Nm = extremes(recording["time_s"][window], recording["torque_Nm"][window], slices=800)
    return rounded(time_s.tolist()), rounded([float(value) for value in torque_Nm])
