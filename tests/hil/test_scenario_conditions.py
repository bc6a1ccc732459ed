"""Conditions of a scenario: sensors and converters of the board, and deviations of the machine from the tables of the
drive."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from salient.bench.rig import bench_variables
from salient.errors import UsageError
from salient.experiments.metrics import losses
from salient.experiments.scenario import LoadStep, Record, RunResult, Scenario, SpeedStep, load_scenarios, run_scenario
from salient.machine.file import load_machine, machine_path

MACHINE = load_machine(machine_path("saturating"))
HEAD = 'machine = "saturating"\ncontrollers = ["paper"]\nduration_s = 0.2\n'
WINDOW_S = (0.25, 0.35)  # three strokes at 150 r/min


def loaded(tmp_path, name: str = "run", **changes) -> RunResult:
    """150 r/min, 8 N m from 0.1 s on, recorded each microsecond from 0.25 s to 0.35 s."""
    settings = {
        "name": name,
        "duration_s": WINDOW_S[1],
        "controller": "paper",
        "speed": (SpeedStep(0.0, 150.0),),
        "load": (LoadStep(0.1, 8.0),),
        "record": Record(step_us=1.0, from_s=WINDOW_S[0]),
    }
    result = run_scenario(Scenario(**(settings | changes)), tmp_path / name)
    assert result.fault == "none"
    return result


def mean_torque_Nm(result: RunResult) -> float:
    return float(result.recording["torque_Nm"].mean(dtype=float))


def ripple(result: RunResult) -> float:
    torque_Nm = result.recording["torque_Nm"]
    return (float(torque_Nm.max()) - float(torque_Nm.min())) / mean_torque_Nm(result)


# --- reading ---------------------------------------------------------------------------------------------------------


def test_file_sets_every_condition(tmp_path):
    path = tmp_path / "conditions.toml"
    path.write_text(HEAD + "encoder_edges = true\nadc_bits = 14\nimmediate_pwm = true\ncontrol_rate_hz = 1000000\n"
                    "[bench]\nflux_linkage_gain = 1.05\nencoder_offset_deg = -0.2\n")
    (scenario,) = load_scenarios(path)
    assert (scenario.encoder_edges, scenario.adc_bits, scenario.immediate_pwm) == (True, 14, True)
    assert scenario.control_rate_hz == 1_000_000
    assert scenario.bench == {"flux_linkage_gain": 1.05, "encoder_offset_deg": -0.2}


def test_conditions_are_optional(tmp_path):
    path = tmp_path / "conditions.toml"
    path.write_text(HEAD)
    (scenario,) = load_scenarios(path)
    assert (scenario.encoder_edges, scenario.adc_bits, scenario.immediate_pwm) == (False, 12, False)
    assert scenario.bench == {}


@pytest.mark.parametrize(("text", "message"), [
    ("adc_bits = 11", "adc_bits: 11: must be a whole number from 12 to 16"),
    ("encoder_edges = 1", "encoder_edges: 1: must be true or false"),
    ('immediate_pwm = "yes"', "immediate_pwm: 'yes': must be true or false"),
    ("[bench]\ngain = 1", "bench.gain: unknown key; the nearest of "),
    ("[bench]\nload_torqe_Nm = 1", f"bench.load_torqe_Nm: unknown key; the nearest of {len(bench_variables())} are "
     "load_torque_Nm, "),
    ("[bench]\nflux_linkage_gain = 0.1", "bench.flux_linkage_gain: 0.1: must be a number from 0.2 to 5"),
    ("[bench]\nencoder_offset_deg = 5.1", "bench.encoder_offset_deg: 5.1: must be a number from -5 to 5"),
    ("[bench]\nminimum_pulse_ns = true", "bench.minimum_pulse_ns: True: must be a number from 0 to 2000"),
    ("bench = 1", "bench: must be a table [bench]"),
])  # fmt: skip
def test_invalid_condition_is_named(tmp_path, text, message):
    path = tmp_path / "conditions.toml"
    path.write_text(HEAD + text + "\n")
    with pytest.raises(UsageError) as caught:
        load_scenarios(path)
    assert str(caught.value).startswith(f"{path}: {message}")


@pytest.mark.parametrize(("text", "message"), [
    ("[parameters]\nnonesuch = 1", "parameters.nonesuch: unknown parameter; the nearest of "),
    ("[parameters]\ntorque_max_Nm = 500", "parameters.torque_max_Nm: 500: must be a number from "),
    ("[parameters]\nunder_voltage_V = 310", "parameters.under_voltage_V: 310 V: must be below over_voltage_V, "),
    ("[bench]\nsupply_voltage_V = 48", "supply_voltage_V: 48 V: must not be below under_voltage_V, "),
    ('true_machine = "nonesuch"', "machine 'nonesuch': no such file"),
])  # fmt: skip
@pytest.mark.parametrize("command", [("run",), ("sweep", "--set", "torque_slew_rate_Nm_s=100,200")])
def test_a_value_that_the_drive_refuses_is_named_with_its_file(salient_without_build, tmp_path, command, text, message):
    (tmp_path / "mine.toml").write_text(f"{HEAD}{text}\n")
    done = salient_without_build(*command, "mine.toml", "--out", "out")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"salient: mine.toml: {message}") and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_every_bench_variable_may_be_set_from_the_start(tmp_path):
    """Every bench variable is accepted near the value of the machine file, and the drive runs."""
    values = {"supply_voltage_V": 230.0, "current_sensor_gain": 1.01, "truth_period_us": 500, "current_noise_A": 0.02,
              "current_sensor_limit_A": 90.0, "flux_linkage_gain": 1.05, "resistance_gain": 1.2, "inertia_gain": 1.1,
              "friction_gain": 0.9, "minimum_pulse_ns": 200.0, "load_ramp_Nm_s": 4000.0, "load_sine_amplitude_Nm": 0.1,
              "load_sine_frequency_Hz": 50.0, "held_speed_rpm": math.nan, "bus_connection": 1,
              "supply_ripple_frequency_Hz": 300.0, "frame_fault_per_mille": 1.0,
              "frame_delay_us": 100, "babble_identifier": 0x700, "babble_length": 1}
    bench = {name: values.get(name, 0.0) for name in bench_variables()}
    assert values.keys() <= bench.keys()
    result = loaded(tmp_path, bench=bench)
    assert set(result.recording["bus_voltage_V"]) == {230.0}
    assert np.diff(result.truth["RIG_TRUTH_MOTION.speed_rpm"].time_s) == pytest.approx(500e-6, abs=1e-9)


# --- the machine ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [0.5, 3.0])
def test_settling_time_is_proportional_to_inertia(tmp_path, gain):
    """The torque is at its limit of 19.1 N m, and the drive settles although its tables have another inertia."""
    reached_s = {}
    for inertia_gain in (1.0, gain):
        scenario = Scenario(name="start", duration_s=0.25, controller="paper", speed=(SpeedStep(0.0, 600.0),),
                            bench={"inertia_gain": inertia_gain}, record=Record(step_us=10.0))
        recording = run_scenario(scenario, tmp_path / str(inertia_gain)).recording
        reached_s[inertia_gain] = recording["time_s"][np.argmax(recording["speed_rpm"] > 500.0)]
        assert recording["speed_rpm"][-1] == pytest.approx(600.0, abs=1.0)
    command_s = 0.001  # time until the drive is ready, in both runs
    assert (reached_s[gain] - command_s) / (reached_s[1.0] - command_s) == pytest.approx(gain, rel=0.03)


@pytest.mark.parametrize("gain", [0.0, 1.0, 5.0])
def test_friction_is_the_difference_between_steady_torque_and_load(tmp_path, gain):
    result = loaded(tmp_path, bench={"friction_gain": gain})
    speed_rad_s = float(result.recording["speed_rpm"].mean(dtype=float)) * math.pi / 30
    assert mean_torque_Nm(result) == pytest.approx(8.0 + gain * MACHINE.friction_Nm_s * speed_rad_s, abs=0.02)


@pytest.mark.parametrize("gain", [0.8, 1.0, 2.0])
def test_copper_loss_is_in_proportion_to_resistance(tmp_path, gain):
    result = losses(loaded(tmp_path, bench={"resistance_gain": gain}).recording, MACHINE, WINDOW_S)
    expected_W = 3 * gain * MACHINE.resistance_ohm * result["phase_current_rms_A"] ** 2
    assert result["copper_W"] == pytest.approx(expected_W, rel=1e-3)


@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_torque_exceeds_the_estimate_of_the_drive_by_the_flux_linkage_gain(tmp_path, gain):
    """Torque is in proportion to flux linkage at the same current, which the drive measures."""
    error = {}
    for flux_linkage_gain in (1.0, gain):
        result = loaded(tmp_path, str(flux_linkage_gain), bench={"flux_linkage_gain": flux_linkage_gain})
        estimate_Nm = result.telemetry["torque_estimate_Nm"].between(*WINDOW_S).value.mean()
        error[flux_linkage_gain] = mean_torque_Nm(result) / estimate_Nm
    assert error[1.0] == pytest.approx(1.0, abs=0.01)
    assert error[gain] == pytest.approx(gain, abs=0.015)


def test_encoder_offset_appears_in_the_angle_reported_by_the_drive(make_bench):
    bench = make_bench(controller="paper", encoder_bits=24)
    bench.rig.encoder_offset_deg = -0.5
    bench.rig.truth_period_us = 0
    bench.run_for(0.01)
    measured_deg = bench.telemetry["DRIVE_MOTION.rotor_angle_deg"].last
    assert (measured_deg + 180) % 360 - 180 == pytest.approx(-0.5, abs=360 / 2**16)


def test_minimum_pulse_suppresses_pulses(tmp_path):
    """2 us of 25 us: the paper's controller has no duties in between."""
    slow = {"speed": (SpeedStep(0.0, 60.0),), "load": (LoadStep(0.1, 2.0),)}
    ideal, coarse = (ripple(loaded(tmp_path, str(ns), bench={"minimum_pulse_ns": ns}, **slow)) for ns in (0.0, 2000.0))
    assert 0.005 < ideal < 0.03
    assert 1.2 * ideal < coarse < 5 * ideal


