"""salient demo: the paper's two experiments, each by every controller, over CAN.

The scenario files of the experiments name the controllers. Output folder: results.json, report.html, figures/*.png, and
in runs/<experiment>_<controller>/ the CAN log as BLF and as candump text and the recording of the true state:
recording.npy has one row per 10 us; ripple_window.npy, where the recording was finer, every row of the window of the
ripple. Metrics and plots use every row; `tools/salient run` keeps them all.
"""

from __future__ import annotations

import argparse
import errno
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from can import CanError

from salient.bench.drive import DriveError
from salient.bench.programs import EmulatorError, command_line
from salient.bench.session import SessionError
from salient.config import BenchConfig
from salient.errors import cannot_write
from salient.experiments import metrics, plots
from salient.experiments.report import (
    EXPERIMENT_TITLE,
    METRIC_ROWS,
    SHORT_TITLE,
    captions,
    format_metric,
    format_published,
    published_of,
    write_report,
)
from salient.experiments.results import make_results, write_results
from salient.experiments.scaled import scale_of, scale_of_name, scaled, steady_window_s
from salient.experiments.scenario import Scenario, check_parameters, load_scenarios, run_scenario
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.path import stated_conditions
from salient.pages import Plot
from salient.paths import COMMAND, SCENARIOS, make_folder
from salient.progress import Progress
from salient.version import VERSION
from salient.workers import process_pool

Metrics = dict[str, float | None]

EXPERIMENTS = ("start_600", "load_step_150")

# Name of the plot's file -> title, with keys of the operating point in the results' conditions, and experiment.
PLOTS = {
    "figure_5": ("Figure 5: start to {start_rpm:g} r/min without load", "start_600"),
    "figure_6": ("Figure 6: speed at {step_rpm:g} r/min with a load step of {load_Nm:g} N m", "load_step_150"),
    "figure_7": ("Figure 7: torque at {step_rpm:g} r/min with a load step of {load_Nm:g} N m", "load_step_150"),
    "phase_currents": ("Phase currents over two strokes", "load_step_150"),
}

KEPT_STEP_US = 10.0
"""Step of the rows that are kept in recording.npy; one row per microsecond of all runs would be some 100 MB."""
RIPPLE_WINDOW_FILE = "ripple_window.npy"

_WORKERS = 2
_CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)


class DemoFailed(Exception):
    """A run without valid metrics; one line that names the run. Exit code 1."""


@dataclass(frozen=True)
class _Run:
    """Result of a run, as its worker process returns it."""

    name: str
    """For a reader: speed, load and controller."""
    experiment: str
    scenario: Scenario
    window_s: tuple[float, float]
    """Window of the ripple and the losses."""
    metrics: Metrics
    losses: dict[str, Any]
    log_paths: tuple[Path, Path]
    recording_path: Path
    """Has every row until _thin."""

    @property
    def controller(self) -> str:
        return self.scenario.controller


def run(options: argparse.Namespace, can: str = "local", stream: TextIO = sys.stdout) -> int:
    """Runs both experiments; prints progress and results on `stream`. Returns 0.

    options: out, build, and machine, control_rate_hz, encoder_bits and seed, each None for the value of the scenario
    files.
    can: "local" for a separate bus per run, or "socketcan:INTERFACE", on which the runs are sequential.
    Raises UsageError, if possible before anything is written, and DemoFailed.
    """
    scenarios = _scenarios(options)
    out: Path = options.out
    make_folder(out, ("results.json", "report.html"))
    make_folder(out / "figures")
    try:
        results = _run_and_report(scenarios, out, can, options.build, stream)
    except OSError as error:
        if error.errno in _CANNOT_WRITE:
            raise cannot_write(f"--out {out}", error) from error
        raise
    stream.write(f"{summary(results)}\n\nresults: {out / 'results.json'}\nreport:  {out / 'report.html'}\n")
    return 0


def _run_and_report(scenarios: Mapping[str, Sequence[Scenario]], out: Path, can: str, build: str,
                    stream: TextIO) -> dict[str, Any]:
    with (process_pool(_WORKERS if can == "local" else 1) as workers,
          Progress(sum(map(len, scenarios.values())) + len(PLOTS) + 1, stream) as progress):
        runs = _run_all(workers, scenarios, out, can, build, progress)
        results = make_results(_by_experiment(runs, "metrics"), _by_experiment(runs, "losses"),
                               _conditions(scenarios))
        page_plots = _plot_all(workers, runs, results, out, progress)
        recordings = [_thin(result) for result in runs]
        write_results(out / "results.json", results)
        write_report(out / "report.html", results, page_plots, _commands(scenarios, build),
                     _files(runs, recordings, out))
        progress.step("report.html")
    return results


