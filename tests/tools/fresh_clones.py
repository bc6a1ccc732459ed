"""Runs every command of tools/salient in a fresh clone of its own, where nothing else has run.

    build/venv/bin/python tests/tools/fresh_clones.py [COMMAND ...] [--turn] [--out DIR]

The suite builds everything before it tests a command, and does not see that a command forgets to build what it runs.
The command lines come from the documents, so that a new one is run as well. Clones have the commit that is checked
out and share nothing but Debian's packages and pip's downloads. An interrupted run goes on where it was: a command that
has passed at this commit is not repeated. The clone of one that failed stays in the folder of --out, with its output.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from salient.bench.session import Session
from salient.cli import make_parser
from salient.paths import BUILD, ROOT
from salient.turns import turn_of_commit

DOCUMENTS = ("*.md", "docs/**/*.md", "*/README.md")
BUS = "/tmp/salient.sock"  # of the documents
NOT_LITERAL = re.compile(r"\b[A-Z]{3,}\b|\.\.\.")
"""Placeholders of the documents, as SEED."""
SHORTER = {
    "test": ["test --only unit"],
    "test --only hil --only plant": [],
    "campaign --seeds 200": ["campaign --seeds 20"],
    "campaign --seeds 10000": [],
    "compare machines": [],
    "pil --figures": [],
    "compare robustness --resume --out out/robustness": [],
}
"""Documented command lines that take from minutes to hours: what is run instead. CI runs the whole suite."""
UNFENCED = ("benchmark --runs 1", "benchmark --runs 1 --page 5", "benchmark --runs 1 --tab", "wheel", "compare --list")
"""Documented in running text, or by --help alone."""
ON_A_BUS = ("log", "monitor", "command", "view", "scope", "parameters")
"""Commands that need a drive which runs elsewhere."""
UNTIL_INTERRUPTED = ("sim", "view")


def documented(root: Path) -> dict[str, list[str]]:
    """Command: its command lines, without tools/salient, in the order of the documents."""
    lines: list[str] = []
    for document in (path for pattern in DOCUMENTS for path in sorted(root.glob(pattern))):
        fenced = False
        for line in document.read_text(encoding="utf-8").splitlines():
            fenced ^= line.startswith("```")
            if fenced and line.startswith("tools/salient ") and not NOT_LITERAL.search(line):
                lines.append(shlex.join(shlex.split(line, comments=True)[1:]))
    found: dict[str, list[str]] = {}
    for line in dict.fromkeys([*lines, *UNFENCED]):
        found.setdefault(line.split()[0], []).extend(SHORTER.get(line, [line]))
    return found


def all_commands() -> list[str]:
    """The commands of tools/salient --help."""
    [commands] = (action.choices for action in make_parser()._subparsers._group_actions)  # argparse has no public list
    return sorted(commands)


def commit_of(root: Path) -> str:
    """The commit that is checked out."""
    return subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True,
                          check=True).stdout.strip()


def make_clone(root: Path, commit: str, folder: Path) -> None:
    """A clone at a commit, in place of an earlier one."""
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", "--no-checkout", root, folder], check=True)
    subprocess.run(["git", "-c", "advice.detachedHead=false", "checkout", "--quiet", "--detach", commit],
                   cwd=folder, check=True)


def environment() -> dict[str, str]:
    """Environment of this process without all that would lead a clone to another's files."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "SALIENT_"))}


