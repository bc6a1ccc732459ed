"""Load steps with encoders whose counts come slowly."""

from __future__ import annotations

import numpy as np
import pytest

from salient.experiments.compare.metrics import EXTRACTORS
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep, run_scenario

STEP_S = 0.4


@pytest.mark.parametrize(("machine", "bits", "edges", "speed_rpm", "angle_deg", "dip_rpm"), [
    ("saturating", 8, False, 10.0, 9.75, (10.0, 60.0)),
    ("saturating", 8, True, 30.0, 2.0, (10.0, 60.0)),
    ("saturating", 10, False, 5.0, 17.0, (5.0, 30.0)),
    ("finite_element", 10, False, 20.0, 4.0, (20.0, 80.0)),
    ("finite_element", 12, True, 5.0, 8.5, (10.0, 50.0)),
])  # fmt: skip
def test_a_load_step_between_slow_counts_is_not_answered_by_torque_against_it(tmp_path, machine, bits, edges, speed_rpm,
                                                                              angle_deg, dip_rpm):
    scenario = Scenario(name="", machine=machine, controller="salient", duration_s=STEP_S + 0.2, encoder_bits=bits,
                        encoder_edges=edges, initial_angle_deg=angle_deg, speed=(SpeedStep(0.0, speed_rpm),),
                        load=(LoadStep(STEP_S, 8.0),), record=Record(5.0, STEP_S - 0.05))
    result = run_scenario(scenario, tmp_path)
    assert result.fault == "none"
    recording = result.recording
    before = recording["torque_Nm"][recording["time_s"] < STEP_S]
    assert np.max(np.abs(before)) < 0.5, "no swing without load"
    after = recording[recording["time_s"] >= STEP_S]
    values = EXTRACTORS["encoder"](scenario, after)
    assert values["against_periods"] <= 2.0
    assert dip_rpm[0] < values["speed_dip_rpm"] < dip_rpm[1]
    assert np.mean(after["torque_Nm"][-10000:]) == pytest.approx(8.0, abs=0.2)
