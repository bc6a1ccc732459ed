"""Magnetics of one phase by formula: as in `emulator/plant/magnetics.h`, implemented independently in NumPy: the
firmware's tables are computed from them, and the tests compare the emulator with them.

Form: psi = Lu i + f(theta) (g(i) - Lu i), T = f'(theta) W(i), W(i) the integral of g(i) - Lu i. Angles are
mechanical, rad, 0 aligned; currents in A, >= 0. Every method takes arrays that broadcast against each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

INDUCTANCES = {"unaligned_inductance_H": (1e-6, 10.0), "aligned_inductance_H": (1e-6, 10.0)}
"""(minimum, maximum) for every machine, both included; of the unsaturated phase."""

# Keys of each form in a machine file with (minimum, maximum), both included.
FORMULA_KEYS: dict[str, dict[str, tuple[float, float]]] = {
    "linear_cosine": INDUCTANCES,
    "linear_trapezoid": INDUCTANCES | {"flat_deg": (0.0, 20.0), "blend_deg": (0.01, 20.0)},
    "saturating": INDUCTANCES
    | {
        "saturated_inductance_H": (1e-7, 10.0),
        "flux_linkage_max_Wb": (1e-4, 100.0),
        "current_at_flux_linkage_max_A": (0.1, 100_000.0),
    },
}


@dataclass(frozen=True)
class Formula:
    """Magnetics by one of the forms of FORMULA_KEYS."""

    form: str
    rotor_poles: int
    parameters: dict[str, float]

    # A formula holds for any current.
    current_max_A = math.inf

    @property
    def pitch_rad(self) -> float:
        return 2.0 * math.pi / self.rotor_poles

    @property
    def unaligned_inductance_H(self) -> float:
        """Incremental inductance of the unsaturated phase, d psi / d i at 0 A."""
        return self.parameters["unaligned_inductance_H"]

    def flux_linkage_Wb(self, angle_rad: ArrayLike, current_A: ArrayLike) -> np.ndarray:
        """psi."""
        i = np.asarray(current_A, dtype=float)
        unaligned_Wb = self.unaligned_inductance_H * i
        factor = self._position_factor(angle_rad)[0]
        flux_Wb: np.ndarray = unaligned_Wb + factor * (self._aligned_Wb(i) - unaligned_Wb)
        return flux_Wb

    def coenergy_J(self, angle_rad: ArrayLike, current_A: ArrayLike) -> np.ndarray:
        """Integral of psi over the current at a constant angle."""
        i = np.asarray(current_A, dtype=float)
        factor = self._position_factor(angle_rad)[0]
        energy_J: np.ndarray = 0.5 * self.unaligned_inductance_H * i * i + factor * self._excess_J(i)
        return energy_J

    def torque_Nm(self, angle_rad: ArrayLike, current_A: ArrayLike) -> np.ndarray:
        """Derivative of the co-energy by the angle."""
        slope = self._position_factor(angle_rad)[1]
        torque_Nm: np.ndarray = slope * self._excess_J(np.asarray(current_A, dtype=float))
        return torque_Nm

    def _position_factor(self, angle_rad: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """f and df/dtheta (1/rad): f is 1 aligned, 0 unaligned."""
        half = self.pitch_rad / 2.0
        wrapped = np.mod(np.asarray(angle_rad, dtype=float) + half, self.pitch_rad) - half
        distance, sign = np.abs(wrapped), np.sign(wrapped)
        if self.form == "linear_cosine":
            f = 0.5 * (1.0 + np.cos(self.rotor_poles * distance))
            slope = -0.5 * self.rotor_poles * np.sin(self.rotor_poles * distance)
        elif self.form == "saturating":
            x = distance / half
            f = (2.0 * x - 3.0) * x * x + 1.0
            slope = 6.0 * x * (x - 1.0) / half
        else:
            flat = math.radians(self.parameters["flat_deg"])
            blend = math.radians(self.parameters["blend_deg"])
            steep = 1.0 / (half - 2.0 * flat - blend)
            # Slope rises over one blend, stays, falls over another; f is its integral.
            up = np.clip(distance - flat, 0.0, blend)
            straight = np.clip(distance - flat - blend, 0.0, half - 2.0 * flat - 2.0 * blend)
            down = np.clip(distance - (half - flat - blend), 0.0, blend)
            f = 1.0 - steep * (up * up / (2.0 * blend) + straight + down - down * down / (2.0 * blend))
            slope = -steep * (up - down) / blend
        return f, slope * sign

    def _saturation(self) -> tuple[float, float]:
        """A in Wb and b in 1/A."""
        m = self.parameters
        amplitude = m["flux_linkage_max_Wb"] - m["saturated_inductance_H"] * m["current_at_flux_linkage_max_A"]
        return amplitude, (m["aligned_inductance_H"] - m["saturated_inductance_H"]) / amplitude

    def _aligned_Wb(self, i: np.ndarray) -> np.ndarray:
        """g(i)."""
        m = self.parameters
        if self.form != "saturating":
            return m["aligned_inductance_H"] * i
        amplitude, rate = self._saturation()
        flux_Wb: np.ndarray = m["saturated_inductance_H"] * i - amplitude * np.expm1(-rate * i)
        return flux_Wb

    def _excess_J(self, i: np.ndarray) -> np.ndarray:
        """W(i)."""
        m = self.parameters
        if self.form != "saturating":
            unsaturated_J: np.ndarray = 0.5 * (m["aligned_inductance_H"] - m["unaligned_inductance_H"]) * i * i
            return unsaturated_J
        amplitude, rate = self._saturation()
        linear = 0.5 * (m["saturated_inductance_H"] - m["unaligned_inductance_H"]) * i * i
        energy_J: np.ndarray = linear + amplitude * (i + np.expm1(-rate * i) / rate)
        return energy_J
