"""salient sweep: a scenario over parameters, machines, controllers, loads and seeds; one table and plots.

OUT/sweep.csv has a row for each combination, in the order of the options, the last one fastest; OUT/sweep.png the
metrics over the first setting of several values; OUT/runs*.jsonl the results of the runs, from which an interrupted
sweep and its other shards continue (tasks.py).
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import itertools
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from can import CanError

from salient.bench.drive import DriveError
from salient.bench.load_profile import load_profile_path, read_load_profile
from salient.bench.programs import EmulatorError, executable
from salient.bench.rig import variable_range
from salient.bench.session import SessionError
from salient.bench.settings import parse_values
from salient.errors import UsageError
from salient.experiments import metrics as run_metrics
from salient.experiments import tasks
from salient.experiments.metrics import MetricsError, load_step_metrics, losses, start_metrics
from salient.experiments.results import rounded
from salient.experiments.scaled import scale_of_name, scaled
from salient.experiments.scenario import (
    RunResult,
    Scenario,
    check_parameters,
    load_scenarios,
    run_scenario,
    with_setting,
)
from salient.machine.cache import machine_image
from salient.machine.file import load_machine, machine_path
from salient.machine.path import stated_conditions
from salient.paths import scenario_path
from salient.progress import Progress, steps_of

TABLE, PLOT = "sweep.csv", "sweep.png"
METRICS = ("settling_time_s", "overshoot_percent", "max_speed_rpm", "final_speed_rpm", "speed_dip_rpm",
           "recovery_time_s", "highest_torque_Nm", "lowest_torque_Nm", "mean_torque_Nm", "torque_ripple",
           "phase_current_rms_A", "efficiency_percent")
"""Columns of every table, none of which is the name of a setting; empty where a run has no such metric."""
_FLAGS = {"machine": "--machine", "controller": "--controller", "load_Nm": "--load-Nm",
          "load_profile": "--load-profile"}
_STEADY_S = 0.1
"""At the end of a run: window of the mean torque, its ripple and the losses."""


@dataclass(frozen=True)
class Run:
    """A combination: its columns and what runs. program: the digest of the executable that everybody must have."""

    columns: dict[str, Any]
    scenario: Scenario
    program: str


def run(options: argparse.Namespace, stream: TextIO = sys.stdout) -> int:
    """Runs a sweep; exit code 1 when a run has failed."""
    combinations = runs_of(options)
    listed = [tasks.Task(_key(of), of) for of in combinations]
    afresh = not options.resume and options.shard == (1, 1)
    results: dict[str, Any] = {}
    mine = len(listed[options.shard[0] - 1::options.shard[1]])
    with Progress(steps_of(mine, sys.stderr), sys.stderr, mine) as progress:
        finished = tasks.run(listed, run_one, options.out, options.shard, options.scheduler, options.jobs, afresh)
        for task, result in finished:
            results[task.key] = result
            progress.item(", ".join(f"{name} {value}" for name, value in task.arguments.columns.items()))
    results |= tasks.read_results(options.out)
    rows = [{**task.arguments.columns, **results[task.key]} for task in listed if task.key in results]
    write_table(options.out / TABLE, combinations, rows)
    if len(rows) < len(listed):
        stream.write(f"{len(rows)} of {len(listed)} runs are in {options.out}; the others belong to other shards\n")
    else:
        plot(options.out / PLOT, combinations, rows)
        stream.write(f"plot:  {options.out / PLOT}\n")
    failed = [row for row in rows if row["error"]]
    stream.write(f"table: {options.out / TABLE} ({len(rows)} runs, {len(failed)} failed)\n")
    if failed:
        where = ", ".join(f"{name} {failed[0][name]}" for name in combinations[0].columns)
        print(f"salient: {len(failed)} of {len(rows)} runs failed, the first with {where}: {failed[0]['error']}",
              file=sys.stderr)
    return 1 if failed else 0


def runs_of(options: argparse.Namespace) -> list[Run]:
    """The combinations in order. UsageError for whatever no run could use."""
    base = load_scenarios(scenario_path(options.scenario))
    axes: dict[str, Sequence[Any]] = {
        "machine": options.machine or [base[0].machine],
        "controller": options.controller or [scenario.controller for scenario in base],
    }
    for text in options.set:
        name, numbers = parse_values(text)
        if name in axes:
            raise UsageError(f"--set {text}: {name} is set twice")
        axes[name] = numbers
    if options.load_Nm:
        if not base[0].load:
            raise UsageError(f"--load-Nm: {options.scenario} has no [[load]] to change")
        low_Nm, high_Nm = variable_range("load_torque_Nm")
        for load_Nm in options.load_Nm:
            if not low_Nm <= load_Nm <= high_Nm:
                raise UsageError(f"--load-Nm {load_Nm:g}: must be a number from {low_Nm:g} to {high_Nm:g}")
        axes["load_Nm"] = options.load_Nm
    if options.load_profile:
        for profile in options.load_profile:
            read_load_profile(load_profile_path(profile))
        axes["load_profile"] = options.load_profile
    first_seed = base[0].seed if options.seed is None else options.seed
    axes["seed"] = [first_seed + n for n in range(options.seeds)]
    for name, of_axis in axes.items():
        _check_different(name, of_axis)
    shown = _machine_names(axes["machine"])
    program = tasks.file_digest(executable())
    found = []
    for combination in itertools.product(*axes.values()):
        columns = dict(zip(axes, combination, strict=True))
        found.append(Run({**columns, "machine": shown[columns["machine"]]}, _scenario(base[0], columns), program))
    checked = {repr(replace(of.scenario, seed=base[0].seed)): replace(of.scenario, seed=base[0].seed) for of in found}
    try:
        check_parameters(list(checked.values()), "host")
    except UsageError:
        check_parameters(base[:1], "host", scenario_path(options.scenario))  # a mistake of the file, or of an option
        raise
    return found


def _check_different(name: str, values: Sequence[Any]) -> None:
    """UsageError: an option has a value twice, whose rows nothing would tell apart."""
    path = {"machine": machine_path, "load_profile": load_profile_path}.get(name, lambda value: value)
    seen: set[Any] = set()
    for value in values:
        meant = path(value)
        meant = meant.resolve() if isinstance(meant, Path) else meant
        if meant in seen:
            raise UsageError(f"{_FLAGS.get(name, name)} {value}: given twice; must be different values")
        seen.add(meant)


def _machine_names(machines: Sequence[str]) -> dict[str, str]:
    """The column of each machine: the name of its file without a suffix; as stated where several have that name."""
    stems = [Path(machine).stem for machine in machines]
    return {machine: stem if stems.count(stem) == 1 else machine for machine, stem in zip(machines, stems, strict=True)}


def _scenario(base: Scenario, columns: Mapping[str, Any]) -> Scenario:
    """The scenario of a combination. On another machine than its own, speeds and loads are in terms of that one."""
    scenario = base
    if columns["machine"] != base.machine:
        machine = columns["machine"]
        machine_image(machine)  # checks the file
        scenario = replace(scenario, machine=machine, **stated_conditions(machine_path(machine)))
        if scenario.speed:
            scenario = scaled(scenario, scale_of_name(machine))
    scenario = replace(scenario, controller=columns["controller"], seed=columns["seed"])
    for name, value in columns.items():
        if name == "load_Nm":
            scenario = replace(scenario, load=tuple(replace(load, torque_Nm=value) for load in scenario.load))
        elif name == "load_profile":
            scenario = replace(scenario, load_profile=value)
        elif name not in ("machine", "controller", "seed"):
            scenario = with_setting(scenario, name, value)
    return scenario


def _key(of: Run) -> str:
    """Identifies the executable, the machine's image, the code of the metrics, and the scenario."""
    profile = of.scenario.load_profile
    files = [machine_image(of.scenario.machine, of.scenario.true_machine), Path(__file__),
             Path(str(run_metrics.__file__)),
             *([load_profile_path(profile)] if profile else [])]
    scenario = replace(of.scenario, machine=Path(of.scenario.machine).stem,
                       true_machine=of.scenario.true_machine and Path(of.scenario.true_machine).stem)
    return hashlib.sha256(" ".join([of.program, *map(tasks.file_digest, files), repr(scenario)]).encode()).hexdigest()


