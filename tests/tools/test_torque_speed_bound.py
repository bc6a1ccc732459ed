"""The bound of the mean torque over the speed: closed forms, balances, and what no drive exceeds."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from salient.machine.file import load_machine, machine_path
from salient.reference import torque_speed_bound
from salient.reference.torque_speed_bound import (
    BRAKING,
    MOTORING,
    Limits,
    largest_torque,
    least_current,
    operate,
    rough_torque_Nm,
)

OF_SUPPLY = Limits(current_A=52.0, over_voltage_V=300.0, supply_V=240.0)


def machine_of(name, **changes):
    return replace(load_machine(machine_path(name)), **changes)


def ideal(name):
    """Without device drops and with a DC link that does not yield."""
    machine = machine_of(name, dc_link=None)
    return replace(machine, converter=dict.fromkeys(machine.converter, 0.0))


def test_pulse_of_a_linear_machine_has_the_flux_linkage_of_its_volt_seconds():
    machine = replace(ideal("linear_cosine"), resistance_ohm=1e-9)
    speed_rpm, on_deg, off_deg = 3000.0, 190.0, 300.0
    pulse = operate(machine, speed_rpm, replace(OF_SUPPLY, current_A=1000.0), on_deg, off_deg)
    # The flux linkage rises from turn-on to turn-off and falls as fast; the current is its quotient by the inductance.
    angle_deg = np.linspace(on_deg, 2.0 * off_deg - on_deg, 200_001)
    s_per_deg = math.radians(1.0) / machine.rotor_poles / (speed_rpm * math.pi / 30.0)
    flux_Wb = 240.0 * s_per_deg * np.minimum(angle_deg - on_deg, 2.0 * off_deg - on_deg - angle_deg)
    inductance_H = machine.magnetics.flux_linkage_Wb(np.radians(angle_deg) / machine.rotor_poles, 1.0)
    current_A = flux_Wb / inductance_H
    work_J = np.sum(0.5 * (current_A[1:] + current_A[:-1]) * np.diff(flux_Wb))
    strokes_per_rad = machine.phases * machine.rotor_poles / (2.0 * math.pi)
    mean_square_A2 = np.sum(np.square(current_A)) * (angle_deg[1] - angle_deg[0]) / 360.0
    assert pulse.torque_Nm == pytest.approx(work_J * strokes_per_rad, rel=2e-3)
    assert pulse.rms_A == pytest.approx(math.sqrt(mean_square_A2), rel=2e-3)
    assert pulse.peak_A == pytest.approx(current_A.max(), rel=2e-3)


@pytest.mark.in_turns
@pytest.mark.parametrize(("speed_rpm", "angles_deg"), [
    (500.0, (180.0, 350.0)), (3000.0, (160.0, 330.0)), (4000.0, (153.0, 345.0)), (1500.0, (330.0, 535.0))])
def test_energy_from_the_link_is_work_and_losses(speed_rpm, angles_deg):
    pulse = operate(machine_of("finite_element"), speed_rpm, OF_SUPPLY, *angles_deg)
    mechanical_W = pulse.torque_Nm * speed_rpm * math.pi / 30.0
    assert pulse.torque_Nm != 0.0
    assert pulse.link_W == pytest.approx(mechanical_W + pulse.copper_W + pulse.device_W, rel=1e-3)


@pytest.mark.in_turns
def test_link_sags_by_the_source_resistance_when_motoring_and_stands_at_the_chopper_when_braking():
    machine = machine_of("finite_element")
    motoring = operate(machine, 3000.0, OF_SUPPLY, 160.0, 330.0)
    sag_V = machine.dc_link["source_resistance_ohm"] * motoring.link_W / motoring.link_V
    assert 240.0 - motoring.link_V == pytest.approx(sag_V, rel=0.05)
    braking = operate(machine, 1500.0, OF_SUPPLY, 330.0, 535.0)
    assert braking.link_W < -1000.0 and braking.link_V == pytest.approx(280.0, rel=1e-3)


def test_flux_linkage_that_does_not_return_to_zero_accumulates_to_the_limit():
    machine = ideal("saturating")
    ended = operate(machine, 12_000.0, OF_SUPPLY, 150.0, 326.0)
    continuous = operate(machine, 12_000.0, OF_SUPPLY, 150.0, 333.0)
    assert 44.0 < ended.peak_A < 46.0
    assert continuous.peak_A == pytest.approx(52.0, rel=5e-3)
    assert continuous.torque_Nm > 1.03 * ended.torque_Nm


def test_current_that_rises_above_its_limit_against_the_full_voltage_is_refused():
    # Turned off at the aligned position, the current of a braking phase rises with its motional voltage.
    assert operate(ideal("linear_cosine"), 4000.0, OF_SUPPLY, 250.0, 420.0).torque_Nm == 0.0


@pytest.mark.in_turns
@pytest.mark.parametrize("quadrant", [MOTORING, BRAKING])
def test_largest_torque_of_finite_element_is_that_of_another_implementation(quadrant):
    # The same bound by another program, with 52 A, an ideal supply of 240 V and no drops.
    expected_Nm = {500.0: 30.1, 1000.0: 30.0, 2000.0: 29.3, 2500.0: 28.9, 2900.0: 28.5, 4000.0: 23.4, 6000.0: 15.4}
    found = largest_torque(ideal("finite_element"), list(expected_Nm), OF_SUPPLY, quadrant)
    for pulse, torque_Nm in zip(found, expected_Nm.values(), strict=True):
        more = 0.10 if quadrant == BRAKING and torque_Nm < 28.0 else 0.015  # resistance helps to brake
        assert 0.99 * torque_Nm < quadrant * pulse.torque_Nm < (1.0 + more) * torque_Nm


@pytest.mark.in_turns
def test_largest_torque_is_below_that_of_the_current_limit_at_every_angle_and_reaches_it_at_low_speed():
    machine = ideal("saturating")
    angle_rad = np.linspace(0.5, 1.0, 2001) * machine.magnetics.pitch_rad
    half_Nm = machine.magnetics.torque_Nm(angle_rad, 52.0).mean() / 2.0 * machine.phases
    slow, fast = largest_torque(machine, [150.0, 3000.0], OF_SUPPLY, MOTORING)
    assert 0.995 * half_Nm < slow.torque_Nm < 1.002 * half_Nm
    assert fast.torque_Nm < 0.97 * half_Nm


@pytest.mark.in_turns
def test_largest_torque_rises_with_the_voltage_and_falls_with_the_speed():
    machine = ideal("linear_cosine")
    by_supply = [largest_torque(machine, [1500.0, 2250.0, 3000.0], replace(OF_SUPPLY, supply_V=supply_V), MOTORING)
                 for supply_V in (168.0, 240.0, 264.0)]
    torque_Nm = np.array([[pulse.torque_Nm for pulse in pulses] for pulses in by_supply])
    assert np.all(np.diff(torque_Nm, axis=0) > 0.0) and np.all(np.diff(torque_Nm, axis=1) < 0.0)
    # Without a resistance the torque is a function of voltage / speed alone.
    free = replace(machine, resistance_ohm=1e-9)
    (slow,), (fast,) = (largest_torque(free, [speed_rpm], replace(OF_SUPPLY, supply_V=supply_V), MOTORING)
                        for speed_rpm, supply_V in ((1500.0, 120.0), (3000.0, 240.0)))
    assert fast.torque_Nm == pytest.approx(slow.torque_Nm, rel=1e-6)


@pytest.mark.in_turns
def test_braking_is_limited_by_what_the_chopper_takes_below_the_over_voltage():
    machine = machine_of("finite_element")
    (pulse,) = largest_torque(machine, [3500.0], OF_SUPPLY, BRAKING)
    chopper_W = 300.0**2 / machine.dc_link["chopper_resistance_ohm"]
    assert -pulse.link_W <= 1.002 * chopper_W
    assert -pulse.torque_Nm * 3500.0 * math.pi / 30.0 > 1.03 * chopper_W  # the losses come on top
    (without,) = largest_torque(replace(machine, dc_link=None), [3500.0], OF_SUPPLY, BRAKING)
    assert without.torque_Nm < 1.05 * pulse.torque_Nm


@pytest.mark.in_turns
def test_braking_with_the_link_at_its_limit_is_found_whatever_the_limit():
    """Angles that are permitted are few, and a higher voltage returns less energy."""
    machine = machine_of("finite_element")
    ohm = machine.dc_link["chopper_resistance_ohm"]
    torques_Nm = []
    for limit_V in (291.0, 295.0, 300.0):
        (pulse,) = largest_torque(machine, [3000.0], replace(OF_SUPPLY, over_voltage_V=limit_V), BRAKING)
        assert 0.995 * limit_V < pulse.link_V <= limit_V
        assert -pulse.link_W == pytest.approx(pulse.link_V**2 / ohm, rel=2e-3)
        torques_Nm.append(-pulse.torque_Nm)
    assert 24.5 < torques_Nm[0] < torques_Nm[1] < torques_Nm[2] < 27.5


@pytest.mark.in_turns
def test_link_without_a_chopper_lets_braking_dissipate_only():
    machine = machine_of("finite_element")
    link = {key: value for key, value in machine.dc_link.items() if not key.startswith("chopper")}
    pulse = operate(replace(machine, dc_link=link), 1500.0, OF_SUPPLY, 330.0, 535.0)
    assert pulse.torque_Nm == 0.0


@pytest.mark.in_turns
def test_pulse_of_least_current_makes_its_torque_and_no_other_pulse_makes_it_with_less():
    machine, speed_rpm = ideal("linear_cosine"), 2250.0
    wanted_Nm = (6.0, 13.0, -13.0)
    generator = np.random.default_rng(1)
    for torque_Nm, pulse in zip(wanted_Nm, least_current(machine, speed_rpm, OF_SUPPLY, wanted_Nm), strict=True):
        assert pulse.torque_Nm == pytest.approx(torque_Nm, rel=0.011)
        again = operate(machine, speed_rpm, OF_SUPPLY, pulse.on_deg, pulse.off_deg)
        assert again.rms_A == pytest.approx(pulse.rms_A, rel=0.01)
        for _ in range(15):
            near = operate(machine, speed_rpm, OF_SUPPLY, pulse.on_deg + generator.uniform(-40.0, 40.0),
                           pulse.off_deg + generator.uniform(-40.0, 40.0))
            if abs(near.torque_Nm) >= abs(torque_Nm) and near.torque_Nm * torque_Nm > 0.0:
                assert near.rms_A > 0.99 * pulse.rms_A


@pytest.mark.in_turns
def test_pulse_of_least_current_is_found_where_few_angles_are_permitted():
    """Braking, the current of a linear machine rises against the full voltage for most pairs of angles."""
    (pulse,) = least_current(machine_of("linear_cosine"), 2250.0, OF_SUPPLY, [-19.4])
    assert pulse.torque_Nm == pytest.approx(-19.4, rel=0.011)
    assert 18.0 < pulse.rms_A < 20.0


def test_torque_beyond_the_largest_has_no_pulse():
    (pulse,) = least_current(ideal("linear_cosine"), 2250.0, OF_SUPPLY, [40.0])
    assert pulse.torque_Nm == 0.0 and math.isinf(pulse.rms_A)


@pytest.mark.in_turns
def test_rough_torque_is_near_the_largest():
    machine, speeds_rpm = ideal("linear_cosine"), [375.0, 1500.0, 3000.0]
    rough_Nm = rough_torque_Nm(machine, speeds_rpm, OF_SUPPLY)
    for torque_Nm, pulse in zip(rough_Nm, largest_torque(machine, speeds_rpm, OF_SUPPLY, MOTORING), strict=True):
        assert 0.95 < torque_Nm / pulse.torque_Nm < 1.03


def test_bound_shares_the_magnetics_with_the_rest_and_nothing_else():
    source = Path(torque_speed_bound.__file__).read_text(encoding="utf-8")
    imported = {line.split()[1] for line in source.splitlines() if line.startswith(("import ", "from "))}
    assert {name for name in imported if name.startswith("salient")} == {"salient.machine.definition"}
    assert torque_speed_bound.CURRENT_OVER == 1.03
