"""Runs worlds with salient_campaign (emulator/campaign): by seed, in whole or with some of their events."""

from __future__ import annotations

import hashlib
import json
import resource
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import util
from pathlib import Path
from typing import Any

from salient.bench.programs import EmulatorError
from salient.errors import UsageError
from salient.experiments.campaign.machines import pool_file
from salient.experiments.tasks import check_build
from salient.paths import BUILD, ROOT, from_root

Result = dict[str, Any]
"""seed, hash, machine, controller, virtual_us, causes, recovered, held, violations, cells."""
ALL_EVENTS = 2**64 - 1
FAULTS, HEALTHY, MOTION = KINDS = ("faults", "healthy", "motion")
"""Kinds of worlds: with faults; without; of positions, by drive.dbc or a CANopen master."""


@dataclass(frozen=True)
class Programs:
    """Other programs than the build's: the campaign's, and drive and test bench (salient_host)."""

    campaign: Path
    host: Path


def program() -> Path:
    """UsageError: it is not built."""
    path = BUILD / "host" / "bin" / "salient_campaign"
    if not path.exists():
        raise UsageError(f"{from_root(path)} is not built; tools/salient campaign builds it")
    return path


@lru_cache
def digest() -> str:
    """Digest of all that a result depends on but the seed: the program and the machines."""
    images = [line.split()[0] for line in pool_file().read_text(encoding="utf-8").splitlines()]
    parts = [program().read_bytes(), *(Path(image).read_bytes() for image in images)]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()[:16]


_RESULTS = ("docs", "tests/campaign", "tests/*.json", "tools/studies")
"""Committed results and documents, of which one measurement changes another's."""


def commit() -> str:
    """Commit of the sources, with a plus when they differ from it."""
    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    known = git("rev-parse", "--short=10", "HEAD")
    sources = [".", *(f":(exclude){name}" for name in _RESULTS)]
    changed = git("status", "--porcelain", "--untracked-files=no", "--", *sources)
    return f"{known}{'+' if changed else ''}" if known else "unknown"


def command(*options: object, programs: Programs | None = None) -> list[str]:
    """A command line of the program."""
    executable = programs.campaign if programs else program()
    return [str(executable), "--machines", str(pool_file()), *map(str, options)]


def _lines(options: Sequence[object], programs: Programs | None = None) -> list[Result]:
    done = subprocess.run(command(*options, programs=programs), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise EmulatorError(f"salient_campaign ended with {done.returncode}: {done.stderr.strip()}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def world(seed: int, kept: int = ALL_EVENTS, kind: str = FAULTS) -> Result:
    """World of a seed: machine, board, events."""
    return _lines(["--first", seed, "--keep", kept, "--describe", *_mode(kind)])[0]


def run_world(seed: int, kept: int = ALL_EVENTS, kind: str = FAULTS, frames: Path | None = None,
              programs: Programs | None = None) -> Result:
    """Runs a world, with the events whose bits are set. frames: a file for the frames that its clients sent, a
    line each: time in ns, number of the client, identifier with flags and data in hexadecimal."""
    options = ["--first", seed, "--keep", kept, *_mode(kind), *(["--frames", frames] if frames else [])]
    return _lines(options, programs)[0]


def run_worlds(first: int, seeds: int, programs: Programs | None = None) -> list[Result]:
    """Runs a range of seeds in one process."""
    return _lines(["--first", first, "--seeds", seeds], programs)


def branches(*setting: object) -> list[Result]:
    """Every fault at every control tick, a result for each fault and place (emulator/campaign/branch.h)."""
    return _lines(["--branch", *setting])


def flips(*setting: object, programs: Programs | None = None) -> list[Result]:
    """Flipped bits in a state of the drive: first the course without a flip, then those that a flip changes
    (emulator/campaign/flips.h)."""
    return _lines(["--flips", *setting], programs)


def processor_s() -> float:
    """Processor time of the processes that have ended, of this one's children and theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _mode(kind: str) -> list[str]:
    return [] if kind == FAULTS else [f"--{kind}"]


_served: dict[str, subprocess.Popen[str]] = {}


def serve(task: tuple[int, str, str]) -> Result:
    """Runs a seed in a program of this process that stays; task: seed, kind, and the digest() that everybody must
    have. For workers."""
    seed, kind, expected = task
    check_build(digest(), expected)
    process = _served.get(kind)
    if process is None or process.poll() is not None:
        process = _served[kind] = subprocess.Popen(command("--serve", *_mode(kind)), stdin=subprocess.PIPE,
                                                      stdout=subprocess.PIPE, text=True)
        util.Finalize(process, process.communicate, exitpriority=0)  # its processor time becomes the worker's
    assert process.stdin is not None and process.stdout is not None  # pipes
    process.stdin.write(f"{seed}\n")
    process.stdin.flush()
    line = process.stdout.readline()
    if not line:
        raise EmulatorError(f"salient_campaign ended with {process.wait()} at seed {seed}")
    result: Result = json.loads(line)
    return result
