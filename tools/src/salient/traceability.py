"""Requirements of firmware/requirements.toml, and who implements, tests and judges each, by marks in the sources.

A mark is [SR-01], one or more in a comment, before the text or after it:

    of a C file      in its first comment, for the whole file; in the comment that ends where a function or a row of a
                     .def file begins, for that one
    of a test file   likewise for a TEST of C++ and a test function of Python (comment lines above its decorators, or
                     the module's docstring). A mark of a test's own replaces the file's
    of a checker     in its first comment

The functions are in IMPLEMENTATIONS, the checkers in emulator/campaign/checkers. A planted bug (tests/planted.toml) and
a mutant that is known to survive (tests/mutants.toml) belong to the requirements of the function that they change; a
bug whose name begins with one of the `faults` of some requirement, to those alone that have it.

The style step (salient.test_runner) fails when a requirement has no implementation or no test, when a mark is of an
unknown requirement or belongs to nothing, and when a test of the safety part (SAFETY_PART) has no mark.
"""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from salient import c_text
from salient.exceptions import read_exceptions
from salient.experiments import mutants, planted
from salient.paths import ROOT

FILE = Path("firmware") / "requirements.toml"
"""In the repository."""
IMPLEMENTATIONS = ("firmware", "hal", "emulator/rig")
CHECKERS = Path("emulator") / "campaign" / "checkers"
TESTS = ("tests/unit", "tests/hil", "tests/target")
SAFETY_PART = (
    "tests/unit/monitors/test_*.cpp", "tests/unit/storage/test_*.cpp", "tests/unit/interrupts/test_self_test.cpp",
    "tests/unit/interrupts/test_state_machine.cpp", "tests/unit/interrupts/test_supervise.cpp",
    "tests/unit/comms/test_bus_monitor.cpp", "tests/unit/comms/test_commands.cpp", "tests/unit/comms/test_e2e.cpp",
    "tests/unit/rig/test_gate_path.cpp",
    *(f"tests/hil/test_{name}.py" for name in (
        "arming", "bus_faults", "degraded_running", "encoder_faults", "gate_path", "hostile_clients", "phase_monitor",
        "protections", "self_test", "stall", "start_inhibit", "temperature", "thermal", "watchdog")))
"""Patterns of the test files, each of whose tests has a requirement."""

_MARK = re.compile(r"\[(SR-\d\d)\]")
_C_FUNCTION = re.compile(r"\s*[A-Za-z_][^;{}=#/]*?\b(?P<name>\w+)\([^;{}]*\)\s*\{")
_C_FUNCTIONS = re.compile(r"^[A-Za-z_][^;{}=#/()]*?\b(?P<name>\w+)\([^;{}]*\)\s*\{.*?^\}", re.MULTILINE | re.DOTALL)
_DEF_ROW = re.compile(r"\s*[A-Z_]+\((?P<name>\w+),")
_TEST = re.compile(r"\s*TEST(?:_F|_P)?\(\s*(?P<suite>\w+),\s*(?P<name>\w+)\)")
_TESTS = re.compile(r"^TEST(?:_F|_P)?\(\s*(?P<suite>\w+),\s*(?P<name>\w+)\)", re.MULTILINE)
_PYTHON_TEST = re.compile(r"(?P<comment>(?:^#[^\n]*\n)*)(?:^@(?:[^\n]*\n)(?:^[ )\]][^\n]*\n)*)*"
                          r"^def (?P<name>test_\w+)\(", re.MULTILINE)
_PYTHON_COMMENT = re.compile(r"^#[^\n]*(?:\n#[^\n]*)*", re.MULTILINE)


@dataclass(frozen=True)
class Requirement:
    """A table of the file. faults: see there."""

    name: str
    function: str
    hazards: tuple[str, ...]
    text: str
    faults: tuple[str, ...] = ()


@dataclass
class Trace:
    """Places of a requirement: names of functions ("" for the whole file) and of tests by file, checkers, names of
    planted bugs, and of mutants that survive."""

    functions: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    tests: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    checkers: list[str] = field(default_factory=list)
    bugs: list[str] = field(default_factory=list)
    survivors: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Marked:
    """Something that can have marks. names: of requirements; own: not the file's. line: of the mark or the thing."""

    file: str
    name: str
    names: tuple[str, ...]
    line: int


@dataclass(frozen=True)
class Table:
    """The whole file. functions: term, name and what it does of each safety function."""

    hazards: dict[str, str]
    functions: dict[str, dict[str, str]]
    requirements: dict[str, Requirement]


