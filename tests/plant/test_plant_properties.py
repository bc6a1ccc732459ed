"""Properties of the emulated plant over random machines, speeds, switching patterns, loads and initial states.

Random cases are compared with an independent integration (batch_plant.py: DOP853 at a tolerance of 1e-12). Deviations
are relative to the largest magnitude of the quantity in the case; of the speed to its change, of the angle to
the angle travelled at the largest speed. Measured on x86-64 with gcc 12: at most 8.2e-6 over 5400 cases of six seeds
(a speed that hardly changes; currents, torques and fluxes 6e-6), 4e-9 in the median.

Every case is drawn from (seed, number) alone: SALIENT_PLANT_SEED gives another seed, and a failure names the case.
"""

from __future__ import annotations

import ctypes
import math
import os
from dataclasses import dataclass

import numpy as np
import pytest
from batch_plant import run_batch
from reference_plant import (
    FORMS,
    TICK_NS,
    Compares,
    Machine,
    Magnetics,
    Run,
    Trace,
    load_library,
    run_plant,
    run_reference,
)

pytestmark = pytest.mark.in_turns

SEED = int(os.environ.get("SALIENT_PLANT_SEED", "20250611"))
CASES = 900
PERIODS = 20
BOUND = 1e-5
ROUNDING = 1e-11
POLES = ((6, 4, 3), (8, 6, 4), (12, 8, 3))
QUANTITIES = ("speed", "angle", "torque", "currents", "fluxes")


@dataclass(frozen=True)
class Case:
    number: int
    machine: Machine
    run: Run

    def __str__(self) -> str:
        def fields(structure: ctypes.Structure) -> str:
            values = ((name, getattr(structure, name)) for name, *_ in structure._fields_)
            return ", ".join(f"{k}={fields(v) if isinstance(v, ctypes.Structure) else repr(v)}" for k, v in values)

        return f"case {self.number} of seed {SEED}: {fields(self.machine)}; {self.run}"


def random_machine(draw: np.random.Generator, form: str) -> Machine:
    """A machine for a random rated current and supply; its other data follow from random time constants, so that any
    combination is a plausible machine."""

    def spread(low: float, high: float) -> float:
        return float(math.exp(draw.uniform(math.log(low), math.log(high))))

    stator, rotor, phases = POLES[draw.integers(len(POLES))]
    rated_A, supply_V = spread(2.0, 200.0), spread(24.0, 500.0)
    unaligned_H = supply_V * spread(20e-6, 500e-6) / rated_A
    aligned_H = unaligned_H * spread(3.0, 40.0)
    saturated_H = unaligned_H * spread(0.05, 1.0)
    knee_A = rated_A * spread(0.2, 2.0)
    rated_Nm = 0.5 * (aligned_H - unaligned_H) * rated_A**2 / (math.pi / rotor)
    if form == "saturating":
        rated_Nm *= min(1.0, 2.0 * knee_A / rated_A)
    inertia_kg_m2 = rated_Nm / spread(100.0, 20e3)
    half_deg = 180.0 / rotor
    saturating, trapezoid = form == "saturating", form == "linear_trapezoid"
    most_A = 10.0 * knee_A
    return Machine(
        name=form.encode(),
        stator_poles=stator,
        rotor_poles=rotor,
        phases=phases,
        resistance_ohm=supply_V / rated_A * spread(1e-3, 1.0),
        inertia_kg_m2=inertia_kg_m2,
        friction_Nm_s=inertia_kg_m2 / spread(100e-6, 100.0),
        supply_voltage_V=supply_V,
        magnetics=Magnetics(
            form=FORMS.index(form),
            unaligned_inductance_H=unaligned_H,
            aligned_inductance_H=aligned_H,
            flat_deg=half_deg * draw.uniform(0.0, 0.1) if trapezoid else 0.0,
            blend_deg=half_deg * draw.uniform(0.01, 0.3) if trapezoid else 0.0,
            saturated_inductance_H=saturated_H if saturating else 0.0,
            flux_linkage_max_Wb=saturated_H * most_A + (aligned_H - saturated_H) * knee_A if saturating else 0.0,
            current_at_flux_linkage_max_A=most_A if saturating else 0.0,
        ),
    )


