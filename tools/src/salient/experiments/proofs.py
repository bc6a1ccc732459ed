"""Proofs of functions of the firmware by bounded model checking with CBMC.

    python -m salient.experiments.proofs [--only PART ...] [--out DIR] [--list]

A proof is a function prove_NAME of tests/proofs/*.c. CBMC (Clarke, Kroening and Lerda, "A tool for checking ANSI-C
programs", TACAS 2004) looks for arguments for which one of its claims is wrong, or a behaviour undefined: signed
overflow, shifts, bounds, pointers, division by 0. That loops end within `unwind` iterations is claimed as well.
Conversions wrap as GCC defines it. tests/proofs.toml has for each proof what it proves, by source and function, and a
bug: a text, and what takes its place. With its bug a proof must fail, otherwise it proves nothing.

CBMC comes from Debian trixie, unpacked with its own C library in the build folder, or is the system's.
DIR/runs.jsonl keeps the results for these sources, so that an interrupted run goes on; DIR/summary.json has the counts,
which a run of all proofs also writes to tests/proofs.json. Exit code 1 when a proof fails, or holds with its bug.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import lizard

from salient.errors import UsageError, exit_code, reason
from salient.experiments import planted, tasks
from salient.experiments.campaign.runner import commit, processor_s
from salient.paths import BUILD, OUT, ROOT, build_lock
from salient.progress import Progress, steps_of

TABLE = ROOT / "tests" / "proofs.toml"
HARNESSES = ROOT / "tests" / "proofs"
SUMMARY = ROOT / "tests" / "proofs.json"
CBMC = BUILD / "cbmc"
PACKAGES = ("cbmc", "minisat", "libc6", "libgcc-s1", "libstdc++6", "zlib1g")
RELEASE = "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://deb.debian.org/debian trixie main\n"
OPTIONS = ("--c11", "--no-malloc-may-fail", "--pointer-overflow-check")
"""Besides the checks that CBMC 6 has by default."""
PROOF_MAX_S = 900
"""CPU time of a proof, several times the longest one's."""
_HOLDS, _BROKEN = 0, 10
"""Exit codes of CBMC."""
_NO_FUNCTIONS = re.compile(r"/\*.*?\*/|^#(?:[^\n]*\\\n)*[^\n]*|^static_assert\(.*?\);", re.DOTALL | re.MULTILINE)
"""Comments, directives and assertions, behind some of which lizard overlooks functions."""


@dataclass(frozen=True)
class Proof:
    """A proof: its harness, names of the functions of the firmware by their source, and the bug that breaks it."""

    name: str
    source: Path
    proves: tuple[tuple[str, tuple[str, ...]], ...]
    bug: planted.Bug
    unwind: int
    slow: bool = False

    @property
    def functions(self) -> list[str]:
        """"FILE: NAME" of the functions that it proves."""
        return [f"{file}: {name}" for file, names in self.proves for name in names]


def proofs(path: Path = TABLE) -> list[Proof]:
    """All of a table; UsageError names what is wrong with it."""
    found = []
    try:
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["proof"]:
            file, old, new = entry["bug"]
            found.append(Proof(entry["name"], HARNESSES / entry["source"],
                               tuple((source, tuple(names)) for source, names in entry["proves"].items()),
                               planted.Bug(entry["name"], file, old, new, (), path), entry.get("unwind", 1),
                               entry.get("slow", False)))
    except (OSError, tomllib.TOMLDecodeError, KeyError, ValueError, AttributeError) as error:
        raise UsageError(f"{path.name}: no table of proofs: {reason(error)}") from None
    known = set(functions())
    for proof in found:
        if unknown := sorted(set(proof.functions) - known):
            raise UsageError(f"{path.name}: {proof.name}: no function {unknown[0]}")
        if f"void prove_{proof.name}(" not in proof.source.read_text(encoding="utf-8"):
            raise UsageError(f"{path.name}: {proof.source.name} has no prove_{proof.name}")
    return found


