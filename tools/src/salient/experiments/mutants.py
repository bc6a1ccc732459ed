"""Mutants of the firmware: its C sources changed by operators, one place at a time, and whether unit tests notice.

    python -m salient.experiments.mutants [--file PART ...] [--per-file N] [--seed S] [--out DIR] [--list]

The operators are from DeMillo, Lipton and Sayward ("Hints on test data selection", IEEE Computer 11(4), 1978) as
far as C of this kind has a use for them (OPERATORS). Of the places in a file a sample is drawn by the seed, so that
another seed judges others; without --per-file all. A mutant is compiled and linked as a planted bug is (planted.py),
and judged by the unit tests of its module, by those that include its header, by its family (tests in the same folder
whose names begin with the same word, as the tests of CANopen), and by tests/unit/test_drive.cpp:

    killed        a test fails, or takes more than TEST_MAX_S
    equivalent    the compiler makes the same code of it
    invalid       the compiler refuses it
    survived      no test notices

tests/mutants.toml has survivors that are known, each with the reason why no test can or has to notice it; one that a
test kills meanwhile is named. DIR/runs.jsonl keeps the results, so that an interrupted run goes on; DIR/summary.json
has the counts, which a run of all files also writes to tests/mutants.json. Exit code 1 when one survives that is not
known.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from salient.errors import UsageError, exit_code
from salient.exceptions import read_exceptions
from salient.experiments import planted, tasks
from salient.experiments.campaign.runner import commit
from salient.paths import BUILD, OUT, ROOT
from salient.progress import Progress, steps_of

KNOWN = ROOT / "tests" / "mutants.toml"
SUMMARY = ROOT / "tests" / "mutants.json"
TEST_MAX_S = 60
"""CPU time of a program of tests, several times the slowest one's."""
KILLED, EQUIVALENT, INVALID, SURVIVED = "killed", "equivalent", "invalid", "survived"
_WHOLE_DRIVE = "test_drive"

OPERATORS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("relation", r"(?<![-<>=!])(?:<=|>=|<|>)(?![<>=])|[=!]=", {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=",
                                                              "!=": "=="}),
    ("logic", r"&&|\|\|", {"&&": "||", "||": "&&"}),
    ("sum", r"(?<= )[-+](?= )|[-+]=", {"+": "-", "-": "+", "+=": "-=", "-=": "+="}),
    ("shift", r"(?<= )(?:<<|>>)(?= )", {"<<": ">>", ">>": "<<"}),
    ("bits", r"(?<= )[&|](?= )", {"&": "|", "|": "&"}),
    ("truth", r"\b(?:true|false)\b", {"true": "false", "false": "true"}),
    ("number", r"(?<![\w.])\d+(?=[uUlL]*\b)(?!\.)", {}),
    ("condition", r"(?<=if )\((?=.*\) \{$)", {}),
    ("statement", r"(?<=^    )[ ]*[a-z_][\w.\[\]>*-]*(?: [-+|&^]?=[^=].*|\(.*\));$", {}),
)
"""Name, pattern within a line, and what takes the place of the text. A number becomes the next one, a condition its
negation, a statement is left out."""


@dataclass(frozen=True)
class Mutant(planted.Bug):
    """A bug at an offset of its file, where `old` may occur more than once."""

    offset: int = 0
    table: Path = KNOWN

    def text(self) -> str:
        """Its file with the mutant."""
        text = (ROOT / self.file).read_text(encoding="utf-8")
        return text[:self.offset] + self.new + text[self.offset + len(self.old):]


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match[0])


def _code(text: str) -> str:
    """A source with spaces for comments, strings and directives other than #define, and with the same offsets."""
    return re.sub(r'/\*.*?\*/|"(?:\\.|[^"\\\n])*"|^#(?!define)[^\n]*', _blank, text, flags=re.DOTALL | re.MULTILINE)


def _closing(line: str, at: int) -> int:
    """Index after the parenthesis that closes the one at an index; -1 when it is on another line."""
    depth = 0
    for index in range(at, len(line)):
        depth += {"(": 1, ")": -1}.get(line[index], 0)
        if depth == 0:
            return index + 1
    return -1


