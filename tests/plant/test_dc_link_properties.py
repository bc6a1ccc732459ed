"""Properties of the emulated plant on a DC link over random machines, links, sags, patterns and speeds.

Random cases are compared with an independent integration (link_reference.py). The capacitor takes rated current for
between 5 us and 5 ms per 1 % of the supply voltage, the source drops between 0.2 % and 20 %, and the supply sags and
comes back. Deviations as in test_plant_properties.py, the DC-link voltage's relative to the supply voltage.

Every case is drawn from (seed, number) alone: SALIENT_PLANT_SEED gives another seed, SALIENT_PLANT_CASES more cases,
and a failure names the case.
"""

from __future__ import annotations

import ctypes
import math
import os
from dataclasses import replace

import numpy as np
import pytest
from link_reference import LinkReference
from reference_plant import SAMPLE, Converter, DcLink, Run, State, load_library, plant_of, set_switches
from test_energy_balance import BalanceTerms
from test_plant_properties import FORMS, SEED, Case, random_machine, random_pattern

pytestmark = pytest.mark.in_turns

CASES = int(os.environ.get("SALIENT_PLANT_CASES", "36"))
PERIODS = 20
BOUND = 1e-5
ENERGY_BOUND = 1e-6


def case_of(number: int, ticks: int = 0) -> tuple[Case, list[float]]:
    """Machine and run, and the supply voltage in each period. With `ticks`: single pulses in periods of that length."""
    draw = np.random.default_rng([SEED, 7, number])

    def spread(low: float, high: float) -> float:
        return float(math.exp(draw.uniform(math.log(low), math.log(high))))

    machine = random_machine(draw, FORMS[number % len(FORMS)])
    supply_V = machine.supply_voltage_V
    rated_A = supply_V * 100e-6 / machine.magnetics.unaligned_inductance_H
    if draw.random() < 0.7:
        ohm = 0.01 * supply_V / rated_A
        machine.converter = Converter(0.01 * supply_V, 0.5 * ohm, 0.005 * supply_V, ohm, 0.0)
    machine.dc_link = DcLink(
        capacitance_F=rated_A * spread(5e-6, 5e-3) / (0.01 * supply_V),
        source_resistance_ohm=spread(2e-3, 0.2) * supply_V / rated_A,
        chopper_resistance_ohm=float(draw.choice([0.0, 0.5 * supply_V / rated_A, 2.0 * supply_V / rated_A])),
        chopper_on_V=1.02 * supply_V,
        chopper_off_V=1.01 * supply_V,
    )
    edges, ticks = ticks == 0 and draw.random() < 0.7, ticks or int(draw.choice([1000, 2500, 5000]))
    run = Run(
        period_ticks=ticks,
        compares=random_pattern(draw, machine, rated_A, ticks, edges),
        speed_rad_s=float(draw.choice([0.0, *draw.uniform(-300.0, 300.0, 4)])),
        angle_deg=float(draw.uniform(-360.0, 360.0)),
        load_torque_Nm=float(draw.uniform(-1.0, 1.0)) * machine.inertia_kg_m2 * 1000.0,
        currents_A=[float(draw.choice([0.0, draw.uniform(0.0, rated_A)])) for _ in range(machine.phases)],
    )
    sag_V = supply_V * float(draw.choice([1.0, 0.9, 0.6]))
    begins, ends = sorted(draw.integers(0, PERIODS, 2))
    supplies_V = [sag_V if begins <= period < ends else supply_V for period in range(PERIODS)]
    return Case(number, machine, run), supplies_V


def run_plant(library: ctypes.CDLL, case: Case, supplies_V: list[float], factor: float = 1.0, sample_ns: int = 0
              ) -> tuple[np.ndarray, State, State, list[tuple[float, ...]]]:
    """Speed, angle, DC-link voltage and currents at the start of each period; states at start and end; samples."""
    first, state, seen, samples = State(), State(), State(), []
    rows: list[list[float]] = []

    def sample(_: int, address: int) -> None:
        library.plant_library_read(address, ctypes.byref(seen))
        samples.append((round(seen.time_s * 1e9), seen.speed_rad_s, seen.rotor_angle_rad, seen.bus_voltage_V,
                        *seen.current_A[: case.machine.phases]))

    callback = SAMPLE(sample)
    with plant_of(library, case.machine, case.run) as plant:
        library.plant_set_step_factor(plant, factor)
        library.plant_library_read(plant, ctypes.byref(first))
        if sample_ns:
            library.plant_observe(plant, 0, sample_ns, callback, None)
        for period, compares in enumerate(case.run.compares):
            library.plant_library_read(plant, ctypes.byref(state))
            rows.append(_row(state, case))
            library.plant_library_set_inputs(plant, case.run.load_torque_Nm, supplies_V[period])
            set_switches(library, plant, compares, case.run.period_ticks)
            library.plant_advance(plant, (period + 1) * case.run.period_ns)
        library.plant_library_read(plant, ctypes.byref(state))
        rows.append(_row(state, case))
    return np.array(rows), first, state, samples


