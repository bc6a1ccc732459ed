"""Makes a legal map of points as they come, and says by how much each correction was.

1. units: angles by the period that the map then has; currents and flux linkages without a unit by what the supply and
   the resistance of the machine permit;
2. the aligned position of each phase by symmetry (flux_map_origin.py), phases a stroke apart;
3. on a common grid, mean of the halves of the pitch, and of the phases;
4. flux linkage falls from aligned to unaligned and rises with the current: the nearest one that does (isotonic
   regression).

Beyond its limit a correction is not one of a measurement any more, and the map is refused. A measurement repeats within
a percent or two; tolerances of the air gap, of a few percent each, and end effects make halves and phases differ by up
to some 6 % in published maps. Twice that and more is a second machine, a wrong column or an outlier: the mean of such
curves would be the map of no machine. A curve that has to be changed by more than 4 % of the aligned flux linkage to be
monotonic has a dip or a step: its torque would have the wrong sign there.

On a steep flank a dip leaves the curve monotonic. Therefore its slope must rise to one maximum and fall from there, as
the overlap of two poles makes it; what has to be changed for that is below 0.2 % in maps of field solvers and of
formulae, and some twice the scatter of the points in one that was measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import isotonic_regression

from salient.machine.flux_map import ANGLE_INTERVALS, FluxMapError
from salient.machine.flux_map_origin import WHOLE_RAD, Origin, find_origin
from salient.machine.map_import.columns import radians
from salient.machine.map_import.layouts import Points

ASYMMETRY_MAX = 0.12  # between the halves of a pitch, of the map's greatest flux linkage
SPREAD_MAX = 0.12  # between phases, likewise
REPAIR_MAX = 0.04  # for a monotonic curve, of the aligned flux linkage at that current
BEND_MAX = 0.025  # for a slope with one maximum, likewise
OFFSET_MAX = 0.02  # at 0 A, of the map's greatest flux linkage
PLACE_MAX = 0.03  # of a phase from its place a stroke after the one before, of a pitch
HALF_ERROR_RAD = 2.0 * math.pi / 80.0  # of the aligned position of half a pitch, which is shifted to 0
GAP_RAD = math.pi / 6.0  # without points, electrical
_TOP_STEP = 3  # of the angles that are tried as the angle of the greatest slope
ANGLES_MIN = 8
CURRENTS_MIN = 6


@dataclass(frozen=True)
class Supply:
    """Bounds of currents and flux linkages without a unit."""

    voltage_V: float
    resistance_ohm: float


@dataclass(frozen=True)
class Imported:
    """A legal map from 0 (aligned) to half a pitch, and what was done."""

    angle_deg: np.ndarray
    current_A: np.ndarray
    flux_Wb: np.ndarray
    lines: list[str]
    """One for each correction."""


@dataclass(frozen=True)
class _Phase:
    angle_rad: np.ndarray
    """Electrical, rising."""
    flux_Wb: np.ndarray
    """By angle and current."""
    line: np.ndarray
    """Line of the file, by angle and current."""


def correct(points: Points, rotor_poles: int, phases: int, supply: Supply) -> Imported:
    """The map of points. FluxMapError, with the line of the file where one can be named."""
    lines = [f"layout: {points.layout}, {len(points.rows)} points"]
    if points.left_out:
        lines.append(f"left out: {points.left_out} tables that are not of flux linkages, by their titles")
    table = _clean(points, supply, lines)
    pitch_deg = 360.0 / rotor_poles
    table_rad, unit = _in_radians(table, points.angle_unit, rotor_poles)
    lines.append(f"angle: {unit}{'' if points.angle_unit else ', by the period'}")
    current_A, measured = _curves(table_rad, lines)
    origins = [_origin(phase) for phase in measured]
    _say_origin(measured, origins, pitch_deg, phases, lines)
    grid_rad = np.linspace(0.0, math.pi, ANGLE_INTERVALS + 1)
    halves = [_halves(phase, origin, grid_rad) for phase, origin in zip(measured, origins, strict=True)]
    most_Wb = max(float(np.max(phase.flux_Wb)) for phase in measured)

    def place(phase: int, half: int, row: int, column: int) -> str:
        way = (1.0, -1.0)[half]
        return _place(measured[phase], origins[phase].aligned_rad + way * grid_rad[row], column)

    _compare_halves(halves, most_Wb, current_A, place, lines)
    for of_phase, origin, both in zip(measured, origins, halves, strict=True):
        _compare_beyond(of_phase, origin, both, most_Wb, current_A)
    means = [np.mean([half for half in both if half is not None], axis=0) for both in halves]
    _compare_phases(means, most_Wb, current_A,
                    lambda phase, row, column: place(phase, int(halves[phase][0] is None), row, column), lines)
    repairs = []
    for phase, both in enumerate(halves):
        for half, flux_Wb in enumerate(both):
            if flux_Wb is not None:
                repairs.append(_check_monotonic(flux_Wb, current_A, partial(place, phase, half)))
                _check_slope(flux_Wb, current_A, partial(place, phase, half))
    flux_Wb = _monotonic(np.mean(means, axis=0), current_A)
    lines.append(f"monotonic: curves changed by up to {100.0 * max(repairs):.2f} % of the aligned flux linkage")
    lines.append(f"grid: {len(grid_rad)} angles from 0 to {pitch_deg / 2.0:.6g} deg, {len(current_A)} currents from 0"
                 f" to {current_A[-1]:.6g} A")
    return Imported(np.degrees(grid_rad) / rotor_poles, current_A, flux_Wb, lines)


def _clean(points: Points, supply: Supply, lines: list[str]) -> np.ndarray:
    """Rows of line, phase, angle, A and Wb, of currents from 0 on and flux linkages that are positive."""
    table = np.array(points.rows, dtype=float)
    if np.sum(table[:, 4] * table[:, 3]) < 0.0:
        table[:, 4] = -table[:, 4]
        lines.append("sign: flux linkages turned")
    negative = table[:, 3] < 0.0
    if np.any(negative):
        lines.append(f"currents below 0: {int(np.sum(negative))} points left out")
        table = table[~negative]
    if len(table) == 0:
        raise FluxMapError("no points of a positive current")
    most_A, most_Wb = float(np.max(table[:, 3])), float(np.max(np.abs(table[:, 4])))
    # More current than three times what the supply drives through the resistance does not flow: they are mA.
    if not points.current_stated:
        milli = most_A * supply.resistance_ohm > 3.0 * supply.voltage_V
        table[:, 3] *= 1e-3 if milli else 1.0
        lines.append(f"current: no unit; {'mA' if milli else 'A'} by supply and resistance of the machine")
    # The supply builds up this flux linkage in more than a second: mWb.
    if not points.flux_stated:
        milli = most_Wb > supply.voltage_V * 1.0 or most_Wb > 20.0
        table[:, 4] *= 1e-3 if milli else 1.0
        lines.append(f"flux linkage: no unit; {'mWb' if milli else 'Wb'} by the supply of the machine")
    return table


def _in_radians(table: np.ndarray, unit: str | None, rotor_poles: int) -> tuple[np.ndarray, str]:
    """With electrical radians, by the unit that is stated or the one with which the map is even and falls best."""
    if unit in (None, "electrical"):
        candidates = ["electrical deg", "electrical rad"] + ([] if unit else ["deg", "rad"])
    else:
        candidates = [unit] if unit.startswith("electrical") else [unit, f"electrical {unit}"]
    best: tuple[float, np.ndarray, str] | None = None
    for candidate in candidates:
        changed = table.copy()
        changed[:, 2] *= radians(candidate, rotor_poles)
        misfit = _misfit(changed)
        # Against the name of the unit, which says mechanical, electrical ones must fit much better.
        weight = 2.0 if candidate.startswith("electrical") and unit else 1.0
        if misfit is not None and (best is None or weight * misfit < best[0]):
            best = (misfit, changed, candidate)
    if best is None:
        low, high = float(np.min(table[:, 2])), float(np.max(table[:, 2]))
        raise FluxMapError(
            f"the angles go from {low:.6g} to {high:.6g} {unit or '(no unit)'}; must be at least half a rotor pitch"
            f" ({180.0 / rotor_poles:.5g} deg mechanical, 180 electrical), and at most one revolution")
    named = best[2] if best[2].startswith("electrical") else f"mechanical {best[2]}"
    return best[1], named


def _misfit(table: np.ndarray) -> float | None:
    """How far the largest current's curve of the first phase is from one that falls from its greatest to its smallest
    value half a pitch away and rises again; None where the angles do not cover half a pitch to a revolution."""
    first = table[table[:, 1] == table[0, 1]]
    turned_rad, flux = first[:, 2], first[:, 4] / np.maximum(first[:, 3], 1e-300)
    angle_rad = np.unique(turned_rad)
    span_rad = float(angle_rad[-1] - angle_rad[0])
    if not math.pi - GAP_RAD <= span_rad <= 50.0 * math.pi or len(angle_rad) < ANGLES_MIN:
        return None
    used = first[:, 3] > 0.5 * np.max(first[:, 3])
    mean = np.array([np.mean(flux[used & (turned_rad == at)]) if np.any(used & (turned_rad == at)) else math.nan
                     for at in angle_rad])
    angle_rad, mean = angle_rad[np.isfinite(mean)], mean[np.isfinite(mean)]
    mean = (mean - np.min(mean)) / max(float(np.ptp(mean)), 1e-300)
    if len(mean) < ANGLES_MIN:
        return None
    best = math.inf
    for top_rad in angle_rad[np.argsort(mean)[-3:]]:
        away_rad = np.abs(np.remainder(angle_rad - top_rad + math.pi, 2.0 * math.pi) - math.pi)
        order = np.argsort(away_rad, kind="stable")
        fallen = isotonic_regression(mean[order], increasing=False).x
        reach = float(np.max(away_rad)) / math.pi  # half a pitch must be there
        best = min(best, float(np.sqrt(np.mean((mean[order] - fallen) ** 2))) + max(0.0, 0.8 - reach))
    return best + 1e-3


def _curves(table: np.ndarray, lines: list[str]) -> tuple[np.ndarray, list[_Phase]]:
    """Common currents from 0 A on, and the curves of each phase at them; without the flux linkage at 0 A."""
    names = np.unique(table[:, 1])
    tables = [table[table[:, 1] == name] for name in names]
    curves = [[(at, *_curve(rows[rows[:, 2] == at])) for at in np.unique(rows[:, 2])] for rows in tables]
    every = [curve for group in curves for curve in group]
    for _, current_A, _, line in every:
        if len(current_A) < CURRENTS_MIN + 1:
            raise FluxMapError(f"line {line[-1]}: {len(current_A) - 1} currents above 0 A at an angle; must be at least"
                               f" {CURRENTS_MIN}")
    least_A = min(float(current_A[-1]) for _, current_A, _, _ in every)
    longest = max(every, key=lambda curve: len(curve[1]))
    if least_A < 0.9 * max(float(current_A[-1]) for _, current_A, _, _ in every):
        short = min(every, key=lambda curve: float(curve[1][-1]))
        raise FluxMapError(f"line {short[3][-1]}: the currents end at {short[1][-1]:.6g} A there; at every angle they"
                           " must reach the same greatest current within 10 %")
    current_A = longest[1][longest[1] < 0.999 * least_A]
    current_A = np.append(current_A, least_A)
    if any(len(of) != len(longest[1]) or np.max(np.abs(of - longest[1])) > 1e-6 * least_A for _, of, _, _ in every):
        lines.append("currents: as at one angle, by interpolation at the others")
    _say_offset(table, every, lines)
    phases = []
    for name, group in zip(names, curves, strict=True):
        if len(group) < ANGLES_MIN:
            raise FluxMapError(f"line {group[0][3][0]}: {len(group)} angles of phase {int(name) + 1}; must be at"
                               f" least {ANGLES_MIN}")
        flux_Wb = np.array([_at_currents(of, flux, current_A) for _, of, flux, _ in group])
        line = np.array([lines_of[np.argmin(np.abs(np.subtract.outer(current_A, of)), axis=1)]
                         for _, of, _, lines_of in group])
        phases.append(_Phase(np.array([at for at, *_ in group]), flux_Wb, line))
    return current_A, phases


def _curve(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Currents from 0 on, flux linkages less that at 0 A (the mean of points at one current), lines of the file."""
    current_A = np.unique(rows[:, 3])
    flux_Wb = np.array([np.mean(rows[rows[:, 3] == of, 4]) for of in current_A])
    line = np.array([int(np.max(rows[rows[:, 3] == of, 0])) for of in current_A])
    if current_A[0] > 0.0:
        current_A, flux_Wb, line = np.append(0.0, current_A), np.append(0.0, flux_Wb), np.append(line[0], line)
    return current_A, flux_Wb - flux_Wb[0], line


