"""Metrics of a run, and the label, unit and resolution of each.

An extractor is a function of (scenario, recording, window of the ripple in s where the recording is longer) that
returns metrics by name. A metric is None when its event does not occur within the run (a drive that never settles).
MetricsError for a recording without the data of a metric.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from salient.experiments import metrics
from salient.experiments.compare import count_cases, every_machine, mismatch, speed_range
from salient.experiments.scaled import scale_of_name
from salient.experiments.scenario import Scenario
from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path

Metrics = dict[str, float | None]
Window = tuple[float, float]
Extractor = Callable[..., Metrics]
PAPER_WINDOW_S = metrics.RIPPLE_WINDOW_S

STEADY_S = 0.5
"""Window at the end of a run of the robustness study, for the speed error and the spectrum."""

SPEED_ERROR_MAX_PERCENT = 100.0 * metrics.BAND
PEAK_CURRENT_MAX_A = 90.0
SPEED_MAX_PERCENT = 105.0
LIMIT_CYCLE_MAX_PERCENT = 1.0
"""Limits of the robustness study. The last: strongest line of the torque's spectrum that is not a harmonic of the
strokes, in percent of the mean torque (metrics.strongest_line_percent)."""


ALLOWANCE_RPM = 0.1
SETTLING_S = 3.0
SWING_MAX_RATIO = 1.05
OVERSHOOT_FROM_RPM = 150.0
"""Limits of random machines, speeds and loads, judged SETTLING_S after the load has its value, which covers learning a
misalignment. Before the load and under a constant one, the speed is within 0.5 % and ALLOWANCE_RPM of the reference; a
sine moves it by at most SWING_MAX_RATIO times the swing of the free shaft and ALLOWANCE_RPM, and its mean is within
0.5 % and ALLOWANCE_RPM of the reference. The overshoot of the start is relative to OVERSHOOT_FROM_RPM where the
reference is lower: its 5 % are what the torque limit adds within 0.8 ms."""

LIMITS = {
    "speed_error_percent": SPEED_ERROR_MAX_PERCENT,
    "mean_error_percent": SPEED_ERROR_MAX_PERCENT,
    "deviation_rpm": ALLOWANCE_RPM,
    "swing_ratio": SWING_MAX_RATIO,
    "peak_current_A": PEAK_CURRENT_MAX_A,
    "highest_speed_percent": SPEED_MAX_PERCENT,
    "cycle_percent": LIMIT_CYCLE_MAX_PERCENT,
}
"""Limits of the robustness study; a run has those that apply to its load."""


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
    "ripple_reference": Metric("K_t of the reference model", "", 5, 0.0002),
    "ripple_to_allowed": Metric("K_t", "of 0.010 or 1.2 times that", 3, 0.02),
    "ripple_step": Metric("K_t from 20 ms after a load step", "", 5, 0.0002),
    "speed_error_percent": Metric("speed error", "%", 3, 0.01),
    "settling_time_s": Metric("settling time to 0.5 %", "s", 5, 0.0001),
    "overshoot_percent": Metric("overshoot", "%", 3, 0.005),
    "speed_dip_rpm": Metric("speed drop", "r/min", 2, 0.02),
    "recovery_time_s": Metric("recovery time to 0.5 %", "ms", 2, 0.1, 1e3),
    "speed_after_rpm": Metric("maximum speed after the step", "r/min", 2, 0.05, reference=150.0),
    "speed_swing_rpm": Metric("peak-to-peak speed", "r/min", 2, 0.02),
    "copper_W": Metric("copper loss before the step", "W", 2, 0.05),
    "torque_mean_Nm": Metric("mean torque", "N m", 3, 0.01),
    "torque_bound_Nm": Metric("bound of the mean torque", "N m", 3, 0.01),
    "motoring_short_percent": Metric("mean torque below its bound", "%", 2, 0.3),
    "braking_short_percent": Metric("braking torque below its bound", "%", 2, 0.3),
    "peak_to_limit": Metric("peak phase current", "of the limit", 3, 0.005),
    "torque_error_percent": Metric("error of the mean torque", "%", 2, 0.1),
    "phase_rms_A": Metric("RMS current of a phase", "A", 2, 0.1),
    "rms_to_best": Metric("RMS current", "of the best pulse's", 3, 0.01),
    "copper_to_least": Metric("sum of squares of the currents", "of the least without ripple", 3, 0.003),
    "torque_fast_Nm": Metric("mean torque at 1.5 times the base speed", "N m", 3, 0.01),
    "torque_error_fast_percent": Metric("error of the mean torque at 1.5 times the base speed", "%", 2, 0.1),
    "torque_error_2s_percent": Metric("error of the mean torque after 2 s", "%", 2, 0.1),
    "torque_error_fast_2s_percent": Metric("error of the mean torque at 1.5 times the base speed after 2 s", "%", 2,
                                           0.1),
    "ripple_to_right": Metric("K_t over 0.1 s", "of the right file's", 2, 0.05),
    "ripple_step_to_right": Metric("K_t from 20 ms after a load step", "of the right file's", 2, 0.05),
    "dip_to_right": Metric("speed drop", "of the right file's", 2, 0.02),
    "recovery_to_right": Metric("recovery time", "of the right file's", 2, 0.05),
    "settling_to_right": Metric("settling time", "of the right file's", 3, 0.005),
    "torque_to_right": Metric("mean torque", "of the right file's", 3, 0.002),
    "torque_fast_to_right": Metric("mean torque at 1.5 times the base speed", "of the right file's", 3, 0.002),
    "dip_ratio": Metric("speed drop by load", "of that at half base speed", 2, 0.05),
    "torque_step_percent": Metric("largest torque step between strokes", "% of load", 2, 0.3),
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
    "against_periods": Metric("longest torque against the load", "control periods", 1, 0.5),
    "course_counts": Metric("deviation from the ideal course", "counts", 2, 0.05),
    "ripple_3s": Metric("K_t after 3 s", "", 5, 0.0002),
    "ripple_6s": Metric("K_t after 6 s", "", 5, 0.0002),
    "ripple_3s_ratio": Metric("K_t after 3 s relative to the aligned drive", "", 2, 0.05),
    "ripple_6s_ratio": Metric("K_t after 6 s relative to the aligned drive", "", 2, 0.05),
    "recovery_ratio": Metric("recovery time relative to the nominal inertia", "", 2, 0.05),
    "swing_percent": Metric("swing after the drop", "% of reference", 2, 0.05),
    "mean_error_rpm": Metric("error of the mean speed", "r/min", 4, 0.001),
    "mean_error_percent": Metric("error of the mean speed", "%", 3, 0.01),
    "deviation_rpm": Metric("deviation under a constant load beyond 0.5 %", "r/min", 2, 0.02),
    "swing_ratio": Metric("swing under a sine relative to the free shaft", "", 3, 0.01),
    "swing_of_free": Metric("peak-to-peak speed relative to the free shaft", "", 3, 0.01),
    "drift_deg": Metric("movement of the shaft", "deg", 4, 0.001),
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


def counts_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """The largest ripple of count_cases.windows_s, and the drop of the speed before them."""
    dip_rpm = metrics.speed_after_step(recording, scenario.speed[-1].value_rpm, scenario.load[0].at_s)["speed_dip_rpm"]
    return {"ripple_step": max(_ripple(recording, window) for window in count_cases.windows_s(scenario)),
            "speed_dip_rpm": dip_rpm}


def moving_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Peak-to-peak speed over the whole recording, which is the steady state under a periodic load; under a sine also
    relative to the swing of a shaft that only the sine moves."""
    swing_rpm = float(np.ptp(recording["speed_rpm"]))
    free_rpm = _free_swing_rpm(scenario)
    return {"speed_swing_rpm": swing_rpm, **({"swing_of_free": swing_rpm / free_rpm} if free_rpm else {})}