def _row(state: State, case: Case) -> list[float]:
    currents_A = state.current_A[: case.machine.phases]
    return [state.speed_rad_s, state.rotor_angle_rad, state.bus_voltage_V, *currents_A]


def run_reference(case: Case, supplies_V: list[float]) -> np.ndarray:
    reference = LinkReference(case.machine, case.run)
    rows = [reference.row()]
    for period, supply_V in enumerate(supplies_V):
        reference.supply_V = supply_V
        reference.advance_period(period)
        rows.append(reference.row())
    return np.array(rows)


def deviation(case: Case, measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Deviation of speed, angle, DC-link voltage and currents."""
    magnitude = np.max(np.abs(expected), axis=0)
    magnitude[1] = magnitude[0] * PERIODS * case.run.period_ns * 1e-9
    magnitude[0] = np.ptp(expected[:, 0])
    magnitude[2] = case.machine.supply_voltage_V
    magnitude[3:] = max(np.max(magnitude[3:]), 1e-9)
    return np.max(np.abs(measured - expected), axis=0) / np.maximum(magnitude, 1e-12)


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


@pytest.fixture(scope="module")
def cases() -> list[tuple[Case, list[float], np.ndarray]]:
    """The cases with the results of the reference."""
    drawn = [case_of(number) for number in range(CASES)]
    return [(case, supplies_V, run_reference(case, supplies_V)) for case, supplies_V in drawn]


def test_plant_on_a_link_agrees_with_scipy(library: ctypes.CDLL,
                                           cases: list[tuple[Case, list[float], np.ndarray]]) -> None:
    wrong, worst = [], []
    for case, supplies_V, expected in cases:
        off = deviation(case, run_plant(library, case, supplies_V)[0], expected)
        worst.append(float(np.max(off)))
        if not worst[-1] < BOUND:
            wrong.append(f"{off}\n{case}")
    print(f"seed {SEED}: worst {max(worst):.1e}, median {np.median(worst):.1e}")
    assert not wrong, "\n".join(wrong)
    # The cases cover voltages that sag, rise beyond the chopper's threshold and hardly change.
    ranges = [float(np.ptp(expected[:, 2])) / case.machine.supply_voltage_V for case, _, expected in cases]
    assert min(ranges) < 5e-3 and max(ranges) > 0.1


def test_energy_balances_close_on_random_links(library: ctypes.CDLL) -> None:
    chopped, worst = 0, 0.0
    for number in range(10 * CASES):
        case, supplies_V = case_of(number)
        _, first, state, _ = run_plant(library, case, supplies_V)
        before, now = BalanceTerms(first), BalanceTerms(state)
        turnover_J = state.energy_drawn_J + state.energy_returned_J + before.stored
        machine_J = now.net - (now.consumed - before.consumed) - (now.stored - before.stored)
        link_J = now.supplied - now.net - (now.link - before.link)
        chopped += state.energy_chopper_J > 0.0
        worst = max(worst, abs(machine_J) / turnover_J, abs(link_J) / turnover_J)
        assert abs(machine_J) < ENERGY_BOUND * turnover_J, f"{machine_J} J of {turnover_J} J\n{case}"
        assert abs(link_J) < ENERGY_BOUND * turnover_J, f"{link_J} J of {turnover_J} J\n{case}"
    print(f"seed {SEED}: worst {worst:.1e}, {chopped} with an active chopper")
    assert chopped > CASES


def test_error_on_a_link_falls_with_the_fourth_power_of_the_step(library: ctypes.CDLL) -> None:
    """Periods of 200 us with whole pulses, without chopper and sags, so that the step limits determine the steps;
    against steps sixteen times finer."""
    ratios = []
    for number in range(CASES // 2):
        case, supplies_V = case_of(number, ticks=20_000)
        case.machine.dc_link.chopper_resistance_ohm = 0.0
        case = replace(case, run=replace(case.run, compares=case.run.compares[:4]))
        expected = run_plant(library, case, supplies_V[:1] * 4, 0.0625)[0]
        coarse, fine = (float(np.max(deviation(case, run_plant(library, case, supplies_V[:1] * 4, factor)[0],
                                               expected))) for factor in (2.0, 1.0))
        if fine > 1e-10:
            ratios.append(coarse / fine)
    print(np.percentile(ratios, [10, 25, 50, 75, 90]), len(ratios))
    assert len(ratios) > CASES / 6
    assert 12.0 < float(np.median(ratios)) < 22.0


def test_observing_a_link_changes_no_bit(library: ctypes.CDLL) -> None:
    for number in range(CASES):
        case, supplies_V = case_of(number)
        plain, _, _, _ = run_plant(library, case, supplies_V)
        observed, _, _, samples = run_plant(library, case, supplies_V, sample_ns=case.run.period_ns // 8)
        assert np.array_equal(plain, observed), str(case)
        at_starts = np.array([values[1:] for at_ns, *values in [(row[0], *row) for row in samples]
                              if at_ns % case.run.period_ns == 0])
        assert np.array_equal(at_starts, plain), str(case)
