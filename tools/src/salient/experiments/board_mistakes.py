"""Plants mistakes in the port of the board and in the model of its part, one at a time, and looks what finds them.

    python -m salient.experiments.board_mistakes [--only PART ...] [--out DIR] [--jobs N] [--list]

tests/board_mistakes.toml has the mistakes, in the form of tests/planted.toml: each is a text in a file, what replaces
it, and what finds it. A mistake of the port is found by the program that checks the port; one of the model by that
program, which is right, or by a small program that tests the model. A mistake that nothing here can find names the step
of the bring-up checklist that shows it.

Prints a line for each mistake, then their number. DIR/runs.jsonl keeps what was found, so that an interrupted run goes
on; a run of all also writes tests/board_mistakes.json. Exit code 1 when a mistake survives that has to be found, or one
is found that the table leaves to the checklist.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from salient.board import port_program
from salient.board.header import PORT
from salient.errors import UsageError, exit_code
from salient.experiments import tasks
from salient.experiments.campaign.runner import commit
from salient.experiments.planted import Bug, bugs
from salient.paths import BUILD, OUT, ROOT
from salient.progress import Progress, steps_of

TABLE = ROOT / "tests" / "board_mistakes.toml"
SUMMARY = ROOT / "tests" / "board_mistakes.json"
CHECKLIST = ROOT / "docs" / "board" / "bring-up.md"
PROGRAM, PART = "port", "part"
CLOCK_MHZ = 170
_TESTS = ROOT / "tests" / "target" / "test_stm32g4_model.py"
_DEPENDS_ON = ("emulator/stm32g4", "hal", "tests/target/stm32g4", "tests/target/test_stm32g4_model.py",
               "tools/src/salient/board/port_program.py")


def mistakes() -> tuple[Bug, ...]:
    """The table; UsageError names what is wrong with it."""
    found = bugs(TABLE)
    for bug in found:
        for finder in bug.found_by:
            if finder not in (PROGRAM, PART) and re.fullmatch(r"step \d+", finder) is None:
                raise UsageError(f"{TABLE.name}: {bug.name}: found by '{finder}': must be {PROGRAM}, {PART} or step N")
    return found


def of_port(bug: Bug) -> bool:
    """It is in the port, not in the model."""
    return (ROOT / bug.file).parent == PORT


def left_to_checklist(bug: Bug) -> bool:
    """No program finds it."""
    return not {PROGRAM, PART} & set(bug.found_by)


def build_model() -> None:
    """The model without a mistake; UsageError."""
    for command in (["cmake", "--preset", "host"], ["cmake", "--build", "--preset", "host", "--target",
                                                    "salient_stm32g4"]):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise UsageError(f"{shlex.join(command)} fails: {done.stdout.strip()[-2000:]}")


@cache
def _link_line() -> list[str]:
    return subprocess.run(["ninja", "-t", "commands", "salient_stm32g4"], cwd=BUILD / "host", capture_output=True,
                          text=True, check=True).stdout.splitlines()


def _model(bug: Bug, folder: Path) -> Path:
    """The model with a mistake: its file compiled, and it linked, as the build does it."""
    source = ROOT / bug.file
    line = next((shlex.split(line) for line in _link_line() if line.endswith(f"-c {source}")), None)
    if line is None:
        raise UsageError(f"{TABLE.name}: {bug.name}: {bug.file} is no part of the model")
    place = folder / source.name
    place.write_text(bug.text(), encoding="utf-8")
    made = folder / f"{source.stem}.o"
    link = shlex.split(next(part for part in _link_line()[-1].split(" && ") if " -o bin/salient_stm32g4 " in part))
    of_build = next(word for word in link if word.endswith(f"salient_stm32g4.dir/{source.name}.o"))
    link[link.index(of_build)] = str(made)
    link[link.index("-o") + 1] = str(folder / "model")
    for command in ([*line[:line.index("-MD")], "-Wno-error", "-Wno-unused", "-o", str(made), "-c", str(place)], link):
        done = subprocess.run(command, cwd=BUILD / "host", capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise UsageError(f"{TABLE.name}: {bug.name}: does not build: {done.stderr.strip()[-2000:]}")
    return folder / "model"


def _first_failure(model: Path) -> str:
    """The first test of the model that fails."""
    line = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider",
            f"--confcutdir={_TESTS.parent}", str(_TESTS)]  # without the builds of all targets
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False,
                          env={**os.environ, "SALIENT_STM32G4": str(model)})
    if done.returncode == 0:
        return ""
    failed = re.search(r"^FAILED (?:\S*/)?(\S+::.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode != 1 or failed is None:
        raise UsageError(f"{_TESTS.name} does not run: {done.stdout.strip()[-1000:]}")
    return failed[1]


@cache
def _kept_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder of this process, until it ends."""
    return tempfile.TemporaryDirectory(prefix="salient-")


