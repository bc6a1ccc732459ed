"""What a control interrupt costs on the Cortex-M4: its instructions, counted by QEMU, the same on every computer."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salient.paths import SCENARIOS
from salient.scenario import load_scenarios, run_scenario

EXPERIMENTS = ("start_600", "load_step_150")


@dataclass(frozen=True)
class Cost:
    """Instructions from the handler's first to its return: of each interrupt, and of all by function, each without what
    it calls and with what is inlined in it."""

    interrupts: np.ndarray
    functions: Counter[str]

    def figures(self) -> dict[str, int]:
        """Typical (half of the interrupts take no more), of 99 in 100, and worst."""
        return {"typical": int(np.percentile(self.interrupts, 50, method="inverted_cdf")),
                "of_99_percent": int(np.percentile(self.interrupts, 99, method="inverted_cdf")),
                "worst": int(self.interrupts.max())}

    def by_function(self) -> dict[str, float]:
        """Instructions an interrupt in the mean, the largest first."""
        return {name: count / len(self.interrupts) for name, count in self.functions.most_common()}


def measure(controller: str, build: str = "cortex-m4") -> Cost:
    """Of the paper's two experiments, one behind the other. build: of TARGET_BUILDS."""
    interrupts, functions = [], Counter()
    for experiment in EXPERIMENTS:
        (scenario,) = (one for one in load_scenarios(SCENARIOS / f"{experiment}.toml") if one.controller == controller)
        with tempfile.TemporaryDirectory(prefix="salient-") as name:
            folder = Path(name)
            run_scenario(scenario, folder / "run", build=build, instructions=folder / "instructions",
                         profile=folder / "profile")
            interrupts.append(np.fromfile(folder / "instructions", "<u4"))
            for line in (folder / "profile").read_text(encoding="utf-8").splitlines():
                count, function = line.split(" ", 1)
                functions[function] += int(count)
    return Cost(np.concatenate(interrupts), functions)
