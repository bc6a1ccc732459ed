"""Flux linkage of a phase as psi = i s(theta, i) with a spline s that is even about aligned and unaligned angle:
cubic B-splines in both directions. psi is 0 at no current, and periodic, by construction."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline

_DEGREE = 3


class FluxBasis:
    """Functions of angle (rad from aligned) and current (A, 0 to current_max_A; beyond, as at the end).

    Coefficients of a map: an array of `size`, the current's functions within an angle's.
    """

    def __init__(self, rotor_poles: int, current_max_A: float, angles: int, currents: int) -> None:
        self.rotor_poles, self.current_max_A, self.angles = rotor_poles, current_max_A, angles
        inner = np.linspace(0.0, current_max_A, currents + 1)
        self._knots = np.concatenate([[0.0] * _DEGREE, inner, [current_max_A] * _DEGREE])
        self.columns = len(self._knots) - _DEGREE - 1
        self.rows = angles + 1
        self.size = self.rows * self.columns

    def _angle(self, angle_rad: np.ndarray, derivative: int) -> tuple[np.ndarray, np.ndarray]:
        """Indices and values of the four functions that are not 0: (points, 4) each."""
        step = math.pi / self.rotor_poles / self.angles
        x = angle_rad / step
        cell = np.floor(x).astype(int)
        t = x - cell
        if derivative == 0:
            values = [(1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6]
        else:
            values = [-((1 - t) ** 2) / 2 / step, (9 * t**2 - 12 * t) / 6 / step, (-9 * t**2 + 6 * t + 3) / 6 / step,
                      t**2 / 2 / step]
        index = (cell[:, None] - 1 + np.arange(4)) % (2 * self.angles)
        return np.where(index > self.angles, 2 * self.angles - index, index), np.stack(values, 1)

    @cached_property
    def _functions(self) -> list[tuple[BSpline, BSpline, BSpline, BSpline]]:
        each = [BSpline(self._knots, row, _DEGREE) for row in np.eye(self.columns)]
        return [(f, f.derivative(), f.antiderivative(), f.antiderivative(2)) for f in each]

    def _current(self, current_A: np.ndarray, derivative: int) -> np.ndarray:
        """i B(i), its derivative, or its integral from 0 on: (points, columns)."""
        if not len(current_A):  # a phase without a pulse; BSpline takes no empty array
            return np.zeros((0, self.columns))
        i = np.clip(current_A, 0.0, self.current_max_A * (1.0 - 1e-12))
        values = BSpline.design_matrix(i, self._knots, _DEGREE).toarray()
        if derivative == 0:
            return np.asarray(values * i[:, None])
        if derivative == 1:
            return np.asarray(values + np.stack([d(i) for _, d, _, _ in self._functions], 1) * i[:, None])
        return np.stack([i * g(i) - (h(i) - h(0.0)) for _, _, g, h in self._functions], 1)

    def design(self, angle_rad: np.ndarray, current_A: np.ndarray, by_angle: int = 0, by_current: int = 0
               ) -> sparse.csr_matrix:
        """Values of the functions, or a derivative, at points; by_current -1: integral over the current."""
        index, across = self._angle(np.asarray(angle_rad, float), by_angle)
        along = self._current(np.asarray(current_A, float), by_current)
        points, reach = along.shape
        columns = (index[:, :, None] * reach + np.arange(reach)).reshape(points, -1)
        values = (across[:, :, None] * along[:, None, :]).reshape(points, -1)
        kept = values != 0.0
        rows = np.repeat(np.arange(points), kept.sum(1))
        return sparse.csr_matrix((values[kept], (rows, columns[kept])), (points, self.size))

    def value(self, coefficients: np.ndarray, angle_rad: np.ndarray, current_A: np.ndarray, by_angle: int = 0,
              by_current: int = 0) -> np.ndarray:
        """A map, or a derivative of it, at points of any shape: with (1, -1) the torque of a phase in N m."""
        angle_rad, current_A = np.broadcast_arrays(angle_rad, current_A)
        index, across = self._angle(np.ravel(angle_rad).astype(float), by_angle)
        along = self._current(np.ravel(current_A).astype(float), by_current)
        of = coefficients.reshape(self.rows, self.columns)
        result = sum(across[:, k] * np.einsum("pc,pc->p", along, of[index[:, k]]) for k in range(4))
        return np.asarray(result).reshape(angle_rad.shape)

    @cached_property
    def _across(self) -> np.ndarray:
        """Third differences over the angle, with its symmetry, of coefficients of the angles."""
        order = 3
        mirrored = np.zeros((self.rows + 2 * order, self.rows))
        for row in range(self.rows + 2 * order):
            at = abs(row - order)
            mirrored[row, 2 * self.angles - at if at > self.angles else at] = 1.0
        return np.asarray(np.diff(mirrored, order, axis=0))

    def bends(self, coefficients: np.ndarray) -> np.ndarray:
        """Squares of the third differences over the angle, by angle and current, where `roughness` has weights."""
        return np.asarray((self._across @ coefficients.reshape(self.rows, self.columns)) ** 2)

    @cached_property
    def _bends_of_map(self) -> sparse.csr_matrix:
        """Third differences over the angle of all coefficients, by angle and current."""
        return sparse.kron(self._across, sparse.eye(self.columns)).tocsr()

    @cached_property
    def _along(self) -> sparse.csr_matrix:
        """Quadratic form of the third differences over the current."""
        along = np.diff(np.eye(self.columns), 3, axis=0)
        return sparse.kron(sparse.eye(self.rows), along.T @ along).tocsr()

    def roughness(self, weights: np.ndarray | None = None) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """Quadratic forms of the third differences over the angle, each with a weight, and over the current."""
        across = self._bends_of_map
        weighted = across if weights is None else across.multiply(np.ravel(weights)[:, None])
        return (across.T @ weighted).tocsr(), self._along
