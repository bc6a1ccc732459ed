"""salient demo: the paper's two experiments, each by every controller, over CAN.

The controllers are those that the experiments' scenario files name. Left in the folder: results.json, report.html,
figures/*.png, and in runs/<experiment>_<controller>/ the CAN log as BLF and as candump text and the recording of the
true state: recording.npy has a row every 10 us, ripple_window.npy, where rows were recorded closer than that, every row
of the window that the ripple is taken from. Figures and pictures are made from every row; `tools/salient run` leaves
them all.
"""

from __future__ import annotations

import argparse
import errno
import shlex
import signal
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from can import CanError

from salient.bench.drive import DriveError
from salient.bench.emulator import EmulatorError, executable
from salient.bench.session import SessionError
from salient.errors import UsageError
from salient.experiments import metrics
from salient.experiments import plots as figures
from salient.experiments.report import ROWS, Picture, captions, printed_words_for, words_for, write_report
from salient.experiments.results import make_results, write_results
from salient.experiments.scenario import Scenario, load_scenarios, run_scenario
from salient.machine.file import load_machine, machine_path
from salient.paths import SCENARIOS
from salient.progress import Progress

Merits = dict[str, float | None]

EXPERIMENTS = ("start_600", "load_step_150")

# As hal/hal_adc.h has it.
ADC_CURRENT_RANGE_A = [0.0, 80.0]

# name of the picture's file -> title, experiment
PICTURES = {
    "figure_5": ("Figure 5: start to 600 r/min without load", "start_600"),
    "figure_6": ("Figure 6: speed at 150 r/min with a load step of 8 N m", "load_step_150"),
    "figure_7": ("Figure 7: torque at 150 r/min with a load step of 8 N m", "load_step_150"),
    "phase_currents": ("Phase currents over two strokes", "load_step_150"),
}

KEPT_STEP_US = 10.0
"""Rows of recording.npy are so far apart or further; a row a microsecond of all runs would be some 100 MB."""
RIPPLE_WINDOW_FILE = "ripple_window.npy"

_WORKERS = 2
_CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)


class DemoFailed(Exception):
    """A run from which the figures cannot be taken; one line that names the run. Exit code 1."""


@dataclass(frozen=True)
class _Run:
    """A run as it comes back from the process that made it."""

    experiment: str
    scenario: Scenario
    merits: Merits
    losses: dict[str, Any]
    log_paths: tuple[Path, Path]
    recording_path: Path
    """Of every row, until _thin."""

    @property
    def controller(self) -> str:
        return self.scenario.controller


def run(options: argparse.Namespace, can: str = "local", stream: TextIO = sys.stdout) -> int:
    """Runs everything, tells `stream` how far it is and what came out. Returns 0.

    options: out, build, and machine, control_rate_hz, encoder_bits and seed, each None for the value of the scenario
    files.
    can: "local" for a bus of its own for each run, or "socketcan:INTERFACE", on which the runs follow each other.
    Raises UsageError, before anything is written where that can be known, and DemoFailed.
    """
    scenarios = _scenarios(options)
    out: Path = options.out
    _prepare_folder(out)
    try:
        results = _run_and_report(scenarios, out, can, options.build, stream)
    except OSError as error:
        if error.errno in _CANNOT_WRITE:
            raise _cannot_write(out, error) from error
        raise
    stream.write(f"{summary(results)}\n\nresults: {out / 'results.json'}\nreport:  {out / 'report.html'}\n")
    return 0


def _run_and_report(scenarios: Mapping[str, Sequence[Scenario]], out: Path, can: str, build: str,
                    stream: TextIO) -> dict[str, Any]:
    with (ProcessPoolExecutor(_WORKERS if can == "local" else 1, initializer=_leave_interrupts_to_parent) as workers,
          Progress(sum(map(len, scenarios.values())) + len(PICTURES) + 1, stream) as progress):
        runs = _run_all(workers, scenarios, out, can, build, progress)
        results = make_results(_by_experiment(runs, "merits"), _by_experiment(runs, "losses"),
                               _conditions(scenarios))
        pictures = _draw_all(workers, runs, results, out, progress)
        recordings = [_thin(made) for made in runs]
        write_results(out / "results.json", results)
        write_report(out / "report.html", results, pictures, _commands(scenarios, build), _files(runs, recordings, out))
        progress.step("report.html")
    return results


