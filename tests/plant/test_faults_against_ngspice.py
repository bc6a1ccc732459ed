"""The plant with faults against ngspice: one phase on its half bridge at constant speed, as in
test_plant_against_ngspice.py, whose netlist is changed as the fault changes the circuit.

open winding     a switch in series with the winding opens under current; a source of twice the supply is its arc
shorted switch   an ideal switch in parallel with the upper one closes
open diode       none; a source of twice the supply is the avalanche of the lower switch
shorted turns    a second winding of a part k of the turns, short-circuited, on the same flux

Deviations are relative to the largest current in the run.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from plant_faults import Faults, Switches, read, set_faults, turns
from reference_plant import Run, load_library, plant_of, set_switches
from test_plant_against_ngspice import BOUND, NGSPICE_PROCESSOR_S, SPICE_STEP_NS, deck, machine_of, run_of

from salient.machine.file import load_machine
from salient.paths import MACHINES
from salient.reference import ngspice

pytestmark = pytest.mark.in_turns

START_NS = {"single_pulse": 7_333_000, "hard_chopping": 13_383_000}  # in the second electrical period, under current
SAMPLES_NS = (1237, 3331, 5003, 7777)  # within each control period, on no edge
SHORTED = 0.1
SHOWS = 0.05  # of the peak, at least, between the faulty and the healthy plant

Change = Callable[[str, int], str]


@dataclass(frozen=True)
class Case:
    """A fault in the plant and in the netlist. starts: at START_NS, otherwise present all the time."""

    faults: Faults
    change: Change
    starts: bool


def fault_gate(start_ns: int, before: int, after: int) -> str:
    return f"Vgate_fault gate_fault 0 PWL(0 {before} {start_ns - 1}n {before} {start_ns}n {after})"


def open_winding(netlist: str, start_ns: int) -> str:
    netlist = netlist.replace(
        "Rwinding upper winding",
        "Sbreak upper broken gate_fault 0 ideal_switch on\n"
        "Darc upper arc ideal_diode\n"
        "Varc arc broken {2 * supply_V}\n"
        "Rwinding broken winding",
    )
    return netlist.replace("*FAULT*", fault_gate(start_ns, 1, 0))


def shorted_switch(netlist: str, start_ns: int) -> str:
    netlist = netlist.replace("Supper dc", "Sshorted dc upper gate_fault 0 ideal_switch off\nSupper dc")
    return netlist.replace("*FAULT*", fault_gate(start_ns, 0, 1))


def open_diode(netlist: str, start_ns: int) -> str:
    return netlist.replace("Dupper lower dc    ideal_diode",
                           "Davalanche lower avalanche ideal_diode\nVavalanche avalanche 0 {2 * supply_V}")


def shorted_turns(netlist: str, start_ns: int) -> str:
    loop = f"Hloop loop 0 Vflux_rate {SHORTED}\nRloop loop looped {{{SHORTED} * resistance_ohm}}\nVloop looped 0 0\n"
    netlist = netlist.replace("{resistance_ohm}", f"{{{1 - SHORTED} * resistance_ohm}}")
    netlist = netlist.replace("Vflux_rate 1\n", f"Vflux_rate {1 - SHORTED}\n{loop}")
    return netlist.replace("I(Vcurrent)", f"({1 - SHORTED} * I(Vcurrent) - {SHORTED} * I(Vloop))")


CASES = {
    "open winding": Case(Faults(winding_open=1), open_winding, True),
    "shorted switch": Case(Faults(switch_shorted=Switches(1, 0)), shorted_switch, True),
    "open diode": Case(Faults(diode_open=Switches(1, 0)), open_diode, False),
    "shorted turns": Case(turns(a=SHORTED), shorted_turns, False),
}


def flat(lines: list[str]) -> str:
    """A netlist with its included files in place."""
    text = []
    for line in lines:
        if line.startswith(".include"):
            text.append(Path(line.split('"')[1]).read_text())
        else:
            text.append(line)
    return "\n".join(text)


def plant_currents(library: ctypes.CDLL, form: str, run: Run, faults: Faults, fault_ns: int
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and currents at the terminals."""
    machine = machine_of(load_machine(MACHINES / f"{form}.toml"))
    time_ns, current_A = [], []
    with plant_of(library, machine, run) as plant:
        if fault_ns == 0:
            set_faults(library, plant, faults)
        for period, compares in enumerate(run.compares):
            start_ns = period * run.period_ns
            set_switches(library, plant, compares, run.period_ticks)
            for sample_ns in SAMPLES_NS:
                at_ns = start_ns + sample_ns
                if start_ns <= fault_ns <= at_ns:
                    library.plant_advance(plant, fault_ns)
                    set_faults(library, plant, faults)
                library.plant_advance(plant, at_ns)
                time_ns.append(at_ns)
                current_A.append(read(library, plant).current_A[0])
            library.plant_advance(plant, start_ns + run.period_ns)
    return np.array(time_ns) * 1e-9, np.array(current_A)


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


RUNS = [(name, pattern) for name in CASES for pattern in START_NS]
RUNS.remove(("shorted switch", "hard_chopping"))  # ngspice takes minutes to converge where both switches' paths conduct


@pytest.mark.parametrize("form", ["linear_cosine", "saturating"])
@pytest.mark.parametrize(("name", "pattern"), RUNS)
def test_current_under_a_fault_agrees(library: ctypes.CDLL, tmp_path: Path, name: str, pattern: str, form: str) -> None:
    case = CASES[name]
    bundled = load_machine(MACHINES / f"{form}.toml")
    fault_ns = START_NS[pattern] if case.starts else 0
    run = run_of(machine_of(bundled), pattern)
    lines = deck(bundled, run)
    healthy = flat([lines[0], f".param supply_V = {bundled.supply_voltage_V!r}", ".global gate_fault",
                    *lines[1:-1], "*FAULT*", lines[-1]])
    netlist = case.change(healthy, fault_ns)
    assert netlist != healthy
    try:
        found = ngspice.run(tmp_path, netlist.split("\n"), NGSPICE_PROCESSOR_S)
    except ngspice.NgspiceError as error:
        pytest.fail(str(error), pytrace=False)
    time_s, current_A = plant_currents(library, form, run, case.faults, fault_ns)
    expected_A = np.interp(time_s, found.time_s, found.values["i(v.xphase.vcurrent)"])
    assert np.max(np.diff(found.time_s)) < 1.01e-9 * SPICE_STEP_NS
    assert math.isclose(found.time_s[-1], len(run.compares) * run.period_ns * 1e-9)

    healthy_A = plant_currents(library, form, run, Faults(), 0)[1]
    peak_A = np.max(np.abs(expected_A))
    assert np.max(np.abs(current_A - healthy_A)) > SHOWS * peak_A, "the fault shows"
    deviation = np.max(np.abs(current_A - expected_A)) / peak_A
    print(f"{name}, {pattern}, {form}: {deviation:.1e} of {peak_A:.0f} A", end="")
    assert deviation < BOUND
