"""Exceptions to the rules of the style step, by name and each with its reason, in a TOML file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path


def read_exceptions(path: Path) -> dict[str, str]:
    """Names, each with the reason of its exception."""
    with path.open("rb") as file:
        return tomllib.load(file)


def unexplained(found: Iterable[tuple[str, str]], exceptions: Mapping[str, str], file: Path) -> list[str]:
    """found: name and line of each breach of a rule. The lines of those without a reason, and one for each exception
    of the file that is not needed any more."""
    needed, lines = set(), []
    for name, line in found:
        needed.add(name)
        if not exceptions.get(name, "").strip():
            lines.append(line)
    return lines + [f"{name}: an exception of {file.name} that is not needed" for name in exceptions
                    if name not in needed]