def _leave_interrupts_to_parent() -> None:
    """For a worker: Ctrl-C reaches the whole group, and one process answering it is enough."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def summary(results: Mapping[str, Any]) -> str:
    """The figures of both experiments beside the paper's, as a small table for a terminal."""
    lines = []
    for experiment, merits in results["experiments"].items():
        printed = results["paper"][experiment]
        heads = (f"{controller:>16}" + f"{'printed':>14}" * (controller in printed) for controller in merits)
        lines += ["", f"{experiment:<30}" + "".join(heads)]
        for name in next(iter(merits.values())):
            cells = (f"{words_for(name, of[name]):>16}"
                     + (f"{printed_words_for(name, printed[controller][name]):>14}" if controller in printed else "")
                     for controller, of in merits.items())
            lines.append(f"  {_plain(ROWS[name][0]):<28}{''.join(cells)}")
    return "\n".join(lines[1:])


# --- runs -----------------------------------------------------------------------------------------------------------

def _scenarios(options: argparse.Namespace) -> dict[str, list[Scenario]]:
    """Experiment -> one scenario for each controller, with what the options change."""
    changes = {name: value for name in ("machine", "control_rate_hz", "encoder_bits", "seed")
               if (value := getattr(options, name)) is not None}
    scenarios = {experiment: [replace(scenario, **changes)
                              for scenario in load_scenarios(SCENARIOS / f"{experiment}.toml")]
                 for experiment in EXPERIMENTS}
    executable(scenarios["start_600"][0].machine, options.build)
    return scenarios


def _prepare_folder(out: Path) -> None:
    """Makes the folder, and takes away what would look like this demo's results if it failed half-way."""
    try:
        (out / "figures").mkdir(parents=True, exist_ok=True)
        for name in ("results.json", "report.html"):
            (out / name).unlink(missing_ok=True)
            (out / name).touch()
            (out / name).unlink()
    except OSError as error:
        raise _cannot_write(out, error) from error


def _cannot_write(out: Path, error: OSError) -> UsageError:
    return UsageError(f"--out {out}: cannot write there ({error.strerror}); give a folder that can be written")


def _run_all(workers: Executor, scenarios: Mapping[str, Iterable[Scenario]], out: Path, can: str,
             build: str, progress: Progress) -> list[_Run]:
    started = {}
    for experiment, of in scenarios.items():
        for scenario in of:
            folder = out / "runs" / f"{experiment}_{scenario.controller}"
            started[f"{experiment} by {scenario.controller}"] = workers.submit(_run_one, experiment, scenario, folder,
                                                                               can, build)
    return _gather(started, progress)


def _run_one(experiment: str, scenario: Scenario, folder: Path, can: str, build: str) -> _Run:
    name = f"{experiment} by {scenario.controller}"
    try:
        result = run_scenario(scenario, folder, can, build)
    except (EmulatorError, SessionError, DriveError, CanError) as error:
        raise DemoFailed(f"{name}: {error}") from error
    if result.fault != "none":
        raise DemoFailed(f"{name}: the drive ended in fault {result.fault}; see {result.text_log_path}")
    try:
        merits = _take(experiment, scenario, result.recording)
        losses = metrics.losses(result.recording, load_machine(machine_path(scenario.machine)), metrics.LOSS_WINDOW_S)
    except metrics.MetricsError as error:
        raise DemoFailed(f"{name}: {error}; see {result.text_log_path}") from error
    return _Run(experiment, scenario, merits, losses, (result.log_path, result.text_log_path), result.recording_path)


def _take(experiment: str, scenario: Scenario, recording: np.ndarray) -> Merits:
    reference = scenario.speed[0]
    if experiment == "start_600":
        return metrics.start_metrics(recording, reference.value_rpm, reference.at_s)
    return metrics.load_step_metrics(recording, reference.value_rpm, scenario.load[0].at_s)


def _gather(started: Mapping[str, Future], progress: Progress) -> list[Any]:
    """The results in the order of `started`, with a step of progress as each is done; the first failure ends it."""
    names = {future: name for name, future in started.items()}
    try:
        for future in as_completed(names):
            future.result()
            progress.step(names[future])
    except BaseException:
        for future in names:
            future.cancel()
        raise
    return [future.result() for future in names]


# --- what is made of them -------------------------------------------------------------------------------------------

def _by_experiment(runs: Iterable[_Run], figures: str) -> dict[str, dict[str, dict[str, Any]]]:
    """One of a run's mappings by experiment and controller."""
    experiments: dict[str, dict[str, dict[str, Any]]] = {}
    for made in runs:
        experiments.setdefault(made.experiment, {})[made.controller] = getattr(made, figures)
    return experiments


