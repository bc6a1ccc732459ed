"""The model of reference_plant.py for a machine with a map: SciPy evaluates the B-splines, and the current follows from
the inverse of the flux linkage."""

from __future__ import annotations

import math

from reference_plant import Machine, Reference
from scipy.interpolate import NdBSpline

from salient.machine.flux_map import ANGLE_INTERVALS, CURRENT_INTERVALS, FluxMap


class MapReference(Reference):
    """The shape of `Reference` is here the angle and the side of the aligned position."""

    def __init__(self, machine: Machine, flux_map: FluxMap) -> None:
        self.machine = machine
        self.phases = machine.phases
        self.half_pitch = math.pi / machine.rotor_poles
        self.phase_offset = 2 * self.half_pitch / machine.phases
        self.corners = []
        self.current_max_A = flux_map.current_max_A
        step_A, step_rad = self.current_max_A / CURRENT_INTERVALS, self.half_pitch / ANGLE_INTERVALS
        knots_A = [step_A * n for n in range(-4, CURRENT_INTERVALS + 5)]
        knots_rad = [step_rad * n for n in range(-3, ANGLE_INTERVALS + 4)]
        self.spline = NdBSpline((knots_A, knots_rad), flux_map.coefficients_J, k=(4, 3))

    def shape(self, angle: float) -> tuple[float, tuple[float, float]]:
        wrapped = math.remainder(angle, 2 * self.half_pitch)
        x = min(abs(wrapped), self.half_pitch)
        return x, (x, math.copysign(1.0, wrapped))

    def energy(self, x: float, current: float, by_current: int, by_angle: int) -> float:
        return float(self.spline((current, x), nu=(by_current, by_angle)))

    def flux(self, x: float, current: float) -> float:
        within = min(current, self.current_max_A)
        straight = (current - within) * self.energy(x, within, 2, 0) if current > within else 0.0
        return self.energy(x, within, 1, 0) + straight

    def current(self, x: float, flux: float) -> float:
        """Newton's method, started on the secant through 0; psi rises with the current."""
        current = flux / self.energy(x, 0.0, 2, 0)
        for _ in range(60):
            step = (flux - self.flux(x, current)) / self.energy(x, min(current, self.current_max_A), 2, 0)
            current += step
            if abs(step) <= 1e-13 * (1 + abs(current)):
                return current
        raise AssertionError(f"no current for {flux} Wb at {x} rad")

    def torque(self, slope: tuple[float, float], current: float) -> float:
        x, side = slope
        within = min(current, self.current_max_A)
        beyond = current - within
        torque = self.energy(x, within, 0, 1)
        if beyond > 0:
            torque += beyond * self.energy(x, within, 1, 1) + beyond**2 / 2 * self.energy(x, within, 2, 1)
        return side * torque
