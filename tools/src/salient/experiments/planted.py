"""Plants bugs in the drive and its gate path, one at a time, and looks who finds them.

    python -m salient.experiments.planted [--only PART ...] [--by KIND ...] [--out DIR] [--list]

tests/planted.toml has the bugs: each is a text in a file, what replaces it, and what has to find it. The file is
compiled with the bug, and the programs of the host build are linked with it. Unit tests and tests of tests/hil find it
when one fails that passes without it; the campaign, when a seed from 1 on has a violation that it does not have without
the bug. Such a seed is shrunk to the events that it needs, and replayed, with log and plots in a folder of DIR.

Prints a line for each bug, then who missed one. DIR/runs.jsonl keeps what was found, so that an interrupted run goes
on; DIR/summary.json has the counts, which a run of all also writes to tests/planted.json. Exit code 1 when a bug is
missed by one of those that have to find it, or its replay differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from salient.errors import UsageError, exit_code, reason
from salient.experiments import tasks
from salient.experiments.campaign.failure import classes, save
from salient.experiments.campaign.runner import Programs, commit, processor_s, run_world, run_worlds
from salient.paths import BUILD, OUT, ROOT
from salient.progress import Progress, steps_of

TABLE = ROOT / "tests" / "planted.toml"
SUMMARY = ROOT / "tests" / "planted.json"
UNIT, HIL = ROOT / "tests" / "unit", ROOT / "tests" / "hil"
CAMPAIGN = "campaign"
KINDS = ("unit", "hil", CAMPAIGN)
SEEDS_MAX = 6000
_CHUNK = 20
_TEST_MAX_S = 600
"""Wall-clock time of a test: with a bug it may never end."""
_WARNINGS = ("-Werror", "-Wno-unused")
"""A compiler sees no bug but that what a removed check had needed is unused."""
_DRIVE = ("CMakeLists.txt", "cmake", "emulator", "firmware", "hal", "tools/machines")
_DEPENDS_ON = {"unit": (*_DRIVE, "tests/unit"), "hil": (*_DRIVE, "tests/hil", "tools/src/salient/bench"),
               CAMPAIGN: _DRIVE}

Finding = dict[str, Any]
"""by: the test or the violation that found a bug, "" when it was missed. Of the campaign also seed, processor_s,
shrinking_s, events and replays."""


@dataclass(frozen=True)
class Bug:
    """A text of a file, what takes its place, and what has to find it."""

    name: str
    file: str
    old: str
    new: str
    found_by: tuple[str, ...]
    table: Path = TABLE

    @property
    def label(self) -> str:
        """Its name in the name of a folder."""
        return re.sub(r"\W+", "_", self.name)

    def finders(self, kind: str) -> tuple[str, ...]:
        """Finders of a kind."""
        return tuple(finder for finder in self.found_by if kind_of(finder) == kind)

    def text(self) -> str:
        """Its file with the bug; UsageError when the old text is not there exactly once."""
        path = ROOT / self.file
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        if text.count(self.old) != 1 or self.old == self.new:
            raise UsageError(f"{self.table.name}: {self.name}: {self.file} has the old text {text.count(self.old)} "
                             "times: must be once, and the new text another one")
        return text.replace(self.old, self.new)


def kind_of(finder: str) -> str:
    """Kind of what finds a bug."""
    return CAMPAIGN if finder == CAMPAIGN else "hil" if ".py" in finder else "unit"


@cache
def bugs(path: Path = TABLE) -> tuple[Bug, ...]:
    """All of a table; UsageError names what is wrong with it."""
    found = []
    try:
        for group in tomllib.loads(path.read_text(encoding="utf-8"))["group"]:
            for name, old, new, *by in group["bugs"]:
                found.append(Bug(name, group["file"], old, new, tuple(by[0] if by else group["found_by"]), path))
    except (OSError, tomllib.TOMLDecodeError, KeyError, ValueError) as error:
        raise UsageError(f"{path.name}: no table of bugs: {reason(error)}") from None
    names = [bug.name for bug in found]
    for bug in found:
        if names.count(bug.name) > 1 or not bug.found_by:
            raise UsageError(f"{path.name}: {bug.name}: must have a name of its own, and something that finds it")
    return tuple(found)


def named(name: str) -> Bug:
    """The bug of a name; UsageError."""
    for bug in bugs():
        if bug.name == name:
            return bug
    raise UsageError(f"{TABLE.name}: no bug '{name}'")


def check_finders(bug: Bug) -> None:
    """UsageError when a test that has to find it does not exist."""
    for finder in bug.found_by:
        if kind_of(finder) == "hil":
            file, _, test = finder.partition("::")
            path = HIL / file
            found = path.is_file() and f"def {test.partition('[')[0]}" in path.read_text(encoding="utf-8")
        elif kind_of(finder) == "unit":
            program, _, test = finder.partition(":")
            source = unit_source(program)
            found = source is not None and test.replace(".", ", ") in source.read_text(encoding="utf-8")
        else:
            found = True
        if not found:
            raise UsageError(f"{TABLE.name}: {bug.name}: no test {finder}")


def unit_source(program: str) -> Path | None:
    """Source of a program of unit tests, test_FOLDER_NAME or test_NAME."""
    return next((path for path in UNIT.rglob("test_*.cpp") if program == unit_program(path)), None)


def unit_program(source: Path) -> str:
    """Program of a source of unit tests."""
    return "_".join(["test", *source.relative_to(UNIT).parent.parts, source.stem.removeprefix("test_")])


# --- Build ----------------------------------------------------------------------------------------------------------


def _target(finder: str) -> str:
    return "salient_host" if kind_of(finder) == "hil" else finder.partition(":")[0]


def build_unchanged(finders: Sequence[str]) -> None:
    """The programs without a bug, whose objects are linked, or without finders all of them; UsageError."""
    targets = {_target(finder) for finder in finders} - {CAMPAIGN}
    if CAMPAIGN in finders:
        targets |= {"salient_campaign", "salient_host"}
    named = ["--target", *targets] if targets else []
    for command in (["cmake", "--preset", "host"], ["cmake", "--build", "--preset", "host", *named]):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise UsageError(f"{shlex.join(command[:4])} fails: {done.stdout.strip()[-2000:]}")


def _compiled(bug: Bug, folder: Path) -> list[tuple[Path, Path]]:
    """Sources of the tree that a bug changes, each with the file to be compiled instead: that with the bug, which is
    written into a folder, or the same source, which finds what it includes in the folder first."""
    top, _, included = bug.file.partition("/")
    place = folder / included
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(bug.text(), encoding="utf-8")
    if place.suffix == ".c":
        return [(ROOT / bug.file, place)]
    return [(path, path) for path in sorted((ROOT / top).rglob("*.c"))
            if f'#include "{included}"' in path.read_text(encoding="utf-8")]


def compiling(bug: Bug, source: Path, target: str) -> list[str]:
    """Compiler and options with which the build compiles a source for a target; UsageError when it does not."""
    line = next((shlex.split(line) for line in _commands(target) if line.endswith(f"-c {source}")), None)
    if line is None:
        raise UsageError(f"{bug.table.name}: {bug.name}: {source.relative_to(ROOT)} is no part of {target}")
    return line[:line.index("-MD")]


def build(bug: Bug, folder: Path, *targets: str) -> list[Path]:
    """Programs with the bug in a folder: its file compiled, and they linked, as the build does it."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for source, place in _compiled(bug, folder):
        compiler, *options = compiling(bug, source, targets[0])
        made.append(folder / f"{source.stem}.o")
        _execute(bug, [compiler, f"-I{folder}", *options, *_WARNINGS, "-o", str(made[-1]), "-c", str(place)])
    for target in targets:
        link = next(part for part in _commands(target)[-1].split(" && ") if f" -o bin/{target} " in part)
        linking = shlex.split(link)
        out = linking.index("-o") + 1
        linking[out] = str(folder / target)
        linking[out + 1:out + 1] = map(str, made)  # before the library, whose members are then not needed
        _execute(bug, [*linking, "-fno-lto"])  # in a sixth of the time; the program takes 8 % longer
    return [folder / target for target in targets]