def read(root: Path = ROOT) -> Table:
    """The requirements of a checkout."""
    tables: dict[str, Any] = tomllib.loads((root / FILE).read_text(encoding="utf-8"))
    return Table(tables["hazard"], tables["function"], {
        name: Requirement(name, row["function"], tuple(row["hazards"]), row["text"], tuple(row.get("faults", ())))
        for name, row in tables["requirement"].items()})


def _line(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1


def _marks(text: str) -> tuple[str, ...]:
    return tuple(_MARK.findall(text))


def _files(root: Path, folders: tuple[str, ...], suffixes: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Names and texts."""
    for path in sorted(path for folder in folders for path in (root / folder).rglob("*") if path.suffix in suffixes):
        yield str(path.relative_to(root)), path.read_text(encoding="utf-8")


def in_c(file: str, text: str) -> Iterator[Marked]:
    """Marks of a C or .def file: of functions, of rows, and of the file, whose name is "". One that belongs to nothing
    has the name "?"."""
    row = _DEF_ROW if file.endswith(".def") else _C_FUNCTION
    for comment in (found for found in c_text.TOKEN.finditer(text) if found["comment"]):
        names = _marks(comment["comment"])
        if names:
            after = row.match(text, comment.end())
            name = "" if comment.start() == 0 else after["name"] if after else "?"
            yield Marked(file, name, names, _line(text, comment.start()))


def in_tests(file: str, text: str) -> Iterator[Marked]:
    """Tests of a C++ or Python file with their marks, and marks that belong to nothing, with the name "?"."""
    python = file.endswith(".py")
    head, comments = _comments(text, python=python)
    whole = _marks(head)
    tests = {found.start("name"): found for found in (_PYTHON_TEST if python else _TESTS).finditer(text)}
    own: dict[int, tuple[str, ...]] = {}
    for comment in comments:
        names = _marks(comment.group())
        if not names:
            continue
        after = _python_test_after(text, comment.end()) if python else _TEST.match(text, comment.end())
        if after:
            own[after.start("name")] = names
        else:
            yield Marked(file, "?", names, _line(text, comment.start()))
    for at, found in tests.items():
        name = found["name"] if python else f"{found['suite']}.{found['name']}"
        yield Marked(file, name, own.get(at, whole), _line(text, at))


def _comments(text: str, *, python: bool) -> tuple[str, list[re.Match[str]]]:
    """The text of the head of a file, and the other comments."""
    if python:
        head = re.match(r'"""[\s\S]*?"""|(?:#[^\n]*\n)*', text)
        at = head.end() if head else 0
        return text[:at], [found for found in _PYTHON_COMMENT.finditer(text) if found.start() >= at]
    comments = [found for found in c_text.TOKEN.finditer(text) if found["comment"]]
    has_head = bool(comments) and comments[0].start() == 0
    return (comments[0].group() if has_head else ""), comments[has_head:]


def _python_test_after(text: str, at: int) -> re.Match[str] | None:
    """The test whose decorators or definition begin after a comment."""
    return _PYTHON_TEST.match(text, at + 1)


def functions_at(text: str) -> list[tuple[int, int, str]]:
    """First and last offset, and name, of each function of a C file."""
    return [(found.start(), found.end(), found["name"]) for found in _C_FUNCTIONS.finditer(text)]


def every_test(root: Path = ROOT) -> list[Marked]:
    """All tests, and marks in their files that belong to nothing."""
    return [marked for file, text in _files(root, TESTS, (".cpp", ".py")) if Path(file).name.startswith("test_")
            for marked in in_tests(file, text)]


def implementations(root: Path = ROOT) -> list[Marked]:
    """Marks of functions and files."""
    return [marked for file, text in _files(root, IMPLEMENTATIONS, (".c", ".h", ".def")) for marked in in_c(file, text)]


def checkers(root: Path = ROOT) -> list[Marked]:
    """Marks of checkers of the campaign, whose names are their files'."""
    return [Marked(file, Path(file).stem if marked.name == "" else "?", marked.names, marked.line)
            for file, text in _files(root, (str(CHECKERS),), (".c",)) for marked in in_c(file, text)]


def _changed(marked: list[Marked]) -> dict[tuple[str, str], tuple[str, ...]]:
    """Names of requirements by file and function."""
    by: dict[tuple[str, str], tuple[str, ...]] = {}
    for each in marked:
        by[each.file, each.name] = by.get((each.file, each.name), ()) + each.names
    return by


def _owners(file: str, text: str, at: int, by: dict[tuple[str, str], tuple[str, ...]]) -> tuple[str, ...]:
    """Requirements of the function, or row, at a place; else of the file."""
    for first, last, name in functions_at(text):
        if first <= at < last:
            return by.get((file, name), by.get((file, ""), ()))
    return by.get((file, ""), ())


@dataclass(frozen=True)
class Sources:
    """Marked functions and files, all tests, marked checkers of a checkout."""

    implementations: list[Marked]
    tests: list[Marked]
    checkers: list[Marked]


def read_sources(root: Path = ROOT) -> Sources:
    """Reads a checkout's sources."""
    return Sources(implementations(root), every_test(root), checkers(root))


def places(table: Table, sources: Sources) -> dict[str, Trace]:
    """Functions, tests and checkers of each requirement by its name; unknown ones are left out."""
    traces = {name: Trace() for name in table.requirements}
    for each in sources.implementations:
        for name in each.names:
            if name in traces:
                traces[name].functions[each.file].append(each.name)
    for each in sources.tests:
        for name in each.names:
            if name in traces and each.name != "?":
                traces[name].tests[each.file].append(each.name)
    for each in sources.checkers:
        for name in each.names:
            if name in traces:
                traces[name].checkers.append(each.name)
    return traces


def trace(root: Path = ROOT) -> dict[str, Trace]:
    """All places of each requirement by its name; unknown ones are left out."""
    table, sources = read(root), read_sources(root)
    traces = places(table, sources)
    by = _changed(sources.implementations)
    _add_bugs(root, table, by, traces)
    _add_survivors(root, by, traces)
    return traces


def _add_bugs(root: Path, table: Table, by: dict[tuple[str, str], tuple[str, ...]], traces: dict[str, Trace]) -> None:
    known = tuple(f"{fault}:" for requirement in table.requirements.values() for fault in requirement.faults)
    for bug in planted.bugs(root / planted.TABLE.relative_to(ROOT)):
        text = (root / bug.file).read_text(encoding="utf-8")
        claims, _, rest = bug.name.partition(":")
        names = [f"{claim}:{rest}:" for claim in claims.split(", ")]
        told = any(each.startswith(known) for each in names)
        for name in dict.fromkeys(_owners(bug.file, text, text.find(bug.old), by)):
            own = tuple(f"{fault}:" for fault in table.requirements[name].faults) if name in traces else ()
            if name in traces and (not told or any(each.startswith(own) for each in names)):
                traces[name].bugs.append(bug.name)


def _add_survivors(root: Path, by: dict[tuple[str, str], tuple[str, ...]], traces: dict[str, Trace]) -> None:
    known = read_exceptions(root / mutants.KNOWN.relative_to(ROOT))
    for file in dict.fromkeys(survivor.partition(": ")[0] for survivor in known):
        text = (root / file).read_text(encoding="utf-8")
        for mutant in (each for each in mutants.mutants(file, root) if each.name in known):
            for name in dict.fromkeys(_owners(file, text, mutant.offset, by)):
                if name in traces:
                    traces[name].survivors.append(mutant.name)


def _unknown(table: Table, marked: list[Marked]) -> Iterator[str]:
    for each in marked:
        for name in each.names:
            if name not in table.requirements:
                yield f"{each.file}:{each.line}: [{name}]: no requirement of {FILE}"
        if each.name == "?":
            yield f"{each.file}:{each.line}: {', '.join(each.names)}: belongs to no function, test or row"


def _in_safety_part(file: str) -> bool:
    return any(Path(file).match(pattern) for pattern in SAFETY_PART)


def violations(root: Path = ROOT) -> list[str]:
    """One line for each breach of a rule; see above."""
    table, sources = read(root), read_sources(root)
    lines = list(_unknown(table, [*sources.implementations, *sources.tests, *sources.checkers]))
    lines += [f"{each.file}:{each.line}: {each.name}: a test of the safety part without a requirement"
              for each in sources.tests if not each.names and _in_safety_part(each.file)]
    found = places(table, sources)
    for name, requirement in table.requirements.items():
        if not found[name].functions:
            lines.append(f"{FILE}: {name}: no function implements it")
        if not found[name].tests:
            lines.append(f"{FILE}: {name}: no test")
        lines += [f"{FILE}: {name}: {hazard}: no hazard of the file" for hazard in requirement.hazards
                  if hazard not in table.hazards]
        if requirement.function not in table.functions:
            lines.append(f"{FILE}: {name}: {requirement.function}: no safety function of the file")
    return lines


