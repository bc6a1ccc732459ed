"""Writes the requirements with what implements, tests and judges them, from the marks in the sources.

    python -m salient.generate.requirements [SR-NN ...]

writes docs/reference/requirements.md; with numbers it prints the names of all functions, tests, planted bugs and
surviving mutants of these instead. salient.traceability has the rules of the marks.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from salient import traceability
from salient.errors import UsageError, exit_code
from salient.paths import REFERENCE
from salient.traceability import Requirement, Table, Trace

PAGE = REFERENCE / "requirements.md"

_HEAD = """# Requirements

Generated from `firmware/requirements.toml` and marks in the sources by `tools/salient docs --generate`; do not edit.

Each row is a requirement that prevents the named [hazards](../safety/hazards.md#hazards).

- Implementations are files of `firmware/`, or of the named folder, and tests of `tests/unit/` and `tests/hil/`, with
  the number of marked functions and tests. A file without a number is an implementation as a whole.
- Bugs are planted in these functions (`tests/planted.toml`), each found by a test. Checkers are the
  [campaign's](checkers.md).
- `build/venv/bin/python -m salient.generate.requirements SR-01` prints the names behind a row.
- The style step fails for a requirement without implementation or test, for an unknown mark, and for a test of the
  [safety part](../safety/hazards.md#traceability) without a mark.
"""


def _implementations(trace: Trace) -> str:
    cells = []
    for file, names in sorted(trace.functions.items()):
        number = len(set(names) - {""})
        cells.append(f"`{file.removeprefix('firmware/')}`" + (f" {number}" if number else ""))
    return ", ".join(cells)


def _tests(trace: Trace) -> str:
    cells = []
    for file, names in sorted(trace.tests.items()):
        path = Path(file)
        folder = path.parent.relative_to("tests")
        module = "/".join((*folder.parts[1:], path.stem.removeprefix("test_")))
        cells.append(f"{folder.parts[0]} `{module}` {len(names)}")
    return ", ".join(cells)


def _row(requirement: Requirement, trace: Trace) -> str:
    checkers = ", ".join(f"`{name}`" for name in sorted(trace.checkers)) or "-"
    return (f"| **{requirement.name}** {requirement.text} ({', '.join(requirement.hazards)}) | "
            f"{_implementations(trace)} | {_tests(trace)} | {len(trace.bugs) or '-'} | {checkers} |")


def page(table: Table, traces: dict[str, Trace]) -> str:
    """The page, in Markdown."""
    tests = {(file, name) for trace in traces.values() for file, names in trace.tests.items() for name in names}
    bugs = {name for trace in traces.values() for name in trace.bugs}
    lines = [_HEAD, f"{len(table.requirements)} requirements, {len(tests)} tests, {len(bugs)} planted bugs, "
             f"{len({name for trace in traces.values() for name in trace.checkers})} checkers.", "",
             "| hazard | requirements |", "| --- | --- |"]
    for hazard, text in table.hazards.items():
        names = [name for name, requirement in table.requirements.items() if hazard in requirement.hazards]
        lines.append(f"| {hazard} {text} | {', '.join(names) or '-'} |")
    for function, row in table.functions.items():
        rows = [_row(requirement, traces[name]) for name, requirement in table.requirements.items()
                if requirement.function == function]
        lines += ["", f"## {row['name']}", "", "| requirement | implemented in | tests | bugs | checkers |",
                  "| --- | --- | --- | --- | --- |", *rows]
    return "\n".join([*lines, ""])


def details(requirement: Requirement, trace: Trace) -> str:
    """All names behind a row."""
    lines = [f"{requirement.name} {requirement.text}"]
    for title, files in (("implemented", trace.functions), ("test", trace.tests)):
        lines += [f"  {title}: {file}: {name or 'whole file'}" for file, names in sorted(files.items())
                  for name in dict.fromkeys(names)]
    for title, names in (("checker", trace.checkers), ("planted bug", trace.bugs), ("mutant", trace.survivors)):
        lines += [f"  {title}: {name}" for name in names]
    return "\n".join(lines)


def write() -> None:
    """Writes the page."""
    PAGE.write_text(page(traceability.read(), traceability.trace()), encoding="utf-8")


def main() -> int:
    """Writes the page or prints requirements; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m salient.generate.requirements", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("names", nargs="*", metavar="SR-NN", help="requirements that are printed")
    names: list[str] = parser.parse_args().names
    if not names:
        write()
        return 0
    table, traces = traceability.read(), traceability.trace()
    for name in names:
        if name not in traces:
            raise UsageError(f"{name}: no requirement of {traceability.FILE}")
        print(details(table.requirements[name], traces[name]))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
