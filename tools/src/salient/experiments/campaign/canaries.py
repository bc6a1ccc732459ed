"""Bugs that are planted at build time, each of which the campaign must find.

    python -m salient.experiments.campaign.canaries [NUMBER ...]

builds the campaign's program with one bug at a time, runs seeds from 1 on until a violation that the program without
bugs does not have, and shrinks it. Prints the seed, the processor seconds that finding it took and the events that it
needs. Exit code 1 when a canary survives.
"""

from __future__ import annotations

import json
import re
import resource
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from salient.errors import RunFailed
from salient.experiments.campaign import names
from salient.experiments.campaign.machines import pool_file
from salient.experiments.campaign.runner import program
from salient.paths import BUILD, ROOT

FILE = ROOT / "tests" / "campaign" / "canaries.toml"
SEEDS_MAX = 3000
_CHUNK = 20
_TARGET = "salient_campaign"


@dataclass(frozen=True)
class Canary:
    """A planted bug: a text of a source file, and what takes its place."""

    name: str
    file: Path
    old: str
    new: str


@lru_cache
def canaries() -> tuple[Canary, ...]:
    """All, as the file has them; RunFailed when the text of one is not there exactly once."""
    found = tuple(Canary(entry["name"], ROOT / entry["file"], entry["old"], entry["new"])
                  for entry in tomllib.loads(FILE.read_text(encoding="utf-8"))["canary"])
    for canary in found:
        count = canary.file.read_text(encoding="utf-8").count(canary.old)
        if count != 1:
            raise RunFailed(f"{FILE.relative_to(ROOT)}: canary '{canary.name}': its text is in "
                            f"{canary.file.relative_to(ROOT)} {count} times; must be there once")
    return found


def build(canary: Canary, number: int) -> Path:
    """The campaign's program with a bug: its file compiled and linked as the build does it."""
    folder = BUILD / "campaign" / "canaries" / str(number)
    folder.mkdir(parents=True, exist_ok=True)
    source, made = folder / canary.file.name, folder / f"{canary.file.stem}.o"
    text = canary.file.read_text(encoding="utf-8").replace(canary.old, canary.new)
    if not source.exists() or source.read_text(encoding="utf-8") != text:
        source.write_text(text, encoding="utf-8")
    host = BUILD / "host"
    lines = subprocess.run(["ninja", "-t", "commands", _TARGET], cwd=host, capture_output=True, text=True,
                           check=True).stdout.splitlines()
    compiling = shlex.split(next(line for line in lines if line.endswith(f"-c {canary.file}")))
    compiling = [*compiling[:compiling.index("-MD")], "-o", str(made), "-c", str(source)]
    linking = shlex.split(re.sub(r"^: && | && :$", "", lines[-1]))
    out = linking.index("-o") + 1
    linking[out] = str(folder / _TARGET)
    linking.insert(out + 1, str(made))  # before the library, whose member of that name is then not needed
    for line in (compiling, linking):
        done = subprocess.run(line, cwd=host, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RunFailed(f"canary '{canary.name}': {done.stderr.strip()[-2000:]}")
    return folder / _TARGET


def results(executable: Path, *options: object) -> list[dict[str, Any]]:
    """Results of a build of the program."""
    line = [str(executable), "--machines", str(pool_file()), *map(str, options)]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    return [json.loads(text) for text in done.stdout.splitlines()]


def _classes(result: dict[str, Any]) -> set[str]:
    return {names.violation(violation) for violation in result.get("violations", ())}


@dataclass(frozen=True)
class Found:
    """A canary's first failing seed, its violation, the processor time until then and the events that it needs."""

    seed: int
    violation: str
    processor_s: float
    events: list[str]


def hunt(executable: Path, seeds_max: int = SEEDS_MAX) -> Found | None:
    """Runs seeds until one has a violation that it does not have without the bug; None: the canary survives."""
    begin_s = _processor_s()
    spent_s = 0.0
    for first in range(1, seeds_max + 1, _CHUNK):
        lines = results(executable, "--first", first, "--seeds", _CHUNK)
        for result in lines:
            if not result.get("violations"):
                continue
            spent_s = _processor_s() - begin_s
            seed = int(result["seed"])
            new = _classes(result) - _classes(results(program(), "--first", seed)[0])
            if new:
                violation = min(new)
                return Found(seed, violation, spent_s, _shrunk(executable, seed, violation))
    return None


def _shrunk(executable: Path, seed: int, violation: str) -> list[str]:
    events = {event["index"]: event["event"]
              for event in results(executable, "--first", seed, "--describe")[0]["events"]}
    kept = list(events)
    part = len(kept)
    while part >= 1:
        at = 0
        while at < len(kept):
            fewer = kept[:at] + kept[at + part:]
            mask = sum(1 << index for index in fewer)
            if violation in _classes(results(executable, "--first", seed, "--keep", mask)[0]):
                kept = fewer
            else:
                at += part
        part //= 2
    return [events[index] for index in kept]


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main(arguments: list[str]) -> int:
    chosen = [int(argument) for argument in arguments] or range(1, len(canaries()) + 1)
    survived = 0
    for number in chosen:
        canary = canaries()[number - 1]
        found = hunt(build(canary, number))
        if found is None:
            survived += 1
            print(f"{number}. {canary.name}: SURVIVES {SEEDS_MAX} seeds", flush=True)
        else:
            events = ", ".join(found.events) or "none"
            print(f"{number}. {canary.name}: seed {found.seed}, {found.violation}, {found.processor_s:.2f} "
                  f"processor s, {len(found.events)} events: {events}", flush=True)
    print(f"{len(chosen) - survived} of {len(chosen)} found")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