def run_one(of: Run) -> dict[str, Any]:
    """The metrics of a combination, and why there are none or fault; executed by a worker."""
    tasks.check_build(tasks.file_digest(executable()), of.program)
    row: dict[str, Any] = dict.fromkeys(METRICS)
    error = ""
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        try:
            result = run_scenario(of.scenario, Path(folder))
            row |= _metrics(result)
            if result.fault != "none":
                error = f"fault {result.fault}"
        except (EmulatorError, SessionError, DriveError, CanError, MetricsError) as failure:
            error = str(failure)
    return {**{name: rounded(row[name]) for name in METRICS}, "error": error}


def _metrics(result: RunResult) -> dict[str, Any]:
    scenario, recording = result.scenario, result.recording
    if recording is None:
        speed_rpm, torque_Nm = result.truth["speed_rpm"].value, result.truth["torque_Nm"].value
        return {"max_speed_rpm": float(speed_rpm.max()), "final_speed_rpm": float(speed_rpm[-1]),
                "highest_torque_Nm": float(torque_Nm.max()), "lowest_torque_Nm": float(torque_Nm.min())}
    last_s = float(recording["time_s"][-1])
    window = recording[recording["time_s"] >= last_s - _STEADY_S]
    torque_Nm = window["torque_Nm"]
    low_Nm, high_Nm, mean_Nm = float(torque_Nm.min()), float(torque_Nm.max()), float(torque_Nm.mean(dtype=float))
    row: dict[str, Any] = {"max_speed_rpm": float(recording["speed_rpm"].max()),
                           "final_speed_rpm": float(recording["speed_rpm"][-1]), "highest_torque_Nm": high_Nm,
                           "lowest_torque_Nm": low_Nm, "mean_torque_Nm": mean_Nm}
    if mean_Nm > 0.0 and scenario.record is not None and scenario.record.step_us <= 1.0:  # else it would be hidden
        row["torque_ripple"] = (high_Nm - low_Nm) / mean_Nm
    energy = losses(recording, load_machine(machine_path(scenario.plant)), (float(window["time_s"][0]), last_s))
    row |= {name: energy[name] for name in ("phase_current_rms_A", "efficiency_percent")}
    if scenario.speed and not scenario.torque:
        first, last = scenario.speed[0], scenario.speed[-1]
        before = recording if not scenario.load else recording[recording["time_s"] < scenario.load[0].at_s]
        if len(scenario.speed) == 1 and len(before) > 1 and before["time_s"][0] <= first.at_s + 1e-6:
            start = start_metrics(before, first.value_rpm, first.at_s)
            row |= {name: start[name] for name in ("settling_time_s", "overshoot_percent")}
        if len(scenario.load) == 1 and scenario.load[0].at_s < last_s:
            step = load_step_metrics(recording, last.value_rpm, scenario.load[0].at_s,
                                     (float(window["time_s"][0]), last_s)) if "torque_ripple" in row else {}
            row |= {name: step[name] for name in ("speed_dip_rpm", "recovery_time_s") if name in step}
    return row