@contextlib.contextmanager
def running_drive(bus: Path, *, faulty: bool) -> Iterator[None]:
    """A drive of this checkout on a bus; faulty: after a fault."""
    command = [ROOT / "tools" / "salient", "sim", "--can", f"unix:{bus}", "--pace", "x0.5"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as drive:
        assert drive.stdout is not None and json.loads(drive.stdout.readline())["ready"]
        try:
            if faulty:
                with Session(f"unix:{bus}", lockstep=False) as session:
                    session.drive.speed_reference_rpm = 100
                    session.run_for(0.05)
                    session.rig.encoder_fault = 1
                    session.run_until(lambda: session.drive.state == "fault", timeout=5.0)
            yield
        finally:
            drive.terminate()


def run_line(line: str, clone: Path, output: IO[bytes]) -> int:
    """Exit code of a command line in a clone. One that runs until it is interrupted gets Ctrl-C when it is ready."""
    output.write(f"\n$ tools/salient {line}\n".encode())
    output.flush()
    start = [clone / "tools" / "salient", *shlex.split(line)]
    if line.split(maxsplit=1)[0] not in UNTIL_INTERRUPTED:
        return subprocess.run(start, cwd=clone, env=environment(), stdin=subprocess.DEVNULL, stdout=output,
                              stderr=output).returncode
    with subprocess.Popen(start, cwd=clone, env=environment(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=output, start_new_session=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        output.write(first)
        link = re.search(rb"http://\S+", first)
        if link:
            with urllib.request.urlopen(link[0].decode()) as page:
                output.write(f"{page.status}: {len(page.read())} bytes\n".encode())
        os.killpg(process.pid, signal.SIGINT)
        output.write(process.stdout.read())
    return process.returncode if first else 1


def run_command(command: str, lines: Sequence[str], root: Path, commit: str, folder: Path) -> list[tuple[str, int]]:
    """Runs the lines of a command in a fresh clone; (line, exit code) of each, up to the first that fails."""
    clone, done = folder / command, []
    make_clone(root, commit, clone)
    with contextlib.ExitStack() as stack:
        bus = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="salient-"))) / "can.sock"
        output = stack.enter_context((folder / f"{command}.log").open("wb"))
        if command in ON_A_BUS:
            stack.enter_context(running_drive(bus, faulty=command == "scope"))
        if command == "view":
            subprocess.run([sys.executable, "-m", "salient", "log", "--can", f"unix:{bus}", "--out",
                            clone / "out" / "can.blf", "--duration-s", "0.2"], check=True, stdout=output)
        for line in lines:
            done.append((line, run_line(line.replace(BUS, str(bus)), clone, output)))
            if done[-1][1] != 0:
                return done
    shutil.rmtree(clone)
    return done


def read_passed(results: Path, commit: str) -> set[str]:
    """Commands that have passed at a commit."""
    try:
        texts = results.read_text(encoding="utf-8").splitlines()
    except OSError:
        return set()
    return {each["command"] for each in map(json.loads, texts) if each["commit"] == commit and each["passed"]}


def run(root: Path, folder: Path, cases: dict[str, list[str]]) -> int:
    """Runs the commands that have not passed at this commit yet and prints a summary; 0 when all have passed."""
    folder.mkdir(parents=True, exist_ok=True)
    results, commit = folder / "results.jsonl", commit_of(root)
    passed = read_passed(results, commit)
    if subprocess.run(["git", "diff", "--quiet", "HEAD"], cwd=root).returncode != 0:
        print("changes that are not committed are in no clone", flush=True)
    summary = []
    for command, lines in cases.items():
        if command in passed:
            summary.append(f"passed  {command} (earlier)")
            continue
        print(f"{command}: {len(lines)} in a fresh clone of {commit[:8]}", flush=True)
        started_s = time.monotonic()
        done = run_command(command, lines, root, commit, folder)
        code = done[-1][1]
        with results.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"commit": commit, "command": command, "passed": code == 0, "lines": done}) + "\n")
        if code == 0:
            passed.add(command)
        summary.append(f"passed  {command} ({time.monotonic() - started_s:.0f} s)" if code == 0 else
                       f"FAILED  {command}: exit code {code} of `tools/salient {done[-1][0]}`, see "
                       f"{folder / command}.log")
        print(summary[-1], flush=True)
    failed = len(cases.keys() - passed)
    print("\n".join(["", *summary, f"{len(cases) - failed} passed, {failed} failed"]))
    return 1 if failed else 0


def main() -> int:
    """Reads the command line."""
    cases = documented(ROOT)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help="these only (default all)")
    parser.add_argument("--turn", action="store_true", help="only the command whose turn it is with this commit")
    parser.add_argument("--out", type=Path, default=BUILD / "fresh_clones", metavar="DIR",
                        help="folder of the clones, outputs and results (default %(default)s)")
    options = parser.parse_args()
    if unknown := set(options.commands) - cases.keys():
        parser.error(f"no command {', '.join(sorted(unknown))}: must be of {', '.join(sorted(cases))}")
    names = options.commands or sorted(cases)
    if options.turn:
        names = [names[turn_of_commit(len(names))]]
    return run(ROOT, options.out.absolute(), {name: cases[name] for name in names})


if __name__ == "__main__":
    sys.exit(main())
