"""The emulated plant against ngspice: one phase on its asymmetric half bridge, at constant speed.

An independent check: ngspice solves a circuit of switch and diode elements (half_bridge.cir) with
its own integration; commutation and the end of conduction follow from the elements, the flux linkage from behavioural
sources (netlists: tools/src/salient/spice). Both sides have the data of the bundled machines and the same switch
edges, over two electrical periods. The plant's speed is held by a huge inertia.

Deviations are relative to the largest magnitude in the run. Measured with ngspice 39: current at most 3.9e-4, flux
linkage 8.2e-5 (soft chopping of the saturating machine), without saturation 3.2e-5 and 4.7e-5; halving the step of
ngspice changes it little, a smaller diode resistance does: it is caused by the diode drop, absent in the emulator.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from reference_plant import FORMS, TICK_NS, Compares, Machine, Run, load_library, machine_from, run_plant

from salient.machine import file as machine_file
from salient.machine.file import load_machine
from salient.paths import MACHINES
from salient.reference import ngspice

pytestmark = pytest.mark.in_turns

PERIOD_TICKS = 1000  # 100 kHz: hard chopping is by whole periods
ELECTRICAL_PERIODS = 2
SAMPLE_NS = 1000
SPICE_STEP_NS = 200
RAMP_NS = 1  # transition of a gate signal, ends at the edge, where the switch acts
NGSPICE_PROCESSOR_S = 60
CONSTANT_SPEED_INERTIA_KG_M2 = 1e9

BOUND = 1e-3
MINIMUM_PULSES = {"single_pulse": 2, "hard_chopping": 200, "soft_chopping": 600}  # pulses of the upper switch
PATTERNS = tuple(MINIMUM_PULSES)


@dataclass(frozen=True)
class Waveforms:
    """Waveforms of one phase, all of the same length."""

    time_s: np.ndarray
    current_A: np.ndarray
    flux_linkage_Wb: np.ndarray


# --- Runs ---


def compare_values(pattern: str, period: int, angle_deg: float) -> tuple[int, int]:
    """(upper, lower) of the phase in a control period that starts at a phase angle; 45 degrees is unaligned."""
    full = PERIOD_TICKS
    electrical_period, position_deg = divmod(angle_deg, 90.0)
    if pattern == "single_pulse":
        return (full, full) if 42.0 <= position_deg < 62.0 else (0, 0)
    if not 45.0 <= position_deg < 75.0:
        return 0, 0
    if pattern == "hard_chopping":
        return (full, full) if 7 * period % 10 < 7 else (0, 0)
    if electrical_period == 0:
        return 300 + period % 177, full
    # Both partial: two pulses and two freewheels in each period, through the upper and the lower path in turn.
    return 690 + period % 31, 690 + period % 37


def run_of(machine: Machine, pattern: str) -> Run:
    speed_rad_s = 250.0 if pattern == "single_pulse" else 150.0
    start_deg = 35.0
    period_ns = 2 * PERIOD_TICKS * TICK_NS
    periods = math.ceil(ELECTRICAL_PERIODS * 2 * math.pi / machine.rotor_poles / speed_rad_s / (period_ns * 1e-9))
    compares: list[Compares] = []
    for period in range(periods):
        angle_deg = start_deg + math.degrees(speed_rad_s * period * period_ns * 1e-9)
        upper, lower = compare_values(pattern, period, angle_deg)
        compares.append(([upper], [lower]))
    return Run(PERIOD_TICKS, compares, speed_rad_s, start_deg, load_torque_Nm=0.0)


# --- The plant ---


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


def machine_of(bundled: machine_file.Machine) -> Machine:
    """The plant's machine at constant speed."""
    machine = machine_from(bundled)
    machine.inertia_kg_m2, machine.friction_Nm_s = CONSTANT_SPEED_INERTIA_KG_M2, 0.0
    return machine


def plant_waveforms(library: ctypes.CDLL, machine: Machine, run: Run) -> Waveforms:
    trace, end = run_plant(library, machine, run, sample_ns=SAMPLE_NS)
    assert abs(end.speed_rad_s / run.speed_rad_s - 1.0) < 1e-9, "the speed is to be constant"
    return Waveforms(trace["time_ns"] * 1e-9, trace["currents"][0], trace["fluxes"][0])


# --- ngspice ---


def gate_pulses(run: Run) -> tuple[list[list[int]], list[list[int]]]:
    """[from, to] in ns of each pulse of the upper and of the lower switch of the phase, as hal_pwm.h defines them:
    the upper's pulse lies around the middle of a control period, the lower's is split over its two ends."""
    upper_pulses: list[list[int]] = []
    lower_pulses: list[list[int]] = []

    def add(pulses: list[list[int]], from_ns: int, to_ns: int) -> None:
        if pulses and pulses[-1][1] == from_ns:
            pulses[-1][1] = to_ns
        elif from_ns < to_ns:
            pulses.append([from_ns, to_ns])

    for period, ((upper,), (lower,)) in enumerate(run.compares):
        start_ns = period * run.period_ns
        middle_ns, end_ns = start_ns + run.period_ns // 2, start_ns + run.period_ns
        add(upper_pulses, middle_ns - upper * TICK_NS, middle_ns + upper * TICK_NS)
        add(lower_pulses, start_ns, start_ns + lower * TICK_NS)
        add(lower_pulses, end_ns - lower * TICK_NS, end_ns)
    return upper_pulses, lower_pulses


