"""Bounds of any commutation: the largest mean torque over the speed, and the least RMS current of a mean
torque, of one pulse of voltage in each electrical revolution.

A phase gets the voltage of the DC link from a turn-on to a turn-off angle and the opposite one after it, through the
drops and resistances of devices and winding. At the current limit the half bridge chops ideally: the current stays at
it as long as the opposite voltage suffices. A pair of angles whose current exceeds the limit by more than CURRENT_OVER
is refused. The flux linkage need not return to zero: what is left over counts in the next revolution. All phases do
the same, one stroke apart.

The DC link has the voltage of the supply behind its source resistance, with the capacitor between: it sags by the
current that the phases draw, over the angle of a stroke. A supply absorbs nothing: returned energy ends in the chopper,
at the mean of its thresholds, or at the voltage at which its resistance takes all of it where that is higher. A pair of
angles that lifts the link to over_voltage_V, or returns energy to a link without a chopper, is refused. Without a table
[dc_link] the voltage is constant and the supply takes everything.

Nothing of this is in the firmware, nor in what computes its tables: only the magnetics are shared with the plant.
Angles of a phase are electrical degrees: 180 is the unaligned, 360 the aligned position; speeds are positive, and a
negative mean torque brakes.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from salient.machine.definition import Machine

MOTORING, BRAKING = 1, -1
CURRENT_OVER = 1.03

_STEP_ROUGH_DEG, _STEP_COARSE_DEG, _STEP_FINE_DEG = 6.0, 2.0, 1.0
# Pairs of angles from which the search for the best begins.
_FIRST_ON_DEG = {MOTORING: np.arange(30.0, 241.0, 10.0), BRAKING: np.arange(150.0, 391.0, 10.0)}
_FIRST_DWELL_DEG = np.arange(10.0, 341.0, 10.0)
_STARTS = 3
_ROUNDS = 9
_LAST_ROUNDS = 2
_LINK_EXPONENT = 20
"""By which the search values the torque of a pair less whose DC link is above its limit: it ends at that limit."""
_CYCLES_MAX = 36
_PERIODIC = 1e-4
"""Tolerance of the flux linkage's limit: change from a revolution to the next at which it counts as periodic."""
_LINK_PERIODIC = 1e-3
"""Tolerance of the supply's voltage: change of the DC link's, likewise."""
_CHOPPER_STEP = 0.25
"""Part of the way to the voltage at which the chopper takes what the last revolution returned."""
_OVER_FULL = 1.1
"""Multiple of the threshold above which it does not matter how much higher the DC link's voltage is."""
_FLUX_POINTS = 256
_TABLE_OVER = 1.15
"""Multiple of the current limit up to which the table reaches; beyond it the current continues linearly."""
_BISECTIONS = 7
_SAME_TORQUE = 0.01


@dataclass(frozen=True)
class Limits:
    """Limits of the drive."""

    current_A: float
    over_voltage_V: float
    """Voltage of the DC link, at which the drive trips; has an effect with a table [dc_link] only."""
    supply_V: float
    """Voltage of the source, at no load."""


@dataclass(frozen=True)
class Pulse:
    """Steady operation with one pair of angles."""

    on_deg: float
    off_deg: float
    torque_Nm: float
    """Mean over a revolution; negative when braking, 0 when no pair of angles is permitted."""
    rms_A: float
    """Value of the current of a phase."""
    peak_A: float
    link_W: float
    """Mean power from the DC link, negative when it is returned."""
    link_V: float
    """Mean voltage of the DC link."""
    copper_W: float
    """Loss of all windings."""
    device_W: float
    """Loss of all devices."""


_NONE = Pulse(0.0, 0.0, 0.0, math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)


def operate(machine: Machine, speed_rpm: float, limits: Limits, on_deg: float, off_deg: float) -> Pulse:
    """Steady operation with given angles."""
    return _Run(machine, limits, np.array([speed_rpm]), np.array([on_deg]), np.array([off_deg - on_deg]),
                _STEP_FINE_DEG / 2.0).pulse(0)


