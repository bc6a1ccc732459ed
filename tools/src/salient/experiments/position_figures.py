"""Position mode measured: moves, holding, cyclic positions; writes the tables of docs/reference/position.md.

    build/venv/bin/python -m salient.experiments.position_figures [MACHINE ...]

Machines are names of bundled ones or files. Every run is one bench in lock-step with a seed, so that the figures are
the same each time. A count is one of 17 bits, whatever the encoder.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from salient.bench.bench import Bench
from salient.config import BenchConfig
from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.paths import ROOT

COUNT_DEG = 360 / 2**17
PAGE = ROOT / "docs" / "reference" / "position.md"
MACHINES = ("saturating", "finite_element", "linear_cosine", "linear_trapezoid")
MOVES_DEG = (0.1, 1.0, 10.0, 90.0, 360.0, 3600.0)
_RECORD_STEP_NS = 50_000
_BEGIN_S = 0.08
_BOUND_DELAY_S = 2 / 40_000
_RESTS_DEG = (0.0, 7.3, 31.0)
_HEAD = """# Position mode, measured

Written by `build/venv/bin/python -m salient.experiments.position_figures`; do not edit.
[Position control](../control/position.md) explains the mode. A count is 360 / 2^17 degrees. The encoder has 17 bits and
the inertia is the parameter's, where a table states nothing else.
"""


@dataclass(frozen=True)
class Limits:
    """Limits of a profile, in rad and s; the deceleration is the acceleration."""

    speed: float
    acceleration: float
    jerk: float

    def least_time_s(self, way: float) -> float:
        """Time of the S-curve from rest to rest (Biagiotti, Melchiorri, "Trajectory Planning for Automatic Machines and
        Robots", 2008, 3.4)."""
        def ramp(speed: float) -> float:
            most = self.acceleration
            full = speed >= most * most / self.jerk
            return speed / most + most / self.jerk if full else 2 * math.sqrt(speed / self.jerk)

        if self.speed * ramp(self.speed) <= way:
            return 2 * ramp(self.speed) + (way - self.speed * ramp(self.speed)) / self.speed
        low, high = 0.0, self.speed
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (low, middle) if middle * ramp(middle) > way else (middle, high)
        return 2 * ramp(low)


def limits_of(machine: str) -> Limits:
    """Six tenths of the largest torque on the true inertia, reached in 5 ms, and half of over_speed_rpm: limits of a
    user who knows the machine."""
    parameters = derive(load_machine(machine_path(machine))).parameters
    acceleration = 0.6 * parameters["torque_max_Nm"] / parameters["inertia_kg_m2"]
    return Limits(parameters["over_speed_rpm"] / 2 * math.pi / 30, acceleration, acceleration / 0.005)


def _parameters(machine: str, limits: Limits, ratio: float = 1.0) -> dict[str, float]:
    """Parameters of the drive; ratio: true inertia by the parameter's."""
    inertia = derive(load_machine(machine_path(machine))).parameters["inertia_kg_m2"]
    rpm = 30 / math.pi
    return {"inertia_kg_m2": inertia / ratio, "position_speed_rpm": round(limits.speed * rpm),
            "position_accel_rpm_s": round(limits.acceleration * rpm),
            "position_jerk_rpm_s2": min(round(limits.jerk * rpm), 2**31 - 1)}


@contextmanager
def _holding(machine: str, parameters: dict[str, float], **options: Any) -> Iterator[tuple[Bench, Path]]:
    """A bench whose drive holds its position from _BEGIN_S on, and its recording, which is there after the end."""
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        recording = Path(folder) / "recording.npy"
        config = BenchConfig(machine=machine, record=recording, record_step_ns=_RECORD_STEP_NS, telemetry_period_ms=1,
                             **options)
        with Bench(config, f"unix:{folder}/can.sock") as bench:
            if parameters:
                bench.drive.parameters.update(parameters)
            bench.drive.halt()
            bench.advance_to(round(_BEGIN_S * 1e9))
            yield bench, recording


def _angle(recording: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and angle in degrees over turns, from that at _BEGIN_S on."""
    record = np.load(recording)
    angle_deg = np.unwrap(record["rotor_angle_deg"].astype(float), period=360.0)
    first = int(np.searchsorted(record["time_s"], _BEGIN_S))
    return record["time_s"][first:] - _BEGIN_S, angle_deg[first:] - angle_deg[first]


# --- measurements ----------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Move:
    """Overshoot of the true angle and time until it stays within two counts; the least time; the range in the last 100
    ms, in counts."""

    overshoot: float
    settling_s: float
    least_s: float
    held: float
    fault: str


def measure_move(machine: str, way_deg: float, ratio: float = 1.0, moves_before: int = 0, **options: Any) -> Move:
    """A move from rest, after others there and back by which an inertia becomes known."""
    limits = limits_of(machine)
    least_s = limits.least_time_s(math.radians(way_deg))
    with _holding(machine, _parameters(machine, limits, ratio), **options) as (bench, recording):
        for index in range(moves_before):
            bench.drive.position_deg = (way_deg, 0.0)[index % 2]
            bench.run_for(least_s + 0.3)
        begin_s = bench.time_s
        bench.drive.position_deg = way_deg
        bench.run_for(least_s + 0.3)
        fault = bench.drive.fault
        bench.close()
        time_s, angle_deg = _angle(recording)
    after = time_s >= begin_s - _BEGIN_S
    time_s, angle_deg = time_s[after] - (begin_s - _BEGIN_S), angle_deg[after]
    error = (angle_deg - way_deg) / COUNT_DEG
    outside = np.nonzero(np.abs(error) > 2)[0]
    return Move(float(error.max()), float(time_s[outside[-1]]) if len(outside) else 0.0, least_s,
                float(np.ptp(error[time_s > time_s[-1] - 0.1])), fault)


@dataclass(frozen=True)
class Hold:
    """deviation and range in counts; back_s: until it stays within one and a half."""

    deviation: float
    bound: float
    back_s: float
    before: float
    after: float


def measure_hold(machine: str, part: float, rest_deg: float, encoder_bits: int = 17) -> Hold:
    """A step of the load by a part of the largest torque, on a rotor that rests at an angle."""
    torque_max_Nm = derive(load_machine(machine_path(machine))).parameters["torque_max_Nm"]
    with _holding(machine, {}, encoder_bits=encoder_bits, initial_angle_deg=rest_deg) as (bench, recording):
        bench.run_for(0.1)
        step_s = bench.time_s
        bench.load_torque_Nm = part * torque_max_Nm
        bench.run_for(0.4)
        bench.close()
        time_s, angle_deg = _angle(recording)
    time_s = time_s - (step_s - _BEGIN_S)
    before = angle_deg[(time_s > -0.05) & (time_s < 0)] / COUNT_DEG
    since, error = time_s[time_s >= 0], angle_deg[time_s >= 0] / COUNT_DEG - before.mean()
    outside = np.nonzero(np.abs(error) > 1.5 * 2.0**(17 - encoder_bits))[0]
    bound = hold_bound_rad(load_machine(machine_path(machine)), part, math.radians(rest_deg),
                           math.radians(360 / 2**encoder_bits))
    return Hold(float(np.abs(error).max()), math.degrees(bound) / COUNT_DEG,
                float(since[outside[-1]]) if len(outside) else 0.0, float(np.ptp(before)),
                float(np.ptp(error[since > 0.3])))


def hold_bound_rad(machine: Machine, part: float, rest_rad: float, count_rad: float) -> float:
    """Least deviation under a step of the load by a part of the largest torque: from the period after the next, once
    the load has turned the rotor by a count, all phases whose torque opposes it have the full voltage, until the
    torque is the largest one; that acts until the rotor stands. A rotor on an edge leaves its count at once, but
    without a load, too."""
    data = derive(machine)
    load_Nm, most_Nm = part * data.parameters["torque_max_Nm"], data.parameters["torque_max_Nm"]
    inertia, step_s = data.parameters["inertia_kg_m2"], 1e-6
    current_A = np.linspace(0.0, data.parameters["current_limit_A"], 400)
    phases = []
    for phase in range(machine.phases):
        angle_rad = np.full_like(current_A, rest_rad - phase * machine.pitch_rad / machine.phases)
        torque_Nm = machine.magnetics.torque_Nm(angle_rad, current_A)
        if torque_Nm[-1] > 0:
            phases.append((machine.magnetics.flux_linkage_Wb(angle_rad, current_A), torque_Nm))
    linkage_Wb = np.zeros(len(phases))
    way = speed = torque = waited_s = 0.0
    while waited_s < 0.1 and (waited_s < _BOUND_DELAY_S or speed > 0):
        waited_s += step_s if way >= count_rad else 0.0
        if waited_s >= _BOUND_DELAY_S and torque < most_Nm:
            torque = 0.0
            for index, (flux_Wb, torque_Nm) in enumerate(phases):
                present_A = float(np.interp(linkage_Wb[index], flux_Wb, current_A))
                rise_V = machine.supply_voltage_V - machine.resistance_ohm * present_A
                linkage_Wb[index] = min(linkage_Wb[index] + rise_V * step_s, flux_Wb[-1])
                torque += float(np.interp(linkage_Wb[index], flux_Wb, torque_Nm))
            torque = min(torque, most_Nm)
        speed += (load_Nm - torque) / inertia * step_s
        way += speed * step_s
    return way


def measure_sine(machine: str, frequency_Hz: float, cycle_ms: int) -> tuple[float, float, float, float]:
    """Amplitude and largest following error in degrees, delay of the rotor behind the sine in ms, and its largest
    deviation from the sine with that delay in degrees; a quarter of the largest torque, at most an eighth of
    over_speed_rpm."""
    parameters = derive(load_machine(machine_path(machine))).parameters
    rate = 2 * math.pi * frequency_Hz
    acceleration = parameters["torque_max_Nm"] / 4 / parameters["inertia_kg_m2"]
    amplitude_deg = math.degrees(min(acceleration / rate**2, parameters["over_speed_rpm"] / 8 * math.pi / 30 / rate))
    with _holding(machine, {"position_cycle_ms": cycle_ms}) as (bench, recording):
        begin_s, rise_s = bench.time_s, max(0.2, 1 / frequency_Hz)
        while bench.time_s < begin_s + rise_s + 2 / frequency_Hz:
            time_s = bench.time_s - begin_s
            part = min(1.0, time_s / rise_s)
            bench.drive.follow_position(amplitude_deg * part * part * (3 - 2 * part) * math.sin(rate * time_s))
            bench.run_for(cycle_ms * 1e-3)
        series = bench.telemetry["DRIVE_POSITION.following_error_deg"]
        errors_deg = np.abs(np.asarray(series.between(begin_s + rise_s, bench.time_s).value, dtype=float))
        bench.close()
        times_s, angle_deg = _angle(recording)
    late = times_s > rise_s + 0.03
    sine, cosine = np.sin(rate * times_s[late]), np.cos(rate * times_s[late])
    (in_phase, behind), *_ = np.linalg.lstsq(np.column_stack([sine, cosine]), angle_deg[late], rcond=None)
    delay_s = math.atan2(-behind, in_phase) / rate
    expected = amplitude_deg * np.sin(rate * (times_s[late] - delay_s))
    return amplitude_deg, float(errors_deg.max()), delay_s * 1e3, float(np.abs(angle_deg[late] - expected).max())


def measure_standstill(machine: str, encoder_bits: int, duration_s: float) -> float:
    """Range of the angle, in counts of the encoder, under a load of a quarter of the largest torque, after the first
    half second."""
    torque_max_Nm = derive(load_machine(machine_path(machine))).parameters["torque_max_Nm"]
    with _holding(machine, {}, encoder_bits=encoder_bits) as (bench, recording):
        bench.load_torque_Nm = torque_max_Nm / 4
        bench.run_for(duration_s)
        bench.close()
        time_s, angle_deg = _angle(recording)
    return float(np.ptp(angle_deg[time_s > 0.5]) * 2.0**encoder_bits / 360)


# --- page -------------------------------------------------------------------------------------------------------------

def _table(title: str, heads: str, rows: list[str]) -> str:
    line = "| " + " | ".join("---" for _ in heads.split("|")) + " |"
    return "\n".join([f"## {title}", "", f"| {heads} |", line, *rows, ""])


def _name(machine: str) -> str:
    return Path(machine).stem


def _move_row(first: str, way_deg: float, move: Move) -> str:
    return (f"| {first} | {way_deg:g} | {move.overshoot:.1f} | {move.settling_s * 1e3:.1f} | "
            f"{move.least_s * 1e3:.1f} | {(move.settling_s - 0.005) / move.least_s:.2f} | {move.held:.1f} | "
            f"{move.fault} |")


_MOVE_HEADS = ("way, deg | overshoot, counts | settled, ms | least, ms | (settled - 5 ms) by least | held, counts | "
               "fault")


def moves(machines: tuple[str, ...]) -> str:
    """Moves of every machine."""
    rows = [_move_row(_name(machine), way, measure_move(machine, way)) for machine in machines for way in MOVES_DEG]
    return _table("Moves", f"machine | {_MOVE_HEADS}", rows)


def inertias(machine: str) -> str:
    """Moves with another inertia than the parameter's: the first one, and the third."""
    rows = [_move_row(f"{ratio:g} | {before + 1}.", way, measure_move(machine, way, ratio, before))
            for ratio in (0.3, 0.5, 2.0, 5.0) for way in (1.0, 90.0) for before in (0, 2)]
    return _table(f"Inertia by the parameter's, {_name(machine)}", f"inertia | move | {_MOVE_HEADS}", rows)


def encoders(machine: str) -> str:
    """Moves and standstill with 10 to 18 bits."""
    rows = []
    for bits in (10, 12, 13, 14, 17, 18):
        move = measure_move(machine, 90.0, encoder_bits=bits)
        rows.append(f"| {bits} | {move.overshoot * 2.0**(bits - 17):.2f} | {move.settling_s * 1e3:.1f} | "
                    f"{measure_standstill(machine, bits, 5.0):.2f} |")
    return _table(f"Encoders, {_name(machine)}, 90 degrees",
                  "bits | overshoot, counts of the encoder | within two counts of 17 bits, ms | 5 s at standstill "
                  "under a quarter of torque_max_Nm, counts of the encoder", rows)


def holding(machines: tuple[str, ...]) -> str:
    """Steps of the load, and a minute at standstill."""
    rows = []
    for machine in machines:
        for part in (0.25, 0.5):
            for rest_deg in _RESTS_DEG:
                hold = measure_hold(machine, part, rest_deg)
                rows.append(f"| {_name(machine)} | {part:g} | {rest_deg:g} | {hold.deviation:.1f} | {hold.bound:.1f} | "
                            f"{hold.deviation / hold.bound:.2f} | {hold.back_s * 1e3:.1f} | {hold.before:.2f} | "
                            f"{hold.after:.2f} |")
    minute = measure_standstill(machines[0], 17, 60.0)
    text = _table("Holding under a step of the load",
                  "machine | step, of torque_max_Nm | at, deg | deviation, counts | bound | by bound | "
                  "back within 1.5 counts, ms | range before | range after", rows)
    return text + ("\nThe bound is a drive that has the full voltage on all phases which oppose the load two control "
                   "periods after\nthe first count, until the torque is the largest one.\n\n"
                   f"60 s at standstill under a quarter of torque_max_Nm, {_name(machines[0])}: a range of "
                   f"{minute:.2f} counts.\n")


def sines(machine: str) -> str:
    """Cyclic positions."""
    rows = []
    for frequency_Hz in (1.0, 5.0, 10.0, 20.0):
        for cycle_ms in (1, 4, 10):
            amplitude, error, delay_ms, deviation = measure_sine(machine, frequency_Hz, cycle_ms)
            rows.append(f"| {frequency_Hz:g} | {cycle_ms} | {amplitude:.2f} | {error:.4f} | {delay_ms:.2f} | "
                        f"{deviation:.4f} |")
    return _table(f"Cyclic sines, {_name(machine)}",
                  "Hz | cycle, ms | amplitude, deg | following error, deg | delay, ms | from the delayed sine, deg",
                  rows)


def main() -> int:
    """Writes the page; returns the exit code."""
    machines = tuple(sys.argv[1:]) or MACHINES
    parts: list[Callable[[], str]] = [
        lambda: moves(machines), lambda: inertias(machines[0]), lambda: encoders(machines[0]),
        lambda: holding(machines), lambda: sines(machines[0])]
    page = "\n".join([_HEAD, *(part() for part in parts)])
    if machines == MACHINES:
        PAGE.write_text(page.rstrip() + "\n", encoding="utf-8")
    else:
        print(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
