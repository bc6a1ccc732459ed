"""Imperfect sensors in the closed loop, through CAN alone: the effect of each error on the measured values, to the
resolution of the ADC; start and loaded run with each error; errors that the drive cannot detect."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from salient.bench.bench import Bench
from salient.paths import MACHINES

pytestmark = pytest.mark.bench_options(controller="traditional")

# Half an LSB of the ADC, and half an LSB of the true-state frames, A.
RESOLUTION_A = 0.5 * 80 / 4096 + 0.5 / 512

ECCENTRICITY_DEG = 0.5
# An angle error of e sin(theta) is a relative speed error of e cos(theta): deviation of the true speed when the drive
# holds the measured one.
ECCENTRIC_SPEED_RPM = 150 * math.radians(ECCENTRICITY_DEG)

SENSORS = """
[sensors]
current_gain = 1.05
current_offset_A = 0.5
current_noise_A = 0.03
current_limit_A = 60.0
current_delay_ns = 3000
encoder_eccentricity_deg = 0.5
"""


@dataclass(frozen=True)
class Case:
    """Rig variables; speed_error_rpm: tolerance of the true speed in addition to the controller's ripple; parameters of
    the drive."""

    variables: dict[str, float]
    speed_error_rpm: float = 0.0
    parameters: dict[str, float] = field(default_factory=dict)


CASES = {
    "offset": Case({"current_sensor_offset_A": 0.5}),
    "negative_offset": Case({"current_sensor_offset_A": -0.5}),
    "gain": Case({"current_sensor_gain": 1.05}),
    "limit": Case({"current_sensor_limit_A": 40.0}, parameters={"current_limit_A": 35.0}),
    "delay": Case({"current_sensor_delay_us": 3.0}),
    "eccentricity": Case({"encoder_eccentricity_deg": ECCENTRICITY_DEG}, ECCENTRIC_SPEED_RPM),
}
CASES["all"] = Case(
    CASES["offset"].variables
    | CASES["gain"].variables
    | CASES["limit"].variables
    | CASES["delay"].variables
    | CASES["eccentricity"].variables
    | {"current_noise_A": 0.03},
    CASES["eccentricity"].speed_error_rpm,
    CASES["limit"].parameters,
)


def set_up(bench: Bench, case: Case) -> None:
    for name, value in case.variables.items():
        setattr(bench.rig, name, value)
    for name, value in case.parameters.items():
        bench.drive.parameters[name] = value


def start_loaded(bench: Bench) -> None:
    """From standstill to 150 r/min, 8 N m after 0.1 s, and 0.1 s to settle."""
    bench.drive.speed_reference_rpm = 150
    bench.at(bench.time_s + 0.1).load_torque_Nm = 8
    bench.run_for(0.2)


def watch_closely(bench: Bench, duration_s: float, period_us: int = 25) -> float:
    """Runs with true-state frames every control period, at whose beginning the drive samples, or more often, for the
    instants before; returns the start. Whether each instant is covered, at_samples checks."""
    bench.rig.truth_period_us = period_us
    start_s = bench.time_s
    bench.run_for(duration_s)
    bench.rig.truth_period_us = 1000
    return start_s


def at_samples(bench: Bench, start_s: float, measured: str, true: str, delay_us: int = 0) -> tuple[np.ndarray, ...]:
    """A signal as measured by the drive in each telemetry cycle since start_s, and its true value delay_us earlier."""
    sampled_us = bench.telemetry["DRIVE_STATUS.time_us"].value.astype(np.int64)
    values = bench.telemetry[measured].value
    sampled_us = sampled_us[: len(values)]
    chosen = sampled_us >= round(start_s * 1e6) + 10
    truth = bench.truth[true]
    truth_us = np.round(truth.time_s * 1e6).astype(np.int64)
    index = np.searchsorted(truth_us, sampled_us[chosen] - delay_us)
    assert np.array_equal(truth_us[index], sampled_us[chosen] - delay_us)
    return values[chosen], truth.value[index]


def currents_A(bench: Bench, start_s: float, delay_us: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Measured and true currents, phases concatenated."""
    pairs = [at_samples(bench, start_s, f"DRIVE_CURRENTS.current_{phase}_A", f"RIG_TRUTH_CURRENTS.current_{phase}_A",
                        delay_us) for phase in "abc"]
    measured, true = (np.concatenate(columns) for columns in zip(*pairs, strict=True))
    assert len(measured) >= 50
    assert true.max() > 20
    return measured, true