def _changes(line: str) -> Iterator[tuple[int, str, str]]:
    """Index, text and new text of each mutant of a line."""
    for name, pattern, new in OPERATORS:
        for match in re.finditer(pattern, line):
            old, at = match[0], match.start()
            if name == "number":
                yield at, old, str(int(old, 8 if old.startswith("0") else 10) + 1)
            elif name == "condition":
                end = _closing(line, at)
                if end > 0:
                    yield at, line[at:end], f"(!{line[at:end]})"
            elif name == "statement":
                yield at, old, f"{' ' * (len(old) - len(old.lstrip()))};"
            else:
                yield at, old, new[old]


def mutants(file: str, root: Path | None = None) -> list[Mutant]:
    """All of a source of a checkout (ROOT), in its order. Names are the changes', with a number where a line repeats
    itself."""
    text = ((root or ROOT) / file).read_text(encoding="utf-8")
    offset, found, names = 0, [], Counter[str]()
    for line in _code(text).split("\n"):
        for at, old, new in _changes(line):
            shown = line.strip()
            before, after = line[:at].strip(), line[at + len(old):].strip()
            changed = f"{before} [{old.strip()} -> {new.strip()}] {after}".strip() if len(old) < len(shown) else \
                f"[{shown} -> {new.strip()}]"
            name = f"{file}: {changed}"
            names[name] += 1
            if names[name] > 1:
                name += f" ({names[name]})"
            found.append(Mutant(name, file, old, new, finders(file), offset=offset + at))
        offset += len(line) + 1
    return found


@cache
def finders(file: str) -> tuple[str, ...]:
    """Programs of unit tests that judge a source: its own, those that include its header, its family (same folder, same
    first word), the whole drive."""
    header = file.partition("/")[2].removesuffix(".c") + ".h"
    own = "test_" + header.removesuffix(".h").replace("/", "_")
    folder, _, name = header.removesuffix(".h").rpartition("/")
    found = [planted.unit_program(path) for path in sorted(planted.UNIT.rglob("test_*.cpp"))
             if f'#include "{header}"' in path.read_text(encoding="utf-8")]
    family = [planted.unit_program(path) for path in sorted((planted.UNIT / folder).glob("test_*.cpp"))
              if path.stem.split("_")[1] == name.partition("_")[0]]
    built = _built()
    return tuple(dict.fromkeys(program for program in (own, *found, *family, _WHOLE_DRIVE) if program in built))


@cache
def _built() -> frozenset[str]:
    """Programs of unit tests in the build folder."""
    return frozenset(path.name for path in (BUILD / "host" / "bin").glob("test_*"))


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (TEST_MAX_S, TEST_MAX_S))


def judge(mutant: Mutant) -> dict[str, str]:
    """State of a mutant, and the program that kills it."""
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        for finder in mutant.found_by:
            try:
                (program,) = planted.build(mutant, Path(folder), finder)
            except UsageError as error:
                if "is no part of" in str(error):
                    continue
                return {"state": INVALID, "by": ""}
            if finder == mutant.found_by[0] and _same_code(mutant, Path(folder), finder):
                return {"state": EQUIVALENT, "by": ""}
            done = subprocess.run([program, "--gtest_brief=1", "--gtest_fail_fast"], cwd=ROOT, capture_output=True,
                                  preexec_fn=_limit, check=False)
            if done.returncode != 0:
                return {"state": KILLED, "by": finder}
    return {"state": SURVIVED, "by": ""}


def _same_code(mutant: Mutant, folder: Path, target: str) -> bool:
    """The compiler makes the same instructions and data of the source with and without the mutant."""
    made = []
    for place in (folder / mutant.file.partition("/")[2], ROOT / mutant.file):
        out = folder / "code.o"
        line = planted.compiling(mutant, ROOT / mutant.file, target)
        done = subprocess.run([line[0], f"-I{folder}", *line[1:], "-g0", "-fno-lto", "-o", out, "-c", place],
                              cwd=BUILD / "host", capture_output=True, check=False)
        if done.returncode != 0:
            return False
        listed = subprocess.run(["objdump", "-s", "-d", "-r", out], capture_output=True, text=True, check=True).stdout
        made.append(listed)
    return made[0] == made[1]


