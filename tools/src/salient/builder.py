"""Runs build commands. Standard library only: the launcher imports this module before anything is installed."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

_WORK = re.compile(rb"-- |\[[0-9]+/[0-9]+\] (?!Re-checking globbed)")
"""Lines of CMake or Ninja when a folder is not up to date."""


def build_preset(root: Path, folder: Path, targets: Sequence[str], log: Path, notice: Callable[[], None],
                 options: Sequence[str] = ()) -> bool:
    """Brings a build of the clone in root up to date, or its targets only, in a folder that has the name of its preset;
    configures it first, with these options, where that has not been done without a machine file of the user. Output,
    result and notice: as run_commands."""
    commands = [["cmake", "--build", str(folder), *(["--target", *targets] if targets else [])]]
    if not _is_configured(folder):
        commands.insert(0, ["cmake", "--preset", folder.name, "-B", str(folder), "-DSALIENT_MACHINE_FILE=", *options])
    return run_commands(commands, root, log, notice)


def _is_configured(folder: Path) -> bool:
    """True for a folder that CMake has configured without a machine file of the user, which may be gone by now."""
    try:
        cache = (folder / "CMakeCache.txt").read_text()
    except OSError:
        return False
    without_file = re.search(r"^SALIENT_MACHINE_FILE:FILEPATH=$", cache, re.MULTILINE) is not None
    return without_file and (folder / "build.ninja").exists()


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
