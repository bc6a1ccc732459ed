"""Measures of the ablation's runs."""

from __future__ import annotations

import numpy as np

from salient.experiments import metrics
from salient.experiments.ablation.cases import Case
from salient.experiments.scenario import RunResult

DIP_S = 0.3
BAND = 0.02
BAND_OF_BASE = 0.002
"""A start ends within this part of the reference, and of the base speed."""

MEASURES = {"ripple": 0.005, "dip": 0.001, "swing": 0.0001, "mean error": 0.00002, "start": 0.002}
"""Measures, and the value added to both values of a ratio: changes below that do not matter. The ripple is K_t;
dip, swing and error of the mean speed are parts of the base speed; the start is in seconds."""

Values = dict[str, float]


def values_of(case: Case, result: RunResult) -> Values:
    """Metrics of a run that has ended without a fault; no "start" when the speed has not settled before the load."""
    scenario, base_rpm = case.scenario, case.base_rpm
    reference_rpm, loaded_s = scenario.speed[0].value_rpm, scenario.load[0].at_s
    speed = result.truth["speed_rpm"]
    time_s, speed_rpm = np.asarray(speed.time_s), np.asarray(speed.value, dtype=float)
    before, after = time_s < loaded_s, (time_s >= loaded_s) & (time_s < loaded_s + DIP_S)
    recording = result.recording
    assert recording is not None and scenario.record is not None  # every case is recorded
    steady_rpm = np.asarray(recording["speed_rpm"], dtype=float)
    torque_Nm = np.asarray(recording["torque_Nm"], dtype=float)
    values = {
        "ripple": float(np.ptp(torque_Nm) / scenario.load[-1].torque_Nm),
        "dip": max(0.0, reference_rpm - float(speed_rpm[after].min())) / base_rpm,
        "swing": float(np.ptp(steady_rpm)) / base_rpm,
        "mean error": abs(float(steady_rpm.mean()) - reference_rpm) / base_rpm,
    }
    start_s = metrics.time_to_stay_in_band_s(time_s[before], speed_rpm[before], reference_rpm, 0.0,
                                             BAND + BAND_OF_BASE * base_rpm / reference_rpm)
    return values if start_s is None else {**values, "start": start_s}