def drawn(files: Sequence[str], per_file: int | None, seed: int) -> list[Mutant]:
    """That many of each file, by the seed, in the order of the file."""
    chosen: list[Mutant] = []
    for file in files:
        every = mutants(file)
        if per_file is None or per_file >= len(every):
            chosen += every
        else:
            numbers = random.Random(f"{seed} {file}").sample(range(len(every)), per_file)
            chosen += [every[number] for number in sorted(numbers)]
    return chosen


def summary(found: Sequence[tuple[Mutant, dict[str, str]]], known: dict[str, str], seed: int,
            per_file: int | None) -> dict[str, Any]:
    """Counts, and the survivors by name."""
    states = Counter(result["state"] for _, result in found)
    survivors = [mutant.name for mutant, result in found if result["state"] == SURVIVED]
    return {
        "commit": commit(), "seed": seed, "per_file": per_file or "all", "files": len({each.file for each, _ in found}),
        "mutants": states[KILLED] + states[SURVIVED], KILLED: states[KILLED], EQUIVALENT: states[EQUIVALENT],
        INVALID: states[INVALID], SURVIVED: len(survivors),
        "known": [name for name in survivors if name in known],
        "unknown": [name for name in survivors if name not in known],
        "known_and_killed": [mutant.name for mutant, result in found
                             if mutant.name in known and result["state"] != SURVIVED],
    }


def run(chosen: Sequence[Mutant], out: Path, seed: int, per_file: int | None) -> dict[str, Any]:
    """Judges mutants; returns the summary, which is also in the folder."""
    known = read_exceptions(KNOWN)
    sources = planted.sources("unit")
    looks = [tasks.Task(hashlib.sha256(f"{sources} {mutant.name}".encode()).hexdigest()[:16], mutant)
             for mutant in chosen]
    found = []
    with Progress(steps_of(len(looks), sys.stderr), sys.stderr, len(looks)) as progress:
        for task, result in tasks.run(looks, judge, out):
            found.append((task.arguments, result))
            progress.item(f"{result['state']}: {task.arguments.name}")
    found.sort(key=lambda item: (item[0].file, item[0].offset))
    note = summary(found, known, seed, per_file)
    (out / "summary.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    return note


def main() -> int:
    """Judges the mutants that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.mutants", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--file", nargs="+", default=[""], metavar="PART",
                        help="sources with one of these in their path")
    parser.add_argument("--per-file", type=int, metavar="N", help="of each source, drawn by the seed (default all)")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--out", type=Path, default=OUT / "mutants", metavar="DIR", help=f"default {OUT}/mutants")
    parser.add_argument("--list", action="store_true", help="only name the mutants")
    options = parser.parse_args()
    files = [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "firmware").rglob("*.c"))]
    named = [file for file in files if any(part in file for part in options.file)]
    planted.build_unchanged([])  # the programs that judge are in the build folder
    chosen = drawn(named, options.per_file, options.seed)
    if not chosen:
        raise UsageError(f"--file {' '.join(options.file)}: no source of firmware/ has this in its path")
    if options.list:
        print("\n".join(mutant.name for mutant in chosen))
        return 0
    note = run(chosen, options.out, options.seed, options.per_file)
    if named == files:
        SUMMARY.write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    for name in note["unknown"]:
        print(f"survived: {name}")
    for name in note["known_and_killed"]:
        print(f"no longer a survivor, to be removed from {KNOWN.name}: {name}")
    print(f"{note['mutants']} mutants of {note['files']} sources: {note[KILLED]} killed, {len(note['known'])} known "
          f"survivors, {len(note['unknown'])} others; {note[EQUIVALENT]} equivalent, {note[INVALID]} invalid")
    return 1 if note["unknown"] or note["known_and_killed"] else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
