"""What is taken from a run, and what each figure is called, in which unit, and which way is better.

A measure is a function of (scenario, recording) that gives figures by name; a figure is None when it does not come
about within the run (a drive that never settles). MetricsError for a recording that a figure cannot be taken from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from salient.experiments import metrics
from salient.experiments.scenario import Scenario
from salient.machine.file import load_machine, machine_path

Figures = dict[str, float | None]

SHORT_WINDOW_S = 0.1
"""The length of the paper's window; where a run has more, the figure over all of it stands beside."""

STEADY_S = 0.5
"""Of the end of a run of the robustness study: what the speed and the spectrum are taken over."""

HOLDS_PERCENT = 100.0 * metrics.BAND
PEAK_CURRENT_A = 90.0
HIGHEST_SPEED_PERCENT = 105.0
CYCLE_PERCENT = 1.0
"""What a drive of the robustness study must stay within. The last: strongest line of the torque's spectrum that is no
harmonic of the strokes, in percent of the mean torque (metrics.strongest_line)."""


@dataclass(frozen=True)
class Figure:
    """How a figure is shown: words, unit, decimals, factor into that unit. Lower is better. A difference below
    `resolution`, in the unit shown, is no change; in percent, changes are of what is above `zero`."""

    words: str
    unit: str
    decimals: int
    resolution: float
    factor: float = 1.0
    zero: float = 0.0


FIGURES = {
    "ripple": Figure("K_t over 0.1 s", "", 5, 0.0002),
    "ripple_long": Figure("K_t over 1 s", "", 5, 0.0002),
    "ripple_late": Figure("K_t after 3 s", "", 5, 0.0002),
    "speed_error_percent": Figure("speed error", "%", 3, 0.01),
    "settling_time_s": Figure("settled within 0.5 %", "s", 5, 0.0001),
    "overshoot_percent": Figure("overshoot", "%", 3, 0.005),
    "speed_dip_rpm": Figure("dip", "r/min", 2, 0.02),
    "recovery_time_s": Figure("back within 0.5 %", "ms", 2, 0.1, 1e3),
    "speed_after_rpm": Figure("highest speed after it", "r/min", 2, 0.05, zero=150.0),
    "copper_W": Figure("copper loss before the step", "W", 2, 0.05),
    "torque_mean_Nm": Figure("mean torque", "N m", 3, 0.01),
    "peak_current_A": Figure("peak phase current", "A", 1, 0.5),
    "highest_speed_percent": Figure("highest speed", "% of reference", 2, 0.05, zero=100.0),
    "cycle_percent": Figure("limit cycle", "% of torque", 3, 0.05),
    "failed": Figure("drives that fail", "", 0, 0.5),
    "step_angle_deg": Figure("rotor angles at the step", "deg", 2, 0.2),
}


def take_ripple(scenario: Scenario, recording: np.ndarray) -> Figures:
    """Torque from the first recorded sample on, over SHORT_WINDOW_S and to the end of the run; and the speed."""
    first_s, last_s = scenario.record.from_s, scenario.duration_s
    figures: Figures = {"ripple": _ripple(recording, (first_s, first_s + SHORT_WINDOW_S))}
    if last_s > first_s + 1.5 * SHORT_WINDOW_S:
        figures["ripple_long"] = _ripple(recording, (first_s, last_s))
    figures["speed_error_percent"] = metrics.speed_error_percent(recording, scenario.speed[-1].value_rpm,
                                                                 (first_s, last_s))
    return figures


def take_late_ripple(scenario: Scenario, recording: np.ndarray) -> Figures:
    """Torque over the whole recording, the end of a long run."""
    return {"ripple_late": _ripple(recording, (scenario.record.from_s, scenario.duration_s))}


def take_start(scenario: Scenario, recording: np.ndarray) -> Figures:
    """A start from standstill."""
    reference = scenario.speed[0]
    figures = metrics.start_metrics(recording, reference.value_rpm, reference.at_s)
    return {name: figures[name] for name in ("settling_time_s", "overshoot_percent")}


