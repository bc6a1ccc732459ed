"""Magnetics of one phase by a flux-linkage map: one smooth potential through the points of finite elements or a bench.

The model is the co-energy W(theta, i), a tensor product of uniform B-splines, cubic in the angle and quartic in the
current, on half a rotor pitch (mirrored at the aligned and at the unaligned position) times 0 .. the map's greatest
current. Flux linkage dW/di, torque dW/dtheta, incremental inductance and every further derivative come from this one
function, so that an integration loses no energy in it. Beyond the greatest current the flux linkage continues linearly
with its last slope. emulator/plant/flux_map.h evaluates the same coefficients.

From the points to the potential, all in plain NumPy element by element (no BLAS, whose bits differ between processors):

1. over the current, at each angle: the cubic spline through the points and through (0 A, 0 Wb), with the slopes at its
   knots limited so that it rises where the points rise (J. M. Hyman, "Accurate monotonicity preserving cubic
   interpolation", SIAM J. Sci. Stat. Comput. 4(4), 1983), read at equal steps;
2. over the angle, at each of those currents: the same, with no slope at the ends, where the machine is symmetric;
3. the twice continuous spline through that uniform grid, and its integral over the current.

The points are met as far as the grid's steps allow, not exactly. Nothing is smoothed: the noise of a map is in the
model, and the torque, its derivative over the angle, shows it enlarged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from salient.machine.flux_map_origin import find_origin

# As in emulator/plant/flux_map.h.
ANGLE_INTERVALS = 96
CURRENT_INTERVALS = 64

# Range of the slope at a knot, as a multiple of the flatter adjacent chord. Up to 3 the cubic between two knots has no
# turning point; from a quarter to 2 its slope stays above a quarter of the flattest chord: the inductance must be > 0.
ANGLE_LIMITS = (0.0, 3.0)
CURRENT_LIMITS = (0.25, 2.0)

# Tolerances, as fractions. Measured maps repeat within a percent or so; a mistake in the file is larger.
MIRROR_TOLERANCE = 0.02  # between the halves of a whole pitch, of the map's greatest flux linkage
FALL_TOLERANCE = 0.01  # rise away from the aligned position, of the aligned flux linkage at the same current
MISS_TOLERANCE = 0.02  # between a point and the model, of the map's greatest flux linkage
RISE_TOLERANCE = 0.05  # above the inductance at lower currents, of the map's greatest flux linkage
REACH_TOLERANCE = 0.1  # by which an angle's greatest current may fall short of the others'

# From which the aligned position that the symmetry shows is another than 0, electrical (0.42 deg of an 8/6), if it is
# more than that many times its uncertainty, too: noise and corners of narrow poles look like a shift of half a pitch.
ORIGIN_TOLERANCE_RAD = math.radians(2.5)
ORIGIN_ERRORS = 3.0

IMPORT_HINT = "tools/salient machine MACHINE --import FILE shifts, symmetrises and resamples a map"

# Below it, time constants of the winding would make the emulator's steps as small as no machine needs them.
INDUCTANCE_MIN_H = 1e-6


class FluxMapError(ValueError):
    """A map that cannot be used; the text is one line."""


@dataclass(frozen=True)
class Curve:
    """Magnetisation at one angle: rising currents > 0 and flux linkages, with their lines in the file."""

    angle_rad: float
    current_A: np.ndarray
    flux_linkage_Wb: np.ndarray
    lines: Sequence[int]


@dataclass(frozen=True, eq=False)
class FluxMap:
    """Magnetics by a map, with the methods of `Formula`; made by `fit`."""

    rotor_poles: int
    current_max_A: float
    """Beyond it the flux linkage continues linearly."""
    coefficients_J: np.ndarray
    """Coefficients of the co-energy's B-splines: (CURRENT_INTERVALS + 4, ANGLE_INTERVALS + 3)."""
    file: Path | None = None
    """Source of the points."""

    form = "map"

    @property
    def pitch_rad(self) -> float:
        return 2.0 * math.pi / self.rotor_poles

    @property
    def unaligned_inductance_H(self) -> float:
        """Incremental inductance of the unsaturated phase, d psi / d i at 0 A."""
        return float(self.derivative(self.pitch_rad / 2.0, 0.0, 0, 2))

    def flux_linkage_Wb(self, angle_rad: ArrayLike, current_A: ArrayLike) -> np.ndarray:
        """psi."""
        return self.derivative(angle_rad, current_A, 0, 1)

    def coenergy_J(self, angle_rad: ArrayLike, current_A: ArrayLike) -> np.ndarray:
        """Integral of psi over the current at a constant angle."""
        return self.derivative(angle_rad, current_A, 0, 0)

    def torque_Nm(self, angle_rad: ArrayLike, current_A: ArrayLike) -> np.ndarray:
        """Derivative of the co-energy by the angle."""
        return self.derivative(angle_rad, current_A, 1, 0)

    def derivative(self, angle_rad: ArrayLike, current_A: ArrayLike, by_angle: int, by_current: int) -> np.ndarray:
        """A derivative of the co-energy, by the angle (0 to 2 times) and the current (0 to 3 times)."""
        angle_rad, current_A = np.broadcast_arrays(
            np.asarray(angle_rad, dtype=float), np.asarray(current_A, dtype=float)
        )
        within_A = np.minimum(current_A, self.current_max_A)
        beyond_A = current_A - within_A
        value = self._spline(angle_rad, within_A, by_angle, by_current)
        if by_current == 3:
            return np.where(beyond_A > 0.0, 0.0, value)
        if not np.any(beyond_A):
            return value
        factor = np.ones_like(beyond_A)
        for order in range(1, 3 - by_current):
            factor = factor * beyond_A / order
            value = value + factor * self._spline(angle_rad, within_A, by_angle, by_current + order)
        return value

    @cached_property
    def inductance_extremes(self) -> tuple[float, float, float, float]:
        """(least incremental inductance in H, its angle in rad, its current in A, the current in A over which
        it changes: largest inductance by largest slope), searched at four points per interval."""
        angle_rad = np.linspace(0.0, self.pitch_rad / 2.0, 4 * ANGLE_INTERVALS + 1)[:, None]
        current_A = np.linspace(0.0, self.current_max_A, 4 * CURRENT_INTERVALS + 1)
        inductance_H = self.derivative(angle_rad, current_A, 0, 2)
        slope_H_A = np.max(np.abs(self.derivative(angle_rad, current_A, 0, 3)))
        row, column = np.unravel_index(np.argmin(inductance_H), inductance_H.shape)
        scale_A = float(np.max(inductance_H) / max(slope_H_A, 1e-300))
        # Not below a step of the grid, its resolution; not above four, because the third derivative of the co-energy
        # jumps at every step and an integrator that crosses many of them in one step loses its order.
        step_A = self.current_max_A / CURRENT_INTERVALS
        scale_A = min(max(scale_A, step_A), 4.0 * step_A)
        return float(inductance_H[row, column]), float(angle_rad[row, 0]), float(current_A[column]), scale_A

    def _spline(self, angle_rad: np.ndarray, current_A: np.ndarray, by_angle: int, by_current: int) -> np.ndarray:
        """Takes differences before weighting, as the emulator does: the coefficients are large compared with their
        differences."""
        steps_1_rad = 2.0 * ANGLE_INTERVALS / self.pitch_rad
        steps_1_A = CURRENT_INTERVALS / self.current_max_A
        wrapped_rad = angle_rad - np.rint(angle_rad / self.pitch_rad) * self.pitch_rad
        column, across = _interval(np.abs(wrapped_rad) * steps_1_rad, ANGLE_INTERVALS)
        row, along = _interval(current_A * steps_1_A, CURRENT_INTERVALS)
        differences = np.diff(np.diff(self.coefficients_J, by_current, axis=0), by_angle, axis=1)
        across_weights = _weights(across, 3 - by_angle)
        value = sum(
            along_weight * sum(weight * differences[row + j, column + k] for k, weight in enumerate(across_weights))
            for j, along_weight in enumerate(_weights(along, 4 - by_current))
        )
        scale = math.prod([steps_1_rad] * by_angle + [steps_1_A] * by_current)  # libm's powers differ in the last bit
        result: np.ndarray = value * scale * np.where(wrapped_rad < 0.0, (-1.0) ** by_angle, 1.0)
        return result


