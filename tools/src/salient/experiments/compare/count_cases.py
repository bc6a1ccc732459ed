"""Torque ripple after a load step at speeds chosen by the encoder counts in a control period.

Near a ratio p / q of them with a small q the rounding to counts is slow, and may be taken for a load. Half of the
speeds of a condition are near such ratios, the rest are evenly distributed on a logarithmic scale, where ratios are
rare.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from salient.experiments.compare.case import MACHINES, Case, make_scenario
from salient.experiments.compare.every_machine import EXAMPLES
from salient.experiments.scaled import Scale, scale_of
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep
from salient.machine.drive_data import DriveData, derive
from salient.machine.file import load_machine, machine_path

EXTRACTOR = "counts"
BITS, BITS_ALL = (10, 14, 17), tuple(range(10, 19))
RATES_HZ = (20_000, 40_000, 50_000, 100_000)
SPEEDS, SPEEDS_QUICK, SPEEDS_ALL = 16, 4, 28
"""Numbers of speeds of a machine and resolution; the last times 9 resolutions and 8 machines is 2,016."""
SAMPLED = (MACHINES[0], MACHINES[-1])
OUTSIDE = tuple(str(EXAMPLES / f"{name}.toml") for name in ("fan12", "map86", "servo86", "traction"))
LOWEST_PART, LOAD_PART = 0.02, 0.5
"""Parts of base speed and rated torque."""
RIPPLE_AFTER_S, WINDOW_S, WINDOWS = 0.02, 0.1, 4
"""The ripple is the largest of successive windows, from this time after the load step on."""
DENOMINATORS = (1, 1, 1, 2, 2, 3, 4, 5)
BEATS_HZ = (0.5, 2_000.0)
_SETTLED_S = 0.1
_RPM = 30.0 / math.pi


def sampled(quick: bool, machines: Sequence[str] = SAMPLED) -> Iterator[Case]:
    """A few speeds of each machine."""
    for machine in machines[:1] if quick else machines:
        for bits in BITS[-1:] if quick else BITS:
            yield from _cases("speeds", machine, bits, SPEEDS_QUICK if quick else SPEEDS)


def every(quick: bool, machines: Sequence[str] = ()) -> Iterator[Case]:
    """2,016 speeds of bundled and outside machines, 252 of one machine."""
    for machine in machines or (*MACHINES, *OUTSIDE):
        for bits in BITS[-1:] if quick else BITS_ALL:
            yield from _cases("every_speed", machine, bits, SPEEDS_QUICK if quick else SPEEDS_ALL)


GROUPS: dict[str, Callable[[bool, Sequence[str]], Iterator[Case]]] = {"speeds": sampled, "every_speed": every}
"""Cases of given machines, by group."""


def condition(machine: str, bits: int) -> str:
    """Label of a machine by its name or file."""
    return f"{Path(machine).stem}, {bits} bits, load step"


@lru_cache
def _data(machine: str) -> tuple[DriveData, Scale]:
    """Drive data and scale of a machine by its name or file; computing them takes a while."""
    loaded = load_machine(machine_path(machine))
    return derive(loaded), scale_of(loaded)


def _cases(group: str, machine: str, bits: int, count: int) -> Iterator[Case]:
    data, scale = _data(machine)
    draw = np.random.default_rng(bits)
    for number in range(count):
        rate_hz = RATES_HZ[number // 2 % len(RATES_HZ)]
        speed_rpm = data.speed_base_rpm * LOWEST_PART ** draw.uniform()
        if number % 2 == 0:
            speed_rpm = _near_ratio(draw, speed_rpm, bits, rate_hz, data.speed_base_rpm)
        speed_rpm = round(speed_rpm, 3)
        counts = speed_rpm / 60.0 * 2**bits / rate_hz
        sample = f"{speed_rpm:g} r/min, {rate_hz / 1000:g} kHz, {counts:.4f} counts a period"
        yield Case(group, condition(machine, bits), "salient", EXTRACTOR,
                   _scenario(machine, bits, rate_hz, speed_rpm, LOAD_PART * data.torque_rated_Nm, scale), sample)


def _near_ratio(draw: np.random.Generator, speed_rpm: float, bits: int, rate_hz: int, base_rpm: float) -> float:
    """The speed at which q samples differ from p counts by a beat of BEATS_HZ, as near to the given one as the base
    speed allows; that one itself where the base speed has less than 1 / q counts."""
    rpm_per_count = 60.0 * rate_hz / 2**bits
    q = int(draw.choice(DENOMINATORS))
    beat_hz = float(np.exp(draw.uniform(*np.log(BEATS_HZ)))) * draw.choice((-1.0, 1.0))
    p = max(1, round(speed_rpm / rpm_per_count * q))
    near_rpm = (p + beat_hz / rate_hz) / q * rpm_per_count
    return float(near_rpm) if near_rpm <= base_rpm else speed_rpm


def _scenario(machine: str, bits: int, rate_hz: int, speed_rpm: float, load_Nm: float, scale: Scale) -> Scenario:
    loaded_s = round(scale.delay_s(speed_rpm, 0.0) + _SETTLED_S, 6)
    return make_scenario(machine=machine, controller="salient", encoder_bits=bits, control_rate_hz=rate_hz,
                         speed=(SpeedStep(0.0, speed_rpm),), load=(LoadStep(loaded_s, load_Nm),),
                         duration_s=round(loaded_s + RIPPLE_AFTER_S + WINDOWS * WINDOW_S, 6),
                         record=Record(1.0, loaded_s))


def windows_s(scenario: Scenario) -> list[tuple[float, float]]:
    """Windows of the ripple, s."""
    first_s = scenario.load[0].at_s + RIPPLE_AFTER_S
    return [(first_s + number * WINDOW_S, first_s + (number + 1) * WINDOW_S) for number in range(WINDOWS)]