def rough_torque_Nm(machine: Machine, speeds_rpm: Sequence[float], limits: Limits) -> np.ndarray:
    """largest_torque when motoring within some percent, in a tenth of a second: few angles, and a DC link that does not
    yield. For what has to be in proportion to it, not for a judgement."""
    on_deg, dwell_deg = (grid.ravel() for grid in np.meshgrid(
        _FIRST_ON_DEG[MOTORING][::2], _FIRST_DWELL_DEG[::2], indexing="ij"))
    count = len(speeds_rpm)
    run = _Run(replace(machine, dc_link=None), limits, np.repeat(speeds_rpm, on_deg.size), np.tile(on_deg, count),
               np.tile(dwell_deg, count), _STEP_ROUGH_DEG)
    largest_Nm: np.ndarray = run.allowed_torque_Nm.reshape(count, -1).max(axis=1)
    return largest_Nm


def largest_torque(machine: Machine, speeds_rpm: Sequence[float], limits: Limits, quadrant: int) -> list[Pulse]:
    """The pulse of the largest mean torque at each speed, MOTORING or BRAKING."""
    count = len(speeds_rpm)
    on_deg, dwell_deg = (grid.ravel() for grid in np.meshgrid(_FIRST_ON_DEG[quadrant], _FIRST_DWELL_DEG, indexing="ij"))
    first = _Run(machine, limits, np.repeat(speeds_rpm, on_deg.size), np.tile(on_deg, count), np.tile(dwell_deg, count),
                 _STEP_COARSE_DEG)
    made_Nm = (quadrant * first.sought_torque_Nm).reshape(count, -1)
    # The best pair and the best ones at least two steps from it: the torque may have several maxima.
    best = np.stack([_apart(row, on_deg, dwell_deg) for row in made_Nm])
    on_deg, dwell_deg = on_deg[best].ravel(), dwell_deg[best].ravel()
    speeds = np.repeat(speeds_rpm, _STARTS)
    offsets = np.array([(a, b) for a in range(-2, 3) for b in range(-2, 3)], dtype=float)
    distance_deg = np.full(len(speeds), 5.0)
    for left in range(_ROUNDS + _LAST_ROUNDS - 1, -1, -1):
        last = left < _LAST_ROUNDS
        around_on = (on_deg[:, None] + distance_deg[:, None] * offsets[:, 0]).ravel()
        around_dwell = np.clip(dwell_deg[:, None] + distance_deg[:, None] * offsets[:, 1], 0.5, 355.0).ravel()
        run = _Run(machine, limits, np.repeat(speeds, len(offsets)), around_on, around_dwell,
                   0.5 * _STEP_FINE_DEG if last else _STEP_FINE_DEG)
        made_Nm = quadrant * (run.allowed_torque_Nm if last else run.sought_torque_Nm)
        at = made_Nm.reshape(len(speeds), -1).argmax(axis=1)
        distance_deg = np.where(np.abs(offsets[at]).max(axis=1) < 2.0, 0.5 * distance_deg, distance_deg)
        at += np.arange(len(speeds)) * len(offsets)
        on_deg, dwell_deg = around_on[at], around_dwell[at]
    made_Nm = made_Nm.reshape(count, -1)
    return [run.pulse(row * made_Nm.shape[1] + int(at)) for row, at in enumerate(made_Nm.argmax(axis=1))]


def least_current(machine: Machine, speed_rpm: float, limits: Limits, torques_Nm: Sequence[float]) -> list[Pulse]:
    """The pulse of the least RMS current of each mean torque, negative ones brake; a pulse of torque 0 for one that no
    pulse makes."""
    return [_least_current(machine, speed_rpm, limits, torque_Nm) for torque_Nm in torques_Nm]


