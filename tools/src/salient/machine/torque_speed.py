"""Abilities of a machine's magnetics and a voltage: smooth torque of a current, time of a change of speed. The mean
torque over the speed: single_pulse.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

_FLUX_POINTS = 128

_CHANGE_STEPS = 3000
_STROKE_POINTS = 61
_BOUND_POINTS = 201
_SEARCH_POINTS = 80
_BISECTIONS = 24  # to 1e-7 of the range


@dataclass(frozen=True)
class Source:
    """Connection of a phase."""

    voltage_V: float
    resistance_ohm: float
    """Resistance of winding and devices."""


def smooth_torque_Nm(magnetics: Any, phases: int, current_A: float) -> float:
    """Torque that the phases, each at up to a current, make at every rotor angle: the least over a stroke of the sum
    of the positive torques."""
    return float(_stroke_torque_Nm(magnetics, phases, np.array([current_A])).min())


def mean_torque_Nm(magnetics: Any, phases: int, current_A: float) -> float:
    """The mean over a stroke of what smooth_torque_Nm takes the least of: no commutation makes more."""
    return float(_stroke_torque_Nm(magnetics, phases, np.array([current_A])).mean())


def torque_bound_Nm(magnetics: Any, phases: int, current_A: float, voltage_s_rad: float) -> float:
    """Mean torque that no commutation exceeds, of currents up to current_A at a voltage over speed, V s/rad: the flux
    linkage rises for at most half a pole pitch, as it has to fall again, and a stroke converts at most what lies
    between the aligned and the unaligned curve up to that flux linkage. Resistance would leave less."""
    grid_A = np.linspace(0.0, current_A, _BOUND_POINTS)
    aligned_Wb, unaligned_Wb = (magnetics.flux_linkage_Wb(angle_rad, grid_A)
                                for angle_rad in (0.0, 0.5 * magnetics.pitch_rad))
    flux_Wb = np.linspace(0.0, min(0.5 * magnetics.pitch_rad * voltage_s_rad, float(aligned_Wb[-1])), _BOUND_POINTS)
    between_A = np.interp(flux_Wb, unaligned_Wb, grid_A) - np.interp(flux_Wb, aligned_Wb, grid_A)
    return float(np.trapezoid(between_A, flux_Wb) * phases / magnetics.pitch_rad)


def _stroke_torque_Nm(magnetics: Any, phases: int, current_A: np.ndarray) -> np.ndarray:
    """By current and angle; of the phases on their way from the unaligned to the aligned position."""
    stroke_rad = magnetics.pitch_rad / phases
    angle_rad = np.linspace(0.0, stroke_rad, _STROKE_POINTS) + stroke_rad * np.arange(phases)[:, None]
    motoring = angle_rad > 0.5 * magnetics.pitch_rad
    torque_Nm = np.where(motoring, magnetics.torque_Nm(angle_rad, current_A[:, None, None]), 0.0)
    total_Nm: np.ndarray = np.maximum(torque_Nm, 0.0).sum(axis=1)
    return total_Nm


def current_of_torque_A(magnetics: Any, phases: int, torque_Nm: float, current_max_A: float) -> float:
    """The smallest current whose smooth torque is torque_Nm, to a ten-thousandth; the one of the largest torque up to
    current_max_A when none is."""
    grid_A = np.geomspace(1e-6 * current_max_A, current_max_A, _SEARCH_POINTS)
    for _ in range(3):
        smooth_Nm = _stroke_torque_Nm(magnetics, phases, grid_A).min(axis=1)
        reached = np.flatnonzero(smooth_Nm >= torque_Nm)
        if not reached.size:
            return float(grid_A[int(np.argmax(smooth_Nm))])
        first = max(int(reached[0]), 1)
        grid_A = np.linspace(grid_A[first - 1], grid_A[first], _SEARCH_POINTS // 4)
    return float(grid_A[-1])


def knee_A(magnetics: Any, current_max_A: float) -> float:
    """Current at which saturation has taken 1/e of the aligned flux linkage: psi = (1 - 1/e) L i, with the unsaturated
    inductance L; current_max_A when it is above it. By bisection."""
    small_A = 1e-9 * current_max_A
    unsaturated_H = float(magnetics.flux_linkage_Wb(0.0, small_A)) / small_A
    low_A, high_A = 0.0, current_max_A
    for _ in range(_BISECTIONS):
        middle_A = 0.5 * (low_A + high_A)
        if float(magnetics.flux_linkage_Wb(0.0, middle_A)) > (1.0 - math.exp(-1.0)) * unsaturated_H * middle_A:
            low_A = middle_A
        else:
            high_A = middle_A
    return high_A


def torque_per_flux_Nm_Wb(magnetics: Any, current_A: float) -> float:
    """dT/dpsi at an angle, N m/Wb: the mean over the angles at which the torque is at least half of its maximum; nan
    where there is no torque."""
    angle_rad = np.linspace(0.5, 1.0, 182)[1:-1] * magnetics.pitch_rad
    low_A, high_A = 0.95 * current_A, 1.05 * current_A
    torque_Nm = magnetics.torque_Nm(angle_rad, current_A)
    slope = ((magnetics.torque_Nm(angle_rad, high_A) - magnetics.torque_Nm(angle_rad, low_A))
             / (magnetics.flux_linkage_Wb(angle_rad, high_A) - magnetics.flux_linkage_Wb(angle_rad, low_A)))
    strong = torque_Nm >= 0.5 * torque_Nm.max()
    return float(np.mean(slope[strong])) if torque_Nm.max() > 0.0 else math.nan


def _inverse_table(magnetics: Any, current_A: float) -> tuple[np.ndarray, np.ndarray]:
    """Current by angle (0..180 electrical degrees from aligned) and flux linkage in _FLUX_POINTS up to its value
    at current_A, and the latter by angle."""
    angle_rad = np.arange(181) / 180.0 * magnetics.pitch_rad / 2.0
    grid_A = np.linspace(0.0, current_A, 257)
    flux_Wb = np.maximum.accumulate(magnetics.flux_linkage_Wb(angle_rad[:, None], grid_A[None, :]), axis=1)
    limit_Wb = flux_Wb[:, -1]
    fractions = np.linspace(0.0, 1.0, _FLUX_POINTS)
    table = np.array([np.interp(fractions * top, row, grid_A) for row, top in zip(flux_Wb, limit_Wb, strict=True)])
    return table, limit_Wb


def speed_change_s(magnetics: Any, phases: int,  # noqa: PLR0913, PLR0917 - the quantities of one machine
                   source: Source, current_A: float, torque_max_Nm: float, inertia_kg_m2: float,
                   friction_Nm_s: float, from_rad_s: float, to_rad_s: float) -> float:
    """Time that a machine takes from one speed to another: full voltage on every phase whose torque helps and full
    opposite voltage on the others, currents up to current_A, the sum of the torques up to torque_max_Nm; the phases
    carry no current at first, and phase 0 is aligned. A drive that turns phases on earlier may need a little less."""
    table, limit_Wb = _inverse_table(magnetics, current_A)
    grid_A = np.linspace(0.0, current_A, _FLUX_POINTS)
    angle_rad = np.arange(181) / 180.0 * magnetics.pitch_rad / 2.0
    torque_Nm = np.abs(magnetics.torque_Nm(angle_rad[:, None], grid_A[None, :]))
    direction = math.copysign(1.0, to_rad_s - from_rad_s)
    least_s = abs(to_rad_s - from_rad_s) * inertia_kg_m2 / torque_max_Nm
    step_s = max(2e-6, least_s / _CHANGE_STEPS)
    turn_deg_per_rad = 360.0 / magnetics.pitch_rad
    offsets_deg = 360.0 / phases * np.arange(phases)
    speed_rad_s, angle_deg, flux_Wb, time_s = from_rad_s, 0.0, np.zeros(phases), 0.0
    current = np.zeros(phases)
    while direction * (to_rad_s - speed_rad_s) > 0.0 and time_s < 20.0 * least_s + 1.0:
        electrical_deg = (angle_deg - offsets_deg) % 360.0
        helps = (electrical_deg >= 180.0) == (direction > 0.0)
        index = np.minimum(np.abs((electrical_deg + 180.0) % 360.0 - 180.0).round().astype(int), 180)
        applied_V = np.where(helps, source.voltage_V, -source.voltage_V)
        flux_Wb = flux_Wb + (applied_V - source.resistance_ohm * current) * step_s
        flux_Wb = np.clip(flux_Wb, 0.0, limit_Wb[index])
        place = flux_Wb / limit_Wb[index] * (_FLUX_POINTS - 1)
        low = np.minimum(place.astype(int), _FLUX_POINTS - 2)
        current = table[index, low] + (place - low) * (table[index, low + 1] - table[index, low])
        column = np.minimum((current / current_A * (_FLUX_POINTS - 1)).round().astype(int), _FLUX_POINTS - 1)
        total_Nm = min(float((np.where(helps, 1.0, -1.0) * torque_Nm[index, column]).sum()), torque_max_Nm)
        speed_rad_s += (direction * total_Nm - friction_Nm_s * speed_rad_s) / inertia_kg_m2 * step_s
        angle_deg += speed_rad_s * step_s * turn_deg_per_rad
        time_s += step_s
    return time_s
