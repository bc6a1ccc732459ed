"""The emulated plant beside other simulators: the same machine, switching pattern and time by each, what it costs and
how far it is from a tight solution."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from salient.benchmark.switching_pattern import Replay, Trajectory, deviation, run_plant
from salient.reference.ngspice_plant import run_ngspice
from salient.reference.scipy_plant import dop853, dopri5, lsoda, run_scipy

REFERENCE_TOLERANCE = 1e-12
_PLANT_PASSES = 20
"""Of a millisecond each; the others are run as often as the user says."""

PLANT = {"plant": 1.0, "plant, steps of 1/8": 1.0 / 8.0, "plant, steps of 1/32": 1.0 / 32.0}
"""Factors of the step's limits."""

PEERS: dict[str, Callable[[Replay], Trajectory]] = {
    "SciPy LSODA, 1e-6": partial(run_scipy, solver=lsoda(1e-6)),
    "SciPy LSODA, 1e-9": partial(run_scipy, solver=lsoda(1e-9)),
    "SciPy LSODA, 1e-12": partial(run_scipy, solver=lsoda(1e-12)),
    "SciPy DOPRI5, 1e-6": partial(run_scipy, solver=dopri5(1e-6)),
    "ngspice, 1 us": partial(run_ngspice, step_ns=1000),
}
"""SciPy's by tolerance, ngspice by its longest step. DOPRI5 because between switch edges some 6 us apart a method that
starts afresh at each does best."""


def compare(replay: Replay, runs: int, say: Callable[[str], None] = lambda _: None) -> list[dict[str, Any]]:
    """A row a solver: name, shortest processor time, and largest deviations (see deviation) from DOP853 at 1e-12. A
    peer's row says how many times faster the plant is, the fastest setting of it that deviates no more than the peer
    in any quantity; None when none does. say: told each row's solver as it begins."""
    say("reference")
    reference = run_scipy(replay, dop853(REFERENCE_TOLERANCE))
    rows = []
    for name, factor in PLANT.items():
        say(name)
        rows.append(_row(name, replay, run_plant(replay, _PLANT_PASSES, factor), reference))
    plants = list(rows)
    for name, run in PEERS.items():
        say(name)
        row = _row(name, replay, min((run(replay) for _ in range(runs)), key=lambda done: done.processor_s), reference)
        better = [plant for plant in plants
                  if all(plant["deviation"][key] <= row["deviation"][key] for key in row["deviation"])]
        fastest = min(better, key=lambda plant: plant["processor_s"], default=None)
        row["compared_with"] = fastest and fastest["solver"]
        row["plant_times_faster"] = fastest and row["processor_s"] / fastest["processor_s"]
        rows.append(row)
    return rows


def _row(name: str, replay: Replay, done: Trajectory, reference: Trajectory) -> dict[str, Any]:
    return {
        "solver": name,
        "processor_s": done.processor_s,
        "simulated_s_per_s": replay.duration_s / done.processor_s,
        "evaluations_per_period": done.evaluations and done.evaluations / replay.periods,
        "deviation": deviation(done, reference),
    }
