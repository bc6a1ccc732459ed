"""salient benchmark: speed of emulator and firmware, with reference solvers, and the ablation of the network."""

from __future__ import annotations

import platform
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from salient.bench.emulator import EmulatorProcess, parameter_table
from salient.bench.programs import EmulatorError
from salient.bench.session import Session
from salient.benchmark import callgrind, solvers
from salient.benchmark.switching_pattern import record
from salient.config import CONTROLLERS, BenchConfig
from salient.errors import UsageError
from salient.experiments.network_ablation import run_ablation
from salient.json_file import json_text
from salient.progress import Progress
from salient.reference.ngspice import NgspiceError
from salient.target import isr_profile

SIMULATED_S = 0.9
_SETTLE_S = 0.2
_CONTROL_RATE_HZ = 40_000
_COUNTED_S = 0.1
_MODULES_SHOWN = 6
_LINKED = "finite_element"
"""A machine with a DC-link capacitor."""
_COMMAND_TIMEOUT_MS = 400.0
_ALONE_S = 0.35
"""Virtual time without a client, less than the command timeout; scaled to SIMULATED_S."""
_STARTED_S = 1e-3
"""Processor time: more than receiving a request takes, less than executing it."""
_POLL_S = 1e-4
_START_TIMEOUT_S = 60.0
"""Wall-clock time."""
_ASLEEP_POLLS = 20
"""Consecutive polls that find the process waiting: its virtual time stands still."""

CONDITIONS = {
    "one client": "telemetry to one client every millisecond",
    "no client": "no client on the bus, the last command stays in effect",
    "recording": "as with one client, and the true state on the bus every millisecond and to a file every microsecond",
    "cortex-m4": "as with one client, the firmware on a Cortex-M4 in QEMU",
}


def measure(controller: str, condition: str) -> float:
    """Processor time in s of the executable for SIMULATED_S of a drive at 600 r/min and 8 N m: saturating machine,
    control at 40 kHz. condition: key of CONDITIONS."""
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        recording = condition == "recording"
        options = BenchConfig(
            controller=controller,
            control_rate_hz=_CONTROL_RATE_HZ,
            pace="lockstep",
            record=Path(folder) / "recording.npy" if recording else None,
            build="cortex-m4" if condition == "cortex-m4" else "host",
        )
        can = f"unix:{folder}/can.sock"
        with EmulatorProcess(options, can) as simulator, \
                Session(can, parameter_table=lambda: parameter_table(options)) as session:
                session.drive.parameters["command_timeout_ms"] = _COMMAND_TIMEOUT_MS
                session.rig.truth_period_us = 1000 if recording else 0
                session.drive.speed_reference_rpm = 600.0
                session.run_for(_SETTLE_S)
                session.load_torque_Nm = 8.0
                session.run_for(_SETTLE_S)
                before_s = _processor_s(simulator.pid)
                if condition == "no client":
                    session.leave_running(_ALONE_S)
                    after_s = _until_reached(simulator.pid, can, session.time_s + _ALONE_S, before_s)
                    return (after_s - before_s) * SIMULATED_S / _ALONE_S
                session.run_for(SIMULATED_S)
                return _processor_s(simulator.pid) - before_s


def _until_reached(pid: int, can: str, end_s: float, before_s: float) -> float:
    """Processor time in s when virtual time, running without a client, has reached end_s; EmulatorError when it
    has not or the drive stopped."""
    for _ in range(round(_START_TIMEOUT_S / _POLL_S)):
        if _processor_s(pid) > before_s + _STARTED_S:
            break
        time.sleep(_POLL_S)
    # A client that connects now would end the run of the one that left.
    asleep, after_s = 0, before_s
    while asleep < _ASLEEP_POLLS:
        asleep = asleep + 1 if _asleep(pid) and _processor_s(pid) == after_s else 0
        after_s = _processor_s(pid)
        time.sleep(_POLL_S)
    with Session(can) as session:
        reached_s = session.time_s
        session.run_for(5e-3)  # a period of the telemetry and more
        speed_rpm = session.telemetry["speed_rpm"].last
        if reached_s < end_s - 1e-9 or not 590.0 < speed_rpm < 610.0:
            raise EmulatorError(f"the drive stopped without a client: {speed_rpm:g} r/min at {reached_s:g} s")
        return after_s


