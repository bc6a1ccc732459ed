"""Single pulse operation above base speed: reported switching mode, passage in both directions, current limit."""

from pathlib import Path

import numpy as np
import pytest

from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.machine.path import machine_path

MACHINE = "linear_cosine"
"""Its largest torque without lead is 15 N m at 2250 r/min, 1.5 times the base speed; with single pulses 25 N m."""


def held(make_bench, speed_rpm, **options):
    """A bench whose shaft has the held speed."""
    bench = make_bench(machine=MACHINE, controller="salient", **options)
    bench.drive.parameters["torque_max_Nm"] = 60
    bench.held_speed_rpm = speed_rpm
    bench.run_for(abs(speed_rpm) / 10_000 + 0.01)
    return bench


def modes(bench, duration_s=0.05):
    """The switching modes in the last part of the run."""
    signal = bench.telemetry["DRIVE_STATUS.single_pulse"]
    return set(signal.between(bench.time_s - duration_s, bench.time_s).value)


def mean_torque_Nm(bench, duration_s=0.15):
    """Mean of samples in every millisecond: samples of pulses are not spread evenly over them."""
    return bench.truth["torque_Nm"].between(bench.time_s - duration_s, bench.time_s).value.mean()


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_torque_that_sharing_cannot_make_is_made_with_single_pulses_and_back(make_bench, direction, sign):
    bench = held(make_bench, direction * 900)
    for speed_rpm, torque_Nm, mode in ((900, 10, 0), (2250, 22, 1), (900, 10, 0)):
        bench.held_speed_rpm = direction * speed_rpm
        bench.drive.torque_reference_Nm = direction * sign * torque_Nm
        bench.run_for(0.6)
        assert modes(bench) == {mode}
        assert mean_torque_Nm(bench) == pytest.approx(direction * sign * torque_Nm, rel=0.01)
    assert bench.drive.fault == "none"


@pytest.mark.parametrize("direction", [1, -1])
def test_a_loaded_drive_passes_into_single_pulses_with_the_speed_and_back(make_bench, direction):
    bench = make_bench(machine=MACHINE, controller="salient")
    bench.drive.speed_reference_rpm = direction * 1000
    bench.run_for(0.2)
    bench.load_torque_Nm = direction * 11
    bench.run_for(0.1)
    for speed_rpm, mode in ((1000, 0), (2600, 1), (1000, 0)):
        bench.drive.speed_reference_rpm = direction * speed_rpm
        bench.run_for(1.5)
        assert modes(bench) == {mode}
        assert bench.truth["speed_rpm"].last == pytest.approx(direction * speed_rpm, abs=1.0 if mode else 0.1)
    assert bench.drive.fault == "none"


@pytest.mark.parametrize(("sign", "speed_rpm"), [(1, 2250), (-1, 1500)])
def test_current_stays_within_three_percent_of_its_limit_at_20_kHz(make_bench, tmp_path: Path, sign, speed_rpm):
    """It rises by a third of the limit in a control period, near the unaligned position."""
    bench = held(make_bench, speed_rpm, control_rate_hz=20_000, record=tmp_path / "recording.npy",
                 record_step_ns=5000, record_from_us=500_000)
    bench.drive.torque_reference_Nm = sign * 60
    bench.run_for(0.6 - bench.time_s)
    bench.close()
    recording = np.load(tmp_path / "recording.npy")
    peak_A = max(float(recording[name].max()) for name in recording.dtype.names if name.startswith("current_"))
    assert 0.97 < peak_A / 52 < 1.03


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["saturating", "finite_element", "linear_cosine", "linear_trapezoid"])
def test_braking_below_base_speed_makes_the_torque_limit_within_a_tenth(make_bench, machine):
    """Over a stroke or more: linear_trapezoid braked with 1.4 times its limit."""
    data = derive(load_machine(machine_path(machine)))
    limit_Nm = data.parameters["torque_max_Nm"]
    bench = make_bench(machine=machine, controller="salient")
    bench.drive.speed_reference_rpm = 0.9 * data.speed_base_rpm
    bench.run_for(0.65)
    begin_s = bench.time_s
    bench.drive.speed_reference_rpm = 0
    bench.run_until(lambda: bench.truth["speed_rpm"].last < 0.3 * data.speed_base_rpm, timeout=0.2)
    torque_Nm = bench.truth["torque_Nm"].between(begin_s + 0.002, bench.time_s).value
    mean_Nm = np.convolve(torque_Nm, np.full(10, 0.1), "valid")
    assert len(mean_Nm) > 3
    assert -1.1 * limit_Nm < mean_Nm.min() and mean_Nm.max() < -0.85 * limit_Nm
