"""The window of the torque sharing function (firmware/control/torque_sharing.h) with the least RMS current.

Angles are electrical degrees of a phase: 180 is the unaligned, 360 the aligned position. The torque of the phases adds
up to the reference at every angle, whatever the window; the current that it takes depends on where a phase makes its
part. The voltage is left out: single pulse operation (single_pulse.py) has what it permits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_STEP_DEG = 2.0
_WINDOW_STEP_DEG = 4.0
_ON_DEG = np.arange(184.0, 249.0, _WINDOW_STEP_DEG)
_OVERLAP_MIN_DEG = 12.0
_OFF_MAX_DEG = 356.0
_SHARES = 64
_CURRENTS = 160
_UNREACHED = 1e3


def least_current_window_deg(magnetics: Any, phases: int, torque_Nm: float, current_max_A: float
                             ) -> tuple[float, float]:
    """Turn-on and turn-off of the window with the least RMS current for a torque; the widest one when no window makes
    it with current_max_A."""
    stroke_deg = 360.0 / phases
    angle_deg = np.arange(180.0, 361.0, _STEP_DEG)
    share_A = _current_of_share_A(magnetics, angle_deg, torque_Nm, current_max_A)
    row = np.arange(len(angle_deg))
    best_A2, best = np.inf, (float(_ON_DEG[0]), _OFF_MAX_DEG)
    for on_deg in _ON_DEG:
        for off_deg in np.arange(on_deg + stroke_deg + _OVERLAP_MIN_DEG, _OFF_MAX_DEG + 1.0, _WINDOW_STEP_DEG):
            if off_deg - on_deg > 2.0 * stroke_deg:
                break
            share = _share(angle_deg - on_deg, stroke_deg, off_deg - on_deg - stroke_deg)
            place = share * (_SHARES - 1)
            low = np.minimum(place.astype(int), _SHARES - 2)
            current_A = share_A[row, low] + (place - low) * (share_A[row, low + 1] - share_A[row, low])
            square_A2 = float((current_A**2).mean())
            if square_A2 < best_A2:
                best_A2, best = square_A2, (float(on_deg), float(off_deg))
    return best


def _share(since_on_deg: np.ndarray, stroke_deg: float, overlap_deg: float) -> np.ndarray:
    """The cubic of torque_sharing.h."""
    rise, fall = (np.clip(since / overlap_deg, 0.0, 1.0) for since in (since_on_deg, since_on_deg - stroke_deg))
    share: np.ndarray = rise**2 * (3.0 - 2.0 * rise) - fall**2 * (3.0 - 2.0 * fall)
    return share


def _current_of_share_A(magnetics: Any, angle_deg: np.ndarray, torque_Nm: float, current_max_A: float) -> np.ndarray:
    """By angle and share of the torque; very large above current_max_A."""
    grid_A = np.linspace(0.0, current_max_A, _CURRENTS)
    shares_Nm = np.linspace(0.0, torque_Nm, _SHARES)
    made_Nm = magnetics.torque_Nm((angle_deg / 360.0 * magnetics.pitch_rad)[:, None], grid_A[None, :])
    made_Nm = np.maximum.accumulate(np.maximum(made_Nm, 0.0), axis=1)
    current_A = np.array([np.interp(shares_Nm, row, grid_A, right=_UNREACHED * current_max_A) for row in made_Nm])
    current_A[:, 0] = 0.0
    return current_A
