"""The window of the torque sharing function (firmware/control/torque_sharing.h) with the least RMS current for a torque
at standstill.

Electrical degrees past the unaligned position. The torque of the phases adds up to the reference at every angle,
whatever the window; the current that it takes depends on where a phase makes its part. A window of a turn-on and a
turn-off angle is enough: on machines by formula and by map, with pole arcs from 0.3 to 0.5 of a pitch, the best one
takes at most 1.5 % more than the least sum of squares of the currents that make the torque at each angle.
"""

from __future__ import annotations

from typing import Any

import numpy as np

WINDOW_SHARE = 0.97
"""Part of the least torque over a stroke of all phases at a current that a window makes at every angle."""
OVERLAP_MIN_DEG = 6.0

_STEP_DEG = 2.0
_ON_DEG = np.arange(0.0, 91.0, _STEP_DEG)
_OFF_MAX_DEG = 178.0
_SHARES = 64
_CURRENTS = 160
_MISSED_COST = 1e3
"""Relative square of the current that a part of the torque is worth which no current makes."""


def least_current_deg(magnetics: Any, phases: int, torque_Nm: float, limit_A: float, more: float) -> np.ndarray:
    """Turn-on and turn-off of the widest motoring window that takes little more than the least square of the current,
    `more` of it relatively, or that leaves the least torque missing with a current up to limit_A."""
    stroke_deg = 360.0 / phases
    angle_deg = np.arange(0.0, 181.0, _STEP_DEG)
    share_A = _current_of_share_A(magnetics, angle_deg, torque_Nm, limit_A)
    overlap_deg = np.arange(OVERLAP_MIN_DEG, stroke_deg + 1.0, _STEP_DEG)
    on_deg, overlap_deg = (of.ravel() for of in np.meshgrid(_ON_DEG, overlap_deg, indexing="ij"))
    inside = on_deg + stroke_deg + overlap_deg <= _OFF_MAX_DEG
    on_deg, overlap_deg = on_deg[inside], overlap_deg[inside]
    place = sharing_function(angle_deg[:, None] - on_deg, stroke_deg, overlap_deg) * (_SHARES - 1)
    low = np.minimum(place.astype(int), _SHARES - 2)
    row = np.arange(len(angle_deg))[:, None]
    current_A = share_A[row, low] + (place - low) * (share_A[row, low + 1] - share_A[row, low])
    cost = (current_A**2).sum(axis=0)
    # Among several of the same width the one that costs least.
    permitted = cost <= (1.0 + more) * cost.min()
    best = int(np.where(permitted, overlap_deg - 1e-3 * cost / cost.min(), -1.0).argmax())
    return np.array([on_deg[best], on_deg[best] + stroke_deg + overlap_deg[best]])


def _current_of_share_A(magnetics: Any, angle_deg: np.ndarray, torque_Nm: float, limit_A: float) -> np.ndarray:
    """By angle and share of the torque; above the limit the larger, the more torque is missing."""
    grid_A = np.linspace(0.0, limit_A, _CURRENTS)
    shares_Nm = np.linspace(0.0, torque_Nm, _SHARES)
    made_Nm = magnetics.torque_Nm((angle_deg / 360.0 + 0.5)[:, None] * magnetics.pitch_rad, grid_A[None, :])
    made_Nm = np.maximum.accumulate(np.maximum(made_Nm, 0.0), axis=1)
    current_A = np.array([np.interp(shares_Nm, row, grid_A) for row in made_Nm])
    missed = np.maximum(shares_Nm / torque_Nm - made_Nm[:, -1:] / torque_Nm, 0.0)
    current_A = current_A + _MISSED_COST * limit_A * missed
    current_A[:, 0] = 0.0
    return current_A


def _cubic(part: np.ndarray) -> np.ndarray:
    x = np.clip(part, 0.0, 1.0)
    result: np.ndarray = x * x * (3.0 - 2.0 * x)
    return result


def sharing_function(since_on_deg: np.ndarray, stroke_deg: float, overlap_deg: np.ndarray | float) -> np.ndarray:
    """The cubic of torque_sharing.h."""
    rising, falling = _cubic(since_on_deg / overlap_deg), _cubic((since_on_deg - stroke_deg) / overlap_deg)
    share: np.ndarray = rising - falling
    return share
