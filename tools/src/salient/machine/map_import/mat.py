"""Makes points of a MAT file: vectors of angles and currents with a matrix of flux linkages, or columns of equal
length."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from scipy.io import loadmat

from salient.machine.flux_map import FluxMapError
from salient.machine.map_import.columns import Column, column
from salient.machine.map_import.layouts import Points, points_of
from salient.machine.map_import.text import Block, Row


def is_mat(data: bytes) -> bool:
    """Whether a file begins as a MAT file of version 5 or 7.3 does."""
    return data[:10] == b"MATLAB 5.0" or is_hdf5(data)


def is_hdf5(data: bytes) -> bool:
    return data[:10] == b"MATLAB 7.3" or data[:8] == b"\x89HDF\r\n\x1a\n"


def mat_points(data: bytes) -> Points:
    """The points of a MAT file; their line is the number of the value in its matrix. FluxMapError."""
    if is_hdf5(data):
        raise FluxMapError("a MAT file of version 7.3 (HDF5), which is not read; write it with save(..., '-v7')")
    try:
        loaded = loadmat(io.BytesIO(data), squeeze_me=True)
    except Exception as error:  # SciPy raises many kinds for a damaged file
        raise FluxMapError(f"not a MAT file: {' '.join(str(error).split())[:80]}") from None
    arrays = _arrays({name: value for name, value in loaded.items() if not name.startswith("__")})
    found = {name: (column(name), array) for name, array in arrays.items()}
    fluxes = {name: (of, array) for name, (of, array) in found.items() if array.ndim in (2, 3)
              and not (of is not None and of.role == "other")}
    vectors = {name: (of, array) for name, (of, array) in found.items() if array.ndim == 1 and len(array) > 3}
    order = {"flux": 0, "inductance": 1}
    for flux, array in sorted(fluxes.values(), key=lambda item: order.get(item[0].role if item[0] else "", 2)):
        if (flux is None or flux.role in order) and (axes := _axes(array.shape, vectors)) is not None:
            return _matrix_points(array, flux, axes)
        if array.ndim == 2 and array.shape[1] in (3, 4) and flux is None:
            return _rows(array)
    points = _columns(found)
    if points is not None:
        return points
    named = ", ".join(f"{name} {'x'.join(map(str, array.shape))}" for name, array in arrays.items())
    raise FluxMapError(f"no matrix of flux linkages with vectors of its angles and currents; it has {named:.200}")


Axis = tuple[int, Column | None, np.ndarray]


def _arrays(values: dict[str, Any]) -> dict[str, np.ndarray]:
    """All arrays of numbers, arrays of structures by the name of their field."""
    found: dict[str, np.ndarray] = {}
    for name, value in values.items():
        array = np.asarray(value)
        if array.dtype.names and array.ndim == 0:
            found |= _arrays({field: array[field].item() for field in array.dtype.names})
        elif array.dtype.kind in "fiu":
            found[name] = array.astype(float)
    return found


def _axes(shape: tuple[int, ...], vectors: dict[str, tuple[Column | None, np.ndarray]]) -> tuple[Axis, Axis] | None:
    """Axis of the angle and axis of the current in an array."""
    axes = []
    for role in ("angle", "current"):
        fits = [(at, of, array) for of, array in vectors.values() for at, length in enumerate(shape)
                if of is not None and of.role == role and len(array) == length]
        if not fits:
            return None
        axes.append(fits)
    pairs = [(angle, current) for angle in axes[0] for current in axes[1] if angle[0] != current[0]]
    return pairs[0] if pairs else None


def _matrix_points(array: np.ndarray, flux: Column | None, axes: tuple[Axis, Axis]) -> Points:
    (angle_at, angle, angles), (current_at, current, currents) = axes
    points = Points(layout="a matrix of a MAT file")
    current_factor, flux_factor = points.units(angle, current, flux)
    rest = [at for at in range(array.ndim) if at not in (angle_at, current_at)]
    ordered = np.transpose(array, [*rest, angle_at, current_at]).reshape(-1, len(angles), len(currents))
    for phase, matrix in enumerate(ordered):
        for row, (at, fluxes) in enumerate(zip(angles, matrix, strict=True), start=1):
            for value, psi in zip(currents, fluxes, strict=True):
                current_A = current_factor * float(value)
                points.add(row, phase, float(at), current_A, points.value(flux, current_A, flux_factor * float(psi)))
    return points


def _rows(array: np.ndarray) -> Points:
    rows = [Row(at, tuple(f"{value:.12g}" for value in row), tuple(map(float, row)))
            for at, row in enumerate(array, start=1)]
    return points_of([Block(rows=rows)])


def _columns(found: dict[str, tuple[Column | None, np.ndarray]]) -> Points | None:
    """Arrays of equal size, a value of each for each point (also of a mesh grid)."""
    by_role = {role: next(((of, array.ravel()) for of, array in found.values() if of is not None and of.role == role),
                          None) for role in ("angle", "current", "flux", "inductance")}
    inductance = by_role.pop("inductance")
    by_role["flux"] = by_role["flux"] or inductance
    parts = [part for part in by_role.values() if part is not None]
    if len(parts) < 3 or len({len(array) for _, array in parts}) != 1:
        return None
    points = Points(layout="vectors of a MAT file")
    (angle, angles), (current, currents), (flux, fluxes) = parts
    current_factor, flux_factor = points.units(angle, current, flux)
    for at, (theta, i, psi) in enumerate(zip(angles, currents, fluxes, strict=True), start=1):
        current_A = current_factor * float(i)
        points.add(at, 0, float(theta), current_A, points.value(flux, current_A, flux_factor * float(psi)))
    return points
