"""Magnetostatic field of one excited phase of a switched-reluctance machine in its cross section, by finite elements.

curl (nu(B^2) curl A) = J for the axial vector potential A: linear triangles (mesh.py), Newton-Raphson with the
exact Jacobian (P. P. Silvester, R. L. Ferrari, Finite Elements for Electrical Engineers, 3rd ed., 1996, chapter 7). No
flux leaves the stator outwards or enters the shaft. Two dimensions: the field at the ends of the stack is left out.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from salient.finite_elements.mesh import COIL_MINUS, COIL_PLUS, FINE_DEG, IRON, Geometry, build_mesh
from salient.finite_elements.steel import MU_0, Laminations

# Reduction of the Newton iteration's first residual; the flux linkage's error is of the order of its square.
_RESIDUAL = 1e-7
_ITERATIONS_MAX = 60
_SAME_PLACE_M = 1e-6


class FieldError(RuntimeError):
    """The iteration did not converge."""


class Machine:
    """The mesh and everything that does not change with position and current. `steel` gives the reluctivity of IRON."""

    def __init__(self, geometry: Geometry, refinement: int = 1, steel: Laminations | None = None):
        self.geometry = geometry
        self.mesh = build_mesh(geometry, refinement)
        self.steel = steel or Laminations(geometry.stacking_factor)
        self.step_deg = FINE_DEG / refinement
        self.length_m = geometry.stack_length * 1e-3
        mesh = self.mesh
        self.iron = np.flatnonzero(mesh.region == IRON)
        # Integral of the products of the shape functions' gradients.
        self.stiffness_m0 = np.einsum("tia,tja,t->tij", mesh.gradients, mesh.gradients, mesh.area_m2)
        self.source_turns = self.source_of(0)
        # The air between the circles that the faces of the poles are on.
        radius_m = np.hypot(*mesh.centre_m.T)
        self.gap = np.flatnonzero(
            (radius_m > geometry.rotor_radius * 1e-3) & (radius_m < geometry.bore_radius * 1e-3)
        )

    @cache  # noqa: B019 - machines are few, and live as long as the program
    def source_of(self, pole: int) -> np.ndarray:
        """Integral of turns a square metre times shape function, by triangle and corner, of the coil on a pole;
        0 is the excited one, poles are counted forwards, of one polarity within half a turn."""
        mesh = self.mesh
        turn = 2.0 * math.pi * pole / self.geometry.stator_poles
        cosine, sine = math.cos(turn), math.sin(turn)
        source = np.zeros(mesh.triangles.shape)
        for region, sign in ((COIL_PLUS, 1.0), (COIL_MINUS, -1.0)):
            side = np.flatnonzero(mesh.region == region)
            place = mesh.centre_m[side] @ np.array([[cosine, sine], [-sine, cosine]])
            half = np.where(place[:, 0] < 0.0, -1.0, 1.0)  # beyond the half that has a mesh
            distance, found = cKDTree(mesh.centre_m).query(place * half[:, None])
            if distance.max() > _SAME_PLACE_M:
                raise ValueError(f"the mesh at pole {pole} is another one")
            density = sign * self.geometry.turns / mesh.area_m2[side].sum()
            np.add.at(source, found, (half * density * mesh.area_m2[side] / 3.0)[:, None] * np.ones(3))
        return source

    def at(self, angle_deg: float) -> Position:
        """The machine with its rotor turned from the aligned position by a whole number of steps."""
        steps = round(angle_deg / self.step_deg)
        if abs(steps * self.step_deg - angle_deg) > 1e-9:
            raise ValueError(f"{angle_deg} deg is no multiple of the mesh's {self.step_deg} deg")
        return Position(self, steps)


class Position:
    """The field at one rotor position."""

    def __init__(self, machine: Machine, steps: int):
        self._machine = machine
        mesh = machine.mesh
        unknown, sign, self._unknowns = _unknowns(machine, steps)
        self._unknown = unknown[mesh.triangles]
        self._sign = sign[mesh.triangles]
        free = self._unknown >= 0
        pairs = free[:, :, None] & free[:, None, :]
        self._pair_entry = np.flatnonzero(pairs)
        row = np.broadcast_to(self._unknown[:, :, None], pairs.shape)[pairs]
        column = np.broadcast_to(self._unknown[:, None, :], pairs.shape)[pairs]
        entry, self._place = np.unique(column.astype(np.int64) * self._unknowns + row, return_inverse=True)
        self._row = entry % self._unknowns
        self._column_start = np.searchsorted(entry, np.arange(self._unknowns + 1) * self._unknowns)
        self._source = self._gather(machine.source_turns)  # a right side for 1 A

    def solve(self, current_A: float, start: np.ndarray | None = None) -> np.ndarray:
        """The potential in T m at the unknowns, from `start` or from no field; FieldError."""
        potential = np.zeros(self._unknowns) if start is None else start
        source = current_A * self._source
        residual, jacobian = self._equations(potential, source)
        first = max(float(np.linalg.norm(source)), 1e-300)
        for _ in range(_ITERATIONS_MAX):
            size = float(np.linalg.norm(residual))
            step = splu(jacobian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                        options={"SymmetricMode": True}).solve(-residual)  # fmt: skip
            if size < _RESIDUAL * first:
                solution: np.ndarray = potential + step
                return solution
            fraction = 1.0
            while True:
                tried = potential + fraction * step
                residual, jacobian = self._equations(tried, source)
                if float(np.linalg.norm(residual)) < size or fraction < 1e-3:
                    break
                fraction *= 0.5
            potential = tried
        raise FieldError(f"no convergence at {current_A:g} A")

    def flux_linkage_Wb(self, potential: np.ndarray) -> float:
        """Flux linkage of the phase, both coils. Its weights are the current's: its integral is the co-energy."""
        return 2.0 * self._machine.length_m * float(self._source @ potential)

    def flux_linkage_of_Wb(self, pole: int, potential: np.ndarray) -> float:
        """Flux linkage of the phase with a coil on another pole (Machine.source_of)."""
        return 2.0 * self._machine.length_m * float(self._gather(self._machine.source_of(pole)) @ potential)

    def torque_Nm(self, potential: np.ndarray) -> float:
        """By Maxwell's stress, averaged over the air gap (A. Arkkio, Analysis of Induction Motors Based on the
        Numerical Solution of the Magnetic Field and Circuit Equations, 1987)."""
        machine = self._machine
        flux_density = self.flux_density_T(potential)[machine.gap]
        centre_m = machine.mesh.centre_m[machine.gap]
        radius_m = np.hypot(*centre_m.T)
        outwards = centre_m / radius_m[:, None]
        radial_T = np.sum(flux_density * outwards, axis=1)
        tangential_T = flux_density[:, 1] * outwards[:, 0] - flux_density[:, 0] * outwards[:, 1]
        stress = radius_m * radial_T * tangential_T * machine.mesh.area_m2[machine.gap]
        return 2.0 * machine.length_m / (MU_0 * machine.geometry.gap * 1e-3) * float(np.sum(stress))

    def flux_density_T(self, potential: np.ndarray) -> np.ndarray:
        """(triangles, 2) components, in the frame of the triangle's part."""
        gradient = np.einsum("tia,ti->ta", self._machine.mesh.gradients, self._at_corners(potential))
        return np.stack([gradient[:, 1], -gradient[:, 0]], axis=1)

    def _equations(self, potential: np.ndarray, source: np.ndarray) -> tuple[np.ndarray, csc_matrix]:
        """Residual and its Jacobian."""
        machine = self._machine
        mesh, iron = machine.mesh, machine.iron
        corners = self._at_corners(potential)
        square_T2 = np.sum(np.einsum("tia,ti->ta", mesh.gradients[iron], corners[iron]) ** 2, axis=1)
        nu = np.full(len(mesh.area_m2), 1.0 / MU_0)
        nu[iron], slope = machine.steel.reluctivity(square_T2)
        flux = np.einsum("tij,tj->ti", machine.stiffness_m0, corners)
        residual = self._gather(nu[:, None] * flux) - source
        local = nu[:, None, None] * machine.stiffness_m0
        local[iron] += (
            (2.0 * slope / mesh.area_m2[iron])[:, None, None] * flux[iron][:, :, None] * flux[iron][:, None, :]
        )
        local *= self._sign[:, :, None] * self._sign[:, None, :]
        data = np.bincount(self._place, weights=local.ravel()[self._pair_entry], minlength=len(self._row))
        return residual, csc_matrix((data, self._row, self._column_start), shape=(self._unknowns, self._unknowns))

    def _at_corners(self, potential: np.ndarray) -> np.ndarray:
        # The unknown -1 is the boundary's zero.
        at_corners: np.ndarray = np.append(potential, 0.0)[self._unknown] * self._sign
        return at_corners

    def _gather(self, at_corners: np.ndarray) -> np.ndarray:
        values = (at_corners * self._sign).ravel()
        return np.bincount(self._unknown.ravel() + 1, weights=values, minlength=self._unknowns + 1)[1:]