def _asleep(pid: int) -> bool:
    """True when every thread of a process waits; EmulatorError when the process has ended."""
    try:
        states = [path.read_text().rpartition(")")[2].split()[0] for path in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:
        return False  # a thread ended in between
    if not states or "Z" in states:
        raise EmulatorError("the drive ended before its time")
    return set(states) == {"S"}


def _processor_s(pid: int) -> float:
    """Processor time of a process, from the clock of clock_getcpuclockid(3) on Linux."""
    return time.clock_gettime((~pid << 3) | 2)


def run(runs: int, json_path: Path | None, page_s: float | None = None, tab: bool = False) -> int:
    """Measures everything `runs` times, prints best and median; page_s: instead the live page for that time; tab:
    instead the drive in a tab. Returns 0."""
    if json_path is not None:
        try:
            json_path.touch()  # reports an unwritable path before the measurement
        except OSError as error:
            raise UsageError(f"--json {json_path}: {error.strerror}") from None
    if page_s is not None:
        from salient.benchmark import live_page

        content = {"schema": 2, "processor": _processor(), "live_page": live_page.measure(page_s)}
        _write(json_path, content)
        return 0
    if tab:
        from salient.benchmark import tab as drive_in_tab

        _write(json_path, {"schema": 2, "processor": _processor(), "tab": drive_in_tab.measure(runs)})
        return 0
    try:
        content = {
            "schema": 2,
            "processor": _processor(),
            "speed": _speed(runs),
            "instructions": _instructions(),
            "cortex_m4": _cortex_m4(),
            "comparison": compare_solvers(runs),
            "network": run_ablation(),
        }
    except NgspiceError as error:
        raise UsageError(str(error)) from None
    _write(json_path, content)
    return 0


def _write(json_path: Path | None, content: dict[str, Any]) -> None:
    if json_path is not None:
        json_path.write_text(json_text(content), encoding="utf-8")


def _speed(runs: int) -> list[dict[str, Any]]:
    print("simulated seconds per second of one core: saturating machine, control at 40 kHz, 600 r/min, 8 N m")
    for condition, meaning in CONDITIONS.items():
        print(f"  {condition}: {meaning}")
    results = []
    for controller in CONTROLLERS:
        for condition in CONDITIONS:
            costs_s = sorted(measure(controller, condition) for _ in range(runs))
            median_s = statistics.median(costs_s)
            results.append({
                "controller": controller,
                "condition": condition,
                "best": round(SIMULATED_S / costs_s[0], 1),
                "median": round(SIMULATED_S / median_s, 1),
                "ns_per_control_period": round(median_s / SIMULATED_S / _CONTROL_RATE_HZ * 1e9),
                "runs": runs,
            })
            print(f"  {controller:<12} {condition:<11} best {results[-1]['best']:6.1f}"
                  f"  median {results[-1]['median']:6.1f}  {results[-1]['ns_per_control_period']} ns a control period",
                  flush=True)
    return results


def _instructions() -> dict[str, Any]:
    """Instructions per control period by controller and group of sources."""
    print("instructions per control period in user space: the same run with one client")
    results = {}
    for controller in CONTROLLERS:
        counts = callgrind.of_drive(controller, _COUNTED_S)
        total = sum(counts.values())
        results[controller] = {group: round(count, 1) for group, count in counts.items()} | {"total": round(total, 1)}
        shares = ", ".join(f"{group} {100 * count / total:.0f} %" for group, count in counts.items())
        print(f"  {controller:<12} {total:6.0f}: {shares}", flush=True)
    return results


def _cortex_m4() -> dict[str, Any]:
    """ISR profile by controller."""
    print("instructions per control interrupt on the Cortex-M4, compiled with -O2: the paper's two experiments")
    results = {}
    for controller in CONTROLLERS:
        profile = isr_profile.measure(controller)
        metrics, modules = profile.metrics(), profile.mean_by_module()
        results[controller] = metrics | {"mean_by_module": {name: round(mean, 1) for name, mean in modules.items()}}
        print(f"  {controller:<12} median {metrics['median']:5d}  p99 {metrics['p99']:5d}  max {metrics['max']:5d};"
              " mean by module: "
              + ", ".join(f"{name} {mean:.0f}" for name, mean in list(modules.items())[:_MODULES_SHOWN]), flush=True)
    return results


def compare_solvers(runs: int) -> dict[str, Any]:
    """Plant alone and reference solvers on a recorded switching pattern: prints and returns one row each."""
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        patterns = {controller: record(Path(folder), controller=controller) for controller in CONTROLLERS}
        patterns |= {f"{controller} on {_LINKED}": record(Path(folder), controller=controller, machine=_LINKED)
                     for controller in CONTROLLERS}
    per_period = {name: round(callgrind.of_plant(pattern), 1) for name, pattern in patterns.items()}
    pattern = patterns["paper"]
    with Progress(1 + len(solvers.PLANT) + len(solvers.REFERENCE_SOLVERS), sys.stderr) as progress:
        rows = solvers.compare(pattern, runs, progress.step)
    print(f"the plant alone and reference solvers: saturating machine, {pattern.duration_s:g} s of the"
          " switching pattern of the paper's controller at 600 r/min, 8 N m")
    print("  simulated seconds per second of one core; right-hand sides per control period; largest deviation from "
          "DOP853 at 1e-12, of current and torque relative to their largest magnitude, of speed to its range")
    print("  SciPy's solvers are compiled, their right-hand sides are Python; ngspice and the plant are compiled")
    for row in rows:
        deviations = "  ".join(f"{name} {value:.1e}" for name, value in row["deviation"].items())
        evaluations = f"{row['evaluations_per_period']:.0f}" if row["evaluations_per_period"] else ""
        print(f"  {row['solver']:<21}{row['simulated_s_per_s']:9.4g}{evaluations:>5}  {deviations}{_comparison(row)}")
    print("  the plant takes "
          + ", ".join(f"{count:.0f} instructions per control period of {name}" for name, count in per_period.items()))
    return {"duration_s": pattern.duration_s, "plant_instructions_per_period": per_period, "solvers": rows}


def _comparison(row: dict[str, Any]) -> str:
    if "plant_times_faster" not in row:
        return ""
    if row["plant_times_faster"] is None:
        return "  more accurate than the plant"
    return f"  {row['compared_with']} is {row['plant_times_faster']:.3g} times faster and at least as accurate"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
