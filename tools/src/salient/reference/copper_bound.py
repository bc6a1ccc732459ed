"""Bound that no drive goes below: the least mean sum of squares of the phase currents with which a machine makes a
torque without ripple at a speed.

All phases do the same, one stroke apart. Their flux linkages over an electrical revolution are the variables; at every
angle the torques add up to the wanted one, and from angle to angle a flux linkage changes by at most what the voltage
permits behind the resistance of winding and switches. At low speed the voltage permits everything, and what is left is
the least sum of squares at each angle for itself, by which the search begins: dynamic programming over the shares.

Nothing of this is in the firmware, nor in what computes its tables: only the magnetics are shared with the plant.
Electrical degrees of a phase past the unaligned position.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import minimize

from salient.machine.definition import Machine

STEP_DEG = 3
_TURN = 360 // STEP_DEG
_HALF = _TURN // 2
_POINTS = 200
"""Points of the flux linkage, and of the share of the torque."""
_ITERATIONS = 200
_MET = 1e-4
"""Relative error of the torque and of the voltage."""


def least_square_A2(machine: Machine, torque_Nm: float, speed_rad_s: float, voltage_V: float, limit_A: float) -> float:
    """Sum over the phases of the mean square of the current; inf where no current up to the limit makes the torque at
    every angle, or the search finds none for the voltage."""
    curves = _Curves(machine, limit_A)
    share = _shares(curves, torque_Nm)
    if share is None:
        return math.inf
    stroke = _TURN // machine.phases
    step_s = math.radians(STEP_DEG) / machine.rotor_poles / speed_rad_s
    step_Wb = voltage_V * step_s
    drop_ohm_s = (machine.resistance_ohm + 2.0 * machine.converter["switch_resistance_ohm"]) * step_s
    row, following = np.arange(_TURN), (np.arange(_TURN) + 1) % _TURN

    def square(part: np.ndarray) -> tuple[float, np.ndarray]:
        current_A, slope_A = curves.at(curves.current_A, part)
        return float((current_A**2).sum()) / scale_A2, 2.0 * current_A * slope_A / scale_A2

    def excess(part: np.ndarray) -> np.ndarray:
        made_Nm, _ = curves.at(curves.torque_Nm, part)
        result: np.ndarray = made_Nm.reshape(machine.phases, stroke).sum(axis=0) / torque_Nm - 1.0
        return result

    def excess_slope(part: np.ndarray) -> np.ndarray:
        _, slope_Nm = curves.at(curves.torque_Nm, part)
        slope = np.zeros((stroke, _TURN))
        slope[row % stroke, row] = slope_Nm / torque_Nm
        return slope

    def room(part: np.ndarray) -> np.ndarray:
        flux_Wb = part * curves.top_Wb
        current_A, _ = curves.at(curves.current_A, part)
        change_Wb = flux_Wb[following] - flux_Wb + drop_ohm_s * current_A
        return np.concatenate([step_Wb - change_Wb, step_Wb + change_Wb]) / step_Wb

    def room_slope(part: np.ndarray) -> np.ndarray:
        _, slope_A = curves.at(curves.current_A, part)
        change = np.zeros((_TURN, _TURN))
        change[row, row] = drop_ohm_s * slope_A - curves.top_Wb
        change[row, following] = curves.top_Wb[following]
        return np.concatenate([-change, change]) / step_Wb

    begin = curves.part_of_torque(share * torque_Nm)
    scale_A2 = 1.0
    scale_A2 = max(square(begin)[0], 1e-12)
    found = minimize(square, begin, jac=True, bounds=[(0.0, 1.0)] * _TURN, method="SLSQP",
                     constraints=[{"type": "eq", "fun": excess, "jac": excess_slope},
                                  {"type": "ineq", "fun": room, "jac": room_slope}],
                     options={"maxiter": _ITERATIONS, "ftol": 1e-6})
    met = np.abs(excess(found.x)).max() < _MET and room(found.x).min() > -_MET
    return float(found.fun) * scale_A2 / stroke if met else math.inf


class _Curves:
    """Current and torque of a phase over the part of the flux linkage of the current limit, by angle of a turn."""

    def __init__(self, machine: Machine, limit_A: float) -> None:
        magnetics = machine.magnetics
        self.phases = machine.phases
        angle_rad = (np.arange(_TURN) * STEP_DEG / 360.0 + 0.5) * magnetics.pitch_rad
        grid_A = np.linspace(0.0, limit_A, 2 * _POINTS)
        flux_Wb = magnetics.flux_linkage_Wb(angle_rad[:, None], grid_A)
        torque_Nm = magnetics.torque_Nm(angle_rad[:, None], grid_A)
        self.top_Wb = flux_Wb[:, -1]
        part = np.linspace(0.0, 1.0, _POINTS)
        self.part = part
        self.current_A = np.array([np.interp(part * of[-1], of, grid_A) for of in flux_Wb])
        self.torque_Nm = np.array([np.interp(part * of[-1], of, torque)
                                   for of, torque in zip(flux_Wb, torque_Nm, strict=True)])

    def at(self, table: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Value and slope at each angle of a turn."""
        row = np.arange(_TURN)
        place = np.clip(part, 0.0, 1.0) * (_POINTS - 1)
        low = np.minimum(place.astype(int), _POINTS - 2)
        rise = table[row, low + 1] - table[row, low]
        return table[row, low] + (place - low) * rise, rise * (_POINTS - 1)

    def part_of_torque(self, torque_Nm: np.ndarray) -> np.ndarray:
        """By angle; 0 for no torque."""
        rising_Nm = np.maximum.accumulate(self.torque_Nm, axis=1)
        return np.array([np.interp(wanted, row, self.part) if wanted > 0.0 else 0.0
                         for wanted, row in zip(torque_Nm, rising_Nm, strict=True)])


def _shares(curves: _Curves, torque_Nm: float) -> np.ndarray | None:
    """Shares of the torque by angle with the least sum of squares at each; None when there are none."""
    grid_Nm = np.linspace(0.0, torque_Nm, _POINTS)
    rising_Nm = np.maximum.accumulate(curves.torque_Nm[: _HALF + 1], axis=1)
    square_A2 = np.array([np.interp(grid_Nm, made, current, right=np.inf) ** 2
                          for made, current in zip(rising_Nm, curves.current_A, strict=False)])
    square_A2[:, 0] = 0.0
    stroke = _TURN // curves.phases
    share = np.zeros(_TURN)
    rest = np.arange(_POINTS)[:, None] - np.arange(_POINTS)  # what the phases before make, by sum and own share
    for first in range(stroke):
        rows = range(first, _HALF + 1, stroke)
        total, own = square_A2[first], []
        for row in list(rows)[1:]:
            both = np.where(rest >= 0, total[np.maximum(rest, 0)] + square_A2[row], np.inf)
            own.append(both.argmin(axis=1))
            total = both.min(axis=1)
        if not np.isfinite(total[-1]):
            return None
        left = _POINTS - 1
        for row, chosen in zip(list(rows)[:0:-1], own[::-1], strict=True):
            share[row] = chosen[left] / (_POINTS - 1)
            left -= chosen[left]
        share[first] = left / (_POINTS - 1)
    return share
