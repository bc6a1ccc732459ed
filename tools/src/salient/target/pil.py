"""salient pil: what the processor does for a scenario. Processor in the loop: the firmware on an emulated processor,
the emulator's machine as its world, every instruction counted.

It leaves what `run` leaves, and processor.json and report.html beside results.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salient.errors import UsageError
from salient.experiments.scenario import RunResult, check_parameters, load_scenarios, write_summaries
from salient.target.control_period import CYCLES_PER_INSTRUCTION, PROCESSOR_HZ, estimable, fits
from salient.target.isr_profile import Cost, measure_run
from salient.target.pil_report import write_pil_report


def run(options: argparse.Namespace) -> int:
    """Does what the options ask for; returns 0, or 1 when a drive ended in a fault."""
    asked = [name for name in ("scenario", "search", "figures") if getattr(options, name)]
    if len(asked) != 1:
        raise UsageError("pil: requires one of SCENARIO.toml, --search SECONDS and --figures")
    if options.figures:
        from salient.target.baseline import measure_and_write

        return measure_and_write()
    if options.search:
        from salient.target.worst_case import search_and_write

        return search_and_write(options.search, options.seed)
    return _run_scenario(options.scenario, options.out or Path("out") / f"pil_{options.scenario.stem}", options.target)


def as_json(cost: Cost, target: str) -> dict[str, Any]:
    """The figures of processor.json for one controller."""
    figures = cost.figures()
    stack = cost.execution.stack
    low, high = CYCLES_PER_INSTRUCTION
    estimate = {
        "estimated_cycles_of_worst": [round(low * figures["worst"]), round(high * figures["worst"])],
        "fits_at_rate_hz": {str(rate): verdict for rate, verdict in fits(figures["worst"]).items()},
    }
    return {
        "interrupts": len(cost.interrupts),
        "instructions": figures,
        "worst_interrupt": int(cost.interrupts.argmax()),
        "mean_by_part": {name: round(mean, 1) for name, mean in cost.mean_by_part().items()},
        "worst_by_part": dict(cost.execution.worst_by_part().most_common()),
        **(estimate if estimable(target) else {}),
        "stack_bytes": {"background": stack.thread, "interrupt": stack.interrupt, "deepest": stack.deepest,
                        "reserved": stack.reserved},
        "coverage": cost.execution.coverage().as_json(),
    }


def words(costs: Mapping[str, Cost], target: str) -> str:
    """The figures of every controller for a terminal."""
    lines = []
    for controller, cost in costs.items():
        made, stack, covered = cost.figures(), cost.execution.stack, cost.execution.coverage().totals()
        total = covered["instructions"]
        parts = ", ".join(f"{name} {mean:.0f}" for name, mean in cost.mean_by_part().items() if mean >= 0.5)
        worst = ", ".join(f"{name} {count}" for name, count in cost.execution.worst_by_part().most_common() if count)
        rates = ", ".join(f"{rate // 1000} kHz {verdict}" for rate, verdict in fits(made["worst"]).items())
        low, high = CYCLES_PER_INSTRUCTION
        lines += [
            f"{controller}: instructions a control interrupt: typical {made['typical']}, 99 in 100 up to"
            f" {made['of_99_percent']}, worst {made['worst']}",
            f"  the mean: {parts}",
            f"  the worst: {worst}",
            *([f"  worst in cycles, an estimate: {low * made['worst']:.0f} to {high * made['worst']:.0f}; fits at"
               f" {PROCESSOR_HZ // 1_000_000} MHz: {rates}"] if estimable(target) else []),
            f"  stack: background {stack.thread} bytes, interrupt {stack.interrupt}, together {stack.deepest}"
            f" of {stack.reserved} reserved",
            f"  object code: of {total} instructions {100 * covered['executed'] / total:.0f} % executed,"
            f" {100 * covered['in_interrupts'] / total:.0f} % in interrupts",
        ]
    return "\n".join(lines)


def _run_scenario(path: Path, out: Path, target: str) -> int:
    scenarios = load_scenarios(path)
    check_parameters(scenarios, target)
    results: dict[str, RunResult] = {}
    costs: dict[str, Cost] = {}
    for scenario in scenarios:
        print(f"{scenario.name}: {scenario.controller} on {target}, {scenario.duration_s:g} s of virtual time",
              flush=True)
        results[scenario.controller], costs[scenario.controller] = measure_run(
            scenario, out / scenario.controller, target)
    write_summaries(scenarios, results, out)
    content = {"schema": 1, "target": target, "control_rate_hz": scenarios[0].control_rate_hz,
               "controllers": {controller: as_json(cost, target) for controller, cost in costs.items()}}
    (out / "processor.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    write_pil_report(out, scenarios[0], content, {name: cost.interrupts for name, cost in costs.items()})
    print(f"{words(costs, target)}\n\nresults: {out / 'results.json'}, {out / 'processor.json'}\n"
          f"report:  {out / 'report.html'}")
    faults = [f"{controller}: {result.fault}" for controller, result in results.items() if result.fault != "none"]
    if faults:
        print(f"the drive ended in a fault: {', '.join(faults)}")
    return 1 if faults else 0