def fit(curves: Sequence[Curve], rotor_poles: int, file: Path | None = None) -> FluxMap:
    """The model of checked curves, their angles rising from 0 to half a pitch or to a whole one. FluxMapError when the
    curves contradict each other or the symmetry of the machine, or are too uneven for the model."""
    half_rad = math.pi / rotor_poles
    whole = curves[-1].angle_rad > 1.5 * half_rad
    _check_inductance(curves)
    current_max_A = _common_current_A(curves)
    current_A = np.linspace(0.0, current_max_A, CURRENT_INTERVALS + 1)
    flux_Wb = np.array([_read_curve(curve, current_A) for curve in curves])
    _check_fall(curves, flux_Wb, half_rad, current_A)
    _check_origin(curves, flux_Wb, rotor_poles)

    angle_rad = np.array([curve.angle_rad for curve in curves])
    uniform_rad = np.linspace(0.0, angle_rad[-1], (2 if whole else 1) * ANGLE_INTERVALS + 1)
    slopes = _limited(angle_rad, flux_Wb, _spline_slopes(angle_rad, flux_Wb, flat_ends=True), ANGLE_LIMITS)
    grid_Wb = _hermite(angle_rad, flux_Wb, slopes, uniform_rad)
    if whole:
        _check_mirror(curves, grid_Wb, uniform_rad, current_A)
        grid_Wb = 0.5 * (grid_Wb + grid_Wb[::-1])[: ANGLE_INTERVALS + 1]

    over_current = _coefficients(grid_Wb.T, current_A[1], flat_ends=False)
    step_rad = half_rad / ANGLE_INTERVALS
    flux_coefficients = _coefficients(over_current.T, step_rad, flat_ends=True).T
    model = FluxMap(rotor_poles, current_max_A, _integral(flux_coefficients, current_A[1]), file)
    _check_model(model, curves)
    return model


