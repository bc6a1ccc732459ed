"""Kills each command by each signal at random instants, and checks what is left and that the next start works.

    build/venv/bin/python tests/tools/kills.py [--only KIND ...] [--instants 20] [--seed 1] [--out build/kills]

A command is first run undisturbed. An instant is a random share of the duration that this run had; a command that runs
until it is interrupted has twice the time to its first line. The signal goes to the process or, as a terminal's,
to its group. After it nothing may be left: no process, recognised by a variable of its environment or by the folder of
its temporary files in its command line, no temporary file, no socket, no lock, nothing half-written in the build
folder; and no traceback. The next start must end as the undisturbed run did; of a command of more than LONG_S it must
come as far as the killed one. Results are kept in --out and not measured again. Exit code 1 when anything is left.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from salient.errors import exit_code
from salient.experiments.tasks import Task, read_results, run
from salient.paths import BUILD, ROOT

MARK = "SALIENT_KILLS"
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGKILL")
ENDED_WITHIN_S = 300.0
"""Much more than the end of a process takes on a busy computer."""
LONG_S = 20.0
HALF_WRITTEN = re.compile(r"tmp|partial|unpack-|run-|\.[0-9a-f]{16}$")
SUITE = """
import pytest

@pytest.mark.parametrize("number", range(8))
def test_some(bench, number):
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.05)
"""
SCENARIO = """
machine = "saturating"
controllers = ["salient"]
duration_s = 0.03
[[speed]]
at_s = 0.0
value_rpm = 300.0
[record]
step_us = 10.0
"""


@dataclass(frozen=True)
class Kind:
    """A command line. {folder} stands for the folder of all its runs, {root} for the repository.

    endless: runs until it is interrupted. bus: needs a drive on unix:{folder}/can.sock. module: of Python, instead of a
    command of tools/salient.
    """

    line: str
    endless: bool = False
    bus: bool = False
    module: str = "salient"


_BUS = "--can unix:{folder}/can.sock"
KINDS = {
    "sim": Kind("sim --pace realtime --can unix:{folder}/own.sock", endless=True),
    "demo": Kind("demo --out {folder}/demo"),
    "run": Kind("run {folder}/some.toml --out {folder}/run"),
    "sweep": Kind("sweep {folder}/some.toml --seeds 12 --resume --out {folder}/sweep"),
    "log": Kind(f"log {_BUS} --duration-s 1 --out {{folder}}/can.blf", bus=True),
    "monitor": Kind(f"monitor {_BUS} --duration-s 1", bus=True),
    "command": Kind(f"command speed 300 --duration-s 0.5 {_BUS}", bus=True),
    "view": Kind(f"view {_BUS}", endless=True, bus=True),
    "scope": Kind(f"scope {_BUS} --out {{folder}}/scope", bus=True),
    "identify": Kind("identify --machine saturating --true-machine linear_cosine --bins 4 --repeats 1 "
                     "--out {folder}/identified/motor.toml"),
    "tables": Kind(f"tables linear_cosine {_BUS}", bus=True),
    "parameters": Kind(f"parameters save {{folder}}/saved.toml {_BUS}", bus=True),
    "machine": Kind("machine saturating --out {folder}/machine"),
    "board": Kind("board build --out {folder}/board"),
    "compare": Kind("compare speeds --quick --samples 1 --resume --out {folder}/compare"),
    "campaign": Kind("campaign --seeds 16 --out {folder}/campaign"),
    "replay": Kind("replay 1 --out {folder}/replay"),
    "benchmark": Kind("benchmark --runs 1 --json {folder}/benchmark.json"),
    "live_page": Kind("benchmark --page 2"),
    "pil": Kind("pil {folder}/some.toml --out {folder}/pil"),
    "tab": Kind("tab --out {folder}/tab.html"),
    "docs": Kind("docs --out {folder}/docs"),
    "evidence": Kind("evidence --out {folder}/evidence.html"),
    "wheel": Kind("wheel --out {folder}/wheel"),
    "test": Kind("test --only unit"),
    "fault_table": Kind("--jobs 2", module="salient.experiments.fault_table"),
    "planted": Kind("--only overflow --by unit --out {folder}/planted", module="salient.experiments.planted"),
    "healthy_drives": Kind("--drives 4", module="salient.experiments.healthy_drives"),
    "finite_elements": Kind("{folder}/map.csv", module="salient.finite_elements"),
    "cluster": Kind("{folder}/cluster 40", module="salient.experiments.campaign.cluster"),
    "vm": Kind("--force-vm -- true", module="salient.vm.run"),
    "pytest": Kind("-v -n 2 -p no:cacheprovider --basetemp {folder}/basetemp {folder}/test_some.py", module="pytest"),
    "suite": Kind("-v -n 2 -p no:cacheprovider {root}/tests/hil/test_identity.py", module="pytest"),
}
WRITES_THE_TREE = ("fault_table",)
"""Kinds whose undisturbed run would write a committed page: they are killed, and never run to their end."""


def line_of(kind: Kind, folder: Path) -> list[str]:
    """A command that is started."""
    rest = [word.format(folder=folder, root=ROOT) for word in kind.line.split()]
    if kind.module != "salient" or not (BUILD / "venv" / "bin" / "python").exists():
        return [sys.executable, "-m", kind.module, *rest]
    return [str(ROOT / "tools" / "salient"), *rest]


# --- what is left ---------------------------------------------------------------------------------------------------

def left_of(mark: str, temporary: Path, folder: Path) -> list[str]:
    """Remains of a run with a mark in its environment: processes, temporary files, sockets and locks."""
    left = [path.parent for path in Path("/proc").glob("[0-9]*/cmdline") if _belongs(path, mark, temporary)]
    found = [f"process {_read(path / 'cmdline').decode(errors='replace')[:200]!r}" for path in left]
    # pytest keeps the folders of its last three sessions.
    found += [f"file {path}" for path in temporary.iterdir() if not path.name.startswith("pytest-of-")]
    found += [f"socket {path}" for path in folder.rglob("*.sock") if path.name != "can.sock"]
    return found + [f"lock {path}" for path in (*BUILD.glob("*.lock"), *BUILD.glob("machine-*/lock"),
                                                *folder.rglob("runs*.jsonl")) if _is_locked(path)]


def _belongs(cmdline: Path, mark: str, temporary: Path) -> bool:
    if os.fsencode(temporary) in _read(cmdline):
        return True
    return mark.encode() in _read(cmdline.with_name("environ")).split(b"\0")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""  # it has ended


def _is_locked(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False


def wait_until_nothing(look: Callable[[], list[str]]) -> list[str]:
    """Looks until nothing is left; what is left at the end of a generous time."""
    deadline_s = time.monotonic() + ENDED_WITHIN_S
    while (left := look()) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return left


def _half_written() -> set[str]:
    places = (BUILD, BUILD / "machines", BUILD / "vm", BUILD / "results")
    return {str(path) for place in places if place.is_dir() for path in place.iterdir()
            if HALF_WRITTEN.search(path.name)}


def unreadable_files(folder: Path) -> list[str]:
    """Recordings, logs and results of the killed programs that cannot be read."""
    found = []
    readers: dict[str, Callable[[Path], object]] = {
        "*.npy": np.load, "*.blf": lambda path: path.stat().st_size and list(can.LogReader(path)),
        "runs.jsonl": lambda path: read_results(path.parent)}
    for pattern, read in readers.items():
        for path in folder.rglob(pattern):
            try:
                read(path)
            except Exception as error:
                found.append(f"unreadable {path}: {error}")
    return found


# --- a run ----------------------------------------------------------------------------------------------------------

@contextmanager
def started(kind: Kind, folder: Path, mark: str) -> Iterator[subprocess.Popen[bytes]]:
    """A run, in a session of its own; its output goes to a file of the folder. Killed at the end."""
    environment = {**os.environ, MARK: mark, "TMPDIR": str(folder / "tmp")}
    line = ["env", "--default-signal", *line_of(kind, folder)]  # this process, of a pool, ignores SIGINT
    with (folder / "output").open("wb") as output, \
            subprocess.Popen(line, env=environment, cwd=folder, stdin=subprocess.DEVNULL,
                             stdout=output, stderr=output, start_new_session=True) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@contextmanager
def bus_of(kind: Kind, folder: Path) -> Iterator[None]:
    """The drive that a kind needs."""
    if not kind.bus:
        yield
        return
    line = [sys.executable, "-m", "salient", "sim", "--pace", "realtime", "--can", f"unix:{folder}/can.sock",
            "--memory", f"{folder}/memory.bin"]
    with subprocess.Popen(line, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline()
            yield
        finally:
            process.terminate()


def folder_of(out: Path, name: str) -> Path:
    folder = (out / name).absolute()
    (folder / "tmp").mkdir(parents=True, exist_ok=True)
    (folder / "some.toml").write_text(SCENARIO)
    (folder / "test_some.py").write_text(SUITE)
    return folder


def undisturbed(task: tuple[str, Path]) -> dict[str, Any]:
    """Duration and exit code of a run; of an endless one twice the time to its first line."""
    name, out = task
    kind, folder = KINDS[name], folder_of(out, name)
    begin_s = time.monotonic()
    with bus_of(kind, folder), started(kind, folder, "undisturbed") as process:
        if not kind.endless and name not in WRITES_THE_TREE:
            code = process.wait()
            return {"duration_s": time.monotonic() - begin_s, "code": code, "output": _output(folder) if code else ""}
        while process.poll() is None and not (folder / "output").stat().st_size:
            time.sleep(0.01)
        duration_s = 2.0 * (time.monotonic() - begin_s)
        return {"duration_s": duration_s, "code": process.poll() or 0, "output": ""}


def _output(folder: Path) -> str:
    return (folder / "output").read_text(errors="replace")[-2000:]


def kill(task: tuple[str, Path, str, float, bool, float, int]) -> dict[str, Any]:
    """Kills a run; what is left, and how the next start ends."""
    name, out, signal_name, instant_s, to_group, duration_s, code = task
    kind, folder = KINDS[name], folder_of(out, name)
    mark = f"{os.getpid()}-{time.monotonic_ns()}"
    before = _half_written()
    with bus_of(kind, folder):
        with started(kind, folder, mark) as process:
            has_ended = _has_ended(process, instant_s)
            if not has_ended:
                (os.killpg if to_group else os.kill)(process.pid, signal.Signals[signal_name])
                with suppress(subprocess.TimeoutExpired):
                    process.wait(ENDED_WITHIN_S)
            left = [] if process.poll() is not None else [f"{name} goes on after {signal_name}"]
            left += wait_until_nothing(lambda: left_of(f"{MARK}={mark}", folder / "tmp", folder))
        text = _output(folder)
        # Without the launcher, which holds an interrupt back meanwhile, Python itself reports one of its imports.
        is_of_imports = line_of(kind, folder)[0] == sys.executable and text.endswith("\nKeyboardInterrupt\n")
        left += [text] if "Traceback" in text and not is_of_imports else []
        left += sorted(_half_written() - before) + unreadable_files(folder)
        with started(kind, folder, "next") as process:
            endless = kind.endless or name in WRITES_THE_TREE or duration_s > LONG_S
            ended = _has_ended(process, instant_s if endless else ENDED_WITHIN_S)
            if process.poll() not in (code, None) or (not ended and not endless):
                left.append(f"the next start ends with {process.poll()}: {_output(folder)}")
    wait_until_nothing(lambda: left_of(f"{MARK}=next", folder / "tmp", folder))
    return {"left": left, "was_running": not has_ended}


def _has_ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        return False
    return True


# --- all of them ----------------------------------------------------------------------------------------------------

def tasks_of(names: Sequence[str], out: Path, instants: int, seed: int, signals: Sequence[str]) -> list[Task]:
    """All kills, each with an instant of its own."""
    first = [Task(f"{name} undisturbed", (name, out)) for name in names]
    measured = {task.key.split()[0]: result for task, result in run(first, undisturbed, out / "undisturbed", jobs=1)}
    tasks = []
    for name in names:
        duration_s, code = measured[name]["duration_s"], measured[name]["code"]
        for signal_name in signals:
            chance = random.Random(f"{seed} {name} {signal_name}")
            for number in range(instants):
                instant_s, to_group = chance.random() * duration_s, chance.random() < 0.5
                tasks.append(Task(f"{name} {signal_name} {seed} {number}",
                                  (name, out, signal_name, instant_s, to_group, duration_s, code)))
    return tasks


def kill_all(names: Sequence[str], out: Path, instants: int, seed: int, signals: Sequence[str] = SIGNALS) -> int:
    """Prints a line for each kill and a summary; returns the number of kills that left something."""
    done: Counter[str] = Counter()
    running: Counter[str] = Counter()
    bad: Counter[str] = Counter()
    for task, result in run(tasks_of(names, out, instants, seed, signals), kill, out / "kills", jobs=1):
        name = task.key.split()[0]
        done[name] += 1
        running[name] += result["was_running"]
        bad[name] += bool(result["left"])
        where = f"at {task.arguments[3]:.2f} s" if result["was_running"] else "after its end"
        print(f"{task.key} {where}: {'; '.join(result['left']) or 'nothing left'}", flush=True)
    print("| command | kills | of a running one | left something |\n| --- | --- | --- | --- |")
    for name in done:
        print(f"| {name} | {done[name]} | {running[name]} | {bad[name]} |")
    print(f"{done.total()} kills of {len(done)} commands, {running.total()} of a running one: {bad.total()} left "
          "something")
    return bad.total()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--instants", type=int, default=20, help="for each command and signal (default 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=BUILD / "kills", metavar="DIR", help="default build/kills")
    options = parser.parse_args()
    return 1 if kill_all(options.only, options.out.absolute(), options.instants, options.seed) else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
