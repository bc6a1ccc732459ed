"""Mean powers from the recorded energies, and the iron loss against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from salient.experiments.metrics import MetricsError, losses
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep, run_scenario
from salient.machine.file import load_machine, machine_path
from salient.machine.iron_loss import iron_loss_W, specific_loss_W_kg, split_loops

K, ALPHA, BETA = 0.008, 1.3, 1.9
IRON = {"turns_area_m2": 0.27, "mass_kg": 10.0, "steinmetz_k": K, "steinmetz_alpha": ALPHA, "steinmetz_beta": BETA}
MACHINE = load_machine(machine_path("saturating"))
WINDOW_S = (0.1, 0.2)


def k_i():
    x = np.linspace(0.0, 2.0 * np.pi, 200_001)
    return K / ((2.0 * np.pi) ** (ALPHA - 1.0) * np.trapezoid(np.abs(np.cos(x)) ** ALPHA, x) * 2.0 ** (BETA - ALPHA))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    scenario = Scenario(name="losses", duration_s=0.2, controller="paper", speed=(SpeedStep(0.0, 300.0),),
                        load=(LoadStep(0.03, 8.0),), record=Record(step_us=1.0))
    return run_scenario(scenario, tmp_path_factory.mktemp("losses")).recording


def stored_J(row):
    """Field and kinetic energy from the recorded state alone."""
    energy_J = 0.5 * MACHINE.inertia_kg_m2 * (float(row["speed_rpm"]) * np.pi / 30.0) ** 2
    for phase, name in enumerate(("current_a_A", "current_b_A", "current_c_A")):
        angle_rad = np.radians(float(row["rotor_angle_deg"])) - phase * MACHINE.pitch_rad / MACHINE.phases
        current_A = float(row[name])
        energy_J += MACHINE.magnetics.flux_linkage_Wb(angle_rad, current_A) * current_A
        energy_J -= MACHINE.magnetics.coenergy_J(angle_rad, current_A)
    return float(energy_J)


# --- energy balance ---------------------------------------------------------------------------------------------------

def test_recorded_energies_balance_the_stored_energy_within_100_microjoules(recording):
    of = losses(recording, MACHINE, WINDOW_S)
    first, last = np.searchsorted(recording["time_s"], np.array(WINDOW_S) - 1e-10)
    assert of["stored_W"] * 0.1 == pytest.approx(stored_J(recording[last]) - stored_J(recording[first]), abs=1e-4)
    assert of["input_W"] > 200.0


def test_mean_powers_are_those_of_currents_torque_and_speed(recording):
    of = losses(recording, MACHINE, WINDOW_S)
    assert of["copper_W"] == pytest.approx(3 * MACHINE.resistance_ohm * of["phase_current_rms_A"] ** 2, rel=1e-3)
    part = recording[100_000:200_001]
    speed_rad_s = part["speed_rpm"].astype(float) * np.pi / 30.0
    assert of["output_W"] == pytest.approx(8.0 * speed_rad_s.mean(), rel=1e-4)
    assert of["friction_W"] == pytest.approx(MACHINE.friction_Nm_s * np.mean(speed_rad_s**2), rel=1e-4)
    lost_W = of["copper_W"] + of["converter_W"] + of["friction_W"]
    assert of["efficiency_percent"] == pytest.approx(100.0 * of["output_W"] / (of["output_W"] + lost_W))


def test_iron_loss_is_absent_without_its_table_and_changes_nothing_else(recording):
    without, iron = losses(recording, MACHINE, WINDOW_S), replace(MACHINE, iron_loss=IRON)
    with_iron = losses(recording, iron, WINDOW_S)
    assert 0.1 < with_iron.pop("iron_estimate_W") < 20.0
    assert with_iron == without
    assert iron_loss_W(iron, recording[::10], WINDOW_S) is None


def test_window_outside_the_recording_is_rejected(recording):
    with pytest.raises(MetricsError, match="losses are taken from 0.1 s to 0.3 s"):
        losses(recording, MACHINE, (0.1, 0.3))


# --- iron loss --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("frequency_Hz", "peak_T"), [(50.0, 1.5), (400.0, 0.3)])
def test_loss_of_a_sine_is_that_of_steinmetz_at_any_sampling(frequency_Hz, peak_T):
    for samples in (500, 5000):
        time_s = np.linspace(0.0, 1.0 / frequency_Hz, samples + 1)
        flux_T = 0.7 + peak_T * np.sin(2.0 * np.pi * frequency_Hz * time_s + 0.3)
        assert specific_loss_W_kg(time_s, flux_T, K, ALPHA, BETA) == pytest.approx(
            K * frequency_Hz**ALPHA * peak_T**BETA, rel=1e-4)


def test_loss_of_a_triangle_is_its_closed_form():
    time_s = np.linspace(0.0, 0.02, 401)
    flux_T = np.interp(time_s, [0.0, 0.01, 0.02], [-1.0, 1.0, -1.0])
    assert specific_loss_W_kg(time_s, flux_T, K, ALPHA, BETA) == pytest.approx(
        k_i() * 200.0**ALPHA * 2.0 ** (BETA - ALPHA), rel=1e-6)


@pytest.mark.parametrize("parts", [1, 7])
def test_minor_loop_contributes_by_its_amplitude(parts):
    """0 to 1 T at 100 T/s with a reversal from 0.6 to 0.4 T, then down without one: the reversal is a loop of 0.2 T."""
    corner_s, corner_T = np.array([0.0, 0.006, 0.008, 0.014, 0.024]), np.array([0.0, 0.6, 0.4, 1.0, 0.0])
    position = np.arange(4 * parts + 1) / parts
    time_s, flux_T = np.interp(position, range(5), corner_s), np.interp(position, range(5), corner_T)
    slope = 100.0**ALPHA
    by_hand = k_i() * slope * (0.020 * 1.0 + 0.004 * 0.2 ** (BETA - ALPHA)) / 0.024
    assert specific_loss_W_kg(time_s, flux_T, K, ALPHA, BETA) == pytest.approx(by_hand, rel=1e-6)


def test_nested_loops_are_found():
    values = np.array([0.0, 10.0, 3.0, 8.0, 5.0, 9.0, 0.0])
    found = split_loops(values, np.abs(np.diff(values)))
    assert found == [(3.0, 6.0), (6.0, 12.0), (10.0, 20.0)]