def _check_origin(curves: Sequence[Curve], flux_Wb: np.ndarray, rotor_poles: int) -> None:
    """The aligned position, where the map is symmetric, is at 0. Half a pitch shows it by the slopes at its ends."""
    angle_rad = np.array([curve.angle_rad for curve in curves])
    origin = find_origin(rotor_poles * angle_rad, flux_Wb[:, 1:])
    if abs(origin.aligned_rad) > max(ORIGIN_TOLERANCE_RAD, ORIGIN_ERRORS * origin.error_rad):
        aligned_deg, error_deg = (math.degrees(of) / rotor_poles for of in (origin.aligned_rad, origin.error_rad))
        raise FluxMapError(
            f"line {curves[0].lines[0]}: the map is symmetric about {aligned_deg:.3f} +- {error_deg:.3f} deg, not"
            f" about 0 (aligned): {IMPORT_HINT}"
        )


def _check_inductance(curves: Sequence[Curve]) -> None:
    """Saturation lowers the inductance: no flux linkage is above a straight line from 0 through one at a lower current.
    The tolerance leaves room for the low permeability of iron in weak fields, and for noise."""
    allowed_Wb = RISE_TOLERANCE * max(curve.flux_linkage_Wb[-1] for curve in curves)
    for curve in curves:
        inductance_H = curve.flux_linkage_Wb / curve.current_A
        most_Wb = np.maximum.accumulate(inductance_H)[:-1] * curve.current_A[1:]
        at = 1 + int(np.argmax(curve.flux_linkage_Wb[1:] - most_Wb))
        if curve.flux_linkage_Wb[at] > most_Wb[at - 1] + allowed_Wb:
            lower = int(np.argmax(inductance_H[:at]))
            raise FluxMapError(
                f"line {curve.lines[at]}: at {_degrees(curve.angle_rad)} deg the flux linkage is"
                f" {curve.flux_linkage_Wb[at]:.4g} Wb at {curve.current_A[at]:g} A; must not be above"
                f" {most_Wb[at - 1]:.4g} Wb, which the inductance of line {curve.lines[lower]},"
                f" {inductance_H[lower]:.4g} H at {curve.current_A[lower]:g} A, gives without saturation, but for"
                f" {RISE_TOLERANCE:.0%} of the map's largest"
            )