def summary(results: Mapping[str, Any]) -> str:
    """The metrics of both experiments and the published values, as a table for a terminal."""
    lines = []
    for experiment, by_controller in results["experiments"].items():
        published = published_of(results, experiment)
        heads = (f"{controller:>16}" + f"{'published':>14}" * (controller in published) for controller in by_controller)
        title = EXPERIMENT_TITLE[experiment].format_map(results["conditions"]["operating_point"])
        lines += ["", f"{title} ({experiment})", " " * 30 + "".join(heads)]
        for name in next(iter(by_controller.values())):
            cells = (f"{format_metric(name, of[name]):>16}"
                     + (f"{format_published(name, published[controller][name]):>14}" if controller in published else "")
                     for controller, of in by_controller.items())
            lines.append(f"  {METRIC_ROWS[name][0]:<28}{''.join(cells)}")
    return "\n".join(lines[1:])


# --- runs -----------------------------------------------------------------------------------------------------------

def _scenarios(options: argparse.Namespace) -> dict[str, list[Scenario]]:
    """Experiment -> one scenario per controller, with the options applied, in terms of the machine."""
    changes = {name: value for name in ("machine", "true_machine", "control_rate_hz", "encoder_bits", "seed")
               if (value := getattr(options, name)) is not None}
    scenarios = {experiment: [replace(scenario, **changes)
                              for scenario in load_scenarios(SCENARIOS / f"{experiment}.toml")]
                 for experiment in EXPERIMENTS}
    machine = scenarios["start_600"][0].machine
    command_line(BenchConfig(machine=machine, true_machine=options.true_machine, build=options.build))  # checks them
    path = machine_path(machine)
    scale, conditions = scale_of(load_machine(path)), stated_conditions(path) | changes
    scenarios = {experiment: [scaled(replace(scenario, **conditions), scale) for scenario in of]
                 for experiment, of in scenarios.items()}
    for of in scenarios.values():
        check_parameters(of, options.build)
    return scenarios


def _run_all(workers: Executor, scenarios: Mapping[str, Sequence[Scenario]], out: Path, can: str,
             build: str, progress: Progress) -> list[_Run]:
    futures = {}
    point = _conditions(scenarios)["operating_point"]
    for experiment, of in scenarios.items():
        for scenario in of:
            folder = out / "runs" / f"{experiment}_{scenario.controller}"
            name = f"{SHORT_TITLE[experiment].format_map(point)}, by {scenario.controller}"
            futures[name] = workers.submit(_run_one, name, experiment, scenario, folder, can, build)
    return _gather(futures, progress)


def _run_one(name: str, experiment: str, scenario: Scenario, folder: Path, can: str, build: str) -> _Run:
    try:
        result = run_scenario(scenario, folder, can, build)
    except (EmulatorError, SessionError, DriveError, CanError) as error:
        raise DemoFailed(f"{name}: {error}") from error
    if result.fault != "none":
        raise DemoFailed(f"{name}: the drive ended in fault {result.fault}; see {result.text_log_path}")
    assert result.recording is not None and result.recording_path is not None  # the experiments record
    machine = load_machine(machine_path(scenario.plant))
    window_s = steady_window_s(scenario, scale_of_name(scenario.machine))
    try:
        values = _metrics(experiment, scenario, result.recording, window_s)
        losses = metrics.losses(result.recording, machine, window_s)
    except metrics.MetricsError as error:
        raise DemoFailed(f"{name}: {error}; see {result.text_log_path}") from error
    return _Run(name, experiment, scenario, window_s, values, losses,
                (result.log_path, result.text_log_path), result.recording_path)


def _metrics(experiment: str, scenario: Scenario, recording: np.ndarray, window_s: tuple[float, float]) -> Metrics:
    reference = scenario.speed[0]
    if experiment == "start_600":
        return metrics.start_metrics(recording, reference.value_rpm, reference.at_s)
    return metrics.load_step_metrics(recording, reference.value_rpm, scenario.load[0].at_s, window_s)


def _gather(futures: Mapping[str, Future[Any]], progress: Progress) -> list[Any]:
    """The results in the order of `futures`, with a step of progress as each is done; the first failure cancels all."""
    names = {future: name for name, future in futures.items()}
    try:
        for future in as_completed(names):
            future.result()
            progress.step(names[future])
    except BaseException:
        for future in names:
            future.cancel()
        raise
    return [future.result() for future in names]


# --- results -------------------------------------------------------------------------------------------

def _by_experiment(runs: Iterable[_Run], attribute: str) -> dict[str, dict[str, dict[str, Any]]]:
    """An attribute of the runs by experiment and controller."""
    experiments: dict[str, dict[str, dict[str, Any]]] = {}
    for result in runs:
        experiments.setdefault(result.experiment, {})[result.controller] = getattr(result, attribute)
    return experiments


