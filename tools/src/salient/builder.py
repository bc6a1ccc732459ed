"""Runs build commands. Standard library only: the launcher imports this module before anything is installed."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

_WORK = re.compile(rb"-- |\[[0-9]+/[0-9]+\] (?!Re-checking globbed)")
"""Lines of CMake or Ninja when a folder is not up to date."""


def run_commands(commands: Sequence[Sequence[str]], folder: Path, log: Path, notice: Callable[[], None]) -> bool:
    """Runs commands in a folder until one fails; their output goes to the log. True when all ended with 0.

    notice: called once when there is anything to build.
    """
    noticed = False
    with log.open("wb", buffering=0) as output:
        for command in commands:
            with subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                  stderr=subprocess.STDOUT) as process:
                for line in process.stdout or ():
                    output.write(line)
                    if not noticed and _WORK.match(line):
                        notice()
                        noticed = True
            if process.returncode != 0:
                return False
    return True