def _common_current_A(curves: Sequence[Curve]) -> float:
    """The greatest current that every angle reaches: nothing is extrapolated within the map."""
    greatest_A = max(curve.current_A[-1] for curve in curves)
    for curve in curves:
        if curve.current_A[-1] < (1.0 - REACH_TOLERANCE) * greatest_A:
            raise FluxMapError(
                f"line {curve.lines[-1]}: the currents at {_degrees(curve.angle_rad)} deg end at"
                f" {curve.current_A[-1]:g} A, at another angle at {greatest_A:g} A; all must reach the same greatest"
                f" current within {REACH_TOLERANCE:.0%}"
            )
    return float(min(curve.current_A[-1] for curve in curves))


def _read_curve(curve: Curve, current_A: np.ndarray) -> np.ndarray:
    known_A = np.concatenate([[0.0], curve.current_A])
    known_Wb = np.concatenate([[0.0], curve.flux_linkage_Wb])
    slopes = _limited(known_A, known_Wb, _spline_slopes(known_A, known_Wb, flat_ends=False), CURRENT_LIMITS)
    return _hermite(known_A, known_Wb, slopes, current_A)


def _check_fall(curves: Sequence[Curve], flux_Wb: np.ndarray, half_rad: float, current_A: np.ndarray) -> None:
    """From aligned to unaligned the flux linkage of every current falls; else the torque has the wrong sign. A second
    half pitch is looked at from its end."""
    order = [at for at, curve in enumerate(curves) if curve.angle_rad <= half_rad]
    _check_fall_in(order, curves, flux_Wb, current_A)
    if curves[-1].angle_rad > half_rad:
        order = [at for at, curve in enumerate(curves) if curve.angle_rad >= half_rad]
        _check_fall_in(order[::-1], curves, flux_Wb, current_A)


def _check_fall_in(order: Sequence[int], curves: Sequence[Curve], flux_Wb: np.ndarray, current_A: np.ndarray) -> None:
    aligned_Wb = flux_Wb[order[0]]
    least_Wb, least_at = aligned_Wb.copy(), np.full(len(current_A), order[0])
    for at in order[1:]:
        column = int(np.argmax(flux_Wb[at] - least_Wb - FALL_TOLERANCE * aligned_Wb))
        if flux_Wb[at, column] - least_Wb[column] > FALL_TOLERANCE * aligned_Wb[column]:
            nearer = curves[least_at[column]]
            raise FluxMapError(
                f"line {_nearest_line(curves[at], current_A[column])}: at {current_A[column]:.3g} A the flux linkage is"
                f" {flux_Wb[at, column]:.4g} Wb at {_degrees(curves[at].angle_rad)} deg and only"
                f" {least_Wb[column]:.4g} Wb at {_degrees(nearer.angle_rad)} deg; from aligned (0 deg) to unaligned it"
                f" must fall, but for {FALL_TOLERANCE:.0%} of the aligned: {IMPORT_HINT}"
            )
        lower = flux_Wb[at] < least_Wb
        least_Wb[lower], least_at[lower] = flux_Wb[at, lower], at
    if not np.all(least_Wb[1:] < aligned_Wb[1:]):
        raise FluxMapError(
            f"line {curves[order[-1]].lines[0]}: the flux linkage at {_degrees(curves[order[-1]].angle_rad)} deg"
            " must be below that at the aligned position at every current"
        )


