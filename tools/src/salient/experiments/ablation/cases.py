"""The runs of the ablation: machines, speeds, loads, encoders and imperfections, drawn by number.

A run starts without a load, takes a load step, and is judged at its end. What is varied on purpose follows from the
number of the case alone; the seed draws the rest: angle at the start, noise of the current sensors, resistance,
friction, and the time of the load within a turn. Two seeds therefore show how much a figure scatters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from salient.experiments.campaign.machines import files
from salient.experiments.scaled import scale_of
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep
from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData, derive
from salient.machine.file import load_machine
from salient.machine.lowest_speed import lowest_speed_rpm
from salient.machine.path import stated_conditions
from salient.machine.scaling import scaling_of

USUAL, BEATS, COUNT = 60, 84, 96
"""Runs of usual conditions, those before the beats, and all."""
EDGES = ("slow strokes", "lowest speed", "far")
BEAT = "beat"
BEAT_BITS = (13, 14, 15)
CONDITIONS_SEED = 45
SPEED_PARTS = (0.01, 0.02, 0.1, 0.5, 1.0)
SPEED_WEIGHTS = (0.2, 0.15, 0.3, 0.25, 0.1)
BITS = (9, 10, 12, 14, 17)
LOADS = ("step", "sine", "ramps", "turn")
LOAD_WEIGHTS = (0.4, 0.2, 0.25, 0.15)
PROFILES = ("compressor_one_cylinder", "compressor_two_cylinders")
PROFILE_MAX_NM = 200.0
"""Largest of the rig's load_profile_Nm."""
COARSE_BITS, SLOW_PART = 12, 0.02
LONG_S = 2.0
RAMPS_END_S = 0.15
"""Time from the end of ramps to the window that is judged."""
CHANGES_MAX = 60
WINDOW_S, WINDOW_MAX_S = 0.1, 0.5
TRUTH_US = 2000.0


@dataclass(frozen=True)
class Case:
    """A run. parts: the parts of the set that it belongs to."""

    number: int
    scenario: Scenario
    parts: tuple[str, ...]
    base_rpm: float


@cache
def _machine(path: Path) -> Machine:
    return load_machine(path)


@cache
def _data(path: Path) -> DriveData:
    return derive(_machine(path))


@cache
def _rate_hz(path: Path) -> int:
    return max(_data(path).control_rate_hz, scaling_of(path, _machine(path)).control_rate_min_hz(_machine(path)))


def _single(value: float) -> float:
    """As the rig takes it: a 24-bit integer of at most four decimals."""
    return round(value, 4)


def _load_kind(draw: np.random.Generator, part: float) -> str:
    """A load that repeats with the turn needs turns to be learned."""
    kind = str(draw.choice(LOADS, p=LOAD_WEIGHTS))
    return "step" if kind == "turn" and part < 0.1 else kind


def _imperfections(draw: np.random.Generator, poles: int) -> tuple[dict[str, float], list[str]]:
    """Variables of the rig that a case has on purpose, and the parts of the set."""
    bench: dict[str, float] = {}
    parts = []
    sign = float(draw.choice((-1.0, 1.0)))
    offset, eccentricity = draw.uniform(0.3, 0.7), draw.uniform(0.05, 0.2)
    if draw.uniform() < 0.5:
        bench["encoder_offset_deg"] = _single(sign * offset * 4.0 / poles)
        parts.append("misaligned")
    if draw.uniform() < 0.2:
        bench["encoder_eccentricity_deg"] = _single(eccentricity * 4.0 / poles)
        parts.append("eccentric")
    gain = float(draw.choice((0.9, 1.1)))
    if draw.uniform() < 0.3:
        bench["flux_linkage_gain"] = gain
        parts.append("tables")
    gain = float(draw.choice((0.5, 2.0)))
    if draw.uniform() < 0.35:
        bench["inertia_gain"] = gain
        parts.append("inertia")
    gain = float(draw.uniform(0.94, 1.06))
    if draw.uniform() < 0.15:
        bench["current_sensor_gain"] = _single(gain)
        parts.append("sensors")
    return bench, parts


@dataclass(frozen=True)
class _Drawn:
    """Quantities varied on purpose."""

    rpm: float
    bits: int
    kind: str
    bench: dict[str, float]
    parts: list[str]
    torque_Nm: float
    swing_Nm: float
    frequency_Hz: float
    settle_s: float