@cache
def _objects() -> dict[str, Path]:
    return port_program.objects(Path(_kept_folder().name) / "objects", CLOCK_MHZ)


@cache
def _right_image() -> Path:
    return port_program.build(Path(_kept_folder().name), CLOCK_MHZ, compiled=_objects())


def look(bug: Bug) -> str:
    """The first complaint about a mistake; empty without one."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        folder = Path(name)
        if of_port(bug):
            try:
                image = port_program.build(folder, CLOCK_MHZ, {Path(bug.file).name: bug.text()}, _objects())
            except UsageError as error:
                return f"does not build: {str(error).splitlines()[0]}"
            return port_program.verdict(image, CLOCK_MHZ)
        model = _model(bug, folder)
        if found := port_program.verdict(_right_image(), CLOCK_MHZ, model):
            return f"port: {found}"
        return _first_failure(model)


def _key(bug: Bug, depended: str) -> str:
    return hashlib.sha256("\0".join((depended, bug.file, bug.old, bug.new)).encode()).hexdigest()[:16]


def run(chosen: Sequence[Bug], out: Path, jobs: int | None = None) -> int:
    """Plants mistakes; returns the exit code."""
    for bug in chosen:
        bug.text()
    build_model()
    depended = tasks.sources_digest(*_DEPENDS_ON)
    looks = [tasks.Task(_key(bug, depended), bug) for bug in chosen]
    found: dict[str, str] = {}
    with Progress(steps_of(len(looks), sys.stderr), sys.stderr, len(looks)) as progress:
        for task, finding in tasks.run(looks, look, out, jobs=jobs):
            found[task.arguments.name] = finding
            progress.item(task.arguments.name)
    print("| mistake | found by |\n| --- | --- |")
    wrong = []
    for bug in chosen:
        by = found[bug.name] or (", ".join(bug.found_by) if left_to_checklist(bug) else "MISSED")
        print(f"| {bug.name} | {by} |")
        if bool(found[bug.name]) == left_to_checklist(bug):
            wrong.append(bug.name)
    note: dict[str, Any] = {"commit": commit()}
    for kind, of_kind in (("port", True), ("model", False)):
        group = [bug for bug in chosen if of_port(bug) == of_kind]
        note[kind] = {"mistakes": len(group), "found": sum(bool(found[bug.name]) for bug in group),
                      "left_to_the_checklist": sorted(bug.name for bug in group if not found[bug.name])}
        print(f"{kind}: {note[kind]['found']} of {note[kind]['mistakes']} found")
    if len(chosen) == len(mistakes()):
        SUMMARY.write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    for name in wrong:
        print(f"not as the table has it: {name}")
    return 1 if wrong else 0


def main() -> int:
    """Plants the mistakes that are named."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.board_mistakes", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--only", nargs="+", default=[""], metavar="PART", help="those with one of these in their name")
    parser.add_argument("--out", type=Path, default=OUT / "board_mistakes", metavar="DIR",
                        help=f"default {OUT}/board_mistakes")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at once (default as many as cores)")
    parser.add_argument("--list", action="store_true", help="only name them")
    options = parser.parse_args()
    chosen = [bug for bug in mistakes() if any(part in bug.name for part in options.only)]
    if not chosen:
        raise UsageError(f"--only {' '.join(options.only)}: no mistake has this in its name; --list shows them")
    if options.list:
        print("\n".join(bug.name for bug in chosen))
        return 0
    return run(chosen, options.out, options.jobs)


if __name__ == "__main__":
    sys.exit(exit_code(main))