def take_load_step(scenario: Scenario, recording: np.ndarray) -> Figures:
    """A load step at a steady speed; the copper loss over the stroke before it, where that was recorded; and the
    rotor's angle at the step, in degrees of a stroke."""
    reference_rpm, step_s = scenario.speed[-1].value_rpm, scenario.load[0].at_s
    stroke_deg = metrics.stroke_deg(load_machine(machine_path(scenario.machine)))
    figures = metrics.speed_after_step(recording, reference_rpm, step_s)
    at_step = int(np.searchsorted(recording["time_s"], step_s - 1e-9))
    before_s = step_s - stroke_deg / (6.0 * reference_rpm)
    if recording["time_s"][0] <= before_s:
        before = int(np.searchsorted(recording["time_s"], before_s - 1e-9))
        copper_J = float(recording["energy_copper_J"][at_step]) - float(recording["energy_copper_J"][before])
        figures["copper_W"] = copper_J / float(recording["time_s"][at_step] - recording["time_s"][before])
    return {**figures, "step_angle_deg": float(recording["rotor_angle_deg"][at_step]) % stroke_deg}


def take_step_and_ripple(scenario: Scenario, recording: np.ndarray) -> Figures:
    """A load step, and the paper's ripple window with mean torque."""
    torque = metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], metrics.RIPPLE_WINDOW_S)
    step = take_load_step(scenario, recording)
    return {**step, "ripple": torque["torque_ripple"], "torque_mean_Nm": torque["torque_mean_Nm"]}


def take_robustness(scenario: Scenario, recording: np.ndarray) -> Figures:
    """A start and a load held: the last STEADY_S are steady. The run is recorded whole."""
    reference_rpm, last_s = scenario.speed[-1].value_rpm, scenario.duration_s
    steady_s = (last_s - STEADY_S, last_s)
    machine = load_machine(machine_path(scenario.machine))
    currents = [recording[name] for name in recording.dtype.names if name.startswith("current_")]
    return {
        "settling_time_s": metrics.time_to_stay_in_band_s(
            *_until(recording, scenario.load[0].at_s), reference_rpm, scenario.speed[-1].at_s),
        "peak_current_A": max(float(np.max(np.abs(current))) for current in currents),
        "highest_speed_percent": 100.0 * float(np.max(recording["speed_rpm"])) / reference_rpm,
        "speed_dip_rpm": metrics.speed_after_step(recording, reference_rpm, scenario.load[0].at_s)["speed_dip_rpm"],
        "speed_error_percent": metrics.speed_error_percent(recording, reference_rpm, steady_s),
        "cycle_percent": metrics.strongest_line_percent(recording, steady_s, metrics.stroke_deg(machine)),
    }


MEASURES: dict[str, Callable[[Scenario, np.ndarray], Figures]] = {
    "ripple": take_ripple,
    "late_ripple": take_late_ripple,
    "start": take_start,
    "load_step": take_load_step,
    "step_and_ripple": take_step_and_ripple,
    "robustness": take_robustness,
}


def failures(figures: Figures) -> list[str]:
    """What a drive of the robustness study did not keep to, in words; empty when it is well."""
    wrong = []
    if figures["settling_time_s"] is None:
        wrong.append("not at speed before the load came")
    for name, limit in (("speed_error_percent", HOLDS_PERCENT), ("peak_current_A", PEAK_CURRENT_A),
                        ("highest_speed_percent", HIGHEST_SPEED_PERCENT), ("cycle_percent", CYCLE_PERCENT)):
        if figures[name] > limit:
            figure = FIGURES[name]
            wrong.append(f"{figure.words} {figures[name]:.{figure.decimals}f} {figure.unit}")
    return wrong


def _ripple(recording: np.ndarray, window_s: tuple[float, float]) -> float:
    return metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], window_s)["torque_ripple"]


def _until(recording: np.ndarray, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    end = int(np.searchsorted(recording["time_s"], end_s))
    return recording["time_s"][:end], recording["speed_rpm"][:end]
