"""The flux-linkage map of tools/machines/finite_element.csv, computed from a geometry and a magnetisation curve.

    build/venv/bin/python -m salient.finite_elements OUT.csv
    build/venv/bin/python -m salient.finite_elements --coupling

The field at every position and current by solver.py, on the cross section of mesh.py (its Geometry), with
the steel of steel.py. machine_data gives the motor's other keys in that machine's file. Takes about four
minutes of processor time, on all cores.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from salient.finite_elements import steel
from salient.finite_elements.mesh import COIL_PLUS, IRON, Geometry
from salient.finite_elements.solver import Machine
from salient.machine.file import load_machine
from salient.machine.flux_map import FluxMap
from salient.paths import MACHINES
from salient.workers import process_pool

ANGLE_STEP_DEG = 0.5

# Closer where the iron saturates.
CURRENTS_A = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 18, 20, 22, 25, 28, 32, 36, 40, 45, 50, 56, 62, 68, 74, 80)

COUPLING_ANGLES_DEG = tuple(range(0, 60, 5))
COUPLING_CURRENTS_A = (5, 10, 20, 40, 60)

# Copper at 75 deg C; of a coil side's area the conductors fill this fraction.
_COPPER_OHM_M = 2.1e-8
_FILL_FACTOR = 0.45

_SHAFT_KG_M3 = 7850.0


def solutions(machine: Machine, angle_deg: float,
              currents_A: Sequence[float] = CURRENTS_A) -> Iterator[tuple[float, float]]:
    """(flux linkage in Wb, torque in N m by Maxwell's stress) at one position and each of the rising currents."""
    position = machine.at(angle_deg)
    before_A, at_A, before, potential = 0.0, 0.0, None, None
    for current_A in currents_A:
        start = None
        if before is not None:  # straight on from the last two
            start = potential + (potential - before) * ((current_A - at_A) / (at_A - before_A))
        before_A, at_A, before = at_A, current_A, potential
        potential = position.solve(current_A, start)
        yield position.flux_linkage_Wb(potential), position.torque_Nm(potential)


def flux_linkages_Wb(geometry: Geometry, angle_deg: float) -> list[float]:
    """At the currents CURRENTS_A."""
    return [flux_Wb for flux_Wb, _ in solutions(Machine(geometry), angle_deg)]


def neighbour_share(geometry: Geometry, flux_map: FluxMap, angles_deg: Sequence[float] = COUPLING_ANGLES_DEG
                    ) -> tuple[float, float]:
    """Key coupling.neighbours of a machine file, of phases on two poles of one polarity, and the RMS deviation from
    the field's flux linkage of the other phase, relative to the largest of these.

    A phase alone, at a current i, gives its neighbour k (psi(theta, i) + L(theta') i) to first order in the share k
    (emulator/plant/coupled.h), with its own flux linkage psi and the neighbour's inductance L: k by least squares.
    """
    machine = Machine(geometry)
    pitch_rad = flux_map.pitch_rad
    seen_Wb, first_Wb = [], []
    for angle_deg in angles_deg:
        position, before_A = machine.at(angle_deg), 0.0
        potential: np.ndarray | None = None
        for current_A in COUPLING_CURRENTS_A:
            start = None if potential is None else potential * (current_A / before_A)
            potential, before_A = position.solve(current_A, start), current_A
            other_deg = angle_deg - 360.0 / geometry.stator_poles
            own, inductance_H = (
                float(flux_map.flux_linkage_Wb(math.remainder(math.radians(angle), pitch_rad), of_A)) / of_A
                for angle, of_A in ((angle_deg, current_A), (other_deg, COUPLING_CURRENTS_A[0])))
            seen_Wb.append(position.flux_linkage_of_Wb(1, potential))
            first_Wb.append((own + inductance_H) * current_A)
    seen, first = np.array(seen_Wb), np.array(first_Wb)
    share = float(seen @ first / (first @ first))
    deviation = float(np.sqrt(np.mean((seen - share * first) ** 2)) / np.abs(seen).max())
    return share, deviation


def machine_data(geometry: Geometry) -> dict[str, float]:
    """Keys of a machine file that follow from the geometry.

    Resistance: resistivity times length by cross section of the wire; mean turn: twice the stack and, at its ends, two
    half circles whose diameter is the pole's and one coil side's width. Inertia: density times the integral of r^2 over
    the rotor's steel and the shaft within the stack. Iron loss: see iron_loss.py.
    """
    machine = Machine(geometry)
    mesh, turns = machine.mesh, geometry.turns_in_series
    steel_kg_m = steel.DENSITY_KG_M3 * geometry.stacking_factor * machine.length_m

    side_m2 = float(mesh.area_m2[mesh.region == COIL_PLUS].sum())
    side_width_m = side_m2 / ((geometry.coil_outer_radius - geometry.coil_inner_radius) * 1e-3)
    pole_width_m = geometry.stator_pole_width * 1e-3
    mean_turn_m = 2.0 * machine.length_m + math.pi * (pole_width_m + side_width_m)
    wire_m2 = _FILL_FACTOR * side_m2 / geometry.turns

    iron = mesh.region == IRON
    rotor = iron & mesh.in_rotor
    square_m2 = np.sum(mesh.centre_m**2, axis=1)
    shaft_m = geometry.shaft_radius * 1e-3
    shaft_kg_m2 = 0.5 * math.pi * _SHAFT_KG_M3 * machine.length_m * shaft_m**4
    k, alpha, beta = steel.steinmetz()
    return {
        "resistance_ohm": _COPPER_OHM_M * turns * mean_turn_m / wire_m2,
        # The mesh is half of the machine.
        "inertia_kg_m2": 2.0 * steel_kg_m * float(np.sum((mesh.area_m2 * square_m2)[rotor])) + shaft_kg_m2,
        "turns_area_m2": turns * pole_width_m * machine.length_m * geometry.stacking_factor,
        "mass_kg": 2.0 * steel_kg_m * float(mesh.area_m2[iron].sum()),
        "steinmetz_k": k,
        "steinmetz_alpha": alpha,
        "steinmetz_beta": beta,
    }


def csv_text(geometry: Geometry) -> str:
    """The whole map."""
    half_pitch_deg = 180.0 / geometry.rotor_poles
    angles_deg = [ANGLE_STEP_DEG * k for k in range(round(half_pitch_deg / ANGLE_STEP_DEG) + 1)]
    with process_pool() as pool:
        curves_Wb = list(pool.map(partial(flux_linkages_Wb, geometry), angles_deg))
    lines = [
        "# Flux linkage of one phase of an 8/6 switched-reluctance machine, computed by two-dimensional nonlinear",
        "# magnetostatic finite elements; the field at the ends of the stack is left out. Geometry: Geometry in",
        "# mesh.py, steel: M-19, steel.py (both in tools/src/salient/finite_elements). Made by",
        "#     build/venv/bin/python -m salient.finite_elements tools/machines/finite_element.csv",
        "angle_deg,current_A,flux_linkage_Wb",
    ]
    for angle_deg, curve_Wb in zip(angles_deg, curves_Wb, strict=True):
        lines += [
            f"{angle_deg:g},{current_A:g},{flux_Wb:.6g}"
            for current_A, flux_Wb in zip(CURRENTS_A, curve_Wb, strict=True)
        ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> int:
    if len(arguments) != 1:
        print("usage: python -m salient.finite_elements OUT.csv | --coupling", file=sys.stderr)
        return 2
    if arguments[0] == "--coupling":
        magnetics = load_machine(MACHINES / "finite_element.toml").magnetics
        assert isinstance(magnetics, FluxMap)
        share, deviation = neighbour_share(Geometry(), magnetics)
        print(f"neighbours = {share:.4g}, {100.0 * deviation:.2g} % RMS of the largest mutual flux linkage")
        return 0
    Path(arguments[0]).write_text(csv_text(Geometry()), encoding="utf-8")
    for key, value in machine_data(Geometry()).items():
        print(f"{key} = {value:.5g}")
    return 0
