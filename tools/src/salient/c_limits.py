"""Limits of the size of C functions and files; exceptions by name, each with its reason, are in tools/c_limits.toml."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import lizard

from salient.exceptions import unexplained
from salient.paths import ROOT

FOLDERS = ("firmware", "hal", "emulator")
EXCEPTIONS = ROOT / "tools" / "c_limits.toml"
FUNCTION_LINES_MAX = 70
COMPLEXITY_MAX = 15
"""Cyclomatic complexity as lizard counts it: one and each condition, && and ||, loop, case and ?:."""
FILE_LINES_MAX = 500


def excesses(root: Path = ROOT) -> Iterator[tuple[str, str]]:
    """Names of the files ("firmware/a.c") and functions ("firmware/a.c: f") beyond a limit, and what is beyond it."""
    for path in sorted(path for folder in FOLDERS for path in (root / folder).rglob("*.[ch]")):
        file = str(path.relative_to(root))
        lines = len(path.read_text(encoding="utf-8").splitlines())
        if lines > FILE_LINES_MAX:
            yield file, f"{lines} lines, at most {FILE_LINES_MAX}"
        for function in lizard.analyze_file(str(path)).function_list:
            name = f"{file}: {function.name}"
            if function.length > FUNCTION_LINES_MAX:
                yield name, f"{function.length} lines, at most {FUNCTION_LINES_MAX}"
            if function.cyclomatic_complexity > COMPLEXITY_MAX:
                yield name, f"complexity {function.cyclomatic_complexity}, at most {COMPLEXITY_MAX}"


def violations(exceptions: Mapping[str, str], root: Path = ROOT) -> list[str]:
    """One line for each excess without a reason, and for each exception that is not needed any more."""
    return unexplained(((name, f"{name}: {excess}") for name, excess in excesses(root)), exceptions, EXCEPTIONS)
