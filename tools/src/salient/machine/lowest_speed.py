"""Lowest speed at which a drive with a coarse encoder is steady.

Between two counts, a time t apart, the rotor angle is an estimate, and the phases carry the currents of that angle. An
error of it makes an error of the torque, K times the angle with K the sum of the slopes dT/dtheta of the phases at
their currents, and grows where K is positive:

    J d2(error)/dt2 = K error,   s = sqrt(max K / J) in 1/s

The drive's law of slow counts (firmware/control/slow_counts.h) reckons with that, up to s t = 4.5 with `salient`, whose
torque is smooth, half of that with `paper` and a third with `traditional`. What the torque estimate errs by, e, changes
with the strokes, of which there are n in a turn: from count to count by 2 pi e n / 2^bits, which moves the rotor by a
count in t = sqrt(2 J / (n e)). That is the other bound of t, with e of a fiftieth of the torque. Both constants are
found by trial with the bundled machines and others, 9 to 14 bits.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.least_current import least_current_deg, sharing_function
from salient.machine.sharing_window import MORE_AT_REST

COARSE_BITS = 12
"""Encoders of more bits have no lowest speed."""

GROWTH_MAX = 4.5
TORQUE_ERROR = 0.02
HASTE = {"salient": 1.0, "paper": 2.0, "traditional": 3.0}
"""Factor by which the counts are to be closer, by controller."""

RATED_PART = 0.75
"""Part of the rated torque for which both are taken."""

_ANGLES_DEG = np.arange(180.0, 361.0)
_CURRENTS = 160


def lowest_speed_rpm(machine: str, encoder_bits: int, controller: str) -> float:
    """Lowest speed of a machine by its name or file, rounded up to 0.01 r/min, as messages name it; 0 with an encoder
    that is not coarse, or ideal (0 bits)."""
    if not 0 < encoder_bits <= COARSE_BITS:
        return 0.0
    return math.ceil(100.0 * HASTE[controller] * _lowest_rpm(machine, encoder_bits)) / 100.0


@lru_cache
def _lowest_rpm(name: str, encoder_bits: int) -> float:
    machine = load_machine(machine_path(name))
    torque_Nm = RATED_PART * derive(machine).torque_rated_Nm
    strokes = machine.phases * machine.rotor_poles
    drift_s = math.sqrt(2.0 * machine.inertia_kg_m2 / (strokes * TORQUE_ERROR * torque_Nm))
    return 60.0 / float(2**encoder_bits) * max(error_growth_1_s(machine) / GROWTH_MAX, 1.0 / drift_s)


def error_growth_1_s(machine: Machine) -> float:
    """s at RATED_PART of the rated torque, with the machine's window of torque sharing at standstill."""
    data = derive(machine)
    torque_Nm = RATED_PART * data.torque_rated_Nm
    on_deg, off_deg = least_current_deg(machine.magnetics, machine.phases, torque_Nm,
                                        data.parameters["current_limit_A"], MORE_AT_REST)
    stroke_deg = 360.0 / machine.phases
    angle_rad = _ANGLES_DEG / 360.0 * machine.magnetics.pitch_rad
    grid_A = np.linspace(0.0, data.current_peak_A, _CURRENTS)
    made_Nm = machine.magnetics.torque_Nm(angle_rad[:, None], grid_A[None, :])
    slope_Nm_rad = np.gradient(made_Nm, angle_rad, axis=0)
    share_Nm = torque_Nm * sharing_function(_ANGLES_DEG - 180.0 - on_deg, stroke_deg, off_deg - on_deg - stroke_deg)
    most_Nm_rad = _stiffness_Nm_rad(made_Nm, slope_Nm_rad, share_Nm, grid_A, machine.phases)
    return math.sqrt(max(most_Nm_rad, 0.0) / machine.inertia_kg_m2)


def _stiffness_Nm_rad(made_Nm: np.ndarray, slope_Nm_rad: np.ndarray, share_Nm: np.ndarray, grid_A: np.ndarray,
                      phases: int) -> float:
    """Largest sum of the phases' slopes, from torque and slope over angle and current and the torque of each angle."""
    own_Nm_rad = np.zeros(len(_ANGLES_DEG))
    for row, share in enumerate(share_Nm):
        rising_Nm = np.maximum.accumulate(np.maximum(made_Nm[row], 0.0))
        current_A = np.interp(share, rising_Nm, grid_A) if share > 0.0 else 0.0
        own_Nm_rad[row] = np.interp(current_A, grid_A, slope_Nm_rad[row])
    place = (_ANGLES_DEG % (360.0 / phases)).astype(int)
    return float(np.bincount(place, own_Nm_rad).max())
