"""Coupled phases, eddy currents and spread (emulator/plant/coupled.h) against an independent integration of the same
equations, against a closed form, and by an energy balance.

Deviations are relative to the largest magnitude of the quantity in the run (speed and angle: to its change). Measured
on x86-64 with gcc 12: at most 2e-7.
"""

from __future__ import annotations

import ctypes
import itertools
import math

import numpy as np
import pytest
from coupled_reference import run_coupled
from plant_faults import Faults, Switches, read, set_faults, turns
from reference_plant import Machine, Run, State, load_library, machine_from, plant_of, run_plant
from test_energy_balance import FULL, BalanceTerms
from test_faults_energy_balance import PERIODS, chopping, machine_of
from test_plant_against_scipy import machine_of as formula_machine

from salient.machine.circuit import none_of
from salient.machine.file import load_machine
from salient.paths import MACHINES

BOUND = 2e-6
ENERGY_BOUND = 1e-6

KINDS = {
    "coupled": {"coupling": (0.03, -0.02, 0.04)},
    "eddy": {"eddy": 2e-3},
    "spread": {"flux": (0.03, -0.02, 0.0), "angle_deg": (0.2, -0.1, 0.0)},
    "all": {"coupling": (-0.03, 0.02, -0.03), "eddy": 2e-3, "flux": (0.03, -0.02, 0.0), "angle_deg": (0.2, -0.1, 0.0)},
}


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


def with_circuit(machine: Machine, kind: str) -> Machine:
    circuit, phases = KINDS[kind], machine.phases

    def of_phases(values: tuple[float, ...]) -> list[float]:
        return list(itertools.islice(itertools.cycle(values), phases))

    machine.circuit.coupling[:phases] = of_phases(circuit.get("coupling", (0.0,)))
    machine.circuit.eddy_conductance_S = circuit.get("eddy", 0.0)
    machine.circuit.flux_deviation[:phases] = of_phases(circuit.get("flux", (0.0,)))
    machine.circuit.angle_deviation_deg[:phases] = of_phases(circuit.get("angle_deg", (0.0,)))
    return machine


def switched(periods: int) -> Run:
    """Each phase with both switches on, one and none, and idle phases of all three kinds beside it."""
    compares = []
    for period in range(periods):
        at = period * 150 // periods
        signs = (1 if at < 40 else 0 if at < 60 else -1,
                 0 if at < 70 else 1 if at < 110 else -1,
                 -1 if at < 20 else 0 if at < 90 else 1 if at < 130 else 0)
        compares.append((tuple(FULL * (sign >= 0) for sign in signs), tuple(FULL * (sign > 0) for sign in signs)))
    return Run(FULL, compares, speed_rad_s=60.0, angle_deg=50.0, load_torque_Nm=2.0)


@pytest.mark.in_turns
@pytest.mark.parametrize(("form", "kind", "periods"), [
    ("linear_cosine", "coupled", 150), ("saturating", "coupled", 150), ("linear_trapezoid", "spread", 150),
    ("saturating", "spread", 150), ("saturating", "eddy", 60), ("linear_cosine", "all", 30),
    ("saturating", "all", 15)])
def test_states_are_those_of_an_independent_integration(library: ctypes.CDLL, form: str, kind: str, periods: int
                                                        ) -> None:
    machine = with_circuit(formula_machine(form), kind)
    run = switched(periods)
    seen, _ = run_plant(library, machine, run)
    expected = run_coupled(machine, run)
    worst = {}
    for name in ("angle", "speed", "torque", "fluxes") + (("currents",) if kind in ("coupled", "spread") else ()):
        scale = np.ptp(expected[name]) if name in ("angle", "speed") else np.max(np.abs(expected[name]))
        worst[name] = float(np.max(np.abs(seen[name] - expected[name])) / scale)
    print(form, kind, {name: f"{value:.1e}" for name, value in worst.items()})
    assert max(worst.values()) < BOUND, worst
    if kind == "coupled":
        assert np.all(np.max(expected["currents"], axis=1) > 1.0)


