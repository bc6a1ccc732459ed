"""Where a table of flux linkages has its aligned position, found from the symmetry of the machine.

Flux linkage is even about the aligned and about the unaligned position: at each current it is a sum of cosines of
multiples of the electrical angle from there. The position is where such sums have the least squares. A table of a whole
pitch shows it by the difference of its halves, one of half a pitch by the slope at its aligned end, which must be
zero. The unaligned end does not count: poles begin to overlap near it, and the corner there looks like a shift.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

# Cosines of a sum: more follow noise, fewer miss the corners where poles begin to overlap.
HARMONICS_MAX = 12
WHOLE_RAD = 1.5 * math.pi
"""Tables over less than that have hardly a point whose mirror image is there, too."""
_CANDIDATES = 180  # over half a pitch
_UNEVEN_CANDIDATES = 15  # to either side of the position of the even sums
_PARTS = (0.1, 0.15, 0.2, 0.27)  # of half a pitch, at its aligned end
_POWERS = (2, 3, 4, 5)
_BEST = 2.0
_ERROR_LEAST_RAD = 1e-4  # of one polynomial
_SIGHT_RAD = math.pi / 6.0  # in which the position is sought there


@dataclass(frozen=True)
class Origin:
    """Aligned position in electrical radians (a pitch is 2 pi), within half a pitch of 0, and its uncertainty: two
    standard deviations, and how much the estimate depends on the form of the sums."""

    aligned_rad: float
    error_rad: float


def find_origin(angle_rad: np.ndarray, flux: np.ndarray) -> Origin:
    """The aligned position of rows at rising electrical angles, one column per current. At least 6 rows."""
    scaled = flux / np.maximum(np.max(np.abs(flux), axis=0), 1e-300)
    if angle_rad[-1] - angle_rad[0] >= WHOLE_RAD:
        return _by_halves(angle_rad, scaled)
    return _by_end(angle_rad, scaled)


def _by_halves(angle_rad: np.ndarray, scaled: np.ndarray) -> Origin:
    harmonics = min(HARMONICS_MAX, len(angle_rad) // 2 - 1)
    step_rad = math.pi / _CANDIDATES
    candidates = step_rad * np.arange(_CANDIDATES)
    near_rad = float(candidates[np.argmin([_squares(at, angle_rad, scaled, harmonics) for at in candidates])])
    shifted_rad, *_ = _least(near_rad, step_rad, lambda at: _squares(at, angle_rad, scaled, harmonics))
    # Halves that differ look like a shift to the even sums alone.
    candidates = shifted_rad + step_rad * np.arange(-_UNEVEN_CANDIDATES, _UNEVEN_CANDIDATES + 1)
    squares = [_squares(at, angle_rad, scaled, harmonics, uneven=True) for at in candidates]
    least_rad, least, curvature = _least(float(candidates[np.argmin(squares)]), step_rad,
                                         lambda at: _squares(at, angle_rad, scaled, harmonics, uneven=True))
    fewer = max(2, harmonics // 2 + 1)
    fewer_rad, *_ = _least(least_rad, step_rad, lambda at: _squares(at, angle_rad, scaled, fewer, uneven=True))
    deviation_rad = _deviation_rad(least, curvature, len(angle_rad) - harmonics - 2)
    aligned_rad = _aligned(least_rad, angle_rad, scaled, harmonics)
    error_rad = 2.0 * deviation_rad + abs(fewer_rad - least_rad) + 0.5 * abs(shifted_rad - least_rad)
    return Origin(math.remainder(aligned_rad, 2.0 * math.pi), error_rad)


def _by_end(angle_rad: np.ndarray, scaled: np.ndarray) -> Origin:
    """From even polynomials through the points near the aligned position: the mean of several widths and degrees, by
    their variances, and their scatter. The low degrees, which have one minimum, find the place; the high ones, which
    have more, tell it closer there."""
    aligned_rad = float(angle_rad[np.argmax(np.sum(scaled, axis=1))])
    sight_rad = _SIGHT_RAD * np.linspace(-1.0, 1.0, 31)
    first = _ends(angle_rad, scaled, aligned_rad, (2, 3), aligned_rad + sight_rad)
    if not first:
        return Origin(math.remainder(aligned_rad, 2.0 * math.pi), _SIGHT_RAD)
    near_rad, error_rad = _mean(first)
    step_rad = float(np.median(np.diff(angle_rad)))
    if angle_rad[0] <= near_rad <= angle_rad[-1]:
        close_rad = min(error_rad, _SIGHT_RAD) * np.linspace(-1.0, 1.0, 15)
        found = [each for each in _ends(angle_rad, scaled, aligned_rad, _POWERS, near_rad + close_rad)
                 if abs(each[0] - near_rad) < close_rad[-1]] or first
        # Errors of polynomials lie on one side: the worse ones would pull.
        least_rad = min(error for _, error in found)
        best = [each for each in found if each[1] <= _BEST * least_rad]
        near_rad, error_rad = _mean(best)[0], _mean(found)[1]
    unseen_rad = (0.1 if len(first) >= len(_PARTS) else 1.0) * step_rad  # few widths have no scatter to tell
    return Origin(math.remainder(near_rad, 2.0 * math.pi), error_rad + unseen_rad)


def _ends(angle_rad: np.ndarray, scaled: np.ndarray, aligned_rad: float, powers: Sequence[int], candidates: np.ndarray
          ) -> list[tuple[float, float]]:
    """Position and error by the polynomials of each width and number of powers, near the best of some candidates."""
    found = []
    for part in _PARTS:
        chosen = np.abs(angle_rad - aligned_rad) <= part * math.pi
        for number in powers:
            freedom = int(np.sum(chosen)) - number - 1
            if freedom < 1:
                continue

            def squares(at: float, chosen: np.ndarray = chosen, number: int = number) -> float:
                return _even_squares(angle_rad[chosen] - at, scaled[chosen], number)

            near_rad = float(candidates[np.argmin([squares(at) for at in candidates])])
            least_rad, least, curvature = _least(near_rad, float(candidates[1] - candidates[0]), squares)
            found.append((least_rad, max(2.0 * _deviation_rad(least, curvature, freedom), _ERROR_LEAST_RAD)))
    return found


def _mean(found: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Mean of positions by their errors, and its error: the least one, and their scatter."""
    values, errors = np.array(found).T
    weights = errors**-2.0 / np.sum(errors**-2.0)
    mean_rad = float(weights @ values)
    scatter_rad = math.sqrt(float(weights @ (values - mean_rad) ** 2))
    return mean_rad, float(np.min(errors)) + 2.0 * scatter_rad


