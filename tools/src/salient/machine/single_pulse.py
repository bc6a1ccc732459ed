"""Single pulse operation: the turn-on and turn-off angles with which a machine makes its largest mean torque at a
speed, those torques, and the flux linkage from which a braking current can still be ended
(firmware/control/conduction.h).

Angles are electrical degrees of a phase: 180 is the unaligned, 360 the aligned position, from 360 to 540 the torque
brakes. A pulse is the full DC-link voltage from a turn-on to a turn-off angle, the current limited by ideal chopping,
then the full opposite voltage until the flux linkage is zero, which it has to be before the next turn-on.

Without resistance only speed / voltage matters; with it, the nominal voltage stands for all. The search needs neither a
simulation for each pair of angles nor one for each turn-off: the rise of the flux linkage depends on the turn-on alone,
its fall on the angle at which it ends, and both meet at the turn-off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData

POINTS = 17
"""As MACHINE_PULSE_POINTS: equidistant speeds per voltage, the first at standstill."""
SPEED_PER_BASE = (3.0, 5.0)
"""Range of the last speed, as a multiple of the base speed: twice the base speed at 70 % of the voltage is below it."""

# Steps divide a stroke and a lane; between lanes the search interpolates. Its ranges are the angles' and a lane
# more where a maximum may be at their end.
STEP_DEG = 3
TURN = 360 // STEP_DEG
LANE_DEG = 6
"""Between turn-on angles, turn-off angles and ends of the flux linkage."""
_LANE_STEPS = LANE_DEG // STEP_DEG
_FALL_LANES = 32
_NEAR_LANES = 3
"""Within which a maximum is followed from speed to speed."""
_MOTORING_ON_DEG, _MOTORING_OFF_DEG = (60, 186), (192, 354)
_BRAKING_ON_DEG, _BRAKING_OFF_DEG = (198, 366), (372, 546)
_LATER_ON_DEG = 60
"""Turn-on angles after these, of parts of the largest torque."""
_MOTORING_OFF_MAX_DEG = 353.0
_SMOOTH_OFF_DEG = np.append(np.arange(240.0, 353.0, 8.0), 358.0)
_FINE_DEG = 0.25
"""Step of the braking envelope."""
_FLUX_POINTS = 48
_CURRENT_TOP = 1.2
"""Largest current of the tables, as a multiple of the limit."""
_CURRENT_OVER = 1.03
"""A current that rises above its limit against the full voltage, by which a pair of angles is refused."""
_REST_DEG = 2.0
"""Between the end of the flux linkage and the next turn-on."""
_CURRENT_WEIGHT = 0.05
"""Relative torque that a relative square of the RMS current is worth."""
_VOLTAGE_SHARE_MAX = 0.95
"""Share of voltage that the resistance may take, and of the supply that the switches may: a current that is not reached
is no limit."""


@dataclass(frozen=True, eq=False)
class SinglePulse:
    """By speed; first axis of two: motoring, braking. SI units."""

    speed_per_voltage: np.ndarray
    """(POINTS,), rad/s of the rotor per volt."""
    base_speed_per_voltage: float
    lead_deg: np.ndarray
    """(2, POINTS), turn-on before the half of the wanted torque."""
    end_deg: np.ndarray
    """(2, POINTS), turn-off past the start of that half."""
    smooth_Nm: np.ndarray
    """(2, POINTS), largest torque without lead and without ripple."""
    mean_Nm: np.ndarray
    """(2, POINTS), largest mean torque."""
    peak_Nm: np.ndarray
    """(2, POINTS), largest sum of the phases' torques in a pulse of the largest mean torque."""
    braking_end_deg: np.ndarray
    """(POINTS,), past the aligned position: until there full opposite voltage keeps a current within its limit when the
    flux linkage is at most braking_flux_Wb + voltage / speed * angle."""
    braking_flux_Wb: np.ndarray
    """(POINTS,), at the current limit at that angle."""


