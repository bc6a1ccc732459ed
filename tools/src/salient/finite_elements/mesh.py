"""An 8/6 switched-reluctance machine's cross section and its mesh, for solver.py.

Half of the machine, from -90 to 90 deg about the excited pole: half a turn further the field is the same with its sign
changed. The mesh is made of rings of nodes. On a ring the nodes' numbers run with equal steps of a nominal angle, in
which the sides of the poles are at constant angles; where they really are follows from the sides being parallel. The
rotor's rings are in the rotor's own frame. Its last ring and the stator's first are the same circle in the middle of
the air gap, with nodes at equal steps: the rotor turns by whole steps, and the mesh of either part is the same at every
position, so that its error does not change from one position to the next but smoothly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

AIR, IRON, COIL_PLUS, COIL_MINUS = range(4)

# Steps of nominal angle on rings far from and next to the air gap, deg. All corners of poles and coils lie on both.
COARSE_DEG = 1.0
FINE_DEG = 0.5


@dataclass(frozen=True)
class Geometry:
    """Lengths in mm, angles in deg. Poles have parallel sides, their arcs are those at their faces."""

    stator_poles: int = 8
    rotor_poles: int = 6
    shaft_radius: float = 15.0
    rotor_root_radius: float = 27.0
    rotor_radius: float = 45.0
    gap: float = 0.5
    coil_inner_radius: float = 50.0
    coil_outer_radius: float = 72.0
    stator_root_radius: float = 73.0
    stator_radius: float = 85.0
    stator_pole_arc: float = 20.0
    rotor_pole_arc: float = 22.0
    coil_arc: float = 10.0  # nominal, of a coil side next to its pole: 0.4 of the slot
    stack_length: float = 170.0
    stacking_factor: float = 0.96
    turns: int = 26  # of each of the two coils of a phase, in series

    @property
    def bore_radius(self) -> float:
        return self.rotor_radius + self.gap

    @property
    def stator_pole_width(self) -> float:
        return 2.0 * self.bore_radius * math.sin(math.radians(self.stator_pole_arc / 2.0))

    @property
    def rotor_pole_width(self) -> float:
        return 2.0 * self.rotor_radius * math.sin(math.radians(self.rotor_pole_arc / 2.0))

    @property
    def turns_in_series(self) -> int:
        return 2 * self.turns


@dataclass(frozen=True)
class Mesh:
    """Linear triangles, in m. Where four cover a quadrangle twice, by both of its diagonals, each counts half: the mesh
    has the machine's mirror symmetry."""

    triangles: np.ndarray
    """(triangles, 3) nodes."""
    gradients: np.ndarray
    """(triangles, 3, 2): gradients of the three shape functions, 1/m, in the frame of the part."""
    area_m2: np.ndarray
    """Weight of a triangle in integrals over the area."""
    centre_m: np.ndarray
    """(triangles, 2)."""
    region: np.ndarray
    in_rotor: np.ndarray
    rotor_rings: list[np.ndarray]
    """Node numbers, the last node of a ring half a turn from its first."""
    stator_rings: list[np.ndarray]


@dataclass(frozen=True)
class _Layer:
    """Rings from `inner` to `outer` radius (mm) at equal distances, `steps` of them."""

    inner: float
    outer: float
    steps: int
    fine: bool


def build_mesh(g: Geometry, refinement: int = 1) -> Mesh:
    """The mesh, every step divided by `refinement`."""
    middle = g.rotor_radius + g.gap / 2.0
    rotor = [
        _Layer(g.shaft_radius, g.rotor_root_radius, 5, False),
        _Layer(g.rotor_root_radius, g.rotor_radius - 6.0, 6, False),
        _Layer(g.rotor_radius - 6.0, g.rotor_radius - 2.0, 4, False),
        _Layer(g.rotor_radius - 2.0, g.rotor_radius - 0.6, 3, True),
        _Layer(g.rotor_radius - 0.6, g.rotor_radius, 3, True),
        _Layer(g.rotor_radius, middle, 2, True),
    ]
    stator = [
        _Layer(middle, g.bore_radius, 2, True),
        _Layer(g.bore_radius, g.bore_radius + 0.6, 3, True),
        _Layer(g.bore_radius + 0.6, g.bore_radius + 2.0, 3, True),
        _Layer(g.bore_radius + 2.0, g.coil_inner_radius, 3, False),
        _Layer(g.coil_inner_radius, g.coil_outer_radius, 11, False),
        _Layer(g.coil_outer_radius, g.stator_root_radius, 1, False),
        _Layer(g.stator_root_radius, g.stator_radius, 5, False),
    ]
    nodes: list[np.ndarray] = []
    parts: list[tuple[np.ndarray, ...]] = []
    rotor_rings = _mesh_part(rotor, _RotorPart(g), refinement, nodes, parts, in_rotor=True)
    stator_rings = _mesh_part(stator, _StatorPart(g), refinement, nodes, parts, in_rotor=False)
    triangles, weights, region, in_rotor = (np.concatenate(column) for column in zip(*parts, strict=True))

    corners = np.concatenate(nodes)[triangles] * 1e-3
    # The gradient of the shape function of corner k is the opposite side, turned by 90 degrees.
    sides = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    double_area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    turned = np.stack([-sides[:, :, 1], sides[:, :, 0]], axis=2)
    return Mesh(
        triangles=triangles,
        gradients=turned / double_area[:, None, None],
        area_m2=0.5 * np.abs(double_area) * weights,
        centre_m=corners.mean(axis=1),
        region=region,
        in_rotor=in_rotor,
        rotor_rings=rotor_rings,
        stator_rings=stator_rings,
    )