def step_and_ripple_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A load step, and ripple and mean torque over the window."""
    torque = metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], window_s)
    step = load_step_metrics(scenario, recording, window_s)
    return {**step, "ripple": torque["torque_ripple"], "torque_mean_Nm": torque["torque_mean_Nm"]}


def encoder_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A load step: the speed drop, and the longest time with a torque against the load of more than a tenth of it, in
    control periods."""
    step = scenario.load[0]
    drop = metrics.speed_after_step(recording, scenario.speed[-1].value_rpm, step.at_s)["speed_dip_rpm"]
    return {"against_periods": _against_periods(scenario, recording), "speed_dip_rpm": drop}


def _against_periods(scenario: Scenario, recording: np.ndarray) -> float:
    against = np.asarray(recording["torque_Nm"]) < -0.1 * scenario.load[0].torque_Nm
    edges = np.flatnonzero(np.diff(np.concatenate(([0], against.astype(np.int8), [0]))))
    longest = int(np.max(edges[1::2] - edges[::2], initial=0))
    return longest * metrics.sample_step_s(recording["time_s"]) * scenario.control_rate_hz


def encoder_course_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Steady running with a coarse encoder: error of the mean speed, by the line of least squares through the angle;
    the range of the angle's deviation from its ideal course, in counts; torque against the load as encoder_metrics."""
    reference_rpm = scenario.speed[-1].value_rpm
    time_s = np.asarray(recording["time_s"], dtype=float) - float(recording["time_s"][0])
    deviation_deg = _travel_deg(recording) - 6.0 * reference_rpm * time_s
    slope_deg_s = float(np.polyfit(time_s, deviation_deg, 1)[0])
    return {"mean_error_percent": abs(100.0 * slope_deg_s / (6.0 * reference_rpm)),
            "course_counts": float(np.ptp(deviation_deg)) * 2**scenario.encoder_bits / 360.0,
            "against_periods": _against_periods(scenario, recording)}


