"""Removes or weakens each protection of the drive and of its gate path, one at a time, and runs the tests that have to
notice it.

    python -m salient.experiments.protection_mutants [--list] [--only PART_OF_A_NAME]

tests/protection_mutants.toml has the mutants: each is a text in a file, which has to occur once, and what replaces it.
They are built and tested in a copy of the sources, build/mutants/. Results of equal sources are kept there, so that an
interrupted run continues. A run of all writes the page tests/PROTECTION_MUTANTS.md. Exit code 1 when a mutant survives
that has no reason for it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from salient.errors import UsageError, exit_code
from salient.paths import BUILD, ROOT

TABLE = ROOT / "tests" / "protection_mutants.toml"
PAGE = ROOT / "tests" / "PROTECTION_MUTANTS.md"
COPY = BUILD / "mutants"
RESULTS = COPY / "results.json"
COPIED = ("CMakeLists.txt", "CMakePresets.json", "cmake", "emulator", "firmware", "hal", "tests", "tools")
KEYS = {"protection", "change", "file", "old", "new", "tests", "survives"}


@dataclass(frozen=True)
class Mutant:
    """tests: programs of unit tests, with :SUITE.TEST for one of theirs, or node ids of pytest; the first that fails
    ends the run. survives: why no test notices it, "" when one has to."""

    protection: str
    change: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    survives: str = ""

    @property
    def name(self) -> str:
        """Name in the options and the page."""
        return f"{self.protection}: {self.change}"


def read_table(path: Path = TABLE) -> list[Mutant]:
    """The mutants; UsageError names an entry that is incomplete or has an unknown key."""
    mutants = []
    try:
        entries = tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    except (OSError, tomllib.TOMLDecodeError, KeyError) as error:
        raise UsageError(f"{path.name}: no table of mutants: {error}") from None
    for number, entry in enumerate(entries, 1):
        keys = set(entry)
        if keys - KEYS or (KEYS - {"survives"}) - keys:
            raise UsageError(f"{path.name}: mutant {number} has the keys {', '.join(sorted(keys))}: must be "
                             f"{', '.join(sorted(KEYS))}, of which survives may be missing")
        mutants.append(Mutant(**{**entry, "tests": tuple(entry["tests"])}))
    names = [mutant.name for mutant in mutants]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{path.name}: {name}: two mutants of this name")
    return mutants


def mutated(mutant: Mutant, root: Path = ROOT) -> str:
    """The text of its file with the mutation; UsageError when the old text does not occur exactly once."""
    path = root / mutant.file
    if not path.is_file():
        raise UsageError(f"{TABLE.name}: {mutant.name}: no file {mutant.file}")
    text = path.read_text(encoding="utf-8")
    count = text.count(mutant.old)
    if count != 1 or mutant.old == mutant.new:
        raise UsageError(f"{TABLE.name}: {mutant.name}: {mutant.file} has the old text {count} times: must be once, "
                         "and the new text another one")
    return text.replace(mutant.old, mutant.new)


def unit_test_source(program: str, root: Path = ROOT) -> Path | None:
    """Source of a program of unit tests, test_FOLDER_NAME or test_NAME."""
    unit = root / "tests" / "unit"
    of_folder = (unit / folder.name / f"test_{program.removeprefix(f'test_{folder.name}_')}.cpp"
                 for folder in unit.iterdir() if folder.is_dir() and program.startswith(f"test_{folder.name}_"))
    return next((path for path in (unit / f"{program}.cpp", *of_folder) if path.is_file()), None)


def check_tests(mutant: Mutant, root: Path = ROOT) -> None:
    """UsageError when a test of the mutant does not exist."""
    for test in mutant.tests:
        file, _, function = test.partition("::")
        if function:
            path = root / file
            found = path.is_file() and f"def {function.partition('[')[0]}(" in path.read_text(encoding="utf-8")
        else:
            program, _, name = test.partition(":")
            source = unit_test_source(program, root)
            found = source is not None and name.replace(".", ", ") in source.read_text(encoding="utf-8")
        if not found:
            raise UsageError(f"{TABLE.name}: {mutant.name}: no test {test}")
    if not mutant.tests and not mutant.survives:
        raise UsageError(f"{TABLE.name}: {mutant.name}: neither tests nor a reason")


# --- Build and run --------------------------------------------------------------------------------------------------


def _tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", *COPIED], cwd=ROOT,
                            capture_output=True, text=True, check=True)
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def _write(path: Path, content: bytes) -> None:
    """Writes what differs, so that the build sees no other changes."""
    if not path.is_file() or path.read_bytes() != content:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def _copy_sources() -> str:
    """Brings the copy up to date; returns the hash of what the tests depend on."""
    digest = hashlib.sha256()
    names = _tracked()
    for name in names:
        content = (ROOT / name).read_bytes()
        _write(COPY / name, content)
        (COPY / name).chmod((ROOT / name).stat().st_mode)
        if not name.endswith((".md", TABLE.name, Path(__file__).name)) and not name.startswith("tests/tools/"):
            digest.update(name.encode() + b"\0" + content)
    (COPY / "build").mkdir(exist_ok=True)
    venv = COPY / "build" / "venv"
    if not venv.exists():
        venv.symlink_to(BUILD / "venv")
    return digest.hexdigest()


def _run(command: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=COPY, env={**os.environ, **environment}, capture_output=True, text=True)


def _programs(mutants: list[Mutant]) -> list[str]:
    """Of unit tests, and the drive that the tests of pytest start."""
    tests = {test for mutant in mutants for test in mutant.tests}
    return sorted({"salient_host" if "::" in test else test.partition(":")[0] for test in tests})


def _build(mutants: list[Mutant]) -> str:
    """Builds what the tests need; returns the last line of the error, "" without one."""
    built = _run(["cmake", "--build", "build/host", "--target", *_programs(mutants)])
    return "" if built.returncode == 0 else (built.stdout.strip() or "build failed").splitlines()[-1]


def _first_failure(test: str) -> str:
    """Name of the first test that fails, "" when all pass; UsageError when the tests do not run."""
    if "::" in test:
        result = _run([str(COPY / "build/venv/bin/pytest"), "-q", "-x", "-p", "no:cacheprovider", test],
                      PYTHONPATH=str(COPY / "tools" / "src"))
        failed = re.search(r"^(?:FAILED|ERROR) (?:\S*/)?(\S+::.+?)(?: - .*)?$", result.stdout, re.MULTILINE)
    else:
        program, _, name = test.partition(":")
        result = _run([str(COPY / "build/host/bin" / program), "--gtest_brief=1", f"--gtest_filter={name or '*'}"])
        failed = re.search(r"^\[  FAILED  \] (\S+?)[,.]?(?: .*)?$", result.stdout, re.MULTILINE)
    if result.returncode == 0:
        return ""
    if "::" in test and result.returncode != 1:
        raise UsageError(f"{TABLE.name}: test {test} does not run")
    return f"`{failed[1]}`" if failed else f"`{test}` ends with code {result.returncode}"


def check_unchanged(mutants: list[Mutant], passed: set[str]) -> None:
    """UsageError when a test fails without a mutation: it would prove nothing. passed: tests that have passed."""
    tests = {test for mutant in mutants for test in mutant.tests} - passed
    error = _build(mutants) if tests else ""
    if error:
        raise UsageError(f"the unchanged sources do not build: {error}")
    for test in sorted(tests):
        failure = _first_failure(test)
        if failure:
            raise UsageError(f"without a mutation fails {failure}")
        passed.add(test)


def judge(mutant: Mutant) -> str:
    """The test that notices the mutant, "" when it survives."""
    path = COPY / mutant.file
    unchanged = path.read_bytes()
    try:
        path.write_text(mutated(mutant, COPY), encoding="utf-8")
        error = _build([mutant])
        if error:
            raise UsageError(f"{TABLE.name}: {mutant.name}: does not build: {error}")
        return next((failure for failure in map(_first_failure, mutant.tests) if failure), "")
    finally:
        path.write_bytes(unchanged)


# --- Results --------------------------------------------------------------------------------------------------------


def _key(mutant: Mutant, sources: str) -> str:
    parts = (sources, mutant.file, mutant.old, mutant.new, *mutant.tests)
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _commit() -> str:
    described = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    return described.stdout.strip()


def page(mutants: list[Mutant], killer_of: dict[str, str], commit: str) -> str:
    """Text of the page; killer_of: by name, "" of a survivor."""
    killed = sum(bool(killer) for killer in killer_of.values())
    lines = [
        "# Protections removed or weakened, and the tests that notice it", "",
        "<!-- Written by python -m salient.experiments.protection_mutants. -->", "",
        f"Each row is one build of the sources of `{commit}` with one change (`tests/protection_mutants.toml`), and",
        f"the first test that failed: {killed} of {len(killer_of)}. The others have their reason.", "",
        "| protection | mutation | in | noticed by |", "| --- | --- | --- | --- |",
    ]
    for mutant in (each for each in mutants if each.name in killer_of):
        noticed = killer_of[mutant.name] or f"survives: {mutant.survives or 'no test notices it'}"
        lines.append(f"| {mutant.protection} | {mutant.change} | `{Path(mutant.file).name}` | {noticed} |")
    return "\n".join(lines) + "\n"


def run(mutants: list[Mutant], *, of_all: bool) -> int:
    """Judges the mutants; writes the page when they are all; returns the exit code."""
    for mutant in mutants:
        mutated(mutant)
        check_tests(mutant)
    commit, sources = _commit(), _copy_sources()
    kept: dict[str, str] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    waiting = [mutant for mutant in mutants if _key(mutant, sources) not in kept]
    waiting.sort(key=lambda mutant: sum("::" in test for test in mutant.tests))  # the quick ones first
    if waiting:
        configured = _run(["cmake", "--preset", "host"])
        if configured.returncode != 0:
            raise UsageError(f"{COPY}: cmake --preset host fails")
    passed: set[str] = set()
    for number, mutant in enumerate(waiting, 1):
        check_unchanged([mutant], passed)
        kept[_key(mutant, sources)] = killer = judge(mutant)
        RESULTS.write_text(json.dumps(kept))
        print(f"{number}/{len(waiting)} {mutant.name}: {killer or 'survives'}", flush=True)
    killer_of = {mutant.name: kept[_key(mutant, sources)] for mutant in mutants}
    if of_all:
        PAGE.write_text(page(mutants, killer_of, commit), encoding="utf-8")
    survivors = [mutant for mutant in mutants if not killer_of[mutant.name] and not mutant.survives]
    for mutant in survivors:
        print(f"survives: {mutant.name}")
    return 1 if survivors else 0


def main() -> int:
    """Runs the mutants that are named."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.protection_mutants", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="only name the mutants")
    parser.add_argument("--only", metavar="PART", help="mutants whose name has this part; the page is not written")
    options = parser.parse_args()
    every = read_table()
    mutants = [mutant for mutant in every if options.only is None or options.only in mutant.name]
    if not mutants:
        raise UsageError(f"--only {options.only}: no mutant has this in its name; --list shows them")
    if options.list:
        print("\n".join(mutant.name for mutant in mutants))
        return 0
    return run(mutants, of_all=options.only is None)


if __name__ == "__main__":
    sys.exit(exit_code(main))
