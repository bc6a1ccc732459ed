"""Ablation of the estimators and corrections of the controller `salient`: the same runs without each.

    python -m salient.experiments.ablation [--only NAME ...] [--out DIR] [--program FILE] [--runs N]

tests/ablation.toml has the mechanisms: each is removed by another text in a file of the firmware, which is compiled and
linked as in salient.experiments.planted. The runs are in cases.py: campaign machines, loads, speeds, encoders and
imperfections, the same for each mechanism, and with the whole drive for three seeds. A cell of the table is the
geometric mean of the ratios without / with, and the mean of the worst tenth, in the parts of the set that the mechanism
was made for; bold where one exceeds the scatter between the seeds. A mechanism without a bold cell and without failures
is not missed.

DIR/runs.jsonl keeps the results, so that an interrupted run goes on. A run of all mechanisms writes the table into
docs/reference/ablation.md.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from can import CanError

from salient.bench.drive import DriveError
from salient.bench.programs import EmulatorError, executable
from salient.bench.session import SessionError
from salient.errors import UsageError, exit_code
from salient.experiments import tasks
from salient.experiments.ablation import measure
from salient.experiments.ablation.cases import COUNT, Case, make_case
from salient.experiments.ablation.table import Ablation, Results, Row, head, line
from salient.experiments.campaign.runner import commit
from salient.experiments.metrics import MetricsError
from salient.experiments.planted import Bug, bugs, build, build_unchanged
from salient.experiments.results import rounded
from salient.experiments.scenario import run_scenario
from salient.machine.cache import machine_image
from salient.paths import OUT, REFERENCE, ROOT
from salient.progress import Progress, steps_of

TABLE = ROOT / "tests" / "ablation.toml"
PAGE = REFERENCE / "ablation.md"
BEGIN, END = "<!-- ablation: python -m salient.experiments.ablation -->\n", "<!-- end of ablation -->\n"
SEEDS = (1, 2, 3)
PROGRAM = "salient_host"
TELEMETRY_MS = 10
"""Nothing is read from it but the state of the drive."""


@dataclass(frozen=True)
class Variant:
    """A drive: the whole one (bug None), one without a mechanism, or another program."""

    seed: int = SEEDS[0]
    bug: Bug | None = None
    program: Path | None = None

    def key(self) -> str:
        """Dependencies of its runs, other than the case."""
        of_bug = (self.bug.file, self.bug.old, self.bug.new) if self.bug else ()
        files = (Path(measure.__file__), self.program or executable())
        return " ".join([*map(tasks.file_digest, files), repr(of_bug)])


def mechanisms() -> tuple[Bug, ...]:
    """All of the table."""
    return bugs(TABLE)


@cache
def needs() -> Mapping[str, str]:
    """By mechanism: the measurement that needs it."""
    found: dict[str, str] = tomllib.loads(TABLE.read_text(encoding="utf-8")).get("needs", {})
    return found


def _keys(variant: Variant, cases: Sequence[Case]) -> dict[int, str]:
    keys = {}
    for case in cases:
        scenario = replace(case.scenario, machine=_image_digest(case.scenario.machine))
        keys[case.number] = hashlib.sha256(f"{variant.key()} {scenario!r}".encode()).hexdigest()
    return keys


@cache
def _image_digest(machine: str) -> str:
    return tasks.file_digest(machine_image(machine))


def _run(task: tuple[str, Case]) -> dict[str, float] | str:
    """Metrics of a case with a program, or why there are none; executed by a worker."""
    program, case = task
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        try:
            result = run_scenario(case.scenario, Path(folder), program=Path(program),
                                  telemetry_period_ms=TELEMETRY_MS)
            if result.fault != "none":
                return f"fault {result.fault}"
            values: dict[str, float] = rounded(measure.values_of(case, result))
        except (EmulatorError, SessionError, DriveError, CanError, MetricsError) as error:
            return str(error)
    return values


def _programs(variants: Sequence[Variant], out: Path) -> dict[Variant, Path]:
    """The program of each variant; those without a mechanism are built."""
    def made(variant: Variant) -> Path:
        if variant.bug is None:
            return variant.program or executable()
        return build(variant.bug, out / variant.bug.label, PROGRAM)[0]

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return dict(zip(variants, pool.map(made, variants), strict=True))


def run(variants: Sequence[Variant], count: int, out: Path) -> dict[Variant, Results]:
    """Results of all runs that `out` does not have yet, and of those that it has."""
    cases = {variant: [make_case(number, variant.seed) for number in range(count)] for variant in variants}
    keys = {variant: _keys(variant, of) for variant, of in cases.items()}
    finished = tasks.read_results(out)
    open_ones = [variant for variant in variants if not finished.keys() >= set(keys[variant].values())]
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        programs = _programs(open_ones, Path(folder))
        listed = [tasks.Task(keys[variant][number], (str(programs.get(variant, "")), cases[variant][number]))
                  for number in reversed(range(count)) for variant in variants]
        with Progress(steps_of(len(listed), sys.stderr), sys.stderr, len(listed)) as progress:
            results = {}
            for task, result in tasks.run(listed, _run, out):
                results[task.key] = result
                progress.item(f"case {task.arguments[1].number}")
    return {variant: {number: results[key] for number, key in of.items()} for variant, of in keys.items()}


def page(text: str, table: str) -> str:
    """A page with the table in its place."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise UsageError(f"{PAGE}: has no place for the table: {BEGIN.strip()} and {END.strip()}")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def rows(chosen: Sequence[Bug], count: int, out: Path, program: Path | None = None
         ) -> list[tuple[Row, tuple[str, ...]]]:
    """Rows of mechanisms, or of another program; each with the parts of the set that its cells are about."""
    seeds = [Variant(seed) for seed in SEEDS]
    others = [Variant(bug=each) for each in chosen] if program is None else [Variant(program=program.resolve())]
    results = run([*seeds, *others], count, out)
    whole = Ablation([make_case(number, SEEDS[0]) for number in range(count)], [results[seed] for seed in seeds])
    named = [(other.bug.name, other.bug.found_by) if other.bug else (str(other.program), ("all",))
             for other in others]
    return [(whole.row(name, parts, results[other]), parts) for other, (name, parts) in zip(others, named, strict=True)]


