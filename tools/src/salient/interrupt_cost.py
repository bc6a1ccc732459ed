"""What a control interrupt costs on the Cortex-M4: its instructions, counted by QEMU, the same on every computer."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from salient.paths import SCENARIOS
from salient.scenario import load_scenarios, run_scenario

EXPERIMENTS = ("start_600", "load_step_150")


def count(controller: str, build: str = "cortex-m4") -> np.ndarray:
    """Instructions of each control interrupt, from the handler's first to its return, of the paper's two experiments
    one behind the other. build: of TARGET_BUILDS."""
    counts = []
    for experiment in EXPERIMENTS:
        (scenario,) = (one for one in load_scenarios(SCENARIOS / f"{experiment}.toml") if one.controller == controller)
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            path = Path(folder) / "instructions"
            run_scenario(scenario, Path(folder) / "run", build=build, instructions=path)
            counts.append(np.fromfile(path, "<u4"))
    return np.concatenate(counts)


def figures(counts: np.ndarray) -> dict[str, int]:
    """Typical (half of the interrupts take no more), of 99 in 100, and worst."""
    return {"typical": int(np.percentile(counts, 50, method="inverted_cdf")),
            "of_99_percent": int(np.percentile(counts, 99, method="inverted_cdf")),
            "worst": int(counts.max())}
