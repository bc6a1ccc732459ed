"""The firmware's magnetics of a phase, sampled from a machine's: rows, angle bins and both surfaces of
firmware/control/machine_tables.h.

Torque over the angle has corners where poles begin to overlap, at angles that differ between machines. Hence rows are
as far apart as a tolerance permits: between two rows, the parabola through the torque at both and half way must be
within it. The tolerance is the smallest with which the rows suffice. It is larger in an angle bin in which more rows
would begin than the firmware's look-up of an angle steps over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from salient.machine.contradictions import FALL_MAX
from salient.machine.drive_data import derive
from salient.machine.file import Machine, MachineError
from salient.machine.scaling import Exponents

# As in firmware/control/machine_tables.h.
ROWS = 33
ANGLE_BINS = 64
ROWS_INSIDE_BIN_MAX = 2
"""Rows that begin within an angle bin, not counting one at its start."""
NODE_OFFSET = 32768
CURRENT_A = np.arange(0.0, 81.0, 2.0)
"""Currents of the columns, in the machine's unit of current."""
ROW_UNITS = 1 << 14  # units of row_start in half a pitch
_COUNT = np.arange(ROW_UNITS + 1.0)
_BIN_UNITS = ROW_UNITS // ANGLE_BINS
_HALF_PITCH = 1 << 31
CURVATURE_SHIFT_MAX = 8
# The finest are 4 uN m and 0.12 uWb per ampere, beyond which no product is finer than its result.
TORQUE_FRACTION_BITS = (6, 18)
FLUX_FRACTION_BITS = (11, 23)

# Tolerances of the rows, as a fraction of the largest torque at each of these currents.
_LEAST_TOLERANCE, _GREATEST_TOLERANCE = 1e-6, 1.0
_TOLERANCE_STEP = 2.0
"""Factor by which the tolerance in a crowded angle bin grows until the rows fit."""
_ROW_CURRENTS = np.array([1.0, 0.75, 0.5, 0.25, 0.125, 0.0625])  # fractions of the largest

# Torque that falls with the current, or is negative from the unaligned to the aligned position, has no inverse and is
# levelled: as noise of a map, up to FALL_MAX of the largest torque at the same current; beyond the map's largest
# current, where its flux linkage is extrapolated linearly, by any amount.

# Torque, as a fraction of the largest at the same current, that is zero: as a spline through a map leaves before the
# poles overlap, of any slope. A phase that is to make a torque there would turn its current off.
_NO_TORQUE = 5e-4

# Columns from the middle of a cell to which the firmware extrapolates the flux linkage of a sample
# (firmware/control/phase_cell.h), which it converts to its format without saturation.
_EXTRAPOLATED_COLUMNS = 4.0

# Current at which psi / i of zero current is evaluated.
_SMALL_A = 1e-6


class PhaseMapError(ValueError):
    """Magnetics that the firmware's tables cannot hold; the text is one line."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Torque or flux linkage per ampere: integers with `fraction_bits` fraction bits."""

    fraction_bits: int
    result_bits: int
    """Fraction bits of the result in the firmware."""
    curvature_shift: int
    """0..CURVATURE_SHIFT_MAX: the smallest with which the curvatures fit."""
    node: np.ndarray
    """(ROWS, columns), 0..65535."""
    curvature: np.ndarray
    """(ROWS - 1, columns), -128..127, in 2^curvature_shift of a node's last place."""

    @property
    def result_shift(self) -> int:
        """Left shift to the result's format, of the product of a value in Q14 and a current in Q9 times 2^15 without
        its low 32 bits."""
        return self.result_bits + 32 - 15 - (self.fraction_bits + 14 + 9)

    def over_angle(self, u: np.ndarray) -> np.ndarray:
        """(ROWS - 1, len(u), columns), N m / A or Wb / A: the parabola from each row to the next at fractions u."""
        u = u[:, None]
        low, high, curvature = self.node[:-1, None], self.node[1:, None], self.curvature[:, None]
        parabola = low + u * (high - low) - u * (1.0 - u) * curvature * 2.0**self.curvature_shift
        result: np.ndarray = parabola / 2.0**self.fraction_bits
        return result