def _at_currents(current_A: np.ndarray, flux_Wb: np.ndarray, wanted_A: np.ndarray) -> np.ndarray:
    if len(current_A) >= len(wanted_A) and np.max(np.abs(current_A[: len(wanted_A)] - wanted_A)) <= 1e-9 * wanted_A[-1]:
        return flux_Wb[: len(wanted_A)]
    read: np.ndarray = PchipInterpolator(current_A, flux_Wb)(wanted_A)
    return read


def _say_offset(table: np.ndarray, curves: Sequence[tuple[float, np.ndarray, np.ndarray, np.ndarray]],
                lines: list[str]) -> None:
    zero = table[table[:, 3] == 0.0]
    if len(zero) == 0:
        lines.append("0 A: added")
        return
    most_Wb = max(float(np.max(flux_Wb)) for _, _, flux_Wb, _ in curves)
    at = int(np.argmax(np.abs(zero[:, 4])))
    offset = abs(float(zero[at, 4])) / most_Wb
    if offset > OFFSET_MAX:
        raise FluxMapError(f"line {int(zero[at, 0])}: the flux linkage at 0 A is {zero[at, 4]:.4g} Wb; it must be 0"
                           f" within {OFFSET_MAX:.0%} of the map's largest")
    if offset > 0.0:
        lines.append(f"offset: up to {100.0 * offset:.2f} % of the largest flux linkage at 0 A, taken off")


