"""Energy balances of the plant with faults: arcs, avalanches, shorted turns, friction and a lock have their terms."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator

import pytest
from plant_faults import Faults, Switches, earth, lock, read, set_faults, turns
from reference_plant import Converter, DcLink, Machine, Run, State, load_library, machine_from, plant_of, set_switches
from test_energy_balance import FULL, BalanceTerms, switches

from salient.machine.file import load_machine
from salient.paths import MACHINES

BOUND = 1e-6
PERIODS = 1500
LINKS = {"ideal supply": None, "link": DcLink(1e-3, 0.3, 10.0, 280.0, 265.0)}
BIT_B = 2

FAULTS = {
    "winding_open": Faults(winding_open=BIT_B),
    "switch_open": Faults(switch_open=Switches(0, BIT_B)),
    "switch_shorted": Faults(switch_shorted=Switches(BIT_B, 0)),
    "both_switches_shorted": Faults(switch_shorted=Switches(BIT_B, BIT_B)),
    "diode_open_high": Faults(diode_open=Switches(BIT_B, 0)),
    "diode_open_low": Faults(diode_open=Switches(0, BIT_B)),
    "chopper_open": Faults(chopper_open=True),
    "winding_shorted": turns(b=0.1),
    "winding_shorted_half": turns(b=0.5, c=0.02),
    "winding_to_earth": earth(b=0.2),
    "friction": Faults(coulomb_Nm=3.0, static_Nm=5.0),
    "several": Faults(winding_open=1, diode_open=Switches(BIT_B, 0), coulomb_Nm=1.0),
}
TAKES_FAULT_ENERGY = ("winding_open", "diode_open_high", "diode_open_low", "several")


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


class Terms(BalanceTerms):
    def __init__(self, state: State) -> None:
        super().__init__(state)
        self.consumed += state.energy_fault_J


def machine_of(name: str, link: str) -> Machine:
    machine = machine_from(load_machine(MACHINES / f"{name}.toml"))
    machine.dc_link = LINKS[link] or DcLink()
    machine.converter = Converter(1.2, 0.015, 0.8, 0.01, 0.0)
    return machine


def chopping(library: ctypes.CDLL, plant: int, machine: Machine, period_ns: int, periods: range
             ) -> Iterator[tuple[int, State]]:
    """The state after each period of a chopping drive that motors and brakes in turn."""
    rising = [True] * machine.phases
    state = read(library, plant)
    for period in periods:
        brakes = period // 500 % 4 == 3
        load_Nm = (2.0, 5.0, -2.0, 3.0)[period // 700 % 4]
        library.plant_library_set_inputs(plant, load_Nm, machine.supply_voltage_V)
        set_switches(library, plant, switches(state, machine, rising, brakes), FULL)
        library.plant_advance(plant, (period + 1) * period_ns)
        state = read(library, plant)
        yield period, state


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("fault", FAULTS)
def test_energy_balance_closes_while_a_fault_comes_and_goes(library: ctypes.CDLL, link: str, fault: str) -> None:
    machine = machine_of("saturating", link)
    run = Run(FULL, [], speed_rad_s=60.0, angle_deg=50.0, load_torque_Nm=0.0)
    worst_J = 0.0
    state = State()
    with plant_of(library, machine, run) as plant:
        first = Terms(read(library, plant))
        for period, state in chopping(library, plant, machine, run.period_ns, range(PERIODS)):
            now = Terms(state)
            machine_J = now.net - first.net - (now.consumed - first.consumed) - (now.stored - first.stored)
            link_J = now.supplied - now.net - (now.link - first.link) if link == "link" else 0.0
            worst_J = max(worst_J, abs(machine_J), abs(link_J))
            if period % 1000 in (300, 800):  # 7.5 ms with and 12.5 ms without it, and so on
                set_faults(library, plant, FAULTS[fault] if period % 1000 == 300 else Faults())
    assert state.energy_drawn_J > 10.0
    assert worst_J < BOUND * state.energy_drawn_J, f"{worst_J} J of {state.energy_drawn_J} J"
    if fault in TAKES_FAULT_ENERGY:
        assert state.energy_fault_J > 1e-3 * state.energy_drawn_J
    else:
        assert state.energy_fault_J == 0.0


def test_a_lock_takes_the_kinetic_energy(library: ctypes.CDLL) -> None:
    machine = machine_of("saturating", "ideal supply")
    run = Run(FULL, [], speed_rad_s=100.0, angle_deg=50.0, load_torque_Nm=0.0)
    with plant_of(library, machine, run) as plant:
        kinetic_J = read(library, plant).kinetic_energy_J
        lock(library, plant)
        library.plant_advance(plant, 1_000_000)
        state = read(library, plant)
    assert state.speed_rad_s == 0.0
    assert kinetic_J > 1.0
    assert state.energy_fault_J == pytest.approx(kinetic_J, rel=1e-12)
    assert state.kinetic_energy_J == 0.0


def test_friction_stops_the_shaft_and_holds_it_up_to_its_torque(library: ctypes.CDLL) -> None:
    """Without current: the speed falls by (Tc + load) / J to exactly 0; a load of less than the static friction moves
    nothing, a larger one less the Coulomb friction accelerates."""
    machine = machine_of("saturating", "ideal supply")
    machine.friction_Nm_s = 1e-9
    run = Run(FULL, [], speed_rad_s=2.0, angle_deg=50.0, load_torque_Nm=0.0)
    with plant_of(library, machine, run) as plant:
        set_faults(library, plant, Faults(coulomb_Nm=0.5, static_Nm=2.0))
        stop_s = 2.0 * machine.inertia_kg_m2 / 0.5
        library.plant_advance(plant, round(0.5 * stop_s * 1e9))
        assert read(library, plant).speed_rad_s == pytest.approx(1.0, rel=1e-6)
        library.plant_advance(plant, round(1.5 * stop_s * 1e9))
        stopped = read(library, plant)
        library.plant_library_set_inputs(plant, -1.99, machine.supply_voltage_V)
        library.plant_advance(plant, round(2.0 * stop_s * 1e9))
        held = read(library, plant)
        library.plant_library_set_inputs(plant, -2.01, machine.supply_voltage_V)
        library.plant_advance(plant, round(2.0 * stop_s * 1e9) + 1_000_000)
        free = read(library, plant)
    assert stopped.speed_rad_s == held.speed_rad_s == 0.0
    assert stopped.rotor_angle_rad == held.rotor_angle_rad
    assert stopped.energy_friction_J == pytest.approx(0.5 * machine.inertia_kg_m2 * 2.0**2, rel=1e-6)
    assert free.speed_rad_s == pytest.approx((2.01 - 0.5) / machine.inertia_kg_m2 * 1e-3, rel=1e-6)
