"""Single pulse operation: the turn-on and turn-off angles with which a machine makes its largest mean torque at a speed,
those torques, and the flux linkage from which a braking current can still be ended, for firmware/control/single_pulse.h.

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
from salient.machine.scaling import Exponents, Scaling

POINTS = 17
"""As MACHINE_PULSE_POINTS: equidistant speeds per voltage, the first at standstill."""
SPEED_PER_BASE = (3.0, 5.0)
"""Range of the last speed, as a multiple of the base speed: twice the base speed at 70 % of the voltage is below it."""

_UINT16_MAX, _HALF_TURN = (1 << 16) - 1, 1 << 15
_INDEX_BITS = 12 + 32 - 22 + 6
"""Fraction bits of the index at the last speed, less those of a speed and a voltage: the index is
((speed_q22 * scale) >> 32) / voltage_q6, 2^12 at the last one."""

_STEP_DEG = 2
_TURN = 360 // _STEP_DEG
_FIRST_DEG = 60
_LANE_DEG = 4  # of turn-on angles, turn-off angles and ends of the flux linkage in the search
_MOTORING_ON_DEG, _MOTORING_OFF_DEG = (60, 180), (184, 352)
_BRAKING_ON_DEG, _BRAKING_OFF_DEG = (200, 360), (364, 540)
_MOTORING_OFF_MAX_DEG = 353.0
_SMOOTH_OFF_DEG = np.arange(240.0, 353.0, 8.0)
_FINE_DEG = 0.25
_FLUX_POINTS = 48
_CURRENT_TOP = 1.2
"""Largest current of the tables, as a multiple of the limit."""
_CURRENT_OVER = 1.03
"""A current that rises above its limit against the full voltage, by which a pair of angles is refused."""
_REST_DEG = 2.0
"""Between the end of the flux linkage and the next turn-on."""
_CURRENT_WEIGHT = 0.02
"""Relative torque that a relative square of the RMS current is worth."""
_VOLTAGE_SHARE_MAX = 0.95
"""Of the voltage that the resistance may take: the current is not limited above it."""


@dataclass(frozen=True, eq=False)
class SinglePulse:
    """By speed; first axis of two: motoring, braking. SI units."""

    speed_per_voltage: np.ndarray
    """(POINTS,), rad/s of the rotor per volt."""
    lead_deg: np.ndarray
    """(2, POINTS), turn-on before the half of the wanted torque."""
    end_deg: np.ndarray
    """(2, POINTS), turn-off past the begin of that half."""
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


@dataclass(frozen=True, eq=False)
class PulseTables:
    """In the units of a machine and the formats of firmware/control/machine_tables.h, rounded and saturated."""

    index_scale: int
    pulse: np.ndarray
    """(2, POINTS, 5): the members of machine_pulse_t."""
    braking_end: np.ndarray
    braking_flux: np.ndarray

    def pulses(self) -> list[list[tuple[int, ...]]]:
        """The values of machine_pulse_t."""
        return [[tuple(row) for row in half] for half in self.pulse.tolist()]


def pulse_tables(machine: Machine, scaling: Scaling) -> PulseTables:
    """The tables of a machine."""
    return in_units(single_pulse(machine, scaling.data), scaling.exponents)


def in_units(pulse: SinglePulse, exponents: Exponents) -> PulseTables:
    """The tables in units."""
    angles = [_rounded(angle_deg / 360.0, 16, limit) for angle_deg, limit in (
        (pulse.lead_deg, _UINT16_MAX), (pulse.end_deg, _HALF_TURN))]
    torques = [_rounded(torque_Nm, 8 - exponents.torque) for torque_Nm in (
        pulse.smooth_Nm, pulse.mean_Nm, pulse.peak_Nm)]
    last = math.ldexp(float(pulse.speed_per_voltage[-1]), exponents.voltage - exponents.speed)
    return PulseTables(
        index_scale=int(_rounded(1.0 / last, _INDEX_BITS, (1 << 31) - 1)),
        pulse=np.stack([*angles, *torques], axis=-1),
        braking_end=_rounded(pulse.braking_end_deg / 360.0, 16, _HALF_TURN),
        braking_flux=_rounded(pulse.braking_flux_Wb, 13 - exponents.voltage),
    )


def _rounded(value: Any, fraction_bits: int, limit: int = _UINT16_MAX) -> np.ndarray:
    result: np.ndarray = np.clip(np.floor(np.ldexp(value, fraction_bits) + 0.5), 0, limit).astype(np.int64)
    return result


def single_pulse(machine: Machine, data: DriveData) -> SinglePulse:
    """The pulses of a machine with the nominal voltage and the limit current_limit_A."""
    phase = _Phase(machine, data.parameters["current_limit_A"])
    base_rad_s = data.speed_base_rpm * math.pi / 30.0
    low, high = SPEED_PER_BASE
    last_rad_s = min(max(data.speed_max_rpm * math.pi / 30.0, low * base_rad_s), high * base_rad_s)
    speed_rad_s = np.arange(POINTS) * last_rad_s / (POINTS - 1)
    moving_rad_s = speed_rad_s[1:]

    rise = phase.run(moving_rad_s, np.arange(_MOTORING_ON_DEG[0], _BRAKING_ON_DEG[1] + 1.0, _LANE_DEG)[None, :],
                     np.inf, _BRAKING_OFF_DEG[1])
    fall = phase.falls(moving_rad_s)
    pairs = [_best(rise, fall, 1.0, _MOTORING_ON_DEG, _MOTORING_OFF_DEG),
             _best(rise, fall, -1.0, _BRAKING_ON_DEG, _BRAKING_OFF_DEG)]
    on_deg = np.array([np.append(180.0, pairs[0][0]), np.append(360.0, pairs[1][0])])
    off_deg = np.array([np.append(_MOTORING_OFF_MAX_DEG, np.minimum(pairs[0][1], _MOTORING_OFF_MAX_DEG)),
                        np.append(540.0, pairs[1][1])])

    # At standstill the current limit alone counts: any speed that is low enough.
    seen_rad_s = np.append(1e-3 * speed_rad_s[1], moving_rad_s)
    pulse_Nm = _stroke_torque(machine.phases, phase.run(seen_rad_s, on_deg.T, off_deg.T).torque_Nm)
    smooth_Nm = [_stroke_torque(machine.phases, sign * phase.run(seen_rad_s, begin, off[None, :]).torque_Nm)
                 .min(axis=0).max(axis=1)
                 for sign, begin, off in ((1.0, 180.0, _SMOOTH_OFF_DEG), (-1.0, 360.0, 180.0 + _SMOOTH_OFF_DEG))]
    end_deg, flux_Wb = phase.envelope(seen_rad_s)
    return SinglePulse(
        speed_per_voltage=speed_rad_s / machine.supply_voltage_V,
        lead_deg=np.array([[180.0], [360.0]]) - on_deg,
        end_deg=off_deg - np.array([[180.0], [360.0]]),
        smooth_Nm=np.maximum(smooth_Nm, 0.0),
        mean_Nm=np.abs(pulse_Nm.mean(axis=0)).T,
        peak_Nm=np.abs(pulse_Nm).max(axis=0).T,
        braking_end_deg=end_deg,
        braking_flux_Wb=flux_Wb,
    )


def _stroke_torque(phases: int, torque_Nm: np.ndarray) -> np.ndarray:
    """Sum of all phases over a stroke, of the torque of one from its turn-on to its end, by angle."""
    steps = _TURN // phases
    padded = np.zeros((-len(torque_Nm) % steps + len(torque_Nm), *torque_Nm.shape[1:]))
    padded[: len(torque_Nm)] = torque_Nm
    total: np.ndarray = padded.reshape(-1, steps, *torque_Nm.shape[1:]).sum(axis=0)
    return total


@dataclass(frozen=True, eq=False)
class _Runs:
    """By angle from _FIRST_DEG in steps of _STEP_DEG, speed and lane."""

    lane_deg: np.ndarray
    """Turn-on angles, or ends of the flux linkage."""
    flux_Wb: np.ndarray
    torque_Nm: np.ndarray
    current_A: np.ndarray
    over_Wb: np.ndarray
    """Flux linkage of the largest current, by angle."""


class _Phase:
    """A phase between full voltages."""

    def __init__(self, machine: Machine, current_limit_A: float) -> None:
        magnetics, converter = machine.magnetics, machine.converter
        self.pitch_rad = magnetics.pitch_rad
        # Two devices conduct.
        self.rise_V = machine.supply_voltage_V - 2.0 * converter["switch_drop_V"]
        self.fall_V = machine.supply_voltage_V + 2.0 * converter["diode_drop_V"]
        self.rise_ohm = machine.resistance_ohm + 2.0 * converter["switch_resistance_ohm"]
        self.fall_ohm = machine.resistance_ohm + 2.0 * converter["diode_resistance_ohm"]
        self.limit_A = min(current_limit_A, _VOLTAGE_SHARE_MAX * self.rise_V / self.rise_ohm)
        self.voltage_V = machine.supply_voltage_V

        half_deg = np.arange(180.0, 361.0, _STEP_DEG)[:, None]
        angle_rad = half_deg / 360.0 * self.pitch_rad
        grid_A = np.linspace(0.0, _CURRENT_TOP * self.limit_A, _FLUX_POINTS)
        grid_Wb = magnetics.flux_linkage_Wb(angle_rad, grid_A)
        grid_Nm = np.maximum(magnetics.torque_Nm(angle_rad, grid_A), 0.0)
        fraction = np.linspace(0.0, 1.0, _FLUX_POINTS)
        curves = [(np.interp(fraction * flux_Wb[-1], flux_Wb, grid_A), np.interp(fraction * flux_Wb[-1], flux_Wb, of))
                  for flux_Wb, of in zip(grid_Wb, grid_Nm, strict=True)]
        half = np.array(curves).transpose(0, 2, 1)  # angle, flux linkage, current and torque
        braking = half[-2:0:-1] * np.array([1.0, -1.0])
        self.table = np.concatenate([half, braking])  # from 180 degrees, a turn
        self.table_rise = np.diff(self.table, axis=1, append=self.table[:, -1:])
        top_Wb = np.concatenate([grid_Wb[:, -1], grid_Wb[-2:0:-1, -1]])
        self.place_1_Wb = (_FLUX_POINTS - 1) / top_Wb
        limit_Wb = magnetics.flux_linkage_Wb(angle_rad[:, 0], self.limit_A)
        self.limit_Wb = np.concatenate([limit_Wb, limit_Wb[-2:0:-1]])
        over_Wb = magnetics.flux_linkage_Wb(angle_rad[:, 0], _CURRENT_OVER * self.limit_A)
        self.over_Wb = np.concatenate([over_Wb, over_Wb[-2:0:-1]])
        fine_rad = np.arange(0.0, 180.0 + _FINE_DEG, _FINE_DEG) / 360.0 * self.pitch_rad
        self.fine_limit_Wb = magnetics.flux_linkage_Wb(fine_rad, self.limit_A)

    def state(self, index: int, flux_Wb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Current and torque at a multiple of _STEP_DEG."""
        row = (index - 180 // _STEP_DEG) % _TURN
        place = np.minimum(flux_Wb * self.place_1_Wb[row], _FLUX_POINTS - 1.0)
        low = place.astype(np.intp)
        value = self.table[row].take(low, axis=0) + self.table_rise[row].take(low, axis=0) * (place - low)[..., None]
        return value[..., 0], value[..., 1]

    def _step_s(self, speed_rad_s: np.ndarray) -> np.ndarray:
        step_s: np.ndarray = _STEP_DEG / 360.0 * self.pitch_rad / speed_rad_s[:, None]
        return step_s

    def run(self, speed_rad_s: np.ndarray, on_deg: Any, off_deg: Any, end_deg: int = 720 + _FIRST_DEG - _STEP_DEG
            ) -> _Runs:
        """Pulses of a turn-on and a turn-off angle."""
        step_s = self._step_s(speed_rad_s)
        on_deg, off_deg = (np.broadcast_arrays(angle, step_s, np.broadcast_arrays(on_deg, off_deg)[0])[0]
                           for angle in (on_deg, off_deg))
        first, last = _FIRST_DEG // _STEP_DEG, end_deg // _STEP_DEG
        shape = (last - first + 1, *on_deg.shape)
        flux_Wb, torque_Nm, current_A = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        rise_Wb, fall_Wb = self.rise_V * step_s, self.fall_V * step_s
        rise_ohm_s, fall_ohm_s = self.rise_ohm * step_s, self.fall_ohm * step_s
        on_step, off_step = on_deg / _STEP_DEG, off_deg / _STEP_DEG
        cap_Wb = self.cap_Wb(speed_rad_s, last)[..., None]
        for at in range(last - first):
            index = first + at + 1
            off = np.clip(index - off_step, 0.0, 1.0)
            on = np.clip(index - on_step, 0.0, 1.0) - off
            falling_Wb = fall_Wb + fall_ohm_s * current_A[at]
            free_Wb = flux_Wb[at] + on * (rise_Wb - rise_ohm_s * current_A[at]) - off * falling_Wb
            # Chopping takes at most what the opposite voltage does.
            held_Wb = np.minimum(free_Wb, np.maximum(cap_Wb[index], flux_Wb[at] - falling_Wb))
            flux_Wb[at + 1] = np.maximum(np.where(on > 0.0, held_Wb, free_Wb), 0.0)
            current_A[at + 1], torque_Nm[at + 1] = self.state(index, flux_Wb[at + 1])
        return _Runs(on_deg, flux_Wb, torque_Nm, current_A, self._over(first, last))

    def falls(self, speed_rad_s: np.ndarray) -> _Runs:
        """The flux linkage under the full opposite voltage on its way to zero at a lane's angle, backwards."""
        step_s = self._step_s(speed_rad_s)
        lane_deg = np.arange(_MOTORING_OFF_DEG[0], _BRAKING_ON_DEG[1] + 360.0 + _LANE_DEG, _LANE_DEG)
        first, last = _FIRST_DEG // _STEP_DEG, int(lane_deg[-1]) // _STEP_DEG
        shape = (last - first + 1, len(speed_rad_s), len(lane_deg))
        flux_Wb, torque_Nm, current_A = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        fall_Wb, fall_ohm_s = self.fall_V * step_s, self.fall_ohm * step_s
        end_step = lane_deg / _STEP_DEG
        for at in range(last - first - 1, -1, -1):
            index = first + at
            if index < _MOTORING_OFF_DEG[0] // _STEP_DEG:
                break
            falling_Wb = fall_Wb + fall_ohm_s * current_A[at + 1]
            flux_Wb[at] = flux_Wb[at + 1] + np.clip(end_step - index, 0.0, 1.0) * falling_Wb
            current_A[at], torque_Nm[at] = self.state(index, flux_Wb[at])
        return _Runs(lane_deg, flux_Wb, torque_Nm, current_A, self._over(first, last))

    def _over(self, first: int, last: int) -> np.ndarray:
        over_Wb: np.ndarray = self.over_Wb[(np.arange(first, last + 1) - 180 // _STEP_DEG) % _TURN]
        return over_Wb

    def envelope(self, speed_rad_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle past the aligned position and flux linkage at which that of the current limit, on its way to the
        unaligned position, begins to fall slower than the full opposite voltage takes it down; where it falls fastest
        at a speed at which it never falls faster."""
        limit_Wb = self.fine_limit_Wb
        fall_Wb = -np.diff(limit_Wb)
        steepest = int(np.flatnonzero(fall_Wb >= 0.999 * fall_Wb.max())[-1])
        taken_Wb = self.voltage_V * self._step_s(speed_rad_s)[:, 0] * (_FINE_DEG / _STEP_DEG)
        above_Wb = limit_Wb + taken_Wb[:, None] * np.arange(len(limit_Wb))
        at = steepest + above_Wb[:, steepest:].argmin(axis=1)
        return at * _FINE_DEG, limit_Wb[at]

    def cap_Wb(self, speed_rad_s: np.ndarray, last: int) -> np.ndarray:
        """By angle from zero in steps and speed: the largest flux linkage from which full opposite voltage keeps the
        current within its limit."""
        index = np.arange(last + 1)
        limit_Wb = self.limit_Wb[(index - 180 // _STEP_DEG) % _TURN][:, None]
        end_deg, flux_Wb = self.envelope(speed_rad_s)
        left_deg = end_deg + 360.0 - _STEP_DEG * index[:, None]
        line_Wb = flux_Wb + self.voltage_V * self._step_s(speed_rad_s)[:, 0] / _STEP_DEG * left_deg
        return np.where(left_deg > 0.0, np.minimum(limit_Wb, line_Wb), limit_Wb)


# --- search ---------------------------------------------------------------------------------------------------------

def _best(rise: _Runs, fall: _Runs, sign: float, on_range_deg: tuple[int, int], off_range_deg: tuple[int, int]
          ) -> tuple[np.ndarray, np.ndarray]:
    """Turn-on and turn-off angles of the largest mean torque of a sign, by speed."""
    lanes = slice((on_range_deg[0] - _MOTORING_ON_DEG[0]) // _LANE_DEG,
                  (on_range_deg[1] - _MOTORING_ON_DEG[0]) // _LANE_DEG + 1)
    offs = slice((off_range_deg[0] - _FIRST_DEG) // _STEP_DEG, (off_range_deg[1] - _FIRST_DEG) // _STEP_DEG + 1,
                 _LANE_DEG // _STEP_DEG)
    on_deg = np.arange(on_range_deg[0], on_range_deg[1] + 1.0, _LANE_DEG)
    off_deg = np.arange(off_range_deg[0], off_range_deg[1] + 1.0, _LANE_DEG)

    # Turn-off angle, speed, turn-on angle.
    flux_Wb = rise.flux_Wb[offs, :, lanes]
    falling_Wb = fall.flux_Wb[offs]
    below = np.maximum((falling_Wb[..., None, :] <= flux_Wb[..., None]).sum(axis=-1) - 1, 0)
    below = np.minimum(below, len(fall.lane_deg) - 2)

    def both(of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.take_along_axis(of, below, axis=-1), np.take_along_axis(of, below + 1, axis=-1)

    low_Wb, high_Wb = both(falling_Wb)
    part = np.clip((flux_Wb - low_Wb) / np.maximum(high_Wb - low_Wb, 1e-9 * high_Wb.max()), 0.0, 1.0)

    def in_fall(of: np.ndarray) -> np.ndarray:
        low, high = both(of)
        result: np.ndarray = low + part * (high - low)
        return result

    def of_pulse(of_rise: np.ndarray, of_fall: np.ndarray) -> np.ndarray:
        """Integral over the angle, in steps."""
        rising = np.cumsum(of_rise, axis=0) - 0.5 * of_rise
        falling = np.cumsum(of_fall[::-1], axis=0)[::-1] - 0.5 * of_fall
        total: np.ndarray = rising[offs, :, lanes] + in_fall(falling[offs])
        return total

    work = sign * of_pulse(rise.torque_Nm, fall.torque_Nm)
    square = of_pulse(rise.current_A**2, fall.current_A**2)
    rising, falling = (runs.flux_Wb / runs.over_Wb[:, None, None] for runs in (rise, fall))
    largest = np.maximum(np.maximum.accumulate(rising, axis=0)[offs, :, lanes],
                         in_fall(np.maximum.accumulate(falling[::-1], axis=0)[::-1][offs]))
    end_deg = fall.lane_deg[below] + part * _LANE_DEG
    # Both limits are met by turning on later; positive: met.
    margin = np.minimum(on_deg + 360.0 - _REST_DEG - end_deg,
                        100.0 * (1.0 - largest))
    met = margin >= 0.0

    largest = np.where(met, work, -np.inf).transpose(1, 0, 2).reshape(work.shape[1], -1)
    of_largest = largest.argmax(axis=1)
    reference = np.abs(largest.max(axis=1))[:, None]
    reference_square = np.take_along_axis(square.transpose(1, 0, 2).reshape(largest.shape), of_largest[:, None], axis=1)
    score = work / reference - _CURRENT_WEIGHT * square / reference_square

    # Turn-on by turn-off, continuous between the lanes and up to where the margin is used up.
    score_met = np.where(met, score, -np.inf)
    best = score_met.argmax(axis=-1)
    shift = _vertex(score, best)
    before = np.maximum(best - 1, 0)[..., None]
    margins = [np.take_along_axis(margin, at, axis=-1)[..., 0] for at in (before, best[..., None])]
    room = np.where(margins[0] < 0.0, margins[1] / np.maximum(margins[1] - margins[0], 1e-12), 1.0)
    shift = np.clip(shift, -np.maximum(room, 0.0), 1.0)
    on_by_off = on_deg[best] + shift * _LANE_DEG
    any_met = met.any(axis=-1)
    on_by_off = np.where(any_met, on_by_off, np.nan)
    score_by_off = np.where(any_met, _parabola(score, best, shift), -np.inf)

    # Turn-off.
    best = score_by_off.argmax(axis=0)
    shift = _vertex(score_by_off.T, best)
    off = off_deg[best] + shift * _LANE_DEG
    on = _parabola(on_by_off.T, best, shift)
    return np.clip(on, on_deg[0], on_deg[-1]), off


def _three(values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values at an index of the last axis and beside it; beyond the ends, and where there is none, that at the index."""
    last = values.shape[-1] - 1
    here = np.take_along_axis(values, at[..., None], axis=-1)[..., 0]
    sides = [np.take_along_axis(values, np.clip(at + step, 0, last)[..., None], axis=-1)[..., 0] for step in (-1, 1)]
    before, after = (np.where(np.isfinite(side), side, here) for side in sides)
    return before, here, after


def _vertex(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Place of the maximum of the parabola through the values at an index of the last axis and beside it, -1..1."""
    before, here, after = _three(values, at)
    curvature = before - 2.0 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.where(curvature < 0.0, 0.5 * (before - after) / curvature, np.sign(after - before))
    return np.where(np.isfinite(place), np.clip(place, -1.0, 1.0), 0.0)


def _parabola(values: np.ndarray, at: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Value of that parabola."""
    before, here, after = _three(values, at)
    result: np.ndarray = here + 0.5 * place * (after - before) + 0.5 * place**2 * (before - 2.0 * here + after)
    return result
