"""Metrics on synthetic recordings with known results."""

import numpy as np
import pytest

from salient.experiments import metrics

STEP_S = 1e-6


def recording(speed_rpm, torque_Nm=8.0, step_s=STEP_S, from_s=0.0):
    """A recording of the given speeds; a scalar torque is constant."""
    speed_rpm = np.asarray(speed_rpm, dtype=float)
    rows = np.zeros(len(speed_rpm), dtype=[("time_s", "f8"), ("speed_rpm", "f8"), ("torque_Nm", "f8")])
    rows["time_s"] = from_s + np.arange(len(speed_rpm)) * step_s
    rows["speed_rpm"] = speed_rpm
    rows["torque_Nm"] = torque_Nm
    return rows


def step_run(torque_Nm=8.0, seconds=0.5, step_s=STEP_S, from_s=0.0):
    """150 r/min held exactly for `seconds`."""
    return recording(np.full(round(seconds / step_s) + 1, 150.0), torque_Nm, step_s, from_s)


# --- settling -------------------------------------------------------------------------------------------------------

def test_first_order_start_settles_where_the_exponential_enters_the_band():
    time_s = np.arange(200_001) * STEP_S
    result = metrics.start_metrics(recording(600.0 * (1.0 - np.exp(-time_s / 0.02))), 600.0)
    assert result["settling_time_s"] == pytest.approx(0.02 * np.log(200.0), abs=STEP_S)
    assert result["overshoot_percent"] == 0.0
    assert result["max_speed_rpm"] == pytest.approx(600.0 * (1.0 - np.exp(-10.0)))


def test_second_order_start_has_the_textbook_overshoot_and_settles_at_its_last_exit():
    damping, natural_rad_s = 0.5, 200.0
    time_s = np.arange(300_001) * STEP_S
    root = np.sqrt(1.0 - damping**2)
    phase = natural_rad_s * root * time_s
    decay = np.exp(-damping * natural_rad_s * time_s)
    error = decay * (np.cos(phase) + damping / root * np.sin(phase))
    result = metrics.start_metrics(recording(600.0 * (1.0 - error)), 600.0)
    assert result["overshoot_percent"] == pytest.approx(100.0 * np.exp(-np.pi * damping / root), rel=1e-6)
    last_outside_s = time_s[np.abs(error) > 0.005][-1]
    assert result["settling_time_s"] == pytest.approx(last_outside_s + STEP_S)


def test_settling_counts_from_the_command():
    speed_rpm = np.where(np.arange(1000) < 400, 0.0, 600.0)
    result = metrics.start_metrics(recording(speed_rpm), 600.0, command_time_s=100e-6)
    assert result["settling_time_s"] == pytest.approx(300e-6)


def test_settling_time_of_a_drive_that_never_settles_is_none():
    assert metrics.start_metrics(recording(np.full(1000, 590.0)), 600.0)["settling_time_s"] is None


def test_slow_limit_cycle_beyond_the_band_never_settles():
    speed_rpm = 600.0 + 4.0 * np.where(np.arange(1000) % 100 < 50, 1.0, -1.0)
    assert metrics.start_metrics(recording(speed_rpm), 600.0)["settling_time_s"] is None


def test_leaving_the_band_at_the_last_sample_is_not_settled():
    speed_rpm = np.full(1000, 600.0)
    speed_rpm[-1] = 603.1
    assert metrics.start_metrics(recording(speed_rpm), 600.0)["settling_time_s"] is None


def test_single_sample_outside_the_band_counts_as_an_exit():
    speed_rpm = np.full(1000, 600.0)
    speed_rpm[0] = 0.0
    speed_rpm[700] = 596.9
    assert metrics.start_metrics(recording(speed_rpm), 600.0)["settling_time_s"] == pytest.approx(701e-6)


def test_entering_the_band_at_the_last_sample_is_settled_there():
    speed_rpm = np.full(1000, 500.0)
    speed_rpm[-1] = 600.0
    assert metrics.start_metrics(recording(speed_rpm), 600.0)["settling_time_s"] == pytest.approx(999e-6)


@pytest.mark.parametrize("edge_rpm", [597.0, 603.0])
def test_edges_belong_to_the_band(edge_rpm):
    assert metrics.start_metrics(recording(np.full(1000, edge_rpm)), 600.0)["settling_time_s"] == 0.0


def test_speed_never_outside_the_band_is_settled_from_the_start():
    assert metrics.start_metrics(recording(np.full(10, 600.0)), 600.0)["settling_time_s"] == 0.0


def test_single_sample_of_overshoot_is_the_maximum():
    speed_rpm = np.full(1000, 600.0)
    speed_rpm[10] = 618.0
    result = metrics.start_metrics(recording(speed_rpm), 600.0)
    assert result["max_speed_rpm"] == 618.0
    assert result["overshoot_percent"] == pytest.approx(3.0)


# --- load step ------------------------------------------------------------------------------------------------------

