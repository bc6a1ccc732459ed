"""The windows of the torque sharing function (firmware/control/torque_sharing.h) with the least RMS current, by half,
speed and torque.

Angles are electrical degrees past the start of the half of the wanted torque: motoring from the unaligned, braking from
the aligned position. At standstill they come from least_current.py. With speed the voltage limits the rate of the
flux linkage: phases follow their shares as far as it permits, the others make up for them as in
firmware/control/predictive_torque.h, and the best window is one that begins and ends earlier. By how much is found by
simulation at the base speed; it is proportional to the speed, as is the angle in which a voltage builds up a flux
linkage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData
from salient.machine.least_current import OVERLAP_MIN_DEG, WINDOW_SHARE, least_current_deg, sharing_function
from salient.machine.torque_speed import smooth_torque_Nm

PARTS = (0.25, 0.5, 0.75, 1.0)
"""Parts of the torque SharingWindow.torque_Nm, as MACHINE_SHARING_PARTS."""
SPEEDS = 2
"""Standstill and base speed, as MACHINE_SHARING_SPEEDS."""

_PULSE_PART = 0.6
"""Part of the peak torque for which the window of the pulses has the least current."""
_STEP_DEG = 2.0
"""Divides a stroke."""
_HALF = int(180 / _STEP_DEG)
_TURN = 2 * _HALF
_CURRENTS = 160
_FLUX_POINTS = 64
MORE_AT_REST, _MORE_AT_SPEED = 0.03, 0.01
"""Increase of the square of the current, relatively, for which a window is wider: the torque of phases that share a
revolution more evenly depends less on errors of angle and tables. At speed the voltage takes as much again."""
_EARLIER_DEG = np.arange(0.0, 49.0, 3.0)
"""By which an angle is earlier at the base speed than at standstill."""
_WIDTH_WEIGHT = 3e-4
"""Worth of a degree by which a window is wider: shares that change less in a control period."""
_VOLTAGE_PART = 0.93
"""Part of the voltage that a window may take: the rest is for the errors of a drive, whose torque ripples where nothing
is left."""
_LEAD_MAX_DEG = 20.0
"""SHARE_LEAD_MAX of firmware/control/conduction.c."""
_RIPPLE_FREE = 0.005
_RIPPLE_WEIGHT = 20.0
"""Relative square of the current that a ripple beyond _RIPPLE_FREE is worth."""
_FAR_DEG = 200.0
"""Between the angles of neighbouring parts that costs as much as the current: what lies between is interpolated."""
_EARLIER_WEIGHT = 1e-4
"""Worth of an earlier degree: where nothing else is better."""


@dataclass(frozen=True, eq=False)
class SharingWindow:
    """Windows of a machine."""

    torque_Nm: float
    """Largest torque of the drive that a window makes at every angle, at standstill."""
    window_deg: np.ndarray
    """(2, SPEEDS, PARTS, 2): motoring and braking; standstill and base speed; part; turn-on and turn-off."""

    pulse_deg: np.ndarray
    """(2, 2): motoring and braking; turn-on and turn-off of the window that the pulses for parts of the torque above
    base speed are found from, one for all torques: with windows that begin earlier for less torque, braking would
    return the energy of wide windows to a small DC link at once."""


def sharing_window(machine: Machine, data: DriveData) -> SharingWindow:
    """The windows of a machine with the nominal voltage and the limit current_limit_A."""
    limit_A = data.parameters["current_limit_A"]
    torque_Nm = min(WINDOW_SHARE * smooth_torque_Nm(machine.magnetics, machine.phases, limit_A),
                    data.parameters["torque_max_Nm"])
    parts_Nm = np.array(PARTS) * torque_Nm
    found_deg = np.array([[least_current_deg(machine.magnetics, machine.phases, of_Nm, limit_A, more)
                           for more in (_MORE_AT_SPEED, MORE_AT_REST)] for of_Nm in parts_Nm])
    phases = _Phases(machine, limit_A)
    base_rad_s = data.speed_base_rpm * math.pi / 30.0
    window_deg = []
    for braking in (False, True):
        of_half_deg = 180.0 - found_deg[..., ::-1] if braking else found_deg
        window_deg.append([of_half_deg[:, 1], _earlier_deg(phases, braking, base_rad_s, of_half_deg[:, 0], parts_Nm)])
    pulse_deg = least_current_deg(machine.magnetics, machine.phases, _PULSE_PART * data.torque_peak_Nm, limit_A, 0.0)
    return SharingWindow(torque_Nm, np.array(window_deg), np.array([pulse_deg, 180.0 - pulse_deg[::-1]]))


# --- speed ----------------------------------------------------------------------------------------------------------

def _earlier_deg(phases: _Phases, braking: bool, speed_rad_s: float, at_rest_deg: np.ndarray, parts_Nm: np.ndarray
                 ) -> np.ndarray:
    """Windows at a speed by part, from those at standstill."""
    on_earlier, off_earlier = (of.ravel() for of in np.meshgrid(_EARLIER_DEG, _EARLIER_DEG, indexing="ij"))
    earlier_deg = np.stack([on_earlier, off_earlier], axis=-1)
    tried_deg = at_rest_deg[:, None] - earlier_deg
    width_deg = tried_deg[..., 1] - tried_deg[..., 0]
    inside = ((width_deg >= phases.stroke_deg + OVERLAP_MIN_DEG) & (width_deg <= 2.0 * phases.stroke_deg)
              & (tried_deg[..., 0] >= -_LEAD_MAX_DEG))
    inside[:, 0] = True
    part, which = np.nonzero(inside)
    made = phases.run(braking, speed_rad_s, tried_deg[part, which], parts_Nm[part])
    ripple = np.maximum((made.largest_Nm - made.least_Nm) / parts_Nm[part] - _RIPPLE_FREE, 0.0)
    least_A2 = np.array([made.square_A2[part == of].min() for of in range(len(parts_Nm))])
    # In windows with little torque the current is small.
    missed = np.maximum(1.0 - made.least_Nm / parts_Nm[part], 0.0)
    cost = (made.square_A2 / least_A2[part] + _RIPPLE_WEIGHT * (ripple + missed)
            + _EARLIER_WEIGHT * earlier_deg[which].sum(axis=1) - _WIDTH_WEIGHT * width_deg[part, which])
    found_deg: list[np.ndarray] = []
    for of in range(len(parts_Nm)):
        own_deg, own_cost = tried_deg[of, which[part == of]], cost[part == of]
        if found_deg:
            own_cost = own_cost + (((own_deg - found_deg[-1]) / _FAR_DEG) ** 2).sum(axis=1)
        found_deg.append(own_deg[int(own_cost.argmin())])
    return np.array(found_deg)


@dataclass(frozen=True, eq=False)
class _Made:
    """By window, of all phases over a stroke."""

    least_Nm: np.ndarray
    largest_Nm: np.ndarray
    square_A2: np.ndarray
    """Mean of the sum of squares."""


class _Phases:
    """Phases that follow their shares between full voltages and up to the current limit, one step after another."""

    def __init__(self, machine: Machine, limit_A: float) -> None:
        magnetics, converter = machine.magnetics, machine.converter
        self.phases, self.pitch_rad = machine.phases, magnetics.pitch_rad
        self.stroke_deg = 360.0 / machine.phases
        self.voltage_V = machine.supply_voltage_V
        self.drop_ohm = machine.resistance_ohm + 2.0 * converter["switch_resistance_ohm"]
        # Rows from the unaligned to the aligned position.
        angle_rad = (np.arange(_HALF + 1) * _STEP_DEG / 360.0 + 0.5) * self.pitch_rad
        grid_A = np.linspace(0.0, limit_A, _CURRENTS)
        flux_Wb = np.maximum.accumulate(magnetics.flux_linkage_Wb(angle_rad[:, None], grid_A[None, :]), axis=1)
        torque_Nm = magnetics.torque_Nm(angle_rad[:, None], grid_A[None, :])
        torque_Nm = np.maximum.accumulate(np.maximum(torque_Nm, 0.0), axis=1)
        fraction = np.linspace(0.0, 1.0, _FLUX_POINTS)
        self.flux_top_Wb = flux_Wb[:, -1]
        of_flux = [[np.interp(fraction * flux[-1], flux, of) for of in (grid_A, torque)]
                   for flux, torque in zip(flux_Wb, torque_Nm, strict=True)]
        self.current_A, self.torque_Nm = np.moveaxis(np.array(of_flux), 1, 0)
        rising_Nm = self.torque_Nm + 1e-9 * torque_Nm.max() * fraction
        self.torque_top_Nm = rising_Nm[:, -1]
        self.flux_Wb = np.array([np.interp(fraction * row[-1], row, fraction * top)
                                 for row, top in zip(rising_Nm, self.flux_top_Wb, strict=True)])

    def run(self, braking: bool, speed_rad_s: float, window_deg: np.ndarray, torque_Nm: np.ndarray) -> _Made:
        """Windows (lanes, 2) and torques by lane."""
        on_deg, overlap_deg = window_deg[:, 0], window_deg[:, 1] - window_deg[:, 0] - self.stroke_deg
        stroke = _TURN // self.phases
        step_s = _STEP_DEG / 360.0 * self.pitch_rad / speed_rad_s
        step_Wb = _VOLTAGE_PART * self.voltage_V * step_s
        lane = np.arange(len(on_deg))
        flux_Wb, current_A = np.zeros((2, self.phases, len(lane)))
        total_Nm, square_A2 = np.zeros((stroke, len(lane))), np.zeros(len(lane))
        for step in range(_HALF + 2 * stroke):
            past = (step + 1 + stroke * np.arange(self.phases)) % _TURN
            inside = ((past > 0) & (past <= _HALF))[:, None]
            row = np.where(past <= _HALF, past, _TURN - past)
            row = (_HALF - row if braking else row)[:, None]
            since_on_deg = np.where(inside, past[:, None] * _STEP_DEG - on_deg, -1.0)
            share = np.where(inside, sharing_function(since_on_deg, self.stroke_deg, overlap_deg), 0.0)
            free_Wb = flux_Wb - self.drop_ohm * step_s * current_A
            least_Wb = np.maximum(free_Wb - step_Wb, 0.0)
            most_Wb = np.minimum(free_Wb + step_Wb, self.flux_top_Wb[row])
            if braking:
                most_Wb = np.minimum(most_Wb, np.where(inside, (_HALF - past)[:, None] * step_Wb, np.inf))
            most_Wb = np.maximum(most_Wb, least_Wb)
            flux_Wb = np.clip(np.where(share > 0.0, self._flux_of_torque_Wb(row, share * torque_Nm), 0.0),
                              least_Wb, most_Wb)
            sign = np.where(inside, 1.0, -1.0)
            made_Nm = self._at(self.torque_Nm, row, flux_Wb / self.flux_top_Wb[row])
            missing_Nm = torque_Nm - (sign * made_Nm).sum(axis=0)
            # A shortfall goes to the phase that entered last, an excess to the one that entered first.
            more = missing_Nm > 0.0
            able = inside & (since_on_deg >= 0.0) & np.where(more, flux_Wb < most_Wb, flux_Wb > least_Wb)
            order = np.where(able, np.where(more, since_on_deg, -since_on_deg), np.inf)
            first = order.argmin(axis=0)
            wanted_Wb = self._flux_of_torque_Wb(row[first, 0], np.maximum(made_Nm[first, lane] + missing_Nm, 0.0))
            corrected_Wb = np.clip(wanted_Wb, least_Wb[first, lane], most_Wb[first, lane])
            flux_Wb[first, lane] = np.where(np.isfinite(order[first, lane]), corrected_Wb, flux_Wb[first, lane])
            part = flux_Wb / self.flux_top_Wb[row]
            current_A = self._at(self.current_A, row, part)
            if step >= _HALF + stroke:
                total_Nm[step % stroke] = (sign * self._at(self.torque_Nm, row, part)).sum(axis=0)
                square_A2 += (current_A * current_A).sum(axis=0) / stroke
        return _Made(total_Nm.min(axis=0), total_Nm.max(axis=0), square_A2)

    def _flux_of_torque_Wb(self, row: np.ndarray, torque_Nm: np.ndarray) -> np.ndarray:
        return self._at(self.flux_Wb, row, torque_Nm / self.torque_top_Nm[row])

    @staticmethod
    def _at(table: np.ndarray, row: np.ndarray, part: np.ndarray) -> np.ndarray:
        place = np.clip(part, 0.0, 1.0) * (_FLUX_POINTS - 1)
        low = np.minimum(place.astype(np.intp), _FLUX_POINTS - 2)
        below = table[row, low]
        result: np.ndarray = below + (place - low) * (table[row, low + 1] - below)
        return result