def random_pattern(
    draw: np.random.Generator, machine: Machine, rated_A: float, ticks: int, edges: bool
) -> list[Compares]:
    """Compare values that stay for some periods and then change: off, on or, with edges, partial. A phase that has had
    1.5 times the volt-seconds of its rated current (unaligned) is switched off."""
    compares: list[Compares] = []
    most_s = 1.5 * rated_A * machine.magnetics.unaligned_inductance_H / machine.supply_voltage_V
    given_s, values = [0.0] * machine.phases, [(0, 0)] * machine.phases
    for _ in range(PERIODS):
        for phase in range(machine.phases):
            if draw.random() < 0.3:
                choice = [0, ticks, draw.integers(1, ticks + 1)] if edges else [0, ticks]
                values[phase] = (int(draw.choice(choice)), int(draw.choice(choice)))
            upper, lower = values[phase]
            net_s = 2 * TICK_NS * 1e-9 * (min(upper, ticks) + min(lower, ticks) - ticks)
            if given_s[phase] + net_s > most_s:
                values[phase], net_s = (0, 0), -2 * TICK_NS * 1e-9 * ticks
            given_s[phase] = max(0.0, given_s[phase] + net_s)
        compares.append(([upper for upper, _ in values], [lower for _, lower in values]))
    return compares


def case_of(number: int, ticks: int = 0) -> Case:
    """With `ticks`: the length of a period, without switch edges within it."""
    draw = np.random.default_rng([SEED, number])
    form = FORMS[number * len(FORMS) // CASES]
    machine = random_machine(draw, form)
    rated_A = machine.supply_voltage_V * 100e-6 / machine.magnetics.unaligned_inductance_H
    rated_Nm = machine.inertia_kg_m2 * 1000.0
    edges, ticks = ticks == 0, ticks or int(draw.choice([1000, 2000, 2500, 5000]))
    run = Run(
        period_ticks=ticks,
        compares=random_pattern(draw, machine, rated_A, ticks, edges),
        speed_rad_s=float(draw.choice([0.0, draw.uniform(-20.0, 20.0), *draw.uniform(-300.0, 300.0, 3)])),
        angle_deg=float(draw.uniform(-360.0, 360.0)),
        load_torque_Nm=float(draw.uniform(-1.0, 1.0)) * rated_Nm,
        currents_A=[float(draw.choice([0.0, draw.uniform(0.0, rated_A)])) for _ in range(machine.phases)],
    )
    return Case(number, machine, run)


def deviation(measured: Trace, expected: Trace) -> dict[str, float]:
    assert np.array_equal(measured["time_ns"], expected["time_ns"])
    magnitude = {name: float(np.max(np.abs(expected[name]))) for name in QUANTITIES}
    magnitude["angle"] = magnitude["speed"] * 1e-9 * float(expected["time_ns"][-1])
    magnitude["speed"] = float(np.ptp(expected["speed"]))
    # Without any current there is no torque either.
    return {name: float(np.max(np.abs(measured[name] - expected[name]))) / max(largest, 1e-12)
            for name, largest in magnitude.items()}


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


@pytest.fixture(scope="module")
def cases() -> list[tuple[Case, Trace]]:
    """The cases with the results of the reference."""
    print(f"seed {SEED}")
    drawn = [case_of(number) for number in range(CASES)]
    expected = run_batch([case.machine for case in drawn], [case.run for case in drawn])
    return list(zip(drawn, expected, strict=True))


def test_batch_reference_agrees_with_scipy(cases: list[tuple[Case, Trace]]) -> None:
    for case, trace in cases[:: CASES // 6]:
        expected, _ = run_reference(case.machine, case.run)
        worst = deviation(trace, expected)
        assert max(worst.values()) < 1e-9, f"{worst}\n{case}"


def test_plant_agrees_with_the_batch_reference(library: ctypes.CDLL, cases: list[tuple[Case, Trace]]) -> None:
    wrong = []
    for case, expected in cases:
        worst = deviation(run_plant(library, case.machine, case.run)[0], expected)
        if not max(worst.values()) < BOUND:
            wrong.append(f"{worst}\n{case}")
    assert not wrong, "\n".join(wrong)


def test_error_falls_with_the_fourth_power_of_the_step(library: ctypes.CDLL) -> None:
    # Periods of 200 us with whole pulses, so that the step limits determine the step, not the switch edges.
    drawn = [case_of(number, ticks=20_000) for number in range(0, CASES, 6)]
    ratios = []
    expected = run_batch([case.machine for case in drawn], [case.run for case in drawn])
    for case, trace in zip(drawn, expected, strict=True):
        coarse, fine = (
            max(deviation(run_plant(library, case.machine, case.run, factor)[0], trace).values()) for factor in (1, 0.5)
        )
        if fine > ROUNDING:
            ratios.append(coarse / fine)
    assert len(ratios) > len(drawn) / 2
    assert 12.0 < float(np.median(ratios)) < 20.0, np.percentile(ratios, [10, 25, 50, 75, 90])
