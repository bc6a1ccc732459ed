"""Ablation of the BP network: the load-step experiment with the network in each of its modes."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from salient.experiments.metrics import RIPPLE_WINDOW_S, torque_metrics
from salient.experiments.scenario import Record, load_scenarios, run_scenario
from salient.paths import MACHINES, SCENARIOS

SEEDS = (1, 2, 3, 4, 5)

# Value of the parameter bp_mode, and the seeds of the initial weights.
MODES: dict[str, tuple[int, tuple[int, ...]]] = {
    "off": (0, (1,)),  # hysteresis instead of the PID
    "fixed": (1, (1,)),  # gains at the middle of their range
    "frozen": (2, SEEDS),  # gains from the network with its initial weights
    "learning": (3, SEEDS),
}


def ripple(machine: str, mode: str) -> tuple[list[float], list[str]]:
    """Torque ripple K_t of the paper's controller at 150 r/min and 8 N m, one value per seed of the initial weights;
    and the faults of the runs that ended in one and have no ripple."""
    number, seeds = MODES[mode]
    paper = next(s for s in load_scenarios(SCENARIOS / "load_step_150.toml") if s.controller == "paper")
    first_s, last_s = RIPPLE_WINDOW_S
    ripples, faults = [], []
    for seed in seeds:
        scenario = replace(
            paper,
            machine=machine,
            duration_s=last_s + 1e-3,
            record=Record(step_us=1.0, from_s=first_s),
            parameters={"bp_mode": number, "bp_seed": seed},
        )
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            result = run_scenario(scenario, Path(folder))
            if result.fault != "none":
                faults.append(result.fault)
                continue
            recording = result.recording
            assert recording is not None
            metrics = torque_metrics(recording["time_s"], recording["torque_Nm"], RIPPLE_WINDOW_S)
        ripples.append(metrics["torque_ripple"])
    return ripples, faults


def run_ablation() -> list[dict[str, Any]]:
    """Prints one line per machine and mode as it is measured; returns the results."""
    results = []
    print("torque ripple of the paper's controller by network mode, 40 kHz, 150 r/min, 8 N m; minimum to "
          f"maximum over {len(SEEDS)} seeds")
    for machine in sorted(path.stem for path in MACHINES.glob("*.toml")):
        for mode in MODES:
            ripples, faults = ripple(machine, mode)
            results.append({"machine": machine, "mode": mode, "ripple": [round(value, 4) for value in ripples],
                            "faults": faults})
            parts = [f"{min(ripples):.4f}"] if ripples else []
            parts += [f"to {max(ripples):.4f}"] if len(ripples) > 1 else []
            parts += [f"ended in a fault: {fault}" for fault in faults]
            print(f"  {machine:<18}{mode:<10}{' '.join(parts)}", flush=True)
    return results
