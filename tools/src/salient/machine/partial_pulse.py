"""Conduction angles for parts of the largest mean torque at a speed (firmware/control/conduction.h).

A torque takes the least RMS current with a single pulse that is shorter than the one of the largest torque. Its
torque pulsates. Torque sharing, whose torque is smooth, takes as little on machines that saturate, and up to a fifth
more on machines whose torque rises and falls with the angle; the window between its own and the one of the pulse of the
largest torque is often smoother still where the voltage has not time enough. So a part of the torque is made by torque
sharing, by the pulse of the least current, or by what lies between them and the pulse of the largest torque: the
smoothest that takes at most _MORE_CURRENT of the least current.

Between them, a phase follows the torque reference, raised by a ripple, from the turn-on to the turn-off angle as far as
the voltage permits; with the ripple of the pulse the voltage decides alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData
from salient.machine.sharing_window import SharingWindow
from salient.machine.single_pulse import LANE_DEG, STEP_DEG, TURN, Pairs, Phase, SinglePulse, parabola, vertex

PARTS = (0.25, 0.5, 0.75)
"""Parts of the largest mean torque, as MACHINE_PULSE_PARTS."""

_MORE_CURRENT = 1.08
_BOTH_WAYS = [
    (0.0, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, 0.3, 0.0), (0.0, 0.45, 0.0), (0.0, 0.6, 0.0), (0.0, 0.8, 0.0),
    (0.0, 0.0, 0.33), (0.0, 0.0, 0.5), (0.0, 0.0, 0.67), (0.0, 0.45, 0.33), (0.0, 0.45, 0.67),
]
_WAYS = (
    np.array([*_BOTH_WAYS, (12.0, 0.0, 0.0), (12.0, 0.3, 0.0), (12.0, 0.6, 0.0), (12.0, 0.0, 0.5)]),
    np.array(_BOTH_WAYS),
)
"""Windows that are tried, motoring and braking: degrees by which torque sharing's is earlier; way from there to
the pulse of the largest torque; way from there to the pulse of the least current."""
_CURRENT_WEIGHT = 2.0
"""Ripple, relatively, that a relative current is worth."""
_EARLIER_COST = 0.05
"""Cost of a window that is earlier, motoring: where nothing else is better."""
_LOWER_WEIGHT = 2.0
"""Weight of a reference that has to be lower than the torque, because the fall of the current adds to it."""
_LOWERED_LEAST = 0.06
"""Part of the largest mean torque: less is within the error of these steps, and the firmware trims it."""
_FAR_DEG = 100.0
"""Sum of both angles between neighbours in the tables that is worth as much as a ripple of 1; half of it a quarter."""
_REFUSED = 1e3
_NARROW_WEIGHT = 0.1
"""Square of the current that a pulse may take more which is as wide as a stroke rather than of no width."""
_FIRST_DEG = -162
"""Past the start of the half of the wanted torque, before which no phase is turned on."""
_SHARE_LEAD_DEG = 20.0
"""As SHARE_LEAD_MAX."""
_JUMP_COST = 0.06
"""Square of the current, relatively, that half a revolution between the angles of two speeds is worth."""
_ROUNDS = 3
"""Until the mean torque is the wanted one within _TORQUE_ERROR."""
_TORQUE_ERROR = 0.02
_SLOPES = (0.5, 3.0)
"""Slopes of the logarithm of the mean torque over the logarithm of the reference."""
_HIGHER_MAX = 2.0
"""Factor by which a reference may have to be higher for it."""
_BEYOND = 1e3
"""Times the wanted torque: a reference that no phase reaches."""
_RIPPLE_MARGIN = 1.03
"""Over the largest torque of the pulse, so that the voltage decides."""


@dataclass(frozen=True, eq=False)
class PartialPulse:
    """By half, motoring and braking, part of the largest mean torque, and speed."""

    on_deg: np.ndarray
    """Turn-on past the start of the half; negative: before it."""
    off_deg: np.ndarray
    """Turn-off past it."""
    ripple: np.ndarray
    """By which the torque reference is raised, as part of the largest mean torque; negative: lowered."""


@dataclass(frozen=True, eq=False)
class _Choices:
    """By way and lane."""

    angles_deg: np.ndarray
    """Turn-on and turn-off past the start of the half, (2, ...)."""
    reference_Nm: np.ndarray
    cost: np.ndarray


@dataclass(frozen=True, eq=False)
class _Operation:
    """By lane."""

    mean_Nm: np.ndarray
    """Mean of all phases."""
    peak_Nm: np.ndarray
    ripple: np.ndarray
    """Ripple of the torque, relatively."""
    rms_A: np.ndarray
    flux_Wb: np.ndarray
    """Flux linkage of each phase, to go on with."""


def partial_pulse(machine: Machine, data: DriveData, of: SinglePulse, window: SharingWindow) -> PartialPulse:
    """From the last of its speeds below the base speed on; before it the same."""
    first = max(int(np.searchsorted(of.speed_per_voltage, of.base_speed_per_voltage)) - 1, 1)
    speed_rad_s = of.speed_per_voltage[first:] * machine.supply_voltage_V
    mean_Nm = of.mean_Nm[:, first:]
    phase = Phase(machine, data.parameters["current_limit_A"])
    found = []
    for half, pairs in enumerate(phase.pairs(speed_rad_s)):
        part = np.repeat(PARTS, len(speed_rad_s))
        wanted_Nm = part * np.tile(mean_Nm[half], len(PARTS))
        pulse_deg = np.concatenate([_least_current_deg(pairs, share * mean_Nm[half] / machine.phases,
                                                       360.0 / machine.phases)
                                    for share in PARTS], axis=1) - (180.0 + 180.0 * half)
        largest_deg = np.array([-of.lead_deg[half, first:], of.end_deg[half, first:]])
        follower = _Follower(phase, machine.phases, half, np.tile(speed_rad_s, len(PARTS)))
        choices = follower.operations(wanted_Nm, pulse_deg, np.tile(largest_deg, len(PARTS)),
                                      np.tile(window.pulse_deg[half][:, None], len(wanted_Nm)))
        angles_deg, reference_Nm = _chosen(choices, largest_deg)
        ripple = (reference_Nm.ravel() / wanted_Nm - 1.0) * part
        ripple = np.where(ripple > -_LOWERED_LEAST, np.maximum(ripple, 0.0), ripple)
        found.append([np.pad(values.reshape(len(PARTS), -1), ((0, 0), (first, 0)), mode="edge")
                      for values in (*angles_deg, ripple)])
    return PartialPulse(*(np.array(values) for values in zip(*found, strict=True)))


def _least_current_deg(pairs: Pairs, wanted_Nm: np.ndarray, stroke_deg: float) -> np.ndarray:
    """Turn-on and turn-off of the least current with which a phase makes a mean torque, by speed: (2, speeds)."""
    torque_Nm, wanted = pairs.torque_Nm, wanted_Nm[:, None]
    made = torque_Nm >= wanted
    last = made.shape[-1] - 1
    # The latest turn-on of each turn-off, between two of them.
    at = last - made[..., ::-1].argmax(axis=-1)

    def beside(of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = (np.take_along_axis(of, np.minimum(index, last)[..., None], axis=-1)[..., 0]
                     for index in (at, at + 1))
        return low, high

    low_Nm, high_Nm = beside(torque_Nm)
    shift = np.clip((low_Nm - wanted_Nm) / np.maximum(low_Nm - high_Nm, 1e-12), 0.0, 1.0)

    def between(of: np.ndarray) -> np.ndarray:
        low, high = beside(of)
        result: np.ndarray = low + shift * (high - low)
        return result

    on_deg = pairs.on_deg[at] + LANE_DEG * shift
    narrow = np.clip(1.0 - (pairs.off_deg[:, None] - on_deg) / stroke_deg, 0.0, 1.0)
    met = made.any(axis=-1) & (between(pairs.margin) >= 0.0)
    cost = np.where(met, between(pairs.square_A2) * (1.0 + _NARROW_WEIGHT * narrow), np.inf).T
    score = -cost / cost.min(axis=1, keepdims=True)
    best = _followed(-score, pairs.off_deg)
    place = vertex(score, best)
    off_deg = np.minimum(pairs.off_deg[best] + LANE_DEG * place, pairs.off_deg[-1])
    return np.array([parabola(on_deg.T, best, place), off_deg])


def _followed(cost: np.ndarray, off_deg: np.ndarray) -> np.ndarray:
    """Index of the turn-off of each row, so that the sum of the costs, and of the ways from row to row, is least: there
    may be two minima, and angles between two speeds are interpolated."""
    way = _JUMP_COST * np.abs(off_deg[:, None] - off_deg) / 180.0
    total, before = cost[0], []
    for row in cost[1:]:
        reached = total[:, None] + way
        before.append(reached.argmin(axis=0))
        total = reached.min(axis=0) + row
    found = [int(total.argmin())]
    for from_ in reversed(before):
        found.append(int(from_[found[-1]]))
    return np.array(found[::-1])


def _chosen(choices: _Choices, largest_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles and reference by part and speed, so that the sum of the costs, and of the ways from speed to speed and to
    the part above, is least: what lies between two of the tables is interpolated."""
    angles_deg, reference_Nm, cost = (
        np.moveaxis(of.reshape(*of.shape[:-1], len(PARTS), -1), -2, 0)
        for of in (choices.angles_deg, choices.reference_Nm, choices.cost))
    above_deg, found = largest_deg, []
    for of_deg, of_Nm, of_cost in zip(angles_deg[::-1], reference_Nm[::-1], cost[::-1], strict=True):
        own = of_cost + 0.1 * _way(of_deg, above_deg[:, None])
        total, before = own[:, 0], []
        for at in range(1, own.shape[1]):
            reached = total[:, None] + _way(of_deg[:, :, None, at - 1], of_deg[:, None, :, at])
            before.append(reached.argmin(axis=0))
            total = reached.min(axis=0) + own[:, at]
        best = [int(total.argmin())]
        for from_ in reversed(before):
            best.append(int(from_[best[-1]]))
        lanes = best[::-1], np.arange(own.shape[1])
        above_deg = of_deg[:, *lanes]
        found.append((above_deg, of_Nm[lanes]))
    return np.stack([of for of, _ in found[::-1]], axis=1), np.stack([of for _, of in found[::-1]])