def campaign_programs(bug: Bug, folder: Path) -> Programs:
    """The campaign's programs with the bug, in a folder."""
    return Programs(*build(bug, folder, "salient_campaign", "salient_host"))


@cache
def _commands(target: str) -> list[str]:
    return subprocess.run(["ninja", "-t", "commands", target], cwd=BUILD / "host", capture_output=True, text=True,
                          check=True).stdout.splitlines()


def _execute(bug: Bug, line: list[str]) -> None:
    done = subprocess.run(line, cwd=BUILD / "host", capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise UsageError(f"{bug.table.name}: {bug.name}: does not build: {done.stderr.strip()[-2000:]}")


# --- Look -----------------------------------------------------------------------------------------------------------


def first_failure(finder: str, program: Path) -> str:
    """The first test that fails with a program, "" when all pass; UsageError when the tests do not run."""
    if kind_of(finder) == "hil":
        line = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--salient-program", str(program),
                "--salient-failures", str(program.parent / "failures"), str(HIL / finder)]
        pattern = r"^(?:FAILED|ERROR) (?:\S*/)?(\S+::.+?)(?: - .*)?$"
    else:
        chosen = finder.partition(":")[2] or "*"
        line = [str(program), "--gtest_brief=1", "--gtest_fail_fast", f"--gtest_filter={chosen}"]
        pattern = r"^\[  FAILED  \] (\S+?)[,.]?(?: .*)?$"
    try:
        done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False, timeout=_TEST_MAX_S)
    except subprocess.TimeoutExpired:
        return f"{finder} does not end"
    if done.returncode == 0:
        return ""
    if kind_of(finder) == "hil" and done.returncode != 1:
        raise UsageError(f"{TABLE.name}: test {finder} does not run")
    failed = re.search(pattern, done.stdout, re.MULTILINE)
    return failed[1] if failed else f"{finder} ends with code {done.returncode}"