def gate_source(name: str, pulses: Sequence[Sequence[int]]) -> list[str]:
    lines = [f"Vgate_{name} gate_{name} 0 PWL(0 0"]
    for on_ns, off_ns in pulses:
        lines.append(f"+ {on_ns - RAMP_NS}n 0 {on_ns}n 1 {off_ns - RAMP_NS}n 1 {off_ns}n 0")
    return [*lines, "+ )"]


def deck(machine: machine_file.Machine, run: Run) -> list[str]:
    """A complete netlist; the phase itself is in the included files."""
    upper_pulses, lower_pulses = gate_pulses(run)
    end_ns = len(run.compares) * run.period_ns
    return [
        f"One phase, {machine.magnetics.form}",
        *ngspice.machine_lines(machine, "half_bridge"),
        *gate_source("upper", upper_pulses),
        *gate_source("lower", lower_pulses),
        "Xphase dc gate_upper gate_lower turns phase",
        f"Bturns turns 0 V = ({run.angle_deg!r} / 360 + {run.speed_rad_s!r} * time / (2 * pi)) * rotor_poles",
        ngspice.OPTIONS,
        ".save i(v.xphase.vcurrent) v(xphase.flux_linkage)",
        f".tran {SPICE_STEP_NS}n {end_ns}n 0 {SPICE_STEP_NS}n",
        ".end",
    ]


def spice_waveforms(folder: Path, netlist: list[str]) -> Waveforms:
    """At the time points that ngspice chose."""
    try:
        found = ngspice.run(folder, netlist, NGSPICE_PROCESSOR_S)
    except ngspice.NgspiceError as error:
        pytest.fail(str(error), pytrace=False)
    return Waveforms(found.time_s, found.values["i(v.xphase.vcurrent)"], found.values["v(xphase.flux_linkage)"])


# --- The tests ---


def deviation(measured: Waveforms, expected: Waveforms) -> dict[str, float]:
    """Largest deviation of each quantity from ngspice's over the whole run, relative to its largest magnitude."""
    worst = {}
    for name in ("current_A", "flux_linkage_Wb"):
        values = getattr(expected, name)
        at_samples = np.interp(measured.time_s, expected.time_s, values)
        worst[name] = float(np.max(np.abs(getattr(measured, name) - at_samples)) / np.max(np.abs(values)))
    return worst


def conduction_ends_s(waveforms: Waveforms) -> np.ndarray:
    """The first sample of each pause, in which the plant's current is exactly 0."""
    conducts = waveforms.current_A > 0.0
    return waveforms.time_s[1:][conducts[:-1] & ~conducts[1:]]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_current_and_flux_linkage_agree(library: ctypes.CDLL, tmp_path: Path, pattern: str, form: str) -> None:
    bundled = load_machine(MACHINES / f"{form}.toml")
    machine = machine_of(bundled)
    run = run_of(machine, pattern)
    expected = spice_waveforms(tmp_path, deck(bundled, run))
    measured = plant_waveforms(library, machine, run)

    # The comparison covers enough samples.
    turn_rad = run.speed_rad_s * measured.time_s[-1]
    assert turn_rad >= ELECTRICAL_PERIODS * 2 * math.pi / machine.rotor_poles
    assert expected.time_s[-1] == pytest.approx(measured.time_s[-1], abs=1e-12)
    assert len(measured.time_s) == len(run.compares) * run.period_ns // SAMPLE_NS + 1 > 10_000
    assert np.max(np.diff(expected.time_s)) < 1.01e-9 * SPICE_STEP_NS
    assert np.max(expected.current_A) > 25.0
    assert np.max(expected.flux_linkage_Wb) > 0.2
    assert len(gate_pulses(run)[0]) >= MINIMUM_PULSES[pattern]
    ends_s = conduction_ends_s(measured)
    assert len(ends_s) == ELECTRICAL_PERIODS and ends_s[-1] < 0.99 * measured.time_s[-1]
    pauses = np.interp(ends_s + SAMPLE_NS * 1e-9, expected.time_s, expected.current_A)
    assert np.all(np.abs(pauses) < 1e-4 * np.max(expected.current_A)), "ngspice's diodes block as well"

    worst = deviation(measured, expected)
    assert max(worst.values()) < BOUND, worst


def test_wrong_inductance_is_detected(library: ctypes.CDLL, tmp_path: Path) -> None:
    """The comparison is sensitive: an unaligned inductance 1 % too large in ngspice alone exceeds the bound."""
    bundled = load_machine(MACHINES / "saturating.toml")
    right = bundled.magnetics.parameters
    wrong = {**right, "unaligned_inductance_H": 1.01 * right["unaligned_inductance_H"]}
    machine = machine_of(bundled)
    run = run_of(machine, "single_pulse")
    netlist = deck(replace(bundled, magnetics=replace(bundled.magnetics, parameters=wrong)), run)
    expected = spice_waveforms(tmp_path, netlist)
    assert deviation(plant_waveforms(library, machine, run), expected)["current_A"] > BOUND
