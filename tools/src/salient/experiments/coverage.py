"""Coverage of the firmware's sources by the unit tests: lines, branches, and conditions that decide by themselves.

    python -m salient.experiments.coverage [--open [PART ...]] [--write] [--out DIR]

compiles the sources of firmware/ with the counters of clang 19, links the unit tests of the host build with them, and
runs these. A condition is covered by modified condition/decision coverage (MC/DC; RTCA DO-178C): two evaluations
of its decision differ in it and in the result, and in no other condition that was evaluated. Only the operators && and
|| make decisions; single conditions are branches. Inline functions of headers are counted nowhere: the tests compile
them themselves.

tests/coverage.json has the committed counts, and those that are open in each file. Exit code 1 when more is open in
a file than there: a figure does not fall. --write commits the present ones. Conditions, branches and lines that no unit
test can or has to reach are in tests/coverage.toml, "FILE: TEXT OF THE LINE", each with its reason, and are not
open. --open lists what is, of files with a part in their path.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from salient.errors import UsageError, exit_code
from salient.exceptions import read_exceptions
from salient.experiments import planted
from salient.experiments.campaign.runner import commit
from salient.paths import BUILD, OUT, ROOT

COMMITTED = ROOT / "tests" / "coverage.json"
EXCEPTIONS = ROOT / "tests" / "coverage.toml"
HOST = BUILD / "host"
COMPILER, MERGE, READ = "clang-19", "llvm-profdata-19", "llvm-cov-19"
RUNTIME = Path("/usr/lib/llvm-19/lib/clang/19/lib/linux/libclang_rt.profile-x86_64.a")
KINDS = ("lines", "branches", "conditions")
_COUNTERS = ("-O1", "-fprofile-instr-generate", "-fcoverage-mapping", "-fcoverage-mcdc", "-w")
_NOT_CLANG = ("-O", "-flto", "-ffat", "-falign", "-ffile-prefix", "-W", "-g")
_LIBRARY = "firmware/libsalient_firmware.a"
_OTHER_TESTS = re.compile(r"test_(plant|rig|host)_|_(finite_element|linear_cosine|linear_trapezoid)$")
"""Programs that test no firmware, or the same with another machine."""
_CORES = len(os.sched_getaffinity(0))

Open = dict[str, list[tuple[int, str]]]
"""Numbers and texts of lines by kind: one for each line, branch or condition that is open there."""


@dataclass
class Coverage:
    """Counts of a file: covered ones and all by kind, and what is not covered, explained or not."""

    covered: dict[str, int]
    count: dict[str, int]
    missed: Open = field(default_factory=dict)

    def unexplained(self, file: str, exceptions: Mapping[str, str]) -> Open:
        """Open ones: those without a reason."""
        return {kind: [each for each in self.missed.get(kind, []) if f"{file}: {each[1]}" not in exceptions]
                for kind in KINDS}


# --- Measure --------------------------------------------------------------------------------------------------------

def _run(line: list[str], **options: Any) -> str:
    done = subprocess.run(line, cwd=HOST, capture_output=True, text=True, check=False, **options)
    if done.returncode != 0:
        raise UsageError(f"{shlex.join(line[:3])} fails: {(done.stdout + done.stderr).strip()[-2000:]}")
    return str(done.stdout)


def _compile(line: str, folder: Path) -> Path:
    """The object of a line of the build's, with counters."""
    _, *options = (part for part in shlex.split(line) if not part.startswith(_NOT_CLANG))
    out = options.index("-o") + 1
    made = folder / options[out].partition(".dir/")[2].replace("/", "_")
    options[out] = str(made)
    _run([COMPILER, *_COUNTERS, *options])
    return made


def _library(folder: Path, pool: ThreadPoolExecutor) -> tuple[Path, Path]:
    """The firmware with counters: as a library, and as the program from which they are read."""
    lines = [entry["command"] for entry in json.loads((HOST / "compile_commands.json").read_text(encoding="utf-8"))
             if "/salient_firmware.dir/" in entry["command"]]
    objects = list(pool.map(lambda line: _compile(line, folder), lines))
    library, whole = folder / "libsalient_firmware.a", folder / "firmware.so"
    _run(["ar", "rcs", str(library), *map(str, objects)])
    _run(["gcc", "-shared", "-nostdlib", "-o", str(whole), *map(str, objects)])
    return library, whole


def _tests() -> dict[str, list[str]]:
    """Programs that are counted, each with the line that links it."""
    programs = [path.name for path in (HOST / "bin").glob("test_*")
                if planted.unit_source(path.name) and not _OTHER_TESTS.search(path.name)]
    commands = _run(["ninja", "-t", "commands", *programs])
    links = {}
    for part in re.split(r" && |\n", commands):
        found = re.search(r" -o bin/(test_\w+) ", part)
        if found:
            links[found[1]] = shlex.split(part)
    return links


def _count(program: str, link: list[str], library: Path, folder: Path) -> None:
    """Links and runs a program of tests."""
    out = folder / program
    link = [str(library) if part == _LIBRARY else str(out) if part == f"bin/{program}" else part for part in link]
    _run([*link, str(RUNTIME), "-Wl,-u,__llvm_profile_runtime", "-fno-lto"])
    _run([str(out), "--gtest_brief=1"], env={**os.environ, "LLVM_PROFILE_FILE": f"{out}.profraw"})
    out.unlink()


