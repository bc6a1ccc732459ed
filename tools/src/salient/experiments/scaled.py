"""The experiments in terms of a machine: the paper's speeds are fractions of the base speed, its loads fractions of the
rated torque (drive_data.py), and recordings are as long as the machine's inertia and speed require.

For the machines whose base speed and rated torque are the paper's, 1500 r/min and 16 N m, nothing changes unless they
accelerate more slowly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep, TorqueStep
from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.scaling import Scaling, choose

PAPER_BASE_RPM = 1500.0
PAPER_RATED_NM = 16.0
PAPER_WINDOW_S = 0.1
AFTER_WINDOW_S = 0.1
"""From the end of the window of the steady torque to the end of a run of the demo."""

_DIGITS = 2  # of scaled speeds and loads
_START_FACTOR, _START_EXTRA_S = 1.5, 0.05
"""A start takes the time that inertia and torque limit require; experiments wait for this factor of it and more."""


@dataclass(frozen=True)
class Scale:
    """speed, torque: factors of the paper's values. electrical_Hz_per_rpm: electrical revolutions in a second at
    1 r/min."""

    speed: float = 1.0
    torque: float = 1.0
    speed_max_rpm: float = math.inf
    torque_max_Nm: float = math.inf
    start_s_per_rpm: float = 0.0
    electrical_Hz_per_rpm: float = math.inf

    def rpm(self, paper_rpm: float) -> float:
        """The machine's speed for one of the paper's, two significant digits."""
        speed_rpm = _rounded(paper_rpm, self.speed)
        return math.copysign(min(abs(speed_rpm), self.speed_max_rpm), speed_rpm)

    def Nm(self, paper_Nm: float) -> float:
        """The machine's torque for one of the paper's, two significant digits."""
        return _rounded(paper_Nm, self.torque)

    def reference_Nm(self, paper_Nm: float) -> float:
        """The machine's torque reference for one of the paper's, at most its torque limit: the range on CAN is the
        machine's."""
        torque_Nm = self.Nm(paper_Nm)
        return math.copysign(min(abs(torque_Nm), self.torque_max_Nm), torque_Nm)

    def window_s(self, speed_rpm: float) -> float:
        """Length of a window of steady torque: the paper's, at least an electrical revolution."""
        return max(PAPER_WINDOW_S, round(1.0 / (abs(speed_rpm) * self.electrical_Hz_per_rpm), 6) if speed_rpm else 0.0)

    def delay_s(self, speed_rpm: float, paper_s: float) -> float:
        """Time by which what follows a start within paper_s comes later, whole milliseconds."""
        required_s = _START_FACTOR * self.start_s_per_rpm * abs(speed_rpm) + _START_EXTRA_S
        return max(0.0, math.ceil((required_s - paper_s) * 1e3) / 1e3)


def scale_of(machine: Machine) -> Scale:
    """The scale of a machine's experiments."""
    data = derive(machine)
    return Scale(
        speed=data.speed_base_rpm / PAPER_BASE_RPM,
        torque=data.torque_rated_Nm / PAPER_RATED_NM,
        speed_max_rpm=Scaling(data, choose(data, machine), machine.phases).speed_range_rpm,
        torque_max_Nm=data.parameters["torque_max_Nm"],
        start_s_per_rpm=machine.inertia_kg_m2 * math.pi / 30.0 / data.parameters["torque_max_Nm"],
        electrical_Hz_per_rpm=machine.rotor_poles / 60.0,
    )


def scale_of_name(name_or_path: str) -> Scale:
    """scale_of a bundled machine or a machine file."""
    return scale_of(load_machine(machine_path(name_or_path)))


def scaled(scenario: Scenario, scale: Scale) -> Scenario:
    """One of the demo's scenarios, written for the paper's machine, for another."""
    speed_rpm = fastest_rpm(scenario, scale)
    first_s = min((load.at_s for load in scenario.load), default=scenario.duration_s - AFTER_WINDOW_S - PAPER_WINDOW_S)
    delay_s = scale.delay_s(speed_rpm, first_s - scenario.speed[0].at_s)
    return in_terms_of(scenario, scale, delay_s, scale.window_s(speed_rpm) - PAPER_WINDOW_S)


def fastest_rpm(scenario: Scenario, scale: Scale) -> float:
    """The highest speed that a scenario requests of the machine; 0 when it requests none."""
    return max((abs(scale.rpm(step.value_rpm)) for step in scenario.speed), default=0.0)


def in_terms_of(scenario: Scenario, scale: Scale, delay_s: float, longer_s: float) -> Scenario:
    """Speeds, loads and torques of the machine; what follows the start comes delay_s later, and the end by longer_s
    more."""
    record = scenario.record
    if record is not None and record.from_s > 0.0:
        record = Record(record.step_us, later_s(record.from_s, delay_s))
    return replace(
        scenario, record=record,
        speed=tuple(SpeedStep(step.at_s, scale.rpm(step.value_rpm)) for step in scenario.speed),
        torque=tuple(TorqueStep(later_s(step.at_s, delay_s), scale.reference_Nm(step.value_Nm))
                     for step in scenario.torque),
        load=tuple(LoadStep(later_s(load.at_s, delay_s), scale.Nm(load.torque_Nm),
                            None if load.profile_Nm is None else scale.Nm(load.profile_Nm)) for load in scenario.load),
        duration_s=later_s(scenario.duration_s, delay_s + longer_s))


def later_s(time_s: float, by_s: float) -> float:
    """A time of a scenario, whole microseconds when it changes."""
    return round(time_s + by_s, 6) if by_s else time_s


def steady_window_s(scenario: Scenario, scale: Scale) -> tuple[float, float]:
    """Window of the steady torque of one of the demo's scenarios."""
    end_s = scenario.duration_s - AFTER_WINDOW_S
    return round(end_s - scale.window_s(scenario.speed[-1].value_rpm), 6), round(end_s, 6)


def _rounded(value: float, factor: float) -> float:
    return value if math.isclose(factor, 1.0, rel_tol=1e-9) else float(f"{value * factor:.{_DIGITS}g}")
