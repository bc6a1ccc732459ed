"""The emulated plant compared with reference solvers: processor time and deviation from a tight solution, for the same
machine, switching pattern and duration."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from salient.benchmark.switching_pattern import SwitchingPattern, Trajectory, deviation, run_plant
from salient.reference.ngspice_plant import run_ngspice
from salient.reference.scipy_plant import dop853, dopri5, lsoda, run_scipy

REFERENCE_TOLERANCE = 1e-12
_PLANT_PASSES = 20
"""Passes of the plant, of one millisecond each; --runs sets the passes of the reference solvers."""

PLANT = {"plant": 1.0, "plant, steps of 1/8": 1.0 / 8.0, "plant, steps of 1/32": 1.0 / 32.0}
"""Factors of the step-size limits."""

REFERENCE_SOLVERS: dict[str, Callable[[SwitchingPattern], Trajectory]] = {
    "SciPy LSODA, 1e-6": partial(run_scipy, solver=lsoda(1e-6)),
    "SciPy LSODA, 1e-9": partial(run_scipy, solver=lsoda(1e-9)),
    "SciPy LSODA, 1e-12": partial(run_scipy, solver=lsoda(1e-12)),
    "SciPy DOPRI5, 1e-6": partial(run_scipy, solver=dopri5(1e-6)),
    "ngspice, 1 us": partial(run_ngspice, step_ns=1000),
}
"""SciPy's solvers with their tolerance, ngspice with its maximum step. DOPRI5, a one-step method, has the lowest cost
for restarts at switch edges some 6 us apart."""


def compare(pattern: SwitchingPattern, runs: int,
            progress: Callable[[str], object] = lambda _: None) -> list[dict[str, Any]]:
    """One row per solver: name, shortest processor time, and largest deviations (see deviation) from DOP853 at 1e-12.
    Rows of reference solvers contain the speed-up of the plant, at its fastest setting that deviates no more in any
    quantity; None when there is none. progress: called with the name of each solver before it runs."""
    progress("reference")
    reference = run_scipy(pattern, dop853(REFERENCE_TOLERANCE))
    rows = []
    for name, factor in PLANT.items():
        progress(name)
        rows.append(_row(name, pattern, run_plant(pattern, _PLANT_PASSES, factor), reference))
    plants = list(rows)
    for name, run in REFERENCE_SOLVERS.items():
        progress(name)
        fastest_run = min((run(pattern) for _ in range(runs)), key=lambda trajectory: trajectory.processor_s)
        row = _row(name, pattern, fastest_run, reference)
        better = [plant for plant in plants
                  if all(plant["deviation"][key] <= row["deviation"][key] for key in row["deviation"])]
        fastest = min(better, key=lambda plant: plant["processor_s"], default=None)
        row["compared_with"] = fastest and fastest["solver"]
        row["plant_times_faster"] = fastest and row["processor_s"] / fastest["processor_s"]
        rows.append(row)
    return rows


def _row(name: str, pattern: SwitchingPattern, done: Trajectory, reference: Trajectory) -> dict[str, Any]:
    return {
        "solver": name,
        "processor_s": done.processor_s,
        "simulated_s_per_s": pattern.duration_s / done.processor_s,
        "evaluations_per_period": done.evaluations and done.evaluations / pattern.periods,
        "deviation": deviation(done, reference),
    }