def measure(out: Path) -> dict[str, Coverage]:
    """Coverage of each source of firmware/, by its name."""
    if not RUNTIME.exists():
        raise UsageError(f"{RUNTIME}: no such file: apt-get install libclang-rt-19-dev")
    planted.build_unchanged([])
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    with ThreadPoolExecutor(_CORES) as pool:
        library, whole = _library(out, pool)
        # Those that take longest are not the last ones: tests of the storage, then of the drive.
        for done in [pool.submit(_count, name, link, library, out)
                     for name, link in sorted(_tests().items(), key=lambda test: "storage" not in test[0])]:
            done.result()
    profile = out / "all.profdata"
    _run([MERGE, "merge", "-sparse", *map(str, out.glob("*.profraw")), "-o", str(profile)])
    read = [READ, "export", str(whole), f"-instr-profile={profile}"]
    return _read(json.loads(_run(read))["data"][0]["files"], _run([*read, "-format=lcov"]))


def _read(files: list[dict[str, Any]], lcov: str) -> dict[str, Coverage]:
    missed_lines = _missed_lines(lcov)
    found = {}
    for entry in files:
        path = Path(entry["filename"])
        if path.suffix != ".c" or not path.is_relative_to(ROOT / "firmware"):
            continue
        text = path.read_text(encoding="utf-8").splitlines()
        summary = dict(zip(KINDS, (entry["summary"][name] for name in ("lines", "branches", "mcdc")), strict=True))
        # A record of conditions tells of each whether it is covered, in their order and not where they are.
        numbers = {"lines": missed_lines.get(str(path), []), "branches": list(_missed_branches(entry["branches"])),
                   "conditions": [record[0] for record in entry["mcdc_records"] for good in record[-1] if not good]}
        found[str(path.relative_to(ROOT))] = Coverage(
            {kind: summary[kind]["covered"] for kind in KINDS}, {kind: summary[kind]["count"] for kind in KINDS},
            {kind: [(number, text[number - 1].strip()) for number in sorted(numbers[kind])] for kind in KINDS})
    return found


def _missed_lines(lcov: str) -> dict[str, list[int]]:
    missed: dict[str, list[int]] = {}
    for section in lcov.split("end_of_record"):
        file = re.search(r"^SF:(.*)$", section, re.MULTILINE)
        if file:
            missed[file[1]] = [int(number) for number in re.findall(r"^DA:(\d+),0$", section, re.MULTILINE)]
    return missed


def _missed_branches(branches: list[list[int]]) -> Iterator[int]:
    """Numbers of the lines. A branch of an inline function, or of a macro, has a row for each place."""
    taken: Counter[tuple[int, int, bool]] = Counter()
    for line, column, _, _, true, false, *_ in branches:
        taken[line, column, True] += true
        taken[line, column, False] += false
    yield from (line for (line, _, _), number in taken.items() if number == 0)


# --- Judge ----------------------------------------------------------------------------------------------------------

def note_of(found: Mapping[str, Coverage], exceptions: Mapping[str, str]) -> dict[str, Any]:
    """Counts that are committed."""
    note: dict[str, Any] = {"commit": commit()}
    for kind in KINDS:
        covered = sum(each.covered[kind] for each in found.values())
        count = sum(each.count[kind] for each in found.values())
        note[kind] = {"covered": covered, "count": count, "percent": round(100 * covered / count, 1)}
    opens = {file: {kind: len(lines) for kind, lines in each.unexplained(file, exceptions).items() if lines}
             for file, each in sorted(found.items())}
    note["open"] = {file: counts for file, counts in opens.items() if counts}
    return note


def falls(note: Mapping[str, Any], committed: Mapping[str, Any]) -> list[str]:
    """A line for each file and kind of which more is open than committed."""
    lines = []
    for file, counts in note["open"].items():
        for kind, number in counts.items():
            before = committed["open"].get(file, {}).get(kind, 0)
            if number > before:
                lines.append(f"{file}: {number} {kind} open, {before} committed")
    return lines


def not_needed(found: Mapping[str, Coverage], exceptions: Mapping[str, str]) -> list[str]:
    """Exceptions of what is covered, or not in its file."""
    missed = {f"{file}: {text}" for file, each in found.items() for lines in each.missed.values() for _, text in lines}
    return [f"{name}: an exception of {EXCEPTIONS.name} that is not needed" for name in exceptions
            if name not in missed]


def _print_open(found: Mapping[str, Coverage], exceptions: Mapping[str, str], parts: list[str]) -> None:
    for file, each in sorted(found.items()):
        if any(part in file for part in parts):
            for kind, lines in each.unexplained(file, exceptions).items():
                for (number, text), times in Counter(lines).items():
                    print(f"{file}:{number}: {times} {kind}: {text}")


def main() -> int:
    """Measures, judges or writes; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.coverage", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--open", nargs="*", metavar="PART", help="list what is open")
    parser.add_argument("--write", action="store_true", help=f"write {COMMITTED.relative_to(ROOT)}")
    parser.add_argument("--out", type=Path, default=OUT / "coverage", metavar="DIR", help=f"default {OUT}/coverage")
    options = parser.parse_args()
    exceptions = read_exceptions(EXCEPTIONS)
    found = measure(options.out.resolve())
    note = note_of(found, exceptions)
    if options.open is not None:
        _print_open(found, exceptions, options.open or [""])
    for kind in KINDS:
        print(f"{kind}: {note[kind]['covered']} of {note[kind]['count']}, {note[kind]['percent']} %")
    lines = not_needed(found, exceptions)
    if options.write:
        COMMITTED.write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")
    else:
        lines += falls(note, json.loads(COMMITTED.read_text(encoding="utf-8")))
    for line in lines:
        print(line)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