def _drawn(draw: np.random.Generator, path: Path) -> _Drawn:
    data = _data(path)
    part = float(draw.choice(SPEED_PARTS, p=SPEED_WEIGHTS))
    bits = int(draw.choice(BITS))
    rpm = max(part * data.speed_base_rpm, 1.1 * lowest_speed_rpm(str(path), bits, "salient"))
    kind = _load_kind(draw, part)
    bench, parts = _imperfections(draw, _machine(path).rotor_poles)
    torque_Nm = data.torque_rated_Nm * draw.uniform(0.3, 0.6) * (0.6 if part == 1.0 else 1.0)
    swing_Nm = min(torque_Nm * draw.uniform(0.3, 0.5), PROFILE_MAX_NM)
    frequency_Hz = round(math.exp(draw.uniform(math.log(5.0), math.log(20.0))), 2)
    is_long = draw.uniform() < (0.4 if "misaligned" in parts and kind != "step" else 0.12)
    settle_s = LONG_S if is_long else 0.5 if "misaligned" in parts else 0.3
    return _Drawn(rpm, bits, kind, bench, parts, torque_Nm, swing_Nm, frequency_Hz, settle_s)


def _at_an_edge(draw: np.random.Generator, path: Path, edge: str) -> _Drawn:
    """Conditions that few drives have and some mechanisms were made for: a load that moves several times within a slow
    stroke, the lowest speed of a coarse encoder, a machine far from its file."""
    machine, data = _machine(path), _data(path)
    torque_Nm = 0.4 * data.torque_rated_Nm
    bench: dict[str, float] = {}
    parts = [edge]
    if edge == "lowest speed":
        bits = int(draw.choice(BITS[:3]))
        rpm = 1.05 * lowest_speed_rpm(str(path), bits, "salient")
        return _Drawn(rpm, bits, "step", bench, parts, torque_Nm, 0.0, 10.0, 1.0)
    offset_deg = (0.3 if edge == "slow strokes" else draw.uniform(1.0, 3.0)) * 4.0 / machine.rotor_poles
    if draw.uniform() < 0.5:
        bench["encoder_offset_deg"] = _single(offset_deg)
        parts.append("misaligned")
    if edge == "slow strokes":
        strokes_Hz = draw.uniform(2.0, 8.0)
        rpm = 60.0 * strokes_Hz / (machine.phases * machine.rotor_poles)
        return _Drawn(rpm, 17, "sine", bench, parts, torque_Nm, draw.uniform(0.15, 0.35) * torque_Nm,
                      round(strokes_Hz * draw.uniform(0.8, 3.0), 2), LONG_S + 0.5)
    bench["inertia_gain"] = float(draw.choice((0.2, 0.33, 3.0, 5.0)))
    parts.append("inertia")
    rpm = float(draw.choice((0.1, 0.4))) * data.speed_base_rpm
    return _Drawn(rpm, int(draw.choice(BITS[3:])), "step", bench, parts, torque_Nm, 0.0, 10.0, 0.8)


def _in_a_beat(draw: np.random.Generator, path: Path) -> _Drawn:
    """A step at nearly one or two counts in a control period, with tables, supply and inertia that are not the drive's:
    as the random drives of `tools/salient compare robustness` that a change of the schedule has moved most."""
    data = _data(path)
    bits = int(draw.choice(BEAT_BITS))
    counts = float(draw.choice((1.0, 2.0))) + draw.uniform(-0.03, 0.03)
    rpm = counts * _rate_hz(path) / 2**bits * 60.0
    while rpm > data.speed_base_rpm:
        bits, rpm = bits + 1, rpm / 2.0
    bench = {
        "flux_linkage_gain": _single(draw.uniform(0.9, 1.1)),
        "inertia_gain": _single(math.exp(draw.uniform(math.log(0.5), math.log(3.0)))),
        "encoder_offset_deg": _single(draw.uniform(-0.1, 0.1) * 4.0 / _machine(path).rotor_poles),
    }
    return _Drawn(rpm, bits, "step", bench, [BEAT, "tables"], 0.4 * data.torque_rated_Nm, 0.0, 10.0,
                  float(draw.choice((0.1, 0.2, 0.5))))


def _conditions(draw: np.random.Generator, path: Path, number: int) -> _Drawn:
    if number < USUAL:
        return _drawn(draw, path)
    return _at_an_edge(draw, path, EDGES[number % len(EDGES)]) if number < BEATS else _in_a_beat(draw, path)


