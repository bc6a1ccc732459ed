"""The comparison for one machine: the cases of the paper's machine in terms of another (experiments/scaled.py)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from salient.bench.rig import bench_variables
from salient.experiments.compare import count_cases, every_machine, mismatch, speed_range
from salient.experiments.compare.case import Case
from salient.experiments.compare.cases import RIPPLE_RPM, STROKE_DEG
from salient.experiments.compare.targets import TARGETS, Key, Target
from salient.experiments.metrics import stroke_deg
from salient.experiments.scaled import PAPER_WINDOW_S, Scale, fastest_rpm, in_terms_of, later_s, scale_of
from salient.experiments.scenario import Scenario
from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.lowest_speed import lowest_speed_rpm
from salient.machine.parameter_table import read_table
from salient.paths import MACHINES

PAPER = "saturating"

_RELATIVE: dict[tuple[str, str], Callable[[Scale], float]] = {
    **dict.fromkeys((("inertia", "recovery_ratio"), ("inertia", "swing_percent"), ("inertia", "overshoot_percent"),
                     ("encoders", "failed"), ("encoders", "against_periods"), ("misalignment", "ripple_6s_ratio")),
                    lambda scale: 1.0),
    **dict.fromkeys((("mismatch", metric) for metric in ("recovery_to_right", "overshoot_percent", "ripple_to_right")),
                    lambda scale: 1.0),
    ("standing_error", "mean_error_rpm"): lambda scale: scale.speed,
}
"""Group and metric of the targets that mean the same for every machine, and the factor of the limit."""


@dataclass(frozen=True)
class Subject:
    """A machine and its factors of the paper's machine's values, by unit."""

    path: str
    machine: Machine
    scale: Scale
    factors: Mapping[str, float]

    @property
    def is_bundled(self) -> bool:
        """It is one of the machines that the targets are about, whatever a file of the same name contains."""
        return machine_path(self.path).parent == MACHINES

    def text(self, text: str) -> str:
        """A title or condition with the machine's speeds and torques."""
        text = re.sub(r"\b(\d[\d.]*)( or (\d[\d.]*))?(?= r/min)", self._speeds, text)
        text = re.sub(r"\b(\d[\d.]*)(?= N m)", lambda match: f"{self.scale.Nm(float(match[1])):g}", text)
        return re.sub(rf"\b{PAPER}\b", self.machine.name, text)

    def _speeds(self, match: re.Match[str]) -> str:
        return " or ".join(f"{self.scale.rpm(float(number)):g}" for number in (match[1], match[3]) if number)


def subject(name_or_path: str) -> Subject:
    """The subject of a machine file; MachineError."""
    path = machine_path(name_or_path)
    machine, of_paper = load_machine(path), load_machine(machine_path(PAPER))
    data, paper = derive(machine), derive(of_paper)
    scale = scale_of(machine)
    torque = scale.torque
    return Subject(name_or_path, machine, scale, {
        "N m": torque, "N m/s": torque, "1/(N m)": 1.0 / torque, "r/min": scale.speed,
        "A": data.current_peak_A / paper.current_peak_A, "V": data.supply_max_V / paper.supply_max_V,
    })


def is_allowed(scenario: Scenario) -> bool:
    """False when the drive is refused a speed with the scenario's encoder."""
    lowest_rpm = lowest_speed_rpm(scenario.machine, scenario.encoder_bits, scenario.controller)
    return all(step.value_rpm == 0.0 or abs(step.value_rpm) >= lowest_rpm for step in scenario.speed)


def cases_of(cases: Iterable[Case], on: Subject, quick: bool = False) -> list[Case]:
    """The cases of the paper's machine among `cases`, for another machine, and its own runs of the groups `machines`
    and the groups of speed_range.py, count_cases.py and mismatch.py."""
    of_paper, sized = [], {}
    groups: dict[str, None] = {}
    for case in cases:
        groups[case.group] = None  # in order
        if case.group in {**speed_range.GROUPS, **mismatch.GROUPS} or case.extractor == count_cases.EXTRACTOR:
            continue
        if case.scenario.machine == PAPER:
            own_case = _case(case, on)
            if is_allowed(own_case.scenario):
                of_paper.append(own_case)
        elif case.extractor == "every_machine":
            sized[case.controller] = replace(case, condition=on.machine.name, scenario=every_machine.scenario(
                machine_path(on.path), case.controller))
    generators = {**speed_range.GROUPS, **count_cases.GROUPS, **mismatch.GROUPS}
    own = [case for group in groups if group in generators for case in generators[group](quick, (on.path,))]
    if sized:
        own += speed_range.of_any_machine(quick, on.path)
    return [*of_paper, *sized.values(), *own]


def targets_of(on: Subject) -> dict[Key, Target]:
    """The targets of the paper's machine that are relative, for another. The rest are values measured with the paper's
    machine: no statement about another."""
    return {(group, on.text(condition), metric, statistic): replace(
                target, limit=None if target.limit is None else target.limit * _RELATIVE[group, metric](on.scale))
            for (group, condition, metric, statistic), target in TARGETS.items()
            if (group, metric) in _RELATIVE and condition.split(",")[0] == PAPER and _has_runs(on.text(condition), on)}


def _has_runs(condition: str, on: Subject) -> bool:
    """False for an encoder and a speed that the drive is refused."""
    bits, rpm = re.search(r"(\d+) bits", condition), re.search(r"([\d.]+) r/min", condition)
    return not bits or not rpm or float(rpm[1]) >= lowest_speed_rpm(on.path, int(bits[1]), "salient")


def _case(case: Case, on: Subject) -> Case:
    scenario, scale = case.scenario, on.scale
    speed_rpm = fastest_rpm(scenario, scale)
    delay_s = _delay_s(scenario, scale, speed_rpm)
    if case.strokes:
        # The load step is at this part of a stroke, of the machine's instead of the paper's machine's.
        paper_s = STROKE_DEG / (6.0 * RIPPLE_RPM)
        delay_s += case.strokes * (stroke_deg(on.machine) / (6.0 * speed_rpm) - paper_s)
    longer_s = scale.window_s(speed_rpm) - PAPER_WINDOW_S if "ripple" in case.extractor else 0.0
    return replace(
        case, condition=on.text(case.condition),
        window_s=(later_s(case.window_s[0], delay_s), later_s(case.window_s[1], delay_s + longer_s)),
        scenario=replace(
            in_terms_of(scenario, scale, delay_s, longer_s), machine=on.path,
            parameters=_scaled(scenario.parameters, _parameter_units(), on.factors),
            bench=_scaled(scenario.bench, _bench_units(), on.factors)))


def _delay_s(scenario: Scenario, scale: Scale, speed_rpm: float) -> float:
    """Time by which the machine comes to its speed later than the paper's machine."""
    step_s = min((load.at_s for load in scenario.load), default=None)
    event_s = step_s if step_s is not None else scenario.duration_s - PAPER_WINDOW_S
    return scale.delay_s(speed_rpm, event_s - scenario.speed[0].at_s)


def _scaled(values: Mapping[str, float], units: Mapping[str, str], factors: Mapping[str, float]) -> dict[str, float]:
    return {name: value * factors.get(units[name], 1.0) for name, value in values.items()}


@lru_cache
def _parameter_units() -> dict[str, str]:
    return {row.name: row.unit for row in read_table()}


@lru_cache
def _bench_units() -> dict[str, str]:
    return {name: signal.unit or "" for name, signal in bench_variables().items()}
