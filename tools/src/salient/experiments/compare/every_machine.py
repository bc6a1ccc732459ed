"""Machines of all sizes: the examples in tools/examples/machines and random ones, each with its drive's data derived.

A run starts to 0.4 of the base speed, takes half of the rated torque at a quarter of it, and with `salient` brakes to
that speed before and reverses after. The start, the braking and the reversal are compared with what torque limit,
inertia and voltage permit (machine/torque_speed.py), the torque ripple of `salient` under the load with its
reference model's (compare/reference.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from salient.config import CONTROLLERS
from salient.experiments import metrics
from salient.experiments.compare import reference
from salient.experiments.compare.random_machines import COUNT, random_machine
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep
from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData, derive
from salient.machine.file import load_machine, machine_path
from salient.machine.path import stated_conditions
from salient.machine.torque_speed import Source, speed_change_s
from salient.paths import BUILD, ROOT, keep_text

EXAMPLES = ROOT / "tools" / "examples" / "machines"
RANDOM = BUILD / "random_machines"
QUICK = ("fan12", "servo86")

START_PART, LOADED_PART, LOAD_PART = 0.4, 0.25, 0.5
"""Parts of base speed and rated torque."""
BOUND_FACTOR, BOUND_EXTRA_S = 1.1, 0.002
"""A change of speed is in time within this factor of its bound, or the bound and this time."""
RIPPLE_MAX, RIPPLE_OF_REFERENCE = 0.010, 1.2
"""The torque ripple is at most the first, or this multiple of the reference model's."""
_SETTLED_S, _LOADED_S, _UNLOADED_S = 0.06, 0.15, 0.05
_RPM = 30.0 / math.pi

Metrics = dict[str, float | None]


def machine_files(quick: bool) -> list[Path]:
    """The examples and the random machines."""
    if quick:
        return [EXAMPLES / f"{name}.toml" for name in QUICK]
    return [*sorted(EXAMPLES.glob("*.toml")), *random_files(range(COUNT))]


def random_files(numbers: range) -> list[Path]:
    """Files of random machines, written when they are missing."""
    files = [RANDOM / f"random_{number:02}.toml" for number in numbers]
    for path, number in zip(files, numbers, strict=True):
        keep_text(path, random_machine(number))
    return files


def scenarios(quick: bool) -> Iterator[Scenario]:
    """One for each machine and controller."""
    for path in machine_files(quick):
        for controller in CONTROLLERS:
            yield scenario(path, controller)


def scenario(path: Path, controller: str) -> Scenario:
    """The run of a machine."""
    machine = load_machine(path)
    data = derive(machine)
    start_rpm, loaded_rpm = START_PART * data.speed_base_rpm, LOADED_PART * data.speed_base_rpm
    start_s = machine.inertia_kg_m2 * start_rpm / _RPM / data.parameters["torque_max_Nm"]
    braking_s = _up(2.0 * start_s + _SETTLED_S)
    load_s = _up(braking_s + 2.0 * start_s + _SETTLED_S)
    ripple_s = _up(load_s + _LOADED_S)
    unload_s = _up(ripple_s + _window_s(machine, loaded_rpm))
    reversal_s = _up(unload_s + _UNLOADED_S)
    load = LoadStep(load_s, LOAD_PART * data.torque_rated_Nm)
    common = Scenario(name="compare", machine=str(path), controller=controller, duration_s=unload_s,
                      speed=(SpeedStep(0.0, start_rpm),), load=(load,), record=Record(1.0, 0.0),
                      **stated_conditions(path))
    if controller != "salient":  # single-quadrant: at the speed of the start
        return common
    return Scenario(**{**vars(common), "duration_s": _up(reversal_s + 3.0 * start_s + _SETTLED_S),
                       "speed": (*common.speed, SpeedStep(braking_s, loaded_rpm), SpeedStep(reversal_s, -loaded_rpm)),
                       "load": (load, LoadStep(unload_s, 0.0))})


def _up(time_s: float) -> float:
    return math.ceil(time_s * 1e3) / 1e3


def _window_s(machine: Machine, speed_rpm: float) -> float:
    """At least two electrical revolutions."""
    return max(0.05, 120.0 / (machine.rotor_poles * speed_rpm))