def _way(from_deg: np.ndarray, to_deg: np.ndarray) -> np.ndarray:
    result: np.ndarray = (np.abs(to_deg - from_deg).sum(axis=0) / _FAR_DEG) ** 2
    return result


class _Follower:
    """Phases that follow a torque reference within their window, by lane; all do the same, one stroke apart."""

    def __init__(self, phase: Phase, phases: int, half: int, speed_rad_s: np.ndarray) -> None:
        self.phase, self.phases, self.speed_rad_s = phase, phases, speed_rad_s
        self.half = half
        self.begin_deg = 180 + 180 * half
        self.sign = 1.0 - 2.0 * half
        self.stroke_deg = 360.0 / phases
        self.cap_Wb = phase.cap_Wb(speed_rad_s, (self.begin_deg + _FIRST_DEG + 360) // STEP_DEG)
        self.lane = np.arange(len(speed_rad_s))

    def operations(self, wanted_Nm: np.ndarray, pulse_deg: np.ndarray, largest_deg: np.ndarray,
                   sharing_deg: np.ndarray) -> _Choices:
        """Choices of each lane that make the wanted torque: the pulse last."""
        pulse = self.run(pulse_deg, _BEYOND * wanted_Nm)
        crest = np.maximum(pulse.peak_Nm / wanted_Nm, 1.0)
        # At a slightly different torque.
        least_A = pulse.rms_A * np.sqrt(wanted_Nm / pulse.mean_Nm)
        earlier_deg, to_largest, to_pulse = _WAYS[self.half].T[..., None]
        angles_deg = sharing_deg[:, None] - earlier_deg
        angles_deg = angles_deg + to_largest * (largest_deg[:, None] - angles_deg)
        angles_deg = angles_deg + to_pulse * (pulse_deg[:, None] - angles_deg)
        reference_Nm = wanted_Nm * (1.0 + to_pulse * (crest - 1.0))
        highest_Nm = _HIGHER_MAX * reference_Nm
        made = self.run(angles_deg, reference_Nm)
        slope = np.ones(reference_Nm.shape)
        for _ in range(_ROUNDS):
            last_Nm, mean_Nm = reference_Nm, np.maximum(made.mean_Nm, 0.5 * wanted_Nm)
            reference_Nm = np.minimum(reference_Nm * (wanted_Nm / mean_Nm) ** (1.0 / slope), highest_Nm)
            made = self.run(angles_deg, reference_Nm, made.flux_Wb)
            changed = np.log(reference_Nm / last_Nm)
            known = np.abs(changed) > _TORQUE_ERROR
            of_mean = np.log(made.mean_Nm / mean_Nm) / np.where(known, changed, 1.0)
            slope = np.where(known, np.clip(of_mean, *_SLOPES), slope)
        reached = np.abs(made.mean_Nm / wanted_Nm - 1.0) < _TORQUE_ERROR
        permitted = reached & (made.rms_A <= _MORE_CURRENT * least_A)
        cost = made.ripple + _CURRENT_WEIGHT * (made.rms_A / least_A - 1.0) + _EARLIER_COST * (earlier_deg > 0.0)
        cost = cost + _LOWER_WEIGHT * np.maximum(1.0 - reference_Nm / wanted_Nm, 0.0)
        cost = np.where(permitted, cost, _REFUSED)
        return _Choices(np.concatenate([angles_deg, pulse_deg[:, None]], axis=1),
                        np.vstack([reference_Nm, _RIPPLE_MARGIN * crest * wanted_Nm]), np.vstack([cost, pulse.ripple]))

    def run(self, angles_deg: np.ndarray, reference_Nm: np.ndarray, flux_Wb: np.ndarray | None = None) -> _Operation:
        """Turn-on and turn-off past the start of the half, (2, ...), from flux linkages of the phases."""
        phase, phases, stroke_deg = self.phase, self.phases, self.stroke_deg
        on_deg, off_deg = angles_deg
        enter_deg = np.maximum(on_deg, -_SHARE_LEAD_DEG)
        overlap_deg = np.maximum(off_deg - enter_deg - stroke_deg, STEP_DEG)
        # Without an overlap the parts of a step with the voltage and with the opposite one are enough.
        within = overlap_deg > STEP_DEG
        rise_deg = np.where(within, enter_deg, enter_deg - STEP_DEG)
        fall_deg = np.where(within, off_deg - overlap_deg, off_deg + STEP_DEG)
        step_s = phase.step_s(self.speed_rad_s)[:, 0]
        rise_Wb, fall_Wb = phase.rise_V * step_s, phase.fall_V * step_s
        rise_ohm_s, fall_ohm_s = phase.rise_ohm * step_s, phase.fall_ohm * step_s
        stroke_steps = round(stroke_deg) // STEP_DEG
        strokes = 2
        if flux_Wb is None:
            flux_Wb, strokes = np.zeros((phases, *on_deg.shape)), phases + 1
        first = _FIRST_DEG // STEP_DEG + stroke_steps * np.arange(phases).reshape(-1, *[1] * on_deg.ndim)
        current_A, _ = phase.state(self.begin_deg // STEP_DEG + first, flux_Wb)
        total_Nm, square_A2 = np.zeros((stroke_steps, *on_deg.shape)), np.zeros(flux_Wb.shape)
        for step in range(strokes * stroke_steps):
            # Within a revolution from _FIRST_DEG on.
            past_deg = _FIRST_DEG + (first * STEP_DEG - _FIRST_DEG + (step + 1) * STEP_DEG) % 360
            index = (self.begin_deg + past_deg) // STEP_DEG
            share = np.where(past_deg > 0, _cubic((past_deg - rise_deg) / overlap_deg)
                             - _cubic((past_deg - fall_deg) / overlap_deg), 0.0)
            on = np.clip((past_deg - on_deg) / STEP_DEG, 0.0, 1.0) - np.clip((past_deg - off_deg) / STEP_DEG, 0.0, 1.0)
            least_Wb = flux_Wb - fall_Wb - fall_ohm_s * current_A
            most_Wb = least_Wb + on * (rise_Wb + fall_Wb + (rise_ohm_s + fall_ohm_s) * current_A)
            most_Wb = np.minimum(most_Wb, np.maximum(self.cap_Wb[index, self.lane], least_Wb))
            held_Wb = np.where((past_deg > 0) & (on > 0.0),
                               np.minimum(most_Wb, np.maximum(phase.flux_Wb(index, share * reference_Nm), least_Wb)),
                               most_Wb)
            _, torque_Nm = phase.state(index, np.maximum(held_Wb, 0.0))
            # The rest is left to the phase that entered first.
            missing_Nm = np.maximum(reference_Nm - self.sign * torque_Nm.sum(axis=0), 0.0)
            inside = (past_deg > 0) & (on > 0.0)
            oldest = inside & (past_deg == np.where(inside, past_deg, -1000).max(axis=0))
            more_Wb = phase.flux_Wb(index, np.abs(torque_Nm) + missing_Nm)
            flux_Wb = np.maximum(np.where(oldest, np.minimum(most_Wb, np.maximum(more_Wb, least_Wb)), held_Wb), 0.0)
            current_A, torque_Nm = phase.state(index, flux_Wb)
            if step >= (strokes - 1) * stroke_steps:
                total_Nm[step % stroke_steps] = self.sign * torque_Nm.sum(axis=0)
                square_A2 += current_A * current_A
        mean_Nm = np.maximum(total_Nm.mean(axis=0), 1e-12)
        return _Operation(mean_Nm, total_Nm.max(axis=0), np.ptp(total_Nm, axis=0) / mean_Nm,
                          np.sqrt(square_A2.sum(axis=0) / TURN), np.roll(flux_Wb, strokes, axis=0))


def _cubic(part: np.ndarray) -> np.ndarray:
    x = np.clip(part, 0.0, 1.0)
    result: np.ndarray = x * x * (3.0 - 2.0 * x)
    return result