@cache
def functions() -> tuple[str, ...]:
    """"FILE: NAME" of all functions of firmware/."""
    return tuple(f"{path.relative_to(ROOT).as_posix()}: {function.name}"
                 for path in sorted((ROOT / "firmware").rglob("*.[ch]"))
                 for function in lizard.analyze_file.analyze_source_code(
                     str(path), _NO_FUNCTIONS.sub("", path.read_text(encoding="utf-8"))).function_list)


# --- CBMC -----------------------------------------------------------------------------------------------------------

def program() -> list[str]:
    """The command of CBMC, which is downloaded when it is missing; UsageError when it cannot be had."""
    if own := shutil.which("cbmc"):
        return [own]
    with build_lock():
        if not CBMC.is_dir():
            _download()
    loader = next(CBMC.glob("usr/lib/**/ld-linux*.so.*"))
    libraries = ":".join(sorted({str(path.parent) for path in CBMC.glob("usr/lib/**/lib*.so*")}))
    return [str(loader), "--library-path", libraries, str(CBMC / "usr" / "bin" / "cbmc")]


def _download() -> None:
    """By apt-get with files of its own, which checks the signature of the release; nothing is installed."""
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise UsageError(f"cbmc is missing, and there is no {tool} to get it with")
    with tempfile.TemporaryDirectory(dir=BUILD, prefix="cbmc-") as name:
        folder = Path(name)
        for part in ("state/lists/partial", "cache/archives/partial", "root"):
            (folder / part).mkdir(parents=True)
        (folder / "sources.list").write_text(RELEASE, encoding="utf-8")
        options = {"Dir::Etc::sourcelist": folder / "sources.list", "Dir::Etc::sourceparts": "/dev/null",
                   "Dir::Etc::preferences": "/dev/null", "Dir::Etc::preferencesparts": "/dev/null",
                   "Dir::State": folder / "state", "Dir::State::status": "/dev/null", "Dir::Cache": folder / "cache",
                   "APT::Sandbox::User": "root", "Acquire::Languages": "none",
                   "Acquire::IndexTargets::deb::DEP-11::DefaultEnabled": "false"}
        apt = ["apt-get", "-qq", *(f"-o{key}={value}" for key, value in options.items())]
        for line in ([*apt, "update", "-oAPT::Update::Error-Mode=any"], [*apt, "download", *PACKAGES]):
            done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise UsageError(f"cbmc of Debian trixie cannot be downloaded: {done.stderr.strip()[-300:]}")
        for package in folder.glob("*.deb"):
            subprocess.run(["dpkg-deb", "-x", package, folder / "root"], check=True)
        (folder / "root").rename(CBMC)


@cache
def _includes() -> tuple[str, ...]:
    """Options of the host build that find the headers of the firmware, generated ones included."""
    entries = json.loads((BUILD / "host" / "compile_commands.json").read_text(encoding="utf-8"))
    line = next(entry["command"] for entry in entries if entry["file"].endswith("/firmware/drive/drive.c"))
    return tuple(part for part in shlex.split(line) if part.startswith(("-I", "-D")))


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (PROOF_MAX_S, PROOF_MAX_S))


def check(proof: Proof, command: Sequence[str], folder: Path | None = None) -> tuple[bool, list[str]]:
    """Whether a proof holds, and the properties that do not; folder: what is included is looked for there first.
    UsageError when CBMC does not end, or cannot read the sources."""
    first = [] if folder is None else [f"-I{folder}"]
    line = [*command, str(proof.source), *first, f"-I{HARNESSES}", *_includes(), "--function", f"prove_{proof.name}",
            "--unwind", str(proof.unwind), *OPTIONS]
    done = subprocess.run(line, cwd=BUILD, capture_output=True, text=True, preexec_fn=_limit, check=False)
    if done.returncode not in (_HOLDS, _BROKEN):
        raise UsageError(f"{proof.name}: CBMC ends with code {done.returncode}: "
                         f"{(done.stdout + done.stderr).strip()[-1000:]}")
    return done.returncode == _HOLDS, re.findall(r"^\[.*?\] (.*): FAILURE$", done.stdout, re.MULTILINE)


# --- Results --------------------------------------------------------------------------------------------------------

