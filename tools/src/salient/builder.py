"""Runs build commands. Standard library only: the launcher imports this module before anything is installed."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

_QUIET_S = 1.0


def run_commands(commands: Sequence[Sequence[str]], folder: Path, log: Path, notice: Callable[[], None]) -> bool:
    """Runs commands in a folder until one fails; their output goes to the log. True when all ended with 0.

    notice: called when they take longer than a moment.
    """
    noticed = False
    with log.open("wb") as output:
        for command in commands:
            process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=output,
                                       stderr=subprocess.STDOUT)
            while True:
                try:
                    code = process.wait(None if noticed else _QUIET_S)
                    break
                except subprocess.TimeoutExpired:
                    notice()
                    noticed = True
                except BaseException:
                    process.terminate()
                    process.wait()
                    raise
            if code != 0:
                return False
    return True