def _check_mirror(curves: Sequence[Curve], grid_Wb: np.ndarray, angle_rad: np.ndarray, current_A: np.ndarray
                  ) -> None:
    """Checks that the halves of a whole pitch agree. The message names the points of the file that are nearest to the
    largest difference."""
    difference_Wb = np.abs(grid_Wb - grid_Wb[::-1])
    row, column = np.unravel_index(np.argmax(difference_Wb), difference_Wb.shape)
    worst_Wb = float(difference_Wb[row, column])
    if worst_Wb > MIRROR_TOLERANCE * np.max(grid_Wb):
        given_rad = np.array([curve.angle_rad for curve in curves])
        nearest = [curves[int(np.argmin(np.abs(given_rad - angle_rad[at])))] for at in (row, -1 - row)]
        places = " and ".join(f"line {_nearest_line(curve, current_A[column])} ({_degrees(curve.angle_rad)} deg)"
                              for curve in nearest)
        raise FluxMapError(
            f"{places}: the halves of the pitch do not mirror each other: at"
            f" {_nearest_current(nearest[0], current_A[column]):.5g} A they differ by {worst_Wb:.4g} Wb,"
            f" {worst_Wb / np.max(grid_Wb):.1%} of the largest flux linkage; they must agree within"
            f" {MIRROR_TOLERANCE:.0%}: {IMPORT_HINT}"
        )


def _check_model(model: FluxMap, curves: Sequence[Curve]) -> None:
    least_H, angle_rad, current_A, _ = model.inductance_extremes
    if least_H < INDUCTANCE_MIN_H:
        nearest = min(curves, key=lambda curve: abs(curve.angle_rad - angle_rad))
        raise FluxMapError(
            f"line {_nearest_line(nearest, current_A)}: the curve through the points has an incremental inductance of"
            f" {least_H:.3g} H near {_degrees(nearest.angle_rad)} deg and {_nearest_current(nearest, current_A):.5g} A;"
            f" it must be at least {INDUCTANCE_MIN_H:g} H: the points there are too uneven, or in another unit"
        )
    allowed_Wb = MISS_TOLERANCE * max(curve.flux_linkage_Wb[-1] for curve in curves)
    for curve in curves:
        within = curve.current_A <= model.current_max_A
        given_Wb = curve.flux_linkage_Wb[within]
        miss_Wb = np.abs(model.flux_linkage_Wb(curve.angle_rad, curve.current_A[within]) - given_Wb)
        at = int(np.argmax(miss_Wb))
        if miss_Wb[at] > allowed_Wb:
            raise FluxMapError(
                f"line {curve.lines[at]}: the smooth model misses this point by {miss_Wb[at]:.3g} Wb; it must be"
                f" within {MISS_TOLERANCE:.0%} of the map's largest flux linkage: the points there are too uneven"
            )


def _nearest_line(curve: Curve, current_A: float) -> int:
    return curve.lines[int(np.argmin(np.abs(curve.current_A - current_A)))]


def _nearest_current(curve: Curve, current_A: float) -> float:
    return float(curve.current_A[int(np.argmin(np.abs(curve.current_A - current_A)))])


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.5g}"


# --- Splines; x are the knots, y the values there, an array whose first axis runs along them. ---


def _spline_slopes(x: np.ndarray, y: np.ndarray, *, flat_ends: bool) -> np.ndarray:
    """Slopes at the knots of the twice continuous cubic spline: flat at its ends, or with one cubic over the first two
    intervals and one over the last two ("not a knot"). At least four knots."""
    step = np.diff(x)
    chord = (y[1:] - y[:-1]) / _column(step, y)
    # Row k: below[k] d[k-1] + here[k] d[k] + above[k] d[k+1] = right[k].
    below, here, above = np.zeros_like(x), np.ones_like(x), np.zeros_like(x)
    right = np.zeros_like(y)
    below[1:-1], here[1:-1], above[1:-1] = step[1:], 2.0 * (step[:-1] + step[1:]), step[:-1]
    right[1:-1] = 3.0 * (_column(step[1:], y) * chord[:-1] + _column(step[:-1], y) * chord[1:])
    if not flat_ends:
        first, last = step[0] + step[1], step[-1] + step[-2]
        here[0], above[0] = step[1], first
        right[0] = ((step[0] + 2.0 * first) * step[1] * chord[0] + step[0] ** 2 * chord[1]) / first
        here[-1], below[-1] = step[-2], last
        right[-1] = ((step[-1] + 2.0 * last) * step[-2] * chord[-1] + step[-1] ** 2 * chord[-2]) / last
    for k in range(1, len(x)):
        factor = below[k] / here[k - 1]
        here[k] -= factor * above[k - 1]
        right[k] -= factor * right[k - 1]
    slopes = np.empty_like(y)
    slopes[-1] = right[-1] / here[-1]
    for k in range(len(x) - 2, -1, -1):
        slopes[k] = (right[k] - above[k] * slopes[k + 1]) / here[k]
    return slopes


