"""The firmware's magnetics of a phase, sampled from a machine's: rows, cells and both surfaces of
firmware/control/machine_tables.h.

Torque over the angle has corners where poles begin to overlap, at angles that differ between machines. Hence rows are
as far apart as a tolerance permits: between two rows, the parabola through the torque at both and half way must be
within it. The tolerance is the smallest with which the rows suffice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from salient.machine.file import Machine, MachineError

# As in firmware/control/machine_tables.h.
ROWS = 33
CELLS = 64
NODE_OFFSET = 32768
CURRENT_A = np.arange(0.0, 81.0, 2.0)
"""Currents of the columns."""
ROW_UNITS = 1 << 14  # units of row_start in half a pitch
_HALF_PITCH = 1 << 31
CURVATURE_SHIFT_MAX = 8
# The finest are 4 uN m and 0.12 uWb per ampere, beyond which no product is finer than its result.
TORQUE_FRACTION_BITS = (6, 18)
FLUX_FRACTION_BITS = (11, 23)

# Tolerances of the rows, as a fraction of the largest torque at each of these currents.
_LEAST_TOLERANCE, _GREATEST_TOLERANCE = 1e-6, 1.0
_ROW_CURRENTS = np.array([1.0, 0.75, 0.5, 0.25, 0.125, 0.0625])  # fractions of the largest

# Torque that falls with the current, or is negative from the unaligned to the aligned position, has no inverse and is
# levelled: as noise of a map, up to this fraction of the largest torque at the same current; beyond the map's largest
# current, where its flux linkage is extrapolated linearly, by any amount.
FALL_TOLERANCE = 0.01

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
        """Right shift of the product of a value in Q14 and a current in Q9 times 2^15, less its low 32 bits."""
        return self.result_bits + 32 - 15 - (self.fraction_bits + 14 + 9)


@dataclass(frozen=True, eq=False)
class PhaseMap:
    row_start: np.ndarray
    """(ROWS,), 0..ROW_UNITS."""
    torque_per_ampere: Surface
    """N m / A."""
    flux_per_ampere: Surface
    """Wb / A."""

    def rows(self) -> list[tuple[int, int]]:
        """Start and reciprocal of each `machine_row_t`."""
        starts = [int(start) * (_HALF_PITCH // ROW_UNITS) for start in self.row_start]
        widths = [following - start for start, following in pairwise(starts)]
        return list(zip(starts, [*((1 << 46) // width for width in widths), 0], strict=True))

    def cell_row(self) -> np.ndarray:
        """(CELLS,): the row in which each of the equal parts of half a pitch begins."""
        begins = np.arange(CELLS) * (ROW_UNITS // CELLS)
        return np.searchsorted(self.row_start, begins, side="right") - 1


def machine_phase_map(path: Path | str, machine: Machine) -> PhaseMap:
    """The tables of a machine file's machine; MachineError when they cannot hold it."""
    try:
        return phase_map(machine.magnetics)
    except PhaseMapError as error:
        raise MachineError(f"{path}: magnetics: {error}") from None


def phase_map(magnetics: Any) -> PhaseMap:
    """The tables of `magnetics`: a `Formula`, a `FluxMap` or another object with their methods. PhaseMapError."""
    half_rad = magnetics.pitch_rad / 2.0
    row_start = _row_starts(magnetics)
    # The rows and, between them, the positions half way.
    places = np.interp(np.arange(2 * ROWS - 1), np.arange(0, 2 * ROWS - 1, 2), row_start)
    angle_rad = half_rad + half_rad * places[:, None] / ROW_UNITS

    flux_Wb = magnetics.flux_linkage_Wb(angle_rad, CURRENT_A)
    if not np.all(np.diff(flux_Wb, axis=1) > 0.0):
        raise PhaseMapError("the flux linkage does not rise with the current everywhere up to 80 A")
    torque_Nm = _rising_torque(magnetics, angle_rad)
    divisor_A = np.maximum(CURRENT_A, _SMALL_A)
    flux_per_ampere = magnetics.flux_linkage_Wb(angle_rad, divisor_A) / divisor_A
    return PhaseMap(
        row_start,
        _surface("torque", "N m/A", torque_Nm / divisor_A, TORQUE_FRACTION_BITS, 24),
        _surface("flux linkage", "Wb/A", flux_per_ampere, FLUX_FRACTION_BITS, 29),
    )


