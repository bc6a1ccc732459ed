"""salient pil, processor in the loop: a scenario with the firmware on an emulated processor, every instruction counted.

Writes the files of `run`, and processor.json and report.html next to results.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salient.errors import UsageError
from salient.experiments.scenario import (
    RunResult,
    check_parameters,
    load_scenarios,
    with_true_machine,
    write_summaries,
)
from salient.json_file import json_text
from salient.paths import OUT, make_folder, scenario_path
from salient.target.control_period import CYCLES_PER_INSTRUCTION, PROCESSOR_HZ, estimable, fits
from salient.target.isr_profile import IsrProfile, measure_run
from salient.target.pil_report import write_pil_report


def run(options: argparse.Namespace) -> int:
    """Runs the scenario, computes the bound or measures the baseline, of which the command line has exactly one.
    Returns 0, or 1 when a drive ended in a fault."""
    if options.true_machine is not None and options.scenario is None:
        raise UsageError(f"--true-machine {options.true_machine}: only with a scenario")
    if options.figures:
        from salient.target.baseline import measure_and_write

        return measure_and_write()
    if options.bound:
        from salient.target import baseline, bound_report

        known = baseline.read()["interrupt"] if estimable(options.target) else {}
        return bound_report.run(options.bound, options.target, {name: of["longest_run"] for name, of in known.items()})
    return _run_scenario(options.scenario, options.out or OUT / f"pil_{options.scenario.stem}", options.target,
                         options.true_machine)


def as_json(profile: IsrProfile, target: str) -> dict[str, Any]:
    """Content of processor.json for one controller."""
    metrics = profile.metrics()
    stack = profile.trace.stack
    low, high = CYCLES_PER_INSTRUCTION
    estimate = {
        "estimated_cycles_of_max": [round(low * metrics["max"]), round(high * metrics["max"])],
        "fits_at_rate_hz": {str(rate): verdict for rate, verdict in fits(metrics["max"]).items()},
    }
    return {
        "interrupts": len(profile.interrupts),
        "instructions": metrics,
        "deferred_instructions": profile.deferred_metrics(),
        "instructions_of_both": profile.sum_metrics(),
        "longest_interrupt": int(profile.interrupts.argmax()),
        "mean_by_module": {name: round(mean, 1) for name, mean in profile.mean_by_module().items()},
        "max_by_module": dict(profile.trace.longest_by_module().most_common()),
        **(estimate if estimable(target) else {}),
        "stack_bytes": {"background": stack.thread, "interrupt": stack.interrupt, "deepest": stack.deepest,
                        "reserved": stack.reserved},
        "coverage": profile.trace.coverage().as_json(),
    }


def summary(profiles: Mapping[str, IsrProfile], target: str) -> str:
    """The metrics of every controller for a terminal."""
    lines = []
    for controller, profile in profiles.items():
        metrics, stack, covered = profile.metrics(), profile.trace.stack, profile.trace.coverage().totals()
        total = covered["instructions"]
        means = ", ".join(f"{name} {mean:.0f}" for name, mean in profile.mean_by_module().items() if mean >= 0.5)
        longest = ", ".join(f"{name} {count}" for name, count in profile.trace.longest_by_module().most_common()
                            if count)
        rates = ", ".join(f"{rate // 1000} kHz {verdict}" for rate, verdict in fits(metrics["max"]).items())
        low, high = CYCLES_PER_INSTRUCTION
        lines += [
            f"{controller}: instructions per control interrupt: median {metrics['median']}, p99 {metrics['p99']},"
            f" max {metrics['max']}",
            *(f"  {what}: median {of['median']}, p99 {of['p99']}, max {of['max']}"
              for what, of in (("deferred interrupt", profile.deferred_metrics()),
                               ("both interrupts of a period", profile.sum_metrics()))),
            f"  mean by module: {means}",
            f"  longest by module: {longest}",
            *([f"  longest in cycles, estimate: {low * metrics['max']:.0f} to {high * metrics['max']:.0f}; fits at"
               f" {PROCESSOR_HZ // 1_000_000} MHz: {rates}"] if estimable(target) else []),
            f"  stack: background {stack.thread} bytes, interrupt {stack.interrupt}, total {stack.deepest}"
            f" of {stack.reserved} reserved",
            f"  machine code: of {total} instructions {100 * covered['executed'] / total:.0f} % executed,"
            f" {100 * covered['in_interrupts'] / total:.0f} % in interrupts",
        ]
    return "\n".join(lines)


def _run_scenario(path: Path, out: Path, target: str, true_machine: str | None) -> int:
    scenarios = with_true_machine(load_scenarios(scenario_path(path)), true_machine)
    check_parameters(scenarios, target, scenario_path(path))
    make_folder(out)
    results: dict[str, RunResult] = {}
    profiles: dict[str, IsrProfile] = {}
    for scenario in scenarios:
        print(f"{scenario.name}: {scenario.controller} on {target}, {scenario.duration_s:g} s of virtual time",
              flush=True)
        results[scenario.controller], profiles[scenario.controller] = measure_run(
            scenario, out / scenario.controller, target)
    write_summaries(scenarios, results, out)
    content = {"schema": 1, "target": target, "control_rate_hz": scenarios[0].control_rate_hz,
               "controllers": {controller: as_json(profile, target) for controller, profile in profiles.items()}}
    (out / "processor.json").write_text(json_text(content), encoding="utf-8")
    write_pil_report(out, scenarios[0], content, {name: profile.interrupts for name, profile in profiles.items()})
    print(f"{summary(profiles, target)}\n\nresults: {out / 'results.json'}, {out / 'processor.json'}\n"
          f"report:  {out / 'report.html'}")
    faults = [f"{controller}: {result.fault}" for controller, result in results.items() if result.fault != "none"]
    if faults:
        print(f"the drive ended in a fault: {', '.join(faults)}")
    return 1 if faults else 0
