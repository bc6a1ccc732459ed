"""Metrics of the comparison on synthetic recordings with known results."""

import numpy as np
import pytest

from salient.experiments import metrics
from salient.experiments.compare.metrics import moving_metrics
from salient.experiments.scenario import Scenario
from salient.machine.file import load_machine, machine_path

STEP_S = 2e-6
STROKE_DEG = 30.0


def steady(lines=(), seconds=1.0, speed_rpm=150.0, mean_Nm=8.0, step_s=STEP_S):
    """Torque with spectral lines (frequency in Hz, amplitude in N m) at constant speed."""
    rows = np.zeros(round(seconds / step_s) + 1,
                    dtype=[("time_s", "f8"), ("speed_rpm", "f4"), ("torque_Nm", "f4")])
    rows["time_s"] = 0.3 + np.arange(len(rows)) * step_s
    rows["speed_rpm"] = speed_rpm
    rows["torque_Nm"] = mean_Nm + sum(amplitude_Nm * np.sin(2 * np.pi * frequency_Hz * rows["time_s"])
                                      for frequency_Hz, amplitude_Nm in lines)
    return rows


def line_percent(recording):
    return metrics.strongest_line_percent(recording, (0.3, float(recording["time_s"][-1])), STROKE_DEG)


@pytest.mark.parametrize("frequency_Hz", [45.0, 317.0, 1033.0])
def test_limit_cycle_is_found_with_its_amplitude(frequency_Hz):
    assert line_percent(steady([(frequency_Hz, 0.4)])) == pytest.approx(5.0, rel=0.05)


def test_strokes_and_their_harmonics_are_not_a_limit_cycle():
    # 150 r/min are 30 strokes a second.
    assert line_percent(steady([(30.0, 2.0), (60.0, 1.0), (300.0, 1.0)])) < 0.02


def test_switching_is_not_a_limit_cycle():
    assert line_percent(steady([(20_000.0, 2.0), (40_000.0, 2.0)])) < 0.02


def test_short_window_has_no_spectrum_between_the_strokes():
    with pytest.raises(metrics.MetricsError, match="needs 12 of them, the window has 6.0"):
        line_percent(steady(seconds=0.2))


def test_coarse_samples_have_no_spectrum():
    with pytest.raises(metrics.MetricsError, match="10 us apart or closer, the recording has 50 us"):
        line_percent(steady(step_s=50e-6))


def test_braking_drive_has_no_spectrum_in_percent():
    with pytest.raises(metrics.MetricsError, match="positive mean torque"):
        line_percent(steady(mean_Nm=-1.0))


def test_speed_error_is_the_larger_of_both_signs_within_its_window():
    rows = steady(seconds=0.1)
    rows["speed_rpm"][0] = 0.0
    rows["speed_rpm"][1000] = 148.5
    rows["speed_rpm"][2000] = 150.75
    end_s = float(rows["time_s"][-1])
    assert metrics.speed_error_percent(rows, 150.0, (0.301, end_s)) == pytest.approx(1.0)
    assert metrics.speed_error_percent(rows, 150.0, (0.303, end_s)) == pytest.approx(0.5)


def test_samples_before_the_load_step_do_not_count():
    rows = steady(seconds=0.1)
    rows["speed_rpm"][:1000] = 170.0
    rows["speed_rpm"][6000:7000] = 147.0
    rows["speed_rpm"][8000] = 150.5
    result = metrics.speed_after_step(rows, 150.0, 0.31)
    assert result["speed_dip_rpm"] == pytest.approx(3.0)
    assert result["recovery_time_s"] == pytest.approx(0.004, abs=1e-9)
    assert result["speed_after_rpm"] == pytest.approx(150.5)


def test_speed_under_a_periodic_load_is_judged_by_its_range():
    rows = steady(seconds=0.1)
    rows["speed_rpm"][[1000, 2000]] = 149.0, 150.5
    assert moving_metrics(Scenario(name="moving", duration_s=0.4), rows) == {"speed_swing_rpm": 1.5}


@pytest.mark.parametrize(("machine", "expected_deg"), [("saturating", 30.0), ("finite_element", 15.0)])
def test_stroke_is_a_revolution_divided_by_rotor_poles_and_phases(machine, expected_deg):
    assert metrics.stroke_deg(load_machine(machine_path(machine))) == expected_deg