def test_dip_and_recovery_of_a_triangular_dip():
    run = step_run()
    time_s = run["time_s"]
    # Speed falls by 5 r/min within 10 ms of the step at 0.13 s and returns to 150 r/min within another 20 ms.
    run["speed_rpm"] = np.interp(time_s, [0.0, 0.13, 0.14, 0.16, 0.5], [150.0, 150.0, 145.0, 150.0, 150.0])
    result = metrics.load_step_metrics(run, 150.0, 0.13)
    assert result["speed_dip_rpm"] == pytest.approx(5.0)
    assert result["recovery_time_s"] == pytest.approx(0.010 + 0.020 * (5.0 - 0.75) / 5.0, abs=2 * STEP_S)
    assert result["max_speed_rpm"] == 150.0


def test_samples_before_the_step_count_for_the_maximum_but_not_for_dip_and_recovery():
    run = step_run()
    run["speed_rpm"][run["time_s"] < 0.05] = 0.0
    run["speed_rpm"][60_000] = 158.0
    result = metrics.load_step_metrics(run, 150.0, 0.13)
    assert result["speed_dip_rpm"] == 0.0
    assert result["recovery_time_s"] == 0.0
    assert result["max_speed_rpm"] == 158.0


def test_dip_of_a_speed_that_stays_above_is_not_negative():
    run = step_run()
    run["speed_rpm"] += 0.5
    assert metrics.load_step_metrics(run, 150.0, 0.13)["speed_dip_rpm"] == 0.0


def test_recovery_time_of_a_drive_that_never_recovers_is_none():
    run = step_run()
    run["speed_rpm"][run["time_s"] > 0.13] = 149.0
    result = metrics.load_step_metrics(run, 150.0, 0.13)
    assert result["recovery_time_s"] is None
    assert result["speed_dip_rpm"] == pytest.approx(1.0)


# --- torque ripple --------------------------------------------------------------------------------------------------

def test_ripple_of_a_sine():
    run = step_run()
    run["torque_Nm"] = 8.314 + 0.2 * np.sin(2 * np.pi * 100.0 * run["time_s"])
    result = metrics.load_step_metrics(run, 150.0, 0.13)
    assert result["torque_max_Nm"] == pytest.approx(8.514, abs=1e-6)
    assert result["torque_min_Nm"] == pytest.approx(8.114, abs=1e-6)
    assert result["torque_mean_Nm"] == pytest.approx(8.314, abs=1e-5)
    assert result["torque_ripple"] == pytest.approx(0.4 / 8.314, rel=1e-5)


@pytest.mark.parametrize("sample", [300_000, 350_001, 400_000])
def test_single_sample_determines_the_ripple_at_either_end_of_the_window_too(sample):
    run = step_run()
    run["torque_Nm"][sample] = 9.0
    result = metrics.load_step_metrics(run, 150.0, 0.13)
    assert result["torque_max_Nm"] == 9.0
    assert result["torque_ripple"] == pytest.approx(1.0 / 8.0, rel=1e-4)


@pytest.mark.parametrize("sample", [299_999, 400_001])
def test_samples_outside_the_window_do_not_count(sample):
    run = step_run()
    run["torque_Nm"][sample] = 9.0
    assert metrics.load_step_metrics(run, 150.0, 0.13)["torque_ripple"] == 0.0


def test_recording_may_start_late_but_before_the_window():
    run = step_run(seconds=0.4, from_s=0.1)
    assert metrics.load_step_metrics(run, 150.0, 0.13)["torque_mean_Nm"] == pytest.approx(8.0)


def test_samples_may_be_finer():
    run = step_run(seconds=0.21, step_s=0.5e-6, from_s=0.2)
    assert metrics.torque_metrics(run["time_s"], run["torque_Nm"], (0.3, 0.4))["torque_ripple"] == 0.0


@pytest.mark.parametrize(("run", "message"), [
    (step_run(step_s=2e-6), "has 2 us"),
    (step_run(seconds=0.35), "spans 0 s to 0.35 s"),
    (step_run(seconds=0.1, from_s=0.35), "spans 0.35 s"),
    (step_run(torque_Nm=0.0), "positive mean torque"),
    (step_run(torque_Nm=np.nan), "torque_Nm has a value that is not finite"),
    (step_run(seconds=0.0), "at least 2 samples"),
    (step_run()[["time_s", "speed_rpm"]], "no field torque_Nm"),
    (step_run(seconds=0.1), "ends at 0.1 s, before 0.13 s"),
])
def test_recording_that_does_not_cover_the_metrics_is_rejected(run, message):
    with pytest.raises(metrics.MetricsError, match=message):
        metrics.load_step_metrics(run, 150.0, 0.13)


def test_gap_in_time_is_rejected():
    run = step_run()
    run["time_s"][200_000:] += 0.001
    with pytest.raises(metrics.MetricsError, match="equal steps"):
        metrics.load_step_metrics(run, 150.0, 0.13)