class _RotorPart:
    def __init__(self, g: Geometry):
        self.g = g
        self.pitch = 360.0 / g.rotor_poles
        self.side = g.rotor_pole_arc / 2.0

    def side_angle(self, radius: float) -> float:
        """Angle of the pole's side from its axis, deg."""
        within = min(max(radius, self.g.rotor_root_radius), self.g.rotor_radius)
        return math.degrees(math.asin(self.g.rotor_pole_width / (2.0 * within)))

    def region(self, radius: float, nominal: np.ndarray) -> np.ndarray:
        if radius > self.g.rotor_radius:
            return np.full(nominal.shape, AIR)
        from_axis = np.abs(nominal - self.pitch * np.rint(nominal / self.pitch))
        return np.where((radius < self.g.rotor_root_radius) | (from_axis < self.side), IRON, AIR)


class _StatorPart:
    def __init__(self, g: Geometry):
        self.g = g
        self.pitch = 360.0 / g.stator_poles
        self.side = g.stator_pole_arc / 2.0

    def side_angle(self, radius: float) -> float:
        within = min(max(radius, self.g.bore_radius), self.g.stator_root_radius)
        return math.degrees(math.asin(self.g.stator_pole_width / (2.0 * within)))

    def region(self, radius: float, nominal: np.ndarray) -> np.ndarray:
        g = self.g
        if radius < g.bore_radius:
            return np.full(nominal.shape, AIR)
        from_axis = np.abs(nominal - self.pitch * np.rint(nominal / self.pitch))
        region = np.where((radius > g.stator_root_radius) | (from_axis < self.side), IRON, AIR)
        if g.coil_inner_radius < radius < g.coil_outer_radius:
            in_coil = (np.abs(nominal) > self.side) & (np.abs(nominal) < self.side + g.coil_arc)
            region[in_coil] = np.where(nominal[in_coil] > 0.0, COIL_PLUS, COIL_MINUS)
        return region


def _mesh_part(layers: list[_Layer], part: _RotorPart | _StatorPart, refinement: int, nodes: list[np.ndarray],
               parts: list[tuple[np.ndarray, ...]], *, in_rotor: bool) -> list[np.ndarray]:
    """Appends the rings' nodes (x and y in mm) and the triangles between them; returns the rings."""
    radii = [layers[0].inner]
    fine = [layers[0].fine]
    for layer in layers:
        steps = layer.steps * refinement
        radii += np.linspace(layer.inner, layer.outer, steps + 1)[1:].tolist()
        fine[-1] |= layer.fine
        fine += [layer.fine] * steps
    rings = []
    begin = sum(len(ring) for ring in nodes)
    for radius, is_fine in zip(radii, fine, strict=True):
        step = (FINE_DEG if is_fine else COARSE_DEG) / refinement
        nominal = np.linspace(-90.0, 90.0, round(180.0 / step) + 1)
        angle = np.radians(_true_angle(nominal, part, radius))
        nodes.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        rings.append(begin + np.arange(len(nominal)))
        begin += len(nominal)
    for inner, outer, inner_radius, outer_radius in zip(rings, rings[1:], radii, radii[1:], strict=False):
        cells = min(len(inner), len(outer)) - 1
        centre = -90.0 + 180.0 / cells * (np.arange(cells) + 0.5)
        region = part.region(0.5 * (inner_radius + outer_radius), centre)
        triangles, weight = _between(inner, outer)
        parts.append((
            np.concatenate(triangles),
            np.full(len(triangles) * cells, weight),
            np.tile(region, len(triangles)),
            np.full(len(triangles) * cells, in_rotor),
        ))  # fmt: skip
    return rings


def _true_angle(nominal: np.ndarray, part: _RotorPart | _StatorPart, radius: float) -> np.ndarray:
    """Nominal angles stretched between the sides of the poles so that these are parallel, deg."""
    axis = part.pitch * np.rint(nominal / part.pitch)
    from_axis = nominal - axis
    side, half = part.side_angle(radius), part.pitch / 2.0
    return axis + np.sign(from_axis) * np.interp(np.abs(from_axis), [0.0, part.side, half], [0.0, side, half])


def _between(inner: np.ndarray, outer: np.ndarray) -> tuple[list[np.ndarray], float]:
    """Triangles between two rings, cell by cell, one array for each of a cell's, and what one counts for."""
    if len(inner) == len(outer):
        a, b, c, d = inner[:-1], inner[1:], outer[1:], outer[:-1]
        corners, weight = [(a, b, c), (a, c, d), (a, b, d), (b, c, d)], 0.5
    else:
        few, many = (inner, outer) if len(inner) < len(outer) else (outer, inner)
        a, b, p, q, r = few[:-1], few[1:], many[:-1:2], many[1::2], many[2::2]
        corners, weight = [(a, p, q), (a, q, b), (b, q, r)], 1.0
    return [np.stack(corner, axis=1) for corner in corners], weight