# --- the board --------------------------------------------------------------------------------------------------------


@pytest.mark.in_turns
@pytest.mark.parametrize("bits", [12, 14, 16])
def test_adc_has_the_resolution_of_its_bits(make_bench, bits):
    bench = make_bench(controller="paper", adc_bits=bits)
    bench.drive.speed_reference_rpm = 150
    bench.at(0.1).load_torque_Nm = 8
    bench.run_for(0.15)
    bench.rig.truth_period_us = 1
    start_us = round(bench.time_s * 1e6)
    bench.run_for(0.03)
    sampled_us = bench.telemetry["DRIVE_STATUS.time_us"].value.astype(np.int64)
    worst_A = []
    for phase in "abc":
        measured_A = bench.telemetry[f"DRIVE_CURRENTS.current_{phase}_A"].value
        chosen = sampled_us[: len(measured_A)] >= start_us + 10
        truth = bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"]
        truth_us = np.round(truth.time_s * 1e6).astype(np.int64)
        index = np.searchsorted(truth_us, sampled_us[: len(measured_A)][chosen])
        worst_A.append(np.abs(measured_A[chosen] - truth.value[index]).max())
    half_code_A, half_lsb_A = 0.5 * 80 / 2**bits, 0.5 / 512
    assert max(worst_A) <= half_code_A + 2 * half_lsb_A + 1e-9  # LSB of the drive's format and of the true-state frames
    assert max(worst_A) > 0.6 * half_code_A


