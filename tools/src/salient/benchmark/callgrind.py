"""Instructions of a program in user space, counted by valgrind's callgrind and grouped by source folder: a measure of
speed that is independent of the load of the computer.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from salient.bench.emulator import EmulatorProcess
from salient.bench.session import Session
from salient.benchmark.switching_pattern import SwitchingPattern, program, program_input
from salient.config import BenchConfig
from salient.errors import UsageError
from salient.paths import ROOT

GROUPS = {
    "plant": ("emulator/plant/",),
    "control laws": ("firmware/control/", "firmware/fixed/"),
    "drive": ("firmware/drive/", "firmware/interrupts/", "firmware/monitors/", "firmware/storage/", "hal/",
              "emulator/host/hal_host"),
    "CAN": ("firmware/comms/", "emulator/rig/can_", "emulator/rig/transport", "emulator/rig/truth", "/codec/"),
    "rig": ("emulator/rig/",),
}
"""Group -> parts of source paths; the first match counts, everything else is "other", mostly the C library."""

Counts = Counter[str]
"""Instructions by group."""

_SETTLE_S = 0.2


def of_plant(pattern: SwitchingPattern) -> float:
    """Instructions per control period of the plant alone: the increment of one more pass through the pattern."""
    counts = [_count_plant(pattern, passes) for passes in (1, 2)]
    return (counts[1] - counts[0]) / pattern.periods


def of_drive(controller: str, span_s: float) -> dict[str, float]:
    """Instructions per control period by group of plant and firmware at 40 kHz, saturating machine, 600 r/min, 8 N m,
    telemetry to one client: the increment of span_s more of the same run."""
    options = BenchConfig(controller=controller, pace="lockstep")
    more = _count_drive(options, _SETTLE_S + span_s)
    more.subtract(_count_drive(options, _SETTLE_S))
    periods = round(span_s * options.control_rate_hz)
    return {group: more[group] / periods for group in (*GROUPS, "other")}


def _count_plant(pattern: SwitchingPattern, passes: int) -> int:
    def run(prefix: list[str]) -> None:
        subprocess.run([*prefix, str(program(pattern.machine))], input=program_input(pattern, passes),
                       stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)

    return _counted(run).total()


def _count_drive(options: BenchConfig, loaded_s: float) -> Counts:
    def run(prefix: list[str]) -> None:
        with tempfile.TemporaryDirectory(prefix="salient-") as folder:
            can = f"unix:{folder}/can.sock"
            with EmulatorProcess(options, can, prefix), Session(can) as session:
                session.rig.truth_period_us = 0
                session.drive.speed_reference_rpm = 600.0
                session.run_for(_SETTLE_S)
                session.load_torque_Nm = 8.0
                session.run_for(loaded_s)

    return _counted(run)


def _counted(run: Callable[[list[str]], None]) -> Counts:
    """Calls `run` with the command line of the profiler, which precedes the program's."""
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        out = Path(folder) / "callgrind.out"
        try:
            run(["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"])
        except FileNotFoundError:
            raise UsageError("valgrind is missing: install the Debian package valgrind") from None
        return read_counts(out.read_text(encoding="utf-8", errors="replace"))


def read_counts(text: str) -> Counts:
    """Instructions by group from a file of callgrind; format: https://valgrind.org/docs/manual/cl-format.html"""
    names: dict[str, str] = {}
    counts: Counts = Counter()
    function, group, skip = "other", "other", False
    for line in text.splitlines():
        file = re.match(r"(c?f[lie])=\((\d+)\)(?: (.*))?", line)
        if file:
            kind, number, path = file.groups()
            names[number] = path or names[number]
            if kind == "fl":
                function = group = _group(names[number])
            elif kind in ("fi", "fe"):
                # Inlined from another file; headers of the compiler count for the function that they are inlined into.
                inlined = _group(names[number])
                group = function if inlined == "other" else inlined
        elif line.startswith("calls="):
            skip = True  # the next line is the cost of the callee
        elif re.match(r"[+\-*\d]", line):
            if not skip:
                counts[group] += int(line.split()[-1])
            skip = False
    return counts


def _group(path: str) -> str:
    path = path.removeprefix(f"{ROOT}/").replace("/./", "/")
    return next((name for name, parts in GROUPS.items() if any(part in path for part in parts)), "other")
