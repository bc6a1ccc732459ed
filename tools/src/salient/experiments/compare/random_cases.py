"""Random drives: imperfections at two speeds with a load step, and machines, speeds and loads of all kinds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from salient.experiments.compare.case import LOAD_NM, MACHINES, Case, by_controller, machine_of, make_scenario
from salient.experiments.compare.metrics import SETTLING_S, STEADY_S
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep

DRIVES, DRIVES_QUICK = 500, 10
LOADS, LOADS_QUICK = 20, 4
LOADS_SEED = 13
TORQUE_MAX_NM = 19.1
"""The drive's default torque_max_Nm."""


def robustness(quick: bool) -> Iterator[Case]:
    """Both studies."""
    for number in range(DRIVES_QUICK if quick else DRIVES):
        yield from by_controller("robustness", "random drives", "robustness", random_drive(number),
                                 f"drive {number:03}")
    for number in range(LOADS_QUICK if quick else LOADS):
        yield from by_controller("robustness", "random machines, speeds and loads", "random_load",
                                 random_load(number), f"load {number:02}")


def random_drive(number: int) -> Scenario:
    """A drive and bench of the robustness study, reproducible by number: start to 150 r/min (even numbers) or
    600 r/min, then 8 N m."""
    draw = np.random.default_rng(number).uniform
    bench, encoder_bits = _imperfections(draw)
    return make_scenario(seed=number, duration_s=0.5 + 0.2 + STEADY_S,
                         speed=(SpeedStep(0.0, (150.0, 600.0)[number % 2]),), load=(LoadStep(0.5, LOAD_NM),),
                         record=Record(2.0, 0.0), encoder_bits=encoder_bits, bench=bench,
                         initial_angle_deg=round(draw(0.0, 90.0), 3))


def random_load(number: int) -> Scenario:
    """A machine with imperfections, a speed of 10 to 1500 r/min and a sine, ramp or step of the load, reproducible by
    number.

    The load follows the start, which with three times the inertia takes 0.5 s to 1500 r/min. After SETTLING_S follows
    what is judged: STEADY_S, a quarter of a turn, or two periods of the sine, whichever is longest; whole periods.
    """
    generator = np.random.default_rng([LOADS_SEED, number])
    draw = generator.uniform
    machine = str(generator.choice(MACHINES))
    speed_rpm = round(_logarithmic(draw, 10.0, 1500.0), 1)
    kind = str(generator.choice(("sine", "ramp", "step")))
    torque_Nm = round(draw(2.0, 12.0), 2)
    bench, encoder_bits = _imperfections(draw)
    sine_share = draw(0.2, 0.5) if kind == "sine" else 0.0
    torque_Nm = round(min(torque_Nm, _load_max_Nm(machine, speed_rpm, bench["friction_gain"]) / (1.0 + sine_share)), 2)
    ramp_s, window_s = 0.0, max(STEADY_S, 15.0 / speed_rpm)
    if kind == "sine":
        frequency_Hz = _single(_logarithmic(draw, 1.0, 100.0))
        bench |= {"load_sine_amplitude_Nm": _single(torque_Nm * sine_share), "load_sine_frequency_Hz": frequency_Hz}
        window_s = max(2, math.ceil(window_s * frequency_Hz)) / frequency_Hz
    elif kind == "ramp":
        ramp_s = _logarithmic(draw, 0.001, 0.5)
        bench["load_ramp_Nm_s"] = _single(torque_Nm / ramp_s)
    loaded_s = round(0.5 + speed_rpm / 2000.0, 6)
    return make_scenario(machine=machine, seed=number, speed=(SpeedStep(0.0, speed_rpm),),
                         duration_s=round(loaded_s + ramp_s + SETTLING_S + window_s, 6),
                         load=(LoadStep(loaded_s, torque_Nm),), record=Record(10.0, 0.0), encoder_bits=encoder_bits,
                         bench=bench, encoder_edges=bool(generator.integers(2)),
                         initial_angle_deg=round(draw(0.0, 90.0), 3))


def _load_max_Nm(machine: str, speed_rpm: float, friction_gain: float) -> float:
    """Rest after friction of nine tenths of the drive's torque limit; at five times the nominal one and 1500 r/min it
    takes most of it."""
    friction_Nm_s = machine_of(machine).friction_Nm_s * friction_gain
    return max(1.0, 0.9 * TORQUE_MAX_NM - friction_Nm_s * speed_rpm * math.pi / 30.0)


def _imperfections(draw: Any) -> tuple[dict[str, float], int]:
    """Variables of the rig, and the resolution of the encoder."""
    bench = {
        "flux_linkage_gain": draw(0.9, 1.1),
        "resistance_gain": draw(0.8, 1.5),
        "inertia_gain": _logarithmic(draw, 0.5, 3.0),
        "friction_gain": draw(0.0, 5.0),
        "supply_voltage_V": draw(200.0, 280.0),
        "encoder_offset_deg": draw(-0.1, 0.1),
        "current_noise_A": draw(0.0, 0.04),
    }
    encoder_bits = int(draw(14.0, 21.0))
    return {name: _single(value) for name, value in bench.items()}, encoder_bits


def _logarithmic(draw: Any, low: float, high: float) -> float:
    return float(math.exp(draw(math.log(low), math.log(high))))


def _single(value: float) -> float:
    """CAN carries rig variables as single-precision floats; rounded so that the scenario holds what is applied."""
    return float(np.float32(value))