def main() -> int:
    """Runs the set without the mechanisms that are named."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.ablation", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--only", nargs="+", default=[""], metavar="NAME",
                        help="mechanisms with one of these in their name")
    parser.add_argument("--out", type=Path, default=OUT / "ablation", metavar="DIR", help=f"default {OUT}/ablation")
    parser.add_argument("--program", type=Path, metavar="FILE",
                        help="a salient_host of other sources instead of the mechanisms, against the present build")
    parser.add_argument("--runs", type=int, default=COUNT, metavar="N", help=f"number of runs (default {COUNT})")
    options: Any = parser.parse_args()
    chosen = [each for each in mechanisms() if any(part in each.name for part in options.only)]
    if not chosen:
        raise UsageError(f"--only {' '.join(options.only)}: no mechanism of {TABLE.name} has this in its name")
    for mechanism in chosen:
        mechanism.text()
    build_unchanged(["hil.py"])
    found = rows(chosen, options.runs, options.out, options.program)
    text = head() + "".join(line(row, parts, needs().get(row.name, "")) for row, parts in found)
    print(text, end="")
    for row, _ in found:
        if not row.is_missed:
            print(f"not missed: {row.name}")
    if len(chosen) == len(mechanisms()) and options.runs == COUNT and options.program is None:
        PAGE.write_text(page(PAGE.read_text(encoding="utf-8"),
                             f"{options.runs} runs at {commit()}.\n\n{text}"), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
