"""Energy balances of the plant over a second of every bundled machine: every loss has a term.

Chopping at 40 kHz, motoring and braking in turn, so that energy goes back to the link, and load steps against the rotor
and with it; on the ideal supply of the machine file, and on a DC link that is charged and has a brake chopper.
Measured on x86-64 with gcc 12: at most 4e-9 of the energy drawn for the linear machines, 5e-8 for the saturating one.
"""

from __future__ import annotations

import ctypes

import pytest
from reference_plant import Converter, DcLink, Machine, Run, State, load_library, machine_from, plant_of, set_switches

from salient.machine.file import load_machine
from salient.paths import MACHINES

pytestmark = pytest.mark.in_turns

FULL = 2500
PERIODS = 40_000
BOUND = 1e-6
LINKS = {
    "ideal supply": None,
    "link": DcLink(1e-3, 0.3, 10.0, 280.0, 265.0),
}


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


class BalanceTerms:
    """Terms of both energy balances from the state, J."""

    def __init__(self, state: State) -> None:
        self.net = state.energy_drawn_J - state.energy_returned_J
        self.consumed = (
            state.energy_copper_J + state.energy_converter_J + state.energy_load_J + state.energy_friction_J
        )
        self.stored = state.field_energy_J + state.kinetic_energy_J
        self.supplied = state.energy_supplied_J - state.energy_source_J - state.energy_chopper_J
        self.link = state.link_energy_J


def switches(state: State, machine: Machine, rising: list[bool], brakes: bool) -> tuple[list[int], list[int]]:
    """Current kept near a level by chopping: at rising inductance for motoring, at falling inductance for braking."""
    uppers, lowers = [0] * machine.phases, [0] * machine.phases
    for phase in range(machine.phases):
        pitches = state.rotor_angle_rad * machine.rotor_poles / 6.283185307179586
        angle = (pitches - phase / machine.phases) % 1.0
        rising[phase] = state.current_A[phase] < (25.0 if rising[phase] else 22.0)
        if (0.03 if brakes else 0.5) <= angle < (0.33 if brakes else 0.83):
            # Braking uses both switches, because one alone would not stop a current driven by the rotor.
            uppers[phase] = FULL if rising[phase] or not brakes else 0
            lowers[phase] = 2300 if rising[phase] else 0
    return uppers, lowers


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("name", sorted(path.stem for path in MACHINES.glob("*.toml")))
def test_energy_balance_closes_over_a_second(library: ctypes.CDLL, name: str, link: str) -> None:
    machine = machine_from(load_machine(MACHINES / f"{name}.toml"))
    machine.dc_link = LINKS[link] or DcLink()
    if link == "link":
        machine.converter = Converter(1.2, 0.015, 0.8, 0.01, 0.0)
    run = Run(FULL, [], speed_rad_s=100.0, angle_deg=50.0, load_torque_Nm=0.0)
    state, rising = State(), [True] * machine.phases
    braking_returned_J, link_V, brakes = 0.0, [], False
    with plant_of(library, machine, run) as plant:
        library.plant_library_read(plant, ctypes.byref(state))
        first = BalanceTerms(state)
        for period in range(PERIODS):
            # Speeds stay within 300 and 1500 r/min.
            brakes = state.speed_rad_s > 155.0 or (brakes and state.speed_rad_s > 35.0)
            before_J = state.energy_returned_J - state.energy_drawn_J
            load_Nm = (2.0, 5.0, -2.0, 3.0)[period // 2000 % 4]
            library.plant_library_set_inputs(plant, load_Nm, machine.supply_voltage_V)
            set_switches(library, plant, switches(state, machine, rising, brakes), FULL)
            library.plant_advance(plant, (period + 1) * run.period_ns)
            library.plant_library_read(plant, ctypes.byref(state))
            braking_returned_J += (state.energy_returned_J - state.energy_drawn_J - before_J) if brakes else 0.0
            link_V.append(state.bus_voltage_V)
            if period % 1000 == 999:
                now = BalanceTerms(state)
                machine_J = now.net - first.net - (now.consumed - first.consumed) - (now.stored - first.stored)
                assert abs(machine_J) < BOUND * state.energy_drawn_J, f"{machine_J} J of {state.energy_drawn_J} J"
                if link == "link":
                    link_J = now.supplied - now.net - (now.link - first.link)
                    assert abs(link_J) < BOUND * state.energy_drawn_J, f"{link_J} J of {state.energy_drawn_J} J"
    print(f"{name}, {link}: {machine_J / state.energy_drawn_J:.1e}", end="")
    print(f", {link_J / state.energy_drawn_J:.1e}" if link == "link" else "")
    assert braking_returned_J > 10.0, "energy went back"
    assert state.energy_drawn_J > 100.0
    if link == "link":
        assert min(link_V) < 238.0 and max(link_V) > 270.0
        assert state.energy_chopper_J > 1.0
        assert state.energy_converter_J > 1.0
