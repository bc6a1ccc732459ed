"""Load steps, mean speed and standstill with encoders whose counts come slowly."""

from __future__ import annotations

import numpy as np
import pytest

from salient.bench.drive import DriveError
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


def _settled(tmp_path, load_Nm: float = 8.0, **fields):
    """Metrics of a run that a load step has disturbed long before."""
    speed_rpm, bits = fields.pop("speed_rpm"), fields["encoder_bits"]
    counts_s = 40.0 * 60.0 / speed_rpm / 2**bits
    settled_s = round(STEP_S + max(2.0, counts_s), 3)
    end_s = round(settled_s + max(2.0, counts_s), 3)
    scenario = Scenario(name="", duration_s=end_s, speed=(SpeedStep(0.0, speed_rpm),),
                        load=(LoadStep(STEP_S, load_Nm),), record=Record(25.0, settled_s), **fields)
    result = run_scenario(scenario, tmp_path)
    assert result.fault == "none"
    return EXTRACTORS["encoder_course"](scenario, result.recording)


@pytest.mark.in_turns
@pytest.mark.parametrize(("machine", "controller", "bits", "edges", "speed_rpm", "load_Nm"), [
    ("saturating", "salient", 9, False, 1.0, 8.0),
    ("saturating", "salient", 12, False, 0.5, 8.0),
    ("saturating", "salient", 9, True, 3.0, -8.0),
    ("saturating", "salient", 10, False, 5.0, 0.0),
    ("finite_element", "salient", 9, False, 10.0, 8.0),
    ("finite_element", "salient", 10, False, 5.0, 16.0),
    ("saturating", "paper", 9, False, 10.0, 8.0),
    ("finite_element", "paper", 10, False, 10.0, 8.0),
    ("saturating", "traditional", 9, False, 10.0, 8.0),
    ("finite_element", "traditional", 10, False, 10.0, 8.0),
])  # fmt: skip
def test_the_mean_speed_is_that_of_the_counts(tmp_path, machine, controller, bits, edges, speed_rpm, load_Nm):
    values = _settled(tmp_path, load_Nm, machine=machine, controller=controller, encoder_bits=bits, encoder_edges=edges,
                      speed_rpm=speed_rpm)
    assert values["mean_error_percent"] < 0.1
    assert 0.001 < values["course_counts"] < 2.0
    if load_Nm > 0.0:
        assert values["against_periods"] == 0.0


@pytest.mark.parametrize(("machine", "controller", "bits"), [
    ("saturating", "salient", 9),
    ("finite_element", "salient", 12),
    ("saturating", "traditional", 10),
])  # fmt: skip
def test_a_rotor_is_held_within_two_counts(tmp_path, machine, controller, bits):
    scenario = Scenario(name="", machine=machine, controller=controller, duration_s=2.5, encoder_bits=bits,
                        speed=(SpeedStep(0.0, 0.0),), load=(LoadStep(STEP_S, 8.0),), record=Record(25.0, 1.0))
    result = run_scenario(scenario, tmp_path)
    assert result.fault == "none"
    angle_deg = np.degrees(np.unwrap(np.radians(result.recording["rotor_angle_deg"].astype(float))))
    assert 0.01 < np.ptp(angle_deg) * 2**bits / 360.0 < 2.5
    assert np.mean(result.recording["torque_Nm"]) == pytest.approx(8.0, abs=0.1)


def test_a_speed_at_which_the_drive_would_swing_is_refused_by_its_lowest_speed(make_bench):
    for controller, lowest in (("salient", "4.58"), ("traditional", "13.72")):
        bench = make_bench(machine="finite_element", controller=controller, encoder_bits=9)
        with pytest.raises(DriveError, match=f"encoder allows 0, or from {lowest} r/min on"):
            bench.drive.speed_reference_rpm = -2.0
        bench.drive.speed_reference_rpm = 0.0
        bench.drive.speed_reference_rpm = float(lowest)
    fine = make_bench(machine="finite_element", controller="traditional", encoder_bits=13)
    fine.drive.speed_reference_rpm = 0.1
