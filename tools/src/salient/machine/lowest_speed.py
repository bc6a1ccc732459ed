"""Lowest speed at which a drive with a coarse encoder is steady.

Between two counts the rotor angle is an estimate, and the phases carry the currents of that angle. An error of it makes
an error of the torque, K times the angle with K the sum of the slopes dT/dtheta of the phases at their currents, and
grows where K is positive:

    J d2(error)/dt2 = K error,   s = sqrt(max K / J) in 1/s

A count that comes after the time t finds it exp(s t) times as large. The drive's law of slow counts
(firmware/control/slow_counts.h) reckons with that, up to s t = 5 with `salient`, whose torque is smooth, and half of
that with the laws of hysteresis and duty: found by trial with the bundled machines and four others, 9 to 14 bits.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.sharing_window import least_current_window_deg

COARSE_BITS = 12
"""Encoders of more bits have no lowest speed."""

GROWTH = {"salient": 5.0, "paper": 2.5, "traditional": 2.5}
"""Largest s t by controller."""

RATED_PART = 0.5
"""Part of the rated torque at which the slopes are taken."""

_ANGLES_DEG = np.arange(180.0, 361.0)
_CURRENTS = 160


def lowest_speed_rpm(machine: str, encoder_bits: int, controller: str) -> float:
    """Of a machine by its name or file; 0 with an encoder that is not coarse, or ideal (0 bits)."""
    if not 0 < encoder_bits <= COARSE_BITS:
        return 0.0
    return 60.0 * _error_growth_of_name_1_s(machine) / GROWTH[controller] / 2**encoder_bits


@lru_cache
def _error_growth_of_name_1_s(name: str) -> float:
    return error_growth_1_s(load_machine(machine_path(name)))


def error_growth_1_s(machine: Machine) -> float:
    """s at RATED_PART of the rated torque, shared with the least current."""
    data = derive(machine)
    torque_Nm = RATED_PART * data.torque_rated_Nm
    on_deg, off_deg = least_current_window_deg(machine.magnetics, machine.phases, torque_Nm, data.current_peak_A)
    stroke_deg = 360.0 / machine.phases
    angle_rad = _ANGLES_DEG / 360.0 * machine.magnetics.pitch_rad
    grid_A = np.linspace(0.0, data.current_peak_A, _CURRENTS)
    made_Nm = machine.magnetics.torque_Nm(angle_rad[:, None], grid_A[None, :])
    slope_Nm_rad = np.gradient(made_Nm, angle_rad, axis=0)
    share_Nm = torque_Nm * _share(_ANGLES_DEG - on_deg, stroke_deg, off_deg - on_deg - stroke_deg)
    stiffness_Nm_rad = np.zeros(len(_ANGLES_DEG))
    for row, share in enumerate(share_Nm):
        rising_Nm = np.maximum.accumulate(np.maximum(made_Nm[row], 0.0))
        current_A = np.interp(share, rising_Nm, grid_A) if share > 0.0 else 0.0
        stiffness_Nm_rad[row] = np.interp(current_A, grid_A, slope_Nm_rad[row])
    place = (_ANGLES_DEG % stroke_deg).astype(int)
    most_Nm_rad = float(np.bincount(place, stiffness_Nm_rad).max())
    return math.sqrt(max(most_Nm_rad, 0.0) / machine.inertia_kg_m2)


def _share(since_on_deg: np.ndarray, stroke_deg: float, overlap_deg: float) -> np.ndarray:
    """The cubic of firmware/control/torque_sharing.h."""
    rise, fall = (np.clip(since / overlap_deg, 0.0, 1.0) for since in (since_on_deg, since_on_deg - stroke_deg))
    share: np.ndarray = rise**2 * (3.0 - 2.0 * rise) - fall**2 * (3.0 - 2.0 * fall)
    return share
