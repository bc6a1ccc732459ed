"""Windings, wiring and direction from random starts: python -m salient.experiments.identified_starts [MACHINE ...]

A seed draws a machine, the angle of its rotor, the zero of its encoder, the direction in which that counts, the order
in which the phases are wired, noise, offsets, friction, a load. The identification runs until it has found windings,
order, direction and angles of the phases (salient.identify.sequence.Sequence.probe and align). They are compared with
the truth: the order exactly, the angles within a twelfth of an electrical revolution. A quarter of the seeds has a name
plate with another number of rotor poles: it has to be refused, there or by the pulses of the map.

Without MACHINE the machines of a campaign (bundled, examples, random). Prints a line for each seed that is wrong or
refused, and the counts. DIR/runs.jsonl has what is done: an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from salient.bench.bench import Bench
from salient.bench.drive import Experiment
from salient.errors import RunFailed, exit_code
from salient.experiments import tasks
from salient.experiments.campaign.machines import files
from salient.experiments.identified import disturb
from salient.experiments.identified_aborts import code
from salient.identify.command import MAP_MAX_S, TELEMETRY_PERIOD_MS
from salient.identify.link import Link, linked
from salient.identify.sequence import Findings
from salient.identify.sequence import Sequence as Experiments
from salient.machine.cache import bench_config
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.machine.scaling import scaling_of
from salient.paths import OUT

SEEDS = 1000
_LOADED, _OTHER_POLES, _LOAD = 0.25, 0.25, 0.2
"""Parts of the seeds; load by the rated torque."""
_CAUGHT_RAD_S2 = 10_000.0 * math.pi / 30.0
"""A load that turns the rotor faster is not caught before the over-speed (docs/limits.md)."""
_NEAR = 1.0 / 12.0
"""Largest error of a rough angle, of an electrical revolution."""
_MAP_BINS, _STANDS_RPM = 12, 1e-3
POLES = {3: (2, 4, 8, 10, 14, 16, 20, 22, 28), 4: (2, 6, 10, 14, 18), 5: (2, 4, 6, 8, 12, 14, 16), 6: (2, 5, 7, 10, 14)}
"""Rotor poles of machines, by the number of phases: of wrong name plates."""


@dataclass(frozen=True)
class Start:
    """A start. wiring: phase of the drive that the client takes for its first one, second one, ...; plate_poles: of the
    name plate."""

    seed: int
    machine: str
    initial_deg: float
    encoder_deg: float
    reversed: bool
    wiring: tuple[int, ...]
    bits: int
    condition: Mapping[str, float]
    plate_poles: int


def drawn(seed: int, machines: Sequence[str]) -> Start:
    """The start of a seed."""
    of = random.Random(seed)
    name = of.choice(machines)
    machine = load_machine(machine_path(name))
    phases, poles = machine.phases, machine.rotor_poles
    others = [each for each in POLES[phases] if each != poles]
    rated_Nm = scaling_of(machine_path(name), machine).data.torque_rated_Nm
    caught = _LOAD * rated_Nm / machine.inertia_kg_m2 < _CAUGHT_RAD_S2
    condition = {"noise_lsb": 2.0, "offset_lsb": of.uniform(0.0, 8.0), "encoder_eccentricity_deg": 0.05,
                 "coulomb": of.choice((0.0, 0.02)), "load": _LOAD if of.random() < _LOADED and caught else 0.0}
    return Start(seed, name, of.uniform(0.0, 360.0), of.uniform(-180.0, 180.0), of.random() < 0.5,
                 tuple(of.sample(range(phases), phases)), of.choice((14, 17)), condition,
                 of.choice(others) if of.random() < _OTHER_POLES else poles)


class Wired:
    """A link to a drive whose phases are wired in another order."""

    def __init__(self, link: Link, wiring: Sequence[int]) -> None:
        self._link, self._wiring = link, tuple(wiring)
        self._of_drive = np.argsort([*wiring, *range(len(wiring), 8)]).astype("u1")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def _seen(self, log: np.ndarray) -> np.ndarray:
        seen = log.copy()
        seen["phase"] = self._of_drive[log["phase"]]
        return seen

    @property
    def log(self) -> np.ndarray:
        """As of a link."""
        return self._seen(self._link.log)

    def run(self, experiment: Experiment, timeout_s: float) -> np.ndarray:
        """As of a link."""
        return self._seen(self._link.run(replace(experiment, phase=self._wiring[experiment.phase]), timeout_s))

    def rest(self, duration_s: float) -> np.ndarray:
        """As of a link."""
        return self._seen(self._link.rest(duration_s))

    def loss_part(self, phases: Sequence[int]) -> float:
        """As of a link."""
        return self._link.loss_part([self._wiring[phase] for phase in phases])


def run_one(start: Start) -> dict[str, Any]:
    """The findings by their error; executed by a worker. verdict: right, wrong or refused."""
    path = machine_path(start.machine)
    machine = load_machine(path)
    data = scaling_of(path, machine).data
    config = bench_config({"machine": str(path), "controller": "salient", "telemetry_period_ms": TELEMETRY_PERIOD_MS,
                           "encoder_bits": start.bits, "seed": start.seed,
                           "initial_angle_deg": start.initial_deg})
    result: dict[str, Any] = {"verdict": "refused", "why": "", "error": None, "time_s": None}
    with tempfile.TemporaryDirectory() as socket:
        bench = Bench(config, f"unix:{socket}/bus")
        try:
            bench.fault("encoder_jump", angle_deg=start.encoder_deg)
            if start.reversed:
                bench.fault("encoder_reversed")
            bench.drive.clear_fault()
            disturb(bench, start.condition, data)
            with linked(bench) as link:
                wired: Any = Wired(link, start.wiring)
                experiments = Experiments(wired, machine.phases, start.plate_poles, lambda _: None)
                experiments.probe()
                experiments.align()
                result["time_s"] = round(bench.time_s, 3)
                result |= _judged(start, machine.rotor_poles, experiments.found, bench, link)
                if start.plate_poles != machine.rotor_poles:
                    result |= {"verdict": "wrong", "why": f"{start.plate_poles} poles are believed"}
                    experiments.map(_MAP_BINS, 1, MAP_MAX_S)
        except RunFailed as error:
            result |= {"verdict": "refused", "why": str(error)}
        finally:
            bench.close()
    return result


def _judged(start: Start, rotor_poles: int, found: Findings, bench: Bench, link: Link) -> dict[str, Any]:
    """Order exactly, angles by the reading of the encoder at the true angle of the rotor."""
    sign, phases = -1 if start.reversed else 1, len(start.wiring)
    wanted = [sign * (start.wiring[phase] - start.wiring[0]) % phases for phase in range(phases)]
    order = [found.order[phase] for phase in range(phases)]
    bench.rig.held_speed_rpm = 0.0  # encoder and true angle are read at rest
    while abs(bench.truth["speed_rpm"].last) > _STANDS_RPM:
        link.rest(0.01)
    turn = float(link.rest(0.01)["turn"][-1])
    zero = turn - sign * float(bench.truth["rotor_angle_deg"].last) / 360.0
    bench.rig.held_speed_rpm = math.nan
    errors = [math.remainder(rotor_poles * (found.position[phase] - zero) - sign * start.wiring[phase] / phases, 1.0)
              for phase in range(phases)]
    error = max(map(abs, errors))
    right = order == wanted and error < _NEAR
    return {"verdict": "right" if right else "wrong", "error": round(error, 5),
            "why": "" if right else f"order {order}, truth {wanted}; angles {error:.3f} of an electrical revolution"}


def of_seed(arguments: tuple[int, tuple[str, ...]]) -> dict[str, Any]:
    """Result of a seed; executed by a worker."""
    return run_one(drawn(*arguments))


def main() -> int:
    """Runs the seeds; exit code 1 when one is wrong, or refused with the right number of poles."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.identified_starts", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("machines", nargs="*", help="names or files (default: those of a campaign)")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--out", type=Path, default=OUT / "identified_starts")
    options = parser.parse_args()
    machines = tuple(str(machine_path(name)) for name in options.machines) or tuple(map(str, files()))
    of = code(__file__, *machines)
    listed = [tasks.Task(f"{of} {seed}", (seed, machines))
              for seed in range(options.first, options.first + options.seeds)]
    counts: dict[tuple[bool, str], int] = {}
    errors = []
    for task, result in tasks.run(listed, of_seed, options.out, jobs=options.jobs):
        start = drawn(*task.arguments)
        other = start.plate_poles != load_machine(machine_path(start.machine)).rotor_poles
        counts[other, result["verdict"]] = counts.get((other, result["verdict"]), 0) + 1
        errors += [result["error"]] if result["verdict"] == "right" else []
        if result["verdict"] == ("wrong" if other else "refused") or result["verdict"] == "wrong":
            print(f"seed {start.seed}: {result} {start}", flush=True)
    print(f"right number of poles: {_text(counts, False)}; angles within {max(errors, default=0.0):.3f} of an "
          f"electrical revolution\nanother number of poles: {_text(counts, True)}")
    good = counts.get((False, "right"), 0) + counts.get((True, "refused"), 0)
    return 0 if good == len(listed) else 1


def _text(counts: Mapping[tuple[bool, str], int], other: bool) -> str:
    return ", ".join(f"{counts.get((other, verdict), 0)} {verdict}" for verdict in ("right", "wrong", "refused"))


if __name__ == "__main__":
    sys.exit(exit_code(main))
