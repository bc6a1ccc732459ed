"""Runs over the whole range of speeds, above base speed too, judged by bounds that share no code with the firmware or
its tables (reference/torque_speed_bound.py, reference/copper_bound.py).

- torque_speed: the largest torque in torque mode, motoring and braking, on a shaft that a dynamometer holds.
- torque_speed_random: the same with ten random machines, which no other group has.
- partial_torque: parts of it above base speed; the RMS current is compared with the best pulse's.
- copper: parts of the rated torque up to base speed; the sum of squares of the currents is compared with the least one
  without ripple at that speed.
- copper_random: the same with random machines of narrow pole arcs, by map.
- transition: load steps at 1.5 times and half of the base speed in one run; speed ramps under load between half and
  twice the base speed.
- torque_conditions: the largest torque with control rates, encoders and supplies.

torque_max_Nm is as large as the drive permits, so that current limit and voltage decide.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from salient.config import CONTROLLERS
from salient.experiments import metrics
from salient.experiments.compare import every_machine
from salient.experiments.compare.case import MACHINES, Case, make_scenario
from salient.experiments.compare.random_maps import random_map_files
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep, TorqueStep
from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData, derive
from salient.machine.file import load_machine, machine_path
from salient.machine.parameter_table import read_table
from salient.machine.path import stated_conditions
from salient.machine.scaling import Scaling, choose
from salient.reference.copper_bound import least_square_A2
from salient.reference.torque_speed_bound import (
    BRAKING,
    MOTORING,
    Limits,
    Pulse,
    largest_torque,
    least_current,
    rough_torque_Nm,
)

QUADRANTS = {"motoring": MOTORING, "braking": BRAKING}
OF_BASE = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
OF_BASE_ANY = (0.5, 1.0, 1.5, 2.0)
OF_BASE_QUICK = (0.5, 2.0)
RANDOM_NUMBERS = range(20, 30)
ABOVE_BASE = (1.25, 1.5, 2.0)
PARTS = (0.25, 0.5, 0.75)
MOTORING_SHORT_PERCENT, BRAKING_SHORT_PERCENT = 3.0, 8.0
"""By which the mean torque may be below its bound."""
PEAK_TO_LIMIT_MAX = 1.03
UP_TO_BASE, UP_TO_BASE_QUICK = (0.1, 0.5, 1.0), (0.1,)
COPPER_RATIO_MAX, COPPER_RIPPLE_MAX = 1.06, 0.045
"""Largest copper ratio and ripple; the latter comes from single samples of a machine of 8/6 poles at its base speed, in
27 control periods of a stroke."""
RMS_RATIO_MAX, TORQUE_ERROR_MAX_PERCENT = 1.1, 3.0

SLOW, FAST = 0.5, 1.5
STEP_PART, RAMP_PART = 0.9, 0.75
"""Torque under the load of the step, and of the ramp, of the largest one."""
RAMP_OF_BASE = (0.5, 2.0)
_RAMP_TORQUE_PART, _RAMP_MIN_S = 0.15, 0.3
STEP_ANGLES = 4
DIP_RATIO_MAX, TORQUE_STEP_MAX_PERCENT = 2.0, 10.0

CONDITION_MACHINES = ("linear_cosine", "finite_element")
CONDITION_OF_BASE = 1.5
RATES_HZ = (20_000, 40_000, 100_000)
ENCODER_BITS = (12, 13, 14, 15, 16, 17)
SUPPLIES = (0.7, 0.8, 0.9, 1.1)

_DYNAMOMETER_RPM_S = 10_000.0
_REQUEST_MAX_NM = 10_000.0
"""Limit of a scenario."""
_SETTLED_S, _WINDOW_S = 0.1, 0.1
_RECORD_US = 5.0
_LONG_RECORD_US = 20.0
_RPM = 30.0 / math.pi

Metrics = dict[str, float | None]
JUDGED = (("motoring_short_percent", ""), ("braking_short_percent", ""), ("peak_to_limit", ""))
"""Columns of the largest torque that have a target, for every machine."""


# --- runs -----------------------------------------------------------------------------------------------------------

def torque_speed(quick: bool, machines: Sequence[str] = MACHINES, group: str = "torque_speed",
                 controllers: Sequence[str] = CONTROLLERS, of_base: Sequence[float] = OF_BASE) -> Iterator[Case]:
    """The largest torque of a held shaft; braking by `salient` alone, the others drive forward only."""
    for machine in machines[:1] if quick else machines:
        subject = _Subject(machine)
        for quadrant, sign in QUADRANTS.items():
            for speed_rpm in subject.speeds_rpm(OF_BASE_QUICK if quick else of_base):
                for controller in controllers if sign == MOTORING else ("salient",):
                    yield Case(group, f"{subject.label}, {speed_rpm:g} r/min, {quadrant}", controller, "held",
                               subject.held(speed_rpm, sign * subject.torque_max_Nm, controller=controller))


def torque_speed_random(quick: bool) -> Iterator[Case]:
    """The largest torque of random machines."""
    machines = [str(path) for path in every_machine.random_files(RANDOM_NUMBERS)]
    return torque_speed(quick, machines, "torque_speed_random", ("salient",))


def partial_torque(quick: bool, machines: Sequence[str] = MACHINES) -> Iterator[Case]:
    """Parts of the largest torque above base speed."""
    for machine in machines[:1] if quick else machines:
        subject = _Subject(machine)
        speeds_rpm = subject.speeds_rpm(ABOVE_BASE[1:2] if quick else ABOVE_BASE)
        for quadrant, sign in QUADRANTS.items():
            for speed_rpm, largest_Nm in zip(speeds_rpm, subject.rough_Nm(speeds_rpm), strict=True):
                for part in PARTS:
                    condition = f"{subject.label}, {speed_rpm:g} r/min, {quadrant}, {100.0 * part:g} %"
                    yield Case("partial_torque", condition, "salient", "held_part",
                               subject.held(speed_rpm, sign * _three_digits(part * largest_Nm)))


def copper(quick: bool, machines: Sequence[str] = MACHINES, group: str = "copper") -> Iterator[Case]:
    """Parts of the rated torque up to base speed."""
    for machine in machines[:1] if quick else machines:
        subject = _Subject(machine)
        for speed_rpm in subject.speeds_rpm(UP_TO_BASE_QUICK if quick else UP_TO_BASE):
            for part in PARTS:
                torque_Nm = _three_digits(part * subject.data.torque_rated_Nm)
                yield Case(group, f"{subject.label}, {speed_rpm:g} r/min, {100.0 * part:g} %", "salient",
                           "held_copper", subject.held(speed_rpm, torque_Nm))


def copper_random(quick: bool) -> Iterator[Case]:
    """Parts of the rated torque of random machines of narrow pole arcs."""
    return copper(quick, [str(path) for path in random_map_files()], "copper_random")


def transition(quick: bool, machines: Sequence[str] = MACHINES) -> Iterator[Case]:
    """Load steps above and below base speed at several rotor angles, and speed ramps through base speed."""
    for machine in machines[:1] if quick else machines:
        subject = _Subject(machine)
        yield Case("transition", f"{subject.label}, load steps", "salient", "fast_step", subject.load_steps())
        yield Case("transition", f"{subject.label}, speed ramps", "salient", "speed_ramps", subject.ramps())


def torque_conditions(quick: bool, machines: Sequence[str] = CONDITION_MACHINES) -> Iterator[Case]:
    """The largest torque with other control rates, encoders and supplies."""
    for machine in machines[:1] if quick else machines:
        subject = _Subject(machine)
        (speed_rpm,) = subject.speeds_rpm((CONDITION_OF_BASE,))
        supply_V = subject.machine.supply_voltage_V
        changes: dict[str, dict[str, Any]] = {f"{rate_hz // 1000} kHz": {"control_rate_hz": rate_hz}
                                              for rate_hz in RATES_HZ}
        changes |= {f"{bits} bits": {"encoder_bits": bits} for bits in ENCODER_BITS}
        changes |= {f"supply x {factor:g}": {"bench": {"supply_voltage_V": factor * supply_V}} for factor in SUPPLIES}
        for name, change in list(changes.items())[:1] if quick else changes.items():
            for quadrant, sign in QUADRANTS.items():
                yield Case("torque_conditions", f"{subject.label}, {name}, {quadrant}", "salient", "held",
                           subject.held(speed_rpm, sign * subject.torque_max_Nm, **change))


def held_parts(machine: str, of_base: float, of_rated: float, fast_of_base: float, of_largest: float
               ) -> tuple[Scenario, Scenario | None]:
    """Parts of the rated torque, and of the largest one above base speed, on a held shaft, without a limit of their
    own; None: the machine is not as fast."""
    subject = _Subject(machine)
    (speed_rpm,) = subject.speeds_rpm((of_base,))
    held = replace(subject.held(speed_rpm, _three_digits(of_rated * subject.data.torque_rated_Nm)), parameters={})
    fast_rpm = subject.speeds_rpm((fast_of_base,))
    if not fast_rpm:
        return held, None
    (largest_Nm,) = subject.rough_Nm(fast_rpm)
    return held, replace(subject.held(fast_rpm[0], _three_digits(of_largest * largest_Nm)), parameters={})


class _Subject:
    """A machine and the scenarios for it."""

    def __init__(self, name_or_path: str) -> None:
        self.name = name_or_path
        path = machine_path(name_or_path)
        self.machine: Machine = load_machine(path)
        self.data: DriveData = derive(self.machine)
        self.label = name_or_path if name_or_path in MACHINES else self.machine.name
        self._conditions = stated_conditions(path)
        (row,) = (row for row in read_table() if row.name == "torque_max_Nm")
        exponents = choose(self.data, self.machine)
        self.torque_max_Nm = min(math.ldexp(row.maximum, -exponents.fraction_bits(row)), _REQUEST_MAX_NM)
        self.speed_range_rpm = Scaling(self.data, exponents, self.machine.phases).speed_range_rpm

    def speeds_rpm(self, of_base: Sequence[float]) -> list[float]:
        """Multiples of the base speed up to the largest speed, four digits."""
        return [_four_digits(min(factor * self.data.speed_base_rpm, self.data.speed_max_rpm)) for factor in of_base
                if factor * self.data.speed_base_rpm <= 1.001 * self.data.speed_max_rpm]

    def rough_Nm(self, speeds_rpm: Sequence[float]) -> list[float]:
        """Largest torques in N m, roughly, within what the drive can be commanded."""
        limits = Limits(self.data.parameters["current_limit_A"], self.data.over_voltage_V,
                        self.machine.supply_voltage_V)
        return [min(float(torque_Nm), self.torque_max_Nm)
                for torque_Nm in rough_torque_Nm(self.machine, speeds_rpm, limits)]

    def held(self, speed_rpm: float, torque_Nm: float, **changes: Any) -> Scenario:
        """A shaft that a dynamometer holds; recorded over whole electrical revolutions."""
        held_s = round(speed_rpm / _DYNAMOMETER_RPM_S + 0.02, 6)
        from_s = round(held_s + _SETTLED_S, 6)
        turn_s = 60.0 / (speed_rpm * self.machine.rotor_poles)
        bench = {"held_speed_rpm": speed_rpm, **changes.pop("bench", {})}
        return self._scenario(round(from_s + math.ceil(_WINDOW_S / turn_s) * turn_s, 6), bench=bench,
                              torque=(TorqueStep(held_s, torque_Nm),), record=Record(_RECORD_US, from_s), **changes)

    def load_steps(self) -> Scenario:
        """At SLOW and then at FAST, STEP_ANGLES steps at angles spread over a stroke."""
        speeds_rpm = self._speeds_in_speed_mode((SLOW, FAST))
        time_s, before_rpm = 0.0, 0.0
        speed: list[SpeedStep] = []
        load: list[LoadStep] = []
        for speed_rpm, load_Nm in zip(speeds_rpm, self._loads_Nm(STEP_PART, speeds_rpm), strict=True):
            stroke_s = metrics.stroke_deg(self.machine) / (6.0 * speed_rpm)
            start_s = self._change_s(speed_rpm - before_rpm, load_Nm)
            long_s = start_s + _SETTLED_S
            period_s = (math.ceil(2.0 * long_s / stroke_s) + 1.0 / STEP_ANGLES) * stroke_s
            speed.append(SpeedStep(time_s, speed_rpm))
            first_s = time_s + 2.0 * start_s + _SETTLED_S
            for number in range(STEP_ANGLES):
                step_s = round(first_s + number * period_s, 6)
                load += [LoadStep(step_s, load_Nm), LoadStep(round(step_s + long_s, 6), 0.0)]
            time_s, before_rpm = _up(load[-1].at_s + long_s), speed_rpm
        return self._scenario(load[-1].at_s, speed=tuple(speed), load=tuple(load),
                              record=Record(_LONG_RECORD_US, 0.0))

    def ramps(self) -> Scenario:
        """From the lower to the higher speed and back under a constant load."""
        slow_rpm, fast_rpm = self._speeds_in_speed_mode((RAMP_OF_BASE[0], min(
            RAMP_OF_BASE[1], self.data.speed_max_rpm / self.data.speed_base_rpm)))
        (largest_Nm,) = self.rough_Nm((fast_rpm,))
        ramp_s = max(_RAMP_MIN_S, self._change_s(fast_rpm - slow_rpm, _RAMP_TORQUE_PART * largest_Nm))
        rate_rpm_s = float(math.ceil((fast_rpm - slow_rpm) / ramp_s))
        loaded_s = _up(slow_rpm / rate_rpm_s + _SETTLED_S)
        up_s = _up(loaded_s + _SETTLED_S)
        down_s = _up(up_s + ramp_s + 2.0 * _SETTLED_S)
        return self._scenario(
            _up(down_s + ramp_s + _SETTLED_S),
            speed=(SpeedStep(0.0, slow_rpm), SpeedStep(up_s, fast_rpm), SpeedStep(down_s, slow_rpm)),
            load=(LoadStep(loaded_s, self._loads_Nm(RAMP_PART, (fast_rpm,))[0]),), record=Record(_LONG_RECORD_US, up_s),
            parameters={"speed_ramp_rpm_s": rate_rpm_s})

    def _speeds_in_speed_mode(self, of_base: Sequence[float]) -> list[float]:
        return [min(_four_digits(factor * self.data.speed_base_rpm), self.speed_range_rpm) for factor in of_base]

    def _loads_Nm(self, part: float, speeds_rpm: Sequence[float]) -> list[float]:
        """Loads on the shaft that require a part of the largest torque, which also overcomes the friction."""
        return [_three_digits(part * torque_Nm - self.machine.friction_Nm_s * speed_rpm / _RPM)
                for torque_Nm, speed_rpm in zip(self.rough_Nm(speeds_rpm), speeds_rpm, strict=True)]

    def _change_s(self, by_rpm: float, torque_Nm: float) -> float:
        return self.machine.inertia_kg_m2 * by_rpm / _RPM / torque_Nm

    def _scenario(self, duration_s: float, parameters: dict[str, float] | None = None, controller: str = "salient",
                  **fields: Any) -> Scenario:
        return make_scenario(machine=self.name, controller=controller, duration_s=duration_s,
                             parameters={"torque_max_Nm": self.torque_max_Nm, **(parameters or {})},
                             **{**self._conditions, **fields})


def _four_digits(value: float) -> float:
    """Rounded down: not above a largest speed."""
    lsb = 10.0 ** (math.floor(math.log10(value)) - 3)
    return round(math.floor(value / lsb * (1.0 + 1e-12)) * lsb, 6)


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def _up(time_s: float) -> float:
    return math.ceil(round(time_s * 1e3, 6)) / 1e3


def of_any_machine(quick: bool, path: str) -> Iterator[Case]:
    """The largest torque of a machine of any size, at fewer speeds."""
    return torque_speed(quick, (path,), "machines", ("salient",), OF_BASE_ANY)


GROUPS = {"torque_speed": torque_speed, "partial_torque": partial_torque, "copper": copper, "transition": transition,
          "torque_conditions": torque_conditions}
"""With --machine, a machine's own cases instead of the cases of the paper's machine in its terms."""


# --- metrics --------------------------------------------------------------------------------------------------------

def held_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Mean torque, what it is short of its bound, ripple and peak current over the whole recording."""
    (step,) = scenario.torque
    quadrant = MOTORING if step.value_Nm > 0.0 else BRAKING
    bound_Nm = largest_of(scenario, quadrant).torque_Nm
    torque_Nm = np.asarray(recording["torque_Nm"], dtype=float)
    mean_Nm = float(torque_Nm.mean())
    name = "motoring_short_percent" if quadrant == MOTORING else "braking_short_percent"
    peak_A = max(float(np.max(current)) for current in _currents(recording))
    short_percent = 100.0 * (1.0 - mean_Nm / bound_Nm) if bound_Nm else None  # a link without chopper
    return {"torque_mean_Nm": mean_Nm, "torque_bound_Nm": bound_Nm, name: short_percent,
            "ripple": float(np.ptp(torque_Nm)) / abs(mean_Nm) if mean_Nm else None, "peak_current_A": peak_A,
            "peak_to_limit": peak_A / _limits(scenario).current_A}