@cache
def make_case(number: int, seed: int) -> Case:
    """The case of a number, with what the seed draws."""
    draw, other = np.random.default_rng([CONDITIONS_SEED, number]), np.random.default_rng([seed, number])
    path = files()[number % len(files())]
    machine, data = _machine(path), _data(path)
    drawn = _conditions(draw, path, number)
    rpm, kind, bench, torque_Nm, swing_Nm = drawn.rpm, drawn.kind, drawn.bench, drawn.torque_Nm, drawn.swing_Nm
    frequency_Hz, settle_s = drawn.frequency_Hz, drawn.settle_s

    start_s = 1.5 * scale_of(machine).start_s_per_rpm * rpm * bench.get("inertia_gain", 1.0) + 0.1
    loaded_s = round(start_s + 0.1 * other.uniform(), 4)
    turn_s = 60.0 / rpm
    window_s = min(max(WINDOW_S, turn_s / machine.rotor_poles, 1.0 / frequency_Hz if kind == "sine" else 0.0),
                   WINDOW_MAX_S)
    if kind == "turn":
        window_s = max(window_s, min(turn_s, WINDOW_MAX_S))
        settle_s = min(max(settle_s, 12.0 * turn_s), LONG_S)
    from_s = round(loaded_s + settle_s, 4)

    profile = str(draw.choice(PROFILES)) if kind == "turn" else None
    load: tuple[LoadStep, ...] = (LoadStep(loaded_s, _single(torque_Nm), _single(swing_Nm) if profile else None),)
    if kind == "sine":
        bench |= {"load_sine_amplitude_Nm": _single(swing_Nm), "load_sine_frequency_Hz": frequency_Hz}
    elif kind == "ramps":
        steps = min(CHANGES_MAX, math.floor((settle_s - RAMPS_END_S) * 2.0 * frequency_Hz))
        each_s = (settle_s - RAMPS_END_S) / (steps + 1)
        levels = torque_Nm + swing_Nm * draw.uniform(-1.0, 1.0, steps)
        bench["load_ramp_Nm_s"] = round(4.0 * swing_Nm / each_s, 2) or 0.01
        load = (*load, *(LoadStep(round(loaded_s + (index + 1) * each_s, 6), _single(level))
                         for index, level in enumerate(levels)),
                LoadStep(round(from_s - RAMPS_END_S, 6), _single(torque_Nm)))
    bench |= {
        "resistance_gain": _single(other.uniform(0.9, 1.2)),
        "friction_gain": _single(other.uniform(0.7, 1.3)),
        "current_noise_A": round(other.uniform(0.5, 1.5) * data.adc_current_A / 4096.0, 5),
        "truth_period_us": TRUTH_US,
    }
    conditions = {"control_rate_hz": _rate_hz(path)} | stated_conditions(path)
    scenario = Scenario(
        name="ablation", machine=str(path), controller="salient", seed=seed,
        duration_s=round(from_s + window_s, 4), speed=(SpeedStep(0.0, round(rpm, 3)),), load=load,
        load_profile=profile, bench=bench, record=Record(1.0, from_s),
        initial_angle_deg=round(other.uniform(0.0, 360.0), 2), **(conditions | {"encoder_bits": drawn.bits}))
    return Case(number, scenario, _parts(drawn, rpm / data.speed_base_rpm), data.speed_base_rpm)


def _parts(drawn: _Drawn, speed_part: float) -> tuple[str, ...]:
    kind, imperfect = drawn.kind, drawn.parts
    moving = kind in ("sine", "ramps")
    coarse, slow = drawn.bits <= COARSE_BITS, speed_part < 1.5 * SLOW_PART
    named = {
        "all": True, "step": kind == "step", "moving": moving, "turn": kind == "turn", "long": drawn.settle_s >= LONG_S,
        "coarse": coarse, "fine": not coarse, "slow": slow, "fast": speed_part >= 0.4, "slow counts": coarse and slow,
        "moving, misaligned": moving and "misaligned" in imperfect,
        "slow counts, misaligned": coarse and slow and "misaligned" in imperfect,
        "moving, aligned": moving and "misaligned" not in imperfect,
        "step, misaligned": kind == "step" and "misaligned" in imperfect,
        "step, aligned": kind == "step" and "misaligned" not in imperfect,
    }
    return (*(name for name, belongs in named.items() if belongs), *imperfect)


PARTS = ("all", "step", "moving", "turn", "long", "coarse", "fine", "slow", "fast", "slow counts",
         "moving, misaligned", "slow counts, misaligned", "moving, aligned", "step, misaligned", "step, aligned",
         "misaligned", "eccentric", "tables", "inertia", "sensors", *EDGES, BEAT)
"""Parts of the set."""