@dataclass(frozen=True, eq=False)
class PhaseMap:
    row_start: np.ndarray
    """(ROWS,), 0..ROW_UNITS."""
    torque_per_ampere: Surface
    """N m / A, in the machine's units as all of the tables."""
    flux_per_ampere: Surface
    """Wb / A."""

    def rows(self) -> list[tuple[int, int]]:
        """Start and reciprocal of each `machine_row_t`; the last twice, because the look-up compares two rows."""
        starts = [int(start) * (_HALF_PITCH // ROW_UNITS) for start in self.row_start]
        widths = [following - start for start, following in pairwise(starts)]
        last = (starts[-1], 0)
        return [*((start, (1 << 46) // width) for start, width in zip(starts[:-1], widths, strict=True)), last, last]

    def angle_bin_row(self) -> np.ndarray:
        """(ANGLE_BINS,): the row in which each angle bin begins."""
        begins = np.arange(ANGLE_BINS) * _BIN_UNITS
        return np.searchsorted(self.row_start, begins, side="right") - 1


class _InUnits:
    """Magnetics in the units of a machine: multiplied by powers of two, exactly."""

    def __init__(self, magnetics: Any, exponents: Exponents, current_max_A: float) -> None:
        self.magnetics, self.pitch_rad = magnetics, magnetics.pitch_rad
        self.ampere, self.weber, self.newton_metre = (
            2.0**exponent for exponent in (exponents.current, exponents.voltage, exponents.torque))
        self.current_max_A = min(magnetics.current_max_A, current_max_A) / self.ampere

    def flux_linkage_Wb(self, angle_rad: Any, current_A: Any) -> np.ndarray:
        flux_Wb: np.ndarray = self.magnetics.flux_linkage_Wb(angle_rad, current_A * self.ampere) / self.weber
        return flux_Wb

    def torque_Nm(self, angle_rad: Any, current_A: Any) -> np.ndarray:
        torque_Nm: np.ndarray = self.magnetics.torque_Nm(angle_rad, current_A * self.ampere) / self.newton_metre
        return torque_Nm


def machine_phase_map(path: Path | str, machine: Machine, exponents: Exponents) -> PhaseMap:
    """The tables of a machine file's machine in its units; MachineError when they cannot hold it."""
    try:
        return phase_map(machine.magnetics, exponents, derive(machine).adc_current_A)
    except PhaseMapError as error:
        raise MachineError(f"{path}: magnetics: {error}") from None


def phase_map(magnetics: Any, exponents: Exponents = Exponents(),  # noqa: B008 - it cannot change
              current_max_A: float = math.inf) -> PhaseMap:
    """The tables of `magnetics`: a `Formula`, a `FluxMap` or another object with their methods, in these units.
    current_max_A: the largest current that is measured; torque may fall with the current beyond, where it is levelled.
    PhaseMapError, in SI units."""
    magnetics = _InUnits(magnetics, exponents, current_max_A)
    ampere, weber, newton_metre = magnetics.ampere, magnetics.weber, magnetics.newton_metre
    half_rad = magnetics.pitch_rad / 2.0
    row_start = _row_starts(magnetics)
    # The rows and, between them, the positions half way.
    places = np.interp(np.arange(2 * ROWS - 1), np.arange(0, 2 * ROWS - 1, 2), row_start)
    angle_rad = half_rad + half_rad * places[:, None] / ROW_UNITS

    flux_Wb = magnetics.flux_linkage_Wb(angle_rad, CURRENT_A)
    if not np.all(np.diff(flux_Wb, axis=1) > 0.0):
        raise PhaseMapError("the flux linkage does not rise with the current everywhere up to"
                            f" {CURRENT_A[-1] * ampere:g} A")
    torque_Nm = _rising_torque(magnetics, angle_rad)
    divisor_A = np.maximum(CURRENT_A, _SMALL_A)
    flux_per_ampere = magnetics.flux_linkage_Wb(angle_rad, divisor_A) / divisor_A
    tables = PhaseMap(
        row_start,
        _surface("torque", "N m/A", newton_metre / ampere, torque_Nm / divisor_A, TORQUE_FRACTION_BITS, 24),
        _surface("flux linkage", "Wb/A", weber / ampere, flux_per_ampere, FLUX_FRACTION_BITS, 29),
    )
    largest_Wb = _largest_flux_linkage_Wb(tables.flux_per_ampere)
    limit_Wb = 2.0 ** (31 - tables.flux_per_ampere.result_bits)
    if largest_Wb > 0.995 * limit_Wb:  # the angles of _largest_flux_linkage_Wb miss up to 0.1 %
        raise PhaseMapError(
            f"the flux linkage up to {CURRENT_A[-1] * ampere:g} A, extrapolated by up to {_EXTRAPOLATED_COLUMNS:g}"
            f" columns of the tables, is up to {largest_Wb * weber:.4g} Wb; it must be below {limit_Wb * weber:g} Wb"
        )
    return tables


def _largest_flux_linkage_Wb(surface: Surface) -> float:
    """Largest magnitude up to the largest current, extrapolated from every cell as the firmware does, at every angle,
    curvature included."""
    values = surface.over_angle(np.linspace(0.0, 1.0, 33))
    low, high = values[..., :-1], values[..., 1:]
    width_A = CURRENT_A[1] - CURRENT_A[0]
    middle_A = CURRENT_A[:-1] + 0.5 * width_A
    slope = (high - low) / width_A
    # psi = i (intercept + slope i) is extreme at the ends of its range of currents, or at its vertex.
    intercept = low - slope * CURRENT_A[:-1]
    ends_A = [np.clip(middle_A + columns * width_A, 0.0, CURRENT_A[-1])
              for columns in (-_EXTRAPOLATED_COLUMNS, _EXTRAPOLATED_COLUMNS)]
    vertex_A = -0.5 * intercept / np.where(slope == 0.0, 1.0, slope)
    currents_A = [*ends_A, np.clip(vertex_A, *ends_A)]
    return max(float(np.max(np.abs(current_A * (intercept + slope * current_A)))) for current_A in currents_A)


def _rising_torque(magnetics: Any, angle_rad: np.ndarray) -> np.ndarray:
    """Torque that nowhere falls with the current, nor below zero; 0 where it is next to nothing."""
    torque_Nm = magnetics.torque_Nm(angle_rad, CURRENT_A)
    torque_Nm = np.where(CURRENT_A > 0.0, torque_Nm, 0.0)  # not what rounding leaves there
    rising_Nm = np.maximum.accumulate(np.maximum(torque_Nm, 0.0), axis=1)
    excess_Nm = rising_Nm - torque_Nm - FALL_MAX * np.max(torque_Nm, axis=0)
    excess_Nm = np.where(magnetics.current_max_A >= CURRENT_A, excess_Nm, 0.0)
    row, column = np.unravel_index(np.argmax(excess_Nm), excess_Nm.shape)
    if excess_Nm[row, column] > 0.0:
        raise PhaseMapError(
            f"at {math.degrees(angle_rad[row, 0]):.4g} deg, towards aligned, the torque falls to"
            f" {torque_Nm[row, column] * magnetics.newton_metre:.4g} N m at {CURRENT_A[column] * magnetics.ampere:g} A;"
            f" it must rise with the current, except for {FALL_MAX:.0%} of the largest torque at that current"
        )
    return np.where(rising_Nm > _NO_TORQUE * rising_Nm.max(axis=0), rising_Nm, 0.0)


def _surface(what: str, unit: str, in_unit: float, values: np.ndarray, fraction_bits: tuple[int, int],
             result_bits: int) -> Surface:
    """Values at the rows (even) and half way (odd), in as fine a format as holds them. in_unit: 1 in the SI unit."""
    rows, half_way = values[::2], values[1::2]
    curvatures = 2.0 * (rows[:-1] + rows[1:]) - 4.0 * half_way
    least, greatest = fraction_bits
    for bits in range(greatest, least - 1, -1):
        node = np.floor(rows * 2.0**bits + 0.5)
        if np.max(node) > 65535:
            continue
        for shift in range(CURVATURE_SHIFT_MAX + 1):
            curvature = np.floor(curvatures * 2.0 ** (bits - shift) + 0.5)
            # The parabola that begins or ends at zero does not go below.
            most = np.floor(np.maximum(node[:-1], node[1:]) * 2.0**-shift)
            curvature = np.where(np.minimum(node[:-1], node[1:]) > 0.0, curvature, np.minimum(curvature, most))
            if np.max(np.abs(curvature)) <= 127:
                return Surface(bits, result_bits, shift, node.astype(int), curvature.astype(int))
    raise PhaseMapError(f"{np.max(values) * in_unit:.4g} {unit} of {what} is more than the firmware's tables hold")


def _row_starts(magnetics: Any) -> np.ndarray:
    half_rad = magnetics.pitch_rad / 2.0
    angle_rad = half_rad + half_rad * np.arange(ROW_UNITS + 1)[:, None] / ROW_UNITS
    torque_Nm = magnetics.torque_Nm(angle_rad, min(CURRENT_A[-1], magnetics.current_max_A) * _ROW_CURRENTS)
    shape = np.ascontiguousarray((torque_Nm / np.max(np.abs(torque_Nm), axis=0)).T)  # long rows: six times as fast

    least, greatest = _LEAST_TOLERANCE, _GREATEST_TOLERANCE
    starts = _rows_within(shape, greatest) or [0, ROW_UNITS]
    while greatest > 1.1 * least:
        tolerance = math.sqrt(least * greatest)
        found = _rows_within(shape, tolerance)
        if found is None:
            least = tolerance
        else:
            starts, greatest = found, tolerance
    # A machine that needs fewer rows gets the others where the rows are widest: wider than two angle bins, so that no
    # other row begins in the bin of its middle.
    while len(starts) < ROWS:
        widest = int(np.argmax(np.diff(starts)))
        starts.insert(widest + 1, (starts[widest] + starts[widest + 1]) // 2)
    return np.array(starts)


def _rows_within(shape: np.ndarray, tolerance: float) -> list[int] | None:
    """Rows, each as wide as the tolerance permits; None when ROWS of them do not reach the aligned position. Where more
    than ROWS_INSIDE_BIN_MAX would begin in an angle bin, the tolerance is larger for the rows after the first."""
    starts = [0]
    end_of_bin, tolerance_in_bin = 0, tolerance
    while starts[-1] < ROW_UNITS:
        if len(starts) == ROWS:
            return None
        start = starts[-1] + _row_width(shape, starts[-1], tolerance)
        if end_of_bin - _BIN_UNITS <= starts[-1] < start < end_of_bin:
            start = starts[-1] + _row_width(shape[:, : end_of_bin + 1], starts[-1], tolerance_in_bin)
        starts.append(start)
        begin = start - start % _BIN_UNITS
        if sum(begin < other < begin + _BIN_UNITS for other in starts) > ROWS_INSIDE_BIN_MAX:
            crowded_before = begin + _BIN_UNITS == end_of_bin
            tolerance_in_bin = _TOLERANCE_STEP * (tolerance_in_bin if crowded_before else tolerance)
            end_of_bin = begin + _BIN_UNITS
            del starts[-ROWS_INSIDE_BIN_MAX:]
    return starts


def _row_width(shape: np.ndarray, start: int, tolerance: float) -> int:
    """Width of a row, as large as the tolerance permits, by doubled and then halved steps."""
    width, step = 1, 1
    last = shape.shape[1] - 1
    while start + width + step <= last and _is_parabola(shape[:, start : start + width + step + 1], tolerance):
        width += step
        step *= 2
    while step > 0:
        if start + width + step <= last and _is_parabola(shape[:, start : start + width + step + 1], tolerance):
            width += step
        step //= 2
    return width


def _is_parabola(shape: np.ndarray, tolerance: float) -> bool:
    """True if the parabola through both ends and the middle is within the tolerance of all points."""
    last = shape.shape[1] - 1
    u = _COUNT[: last + 1] / last
    first, end = shape[:, :1], shape[:, -1:]
    middle = 0.5 * (shape[:, last // 2, None] + shape[:, (last + 1) // 2, None])
    curvature = 2.0 * (first + end) - 4.0 * middle
    difference = u * (end - first)  # in place: memory is most of the time
    difference += first
    difference -= u * (1.0 - u) * curvature
    difference -= shape
    return bool(max(difference.max(), -difference.min()) <= tolerance)