def judge(arguments: tuple[Proof, list[str]]) -> dict[str, Any]:
    """Whether a proof holds, and fails with its bug."""
    proof, command = arguments
    begin_s = processor_s()
    holds, failed = check(proof, command)
    spent_s = processor_s() - begin_s
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        place = Path(name) / proof.bug.file.partition("/")[2]
        place.parent.mkdir(parents=True)
        place.write_text(proof.bug.text(), encoding="utf-8")
        with_bug, found = check(proof, command, Path(name))
    return {"holds": holds, "failed": failed, "bug_found": not with_bug, "by": found[:3],
            "processor_s": round(spent_s, 1)}


def key(proof: Proof) -> str:
    """Hash of what the result of a proof depends on."""
    compiled = tasks.compiled_digest(["gcc", f"-I{HARNESSES}", *_includes()], str(proof.source))
    parts = (proof.name, proof.bug.old, proof.bug.new, proof.unwind, OPTIONS, compiled)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def summary(found: Iterable[tuple[Proof, Mapping[str, Any]]]) -> dict[str, Any]:
    """Counts; a function is proved when all its proofs hold and fail with their bugs."""
    results = list(found)
    good = {proof.name for proof, result in results if result["holds"] and result["bug_found"]}
    claimed = {name for proof, _ in results for name in proof.functions}
    open_ones = {name for proof, _ in results if proof.name not in good for name in proof.functions}
    proved = claimed - open_ones
    folders = sorted({name.split("/")[1] for name in functions()})
    return {
        "commit": commit(), "proofs": len(results), "functions": len(functions()), "proved": len(proved),
        "folders": {folder: [sum(name.startswith(f"firmware/{folder}/") for name in names)
                             for names in (proved, functions())] for folder in folders},
        "processor_s": round(sum(result["processor_s"] for _, result in results), 1),
        "failed": [proof.name for proof, result in results if not result["holds"]],
        "bug_not_found": [proof.name for proof, result in results if not result["bug_found"]],
    }


def run(chosen: Sequence[Proof], out: Path) -> dict[str, Any]:
    """Judges proofs; returns the summary, which is also in the folder."""
    for proof in chosen:
        proof.bug.text()
    planted.build_unchanged(["salient_host"])  # generated headers
    command = program()
    looks = [tasks.Task(key(proof), (proof, command)) for proof in chosen]
    found = []
    with Progress(steps_of(len(looks), sys.stderr), sys.stderr, len(looks)) as progress:
        for task, result in tasks.run(looks, judge, out):
            found.append((task.arguments[0], result))
            progress.item(f"{task.arguments[0].name}: {result['processor_s']} s")
    found.sort(key=lambda item: chosen.index(item[0]))
    for proof, result in found:
        for line in result["failed"]:
            print(f"{proof.name}: does not hold: {line}")
        if not result["bug_found"]:
            print(f"{proof.name}: holds with its bug")
    note = summary(found)
    (out / "summary.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    return note


def main() -> int:
    """Judges the proofs that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.proofs", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--only", nargs="+", default=[""], metavar="PART",
                        help="proofs with one of these in their name")
    parser.add_argument("--out", type=Path, default=OUT / "proofs", metavar="DIR", help=f"default {OUT}/proofs")
    parser.add_argument("--list", action="store_true", help="only name the proofs, with what they prove")
    options = parser.parse_args()
    every = proofs()
    chosen = [proof for proof in every if any(part in proof.name for part in options.only)]
    if not chosen:
        raise UsageError(f"--only {' '.join(options.only)}: no proof has this in its name; --list shows them")
    if options.list:
        print("\n".join(f"{proof.name}: {', '.join(proof.functions)}" for proof in chosen))
        return 0
    note = run(chosen, options.out)
    if len(chosen) == len(every):
        SUMMARY.write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    print(f"{note['proofs']} proofs of {note['proved']} of {note['functions']} functions in {note['processor_s']} s of "
          f"CPU time: {len(note['failed'])} fail, {len(note['bug_not_found'])} hold with their bug")
    return 1 if note["failed"] or note["bug_not_found"] else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