def extract(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Times of the start, the braking and the reversal as parts of their bounds, and the excess of the latest beyond
    what is in time; dip and recovery of the load step; ripple and speed error under the load."""
    time_s, speed_rpm = recording["time_s"], recording["speed_rpm"]
    machine = load_machine(machine_path(scenario.machine))
    load_s = scenario.load[0].at_s
    held_rpm = scenario.speed[min(1, len(scenario.speed) - 1)].value_rpm
    ripple_s = load_s + _LOADED_S
    window_s = (ripple_s, ripple_s + _window_s(machine, LOADED_PART * derive(machine).speed_base_rpm))
    ends_s = [*(step.at_s for step in scenario.speed[1:]), scenario.duration_s]
    ends_s[min(1, len(ends_s) - 1)] = load_s
    values: Metrics = {"late_s": 0.0}
    before_rpm = 0.0
    for name, step, end_s in zip(("start", "brake", "reverse"), scenario.speed, ends_s, strict=False):
        part = slice(*np.searchsorted(time_s, (step.at_s - 1e-9, end_s)))
        taken_s = metrics.time_to_stay_in_band_s(time_s[part], speed_rpm[part], step.value_rpm, step.at_s)
        bound_s = change_bound_s(scenario.machine, before_rpm, step.value_rpm)
        before_rpm = step.value_rpm
        values[f"{name}_to_bound"] = None if taken_s is None else taken_s / bound_s
        late_s, so_far_s = None, values["late_s"]
        if taken_s is not None and so_far_s is not None:
            late_s = max(so_far_s, taken_s - max(BOUND_FACTOR * bound_s, bound_s + BOUND_EXTRA_S))
        values["late_s"] = late_s
    loaded = slice(*np.searchsorted(time_s, (load_s - 1e-9, window_s[1])))
    held = slice(*np.searchsorted(time_s, window_s))
    dip_rpm = held_rpm - float(np.min(speed_rpm[loaded]))
    values["dip_percent"] = 100.0 * max(0.0, dip_rpm) / held_rpm
    values["recovery_time_s"] = metrics.time_to_stay_in_band_s(time_s[loaded], speed_rpm[loaded], held_rpm, load_s)
    values["hold_percent"] = 100.0 * abs(float(np.mean(speed_rpm[held], dtype=float)) / held_rpm - 1.0)
    ripple = metrics.torque_metrics(time_s, recording["torque_Nm"], window_s)["torque_ripple"]
    values["ripple"] = ripple
    if scenario.controller == "salient":
        of_reference = ripples(scenario)["reference"]
        values["ripple_reference"] = of_reference
        values["ripple_to_allowed"] = ripple / max(RIPPLE_MAX, RIPPLE_OF_REFERENCE * of_reference)
    return values


def ripples(scenario: Scenario) -> dict[str, float]:
    """Torque ripple of the firmware and of its reference model, by reference.DRIVES, under the load of a run of
    `salient`, from a start to the speed under load on."""
    machine = load_machine(machine_path(scenario.machine))
    braking, load = scenario.speed[1], scenario.load[0]
    load_s = load.at_s - braking.at_s
    measured = reference.measure(
        scenario.machine, control_rate_hz=scenario.control_rate_hz, encoder_bits=scenario.encoder_bits,
        encoder_edges=scenario.encoder_edges, adc_bits=scenario.adc_bits, speed_rpm=braking.value_rpm,
        load_Nm=load.torque_Nm, load_at_s=load_s, from_s=load_s + _LOADED_S,
        window_s=_window_s(machine, braking.value_rpm))
    return {drive: of["ripple"] for drive, of in measured.items()}


@lru_cache(maxsize=256)
def change_bound_s(path: str, from_rpm: float, to_rpm: float) -> float:
    """Bound of a change of speed, until the speed is within 0.5 % of the new one."""
    machine = load_machine(machine_path(path))
    data: DriveData = derive(machine)
    reached_rpm = to_rpm * (1.0 + math.copysign(metrics.BAND, from_rpm - to_rpm) * math.copysign(1.0, to_rpm))
    return speed_change_s(machine.magnetics, machine.phases, Source(data.supply_min_V, machine.resistance_ohm),
                          data.parameters["current_limit_A"], data.parameters["torque_max_Nm"], machine.inertia_kg_m2,
                          machine.friction_Nm_s, from_rpm / _RPM, reached_rpm / _RPM)


def failures(values: Metrics, controller: str) -> list[str]:
    """Duties of a drive of any machine that this one fails."""
    late_s, hold_percent = values["late_s"], values["hold_percent"]
    wrong = [f"{name} not settled" for name in ("start", "brake", "reverse")
             if controller == "salient" and values[f"{name}_to_bound"] is None]
    if controller == "salient" and late_s is not None and late_s > 0.0:
        wrong.append(f"{1e3 * late_s:.1f} ms late")
    if hold_percent is not None and hold_percent > 100.0 * metrics.BAND:
        wrong.append(f"speed under load {hold_percent:.2f} % off")
    if (values.get("ripple_to_allowed") or 0.0) > 1.0:
        wrong.append(f"K_t {values['ripple']:.4f}, of the reference model {values['ripple_reference']:.4f}")
    return wrong
