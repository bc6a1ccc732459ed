"""Metrics of a run, and the label, unit and resolution of each.

An extractor is a function of (scenario, recording, window of the ripple in s where the recording is longer) that
returns metrics by name. A metric is None when its event does not occur within the run (a drive that never settles).
MetricsError for a recording without the data of a metric.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from salient.experiments import metrics
from salient.experiments.compare import every_machine
from salient.experiments.scaled import scale_of_name
from salient.experiments.scenario import Scenario
from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path

Metrics = dict[str, float | None]
Window = tuple[float, float]
PAPER_WINDOW_S = metrics.RIPPLE_WINDOW_S

STEADY_S = 0.5
"""Window at the end of a run of the robustness study, for the speed error and the spectrum."""

SPEED_ERROR_MAX_PERCENT = 100.0 * metrics.BAND
PEAK_CURRENT_MAX_A = 90.0
SPEED_MAX_PERCENT = 105.0
LIMIT_CYCLE_MAX_PERCENT = 1.0
"""Limits of the robustness study. The last: strongest line of the torque's spectrum that is not a harmonic of the
strokes, in percent of the mean torque (metrics.strongest_line_percent)."""


@dataclass(frozen=True)
class Metric:
    """Presentation of a metric; lower is better.

    factor: from the stored unit into `unit`. resolution: in `unit`; smaller differences are no change. reference: in
    the stored unit; the threshold of a change is relative to the excess over it.
    """

    label: str
    unit: str
    decimals: int
    resolution: float
    factor: float = 1.0
    reference: float = 0.0


METRICS = {
    "ripple": Metric("K_t over 0.1 s", "", 5, 0.0002),
    "ripple_long": Metric("K_t over 1 s", "", 5, 0.0002),
    "ripple_late": Metric("K_t after 3 s", "", 5, 0.0002),
    "speed_error_percent": Metric("speed error", "%", 3, 0.01),
    "settling_time_s": Metric("settling time to 0.5 %", "s", 5, 0.0001),
    "overshoot_percent": Metric("overshoot", "%", 3, 0.005),
    "speed_dip_rpm": Metric("speed drop", "r/min", 2, 0.02),
    "recovery_time_s": Metric("recovery time to 0.5 %", "ms", 2, 0.1, 1e3),
    "speed_after_rpm": Metric("maximum speed after the step", "r/min", 2, 0.05, reference=150.0),
    "speed_swing_rpm": Metric("peak-to-peak speed", "r/min", 2, 0.02),
    "copper_W": Metric("copper loss before the step", "W", 2, 0.05),
    "torque_mean_Nm": Metric("mean torque", "N m", 3, 0.01),
    "peak_current_A": Metric("peak phase current", "A", 1, 0.5),
    "highest_speed_percent": Metric("maximum speed", "% of reference", 2, 0.05, reference=100.0),
    "cycle_percent": Metric("limit cycle", "% of torque", 3, 0.05),
    "start_to_bound": Metric("time of the start", "of its bound", 3, 0.01),
    "brake_to_bound": Metric("time of the braking", "of its bound", 3, 0.01),
    "reverse_to_bound": Metric("time of the reversal", "of its bound", 3, 0.01),
    "late_s": Metric("latest beyond 1.1 times the bound or 2 ms", "ms", 2, 0.1, 1e3),
    "dip_percent": Metric("speed drop", "%", 2, 0.05),
    "hold_percent": Metric("mean speed error", "%", 4, 0.002),
    "failed": Metric("failed drives", "", 0, 0.5),
    "step_angle_deg": Metric("rotor angle at the step", "deg", 2, 0.2),
}


def _recorded_from_s(scenario: Scenario) -> float:
    assert scenario.record is not None  # every case is recorded
    return scenario.record.from_s


def ripple_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Ripple from the first recorded sample, over the paper's window and to the end of the run; speed error."""
    first_s, last_s = _recorded_from_s(scenario), scenario.duration_s
    short_s = scale_of_name(scenario.machine).window_s(scenario.speed[-1].value_rpm)
    values: Metrics = {"ripple": _ripple(recording, (first_s, first_s + short_s))}
    if last_s > first_s + 1.5 * short_s:
        values["ripple_long"] = _ripple(recording, (first_s, last_s))
    values["speed_error_percent"] = metrics.speed_error_percent(recording, scenario.speed[-1].value_rpm,
                                                                (first_s, last_s))
    return values


def late_ripple_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Ripple over the whole recording, which is the end of a long run."""
    return {"ripple_late": _ripple(recording, (_recorded_from_s(scenario), scenario.duration_s))}


def start_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A start from standstill."""
    reference = scenario.speed[0]
    values = metrics.start_metrics(recording, reference.value_rpm, reference.at_s)
    return {name: values[name] for name in ("settling_time_s", "overshoot_percent")}


