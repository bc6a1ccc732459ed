"""Reads a flux-linkage map from a CSV file.

Lines that start with # and blank lines are ignored. The first other line is a header,
`angle_deg,current_A,flux_linkage_Wb` (or angle_rad, or flux_linkage_mWb: the names have the units). Then follow rows of
one point, the angles rising, the currents rising within an angle. Angles are mechanical angles of the phase, from 0
(aligned) to half a rotor pitch (unaligned) or to a whole pitch; a whole one is averaged with its mirror image. The grid
may be irregular: angles at any distance, each with different currents. A row of 0 A may be left out.
"""

from __future__ import annotations

import math
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from salient.machine.flux_map import IMPORT_HINT, Curve, FluxMap, FluxMapError, fit
from salient.toml_file import TextFileError, read_text

FILE_BYTES_MAX = 20_000_000
ANGLES_MIN = 8
CURRENTS_MIN = 6  # at each angle, 0 A not counted
CURRENT_MAX_A = 10_000.0
FLUX_LINKAGE_MAX_Wb = 100.0

# The first and last angle are moved to the exact ends of the range when they are within this distance.
ANGLE_TOLERANCE_DEG = 0.01

# Closer points do not determine a slope.
ANGLE_STEP_MIN_DEG = 0.02
CURRENT_STEP_MIN_A = 0.001

# Factors to rad, A and Wb by the names that each column may have.
_COLUMNS = (
    {"angle_deg": math.pi / 180.0, "angle_rad": 1.0},
    {"current_A": 1.0},
    {"flux_linkage_Wb": 1.0, "flux_linkage_mWb": 1e-3},
)


def load_flux_map(path: Path, rotor_poles: int) -> FluxMap:
    """The model of a CSV file's map. FluxMapError: one line with the file and where possible its line."""
    try:
        return map_of_text(read_text(path, FILE_BYTES_MAX), rotor_poles, path)
    except (FluxMapError, TextFileError) as error:
        raise FluxMapError(f"{path}: {error}") from None


def map_of_text(text: str, rotor_poles: int, path: Path | None = None) -> FluxMap:
    """The model of the text of a file. FluxMapError: one line without the file."""
    return fit(_curves(_points(text), math.pi / rotor_poles), rotor_poles, path)


Point = tuple[int, float, float, float]
"""Line, angle in rad, current in A, flux linkage in Wb."""


def _points(text: str) -> list[Point]:
    rows = [
        (line, [cell.strip() for cell in row.split(",")])
        for line, row in enumerate(text.split("\n"), start=1)
        if row.strip() and not row.lstrip().startswith("#")
    ]
    if not rows:
        raise FluxMapError(f"no header; must be {_header_names()}")
    line, header = rows[0]
    if len(header) != len(_COLUMNS) or any(name not in allowed for name, allowed in zip(header, _COLUMNS, strict=True)):
        raise FluxMapError(f"line {line}: {','.join(header)!r:.100}: the header must be {_header_names()}:"
                           f" {IMPORT_HINT}")
    factors = [allowed[name] for name, allowed in zip(header, _COLUMNS, strict=True)]
    return [(line, *_numbers(line, cells, header, factors)) for line, cells in rows[1:]]


def _header_names() -> str:
    return ",".join("|".join(allowed) for allowed in _COLUMNS)


def _numbers(line: int, cells: list[str], header: list[str], factors: list[float]
             ) -> tuple[float, float, float]:
    if len(cells) != len(header):
        raise FluxMapError(f"line {line}: {len(cells)} columns; must be {len(header)}: {','.join(header)}")
    values = []
    for cell, name, factor in zip(cells, header, factors, strict=True):
        try:
            value = float(cell) if "_" not in cell else math.nan  # Python reads 0.1_2 as 0.12
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise FluxMapError(f"line {line}: {name}: {cell!r:.40}: must be a finite number")
        if value < 0.0:
            raise FluxMapError(f"line {line}: {name}: {cell:.40}: must not be negative")
        values.append(value * factor)
    angle_rad, current_A, flux_Wb = values
    return angle_rad, current_A, flux_Wb


