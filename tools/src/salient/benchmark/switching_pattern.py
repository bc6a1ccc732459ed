"""Switching-pattern playback: a pattern recorded from a controlled drive, played back on the plant alone and on
reference solvers of the same machine, so that all of them compute the same trajectory.
"""

from __future__ import annotations

import itertools
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from salient.bench.bench import Bench
from salient.config import BenchConfig
from salient.dbc import PHASES, PHASES_MAX
from salient.errors import UsageError
from salient.machine.file import load_machine, machine_path
from salient.paths import BUILD, from_root

TICK_NS = 5
"""PWM_TIMER_TICK_NS of emulator/plant/pwm_timer.h."""

_SETTLE_S = 0.2
_STATE = np.dtype([("angle_rad", "f8"), ("speed_rad_s", "f8"), ("torque_Nm", "f8"), ("current_A", "f8", PHASES_MAX)])


@dataclass(frozen=True)
class SwitchingPattern:
    """Compare values of each control period of 2 * period_ticks ticks (rows: periods, columns: phases, for upper and
    lower switches), and the initial state of the machine."""

    machine: str
    period_ticks: int
    upper: np.ndarray
    lower: np.ndarray
    angle_rad: float
    speed_rad_s: float
    load_torque_Nm: float
    current_A: tuple[float, ...]

    @property
    def periods(self) -> int:
        return len(self.upper)

    @property
    def phases(self) -> int:
        return int(self.upper.shape[1])

    @property
    def period_ns(self) -> int:
        return 2 * self.period_ticks * TICK_NS

    @property
    def duration_s(self) -> float:
        return self.periods * self.period_ns * 1e-9

    def first(self, periods: int) -> SwitchingPattern:
        """The first `periods` control periods."""
        return replace(self, upper=self.upper[:periods], lower=self.lower[:periods])

    def segments(self, period: int) -> Iterator[tuple[int, int, list[int]]]:
        """(start, end, switches on per phase: 0 to 2) in ns from the period's start, between the edges of its pulses as
        hal/hal_pwm.h defines them: the upper's around the period's middle, the lower's split over its two ends."""
        ticks = self.period_ticks
        upper = np.minimum(self.upper[period], ticks).tolist()
        lower = np.minimum(self.lower[period], ticks).tolist()
        instants = {0, 2 * ticks}
        for up, low in zip(upper, lower, strict=True):
            instants |= {ticks - up, ticks + up, low, 2 * ticks - low}
        for start, end in itertools.pairwise(sorted(instants)):
            from_middle = abs((start + end) / 2 - ticks)
            on = [(from_middle < up) + (ticks - from_middle < low) for up, low in zip(upper, lower, strict=True)]
            yield start * TICK_NS, end * TICK_NS, on


@dataclass(frozen=True)
class Trajectory:
    """States at the end of each control period, and the processor time of the solver."""

    angle_rad: np.ndarray
    speed_rad_s: np.ndarray
    torque_Nm: np.ndarray
    current_A: np.ndarray
    """Rows: periods, columns: phases."""
    processor_s: float
    evaluations: int | None = None
    """Number of evaluations of the right-hand side, if counted."""


def deviation(measured: Trajectory, reference: Trajectory) -> dict[str, float]:
    """Largest deviation of currents, torque and speed over the whole run, relative to the largest magnitude of the
    quantity in the reference, of the speed to its range there."""
    scale = {
        "current": np.max(np.abs(reference.current_A)),
        "torque": np.max(np.abs(reference.torque_Nm)),
        "speed": np.ptp(reference.speed_rad_s),
    }
    difference = {
        "current": measured.current_A - reference.current_A,
        "torque": measured.torque_Nm - reference.torque_Nm,
        "speed": measured.speed_rad_s - reference.speed_rad_s,
    }
    return {name: float(np.max(np.abs(difference[name])) / scale[name]) for name in scale}


def record(folder: Path, duration_s: float = 0.1, controller: str = "paper",
           machine: str = "saturating") -> SwitchingPattern:
    """Records a controller on a bundled machine at 40 kHz, 600 r/min and 8 N m, from 0.4 s after the start. The
    recording of the true state, one row per control period, is written to `folder`."""
    load_torque_Nm, control_rate_hz = 8.0, 40_000
    period_ns = 1_000_000_000 // control_rate_hz
    recording, switches = folder / "recording.npy", folder / "switches"
    options = BenchConfig(
        machine=machine,
        controller=controller,
        control_rate_hz=control_rate_hz,
        record=recording,
        record_from_us=round(2 * _SETTLE_S * 1e6),
        record_step_ns=period_ns,
        record_switches=switches,
    )
    with Bench(options, f"unix:{folder}/can.sock") as bench:
        bench.rig.truth_period_us = 0
        bench.drive.speed_reference_rpm = 600.0
        bench.run_for(_SETTLE_S)
        bench.load_torque_Nm = load_torque_Nm
        bench.run_for(_SETTLE_S + duration_s)
    start = np.load(recording)[0]
    compares = np.fromfile(switches, dtype="u2").reshape(-1, 2, PHASES_MAX)
    phases = load_machine(machine_path(machine)).phases
    # The first row takes effect at the end of the first period.
    first = round(start["time_s"] * 1e9 / period_ns) - 1
    rows = compares[first : first + round(duration_s * 1e9 / period_ns), :, :phases].astype(int)
    return SwitchingPattern(
        machine=machine,
        period_ticks=period_ns // (2 * TICK_NS),
        upper=rows[:, 0],
        lower=rows[:, 1],
        angle_rad=float(np.radians(start["rotor_angle_deg"], dtype=float)),
        speed_rad_s=float(start["speed_rpm"]) * np.pi / 30.0,
        load_torque_Nm=load_torque_Nm,
        current_A=tuple(float(start[f"current_{PHASES[phase]}_A"]) for phase in range(phases)),
    )


def program(machine: str) -> Path:
    """Executable of the plant alone for a bundled machine; UsageError when it is not built."""
    path = BUILD / "host" / "bin" / f"plant_benchmark_{machine}"
    if not path.exists():
        raise UsageError(f"{from_root(path)} is not built; tools/salient benchmark builds it")
    return path


def program_input(pattern: SwitchingPattern, passes: int, step_factor: float = 1.0) -> bytes:
    """Input of plant_benchmark_<machine> (emulator/plant_benchmark/main.c)."""
    current_A = [*pattern.current_A, *[0.0] * (PHASES_MAX - pattern.phases)]
    state = (pattern.angle_rad, pattern.speed_rad_s, pattern.load_torque_Nm, *current_A, step_factor)
    head = struct.pack(f"{4 + PHASES_MAX}d4I", *state, pattern.period_ticks, pattern.periods, passes, 0)
    compares = np.zeros((pattern.periods, 2, PHASES_MAX), dtype="u2")
    compares[:, 0, : pattern.phases], compares[:, 1, : pattern.phases] = pattern.upper, pattern.lower
    return head + compares.tobytes()


def run_plant(pattern: SwitchingPattern, passes: int, step_factor: float = 1.0) -> Trajectory:
    """Plays the pattern back on the plant alone; processor_s is the shortest of the passes."""
    done = subprocess.run([program(pattern.machine)], input=program_input(pattern, passes, step_factor),
                          stdout=subprocess.PIPE, check=True)
    times_s = np.frombuffer(done.stdout[: 8 * passes])
    states = np.frombuffer(done.stdout[8 * passes :], dtype=_STATE)
    return Trajectory(states["angle_rad"], states["speed_rad_s"], states["torque_Nm"],
                      states["current_A"][:, : pattern.phases], float(np.min(times_s)))