def load_step_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A load step at steady speed: metrics after it, copper loss over the stroke before it where that was recorded, and
    the rotor angle at the step within a stroke, in degrees."""
    reference_rpm, step_s = scenario.speed[-1].value_rpm, scenario.load[0].at_s
    stroke_deg = metrics.stroke_deg(load_machine(machine_path(scenario.machine)))
    values = metrics.speed_after_step(recording, reference_rpm, step_s)
    at_step = int(np.searchsorted(recording["time_s"], step_s - 1e-9))
    before_s = step_s - stroke_deg / (6.0 * reference_rpm)
    if recording["time_s"][0] <= before_s:
        before = int(np.searchsorted(recording["time_s"], before_s - 1e-9))
        copper_J = float(recording["energy_copper_J"][at_step]) - float(recording["energy_copper_J"][before])
        values["copper_W"] = copper_J / float(recording["time_s"][at_step] - recording["time_s"][before])
    return {**values, "step_angle_deg": float(recording["rotor_angle_deg"][at_step]) % stroke_deg}


def moving_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Peak-to-peak speed over the whole recording, which is the steady state under a periodic load."""
    return {"speed_swing_rpm": float(np.ptp(recording["speed_rpm"]))}


def held_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Mean torque and peak current over the whole recording, which is of whole strokes."""
    return {"torque_mean_Nm": float(recording["torque_Nm"].mean(dtype=float)),
            "peak_current_A": _peak_current_A(recording)}


def step_and_ripple_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A load step, and ripple and mean torque over the window."""
    torque = metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], window_s)
    step = load_step_metrics(scenario, recording, window_s)
    return {**step, "ripple": torque["torque_ripple"], "torque_mean_Nm": torque["torque_mean_Nm"]}


def robustness_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A start and a load step; the last STEADY_S are steady. The whole run is recorded."""
    reference_rpm, last_s = scenario.speed[-1].value_rpm, scenario.duration_s
    steady_s = (last_s - STEADY_S, last_s)
    machine = load_machine(machine_path(scenario.machine))
    return {
        "settling_time_s": metrics.time_to_stay_in_band_s(
            *_until(recording, scenario.load[0].at_s), reference_rpm, scenario.speed[-1].at_s),
        "peak_current_A": _peak_current_A(recording),
        "highest_speed_percent": 100.0 * float(np.max(recording["speed_rpm"])) / reference_rpm,
        "speed_dip_rpm": metrics.speed_after_step(recording, reference_rpm, scenario.load[0].at_s)["speed_dip_rpm"],
        "speed_error_percent": metrics.speed_error_percent(recording, reference_rpm, steady_s),
        "cycle_percent": metrics.strongest_line_percent(recording, steady_s, metrics.stroke_deg(machine)),
    }


def every_machine_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A run of every_machine.py."""
    return every_machine.extract(scenario, recording)


EXTRACTORS: dict[str, Callable[[Scenario, np.ndarray, Window], Metrics]] = {
    "ripple": ripple_metrics,
    "late_ripple": late_ripple_metrics,
    "start": start_metrics,
    "load_step": load_step_metrics,
    "moving": moving_metrics,
    "held": held_metrics,
    "step_and_ripple": step_and_ripple_metrics,
    "robustness": robustness_metrics,
    "every_machine": every_machine_metrics,
}


def peak_current_max_A(machine: Machine) -> float:
    """PEAK_CURRENT_MAX_A for a machine, in proportion to its peak current."""
    return PEAK_CURRENT_MAX_A * derive(machine).current_peak_A / 52.0


def failures(values: Metrics, peak_A: float = PEAK_CURRENT_MAX_A) -> list[str]:
    """Limits that a drive of the robustness study violated, as text; empty when it passes."""
    wrong = []
    if values["settling_time_s"] is None:
        wrong.append("not at speed before the load step")
    for name, limit in (("speed_error_percent", SPEED_ERROR_MAX_PERCENT), ("peak_current_A", peak_A),
                        ("highest_speed_percent", SPEED_MAX_PERCENT), ("cycle_percent", LIMIT_CYCLE_MAX_PERCENT)):
        value = values[name]
        if value is not None and value > limit:
            metric = METRICS[name]
            wrong.append(f"{metric.label} {value:.{metric.decimals}f} {metric.unit}")
    return wrong


def _ripple(recording: np.ndarray, window_s: tuple[float, float]) -> float:
    return metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], window_s)["torque_ripple"]


def _peak_current_A(recording: np.ndarray) -> float:
    currents = [recording[name] for name in recording.dtype.names or () if name.startswith("current_")]
    return max(float(np.max(np.abs(current))) for current in currents)


def _until(recording: np.ndarray, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    end = int(np.searchsorted(recording["time_s"], end_s))
    return recording["time_s"][:end], recording["speed_rpm"][:end]