def single_pulse(machine: Machine, data: DriveData, speed_per_voltage_least: float = 0.0) -> SinglePulse:
    """The pulses of a machine with the nominal voltage and the limit current_limit_A. speed_per_voltage_least: of the
    last speed, rad/s/V."""
    phase = Phase(machine, data.parameters["current_limit_A"])
    base_rad_s = data.speed_base_rpm * math.pi / 30.0
    low, high = SPEED_PER_BASE
    last_rad_s = min(max(data.speed_max_rpm * math.pi / 30.0, low * base_rad_s), high * base_rad_s)
    last_rad_s = max(last_rad_s, speed_per_voltage_least * machine.supply_voltage_V)
    speed_rad_s = np.arange(POINTS) * last_rad_s / (POINTS - 1)
    pairs = phase.pairs(speed_rad_s[1:])
    on_deg, off_deg = phase.best_angles(pairs)
    on_deg = _smoothed(np.insert(on_deg, 0, [180.0, 360.0], axis=1))
    off_deg = _smoothed(np.insert(off_deg, 0, [_MOTORING_OFF_MAX_DEG, 540.0], axis=1))

    # At standstill the current limit alone counts: any speed that is low enough.
    seen_rad_s = np.append(1e-3 * speed_rad_s[1], speed_rad_s[1:])
    begin_deg, ends = np.array([[180.0], [360.0]]), len(_SMOOTH_OFF_DEG)
    smooth_on_deg = np.broadcast_to(np.repeat(begin_deg, ends)[:, None], (2 * ends, POINTS))
    smooth_off_deg = np.broadcast_to((begin_deg - 180.0 + _SMOOTH_OFF_DEG).reshape(-1, 1), (2 * ends, POINTS))
    torque_Nm = phase.torque_Nm(seen_rad_s, np.concatenate([on_deg, smooth_on_deg]).T,
                                np.concatenate([off_deg, smooth_off_deg]).T)
    total_Nm = torque_Nm.reshape(-1, TURN // machine.phases, *torque_Nm.shape[1:]).sum(axis=0)
    pulse_Nm = total_Nm[..., :2]
    smooth_Nm = [(sign * total_Nm[..., lanes]).min(axis=0).max(axis=1)
                 for sign, lanes in ((1.0, slice(2, 2 + ends)), (-1.0, slice(2 + ends, None)))]
    end_deg, flux_Wb = phase.envelope(seen_rad_s)
    return SinglePulse(
        speed_per_voltage=speed_rad_s / machine.supply_voltage_V,
        base_speed_per_voltage=base_rad_s / machine.supply_voltage_V,
        lead_deg=begin_deg - on_deg,
        end_deg=off_deg - begin_deg,
        smooth_Nm=np.maximum(smooth_Nm, 0.0),
        mean_Nm=np.abs(pulse_Nm.mean(axis=0)).T,
        peak_Nm=np.abs(pulse_Nm).max(axis=0).T,
        braking_end_deg=end_deg,
        braking_flux_Wb=flux_Wb,
    )


@dataclass(frozen=True, eq=False)
class _Sweep:
    """Rises from turn-on to turn-off, or falls from turn-off to zero; by turn-off angle, speed, and turn-on or end."""

    flux_Wb: np.ndarray
    """At turn-off."""
    torque: np.ndarray
    """Integral over the angle, N m times steps."""
    square: np.ndarray
    """Sum of the square of the current, A^2 times steps."""
    over: np.ndarray
    """Largest flux linkage, as a fraction of the flux linkage of _CURRENT_OVER times the current limit."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of turn-on and turn-off angles; arrays by turn-off, speed and turn-on."""

    on_deg: np.ndarray
    off_deg: np.ndarray
    torque_Nm: np.ndarray
    """Mean of a phase over a revolution, in the direction that is wanted."""
    square_A2: np.ndarray
    """Mean square of the current."""
    margin: np.ndarray
    """Both limits are met by turning on later; not negative: met."""

    def turned_on_until(self, last_deg: float) -> Pairs:
        """Those that turn on up to an angle."""
        lanes = self.on_deg <= last_deg
        return Pairs(self.on_deg[lanes], self.off_deg, self.torque_Nm[..., lanes], self.square_A2[..., lanes],
                     self.margin[..., lanes])


class Phase:
    """A phase between full voltages."""

    def __init__(self, machine: Machine, current_limit_A: float) -> None:
        magnetics, converter = machine.magnetics, machine.converter
        self.pitch_rad = magnetics.pitch_rad
        # Two devices conduct.
        self.rise_V = max(machine.supply_voltage_V - 2.0 * converter["switch_drop_V"],
                          (1.0 - _VOLTAGE_SHARE_MAX) * machine.supply_voltage_V)
        self.fall_V = machine.supply_voltage_V + 2.0 * converter["diode_drop_V"]
        self.rise_ohm = machine.resistance_ohm + 2.0 * converter["switch_resistance_ohm"]
        self.fall_ohm = machine.resistance_ohm + 2.0 * converter["diode_resistance_ohm"]
        self.limit_A = min(current_limit_A, _VOLTAGE_SHARE_MAX * self.rise_V / self.rise_ohm)
        self.voltage_V = machine.supply_voltage_V

        half_deg = np.arange(180.0, 361.0, STEP_DEG)[:, None]
        angle_rad = half_deg / 360.0 * self.pitch_rad
        grid_A = np.linspace(0.0, _CURRENT_TOP * self.limit_A, _FLUX_POINTS)
        grid_Wb = magnetics.flux_linkage_Wb(angle_rad, grid_A)
        grid_Nm = np.maximum(magnetics.torque_Nm(angle_rad, grid_A), 0.0)
        fraction = np.linspace(0.0, 1.0, _FLUX_POINTS)
        curves = [(np.interp(fraction * flux_Wb[-1], flux_Wb, grid_A), np.interp(fraction * flux_Wb[-1], flux_Wb, of))
                  for flux_Wb, of in zip(grid_Wb, grid_Nm, strict=True)]
        half = np.array(curves).transpose(0, 2, 1)  # angle, flux linkage, current and torque
        braking = half[-2:0:-1] * np.array([1.0, -1.0])
        table = np.concatenate([half, braking])  # from 180 degrees, a turn
        self.slope = np.diff(table, axis=1, append=table[:, -1:])
        self.begin = table - self.slope * np.arange(_FLUX_POINTS)[:, None]
        rows = np.abs(table[..., 1])
        self.torque_top_Nm = np.maximum(rows.max(axis=1), 1e-9 * rows.max())
        self.flux_top_Wb = _whole(grid_Wb[:, -1])
        self.flux_of_torque_Wb = np.array([
            np.interp(fraction * torque_top_Nm, np.maximum.accumulate(row), fraction * flux_top_Wb)
            for row, torque_top_Nm, flux_top_Wb in zip(rows, self.torque_top_Nm, self.flux_top_Wb, strict=True)])
        self.place_1_Wb = (_FLUX_POINTS - 1) / _whole(grid_Wb[:, -1])
        self.limit_Wb = _whole(magnetics.flux_linkage_Wb(angle_rad[:, 0], self.limit_A))
        self.over_Wb = _whole(magnetics.flux_linkage_Wb(angle_rad[:, 0], _CURRENT_OVER * self.limit_A))
        fine_rad = np.arange(0.0, 180.0 + _FINE_DEG, _FINE_DEG) / 360.0 * self.pitch_rad
        self.fine_limit_Wb = magnetics.flux_linkage_Wb(fine_rad, self.limit_A)

    def state(self, index: Any, flux_Wb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Current and torque at a multiple of STEP_DEG, or at one for each phase."""
        row = _row(index)
        place = np.minimum(flux_Wb * self.place_1_Wb[row], _FLUX_POINTS - 1.0)
        low = place.astype(np.intp)
        if np.ndim(row) == 0:
            value = self.begin[row].take(low, axis=0) + self.slope[row].take(low, axis=0) * place[..., None]
        else:
            value = self.begin[row, low] + self.slope[row, low] * place[..., None]
        return value[..., 0], value[..., 1]

    def flux_Wb(self, index: Any, torque_Nm: np.ndarray) -> np.ndarray:
        """Flux linkage of a torque by magnitude; the largest where no current makes it."""
        row = _row(index)
        place = np.minimum(torque_Nm / self.torque_top_Nm[row], 1.0) * (_FLUX_POINTS - 1)
        low = np.minimum(place.astype(np.intp), _FLUX_POINTS - 2)
        below = self.flux_of_torque_Wb[row, low]
        flux_Wb: np.ndarray = below + (place - low) * (self.flux_of_torque_Wb[row, low + 1] - below)
        return flux_Wb

    def step_s(self, speed_rad_s: np.ndarray) -> np.ndarray:
        """By speed, as a column."""
        step_s: np.ndarray = STEP_DEG / 360.0 * self.pitch_rad / speed_rad_s[:, None]
        return step_s

    def pairs(self, speed_rad_s: np.ndarray) -> list[Pairs]:
        """Motoring and braking."""
        falls = self._falls(speed_rad_s, _MOTORING_OFF_DEG[0], _BRAKING_OFF_DEG[1])
        found = []
        for sign, on_range_deg, off_range_deg in (
            (1.0, _MOTORING_ON_DEG, _MOTORING_OFF_DEG), (-1.0, _BRAKING_ON_DEG, _BRAKING_OFF_DEG),
        ):
            on_deg = np.arange(on_range_deg[0], on_range_deg[1] + _LATER_ON_DEG + 1, LANE_DEG)
            off_deg = np.arange(off_range_deg[0], off_range_deg[1] + 1, LANE_DEG)
            row = (off_deg[0] - _MOTORING_OFF_DEG[0]) // LANE_DEG
            fall = _Sweep(*(of[row : row + len(off_deg)] for of in vars(falls).values()))
            found.append(_pairs(self._rises(speed_rad_s, on_deg, off_deg), fall, sign, on_deg, off_deg))
        return found

    def best_angles(self, pairs: list[Pairs]) -> tuple[np.ndarray, np.ndarray]:
        """Turn-on and turn-off angles of the largest mean torque: motoring and braking, by speed."""
        found = [_best(of.turned_on_until(last_deg)) for of, last_deg in zip(
            pairs, (_MOTORING_ON_DEG[1], _BRAKING_ON_DEG[1]), strict=True)]
        on_deg, off_deg = (np.array(angle_deg) for angle_deg in zip(*found, strict=True))
        return (np.minimum(on_deg, [[180.0], [360.0]]), np.minimum(off_deg, [[_MOTORING_OFF_MAX_DEG], [540.0]]))

    def _rises(self, speed_rad_s: np.ndarray, on_deg: np.ndarray, off_deg: np.ndarray) -> _Sweep:
        """Full voltage and ideal chopping from rising turn-on angles to every turn-off angle."""
        step_s = self.step_s(speed_rad_s)
        rise_Wb, fall_Wb = self.rise_V * step_s, self.fall_V * step_s
        rise_ohm_s, fall_ohm_s = self.rise_ohm * step_s, self.fall_ohm * step_s
        cap_Wb = self.cap_Wb(speed_rad_s, int(off_deg[-1]) // STEP_DEG)[..., None]
        flux_Wb, current_A, torque_Nm, torque, square, over = np.zeros((6, len(speed_rad_s), len(on_deg)))
        rows = []
        for index in range(on_deg[0] // STEP_DEG + 1, off_deg[-1] // STEP_DEG + 1):
            lanes = np.s_[:, : (index * STEP_DEG - on_deg[0] - 1) // LANE_DEG + 1]
            before_Wb, before_A, before_Nm = flux_Wb[lanes], current_A[lanes], torque_Nm[lanes]
            # Chopping takes at most what the opposite voltage does.
            least_Wb = np.maximum(before_Wb - (fall_Wb + fall_ohm_s * before_A), cap_Wb[index])
            after_Wb = np.minimum(before_Wb + (rise_Wb - rise_ohm_s * before_A), least_Wb)
            after_A, after_Nm = self.state(index, after_Wb)
            torque[lanes] += 0.5 * (before_Nm + after_Nm)
            square[lanes] += 0.5 * (before_A * before_A + after_A * after_A)
            over[lanes] = np.maximum(over[lanes], after_Wb / self.over_Wb[_row(index)])
            flux_Wb[lanes], current_A[lanes], torque_Nm[lanes] = after_Wb, after_A, after_Nm
            if index * STEP_DEG >= off_deg[0] and (index * STEP_DEG - off_deg[0]) % LANE_DEG == 0:
                rows.append(np.stack([flux_Wb, torque, square, over]))
        return _Sweep(*np.stack(rows, axis=1))

    def _falls(self, speed_rad_s: np.ndarray, first_deg: int, last_deg: int) -> _Sweep:
        """Full opposite voltage from turn-off angles until the flux linkage is zero, backwards; the last axis is the
        angle between both in multiples of LANE_DEG."""
        step_s = self.step_s(speed_rad_s)
        fall_Wb, fall_ohm_s = self.fall_V * step_s, self.fall_ohm * step_s
        # Ends beyond those that are searched: more than any flux linkage.
        flux_Wb, current_A, torque_Nm, torque, square, over = np.zeros((6, len(speed_rad_s), _FALL_LANES))
        flux_Wb[:, 1:] = 1e3 * self.limit_Wb.max()
        rows = []
        for index in range((_BRAKING_ON_DEG[1] + 360) // STEP_DEG - 1, first_deg // STEP_DEG - 1, -1):
            flux_Wb = flux_Wb + (fall_Wb + fall_ohm_s * current_A)
            after_A, after_Nm = self.state(index, flux_Wb)
            torque = torque + 0.5 * (torque_Nm + after_Nm)
            square = square + 0.5 * (current_A * current_A + after_A * after_A)
            over = np.maximum(over, flux_Wb / self.over_Wb[_row(index)])
            current_A, torque_Nm = after_A, after_Nm
            if index % _LANE_STEPS == 0:  # the next end
                moved = np.zeros((6, *flux_Wb.shape))
                moved[..., 1:] = np.stack([flux_Wb, current_A, torque_Nm, torque, square, over])[..., :-1]
                flux_Wb, current_A, torque_Nm, torque, square, over = moved
                if index * STEP_DEG <= last_deg:
                    rows.append(moved[[0, 3, 4, 5]])
        return _Sweep(*np.stack(rows[::-1], axis=1))

    def torque_Nm(self, speed_rad_s: np.ndarray, on_deg: np.ndarray, off_deg: np.ndarray) -> np.ndarray:
        """Torque of a phase in two turns, by angle, speed and pulse."""
        step_s = self.step_s(speed_rad_s)
        rise_Wb, fall_Wb = self.rise_V * step_s, self.fall_V * step_s
        rise_ohm_s, fall_ohm_s = self.rise_ohm * step_s, self.fall_ohm * step_s
        first = _MOTORING_ON_DEG[0] // STEP_DEG
        indices = np.arange(first, first + 2 * TURN)
        cap_Wb = self.cap_Wb(speed_rad_s, int(indices[-1]))[..., None]
        # Parts of a step with the voltage and with the opposite one.
        off = np.clip(indices[:, None, None] - off_deg / STEP_DEG, 0.0, 1.0)
        on = np.clip(indices[:, None, None] - on_deg / STEP_DEG, 0.0, 1.0) - off
        torque_Nm = np.zeros((len(indices), *on_deg.shape))
        flux_Wb, current_A = np.zeros((2, *on_deg.shape))
        for at in range(1, len(indices)):
            falling_Wb = fall_Wb + fall_ohm_s * current_A
            free_Wb = flux_Wb + on[at] * (rise_Wb - rise_ohm_s * current_A) - off[at] * falling_Wb
            held_Wb = np.minimum(free_Wb, np.maximum(cap_Wb[indices[at]], flux_Wb - falling_Wb))
            flux_Wb = np.maximum(np.where(on[at] > 0.0, held_Wb, free_Wb), 0.0)
            current_A, torque_Nm[at] = self.state(int(indices[at]), flux_Wb)
        return torque_Nm

    def envelope(self, speed_rad_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle past the aligned position and flux linkage at which the current limit's, on its way to the
        unaligned position, begins to fall slower than the full opposite voltage takes it down; where it falls fastest
        at a speed at which it never falls faster."""
        limit_Wb = self.fine_limit_Wb
        fall_Wb = -np.diff(limit_Wb)
        steepest = int(np.flatnonzero(fall_Wb >= 0.999 * fall_Wb.max())[-1])
        taken_Wb = self.voltage_V * self.step_s(speed_rad_s)[:, 0] * (_FINE_DEG / STEP_DEG)
        above_Wb = limit_Wb + taken_Wb[:, None] * np.arange(len(limit_Wb))
        at = steepest + above_Wb[:, steepest:].argmin(axis=1)
        return at * _FINE_DEG, limit_Wb[at]

    def cap_Wb(self, speed_rad_s: np.ndarray, last: int) -> np.ndarray:
        """By angle from zero in steps and speed: the largest flux linkage from which full opposite voltage keeps the
        current within its limit."""
        index = np.arange(last + 1)
        limit_Wb = self.limit_Wb[_row(index)][:, None]
        end_deg, flux_Wb = self.envelope(speed_rad_s)
        left_deg = end_deg + 360.0 - STEP_DEG * index[:, None]
        line_Wb = flux_Wb + self.voltage_V * self.step_s(speed_rad_s)[:, 0] / STEP_DEG * left_deg
        cap_Wb: np.ndarray = np.where(left_deg > 0.0, np.minimum(limit_Wb, line_Wb), limit_Wb)
        return cap_Wb


def _row(index: Any) -> Any:
    """Row of the tables of a turn, by the angle in steps."""
    return (index - 180 // STEP_DEG) % TURN


def _whole(half: np.ndarray) -> np.ndarray:
    """A turn from the half from 180 to 360 degrees."""
    return np.concatenate([half, half[-2:0:-1]])


# --- search ---------------------------------------------------------------------------------------------------------

def _pairs(rise: _Sweep, fall: _Sweep, sign: float, on_deg: np.ndarray, off_deg: np.ndarray) -> Pairs:
    """Pairs of a rise and the fall that meets it."""
    below = (fall.flux_Wb[..., None, :] <= rise.flux_Wb[..., None]).sum(axis=-1) - 1
    below = np.clip(below, 0, fall.flux_Wb.shape[-1] - 2)

    def both(of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.take_along_axis(of, below, axis=-1), np.take_along_axis(of, below + 1, axis=-1)

    low_Wb, high_Wb = both(fall.flux_Wb)
    part = np.minimum((rise.flux_Wb - low_Wb) / (high_Wb - low_Wb), 1.0)

    def in_fall(of: np.ndarray) -> np.ndarray:
        low, high = both(of)
        result: np.ndarray = low + part * (high - low)
        return result

    end_deg = off_deg[:, None, None] + LANE_DEG * (below + part)
    margin = np.minimum(on_deg + 360.0 - _REST_DEG - end_deg,
                        100.0 * (1.0 - np.maximum(rise.over, in_fall(fall.over))))
    return Pairs(on_deg, off_deg, sign * (rise.torque + in_fall(fall.torque)) / TURN,
                 (rise.square + in_fall(fall.square)) / TURN, margin)


def _best(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Turn-on and turn-off angles of the largest mean torque, by speed."""
    on_deg, off_deg, torque, square, margin = (
        pairs.on_deg, pairs.off_deg, pairs.torque_Nm, pairs.square_A2, pairs.margin)
    met = margin >= 0.0

    by_speed = np.where(met, torque, -np.inf).transpose(1, 0, 2).reshape(torque.shape[1], -1)
    largest = by_speed.argmax(axis=1)[:, None]
    of_largest = [np.take_along_axis(of.transpose(1, 0, 2).reshape(by_speed.shape), largest, axis=1)
                  for of in (torque, square)]
    score = torque / np.abs(of_largest[0]) - _CURRENT_WEIGHT * square / of_largest[1]

    # Turn-on by turn-off, continuous between the lanes and up to where the margin is used up.
    best = np.where(met, score, -np.inf).argmax(axis=-1)
    before, here, _ = _three(margin, best)
    room = np.where(before < 0.0, np.maximum(here, 0.0) / np.maximum(here - before, 1e-12), 1.0)
    shift = np.clip(vertex(score, best), -room, 1.0)
    any_met = met.any(axis=-1)
    on_by_off = np.where(any_met, on_deg[best] + shift * LANE_DEG, np.nan).T
    score_by_off = np.where(any_met, parabola(score, best, shift), -np.inf).T

    best = _followed(score_by_off)
    shift = vertex(score_by_off, best)
    off = np.minimum(off_deg[best] + shift * LANE_DEG, off_deg[-1])
    return np.clip(parabola(on_by_off, best, shift), on_deg[0], on_deg[-1]), off


def _followed(score: np.ndarray) -> np.ndarray:
    """Index of the maximum of each row, and where there are two, of that which follows from the row before: angles
    between two speeds are interpolated, and those between two maxima may be bad."""
    found = np.zeros(len(score), dtype=np.intp)
    at = int(score[0].argmax())
    for row, values in enumerate(score):
        before = -1
        while at != before:
            before, first = at, max(at - _NEAR_LANES, 0)
            at = first + int(values[first : at + _NEAR_LANES + 1].argmax())
        found[row] = at
    return found


def _smoothed(angle_deg: np.ndarray) -> np.ndarray:
    """Over the speed: the maximum of a flat torque is found to some degrees only."""
    smoothed_deg = angle_deg.copy()
    smoothed_deg[:, 1:-1] += 0.25 * np.diff(angle_deg, 2)
    return smoothed_deg


def _three(values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values at an index of the last axis and beside it; where there is none, that at the index."""
    last = values.shape[-1] - 1
    here = np.take_along_axis(values, at[..., None], axis=-1)[..., 0]
    sides = [np.take_along_axis(values, np.clip(at + step, 0, last)[..., None], axis=-1)[..., 0] for step in (-1, 1)]
    before, after = (np.where(np.isfinite(side), side, here) for side in sides)
    return before, here, after


def vertex(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Place of the maximum of the parabola through the values at an index of the last axis and beside it, -1..1."""
    before, here, after = _three(values, at)
    curvature = before - 2.0 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.where(curvature < 0.0, 0.5 * (before - after) / curvature, np.sign(after - before))
    return np.where(np.isfinite(place), np.clip(place, -1.0, 1.0), 0.0)


def parabola(values: np.ndarray, at: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Value of that parabola."""
    before, here, after = _three(values, at)
    result: np.ndarray = here + 0.5 * place * (after - before) + 0.5 * place**2 * (before - 2.0 * here + after)
    return result
