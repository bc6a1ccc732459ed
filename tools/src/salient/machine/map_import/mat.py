"""Makes points of a MAT file: vectors of angles and currents with a matrix of flux linkages, or columns of equal
length."""

from __future__ import annotations

import io
import re
import struct
from typing import Any

import numpy as np
from scipy.io import loadmat

from salient.machine.flux_map import FluxMapError
from salient.machine.map_import.columns import Column, column
from salient.machine.map_import.layouts import Points, points_of
from salient.machine.map_import.text import Block, Row


def is_mat(data: bytes, suffix: str = "") -> bool:
    """Whether a file begins as a MAT file of version 5 or 7.3 does, or of version 4 with the suffix, as Octave and old
    versions write it: five numbers, of which the first is its type."""
    if suffix.lower() == ".mat" and len(data) > 20:
        kinds = [struct.unpack_from(f"{order}L", data)[0] for order in "<>"]
        if any(kind <= 4052 and kind // 10 % 10 <= 5 for kind in kinds):
            return True
    return data[:10] == b"MATLAB 5.0" or is_hdf5(data)


def is_octave(text: str) -> bool:
    """Whether Octave wrote a text, as it does by default."""
    return text.startswith("# Created by Octave") and "# type: matrix" in text


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
    return _points(_arrays({name: value for name, value in loaded.items() if not name.startswith("__")}))


def octave_points(text: str) -> Points:
    """The points of a text of Octave: matrices by name. FluxMapError."""
    found: dict[str, np.ndarray] = {}
    for part in re.split(r"(?m)^# name: ", text)[1:]:
        name, _, rest = part.partition("\n")
        sizes = [re.search(rf"(?m)^# {key}: (\d+)$", rest) for key in ("rows", "columns")]
        rows, columns = (int(size[1]) if size else 0 for size in sizes)
        try:
            values = [float(word) for line in rest.splitlines() if not line.startswith("#") for word in line.split()]
        except ValueError:
            continue  # of another type
        if "# type: matrix" in rest and rows * columns == len(values) > 1:
            found[name.strip()] = np.squeeze(np.array(values).reshape(rows, columns))
    return _points(found)


def _points(arrays: dict[str, np.ndarray]) -> Points:
    """The points of arrays by name."""
    arrays = {name: _vector(array) for name, array in arrays.items()}
    found = {name: (column(name), array) for name, array in arrays.items()}
    fluxes = {name: (of, array) for name, (of, array) in found.items() if array.ndim in (2, 3)
              and not (of is not None and of.role == "other")}
    vectors = {name: (of, array) for name, (of, array) in found.items() if array.ndim == 1 and len(array) > 3}
    order = {"flux": 0, "inductance": 1}
    for flux, array in sorted(fluxes.values(), key=lambda item: order.get(item[0].role if item[0] else "", 2)):
        if (flux is None or flux.role in order) and (axes := _axes(array.shape, vectors)) is not None:
            return _matrix_points(array, flux, axes)
        if array.ndim == 2 and array.shape[1] in (3, 4) and (flux is None or len(arrays) == 1):
            return _rows(array)
    points = _columns(found)
    if points is not None:
        return points
    unnamed = [array for of, array in fluxes.values() if of is None or of.role == "flux"]
    sides = [array for of, array in vectors.values() if of is None or of.role in ("angle", "current")]
    if len(unnamed) == 1 and len(sides) == 2 and unnamed[0].ndim == 2:
        by_size = {len(side): side for side in sides}
        rows, columns = (by_size.get(size) for size in unnamed[0].shape)
        if rows is not None and columns is not None and len(by_size) == 2:
            return _rows(np.block([[np.zeros((1, 1)), columns[None]], [rows[:, None], unnamed[0]]]))
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


def _vector(array: np.ndarray) -> np.ndarray:
    """A mesh grid, which repeats one row or column, as that; another array as it is."""
    if array.ndim != 2 or 1 in array.shape:
        return array
    row: np.ndarray = array[0]
    column_of: np.ndarray = array[:, 0]
    if np.all(array == row):
        return row
    return column_of if np.all(array == column_of[:, None]) else array


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
