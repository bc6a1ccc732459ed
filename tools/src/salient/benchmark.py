"""salient bench: the figures of the README, measured again: what a simulated second costs, what the network gives."""

from __future__ import annotations

import json
import platform
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from salient.bench import Bench
from salient.errors import UsageError
from salient.network_study import study
from salient.simulator import SimulatorOptions

SIMULATED_S = 1.0
_SETTLE_S = 0.2
_STEP_S = 0.05
_CONTROL_RATE_HZ = 40_000


def measure(controller: str, record: bool) -> float:
    """Processor seconds of the executable for SIMULATED_S of a drive that holds 600 r/min against 8 N m.

    Saturating machine, control at 40 kHz, telemetry to one client each millisecond; record: the true state on the bus
    each millisecond, and to a file each microsecond, too.
    """
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        options = SimulatorOptions(
            controller=controller,
            control_rate_hz=_CONTROL_RATE_HZ,
            record=Path(folder) / "recording.npy" if record else None,
        )
        with Bench(options, f"unix:{folder}/can.sock") as bench:
            bench.rig.truth_period_us = 1000 if record else 0
            bench.drive.speed_reference_rpm = 600.0
            bench.run_for(_SETTLE_S)
            bench.load_torque_Nm = 8.0
            bench.run_for(_SETTLE_S)
            before_s = _processor_s(bench.simulator.pid)
            bench.run_for(SIMULATED_S)
            return _processor_s(bench.simulator.pid) - before_s


def _processor_s(pid: int) -> float:
    """Processor time that a process used so far: the clock that clock_getcpuclockid(3) gives for it on Linux."""
    return time.clock_gettime((~pid << 3) | 2)


def run(runs: int, json_path: Path | None) -> int:
    """Measures every combination `runs` times, prints best and median; returns 0."""
    if runs < 1:
        raise UsageError(f"--runs {runs}: allowed are whole numbers from 1")
    if json_path is not None:
        try:
            json_path.touch()  # a path that cannot be written is better known before the measurement
        except OSError as error:
            raise UsageError(f"--json {json_path}: {error.strerror}") from None
    figures: list[dict[str, Any]] = []
    print("simulated seconds per second of one core: saturating machine, control at 40 kHz, 600 r/min, 8 N m")
    for controller in ("traditional", "paper"):
        for record in (False, True):
            costs_s = sorted(measure(controller, record) for _ in range(runs))
            median_s = statistics.median(costs_s)
            figures.append({
                "controller": controller,
                "recording": record,
                "best": round(SIMULATED_S / costs_s[0], 1),
                "median": round(SIMULATED_S / median_s, 1),
                "ns_per_control_period": round(median_s / SIMULATED_S / _CONTROL_RATE_HZ * 1e9),
                "runs": runs,
            })
            print(f"  {controller:<12} recording {'on ' if record else 'off'}  best {figures[-1]['best']:6.1f}"
                  f"  median {figures[-1]['median']:6.1f}  {figures[-1]['ns_per_control_period']} ns a control period",
                  flush=True)
    network = study()
    if json_path is not None:
        content = {"schema": 1, "processor": _processor(), "speed": figures, "network": network}
        json_path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 0


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