def ripple_3s_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Ripple over the whole recording."""
    return {"ripple_3s": _ripple(recording, (_recorded_from_s(scenario), scenario.duration_s))}


def ripple_6s_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Ripple over the whole recording."""
    return {"ripple_6s": _ripple(recording, (_recorded_from_s(scenario), scenario.duration_s))}


def inertia_step_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A load step: drop, recovery, and the highest speed above the reference after it or, where that is more, the
    peak-to-peak speed over the last quarter of the recording."""
    reference_rpm, step_s = scenario.speed[-1].value_rpm, scenario.load[0].at_s
    after = metrics.speed_after_step(recording, reference_rpm, step_s)
    speed_rpm = np.asarray(recording["speed_rpm"], dtype=float)
    swing_rpm = max(float(np.max(speed_rpm)) - reference_rpm, float(np.ptp(speed_rpm[-(len(speed_rpm) // 4):])))
    return {"speed_dip_rpm": after["speed_dip_rpm"], "recovery_time_s": after["recovery_time_s"],
            "swing_percent": 100.0 * swing_rpm / reference_rpm}


def mean_error_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Absolute error of the mean speed over the whole recording."""
    return {"mean_error_rpm": abs(_mean_speed_rpm(recording) - scenario.speed[-1].value_rpm)}


def hold_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """Range of the rotor angle over the whole recording."""
    return {"drift_deg": float(np.ptp(_travel_deg(recording)))}


def random_load_metrics(scenario: Scenario, recording: np.ndarray, window_s: Window = PAPER_WINDOW_S) -> Metrics:
    """A start and a load of any kind, judged SETTLING_S after the load has its value; a sine acts from the start on.

    The whole run is recorded.
    """
    reference_rpm, load = scenario.speed[-1].value_rpm, scenario.load[0]
    ramp_Nm_s = scenario.bench.get("load_ramp_Nm_s", 0.0)
    from_s = load.at_s + (load.torque_Nm / ramp_Nm_s if ramp_Nm_s else 0.0) + SETTLING_S
    steady = recording[int(np.searchsorted(recording["time_s"], from_s)):]
    before = recording[:int(np.searchsorted(recording["time_s"], load.at_s))]
    speed_rpm = np.asarray(steady["speed_rpm"], dtype=float)
    swing_Nm = scenario.bench.get("load_sine_amplitude_Nm", 0.0)
    currents = [recording[name] for name in recording.dtype.names or () if name.startswith("current_")]
    values: Metrics = {
        "peak_current_A": max(float(np.max(current)) for current in currents),
    }
    if swing_Nm:
        values["swing_ratio"] = max(0.0, float(np.ptp(speed_rpm)) - ALLOWANCE_RPM) / _free_swing_rpm(scenario)
        values["mean_error_percent"] = 100.0 * max(
            0.0, abs(float(np.mean(speed_rpm)) - reference_rpm) - ALLOWANCE_RPM) / reference_rpm
    else:
        values["settling_time_s"] = metrics.time_to_stay_in_band_s(
            before["time_s"], before["speed_rpm"], reference_rpm, scenario.speed[-1].at_s,
            metrics.BAND + ALLOWANCE_RPM / reference_rpm)
        over_rpm = float(np.max(before["speed_rpm"])) - reference_rpm
        values["highest_speed_percent"] = 100.0 * (1.0 + over_rpm / max(reference_rpm, OVERSHOOT_FROM_RPM))
        deviation_rpm = float(np.max(np.abs(speed_rpm - reference_rpm)))
        values["deviation_rpm"] = max(0.0, deviation_rpm - metrics.BAND * reference_rpm)
        values["mean_error_percent"] = 100.0 * abs(float(np.mean(speed_rpm)) - reference_rpm) / reference_rpm
    return values


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