def _even_squares(angle_rad: np.ndarray, scaled: np.ndarray, powers: int) -> float:
    """Sum of squares that even polynomials leave."""
    basis = np.linalg.qr(np.power.outer(angle_rad / math.pi, 2 * np.arange(powers)))[0]
    return float(np.sum((scaled - basis @ (basis.T @ scaled)) ** 2))


def _deviation_rad(squares: float, curvature: float, freedom: int) -> float:
    """Standard deviation of a position. The columns of a table err together: as if there were one."""
    return math.sqrt(2.0 * squares / (max(1, freedom) * curvature)) if curvature > 0.0 else math.pi


def _basis(at_rad: float, angle_rad: np.ndarray, harmonics: int) -> np.ndarray:
    basis: np.ndarray = np.cos(np.outer(angle_rad - at_rad, np.arange(harmonics + 1)))
    return basis


def _squares(at_rad: float, angle_rad: np.ndarray, scaled: np.ndarray, harmonics: int, *, uneven: bool = False
             ) -> float:
    """Sum of squares that even sums about a position leave; uneven: times 1 + a sin, whose one half is higher."""
    basis = _basis(at_rad, angle_rad, harmonics)
    left, values, _ = np.linalg.svd(basis, full_matrices=False)
    known = left[:, values > 1e-3 * values[0]]  # what the angles determine
    even = known @ (known.T @ scaled)
    rest = scaled - even
    squares = float(np.sum(rest**2))
    if not uneven:
        return squares
    higher = np.sin(angle_rad - at_rad)[:, None] * even
    higher -= known @ (known.T @ higher)
    return squares - float(np.sum(rest * higher)) ** 2 / max(float(np.sum(higher**2)), 1e-300)


def _least(near_rad: float, step_rad: float, squares: Callable[[float], float]) -> tuple[float, float, float]:
    """(position, sum of squares, its second derivative) of the minimum near a candidate, by parabolas."""
    at_rad, curvature = near_rad, 0.0
    for _ in range(6):
        before, here, after = (squares(at_rad + way * step_rad) for way in (-1, 0, 1))
        bend = before - 2.0 * here + after
        if bend <= 0.0:
            break
        curvature = bend / step_rad**2
        at_rad += float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) * step_rad
        step_rad = max(0.4 * step_rad, 0.002)
    return at_rad, squares(at_rad), curvature


def _aligned(symmetric_rad: float, angle_rad: np.ndarray, scaled: np.ndarray, harmonics: int) -> float:
    """The position of more flux linkage: the position of symmetry, or the one half a pitch away."""
    basis = _basis(symmetric_rad, angle_rad, harmonics)
    sums = np.linalg.lstsq(basis, np.sum(scaled, axis=1), rcond=1e-3)[0]
    odd = float(np.sum(sums[1::2]))
    return symmetric_rad if odd >= 0.0 else symmetric_rad + math.pi
