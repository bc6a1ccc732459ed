"""Torque ripple of the controller paper between the points of its experiments, and its hand-over under load steps."""

import numpy as np
import pytest


def ripple(recording, from_s: float) -> float:
    """K_t of a recording of every microsecond."""
    torque_Nm = recording["torque_Nm"][recording["time_s"] > from_s]
    return float((torque_Nm.max() - torque_Nm.min()) / torque_Nm.mean())


# Measured (paper before the hand-over by duty: .058, .062, .145, .120 at 150 r/min and 40 kHz).
RIPPLE = [
    ("saturating", 40_000, 150, 0.008, 0.0197), ("saturating", 40_000, 50, 0.005, 0.022),
    ("saturating", 40_000, 600, 0.02, 0.06), ("saturating", 20_000, 150, 0.02, 0.05),
    ("saturating", 100_000, 150, 0.003, 0.012), ("linear_cosine", 40_000, 150, 0.006, 0.02),
    ("linear_cosine", 20_000, 150, 0.015, 0.05), ("linear_trapezoid", 40_000, 150, 0.03, 0.08),
    ("finite_element", 40_000, 150, 0.035, 0.09), ("finite_element", 20_000, 150, 0.02, 0.09),
    ("finite_element", 40_000, 600, 0.05, 0.13),
]  # fmt: skip


@pytest.mark.parametrize(("machine", "rate_hz", "speed_rpm", "least", "most"), RIPPLE)
def test_ripple_under_load(make_bench, tmp_path, machine, rate_hz, speed_rpm, least, most):
    record = tmp_path / "torque.npy"
    bench = make_bench(controller="paper", machine=machine, control_rate_hz=rate_hz, record=record, record_step_ns=1000,
                       record_from_us=300_000)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.at(0.13).load_torque_Nm = 8
    bench.run_for(0.4)
    assert bench.drive.state == "run"
    bench.close()
    assert least < ripple(np.load(record), 0.3) < most


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["saturating", "linear_trapezoid", "finite_element"])
def test_a_load_step_at_any_angle_of_the_hand_over_stays_below_the_trip(make_bench, machine):
    """The outgoing phase keeps its duty: none that raises its current."""
    for angle in range(12):
        bench = make_bench(controller="paper", machine=machine, initial_angle_deg=2.5 * angle)
        bench.rig.truth_period_us = 20
        bench.drive.speed_reference_rpm = 150
        bench.at(0.15).load_torque_Nm = 12
        bench.run_for(0.25)
        assert bench.drive.state == "run", bench.drive.fault
        currents_A = [np.max(bench.truth[f"current_{phase}_A"].value) for phase in "abc"]
        assert 30 < max(currents_A) < 0.97 * 75
        assert bench.truth["speed_rpm"].last == pytest.approx(150, abs=1)
        bench.close()
