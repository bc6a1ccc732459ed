"""salient compare: measures the groups asked for and leaves compare.json, compare.html and the failed runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from salient.bench.emulator import executable
from salient.errors import UsageError
from salient.experiments.compare import baseline, results_file, table
from salient.experiments.compare.cases import GROUPS, Case, scenario_toml
from salient.experiments.compare.runner import Outcome, run_all

FAILED = "failed"
_REPLAYS_MAX = 10  # named, of the runs that failed


def run(options: argparse.Namespace, stream: TextIO = sys.stdout) -> int:
    """Measures, prints the table, writes the files. Returns 0; 1 when a figure got worse than in --baseline."""
    if options.list:
        for name, group in GROUPS.items():
            stream.write(f"{name:<18}{group.title}{' (long: only when named)' if group.long else ''}\n")
        return 0
    cases = _cases(options.groups, options.quick)
    earlier = None if options.baseline is None else results_file.read(options.baseline, options.quick)
    _prepare_folder(options.out)
    for machine in {case.scenario.machine for case in cases}:
        executable(machine)
    outcomes = run_all(cases, options.jobs or os.cpu_count() or 1, sys.stderr)
    made = table.make_rows(outcomes)
    changed, both = ([], 0) if earlier is None else baseline.changes(made, earlier, options.worse_percent)
    compared = earlier and baseline.summary(changed, both, str(options.baseline), options.worse_percent)
    content = results_file.content(made, outcomes, options.quick)
    results_file.write(options.out / results_file.NAME, content)
    replays = _write_failed(options.out / FAILED, outcomes)

    from salient.experiments.compare.html import write_page  # draws; not needed before

    write_page(options.out / "compare.html", made, content, compared, changed, _command(options))
    stream.write(f"{table.table(made)}\n\n{table.verdict(made)}\n")
    for outcome, path in replays[:_REPLAYS_MAX]:
        stream.write(f"{_name(outcome.case)}: {outcome.failed}; again: tools/salient run {path}\n")
    if len(replays) > _REPLAYS_MAX:
        stream.write(f"and {len(replays) - _REPLAYS_MAX} more in {options.out / FAILED}\n")
    if compared:
        stream.write(f"\n{compared}\n")
    stream.write(f"\nresults: {options.out / results_file.NAME}\npage:    {options.out / 'compare.html'}\n")
    return 1 if any(change.worse for change in changed) else 0


def _cases(groups: Sequence[str], quick: bool) -> list[Case]:
    for name in groups:
        if name not in GROUPS:
            raise UsageError(f"no group {name}: must be one of {', '.join(GROUPS)}")
    return [case for name, group in GROUPS.items() if name in groups or not groups and not group.long
            for case in group.cases(quick)]


def _prepare_folder(out: Path) -> None:
    """Makes the folder, and takes away what an earlier run left there."""
    try:
        (out / FAILED).mkdir(parents=True, exist_ok=True)
        for path in (*(out / FAILED).glob("*.toml"), out / results_file.NAME, out / "compare.html"):
            path.unlink(missing_ok=True)
        (out / results_file.NAME).touch()
        (out / results_file.NAME).unlink()
    except OSError as error:
        raise UsageError(f"--out {out}: cannot write there ({error.strerror}); give a folder that can be written") \
            from None


def _write_failed(folder: Path, outcomes: Sequence[Outcome]) -> list[tuple[Outcome, Path]]:
    """A scenario file for each run that failed, which replays it."""
    replays = []
    for outcome in outcomes:
        if not outcome.failed:
            continue
        path = folder / f"{'_'.join(_name(outcome.case).replace(',', '').split())}.toml"
        path.write_text(scenario_toml(outcome.case), encoding="utf-8")
        replays.append((outcome, path))
    return replays


def _name(case: Case) -> str:
    return " ".join(f"{case.group} {case.condition} {case.sample} {case.controller}".split())


def _command(options: argparse.Namespace) -> str:
    return " ".join(["tools/salient compare", *options.groups, *(["--quick"] if options.quick else [])])