@cache
def _check_unchanged(finder: str) -> None:
    """UsageError when a test fails without a bug: it would prove nothing."""
    failure = first_failure(finder, BUILD / "host" / "bin" / _target(finder))
    if failure:
        raise UsageError(f"{TABLE.name}: fails without a bug: {failure}")


def run_tests(bug: Bug, finders: Sequence[str]) -> Finding:
    """Runs tests until one finds the bug."""
    for finder in finders:
        _check_unchanged(finder)
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            failure = first_failure(finder, build(bug, Path(folder), _target(finder))[0])
        if failure:
            return {"by": failure}
    return {"by": ""}


def hunt(programs: Programs, seeds_max: int = SEEDS_MAX) -> Finding:
    """Runs seeds until one has a violation that it does not have without the bug."""
    begin_s = processor_s()
    for first in range(1, seeds_max + 1, _CHUNK):
        for result in run_worlds(first, min(_CHUNK, seeds_max + 1 - first), programs):
            if not result.get("violations"):
                continue
            spent_s = processor_s() - begin_s
            seed = int(result["seed"])
            new = set(classes(result)) - set(classes(run_world(seed)))
            if new:
                return {"by": min(new), "seed": seed, "processor_s": round(spent_s, 2)}
    return {"by": "", "processor_s": round(processor_s() - begin_s, 2)}


def _replays(folder: Path, violation: str) -> bool:
    """The printed command has the violation, the bits of the campaign, log and plots."""
    done = subprocess.run([sys.executable, "-m", "salient", "replay", str(folder)], capture_output=True, text=True,
                          check=False)
    left = ("can.blf", "failure.png", "failure.html")
    return (f"violation: {violation} at" in done.stdout and "equal to the campaign's" in done.stdout
            and done.returncode == 1 and all((folder / name).exists() for name in left))


def hunt_and_replay(bug: Bug, folder: Path, seeds_max: int = SEEDS_MAX) -> Finding:
    """Hunts a bug with the campaign, shrinks and replays what it found; folder: for log and plots."""
    with tempfile.TemporaryDirectory(prefix="salient-") as temporary:
        programs = campaign_programs(bug, Path(temporary))
        found = hunt(programs, seeds_max)
        if not found["by"]:
            return found
        begin_s = processor_s()
        saved = save(found["seed"], found["by"], folder, bug=bug.name, programs=programs)
        shrinking_s = round(processor_s() - begin_s, 2)
    return {**found, "shrinking_s": shrinking_s, "events": [event["event"] for event in saved["world"]["events"]],
            "replays": _replays(folder, found["by"])}


def look(bug: Bug, kind: str, out: Path, seeds_max: int) -> Finding:
    """Who of a kind finds the bug."""
    if kind == CAMPAIGN:
        return hunt_and_replay(bug, out / bug.label, seeds_max)
    return run_tests(bug, bug.finders(kind))


def _look(arguments: tuple[Bug, str, Path, int]) -> Finding:
    """By a worker process."""
    return look(*arguments)


# --- Results --------------------------------------------------------------------------------------------------------


def sources(kind: str) -> str:
    """Hash of what findings of a kind depend on."""
    return tasks.sources_digest(*_DEPENDS_ON[kind])


def _key(bug: Bug, kind: str, sources: str, seeds_max: int) -> str:
    parts = (sources, bug.file, bug.old, bug.new, *bug.finders(kind), str(seeds_max) if kind == CAMPAIGN else "")
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _cell(finding: Finding | None) -> str:
    if finding is None:
        return "-"
    seed = f", seed {finding['seed']}" if "seed" in finding else ""
    return f"{finding['by'] or 'MISSED'}{seed}{'' if finding.get('replays', True) else ', replay DIFFERS'}"