def _origin(phase: _Phase) -> Origin:
    """The aligned position; of half a pitch, an end of the electrical turn that is within the uncertainty is kept: a
    shift that the file does not show would be invented."""
    origin = find_origin(phase.angle_rad, phase.flux_Wb[:, 1:])
    kept_rad = math.pi * round(origin.aligned_rad / math.pi)
    near = abs(origin.aligned_rad - kept_rad) <= origin.error_rad
    return Origin(kept_rad, origin.error_rad) if near and not _is_whole(phase) else origin


def _is_whole(phase: _Phase) -> bool:
    """Whether the points cover a whole pitch."""
    return float(phase.angle_rad[-1] - phase.angle_rad[0]) >= WHOLE_RAD


def _is_at_end(origin: Origin) -> bool:
    """Whether the aligned position is at an angle of 0 or of half a pitch."""
    return math.remainder(origin.aligned_rad, math.pi) == 0.0


def _say_origin(measured: Sequence[_Phase], origins: Sequence[Origin], pitch_deg: float, phases: int,
                lines: list[str]) -> None:
    """The aligned position of every phase, and how far it is from its place a stroke after another."""
    deg = pitch_deg / (2.0 * math.pi)
    shown = ", ".join(f"{deg * origin.aligned_rad:.3f} +- {deg * origin.error_rad:.3f}" for origin in origins)
    for phase, origin in zip(measured, origins, strict=True):
        if not _is_at_end(origin) and origin.error_rad > HALF_ERROR_RAD and not _is_whole(phase):
            raise FluxMapError(f"line {phase.line[0, 0]}: the points of half a pitch do not tell where the poles are"
                               f" aligned: at {deg * origin.aligned_rad:.3f} +- {deg * origin.error_rad:.3f} deg; must"
                               f" be known within {deg * HALF_ERROR_RAD:.3f} deg; a whole pitch shows it")
    is_kept = all(_is_at_end(origin) and not _is_whole(phase) for phase, origin in zip(measured, origins, strict=True))
    lines.append(f"origin: aligned at {shown} deg of the file (mechanical{', by phase' if len(origins) > 1 else ''}), "
                 + ("kept: half a pitch shows no smaller shift than that" if is_kept else "shifted to 0"))
    first = origins[0].aligned_rad
    worst_rad, at = 0.0, 0
    for number, origin in enumerate(origins):
        turned = phases * (origin.aligned_rad - first)
        away_rad = math.remainder(turned, 2.0 * math.pi) / phases
        if abs(away_rad) > abs(worst_rad):
            worst_rad, at = away_rad, number
    if len(origins) > 1:
        error_rad = origins[0].error_rad + origins[at].error_rad
        if abs(worst_rad) > 2.0 * math.pi * PLACE_MAX + error_rad:
            raise FluxMapError(f"line {measured[at].line[0, 0]}: the aligned position of phase {at + 1} is"
                               f" {deg * worst_rad:.3f} deg from its place a multiple of a stroke after phase 1; must"
                               f" be within {PLACE_MAX:.0%} of a pitch")
        lines.append(f"phases: {len(origins)}, their aligned positions up to {abs(deg * worst_rad):.3f} deg from their"
                     " place")