def write_table(path: Path, combinations: Sequence[Run], rows: Sequence[Mapping[str, Any]]) -> None:
    """One row for each finished run, in the order of the combinations."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [*combinations[0].columns, *METRICS, "error"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def plot(path: Path, combinations: Sequence[Run], rows: Sequence[Mapping[str, Any]]) -> None:
    """Every metric over the first setting of several values, a line for each of the other combinations."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = list(combinations[0].columns)
    swept = [name for name in columns if len({row[name] for row in rows}) > 1]
    x = next((name for name in swept if all(isinstance(row[name], int | float) for row in rows)), "seed")
    shown = [name for name in METRICS if any(row[name] is not None for row in rows)]
    others = [name for name in swept if name != x]
    if not shown:
        return
    figure = Figure(figsize=(12, 2.6 * -(-len(shown) // 3)), layout="constrained")
    FigureCanvasAgg(figure)
    axes_of = figure.subplots(-(-len(shown) // 3), 3, squeeze=False).flat
    lines: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        lines.setdefault(", ".join(str(row[name]) for name in others), []).append(row)
    for name, axes in itertools.zip_longest(shown, axes_of):
        if name is None:
            axes.set_axis_off()
            continue
        for label, of in lines.items():
            points = sorted((row[x], row[name]) for row in of if row[name] is not None)
            axes.plot([point[0] for point in points], [point[1] for point in points], marker=".", label=label)
        axes.set_title(name, fontsize="small")
        axes.set_xlabel(x, fontsize="small")
        axes.grid(alpha=0.3)
    if len(lines) > 1:
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=4,
                      fontsize="small")
    figure.savefig(path, dpi=90)