def _unknowns(machine: Machine, steps: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Number and sign of the unknown of every node, and how many there are; -1 at the boundary, where A is zero."""
    rotor, stator = machine.mesh.rotor_rings, machine.mesh.stator_rings
    nodes = stator[-1][-1] + 1
    unknown = np.full(nodes, -1)
    sign = np.ones(nodes)
    count = 0
    for ring in [*rotor[1:], *stator[1:-1]]:
        unknown[ring[:-1]] = count + np.arange(len(ring) - 1)
        unknown[ring[-1]] = count
        sign[ring[-1]] = -1.0
        count += len(ring) - 1
    # The stator's first ring is the rotor's last, shifted by `steps`; each half turn changes the sign.
    columns = len(stator[0]) - 1
    turns, place = np.divmod(np.arange(columns + 1) - steps, columns)
    unknown[stator[0]] = unknown[rotor[-1][place]]
    sign[stator[0]] = 1.0 - 2.0 * (turns % 2)
    return unknown, sign, count


def gap_inductance_H(geometry: Geometry) -> float:
    """Aligned inductance with ideal iron and no fringing: mu_0 N^2 A / (2 g)."""
    area_m2 = geometry.stack_length * 1e-3 * math.radians(geometry.stator_pole_arc) * (
        (geometry.rotor_radius + geometry.gap / 2.0) * 1e-3
    )
    return MU_0 * geometry.turns_in_series**2 * area_m2 / (2.0 * geometry.gap * 1e-3)