def _halves(phase: _Phase, origin: Origin, grid_rad: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Flux linkage from aligned to unaligned after and before the aligned position; None where points are missing."""
    both = [_half(phase, origin.aligned_rad, way, grid_rad) for way in (1.0, -1.0)]
    if both[0] is None and both[1] is None:
        raise FluxMapError(f"line {phase.line[0, 0]}: the angles leave more than {GAP_RAD / math.pi:.0%} of half a"
                           " pitch without points, or end more than that from the aligned and from the unaligned"
                           " position")
    return both[0], both[1]


def _half(phase: _Phase, aligned_rad: float, way: float, grid_rad: np.ndarray) -> np.ndarray | None:
    away_rad = np.remainder(way * (phase.angle_rad - aligned_rad) + GAP_RAD, 2.0 * math.pi) - GAP_RAD
    order = np.argsort(away_rad, kind="stable")
    away_rad, flux_Wb = away_rad[order], phase.flux_Wb[order]
    own = (away_rad >= -1e-9) & (away_rad <= math.pi + 1e-9)
    if np.sum(own) < 4:
        return None
    at = away_rad[own]
    if at[0] > GAP_RAD or at[-1] < math.pi - GAP_RAD or np.max(np.diff(at)) > GAP_RAD:
        return None
    # Beyond its ends, the other half where the file has it, else the mirror image.
    near = (away_rad >= -GAP_RAD) & (away_rad <= math.pi + GAP_RAD)
    x, y = away_rad[near], flux_Wb[near]
    # Two points at nearly one angle, of which the error of the origin moves one, would be a kink.
    apart_rad = 0.25 * float(np.median(np.diff(at)))
    if x[0] > -0.5 * GAP_RAD:
        mirrored = own & (away_rad > max(1e-6, -x[0] + apart_rad)) & (away_rad < 2.0 * GAP_RAD)
        x, y = np.append(-away_rad[mirrored], x), np.concatenate([flux_Wb[mirrored], y])
    if x[-1] < math.pi + 0.5 * GAP_RAD:
        mirrored = own & (away_rad > math.pi - 2.0 * GAP_RAD) & (2.0 * math.pi - away_rad > x[-1] + apart_rad)
        x, y = np.append(x, 2.0 * math.pi - away_rad[mirrored]), np.concatenate([y, flux_Wb[mirrored]])
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    kept = np.append(True, np.diff(x) > 1e-6)  # the ends of a whole pitch are one angle
    read: np.ndarray = CubicSpline(x[kept], y[kept])(grid_rad)
    return read


def _largest(values: np.ndarray) -> tuple[int, int, float]:
    """Row, column and value of the largest element."""
    row, column = divmod(int(np.argmax(values)), values.shape[1])
    return row, column, float(values[row, column])


def _compare_halves(halves: Sequence[tuple[np.ndarray | None, np.ndarray | None]], most_Wb: float,
                    current_A: np.ndarray, place: Callable[[int, int, int, int], str], lines: list[str]) -> None:
    worst, told = 0.0, ""
    for phase, (after, before) in enumerate(halves):
        if after is None or before is None:
            continue
        difference = np.abs(after - before) / most_Wb
        row, column, largest = _largest(difference)
        if largest >= worst:
            worst = largest
            lines_of = " and ".join(place(phase, half, row, column) for half in (0, 1))
            told = f"{lines_of}, {current_A[column]:.5g} A"
    if not told:
        lines.append("asymmetry: unknown, half a pitch")
        return
    if worst > ASYMMETRY_MAX:
        raise FluxMapError(f"{told}: the halves of the pitch differ by {100.0 * worst:.1f} % of the largest flux"
                           f" linkage; must be within {ASYMMETRY_MAX:.0%}")
    lines.append(f"asymmetry: the halves of the pitch differ by up to {100.0 * worst:.2f} % of the largest flux linkage"
                 f" ({told}); their mean is used")


def _compare_beyond(phase: _Phase, origin: Origin, both: tuple[np.ndarray | None, np.ndarray | None], most_Wb: float,
                    current_A: np.ndarray) -> None:
    """FluxMapError: of half a pitch, a few points beyond its ends are no mirror image of those before. The aligned
    position was then found at the edge of a dip."""
    if both[0] is not None and both[1] is not None:
        return
    way, half = (1.0, both[0]) if both[0] is not None else (-1.0, both[1])
    assert half is not None
    away_rad = np.abs(np.remainder(way * (phase.angle_rad - origin.aligned_rad) + math.pi, 2.0 * math.pi) - math.pi)
    mirrored = CubicSpline(np.linspace(0.0, math.pi, len(half)), half)(away_rad)
    difference = np.abs(phase.flux_Wb - mirrored) / most_Wb
    row, column, worst = _largest(difference)
    if worst > ASYMMETRY_MAX:
        raise FluxMapError(
            f"line {phase.line[row, column]}, {current_A[column]:.5g} A: beyond the end of half a pitch the flux"
            f" linkage differs from its mirror image by {100.0 * worst:.1f} % of the largest; must be within"
            f" {ASYMMETRY_MAX:.0%}")


def _compare_phases(means: Sequence[np.ndarray], most_Wb: float, current_A: np.ndarray,
                    place: Callable[[int, int, int], str], lines: list[str]) -> None:
    if len(means) < 2:
        return
    spread = np.ptp(np.array(means), axis=0) / most_Wb
    row, column, worst = _largest(spread)
    away = [abs(float(mean[row, column] - np.median([of[row, column] for of in means]))) for mean in means]
    told = f"{place(int(np.argmax(away)), row, column)}, {current_A[column]:.5g} A"
    if worst > SPREAD_MAX:
        raise FluxMapError(f"{told}: the phases differ by {100.0 * worst:.1f} % of the largest flux linkage; must be"
                           f" within {SPREAD_MAX:.0%}")
    lines.append(f"spread: the phases differ by up to {100.0 * worst:.2f} % of the largest flux linkage ({told}); their"
                 " mean is used")


def _monotonic(flux_Wb: np.ndarray, current_A: np.ndarray) -> np.ndarray:
    """The nearest map that falls from aligned to unaligned, and rises with the current by at least a thousandth of the
    mean inductance: the inductance of a coil without iron is never 0."""
    changed = flux_Wb.copy()
    rise_Wb = 1e-3 * float(np.max(flux_Wb)) * current_A / current_A[-1]
    for _ in range(3):
        for column in range(1, len(current_A)):
            changed[:, column] = isotonic_regression(changed[:, column], increasing=False).x
        for row in range(len(changed)):
            changed[row] = isotonic_regression(changed[row] - rise_Wb).x + rise_Wb
        changed[:, 0] = 0.0
    return changed


def _check_monotonic(flux_Wb: np.ndarray, current_A: np.ndarray, place: Callable[[int, int], str]) -> float:
    """The largest change of a curve, as a fraction of the aligned flux linkage at its current."""
    changed = np.abs(_monotonic(flux_Wb, current_A) - flux_Wb)[:, 1:] / np.maximum(np.max(flux_Wb, axis=0)[1:], 1e-300)
    row, column, worst = _largest(changed)
    if worst > REPAIR_MAX:
        raise FluxMapError(
            f"{place(row, column + 1)}, {current_A[column + 1]:.5g} A: the flux linkage does not fall from"
            f" aligned to unaligned, or not rise with the current: a dip or a step of {200.0 * worst:.1f} % of the"
            f" aligned flux linkage; must be within {2.0 * REPAIR_MAX:.0%}")
    return worst


def _check_slope(flux_Wb: np.ndarray, current_A: np.ndarray, place: Callable[[int, int], str]) -> None:
    """FluxMapError: the slope over the angle is far from one with a single maximum."""
    worst, at = 0.0, (0, 0)
    for column in range(1, len(current_A)):
        bent = _bend(flux_Wb[:, column]) / max(float(np.max(flux_Wb[:, column])), 1e-300)
        row = int(np.argmax(np.abs(bent)))
        if abs(bent[row]) > worst:
            worst, at = abs(float(bent[row])), (row, column)
    if worst > BEND_MAX:
        raise FluxMapError(
            f"{place(*at)}, {current_A[at[1]]:.5g} A: a dip or a step of {200.0 * worst:.1f} % of the aligned flux"
            f" linkage on the way from aligned to unaligned; must be within {2.0 * BEND_MAX:.0%}")


def _bend(flux_Wb: np.ndarray) -> np.ndarray:
    """Rest of a curve beside the nearest one whose slope has one maximum, about its middle."""
    fall = -np.diff(flux_Wb)
    best: np.ndarray | None = None
    for top in range(0, len(fall) + 1, _TOP_STEP):
        before = isotonic_regression(fall[:top]).x if top else fall[:0]
        after = isotonic_regression(fall[top:], increasing=False).x if top < len(fall) else fall[:0]
        bent = np.append(0.0, np.cumsum(np.concatenate([before, after]) - fall))
        bent -= 0.5 * (np.max(bent) + np.min(bent))
        if best is None or np.max(bent) < np.max(best):
            best = bent
    assert best is not None
    return best


def _place(phase: _Phase, angle_rad: float, column: int) -> str:
    """The line of the file nearest to an angle and a current."""
    away_rad = np.abs(np.remainder(phase.angle_rad - angle_rad + math.pi, 2.0 * math.pi) - math.pi)
    return f"line {phase.line[int(np.argmin(away_rad)), column]}"