def _conditions(scenarios: Mapping[str, Sequence[Scenario]]) -> dict[str, Any]:
    """Conditions of the metrics; equal for all runs except the step of the recording, which is the ripple's."""
    scenario, start = scenarios["load_step_150"][0], scenarios["start_600"][0]
    assert scenario.record is not None  # as in its file
    data = derive(load_machine(machine_path(scenario.machine)))
    return {
        "operating_point": {"start_rpm": start.speed[0].value_rpm, "step_rpm": scenario.speed[0].value_rpm,
                            "load_Nm": scenario.load[0].torque_Nm, "step_at_s": scenario.load[0].at_s,
                            "window_s": list(steady_window_s(scenario, scale_of_name(scenario.machine)))},
        "control_rate_hz": scenario.control_rate_hz,
        "adc": {"bits": scenario.adc_bits, "current_range_A": [0.0, data.adc_current_A]},
        "encoder": {"bits": scenario.encoder_bits or "ideal", "edges": scenario.encoder_edges},
        "immediate_pwm": scenario.immediate_pwm,
        "machine": Path(scenario.machine).stem,
        **({} if scenario.true_machine is None else {"true_machine": Path(scenario.true_machine).stem}),
        "torque_sample_step_s": scenario.record.step_us * 1e-6,
        "initial_angle_deg": scenario.initial_angle_deg,
        "seed": scenario.seed,
        "versions": {"salient": VERSION} | {name: version(name) for name in ("python-can", "cantools", "numpy")},
    }


def _plot_all(workers: Executor, runs: Sequence[_Run], results: Mapping[str, Any], out: Path,
              progress: Progress) -> list[Plot]:
    paths = {name: out / "figures" / f"{name}.png" for name in PLOTS}
    _gather({path.name: workers.submit(_plot, name, path,
                                       [run for run in runs if run.experiment == PLOTS[name][1]], results)
             for name, path in paths.items()}, progress)
    caption_of = captions(results)
    point = results["conditions"]["operating_point"]
    return [Plot(PLOTS[name][0].format_map(point), caption_of[name], path.read_bytes())
            for name, path in paths.items()]


def _plot(name: str, path: Path, runs: Sequence[_Run], results: Mapping[str, Any]) -> None:
    experiment, scenario = runs[0].experiment, runs[0].scenario
    recordings = {result.controller: np.load(result.recording_path, mmap_mode="r") for result in runs}
    ours, paper = results["experiments"][experiment], published_of(results, experiment)
    reference = scenario.speed[0]
    if name == "figure_5":
        plots.plot_start(path, recordings, ours, paper, reference.value_rpm, reference.at_s)
    elif name == "figure_6":
        plots.plot_load_step_speed(path, recordings, ours, paper, scenario.load[0], reference.value_rpm)
    elif name == "figure_7":
        plots.plot_load_step_torque(path, recordings, ours, paper, scenario.load[0], runs[0].window_s)
    else:
        machine = load_machine(machine_path(scenario.machine))
        plots.plot_phase_currents(path, recordings, runs[0].window_s[0], 2.0 * metrics.stroke_deg(machine))


def _commands(scenarios: Mapping[str, Sequence[Scenario]], build: str) -> list[str]:
    target = "" if build == "host" else f" --target {build}"
    one = scenarios["start_600"][0]
    true = "" if one.true_machine is None else f" --true-machine {shlex.quote(one.true_machine)}"
    return [
        "# everything on this page",
        f"{COMMAND} demo --machine {shlex.quote(one.machine)}{true} --control-rate-hz {one.control_rate_hz}"
        f" --encoder-bits {one.encoder_bits} --seed {one.seed}{target}",
        "# one experiment, with every row of its recordings",
        *(f"{COMMAND} run {experiment}{target}" for experiment in scenarios),
    ]


def _files(runs: Iterable[_Run], recordings: Iterable[list[tuple[str, Path]]],
           out: Path) -> list[tuple[str, list[tuple[str, str]]]]:
    """The files of each run, in the form of write_report. recordings: of each run, from _thin."""
    logs = ("CAN log (BLF)", "CAN log (candump text)")
    return [("The results of this page, for scripts", [("results.json", "results.json")])] + [
        (f"{result.name}, on virtual time",
         [(title, path.relative_to(out).as_posix())
          for title, path in (*zip(logs, result.log_paths, strict=True), *kept)])
        for result, kept in zip(runs, recordings, strict=True)]


def _thin(result: _Run) -> list[tuple[str, Path]]:
    """Keeps one row per KEPT_STEP_US of a run's recording and, where the recording is finer, all rows of the ripple's
    window in a separate file. Returns (description, path) of the files."""
    assert result.scenario.record is not None  # both scenario files have the table
    step_us = result.scenario.record.step_us
    every = max(1, round(KEPT_STEP_US / step_us))
    kept = [(f"true state every {every * step_us:g} µs (numpy.load)", result.recording_path)]
    if every > 1:
        rows = np.load(result.recording_path)
        half_step_s = 0.5e-6 * step_us
        first, end = np.searchsorted(rows["time_s"], (result.window_s[0] - half_step_s,
                                                      result.window_s[1] + half_step_s))
        window_path = result.recording_path.with_name(RIPPLE_WINDOW_FILE)
        np.save(window_path, rows[first:end])
        np.save(result.recording_path, rows[::every])
        kept.append((f"every {step_us:g} µs from {result.window_s[0]:g} to {result.window_s[1]:g} s",
                     window_path))
    return kept
