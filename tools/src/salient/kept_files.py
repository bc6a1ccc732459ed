"""Files that the options of a command name for reading and for writing: no file is both, by whatever name."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from salient.errors import UsageError
from salient.machine.path import machine_path
from salient.paths import keep_sources

MACHINES = ("machine", "true_machine")
READ = (*MACHINES, "scenario", "table", "convert", "replay", "load_profile", "baseline", "dbc", "file")
"""Options with a file that is read."""
WRITTEN = {"log": ("out",), "tab": ("out",), "identify": ("out",), "scope": ("out",), "evidence": ("out",),
           "benchmark": ("json",), "sim": ("memory",), "tables": ("out",), "machine": ("json", "a2l", "eds", "dbc"),
           "parameters save": ("file",)}
"""By command: options with a file that is written, be they of READ or not."""
_RUN = ("results.json", "*/recording.npy", "*/can.blf", "*/can.log")
FOLDERS = {"run": _RUN, "pil": _RUN, "demo": ("results.json", "report.html"), "sweep": ("sweep.csv", "sweep.png"),
           "compare": ("compare.json", "compare.html", "summary.toml", "failed/*.toml", "machines/*/*.*",
                       "plots/*.png"),
           "scope": ("scope.csv", "scope.png", "signals.csv"), "board build": ("*.elf", "*.bin", "*.hex")}
"""By command: patterns of what is written to, or at the start removed from, the folder --out."""


def keep_read_files(options: argparse.Namespace) -> None:
    """UsageError before anything is read: the command would overwrite or remove a file that it reads, or write one
    twice."""
    command = " ".join(filter(None, (options.command, getattr(options, "action", None))))
    read: list[Path] | None = None
    earlier: dict[Path, str] = {}
    for option, paths in _written(command, options):
        for path in {path.resolve() for path in paths}:
            if path in earlier:
                raise UsageError(f"{option}: {earlier[path]} writes the same file; name another one")
            earlier[path] = option
        if there := [path for path in paths if path.exists()]:
            read = list(_read(command, options)) if read is None else read
            keep_sources(option, there, *read)


def _written(command: str, options: argparse.Namespace) -> Iterator[tuple[str, list[Path]]]:
    """Options with what they write, as far as it is known before."""
    for name in WRITTEN.get(command, ()):
        path = getattr(options, name)
        if path is not None:
            yield f"{path}" if name == "file" else f"--{name} {path}", _files(command, path, options)
    if command in FOLDERS and options.out is not None:
        yield f"--out {options.out}", [path for pattern in FOLDERS[command] for path in options.out.glob(pattern)]


def _files(command: str, path: Path, options: argparse.Namespace) -> list[Path]:
    if command == "identify":
        return [path, path.with_suffix(".html")]
    if command == "log" and options.rotate is not None:
        from salient.bus.log import parts_of

        return parts_of(path)
    return [path]


def _read(command: str, options: argparse.Namespace) -> Iterator[Path]:
    for name in READ:
        if name in WRITTEN.get(command, ()):
            continue
        value: Any = getattr(options, name, None)
        for each in value if isinstance(value, list) else [] if value is None else [value]:
            of_machine = name in MACHINES or (command, name) == ("tables", "file")
            yield from _machine_files(str(each)) if of_machine else _results(Path(each))


def _results(path: Path) -> list[Path]:
    """A file, and what an earlier comparison has left in a folder."""
    return [path, path / "compare.json"]


def _machine_files(name: str) -> list[Path]:
    """A machine file and its map; none where the command will refuse the machine."""
    try:
        path = machine_path(name)
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))["magnetics"]["file"]
    except (UsageError, OSError):
        return []
    except (ValueError, KeyError, TypeError, RecursionError):
        return [path]
    return [path, path.parent / table] if isinstance(table, str) and "\0" not in table else [path]