def _conditions(scenarios: Mapping[str, Sequence[Scenario]]) -> dict[str, Any]:
    """What the figures hold for. The same for all runs, but for the recording's step, which is the ripple's."""
    scenario = scenarios["load_step_150"][0]
    return {
        "control_rate_hz": scenario.control_rate_hz,
        "adc": {"bits": scenario.adc_bits, "current_range_A": ADC_CURRENT_RANGE_A},
        "encoder": {"bits": scenario.encoder_bits or "ideal", "edges": scenario.encoder_edges},
        "immediate_pwm": scenario.immediate_pwm,
        "machine": Path(scenario.machine).stem,
        "torque_sample_step_s": scenario.record.step_us * 1e-6,
        "initial_angle_deg": scenario.initial_angle_deg,
        "seed": scenario.seed,
        "versions": {name: version(name) for name in ("salient", "python-can", "cantools", "numpy")},
    }


def _draw_all(workers: Executor, runs: Sequence[_Run], results: Mapping[str, Any], out: Path,
              progress: Progress) -> list[Picture]:
    words = captions(results)
    pictures = [Picture(out / "figures" / f"{name}.png", title, words[name]) for name, (title, _) in PICTURES.items()]
    _gather({f"{name}.png": workers.submit(_draw, name, out / "figures" / f"{name}.png",
                                           [made for made in runs if made.experiment == experiment], results)
             for name, (_, experiment) in PICTURES.items()}, progress)
    return pictures


def _draw(name: str, path: Path, runs: Sequence[_Run], results: Mapping[str, Any]) -> None:
    experiment, scenario = runs[0].experiment, runs[0].scenario
    recordings = {made.controller: np.load(made.recording_path, mmap_mode="r") for made in runs}
    ours, paper = results["experiments"][experiment], results["paper"][experiment]
    reference = scenario.speed[0]
    if name == "figure_5":
        figures.draw_start(path, recordings, ours, paper, reference.value_rpm, reference.at_s)
    elif name == "figure_6":
        figures.draw_load_step_speed(path, recordings, ours, paper, scenario.load[0].at_s, reference.value_rpm)
    elif name == "figure_7":
        figures.draw_load_step_torque(path, recordings, ours, paper, scenario.load[0].at_s)
    else:
        figures.draw_phase_currents(path, recordings)


def _commands(scenarios: Mapping[str, Sequence[Scenario]], build: str) -> list[str]:
    target = "" if build == "host" else f" --target {build}"
    one = scenarios["start_600"][0]
    return [
        "# everything on this page",
        f"tools/salient demo --machine {shlex.quote(one.machine)} --control-rate-hz {one.control_rate_hz}"
        f" --encoder-bits {one.encoder_bits} --seed {one.seed}{target}",
        "# one experiment, with every row of its recordings",
        *(f"tools/salient run tools/scenarios/{experiment}.toml{target}" for experiment in scenarios),
    ]


def _files(runs: Iterable[_Run], recordings: Iterable[list[tuple[str, Path]]],
           out: Path) -> list[tuple[str, list[tuple[str, str]]]]:
    """What each run leaves, as write_report wants it. recordings: of each run, from _thin."""
    logs = ("CAN log (BLF)", "CAN log (candump text)")
    return [("The figures of this page, for scripts", [("results.json", "results.json")])] + [
        (f"{made.experiment} by {made.controller}, on virtual time",
         [(what, path.relative_to(out).as_posix())
          for what, path in (*zip(logs, made.log_paths, strict=True), *kept)])
        for made, kept in zip(runs, recordings, strict=True)]


def _thin(made: _Run) -> list[tuple[str, Path]]:
    """Leaves of a run's recording a row every KEPT_STEP_US, and all rows of the ripple's window in a file of their own
    where that has more; says what is in which file."""
    step_us = made.scenario.record.step_us
    every = max(1, round(KEPT_STEP_US / step_us))
    kept = [(f"true state each {every * step_us:g} µs (numpy.load)", made.recording_path)]
    if every > 1:
        rows = np.load(made.recording_path)
        half_step_s = 0.5e-6 * step_us
        first, end = np.searchsorted(rows["time_s"], (metrics.RIPPLE_WINDOW_S[0] - half_step_s,
                                                      metrics.RIPPLE_WINDOW_S[1] + half_step_s))
        window_path = made.recording_path.with_name(RIPPLE_WINDOW_FILE)
        np.save(window_path, rows[first:end])
        np.save(made.recording_path, rows[::every])
        kept.append((f"each {step_us:g} µs from {metrics.RIPPLE_WINDOW_S[0]:g} to {metrics.RIPPLE_WINDOW_S[1]:g} s",
                     window_path))
    return kept


def _plain(words: str) -> str:
    return words.replace("<i>", "").replace("</i>", "").replace("<sub>", "_").replace("</sub>", "")
