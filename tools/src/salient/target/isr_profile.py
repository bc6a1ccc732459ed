"""Profile of the interrupts on a target: instructions counted by QEMU, the same on every computer."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salient.bench.programs import deferred_instructions, image
from salient.experiments.scenario import RunResult, Scenario, load_scenarios, run_scenario
from salient.paths import SCENARIOS
from salient.target.trace import Trace, read_trace

EXPERIMENTS = ("start_600", "load_step_150")


@dataclass(frozen=True)
class IsrProfile:
    """interrupts: instructions of each control interrupt, from the handler's first to its return; deferred: of each
    deferred interrupt, without instructions of control interrupts that pre-empt it. trace: of the same runs."""

    interrupts: np.ndarray
    deferred: np.ndarray
    trace: Trace

    def __add__(self, other: IsrProfile) -> IsrProfile:
        """Both runs of the same ELF image."""
        return IsrProfile(np.concatenate((self.interrupts, other.interrupts)),
                          np.concatenate((self.deferred, other.deferred)), self.trace + other.trace)

    def metrics(self) -> dict[str, int]:
        """Instructions of the control interrupt: median, 99th percentile and maximum."""
        return _metrics(self.interrupts)

    def deferred_metrics(self) -> dict[str, int]:
        """The same of the deferred interrupt."""
        return _metrics(self.deferred)

    def sum_metrics(self) -> dict[str, int]:
        """The same of both interrupts of a period together. ValueError when a period has no deferred interrupt."""
        if len(self.interrupts) != len(self.deferred):
            raise ValueError(f"{len(self.interrupts)} control and {len(self.deferred)} deferred interrupts")
        return _metrics(self.interrupts + self.deferred)

    def mean_by_module(self) -> dict[str, float]:
        """Mean instructions per interrupt, the largest first (Trace.by_module)."""
        return {name: count / len(self.interrupts) for name, count in self.trace.by_module().most_common()}


def _metrics(instructions: np.ndarray) -> dict[str, int]:
    return {"median": int(np.percentile(instructions, 50, method="inverted_cdf")),
            "p99": int(np.percentile(instructions, 99, method="inverted_cdf")),
            "max": int(instructions.max())}


def read_profile(interrupts: Path, trace: Path, machine: str, build: str) -> IsrProfile:
    """Reads the files that a run has written for BenchConfig.instructions and execution."""
    return IsrProfile(np.fromfile(interrupts, "<u4"), np.fromfile(deferred_instructions(interrupts), "<u4"),
                      read_trace(trace, image(machine, build)))


def measure_run(scenario: Scenario, out_dir: Path, build: str = "cortex-m4") -> tuple[RunResult, IsrProfile]:
    """Runs a scenario as run_scenario does, with a profile. build: one of TARGET_BUILDS."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        instructions, trace = Path(name) / "instructions", Path(name) / "trace"
        result = run_scenario(scenario, out_dir, build=build, instructions=instructions, execution=trace)
        return result, read_profile(instructions, trace, scenario.machine, build)


def measure(controller: str, build: str = "cortex-m4") -> IsrProfile:
    """Profile of the paper's two experiments, concatenated. build: one of TARGET_BUILDS."""
    profiles = []
    for experiment in EXPERIMENTS:
        (scenario,) = (one for one in load_scenarios(SCENARIOS / f"{experiment}.toml") if one.controller == controller)
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            profiles.append(measure_run(scenario, Path(folder), build)[1])
    return profiles[0] + profiles[1]
