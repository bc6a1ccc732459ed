"""Known deviations of the drive from the rules of the campaign: tests/campaign/known.toml.

A violation that is listed there, by its world and class, is counted as known; every other one fails a campaign. A known
one that a campaign has run and not found again is named, so that its entry is removed.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import lru_cache

from salient.errors import RunFailed
from salient.paths import ROOT

FILE = ROOT / "tests" / "campaign" / "known.toml"
_KEYS = {"seed": int, "kind": str, "violation": str, "reason": str}


@dataclass(frozen=True)
class Known:
    """A deviation: the world, the class of its violation, and the physical reason."""

    seed: int
    kind: str
    violation: str
    reason: str


def parse(text: str) -> tuple[Known, ...]:
    """The entries of a file; RunFailed where one is not complete or is there twice."""
    entries = tomllib.loads(text).get("known", [])
    for entry in entries:
        if entry.keys() != _KEYS.keys() or not all(isinstance(entry[key], kind) for key, kind in _KEYS.items()):
            raise RunFailed(f"{FILE.relative_to(ROOT)}: {entry}: must have {', '.join(_KEYS)}")
    found = tuple(Known(**entry) for entry in entries)
    if len({(each.seed, each.kind, each.violation) for each in found}) < len(found):
        raise RunFailed(f"{FILE.relative_to(ROOT)}: an entry is there twice")
    return found


@lru_cache
def known() -> tuple[Known, ...]:
    """All entries of the file."""
    return parse(FILE.read_text(encoding="utf-8"))


def of_world(seed: int, kind: str) -> set[str]:
    """Classes of the known violations of a world."""
    return {each.violation for each in known() if (each.seed, each.kind) == (seed, kind)}