def _limited(x: np.ndarray, y: np.ndarray, slopes: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Slopes of the chords' sign and within `limits` times the flatter adjacent chord; 0 where their signs differ."""
    chord = (y[1:] - y[:-1]) / _column(np.diff(x), y)
    left = np.concatenate([chord[:1], chord])
    right = np.concatenate([chord, chord[-1:]])
    sign = np.where(left * right > 0.0, np.sign(left), 0.0)
    flatter = np.minimum(np.abs(left), np.abs(right))
    limited: np.ndarray = sign * np.clip(sign * slopes, limits[0] * flatter, limits[1] * flatter)
    return limited


def _hermite(x: np.ndarray, y: np.ndarray, slopes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The cubic of each interval by values and slopes at its ends, at `at` within the knots."""
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    step = _column(x[k + 1] - x[k], y)
    t = _column((at - x[k]) / (x[k + 1] - x[k]), y)
    u = 1.0 - t
    value: np.ndarray = u * u * (y[k] * (1.0 + 2.0 * t) + step * t * slopes[k]) + t * t * (
        y[k + 1] * (1.0 + 2.0 * u) - step * u * slopes[k + 1]
    )
    return value


def _coefficients(y: np.ndarray, step: float, *, flat_ends: bool) -> np.ndarray:
    """B-spline coefficients, two more than knots, of the twice continuous cubic spline on equidistant knots."""
    slopes = _spline_slopes(step * np.arange(len(y)), y, flat_ends=flat_ends) * step
    curvature = 6.0 * (y[1:] - y[:-1]) - 4.0 * slopes[:-1] - 2.0 * slopes[1:]
    last_curvature = -6.0 * (y[-1:] - y[-2:-1]) + 2.0 * slopes[-2:-1] + 4.0 * slopes[-1:]
    inner = y - np.concatenate([curvature, last_curvature]) / 6.0
    return np.concatenate([inner[1:2] - 2.0 * slopes[:1], inner, inner[-2:-1] + 2.0 * slopes[-1:]])


def _integral(coefficients: np.ndarray, step: float) -> np.ndarray:
    """Coefficients of degree four, one more, of the integral from the first knot of a cubic spline."""
    summed = np.concatenate([np.zeros_like(coefficients[:1]), np.cumsum(step * coefficients, axis=0)])
    integral: np.ndarray = summed - (summed[0] + 11.0 * summed[1] + 11.0 * summed[2] + summed[3]) / 24.0
    return integral


def _interval(position: np.ndarray, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """Number of the interval and the position in it, 0 to 1; outside, the first and last intervals continue."""
    number = np.clip(np.floor(position).astype(int), 0, intervals - 1)
    return number, position - number


def _weights(t: np.ndarray, degree: int) -> list[Any]:
    """The degree + 1 uniform B-splines that are not zero at position t of an interval (de Boor's recursion)."""
    weights = [np.ones_like(t)]
    for d in range(1, degree + 1):
        last: list[Any] = [0.0, *weights, 0.0]
        weights = [((t + (d - j)) * last[j] + ((1.0 - t) + j) * last[j + 1]) / d for j in range(d + 1)]
    return weights


def _column(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """`values` along the first axis of `like`."""
    return values.reshape(-1, *(1,) * (like.ndim - 1))