def test_captured_edges_leave_the_counts_unchanged(make_bench):
    """Angles follow from the counts, with or without captured edges."""
    angles = []
    for edges in (False, True):
        bench = make_bench(controller="paper", encoder_edges=edges)
        bench.rig.load_torque_Nm = -1.0  # rotates the shaft; the drive stays off
        bench.run_for(0.1)
        angles.append(bench.telemetry["DRIVE_MOTION.rotor_angle_deg"].value)
        assert angles[-1].max() > 10
    assert np.array_equal(*angles)


def test_conditions_of_the_paper_remove_the_ripple_of_its_controllers(tmp_path):
    """1 MHz, no delay, exact sensing; at 40 kHz the ripple is 0.06, and 0.8 with the hysteresis controller."""
    conditions = {"control_rate_hz": 1_000_000, "encoder_bits": 0, "adc_bits": 16, "immediate_pwm": True}
    assert 0.001 < ripple(loaded(tmp_path, "paper", **conditions)) < 0.01
    assert 0.05 < ripple(loaded(tmp_path, "traditional", controller="traditional", **conditions)) < 0.25


def test_immediate_duties_avoid_the_delay_of_a_period(tmp_path):
    """The hysteresis controller overshoots its band by the change of torque in the delay."""
    base = {"controller": "traditional", "control_rate_hz": 100_000}
    delayed = ripple(loaded(tmp_path, "delayed", **base))
    immediate = ripple(loaded(tmp_path, "immediate", immediate_pwm=True, **base))
    assert 0.1 < immediate < 0.8 * delayed < 1.0


def test_equal_conditions_give_identical_files(tmp_path):
    settings = {"bench": {"current_noise_A": 0.02, "flux_linkage_gain": 1.03}, "encoder_edges": True, "adc_bits": 14}
    first = loaded(tmp_path, "first", **settings)
    second = loaded(tmp_path, "second", **settings)
    assert first.recording_path.read_bytes() == second.recording_path.read_bytes()
    assert first.log_path.read_bytes() == second.log_path.read_bytes()
    other = run_scenario(replace(first.scenario, seed=2), tmp_path / "other")
    assert first.log_path.read_bytes() != other.log_path.read_bytes()