def _of_run(extract: Callable[[Scenario, np.ndarray], Metrics]) -> Extractor:
    """An extractor that looks at the whole recording, whatever the window."""
    return lambda scenario, recording, _=PAPER_WINDOW_S: extract(scenario, recording)


EXTRACTORS: dict[str, Extractor] = {
    "ripple": ripple_metrics,
    "start": start_metrics,
    "load_step": load_step_metrics,
    "counts": counts_metrics,
    "moving": moving_metrics,
    "held": _of_run(speed_range.held_metrics),
    "held_part": _of_run(speed_range.held_part_metrics),
    "held_copper": _of_run(speed_range.held_copper_metrics),
    "fast_step": _of_run(speed_range.fast_step_metrics),
    "speed_ramps": _of_run(speed_range.speed_ramps_metrics),
    "mismatch_step": _of_run(mismatch.step_metrics),
    "mismatch_held": _of_run(mismatch.held_metrics),
    "mismatch_fast": _of_run(mismatch.fast_metrics),
    "step_and_ripple": step_and_ripple_metrics,
    "encoder": encoder_metrics,
    "encoder_course": encoder_course_metrics,
    "ripple_3s": ripple_3s_metrics,
    "ripple_6s": ripple_6s_metrics,
    "inertia_step": inertia_step_metrics,
    "mean_error": mean_error_metrics,
    "hold": hold_metrics,
    "robustness": robustness_metrics,
    "every_machine": _of_run(every_machine.extract),
    "random_load": random_load_metrics,
}


def peak_current_max_A(machine: Machine) -> float:
    """PEAK_CURRENT_MAX_A for a machine, in proportion to its peak current."""
    return PEAK_CURRENT_MAX_A * derive(machine).current_peak_A / 52.0


def failures(values: Metrics, peak_A: float = PEAK_CURRENT_MAX_A) -> list[str]:
    """Limits that a drive of the robustness study violated, as text; empty when it passes."""
    wrong = []
    if values.get("settling_time_s", 0.0) is None:
        wrong.append("not at speed before the load step")
    for name, limit in {**LIMITS, "peak_current_A": peak_A}.items():
        value = values.get(name)
        if value is not None and value > limit:
            metric = METRICS[name]
            wrong.append(f"{metric.label} {value:.{metric.decimals}f} {metric.unit}".rstrip())
    return wrong


def _free_swing_rpm(scenario: Scenario) -> float:
    """Peak-to-peak speed of a shaft that only the load's sine moves, 0 without one."""
    swing_Nm = scenario.bench.get("load_sine_amplitude_Nm", 0.0)
    if not swing_Nm:
        return 0.0
    inertia_kg_m2 = load_machine(machine_path(scenario.machine)).inertia_kg_m2 * scenario.bench.get("inertia_gain", 1.0)
    angular_frequency = 2.0 * math.pi * scenario.bench["load_sine_frequency_Hz"]
    return 2.0 * swing_Nm / (inertia_kg_m2 * angular_frequency) * 30.0 / math.pi


def _ripple(recording: np.ndarray, window_s: tuple[float, float]) -> float:
    return metrics.torque_metrics(recording["time_s"], recording["torque_Nm"], window_s)["torque_ripple"]


def _peak_current_A(recording: np.ndarray) -> float:
    currents = [recording[name] for name in recording.dtype.names or () if name.startswith("current_")]
    return max(float(np.max(np.abs(current))) for current in currents)


def _travel_deg(recording: np.ndarray) -> np.ndarray:
    """Rotor angle from the first sample on, without jumps at 360 degrees."""
    travel_deg: np.ndarray = np.unwrap(np.asarray(recording["rotor_angle_deg"], dtype=float), period=360.0)
    return travel_deg


def _mean_speed_rpm(recording: np.ndarray) -> float:
    travel_deg = _travel_deg(recording)
    return float((travel_deg[-1] - travel_deg[0]) / (recording["time_s"][-1] - recording["time_s"][0]) / 6.0)


def _until(recording: np.ndarray, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    end = int(np.searchsorted(recording["time_s"], end_s))
    return recording["time_s"][:end], recording["speed_rpm"][:end]
