"""salient compare: runs the selected groups; writes compare.json, compare.html and scenarios of the failed runs."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TextIO

from salient.bench.settings import parse_values
from salient.config import DEFAULTS
from salient.errors import UsageError, close_names
from salient.experiments.compare import baseline, mismatch, results_file, summary_file, table
from salient.experiments.compare.case import MACHINES, Case
from salient.experiments.compare.cases import GROUPS, TITLES, scenario_toml
from salient.experiments.compare.machine import Subject, cases_of, subject, targets_of
from salient.experiments.compare.runner import RunMetrics, run_all
from salient.experiments.compare.targets import TARGETS
from salient.experiments.scenario import check_parameters, with_setting
from salient.experiments.tasks import RESULTS
from salient.machine.cache import machine_image
from salient.machine.file import MachineError
from salient.paths import COMMAND, make_folder

FAILED, PAGE = "failed", "compare.html"
_FAILED_LISTED_MAX = 10


def run(options: argparse.Namespace, stream: TextIO = sys.stdout) -> int:
    """Runs the cases, prints the table, writes the files. Returns 0, or 1 when a metric is worse than in --baseline."""
    if options.list:
        stream.writelines(f"{name:<20}{group.title}{' (long: runs only when named)' if group.long else ''}\n"
                          for name, group in GROUPS.items())
        return 0
    # Options are refused before the cases are made: a group may have a thousand of them, with files of their own.
    groups = _groups(options.groups)
    on = None if options.machine is None else _subject(options.machine)
    if options.true_machine is not None:
        _check_true_machine(groups, options.machine, options.true_machine)
    settings = _settings(options.set)
    earlier = None if options.baseline is None else results_file.read(options.baseline, options.quick)
    cases = [case for name in groups for case in GROUPS[name].cases(options.quick)]
    titles, targets = TITLES, TARGETS
    if on is not None:
        cases, titles = cases_of(cases, on, options.quick), {name: on.text(title) for name, title in titles.items()}
        targets = TARGETS if on.is_bundled else targets_of(on)
    if options.true_machine is not None:
        cases = [replace(case, scenario=replace(case.scenario, true_machine=options.true_machine)) for case in cases]
    cases = _with_settings(_first_samples(cases, options.samples), settings)
    make_folder(options.out, _of_earlier_run(options.out))
    machine_files = mismatch.copy_files(cases, options.out)
    runs = run_all(cases, options.jobs, sys.stderr, options.out, not options.resume, options.scheduler)
    rows = table.make_rows(runs, targets)
    changes: list[baseline.Change] = []
    change_summary = None
    if earlier is not None:
        changes, both = baseline.changes(rows, earlier, options.worse_percent)
        change_summary = baseline.summary(changes, both, str(options.baseline), options.worse_percent)
    content = results_file.content(rows, runs, options.quick)
    results_file.write(options.out / results_file.NAME, content)
    summary_file.write(options.out / summary_file.NAME, runs, _command(options))
    failed = _write_failed(options.out / FAILED, runs)

    from salient.experiments.compare.html import write_page  # imports Matplotlib, which takes a second

    write_page(options.out / PAGE, rows, content, change_summary, changes, _command(options), titles)
    stream.write(f"{table.table(rows, titles)}\n\n{table.summary(rows)}\n")
    stream.writelines(f"{line}\n" for line in table.worst(runs))
    for run, path in failed[:_FAILED_LISTED_MAX]:
        stream.write(f"{_name(run.case)}: {run.failed}; reproduce with: {COMMAND} run {path}\n")
    if len(failed) > _FAILED_LISTED_MAX:
        stream.write(f"and {len(failed) - _FAILED_LISTED_MAX} more in {options.out / FAILED}\n")
    if change_summary:
        stream.write(f"\n{change_summary}\n")
    for wrong, right in machine_files[:1]:
        stream.writelines(f"{line}\n" for line in mismatch.refused(
            MACHINES if options.machine is None else (options.machine,)))
        stream.write(f"\nwrong machine files: {options.out / mismatch.FILES}; for example {COMMAND} demo --machine"
                     f" {shlex.quote(str(wrong))} --true-machine {shlex.quote(right)}\n")
    stream.write(f"\nresults: {options.out / results_file.NAME}\npage:    {options.out / 'compare.html'}\n")
    return 1 if any(change.worse for change in changes) else 0


def _of_earlier_run(out: Path) -> Sequence[str]:
    """Patterns of the files that an earlier run has left in a folder: none without its results, since a folder of the
    user may have machine files and failed scenarios of his own."""
    if not any((out / name).is_file() for name in (results_file.NAME, RESULTS)):
        return ()
    return f"{FAILED}/*.toml", f"{mismatch.FILES}/*/*.*", results_file.NAME, PAGE, summary_file.NAME


def _groups(named: Sequence[str]) -> list[str]:
    """The groups in their order; all but the long ones without a name. UsageError: there is no such group."""
    for name in named:
        if name not in GROUPS:
            raise UsageError(f"unknown group {name}: {close_names(name, GROUPS)} (--list)")
    return [name for name, group in GROUPS.items() if name in named or (not named and not group.long)]


def _subject(name_or_path: str) -> Subject:
    try:
        return subject(name_or_path)
    except MachineError as error:
        raise UsageError(str(error)) from None


def _check_true_machine(groups: Sequence[str], machine: str | None, true_machine: str) -> None:
    """UsageError: without --machine, with a group whose runs have their own, or the two do not fit."""
    if machine is None:
        raise UsageError(f"--true-machine {true_machine}: only with --machine, whose drive it replaces the motor of")
    if mismatch.GROUP in groups:
        raise UsageError(f"--true-machine {true_machine}: not with {mismatch.GROUP}, whose runs have their own")
    machine_image(machine, true_machine)  # checks them


def _first_samples(cases: Sequence[Case], count: int | None) -> list[Case]:
    """The cases of the first `count` samples of each condition; None for all."""
    samples: dict[tuple[str, str], dict[str, None]] = {}  # in order
    for case in cases:
        samples.setdefault((case.group, case.condition), {}).setdefault(case.sample)
    kept = {condition: list(of)[:count] for condition, of in samples.items()}
    return [case for case in cases if case.sample in kept[case.group, case.condition]]


def _settings(texts: Sequence[str]) -> list[tuple[str, float]]:
    """Name and value of each --set."""
    found = []
    for text in texts:
        name, values = parse_values(text)
        if len(values) != 1:
            raise UsageError(f"--set {text}: must be one value; salient sweep takes several")
        found.append((name, values[0]))
    return found


def _with_settings(cases: Sequence[Case], settings: Sequence[tuple[str, float]]) -> list[Case]:
    """The cases with a parameter of the drive or a variable of the bench set in all of them."""
    changed = list(cases)
    for name, value in settings:
        changed = [replace(case, scenario=with_setting(case.scenario, name, value)) for case in changed]
    if settings:
        checked = {repr(scenario): scenario for case in changed
                   for scenario in [replace(case.scenario, seed=DEFAULTS["seed"], initial_angle_deg=0.0)]}
        check_parameters(list(checked.values()), "host")
    return changed


def _write_failed(folder: Path, runs: Sequence[RunMetrics]) -> list[tuple[RunMetrics, Path]]:
    """Writes a scenario file for each failed run, which reproduces it."""
    written = []
    folder.mkdir(exist_ok=True)
    for run in runs:
        if not run.failed:
            continue
        path = folder / f"{_file_name(run.case)}.toml"
        path.write_text(scenario_toml(run.case), encoding="utf-8")
        written.append((run, path))
    return written


def _name(case: Case) -> str:
    return " ".join(f"{case.group} {case.condition} {case.sample} {case.controller}".split())


def _file_name(case: Case) -> str:
    """The name without spaces, commas and the slash of a unit."""
    return "_".join(_name(case).replace(",", "").replace("/", "_").split())


def _command(options: argparse.Namespace) -> str:
    machine = [] if options.machine is None else ["--machine", shlex.quote(options.machine)]
    if options.true_machine is not None:
        machine += ["--true-machine", shlex.quote(options.true_machine)]
    return " ".join([f"{COMMAND} compare", *options.groups, *machine, *(["--quick"] if options.quick else []),
                     *(["--set " + shlex.quote(text) for text in options.set]),
                     *([f"--samples {options.samples}"] if options.samples else [])])
