"""Cost of a wrong machine file: the drive on one with a stated error (wrong_files.py), the motor of the right one.

Speeds and loads are the right machine's, and each figure is beside the figure of the drive on the right file.

A displaced angle is an offset of the encoder: no machine file has one, and the loader refuses a map that is symmetric
about another angle than 0.
"""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from salient.config import CONTROLLERS
from salient.experiments import metrics
from salient.experiments.compare import speed_range
from salient.experiments.compare.case import LOAD_NM, MACHINES, STEP_AT_S, Case, by_controller, make_scenario
from salient.experiments.compare.wrong_files import FAULTS, FOLDER, Fault, every_fault, wrong_file
from salient.experiments.scaled import Scale, scale_of
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep
from salient.machine.definition import MachineError
from salient.machine.file import load_machine, machine_path
from salient.machine.path import stated_conditions
from salient.paths import EXAMPLE_MACHINES
from salient.paths import MACHINES as MACHINE_FILES

GROUP, FILES = "mismatch", "machines"
"""The group, and the folder of the machine files in the folder of the results."""
RIGHT = "right file"
PROMISED = ("flux linkage x 1.1", "resistance x 0.7", "inertia x 0.5", "inertia x 2", "friction x 0.2", "friction x 5",
            "angle 0.5 deg", "angle 1 deg")
"""Errors within the ranges of motors by their files over which the drive runs (groups `robustness`, `misalignment`)."""
LEARNED = ("flux linkage x 0.9", "flux linkage x 1.1", "flux linkage x 1.2", "resistance x 1.3")
"""Errors within the ranges over which the scale of the tables and the resistance are learned."""
QUICK = ("flux linkage x 0.8", "inertia x 2")
STEP_RPM, START_RPM = 150.0, 600.0
STEADY_S = {"salient": 6.0}
"""From the load step to the steady state, 1 s with the others: `salient` learns a misalignment."""
RECOVERY_S = 0.4
RIPPLE_AFTER_S = 0.02
HELD_OF_BASE, HELD_PART = 0.1, 0.5
FAST_OF_BASE, FAST_PART = 1.5, 0.5
"""Speeds of the held shaft, and torques: of the rated one, above base speed of the largest one there."""
LEARNED_S = 2.0
"""On a held shaft, until the scale of the tables is learned."""

Metrics = dict[str, float | None]


def mismatch(quick: bool, machines: Sequence[str] = MACHINES) -> Iterator[Case]:
    """Each machine on its own file, and on one with each error."""
    faults = {name: FAULTS[name] for name in QUICK} if quick else every_fault()
    for machine in machines[:1] if quick else machines:
        right = _condition(machine, RIGHT)
        yield from _cases(machine, machine, Fault(), right, "")
        for name, fault in faults.items():
            file = _file(machine, name, fault)
            if file is not None:
                yield from _cases(machine, file, fault, _condition(machine, name), right)


GROUPS = {GROUP: mismatch}
"""Cases of given machines, by group."""


def refused(machines: Sequence[str] = MACHINES) -> list[str]:
    """Errors that a machine cannot have, because the loader refuses the file with them: a line each."""
    return [f"{_condition(machine, name)}: left out: {line}" for machine in machines
            for name, fault in every_fault().items() if (line := _made(machine, name, fault)[1])]


def copy_files(cases: Iterable[Case], out: Path) -> list[tuple[Path, str]]:
    """Copies the wrong machine files of the runs, with their maps, to a folder of the results. Returns each with the
    right machine."""
    used = {Path(case.scenario.machine): case.scenario.true_machine for case in cases
            if case.group == GROUP and case.scenario.true_machine is not None}
    copies = []
    for path, right in used.items():
        folder = out / FILES / path.parent.name
        folder.mkdir(parents=True, exist_ok=True)
        for file in (path, path.with_suffix(".csv")):
            if file.exists():
                shutil.copyfile(file, folder / file.name)
        copies.append((folder / path.name, right))
    return copies


def _condition(machine: str, name: str) -> str:
    return f"{machine if machine in MACHINES else load_machine(machine_path(machine)).name}, {name}"


def _file(machine: str, name: str, fault: Fault) -> str | None:
    """The file of the firmware; None: the machine cannot have the error."""
    path = _made(machine, name, fault)[0]
    return machine if path == machine_path(machine) else None if path is None else str(path)


@lru_cache(maxsize=1024)
def _made(machine: str, name: str, fault: Fault) -> tuple[Path | None, str]:
    """The file, None for an error that the machine cannot have, and the loader's refusal, "" without one."""
    path = machine_path(machine)
    own = path.parent in (MACHINE_FILES, EXAMPLE_MACHINES)  # files of the user may have one name
    folder = FOLDER / (path.stem if own else f"{path.stem}-{zlib.crc32(str(path).encode()):08x}")
    try:
        return wrong_file(path, fault, name, folder), ""
    except MachineError as error:
        return None, str(error)