def angle_error_deg(bench: Bench, start_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Measured less true rotor angle, wrapped to half a revolution, and the true angle."""
    measured, true = at_samples(bench, start_s, "DRIVE_MOTION.rotor_angle_deg", "RIG_TRUTH_BENCH.rotor_angle_deg")
    return (measured - true + 180) % 360 - 180, true


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", ["traditional", "paper"])
@pytest.mark.parametrize("name", CASES)
def test_starts_and_holds_speed_under_load(make_bench, controller, name):
    case = CASES[name]
    bench = make_bench(controller=controller)
    set_up(bench, case)
    bench.rig.truth_period_us = 25  # also the currents between switching edges
    start_loaded(bench)
    settled_s = bench.time_s
    bench.run_for(0.4)  # a whole revolution
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    speed_rpm = bench.truth["speed_rpm"].between(settled_s, bench.time_s).value
    bound_rpm = 0.6 + 1.1 * case.speed_error_rpm
    assert 150 - bound_rpm < speed_rpm.min() <= 150 - 0.9 * case.speed_error_rpm
    assert 150 + 0.9 * case.speed_error_rpm <= speed_rpm.max() < 150 + bound_rpm
    greatest_A = max(bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].value.max() for phase in "abc")
    assert 35 < greatest_A < 65


@pytest.mark.bench_options(controller="paper")
@pytest.mark.parametrize(("variable", "value", "wrong"), [
    ("current_sensor_offset_A", 0.5, lambda true_A: true_A + 0.5),
    ("current_sensor_offset_A", -0.5, lambda true_A: np.maximum(true_A - 0.5, 0.0)),
    ("current_sensor_gain", 1.05, lambda true_A: 1.05 * true_A),
    ("current_sensor_limit_A", 30.0, lambda true_A: np.minimum(true_A, 30.0)),
])  # fmt: skip
def test_measured_currents_have_the_injected_error(bench, variable, value, wrong):
    start_loaded(bench)
    with pytest.raises(AttributeError, match=f"{variable} has the value of the machine file until it is set"):
        getattr(bench.rig, variable)
    before_s = watch_closely(bench, 0.03)
    measured_A, true_A = currents_A(bench, before_s)
    assert np.abs(measured_A - true_A).max() <= RESOLUTION_A

    setattr(bench.rig, variable, value)
    start_s = watch_closely(bench, 0.03)
    measured_A, true_A = currents_A(bench, start_s)
    assert np.abs(measured_A - wrong(true_A)).max() <= 1.05 * RESOLUTION_A
    assert np.abs(measured_A - true_A).max() > 0.45


@pytest.mark.in_turns
@pytest.mark.parametrize("delay_us", [1, 3, 8])
def test_measured_currents_lag_by_the_sensor_delay(bench, delay_us):
    """With the traditional controller, which applies 240 V to a phase for whole periods."""
    start_loaded(bench)
    bench.rig.current_sensor_delay_us = delay_us
    start_s = watch_closely(bench, 0.03, period_us=1)
    measured_A, true_A = currents_A(bench, start_s, delay_us)
    assert np.abs(measured_A - true_A).max() <= RESOLUTION_A
    measured_A, present_A = currents_A(bench, start_s)
    fastest_A = 240 / 0.67e-3 * delay_us * 1e-6
    assert 0.1 * delay_us < np.abs(measured_A - present_A).max() <= fastest_A + RESOLUTION_A


@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_eccentric_encoder_errs_once_per_revolution_and_the_speed_follows(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.rig.encoder_eccentricity_deg = ECCENTRICITY_DEG
    start_loaded(bench)
    bench.rig.truth_period_us = 25
    start_s = bench.time_s
    bench.run_for(0.4)  # a whole revolution
    error_deg, true_deg = angle_error_deg(bench, start_s)
    assert true_deg.max() - true_deg.min() > 355
    expected_deg = ECCENTRICITY_DEG * np.sin(np.radians(true_deg))
    # Half a count of the encoder, and an LSB of the telemetry.
    assert np.abs(error_deg - expected_deg).max() < 0.5 * 360 / 2**17 + 360 / 2**16

    # The controller holds the measured speed, omega (1 + e cos theta).
    speed_rpm = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].between(start_s + 1e-5, bench.time_s).value
    angle_rad = np.radians(bench.truth["rotor_angle_deg"].between(start_s + 1e-5, bench.time_s).value)
    cosine_rpm = 2 * np.mean((speed_rpm - speed_rpm.mean()) * np.cos(angle_rad))
    sine_rpm = 2 * np.mean((speed_rpm - speed_rpm.mean()) * np.sin(angle_rad))
    assert cosine_rpm == pytest.approx(-ECCENTRIC_SPEED_RPM, rel=0.1)
    assert abs(sine_rpm) < 0.15 * ECCENTRIC_SPEED_RPM


@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_sensor_that_saturates_below_the_limit_hides_an_overcurrent_from_the_drive_only(make_bench, controller):
    """Limit and trip are parameters of the drive (52 A, 75 A): a sensor that saturates at 40 A reaches neither; the
    comparators of the gate drivers see the current itself."""
    bench = make_bench(controller=controller)
    bench.rig.current_sensor_limit_A = 40.0
    bench.rig.truth_period_us = 5
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.005)
    measured_A = max(bench.telemetry[f"DRIVE_CURRENTS.current_{phase}_A"].value.max() for phase in "abc")
    true_A = max(bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].value.max() for phase in "abc")
    assert measured_A <= 40.0
    assert 80 < true_A < 1.2 * 75
    assert (bench.drive.state, bench.drive.fault) == ("fault", "hardware_over_current")


@pytest.mark.bench_options(controller="paper")
def test_trip_below_the_sensor_limit_protects(bench):
    bench.rig.current_sensor_limit_A = 40.0
    bench.drive.parameters["current_trip_A"] = 39.0
    bench.rig.truth_period_us = 25
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.02)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "over_current")
    true_A = max(bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].value.max() for phase in "abc")
    assert 39 < true_A < 39 + 2 * 240 / 0.67e-3 * 25e-6  # rise of two periods at the minimum inductance


def test_equal_runs_are_identical_with_every_error_on(make_bench):
    logs = []
    for seed in (1, 1, 2):
        bench = make_bench(controller="paper", seed=seed)
        set_up(bench, CASES["all"])
        start_loaded(bench)
        logs.append([(time_ns, m.arbitration_id, bytes(m.data)) for time_ns, m in bench.log])
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_machine_file_sets_the_errors_and_the_rig_clears_them(make_bench, tmp_path):
    file = tmp_path / "poor_sensors.toml"
    text = (MACHINES / "saturating.toml").read_text().replace('name = "saturating"', 'name = "poor_sensors"')
    file.write_text(text + SENSORS)
    bench = make_bench(machine=str(file), controller="paper")
    start_loaded(bench)
    start_s = watch_closely(bench, 0.03, period_us=1)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    measured_A, true_A = currents_A(bench, start_s, delay_us=3)
    noise_A = measured_A - (1.05 * true_A + 0.5)
    assert abs(noise_A.mean()) < 0.015
    assert 0.02 < noise_A.std() < 0.04
    error_deg, true_deg = angle_error_deg(bench, start_s)
    assert error_deg == pytest.approx(0.5 * np.sin(np.radians(true_deg)), abs=0.01)
    assert np.abs(error_deg).max() > 0.1

    ideal = {"current_sensor_gain": 1.0, "current_sensor_offset_A": 0.0, "current_noise_A": 0.0,
             "current_sensor_limit_A": 1000.0, "current_sensor_delay_us": 0.0, "encoder_eccentricity_deg": 0.0}
    set_up(bench, Case(ideal))
    bench.run_for(0.01)
    start_s = watch_closely(bench, 0.03)
    measured_A, true_A = currents_A(bench, start_s)
    assert np.abs(measured_A - true_A).max() <= RESOLUTION_A
    error_deg, _ = angle_error_deg(bench, start_s)
    assert np.abs(error_deg).max() < 0.01
