"""Kills simulator, client, logger and runners with SIGKILL at random moments, and checks what is left.

    build/venv/bin/python tests/tools/kills.py 200 [SEED]

After each kill no process is left, every file can be read, and the next start in the same folder works. Moments are
counted in lines of output, not in time.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import can
import numpy as np

from salient.bench.emulator import EmulatorProcess
from salient.bench.session import Session
from salient.config import BenchConfig
from salient.experiments.tasks import read_results

MARK = "SALIENT_KILLS"
ENDED_WITHIN_S = 120.0
KINDS = ("simulator", "client", "log", "pytest", "sweep", "demo")
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


def client(folder: Path) -> None:
    """A drive with its test bench, recording and memory, that prints a line for each 2 ms."""
    address = f"unix:{folder}/can.sock"
    config = BenchConfig(record=folder / "truth.npy", record_step_ns=10_000, memory=folder / "memory.bin")
    with EmulatorProcess(config, address) as process, Session(address, is_alive=lambda: process.is_alive) as session:
        print(process.pid, flush=True)
        session.drive.speed_reference_rpm = 300
        while True:
            session.run_for(0.002)
            print(session.time_s, flush=True)


def command(kind: str, folder: Path) -> list[str]:
    """What is started. The folder is that of all earlier kills."""
    salient = [sys.executable, "-u", "-m", "salient"]
    if kind in ("simulator", "client"):
        return [sys.executable, "-u", __file__, "client", str(folder)]
    if kind == "log":
        return [*salient, "sim", "--can", f"unix:{folder}/log.sock", "--pace", "realtime"]
    if kind == "pytest":
        (folder / "test_some.py").write_text(SUITE)
        return [sys.executable, "-u", "-m", "pytest", "-v", "-n", "2", "-p", "no:cacheprovider", "--basetemp",
                str(folder / "tmp"), str(folder / "test_some.py")]
    if kind == "demo":
        return [*salient, "demo", "--out", str(folder / "demo")]
    (folder / "some.toml").write_text(SCENARIO)
    return [*salient, "sweep", str(folder / "some.toml"), "--seeds", "12", "--resume", "--out", str(folder / "sweep")]


def kill_once(kind: str, folder: Path, number: int, chance: random.Random) -> int:
    """Starts something, kills it after a random number of lines; returns that number."""
    mark = f"{os.getpid()}-{number}"
    environment = {**os.environ, MARK: mark, "PYTHONPATH": ""}
    lines = chance.randrange(1, 12)
    with subprocess.Popen(command(kind, folder), env=environment, cwd=folder, stdin=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        victim = process.pid
        if kind == "simulator":
            victim = int(first)
        elif kind == "log":
            logger = subprocess.Popen([sys.executable, "-m", "salient", "log", "--can", f"unix:{folder}/log.sock",
                                       "--out", str(folder / "can.blf")], env=environment, stdout=subprocess.PIPE)
            while not (folder / "can.blf").exists():
                assert logger.poll() is None
            victim = logger.pid
        for _ in range(lines if kind != "log" else 0):
            if not process.stdout.readline():
                break  # it has finished
        with contextlib.suppress(ProcessLookupError):
            os.kill(victim, signal.SIGKILL)
        if kind == "log":
            logger.communicate()
            process.terminate()
        process.stdout.read()  # to the end of all that write into it
    wait_until_ended(mark)
    check_files(folder)
    return lines


def wait_until_ended(mark: str) -> None:
    """AssertionError when a process that was started with the mark goes on."""
    deadline_s = time.monotonic() + ENDED_WITHIN_S
    while left := [path.parent for path in Path("/proc").glob("[0-9]*/environ") if is_marked(path, mark)]:
        assert time.monotonic() < deadline_s, [(path / "cmdline").read_bytes() for path in left]


def is_marked(path: Path, mark: str) -> bool:
    try:
        return f"{MARK}={mark}\0".encode() in path.read_bytes()
    except OSError:
        return False


def check_files(folder: Path) -> None:
    """Every file that the killed programs have written can be read."""
    if (folder / "truth.npy").exists():
        np.load(folder / "truth.npy")
    for path in folder.glob("*.blf"):
        if path.stat().st_size:
            with can.LogReader(path) as log:
                assert all(message.dlc <= 8 for message in log)
    if (folder / "sweep").exists():
        read_results(folder / "sweep")


def main(count: int, seed: int = 1) -> None:
    """Kills `count` times, each kind in turn, and then lets everything run once."""
    chance = random.Random(seed)
    done: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        folder = Path(name)
        for number in range(count):
            kind = KINDS[number % len(KINDS)]
            after = kill_once(kind, folder, number, chance)
            done[kind] += 1
            print(f"{number + 1}/{count} {kind} after {after} lines", flush=True)
        for kind in ("pytest", "sweep"):
            if done[kind]:
                last = subprocess.run(command(kind, folder), cwd=folder, capture_output=True, text=True)
                assert last.returncode == 0, last.stdout + last.stderr
        check_files(folder)
    print(f"killed {', '.join(f'{kind} {times} times' for kind, times in done.items())}; seed {seed}: nothing left "
          "running, every file readable, the next start works")


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(Path(sys.argv[2]))
    else:
        main(*map(int, sys.argv[1:]))