def _rising_torque(magnetics: Any, angle_rad: np.ndarray) -> np.ndarray:
    """Torque that nowhere falls with the current, nor below zero."""
    torque_Nm = magnetics.torque_Nm(angle_rad, CURRENT_A)
    torque_Nm = np.where(CURRENT_A > 0.0, torque_Nm, 0.0)  # not what rounding leaves there
    rising_Nm = np.maximum.accumulate(np.maximum(torque_Nm, 0.0), axis=1)
    excess_Nm = rising_Nm - torque_Nm - FALL_TOLERANCE * np.max(torque_Nm, axis=0)
    excess_Nm = np.where(magnetics.current_max_A >= CURRENT_A, excess_Nm, 0.0)
    row, column = np.unravel_index(np.argmax(excess_Nm), excess_Nm.shape)
    if excess_Nm[row, column] > 0.0:
        raise PhaseMapError(
            f"at {math.degrees(angle_rad[row, 0]):.4g} deg, towards aligned, the torque falls to"
            f" {torque_Nm[row, column]:.4g} N m at {CURRENT_A[column]:g} A; it must rise with the current, except for"
            f" {FALL_TOLERANCE:.0%} of the largest torque at that current"
        )
    return rising_Nm


def _surface(what: str, unit: str, values: np.ndarray, fraction_bits: tuple[int, int], result_bits: int) -> Surface:
    """Values at the rows (even) and half way (odd), in as fine a format as holds them."""
    rows, half_way = values[::2], values[1::2]
    curvatures = 2.0 * (rows[:-1] + rows[1:]) - 4.0 * half_way
    least, greatest = fraction_bits
    for bits in range(greatest, least - 1, -1):
        node = np.floor(rows * 2.0**bits + 0.5)
        if np.max(node) > 65535:
            continue
        for shift in range(CURVATURE_SHIFT_MAX + 1):
            curvature = np.floor(curvatures * 2.0 ** (bits - shift) + 0.5)
            if np.max(np.abs(curvature)) <= 127:
                return Surface(bits, result_bits, shift, node.astype(int), curvature.astype(int))
    raise PhaseMapError(f"{np.max(values):.4g} {unit} of {what} is more than the firmware's tables hold")


def _row_starts(magnetics: Any) -> np.ndarray:
    half_rad = magnetics.pitch_rad / 2.0
    angle_rad = half_rad + half_rad * np.arange(ROW_UNITS + 1)[:, None] / ROW_UNITS
    torque_Nm = magnetics.torque_Nm(angle_rad, min(CURRENT_A[-1], magnetics.current_max_A) * _ROW_CURRENTS)
    shape = torque_Nm / np.max(np.abs(torque_Nm), axis=0)

    least, greatest = _LEAST_TOLERANCE, _GREATEST_TOLERANCE
    starts = _rows_within(shape, greatest)
    assert starts is not None  # a single row satisfies the greatest tolerance
    while greatest > 1.1 * least:
        tolerance = math.sqrt(least * greatest)
        found = _rows_within(shape, tolerance)
        if found is None:
            least = tolerance
        else:
            starts, greatest = found, tolerance
    # A machine that needs fewer rows gets the others where the rows are widest.
    while len(starts) < ROWS:
        widest = int(np.argmax(np.diff(starts)))
        starts.insert(widest + 1, (starts[widest] + starts[widest + 1]) // 2)
    return np.array(starts)


def _rows_within(shape: np.ndarray, tolerance: float) -> list[int] | None:
    """Rows, each as wide as the tolerance allows; None when ROWS of them do not reach the aligned position."""
    starts = [0]
    while starts[-1] < ROW_UNITS:
        if len(starts) == ROWS:
            return None
        start = starts[-1]
        width, step = 1, 1
        while start + width + step <= ROW_UNITS and _is_parabola(shape[start : start + width + step + 1], tolerance):
            width += step
            step *= 2
        while step > 0:
            if start + width + step <= ROW_UNITS and _is_parabola(shape[start : start + width + step + 1], tolerance):
                width += step
            step //= 2
        starts.append(start + width)
    return starts


def _is_parabola(shape: np.ndarray, tolerance: float) -> bool:
    """True if the parabola through both ends and the middle is within the tolerance of all points."""
    last = len(shape) - 1
    u = (np.arange(last + 1) / last)[:, None]
    middle = 0.5 * (shape[last // 2] + shape[(last + 1) // 2])
    curvature = 2.0 * (shape[0] + shape[-1]) - 4.0 * middle
    parabola = shape[0] + u * (shape[-1] - shape[0]) - u * (1.0 - u) * curvature
    return bool(np.max(np.abs(parabola - shape)) <= tolerance)