def line(bug: Bug, findings: dict[str, Finding]) -> str:
    """A row of the table."""
    return f"| {bug.name} | {' | '.join(_cell(findings.get(kind)) for kind in KINDS)} |"


def summary(found: dict[str, dict[str, Finding]], seeds_max: int) -> dict[str, Any]:
    """Counts; found: by bug and kind."""
    note: dict[str, Any] = {"commit": commit(), "bugs": len(found),
                            "found": sum(any(each["by"] for each in kinds.values()) for kinds in found.values())}
    for kind in KINDS:
        of_kind = [kinds[kind] for kinds in found.values() if kind in kinds]
        note[kind] = {"looked": len(of_kind), "found": sum(bool(each["by"]) for each in of_kind)}
    hunted = [kinds[CAMPAIGN] for kinds in found.values() if kinds.get(CAMPAIGN, {}).get("by")]
    if hunted:
        note[CAMPAIGN] |= {
            "seeds": seeds_max, "last_seed": max(each["seed"] for each in hunted),
            "processor_s": [round(of(each["processor_s"] for each in hunted), 2)
                            for of in (min, statistics.median, max)],
            "shrinking_s": max(each["shrinking_s"] for each in hunted),
            "events": max(len(each["events"]) for each in hunted), "replayed": sum(each["replays"] for each in hunted)}
    note["missed"] = {name: missed for name, kinds in found.items()
                      if (missed := [kind for kind in KINDS if kind in kinds and not kinds[kind]["by"]])}
    return note


def run(chosen: Sequence[Bug], kinds: Sequence[str], out: Path, seeds_max: int = SEEDS_MAX) -> int:
    """Plants bugs; returns the exit code."""
    for bug in chosen:
        bug.text()
        check_finders(bug)
    depended = {kind: sources(kind) for kind in kinds}
    build_unchanged(sorted({finder for bug in chosen for finder in bug.found_by if kind_of(finder) in kinds}))
    looks = [tasks.Task(_key(bug, kind, depended[kind], seeds_max), (bug, kind, out, seeds_max))
             for bug in chosen for kind in kinds if bug.finders(kind)]
    found: dict[str, dict[str, Finding]] = {bug.name: {} for bug in chosen}
    with Progress(steps_of(len(looks), sys.stderr), sys.stderr, len(looks)) as progress:
        for task, finding in tasks.run(looks, _look, out):
            bug, kind, *_ = task.arguments
            found[bug.name][kind] = finding
            progress.item(f"{bug.name} by {kind}")
    print(f"| bug | {' | '.join(KINDS)} |\n| --- | --- | --- | --- |")
    for bug in chosen:
        print(line(bug, found[bug.name]))
    note = summary(found, seeds_max)
    text = json.dumps(note, indent=2) + "\n"
    (out / "summary.json").write_text(text, encoding="utf-8")
    if len(chosen) == len(bugs()) and set(kinds) == set(KINDS):
        SUMMARY.write_text(text, encoding="utf-8")
    for name, missed in note["missed"].items():
        print(f"missed by {', '.join(missed)}: {name}")
    replays = all(each.get("replays", True) for kinds_of in found.values() for each in kinds_of.values())
    print(f"{note['found']} of {note['bugs']} found")
    return 0 if not note["missed"] and replays else 1


def main() -> int:
    """Plants the bugs that are named."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.planted", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--only", nargs="+", default=[""], metavar="PART", help="bugs with one of these in their name")
    parser.add_argument("--by", nargs="+", default=KINDS, choices=KINDS, help="look with these only (default all)")
    parser.add_argument("--seeds", type=int, default=SEEDS_MAX, help=f"for a bug at most (default {SEEDS_MAX})")
    parser.add_argument("--out", type=Path, default=OUT / "planted", metavar="DIR", help=f"default {OUT}/planted")
    parser.add_argument("--list", action="store_true", help="only name the bugs")
    options = parser.parse_args()
    chosen = [bug for bug in bugs() if any(part in bug.name for part in options.only)
              and any(bug.finders(kind) for kind in options.by)]
    if not chosen:
        raise UsageError(f"--only {' '.join(options.only)}: no bug has this in its name; --list shows them")
    if options.list:
        print("\n".join(bug.name for bug in chosen))
        return 0
    return run(chosen, [kind for kind in KINDS if kind in options.by], options.out, options.seeds)


if __name__ == "__main__":
    sys.exit(exit_code(main))