def _least_current(machine: Machine, speed_rpm: float, limits: Limits, torque_Nm: float) -> Pulse:
    """For each turn-on angle the shortest pulse that makes the torque, then the turn-on angle of the least current."""
    quadrant = MOTORING if torque_Nm >= 0.0 else BRAKING
    wanted_Nm = abs(torque_Nm)
    on_deg, dwell_deg = (grid.ravel() for grid in np.meshgrid(_FIRST_ON_DEG[quadrant], _FIRST_DWELL_DEG, indexing="ij"))
    grid = _Run(machine, limits, np.full(on_deg.size, speed_rpm), on_deg, dwell_deg, _STEP_COARSE_DEG)
    # Also of refused pairs: those that are permitted may lie between two of the grid.
    reached = (quadrant * grid.torque_Nm >= wanted_Nm).reshape(-1, _FIRST_DWELL_DEG.size)
    usable = reached.any(axis=1)
    if not usable.any():
        return _NONE
    on_deg, dwell_deg = _FIRST_ON_DEG[quadrant][usable], _FIRST_DWELL_DEG[reached[usable].argmax(axis=1)]
    below_deg = 10.0
    best = _NONE
    for spread_deg, step_deg in ((2.5, _STEP_COARSE_DEG), (0.625, _STEP_FINE_DEG)):
        low_deg, high_deg = dwell_deg - below_deg, dwell_deg + 2.0
        speeds = np.full(on_deg.size, speed_rpm)
        for _ in range(_BISECTIONS):
            middle_deg = 0.5 * (low_deg + high_deg)
            run = _Run(machine, limits, speeds, on_deg, middle_deg, step_deg)
            enough = quadrant * run.torque_Nm >= wanted_Nm
            high_deg, low_deg = np.where(enough, middle_deg, high_deg), np.where(enough, low_deg, middle_deg)
        run = _Run(machine, limits, speeds, on_deg, high_deg, step_deg)
        made = ~run.refused & (np.abs(quadrant * run.torque_Nm - wanted_Nm) < _SAME_TORQUE * wanted_Nm)
        if not made.any():
            break
        at = int(np.where(made, run.rms_A, np.inf).argmin())
        best = run.pulse(at)
        on_deg = on_deg[at] + spread_deg * np.arange(-4.0, 5.0)
        dwell_deg, below_deg = high_deg[at] + np.full(9, 8.0 * spread_deg), 16.0 * spread_deg
    return best


def _apart(made_Nm: np.ndarray, on_deg: np.ndarray, dwell_deg: np.ndarray) -> np.ndarray:
    """Indices of the best pairs of angles that are 20 degrees or more from each other."""
    left_Nm, chosen = made_Nm.copy(), []
    for _ in range(_STARTS):
        at = int(left_Nm.argmax())
        chosen.append(at)
        left_Nm[np.hypot(on_deg - on_deg[at], dwell_deg - dwell_deg[at]) < 19.0] = -np.inf
    return np.array(chosen)


class _Run:
    """Simulates many pairs of angles at once, each to its periodic state; every array has one value of each pair."""

    def __init__(self, machine: Machine, limits: Limits, speed_rpm: np.ndarray, on_deg: np.ndarray,
                 dwell_deg: np.ndarray, step_deg: float) -> None:
        self.on_deg, self.dwell_deg = on_deg, dwell_deg
        self._limits = limits
        revolution = _Revolution(machine, limits, speed_rpm, on_deg, dwell_deg, step_deg)
        sums, periodic = np.zeros((len(_SUMS), on_deg.size)), np.zeros(on_deg.size, dtype=bool)
        left, top_Wb = np.arange(on_deg.size), revolution.table.top_Wb.max()
        start_Wb, moved_before_Wb = np.zeros(on_deg.size), np.zeros(on_deg.size)
        for cycle in range(_CYCLES_MAX):
            end_Wb, sums[:, left] = revolution.run(start_Wb)
            moved_Wb = end_Wb - start_Wb
            link_V = revolution.link_V.mean(axis=0)
            link_change_V = revolution.update_link()
            done = (np.abs(moved_Wb) < _PERIODIC * top_Wb) & (link_change_V < _LINK_PERIODIC * limits.supply_V)
            sums[_SUMS.index("link_mean_V"), left] = link_V
            periodic[left[done]] = True
            # Between its resets, at no current or at the limit, a flux linkage changes by nearly the same amount in
            # each revolution: a leap covers many, and a reset corrects one that is too far.
            if cycle % 5 == 4:
                ratio = np.clip(moved_Wb / np.where(moved_before_Wb == 0.0, np.inf, moved_before_Wb), 0.0, 0.95)
                end_Wb = np.clip(end_Wb + moved_Wb * ratio / (1.0 - ratio), 0.0, top_Wb)
            if done.all():
                break
            left, start_Wb, moved_before_Wb = left[~done], end_Wb[~done], moved_Wb[~done]
            revolution = revolution.of(~done)
        strokes_per_rad = machine.phases * machine.rotor_poles / (2.0 * math.pi)
        period_s = 2.0 * math.pi / machine.rotor_poles / (np.asarray(speed_rpm) * math.pi / 30.0)
        work_J, square_A2, device_J, link_J, self.peak_A, self.link_mean_V, link_highest_V = sums
        self.torque_Nm = work_J * strokes_per_rad
        self.rms_A = np.sqrt(square_A2)
        self.copper_W = machine.phases * machine.resistance_ohm * square_A2
        self.device_W = machine.phases * device_J / period_s
        self.link_W = machine.phases * link_J / period_s
        self.refused = ~periodic | (self.peak_A > CURRENT_OVER * limits.current_A)
        self.sought_torque_Nm = np.where(self.refused, 0.0, self.torque_Nm)
        if machine.dc_link is not None:
            self.refused |= link_highest_V > limits.over_voltage_V
            self.sought_torque_Nm *= np.minimum(1.0, limits.over_voltage_V / link_highest_V) ** _LINK_EXPONENT
        self.allowed_torque_Nm = np.where(self.refused, 0.0, self.torque_Nm)

    def pulse(self, at: int) -> Pulse:
        values = (self.allowed_torque_Nm, self.rms_A, self.peak_A, self.link_W, self.link_mean_V, self.copper_W,
                  self.device_W)
        return Pulse(float(self.on_deg[at]), float(self.on_deg[at] + self.dwell_deg[at]),
                     *(float(value[at]) for value in values))