def held_part_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """RMS current of a phase relative to the best pulse's of the same mean torque, and the torque's error."""
    (step,) = scenario.torque
    torque_Nm = np.asarray(recording["torque_Nm"], dtype=float)
    mean_Nm = float(torque_Nm.mean())
    currents = list(_currents(recording))
    rms_A = math.sqrt(sum(float(np.mean(np.square(current, dtype=float))) for current in currents) / len(currents))
    best_A = _least_rms_A(scenario.machine, scenario.bench["held_speed_rpm"], _limits(scenario), round(mean_Nm, 3))
    return {"torque_error_percent": 100.0 * abs(mean_Nm / step.value_Nm - 1.0), "phase_rms_A": rms_A,
            "rms_to_best": rms_A / best_A if math.isfinite(best_A) else None,
            "ripple": float(np.ptp(torque_Nm)) / abs(mean_Nm) if mean_Nm else None}


def held_copper_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Sum of squares of the currents relative to the least one of the same mean torque without ripple, the torque's
    error and ripple."""
    (step,) = scenario.torque
    limits = _limits(scenario)
    torque_Nm = np.asarray(recording["torque_Nm"], dtype=float)
    mean_Nm = float(torque_Nm.mean())
    square_A2 = sum(float(np.mean(np.square(current, dtype=float))) for current in _currents(recording))
    bound_A2 = _least_square_A2(scenario.machine, scenario.bench["held_speed_rpm"], limits, float(f"{mean_Nm:.3g}"))
    return {"torque_error_percent": 100.0 * abs(mean_Nm / step.value_Nm - 1.0),
            "copper_to_least": square_A2 / bound_A2 if math.isfinite(bound_A2) else None,
            "ripple": float(np.ptp(torque_Nm)) / abs(mean_Nm) if mean_Nm else None}


def fast_step_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Largest drop of speed by torque of the load steps at FAST, relative to that at SLOW; longest recovery at FAST."""
    time_s = recording["time_s"]
    drops: list[float] = []
    recoveries_s: list[float | None] = []
    for number, (load, end) in enumerate(zip(scenario.load[::2], scenario.load[1::2], strict=True)):
        part = recording[slice(*np.searchsorted(time_s, (load.at_s - 1e-9, end.at_s)))]
        reference_rpm = scenario.speed[number // STEP_ANGLES].value_rpm
        after = metrics.speed_after_step(part, reference_rpm, load.at_s)
        drops.append((after["speed_dip_rpm"] or 0.0) / load.torque_Nm)
        recoveries_s.append(after["recovery_time_s"])
    slow, fast = max(drops[:STEP_ANGLES]), max(drops[STEP_ANGLES:])
    settled_s = [recovery_s for recovery_s in recoveries_s[STEP_ANGLES:] if recovery_s is not None]
    return {"speed_dip_rpm": fast * scenario.load[-2].torque_Nm, "dip_ratio": fast / slow if slow > 0.0 else None,
            "recovery_time_s": max(settled_s) if len(settled_s) == STEP_ANGLES else None}


def speed_ramps_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Largest change of the torque from a stroke to the next, relative to the load, while the speed changes in either
    direction; without the first and the last twentieth of a ramp, where the acceleration changes."""
    machine = load_machine(machine_path(scenario.machine))
    (load,) = scenario.load
    slow_rpm, fast_rpm = scenario.speed[0].value_rpm, scenario.speed[1].value_rpm
    ramp_s = (fast_rpm - slow_rpm) / scenario.parameters["speed_ramp_rpm_s"]
    travel_deg = np.unwrap(np.asarray(recording["rotor_angle_deg"], dtype=float), period=360.0)
    strokes = np.floor(travel_deg / metrics.stroke_deg(machine)).astype(np.int64)
    changes = [0.0]
    for step in scenario.speed[1:]:
        from_s, to_s = step.at_s + 0.05 * ramp_s, step.at_s + 0.95 * ramp_s
        part = slice(*np.searchsorted(recording["time_s"], (from_s, to_s)))
        numbers = strokes[part] - strokes[part][0]
        sums_Nm = np.bincount(numbers, weights=np.asarray(recording["torque_Nm"][part], dtype=float))
        of_strokes_Nm = (sums_Nm / np.bincount(numbers))[1:-1]  # whole ones
        changes.append(float(np.max(np.abs(np.diff(of_strokes_Nm)), initial=0.0)))
    ramps = (recording["time_s"] > scenario.speed[1].at_s) & (recording["time_s"] < scenario.duration_s)
    fastest_rpm = float(np.max(recording["speed_rpm"][ramps]))
    return {"torque_step_percent": 100.0 * max(changes) / load.torque_Nm,
            "highest_speed_percent": 100.0 * fastest_rpm / fast_rpm}


def largest_of(scenario: Scenario, quadrant: int) -> Pulse:
    """The bound of a run on a held shaft."""
    return _largest(scenario.machine, scenario.bench["held_speed_rpm"], _limits(scenario), quadrant)


@lru_cache(maxsize=1024)
def _largest(name: str, speed_rpm: float, limits: Limits, quadrant: int) -> Pulse:
    return largest_torque(_machine(name), [speed_rpm], limits, quadrant)[0]


@lru_cache(maxsize=1024)
def _least_rms_A(name: str, speed_rpm: float, limits: Limits, torque_Nm: float) -> float:
    return least_current(_machine(name), speed_rpm, limits, [torque_Nm])[0].rms_A


@lru_cache(maxsize=1024)
def _least_square_A2(name: str, speed_rpm: float, limits: Limits, torque_Nm: float) -> float:
    return least_square_A2(_machine(name), torque_Nm, speed_rpm / _RPM, limits.supply_V, limits.current_A)


@lru_cache
def _machine(name: str) -> Machine:
    return load_machine(machine_path(name))


def _limits(scenario: Scenario) -> Limits:
    machine = _machine(scenario.machine)
    parameters = {**derive(machine).parameters, **scenario.parameters}
    return Limits(parameters["current_limit_A"], parameters["over_voltage_V"],
                  scenario.bench.get("supply_voltage_V", machine.supply_voltage_V))


def _currents(recording: np.ndarray) -> Iterator[np.ndarray]:
    return (recording[name] for name in recording.dtype.names or () if name.startswith("current_"))