@lru_cache
def _scale(machine: str) -> Scale:
    return scale_of(load_machine(machine_path(machine)))


# --- runs -----------------------------------------------------------------------------------------------------------

def _cases(machine: str, file: str, fault: Fault, condition: str, right: str) -> Iterator[Case]:
    """The runs of the drive on a file with the motor of `machine`. right: the condition that ratios are relative to."""
    for extractor, scenario, controllers in _scenarios(machine):
        changed = replace(scenario, machine=file, true_machine=None if file == machine else machine,
                          bench=scenario.bench | ({"encoder_offset_deg": fault.angle_deg} if fault.angle_deg else {}))
        for case in by_controller(GROUP, condition, extractor, changed, controllers=controllers):
            yield replace(case, relative_to=right)


def _scenarios(machine: str) -> Iterator[tuple[str, Scenario, Sequence[str]]]:
    """Extractor, run and controllers of a machine on its own file."""
    scale, stated = _scale(machine), stated_conditions(machine_path(machine))
    speed_rpm, load_Nm = scale.rpm(STEP_RPM), scale.Nm(LOAD_NM)
    step_s = round(STEP_AT_S + scale.delay_s(speed_rpm, STEP_AT_S), 6)
    window_s = scale.window_s(speed_rpm)
    step = make_scenario(machine=machine, duration_s=round(step_s + max(RECOVERY_S, RIPPLE_AFTER_S + window_s), 6),
                         speed=(SpeedStep(0.0, speed_rpm),), load=(LoadStep(step_s, load_Nm),),
                         record=Record(1.0, step_s), **stated)
    yield "mismatch_step", step, CONTROLLERS
    for controller in CONTROLLERS:
        from_s = round(step_s + STEADY_S.get(controller, 1.0), 6)
        yield "ripple", replace(step, duration_s=round(from_s + window_s, 6), record=Record(1.0, from_s)), (controller,)
    start_rpm = scale.rpm(START_RPM)
    yield "start", make_scenario(machine=machine, duration_s=round(0.5 + scale.delay_s(start_rpm, 0.5), 6),
                                 speed=(SpeedStep(0.0, start_rpm),), record=Record(10.0, 0.0), **stated), CONTROLLERS
    held, fast = speed_range.held_parts(machine, HELD_OF_BASE, HELD_PART, FAST_OF_BASE, FAST_PART)
    yield "mismatch_held", _longer(held), CONTROLLERS
    if fast is not None:
        yield "mismatch_fast", _longer(fast), ("salient",)


def _longer(held: Scenario) -> Scenario:
    """A run on a held shaft with the same number of electrical revolutions once more after LEARNED_S."""
    return replace(held, duration_s=round(held.duration_s + LEARNED_S, 6))


# --- metrics --------------------------------------------------------------------------------------------------------

def step_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Drop and recovery of a load step, and the ripple of a window from RIPPLE_AFTER_S after it on."""
    after = metrics.speed_after_step(recording, scenario.speed[-1].value_rpm, scenario.load[0].at_s)
    first_s = scenario.load[0].at_s + RIPPLE_AFTER_S
    window_s = _scale(scenario.plant).window_s(scenario.speed[-1].value_rpm)
    torque = metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], (first_s, first_s + window_s))
    return {"ripple_step": torque["torque_ripple"], "speed_dip_rpm": after["speed_dip_rpm"],
            "recovery_time_s": after["recovery_time_s"]}


def held_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """Mean torque on a held shaft, at first and after LEARNED_S, and its errors."""
    mean_Nm, error_percent, learned_percent = _torque(scenario, recording)
    return {"torque_mean_Nm": mean_Nm, "torque_error_percent": error_percent,
            "torque_error_2s_percent": learned_percent}


def fast_metrics(scenario: Scenario, recording: np.ndarray) -> Metrics:
    """The same above base speed."""
    mean_Nm, error_percent, learned_percent = _torque(scenario, recording)
    return {"torque_fast_Nm": mean_Nm, "torque_error_fast_percent": error_percent,
            "torque_error_fast_2s_percent": learned_percent}


def _torque(scenario: Scenario, recording: np.ndarray) -> tuple[float, float, float]:
    """Mean torque of the first whole electrical revolutions in N m, its error, and the error of the last ones, in %."""
    assert scenario.record is not None  # every case is recorded
    rows = round((scenario.duration_s - scenario.record.from_s - LEARNED_S) / (1e-6 * scenario.record.step_us))
    means_Nm = [float(np.mean(part, dtype=float)) for part in (
        recording["torque_Nm"][:rows], recording["torque_Nm"][-rows:])]
    first, last = (100.0 * abs(mean_Nm / scenario.torque[0].value_Nm - 1.0) for mean_Nm in means_Nm)
    return means_Nm[0], first, last