_SUMS = ("work_J", "square_A2", "device_J", "link_J", "peak_A", "link_mean_V", "link_highest_V")
"""Sums of a revolution: work on the shaft, mean square of the current, losses of the devices, energy from the link."""


class _Revolution:
    """Electrical revolutions of many pairs of angles, with the voltage of the DC link over the steps of a stroke."""

    def __init__(self, machine: Machine, limits: Limits, speed_rpm: np.ndarray, on_deg: np.ndarray,
                 dwell_deg: np.ndarray, step_deg: float) -> None:
        self._machine, self._limits = machine, limits
        # Part of each step on positive voltage; a pulse may begin in a revolution and end in the next.
        since_deg = (np.arange(0.0, 359.99, step_deg)[:, None] - on_deg) % 360.0
        self._on = (np.clip(dwell_deg - since_deg, 0.0, step_deg)
                    + np.clip(since_deg + step_deg - 360.0, 0.0, np.minimum(dwell_deg, step_deg))) / step_deg
        self._step_s = math.radians(step_deg) / machine.rotor_poles / (np.asarray(speed_rpm) * math.pi / 30.0)
        self.table = _Table(machine, limits.current_A, step_deg)
        self.link_V = np.full((round(360.0 / machine.phases / step_deg), on_deg.size), limits.supply_V)
        self._drawn_A = np.zeros_like(self.link_V)

    def of(self, which: np.ndarray) -> _Revolution:
        """Values of some of the pairs."""
        part = copy.copy(self)
        part._on, part._step_s = self._on[:, which], self._step_s[which]
        part.link_V, part._drawn_A = self.link_V[:, which], self._drawn_A[:, which]
        return part

    def run(self, flux_Wb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From the aligned position on: the flux linkage at the end, and _SUMS."""
        table, step_s = self.table, self._step_s
        converter, winding_ohm = self._machine.converter, self._machine.resistance_ohm
        on_V, off_V = 2.0 * converter["switch_drop_V"], 2.0 * converter["diode_drop_V"]
        on_ohm, off_ohm = 2.0 * converter["switch_resistance_ohm"], 2.0 * converter["diode_resistance_ohm"]
        steps, stroke_steps = len(self._on), len(self.link_V)
        current_A = table.current_A(0, flux_Wb)
        sums = np.zeros((len(_SUMS), flux_Wb.size))
        work_J_, square_A2_, device_J_, link_J_, peak_A = sums[:5]
        sums[6] = self.link_V.max(axis=0)
        self._drawn_A[:] = 0.0
        for step in range(steps):
            on = self._on[step]
            link_V = self.link_V[step % stroke_steps]
            rise_Wb = step_s * (link_V - on_V - (winding_ohm + on_ohm) * current_A)
            fall_Wb = step_s * (link_V + off_V + (winding_ohm + off_ohm) * current_A)
            off = np.where(flux_Wb > 0.0, 1.0 - on, 0.0)
            next_Wb = np.maximum(flux_Wb + on * rise_Wb - off * fall_Wb, 0.0)
            limit_Wb = table.limit_Wb[(step + 1) % steps]
            next_Wb = np.where((on > 0.0) & (next_Wb > limit_Wb), np.maximum(flux_Wb - fall_Wb, limit_Wb), next_Wb)
            next_A = table.current_A((step + 1) % steps, next_Wb)
            mean_A = 0.5 * (current_A + next_A)
            square_A2 = (current_A * current_A + current_A * next_A + next_A * next_A) / 3.0
            # Part of the time on positive voltage that the change of flux linkage requires.
            positive = np.clip((next_Wb - flux_Wb + fall_Wb) / (rise_Wb + fall_Wb), 0.0, 1.0)
            work_J = mean_A * (next_Wb - flux_Wb)
            device_J = step_s * ((off_V + positive * (on_V - off_V)) * mean_A
                                 + (off_ohm + positive * (on_ohm - off_ohm)) * square_A2)
            link_J = work_J + device_J + step_s * winding_ohm * square_A2
            work_J_ += work_J
            square_A2_ += square_A2 / steps
            device_J_ += device_J
            link_J_ += link_J
            self._drawn_A[step % stroke_steps] += link_J / (link_V * step_s)
            np.maximum(peak_A, next_A, out=peak_A)
            flux_Wb, current_A = next_Wb, next_A
        return flux_Wb, sums

    def update_link(self) -> np.ndarray:
        """The voltage of the DC link over a stroke under what all phases drew in the last one; its largest change."""
        link = self._machine.dc_link
        if link is None:
            return np.zeros_like(self._step_s)
        before_V = self.link_V
        returned_W = -(self._drawn_A * before_V).mean(axis=0)
        taken_V: np.ndarray | float = math.inf
        if "chopper_resistance_ohm" in link:
            held_V = 0.5 * (link["chopper_on_V"] + link["chopper_off_V"])
            taken_V = np.maximum(held_V, np.sqrt(np.maximum(returned_W, 0.0) * link["chopper_resistance_ohm"]))
        target_V = np.where(returned_W > 0.0, np.minimum(taken_V, _OVER_FULL * self._limits.over_voltage_V),
                            self._sagging_V(link["source_resistance_ohm"], link["capacitance_F"]))
        # A higher voltage returns less energy: whole steps could alternate between two voltages.
        self.link_V = before_V + np.where(returned_W > 0.0, _CHOPPER_STEP, 1.0) * (target_V - before_V)
        change_V: np.ndarray = np.abs(target_V - before_V).max(axis=0)
        return change_V

    def _sagging_V(self, source_ohm: float, capacitance_F: float) -> np.ndarray:
        """Source with resistance, which absorbs nothing, and capacitor; each step with a constant current."""
        supply_V = self._limits.supply_V
        decay = np.exp(-self._step_s / (source_ohm * capacitance_F))
        voltage_V = supply_V - source_ohm * np.maximum(self._drawn_A.mean(axis=0), 0.0)
        profile_V = np.empty_like(self._drawn_A)
        for _ in range(2):
            for step, drawn_A in enumerate(self._drawn_A):
                steady_V = supply_V - source_ohm * drawn_A
                free_V = voltage_V - drawn_A * self._step_s / capacitance_F
                next_V = np.where(np.maximum(voltage_V, free_V) > supply_V, free_V,
                                  steady_V + (voltage_V - steady_V) * decay)
                profile_V[step] = 0.5 * (voltage_V + next_V)
                voltage_V = next_V
        return profile_V


class _Table:
    """Current by angle, from the aligned position in steps, and flux linkage."""

    def __init__(self, machine: Machine, current_A: float, step_deg: float) -> None:
        magnetics = machine.magnetics
        half = round(180.0 / step_deg)
        angle_rad = np.arange(half + 1) / half * 0.5 * magnetics.pitch_rad
        grid_A = np.linspace(0.0, _TABLE_OVER * current_A, 2 * _FLUX_POINTS + 1)
        flux_Wb = magnetics.flux_linkage_Wb(angle_rad[:, None], grid_A)
        fractions = np.linspace(0.0, 1.0, _FLUX_POINTS)
        rows = np.array([np.interp(fractions * row[-1], row, grid_A) for row in flux_Wb])
        limit_Wb = magnetics.flux_linkage_Wb(angle_rad, current_A)
        mirrored = np.concatenate([np.arange(half), np.arange(half, 0, -1)])
        self._rows, self.top_Wb, self.limit_Wb = rows[mirrored], flux_Wb[mirrored, -1], limit_Wb[mirrored]

    def current_A(self, step: int, flux_Wb: np.ndarray) -> np.ndarray:
        place = flux_Wb * ((_FLUX_POINTS - 1) / self.top_Wb[step])
        low = np.minimum(place.astype(np.intp), _FLUX_POINTS - 2)
        row = self._rows[step]
        below = row[low]
        current_A: np.ndarray = below + (place - low) * (row[low + 1] - below)
        return current_A