def _curves(points: list[Point], half_rad: float) -> list[Curve]:
    """One curve per angle, after all checks of the file that require no model."""
    for (_, before_rad, *_), (line, angle_rad, *_) in pairwise(points):
        if angle_rad != before_rad and math.degrees(angle_rad - before_rad) < ANGLE_STEP_MIN_DEG:
            raise FluxMapError(
                f"line {line}: the angle goes from {math.degrees(before_rad):.5g} to {math.degrees(angle_rad):.5g} deg;"
                f" the angles must rise, by {ANGLE_STEP_MIN_DEG:g} deg at least, all currents of an angle together"
            )
    groups = [list(group) for _, group in groupby(points, key=lambda point: point[1])]
    if len(groups) < ANGLES_MIN:
        raise FluxMapError(f"{len(groups)} angles; must be at least {ANGLES_MIN}")
    ends_rad = _ends_rad(groups, half_rad)
    return [_curve(group, ends_rad.get(at, group[0][1])) for at, group in enumerate(groups)]


def _ends_rad(groups: list[list[Point]], half_rad: float) -> dict[int, float]:
    """The exact first and last angle by their index."""
    half_deg = math.degrees(half_rad)
    first_deg, last_deg = math.degrees(groups[0][0][1]), math.degrees(groups[-1][0][1])
    if first_deg > ANGLE_TOLERANCE_DEG:
        raise FluxMapError(f"line {groups[0][0][0]}: the angles begin at {first_deg:.5g} deg; must be 0 (aligned):"
                           f" {IMPORT_HINT}")
    for pitches in (1, 2):
        if abs(last_deg - pitches * half_deg) <= ANGLE_TOLERANCE_DEG:
            return {0: 0.0, len(groups) - 1: pitches * half_rad}
    raise FluxMapError(
        f"line {groups[-1][-1][0]}: the angles end at {last_deg:.5g} deg; must be half a rotor pitch"
        f" ({half_deg:.5g} deg, unaligned) or a whole one ({2.0 * half_deg:.5g} deg): {IMPORT_HINT}"
    )


def _curve(points: list[Point], angle_rad: float) -> Curve:
    angle = f"at {math.degrees(angle_rad):.5g} deg"
    line = points[-1][0]
    if points[0][2] == 0.0:
        zero_line, _, _, flux_Wb = points[0]
        if flux_Wb != 0.0:
            raise FluxMapError(f"line {zero_line}: the flux linkage at 0 A is {flux_Wb:.4g} Wb; it must be 0")
        points = points[1:]
    if len(points) < CURRENTS_MIN:
        raise FluxMapError(
            f"line {line}: {len(points)} currents above 0 A {angle}; must be at least {CURRENTS_MIN}"
        )
    last_A, last_Wb = 0.0, 0.0
    for line, _, current_A, flux_Wb in points:
        if current_A < last_A + CURRENT_STEP_MIN_A:
            raise FluxMapError(
                f"line {line}: {angle} {current_A:g} A comes after {last_A:g} A; the currents must rise, by"
                f" {CURRENT_STEP_MIN_A:g} A at least"
            )
        if flux_Wb <= last_Wb:
            raise FluxMapError(
                f"line {line}: {angle} the flux linkage goes from {last_Wb:.6g} Wb at {last_A:g} A to {flux_Wb:.6g} Wb"
                f" at {current_A:g} A; it must rise with the current"
            )
        if current_A > CURRENT_MAX_A:
            raise FluxMapError(f"line {line}: {current_A:g} A: must be at most {CURRENT_MAX_A:g} A")
        if flux_Wb > FLUX_LINKAGE_MAX_Wb:
            raise FluxMapError(f"line {line}: {flux_Wb:g} Wb: must be at most {FLUX_LINKAGE_MAX_Wb:g} Wb")
        last_A, last_Wb = current_A, flux_Wb
    lines, _, currents_A, fluxes_Wb = zip(*points, strict=True)
    return Curve(angle_rad, np.array(currents_A), np.array(fluxes_Wb), lines)
