"""Turns of the tests that take long: a commit runs one of them, so that the check stays short and everything is run
within a few commits. `tools/salient test --thorough` runs all of them.

A commit's turn follows from its hash, and a test's from its name: both are the same on every computer, in a shallow
clone as well, and a new test moves no other.
"""

from __future__ import annotations

import subprocess
import zlib

from salient.paths import ROOT

TURNS = 8


def turn_of_name(name: str) -> int:
    """Turn of a test, or of a file of tests that are run together."""
    return zlib.crc32(name.encode()) % TURNS


def turn_of_commit(turns: int = TURNS) -> int:
    """Turn of the commit that is checked out, of that many; 0 outside a clone."""
    done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    return int(done.stdout, 16) % turns if done.returncode == 0 else 0