def test_mutual_inductance_of_a_linear_machine(library: ctypes.CDLL) -> None:
    """Flux linkage of a phase without current and torque of two that carry one, as k (L_j + L_(j+1)) has it."""
    machine = formula_machine("linear_cosine")
    share = 0.04
    machine.circuit.coupling[0] = share
    mean_H, swing_H = (23.6e-3 + 0.676e-3) / 2.0, (23.6e-3 - 0.676e-3) / 2.0
    for angle_deg in (3.0, 20.0, 55.0, 81.0):
        angles = [4.0 * math.radians(angle_deg - 30.0 * phase) for phase in range(2)]
        first_H, second_H = (mean_H + swing_H * math.cos(angle) for angle in angles)
        first_slope, second_slope = (-4.0 * swing_H * math.sin(angle) for angle in angles)
        mutual_H, mutual_slope = share * (first_H + second_H), share * (first_slope + second_slope)
        with plant_of(library, machine, Run(FULL, [], 0.0, angle_deg, 0.0, (10.0, 0.0, 0.0))) as plant:
            state = read(library, plant)
        assert state.flux_linkage_Wb[1] == pytest.approx(mutual_H * 10.0, rel=1e-12)
        assert state.flux_linkage_Wb[2] == 0.0
        with plant_of(library, machine, Run(FULL, [], 0.0, angle_deg, 0.0, (10.0, 7.0, 0.0))) as plant:
            state = read(library, plant)
        own_slope = [first_slope + share**2 * second_slope, second_slope + share**2 * first_slope]
        torque_Nm = 0.5 * own_slope[0] * 100.0 + 0.5 * own_slope[1] * 49.0 + mutual_slope * 70.0
        assert state.torque_Nm == pytest.approx(torque_Nm, rel=1e-11)


FAULTS = {
    "none": Faults(),
    "switch_shorted": Faults(switch_shorted=Switches(2, 0)),
    "winding_open": Faults(winding_open=2),
    "diode_open": Faults(diode_open=Switches(2, 0)),
    "winding_shorted": turns(b=0.1),
    "friction": Faults(coulomb_Nm=3.0, static_Nm=5.0),
}


@pytest.mark.in_turns
@pytest.mark.parametrize("name", ["saturating", "finite_element"])
@pytest.mark.parametrize("link", ["ideal supply", "link"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_energy_balance_closes(library: ctypes.CDLL, name: str, link: str, kind: str, fault: str) -> None:
    machine = with_circuit(machine_of(name, link), kind)
    run = Run(FULL, [], speed_rad_s=60.0, angle_deg=50.0, load_torque_Nm=0.0)
    worst_J = 0.0
    state = State()
    with plant_of(library, machine, run) as plant:
        first = read(library, plant)
        for period, state in chopping(library, plant, machine, run.period_ns, range(PERIODS)):
            machine_J, link_J = missing(first, state, link)
            worst_J = max(worst_J, abs(machine_J), abs(link_J))
            if period % 1000 in (300, 800):
                set_faults(library, plant, FAULTS[fault] if period % 1000 == 300 else Faults())
    print(f"{worst_J / state.energy_drawn_J:.1e}")
    assert state.energy_drawn_J > 10.0
    assert worst_J < ENERGY_BOUND * state.energy_drawn_J, f"{worst_J} J of {state.energy_drawn_J} J"
    assert (state.energy_iron_J > 1e-4 * state.energy_drawn_J) == (kind in ("eddy", "all"))


def missing(first: State, state: State, link: str) -> tuple[float, float]:
    """Energy that the terms of machine and link leave unexplained."""
    before, now = BalanceTerms(first), BalanceTerms(state)
    machine_J = (now.net - before.net - (now.consumed - before.consumed) - (now.stored - before.stored)
                 - state.energy_fault_J - state.energy_iron_J)
    return machine_J, (now.supplied - now.net - (now.link - before.link) if link == "link" else 0.0)


def test_the_bundled_machines_have_none() -> None:
    for path in sorted(MACHINES.glob("*.toml")):
        machine = load_machine(path)
        assert none_of(machine.circuit), path
        assert bytes(machine_from(machine).circuit) == bytes(ctypes.sizeof(machine_from(machine).circuit)), path
