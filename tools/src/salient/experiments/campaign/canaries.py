"""Bugs that are planted at build time, each of which the campaign must find.

    python -m salient.experiments.campaign.canaries DIR [NUMBER ...]

builds the campaign's program and the test bench with one bug at a time, runs seeds from 1 on until a violation that the
program without bugs does not have, shrinks it to the events that it needs, and replays it by the command that it
prints, which leaves log and plots in DIR/NUMBER. Prints a line for each and keeps it in DIR/canaries.json: processor
seconds until the bug was found, and to shrink it. Exit code 1 when a canary survives or its replay differs.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from salient.errors import RunFailed, exit_code
from salient.experiments.campaign.arguments import count
from salient.experiments.campaign.arguments import parser as parser_of
from salient.experiments.campaign.failure import classes, save
from salient.experiments.campaign.runner import Programs, commit, processor_s, program, run_world, run_worlds
from salient.paths import BUILD, ROOT

FILE = ROOT / "tests" / "campaign" / "canaries.toml"
RESULTS = "canaries.json"
SEEDS_MAX = 6000
_CHUNK = 20
_TARGETS = ("salient_campaign", "salient_host")


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


def build(number: int) -> Programs:
    """The programs with a bug: its file compiled, and they linked, as the build does it."""
    if not 1 <= number <= len(canaries()):
        raise RunFailed(f"{FILE.relative_to(ROOT)}: no canary {number}; has 1 to {len(canaries())}")
    program()  # whose objects are linked
    canary = canaries()[number - 1]
    folder = BUILD / "campaign" / "canaries" / str(number)
    folder.mkdir(parents=True, exist_ok=True)
    source, made = folder / canary.file.name, folder / f"{canary.file.stem}.o"
    text = canary.file.read_text(encoding="utf-8").replace(canary.old, canary.new)
    if not source.exists() or source.read_text(encoding="utf-8") != text:
        source.write_text(text, encoding="utf-8")
    compiling = next(shlex.split(line) for line in _commands(_TARGETS[0]) if line.endswith(f"-c {canary.file}"))
    _execute(canary, [*compiling[:compiling.index("-MD")], "-o", str(made), "-c", str(source)])
    for target in _TARGETS:
        linking = shlex.split(re.sub(r"^: && | && :$", "", _commands(target)[-1]))
        out = linking.index("-o") + 1
        linking[out] = str(folder / target)
        linking.insert(out + 1, str(made))  # before the library, whose member of that name is then not needed
        _execute(canary, [*linking, "-fno-lto"])  # in a sixth of the time; the program takes 8 % longer
    return Programs(*(folder / target for target in _TARGETS))


def _commands(target: str) -> list[str]:
    return subprocess.run(["ninja", "-t", "commands", target], cwd=BUILD / "host", capture_output=True, text=True,
                          check=True).stdout.splitlines()


def _execute(canary: Canary, line: list[str]) -> None:
    done = subprocess.run(line, cwd=BUILD / "host", capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RunFailed(f"canary '{canary.name}': {done.stderr.strip()[-2000:]}")


@dataclass(frozen=True)
class Found:
    """A canary's first failing seed, its violation, and the processor time until then."""

    seed: int
    violation: str
    processor_s: float


def hunt(programs: Programs, seeds_max: int = SEEDS_MAX) -> Found | None:
    """Runs seeds until one has a violation that it does not have without the bug; None: the canary survives."""
    begin_s = processor_s()
    for first in range(1, seeds_max + 1, _CHUNK):
        for result in run_worlds(first, _CHUNK, programs):
            if not result.get("violations"):
                continue
            spent_s = processor_s() - begin_s
            seed = int(result["seed"])
            new = set(classes(result)) - set(classes(run_world(seed)))
            if new:
                return Found(seed, min(new), round(spent_s, 2))
    return None


def _replays(folder: Path, violation: str) -> bool:
    """The printed command has the violation, the bits of the campaign, log and plots."""
    done = subprocess.run([sys.executable, "-m", "salient", "replay", str(folder)], capture_output=True, text=True,
                          check=False)
    left = ("can.blf", "failure.png", "failure.html")
    return (f"violation: {violation} at" in done.stdout and "equal to the campaign's" in done.stdout
            and done.returncode == 1 and all((folder / name).exists() for name in left))


def measure(number: int, out: Path) -> dict[str, Any]:
    """Hunts a canary, shrinks and replays it; out: parent of its folder."""
    note: dict[str, Any] = {"number": number, "name": canaries()[number - 1].name, "commit": commit()}
    programs = build(number)
    found = hunt(programs)
    if found is None:
        return note
    folder = out / str(number)
    begin_s = processor_s()
    saved = save(found.seed, found.violation, folder, canary=number, programs=programs)
    return {**note, **asdict(found), "shrinking_s": round(processor_s() - begin_s, 2),
            "events": [event["event"] for event in saved["world"]["events"]],
            "replays": _replays(folder, found.violation), "command": saved["replay"]}


def line(note: dict[str, Any]) -> str:
    """A result to be read."""
    if "seed" not in note:
        return f"{note['number']}. {note['name']}: SURVIVES {SEEDS_MAX} seeds"
    return (f"{note['number']}. {note['name']}: seed {note['seed']}, {note['violation']}, {note['processor_s']:.2f} "
            f"processor s, {len(note['events'])} events ({', '.join(note['events']) or 'none'}) after "
            f"{note['shrinking_s']:.2f} processor s more; {note['command']}{'' if note['replays'] else ' DIFFERS'}")


def main(arguments: list[str]) -> int:
    parser = parser_of("canaries", __doc__)
    parser.add_argument("numbers", type=count, nargs="*", metavar="NUMBER", help="of canaries (default all)")
    options = parser.parse_args(arguments)
    unknown = [number for number in options.numbers if number > len(canaries())]
    if unknown:
        parser.error(f"{unknown[0]}: the canaries are 1 to {len(canaries())}")
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    file = out / RESULTS
    notes = {note["number"]: note for note in json.loads(file.read_text(encoding="utf-8"))} if file.exists() else {}
    chosen = options.numbers or range(1, len(canaries()) + 1)
    for number in chosen:
        notes[number] = measure(number, out)
        print(line(notes[number]), flush=True)
        every = [notes[each] for each in sorted(notes)]
        file.write_text(json.dumps(every, indent=2) + "\n", encoding="utf-8")
    good = sum(notes[number].get("replays", False) for number in chosen)
    print(f"{good} of {len(chosen)} found and replayed")
    return 0 if good == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
