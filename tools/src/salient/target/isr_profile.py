"""What a control interrupt costs on the Cortex-M4: its instructions, counted by QEMU, the same on every computer."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salient.bench.emulator import image
from salient.experiments.scenario import RunResult, Scenario, load_scenarios, run_scenario
from salient.paths import SCENARIOS
from salient.target.trace import Execution, read_execution

EXPERIMENTS = ("start_600", "load_step_150")


@dataclass(frozen=True)
class Cost:
    """interrupts: instructions of each, from the handler's first to its return. execution: of the same runs."""

    interrupts: np.ndarray
    execution: Execution

    def __add__(self, other: Cost) -> Cost:
        """Both runs of one image."""
        return Cost(np.concatenate((self.interrupts, other.interrupts)), self.execution + other.execution)

    def figures(self) -> dict[str, int]:
        """Typical (half of the interrupts take no more), of 99 in 100, and worst."""
        return {"typical": int(np.percentile(self.interrupts, 50, method="inverted_cdf")),
                "of_99_percent": int(np.percentile(self.interrupts, 99, method="inverted_cdf")),
                "worst": int(self.interrupts.max())}

    def mean_by_part(self) -> dict[str, float]:
        """Instructions an interrupt in the mean, the largest first (Execution.by_part)."""
        return {name: count / len(self.interrupts) for name, count in self.execution.by_part().most_common()}


def read_cost(interrupts: Path, execution: Path, machine: str, build: str) -> Cost:
    """What a run has left in the files BenchConfig.instructions and execution."""
    return Cost(np.fromfile(interrupts, "<u4"), read_execution(execution, image(machine, build)))


def measure_run(scenario: Scenario, out_dir: Path, build: str = "cortex-m4") -> tuple[RunResult, Cost]:
    """Runs a scenario as run_scenario does, counting. build: of TARGET_BUILDS."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        counted, executed = Path(name) / "instructions", Path(name) / "execution"
        result = run_scenario(scenario, out_dir, build=build, instructions=counted, execution=executed)
        return result, read_cost(counted, executed, scenario.machine, build)


def measure(controller: str, build: str = "cortex-m4") -> Cost:
    """Of the paper's two experiments, one behind the other. build: of TARGET_BUILDS."""
    costs = []
    for experiment in EXPERIMENTS:
        (scenario,) = (one for one in load_scenarios(SCENARIOS / f"{experiment}.toml") if one.controller == controller)
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            costs.append(measure_run(scenario, Path(folder), build)[1])
    return costs[0] + costs[1]
