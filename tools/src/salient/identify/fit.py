"""The electrical part of the machine from the pulses, as one least-squares problem:

    integral of s Vdc dt = psi(theta - delta, i - G u) + R integral of i dt + 2 V t,   u = s Vdc - R i - 2 V

s is +1 with both switches on, 0 freewheeling, -1 with both off. psi is linear in the coefficients of its spline, and
so are R and the mean drop V of a device. Columns of the derivatives (Gauss-Newton) add what is not: the angle of each
phase, the delay of the current sensors, their offsets, the eccentricity of the encoder, and the conductance G of the
iron, in which the voltage u makes eddy currents (emulator/plant/coupled.h).

Not observable, because the pulses would be the same: a common gain of all currents, one of the DC-link voltage, and
the difference of the drops of a switch and a diode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, ndimage, sparse
from scipy.optimize import nnls

from salient.identify.basis import FluxBasis
from salient.identify.link import OFF, ON, PART, ZERO, IdentifyError
from salient.identify.sequence import Findings, Pulse
from salient.machine.flux_map import ANGLE_INTERVALS

ANGLES, CURRENTS = ANGLE_INTERVALS, 24
"""Steps of the spline over half a rotor pitch, as many as the loader's, and over the current."""
_ITERATIONS, _SMOOTHED = 5, 3
"""Iterations, and the one in which the smoothness is found: angles, delay and offsets are known then, whose errors
would ask for a smoother map."""
_ANGLE_WEIGHTS = (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4)
_CURRENT_WEIGHTS = (1e-4, 1e-3, 1e-2, 0.1, 1.0)
"""Weights of the roughness, relative to the mean weight of a coefficient: those are taken with which the other pulses
predict a pulse best, for a smoother map averages more noise and follows a corner less."""
_FLAT_PART = 0.01
"""Part of the mean square bend that is added to each: places with less bend have nearly the same stiffness."""
_ALIKE = 3
"""Part of the currents over which a bend counts as one, for saturation rounds corners: of all in the first round, whose
map has the most noise."""
_SHARPENED, _LOWER, _HIGHER = 3, 1, 2
"""Rounds in which the stiffness follows the bends of the map before; in these the weights of the round before are
tried, and so many of the list that are less and that are more."""
_FOLDS, _ROUGHER = 4, 0.1
_EXACT_PART = 0.1
"""Least part of the residual that is not of the current's noise."""
_DROP_V, _ECCENTRICITY_RAD, _DELAY_S, _OFFSET_PART, _EDDY_PART = 2.0, 0.005, 20e-6, 0.01, 0.02
"""Deviations of weak priors, for what a machine may not show."""
_BEGIN_PART = 0.003
_MOST = 0.25
"""Part of the pulses that may end at less than the largest common current."""
_INITIAL_PART, _LEAST_PART = 0.1, 0.1
"""The least incremental inductance is that part of the one of the unaligned phase, which is read at that part of the
largest current."""
_SIGN_WEIGHT, _SIGN_ROUNDS = 10.0, 8
"""Weight of a sign, relative to the samples; rounds in which more of them may appear."""
_SIGN = {OFF: -1.0, ZERO: 0.0, ON: 1.0}


@dataclass(frozen=True)
class Rows:
    """Samples of pulses. angle_rad: from the rough aligned angle; shaft_rad: of the encoder; flux_Wb: integral of the
    voltage; charge_As: of the current; time_s: since the start of the pulse; slope_A_s, supply_V: of the current and of
    the terminals before the sample; pulse: number."""

    pulse: np.ndarray
    row: np.ndarray
    angle_rad: np.ndarray
    shaft_rad: np.ndarray
    current_A: np.ndarray
    flux_Wb: np.ndarray
    charge_As: np.ndarray
    time_s: np.ndarray
    slope_A_s: np.ndarray
    supply_V: np.ndarray


def rows_of(found: Findings, pulses: Sequence[Pulse]) -> Rows:
    """The samples with current of pulses. IdentifyError: a phase has too few pulses."""
    parts: list[list[np.ndarray]] = []
    for number, pulse in enumerate(pulses):
        part = _rows(found, pulse)
        if part is not None:
            parts.append([np.full(len(part[0]), number), np.full(len(part[0]), found.phases.index(pulse.phase)), *part])
    pulses_of = [sum(part[1][0] == row for part in parts) for row in range(len(found.phases))]
    for phase, count in zip(found.phases, pulses_of, strict=True):
        if count < _FOLDS:  # each phase in each fold, on the mean
            raise IdentifyError(f"phase {'abcdef'[phase]}: {count} pulses with a current; its angle needs {_FOLDS}")
    return Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def common_current_A(pulses: Sequence[Pulse]) -> float:
    """Largest current of most pulses. IdentifyError: none is one of the map."""
    peaks_A = [pulse.log["current_A"].max() for pulse in pulses if pulse.mapped]
    if not peaks_A:
        raise IdentifyError("no pulse of the map")
    return float(np.quantile(peaks_A, _MOST))


def _rows(found: Findings, pulse: Pulse) -> list[np.ndarray] | None:
    log = pulse.log
    current = log["current_A"] - found.offset_A[pulse.phase]
    on = np.nonzero(log["action"] == ON)[0]
    if not len(on) or (log["action"] == PART).any():
        return None
    begin_A = 4.0 * found.noise_A[pulse.phase] + _BEGIN_PART * current.max()
    if on[0] == 0 or (current[:on[0] + 1] > begin_A).any():  # it began with the flux of another one
        return None
    floor_A = 4.0 * found.noise_A[pulse.phase] + 0.01 * current.max()
    first = on[0]
    dead = np.nonzero(current[first + 1:] <= floor_A)[0]
    late = dead[dead + first + 1 > np.argmax(current)]
    last = first + (int(late[0]) if len(late) else len(current) - 1 - first)
    if last <= first + 1:
        return None
    step_s = np.diff(log["time_us"][first:last + 1]) * 1e-6
    sign = np.array([float(_SIGN[action]) for action in log["action"][first:last].tolist()])
    voltage = (log["dc_link_V"][first:last] + log["dc_link_V"][first + 1:last + 1]) / 2.0
    mean_A = (current[first:last] + current[first + 1:last + 1]) / 2.0
    flux, charge, time_s = np.cumsum(sign * voltage * step_s), np.cumsum(mean_A * step_s), np.cumsum(step_s)
    turn = log["turn"][first + 1:last + 1]
    live = current[first + 1:last + 1] > floor_A
    if not live.any():
        return None
    at = np.arange(first + 1, last + 1)
    slope = (current[at] - current[at - 1]) / step_s
    columns = [2.0 * math.pi * (turn - found.position[pulse.phase]), 2.0 * math.pi * turn, current[at], flux, charge,
               time_s, slope, sign * voltage]
    return [column[live] for column in columns]


@dataclass
class Fit:
    """A machine by its pulses. delta_rad: of the aligned angle from the rough one, by row of phases; drop_V: mean of a
    device; eccentricity_rad: cosine and sine of the encoder's error; offset_A: of currents beyond that at rest;
    conductance_S: of the iron; smoothness: weights of the roughness over angle and current; stiffness: of its bends
    over the angle, by angle and current, or None of an equal one."""

    basis: FluxBasis
    coefficients: np.ndarray
    resistance_ohm: float
    drop_V: float
    delta_rad: np.ndarray
    eccentricity_rad: np.ndarray
    delay_s: float
    offset_A: np.ndarray
    conductance_S: float
    residual_Wb: np.ndarray
    smoothness: tuple[float, float] = (1e-3, 1e-3)
    stiffness: np.ndarray | None = None

    def flux_Wb(self, angle_rad: np.ndarray, current_A: np.ndarray) -> np.ndarray:
        """Flux linkage at an angle from aligned."""
        return self.basis.value(self.coefficients, angle_rad, current_A)

    def torque_Nm(self, angle_rad: np.ndarray, current_A: np.ndarray) -> np.ndarray:
        """Derivative of the co-energy by the angle."""
        return self.basis.value(self.coefficients, angle_rad, current_A, 1, -1)

    def iron_A(self, current_A: np.ndarray, supply_V: np.ndarray) -> np.ndarray:
        """Current of a winding less the eddy currents that the voltage of its terminals makes."""
        induced_V = supply_V - self.resistance_ohm * current_A - 2.0 * self.drop_V
        return np.asarray(current_A - self.conductance_S * induced_V)

    def shaft_rad(self, encoder_rad: np.ndarray) -> np.ndarray:
        """Angle of the shaft by the encoder's."""
        cosine, sine = self.eccentricity_rad
        return np.asarray(encoder_rad - cosine * np.cos(encoder_rad) - sine * np.sin(encoder_rad))


def solve(rows: Rows, phases: int, rotor_poles: int, current_max_A: float, angles: int = ANGLES,
          currents: int = CURRENTS) -> Fit:
    """The machine that explains the rows best."""
    basis = FluxBasis(rotor_poles, current_max_A, angles, currents)
    fit = Fit(basis, np.zeros(basis.size), 0.0, 0.0, np.zeros(phases), np.zeros(2), 0.0, np.zeros(phases),
              0.0, np.zeros(0))
    for iteration in range(_ITERATIONS):
        problem = _problem(rows, phases, fit, linear=iteration == 0)
        if iteration == _SMOOTHED:
            problem = _smoothed(problem, rows, phases)
        fit = _solution(problem, rows, phases)
    return fit


def _smoothed(problem: _Problem, rows: Rows, phases: int) -> _Problem:
    """The problem with the smoothness that predicts best. The stiffness begins as an equal one, whose map is round at
    the corners and has noise between them. It follows the bends of that map, and of the next ones as long as pulses are
    predicted better."""
    folds = _folds(problem, rows)
    error, smoothness = _smoothness(problem, folds, _ANGLE_WEIGHTS, _CURRENT_WEIGHTS)
    problem = replace(problem, fit=replace(problem.fit, smoothness=smoothness))
    basis = problem.fit.basis
    for number in range(_SHARPENED):
        alike = _ALIKE if number else 1
        # The pulses of a fold have no part in the stiffness by which they are predicted: noise has bends, too.
        others = [replace(fold, stiffness=_stiffness(basis, alike, _without(problem, folds, fold, smoothness)))
                  for fold in folds]
        less, smoother = _smoothness(problem, others, _near(_ANGLE_WEIGHTS, smoothness[0]),
                                     _near(_CURRENT_WEIGHTS, smoothness[1]))
        if number and less >= error:
            break
        stiffness = _stiffness(basis, alike, _solution(problem, rows, phases).coefficients)
        problem = replace(problem, fit=replace(problem.fit, smoothness=smoother, stiffness=stiffness))
        error, folds, smoothness = less, others, smoother
    return problem


def _near(weights: Sequence[float], weight: float) -> Sequence[float]:
    """Weights of a list about one of it."""
    at = weights.index(weight)
    return weights[max(at - _LOWER, 0):at + _HIGHER + 1]


def _stiffness(basis: FluxBasis, alike: int, unknowns: np.ndarray) -> np.ndarray:
    """Weights of the bends over the angle, with a mean of 1, by the bends of a map, the first of the unknowns, in
    1 / alike of the currents: where poles begin to overlap the torque has corners, which one smoothness of all places
    either rounds or pays for with noise at the others. Currents that no pulse reaches stay stiff, for the bends there
    are only continued."""
    squares = basis.bends(unknowns[:basis.size])
    bends = (ndimage.uniform_filter1d(squares, max(1, squares.shape[1] // alike), axis=1, mode="nearest") if alike > 1
             else np.repeat(squares.mean(axis=1, keepdims=True), squares.shape[1], axis=1))
    stiffness = 1.0 / (bends + _FLAT_PART * np.mean(bends))
    return np.asarray(stiffness / np.mean(stiffness))


@dataclass(frozen=True)
class _Fold:
    """Pulses that are left out: rows and normal equations of their own, stiffness of the map by the others."""

    design: sparse.csr_matrix
    weights: np.ndarray
    flux_Wb: np.ndarray
    normal: sparse.csr_matrix
    right: np.ndarray
    stiffness: np.ndarray | None


def _folds(problem: _Problem, rows: Rows) -> list[_Fold]:
    folds = []
    for number in range(_FOLDS):
        kept = rows.pulse % _FOLDS == number
        design, weights, flux = problem.design[kept], problem.weights[kept], rows.flux_Wb[kept]
        weighted = design.multiply(weights[:, None]).tocsr()
        folds.append(_Fold(design, weights, flux, (weighted.T @ design).tocsr(), weighted.T @ flux,
                           problem.fit.stiffness))
    return folds


def _without(problem: _Problem, folds: Sequence[_Fold], left_out: _Fold, smoothness: tuple[float, float]) -> np.ndarray:
    """The solution of the pulses of the other folds, but for the signs. LinAlgError: they do not determine it."""
    normal = sum(fold.normal for fold in folds if fold is not left_out) + sparse.diags(problem.ridge)
    right = sum(fold.right for fold in folds if fold is not left_out) + problem.pull
    return _solved(normal + _forms(problem, smoothness, left_out.stiffness), right, problem.fit.basis)


def _smoothness(problem: _Problem, folds: Sequence[_Fold], by_angles: Sequence[float], by_currents: Sequence[float]
                ) -> tuple[float, tuple[float, float]]:
    """Least error and weights of the roughness by prediction of each pulse from the pulses of other folds, of the
    linear problem. IdentifyError: with no weights do these determine the machine."""
    def error(smoothness: tuple[float, float]) -> float:
        try:
            left = [fold.flux_Wb - fold.design @ _without(problem, folds, fold, smoothness) for fold in folds]
        except linalg.LinAlgError:
            return math.inf
        return sum(float(fold.weights @ of**2) for fold, of in zip(folds, left, strict=True))

    def best(candidates: Sequence[tuple[float, float]]) -> tuple[float, tuple[float, float]]:
        least, found = min((error(each), each) for each in candidates)
        if math.isinf(least):
            raise IdentifyError(f"{_FOLDS - 1} of {_FOLDS} pulses do not determine the machine: they are too few")
        return least, found

    _, by_current = problem.fit.smoothness
    _, (by_angle, _) = best([(weight, by_current) for weight in by_angles])
    return best([(by_angle, weight) for weight in by_currents])


def _corrected(rows: Rows, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Angles from aligned and currents of the rows with what is known of the sensors."""
    cosine, sine = fit.eccentricity_rad
    angle = (rows.angle_rad - fit.delta_rad[rows.row] - cosine * np.cos(rows.shaft_rad) - sine * np.sin(rows.shaft_rad))
    current = fit.iron_A(rows.current_A, rows.supply_V) + fit.offset_A[rows.row] + fit.delay_s * rows.slope_A_s
    return angle, np.maximum(current, 0.0)


@dataclass(frozen=True)
class _Problem:
    """A least-squares problem about a fit. weights: of the rows, 1 on the mean; scale: mean weight of a coefficient;
    ridge, pull: of the priors of the further columns, diagonal and right-hand side."""

    fit: Fit
    design: sparse.csr_matrix
    weights: np.ndarray
    scale: float
    ridge: np.ndarray
    pull: np.ndarray
    linear: bool
    signs: sparse.csr_matrix
    least: np.ndarray


def _signs(basis: FluxBasis) -> sparse.csr_matrix:
    """Quantities that no machine has negative, on a grid of both directions: the incremental inductance, scaled by the
    largest current, and the fall of the flux linkage from aligned to unaligned, by the pitch."""
    angle, current = np.meshgrid(np.linspace(0.0, math.pi / basis.rotor_poles, basis.angles + 1),
                                 np.linspace(0.0, basis.current_max_A, basis.columns), indexing="ij")
    rises = basis.design(angle.ravel(), current.ravel(), 0, 1) * basis.current_max_A
    falls = basis.design(angle[1:-1, 1:].ravel(), current[1:-1, 1:].ravel(), 1, 0) * (-math.pi / basis.rotor_poles)
    return sparse.vstack([rises, falls]).tocsr()


def _forms(problem: _Problem, smoothness: tuple[float, float], stiffness: np.ndarray | None) -> sparse.csr_matrix:
    """Quadratic form of the roughness of a map, in all unknowns."""
    by_angle, by_current = problem.fit.basis.roughness(stiffness)
    of_map = problem.scale * (smoothness[0] * by_angle + smoothness[1] * by_current
                              + 1e-12 * sparse.eye(problem.fit.basis.size))
    return _widened(of_map, problem.design.shape[1])


def _widened(of_map: sparse.spmatrix, size: int) -> sparse.csr_matrix:
    """A quadratic form of the map, in all unknowns."""
    wide = of_map.tocsr(copy=True)
    wide.resize((size, size))
    return wide


def _solved(normal: sparse.spmatrix, right: np.ndarray, basis: FluxBasis) -> np.ndarray:
    """The solution of the normal equations: of the map, whose functions reach over four angles, as a band, and of the
    few other unknowns by what the map leaves of them. LinAlgError: they do not determine it."""
    n, reach = basis.size, 4 * basis.columns
    map_part = sparse.triu(normal[:n, :n]).tocoo()
    assert int((map_part.col - map_part.row).max()) < reach
    band = np.zeros((reach, n))
    np.add.at(band, (reach - 1 + map_part.row - map_part.col, map_part.col), map_part.data)
    border, corner = normal[:n, n:].toarray(), normal[n:, n:].toarray()
    factor = linalg.cholesky_banded(band, overwrite_ab=True, check_finite=False)
    of_border = linalg.cho_solve_banded((factor, False), np.column_stack([border, right[:n]]), check_finite=False)
    others = linalg.solve(corner - border.T @ of_border[:, :-1], right[n:] - border.T @ of_border[:, -1],
                          assume_a="pos", check_finite=False)
    return np.concatenate([of_border[:, -1] - of_border[:, :-1] @ others, others])


def _weights(rows: Rows, fit: Fit, by_current: np.ndarray) -> np.ndarray:
    """Weights of the rows by their variance: of the current's noise times the incremental inductance, and a constant
    one; both by the residuals."""
    square, of_current = fit.residual_Wb**2, by_current**2
    of_current /= of_current.mean()
    parts = nnls(np.column_stack([np.ones(len(square)), of_current]), square)[0]
    variance = max(parts[0], _EXACT_PART * float(square.mean()), 1e-300) + parts[1] * of_current
    return np.asarray(1.0 / variance / np.mean(1.0 / variance))


def _problem(rows: Rows, phases: int, fit: Fit, linear: bool) -> _Problem:
    """About the present angles, delay and offsets unless `linear`."""
    basis, n = fit.basis, fit.basis.size
    angle, current = _corrected(rows, fit)
    columns = [rows.charge_As, 2.0 * rows.time_s]
    deviations, known = [math.inf, _DROP_V], [0.0, 0.0]
    weights = np.ones(len(rows.row))
    if not linear:
        by_angle = basis.value(fit.coefficients, angle, current, 1, 0)
        by_current = basis.value(fit.coefficients, angle, current, 0, 1)
        weights = _weights(rows, fit, by_current)
        of_phase = [(rows.row == row).astype(float) for row in range(phases)]
        columns += [-by_angle * each for each in of_phase]
        columns += [-by_angle * np.cos(rows.shaft_rad), -by_angle * np.sin(rows.shaft_rad), by_current * rows.slope_A_s]
        columns += [by_current * each for each in of_phase]
        columns += [by_current * (fit.resistance_ohm * rows.current_A + 2.0 * fit.drop_V - rows.supply_V)]
        deviations += [math.inf] * phases + [_ECCENTRICITY_RAD] * 2 + [_DELAY_S]
        deviations += [_OFFSET_PART * basis.current_max_A] * phases
        deviations += [_EDDY_PART * basis.current_max_A / float(np.abs(rows.supply_V).max())]
        known += [0.0] * phases + [*-fit.eccentricity_rad, -fit.delay_s, *-fit.offset_A, -fit.conductance_S]
    design = sparse.hstack([basis.design(angle, current), sparse.csr_matrix(np.array(columns).T)]).tocsr()
    scale = float(weights @ design[:, :n].multiply(design[:, :n]).sum(axis=1).A1) / n
    noise = float(np.mean(weights * fit.residual_Wb**2)) if not linear else \
        (2e-4 * float(np.abs(rows.flux_Wb).max())) ** 2
    square = design[:, n:].multiply(design[:, n:]).sum(axis=0).A1
    ridge, pull = np.zeros(design.shape[1]), np.zeros(design.shape[1])
    ridge[n:] = np.where(np.isinf(deviations), 1e-12 * square, noise / np.square(deviations))
    pull[n:] = np.where(np.isinf(deviations), 0.0, known * ridge[n:])
    signs = _signs(basis)
    least = np.zeros(signs.shape[0])
    if not linear:
        unaligned = float(basis.value(fit.coefficients, np.array(math.pi / basis.rotor_poles),
                                      np.array(_INITIAL_PART * basis.current_max_A))) / _INITIAL_PART
        least[:basis.rows * basis.columns] = _LEAST_PART * max(unaligned, 0.0)
    return _Problem(fit, design, weights, scale, ridge, pull, linear, signs, least)


def _solution(problem: _Problem, rows: Rows, phases: int, drawn: np.ndarray | None = None) -> Fit:
    """The fit of a problem, with a number of each row. IdentifyError: the pulses do not determine the machine."""
    fit, design = problem.fit, problem.design
    n = fit.basis.size
    weights = problem.weights if drawn is None else problem.weights * drawn
    weighted = design.multiply(weights[:, None]).tocsr()
    normal = weighted.T @ design + sparse.diags(problem.ridge) + _forms(problem, fit.smoothness, fit.stiffness)
    x = _constrained(problem, normal.tocsr(), weighted.T @ rows.flux_Wb + problem.pull, n)
    more = np.zeros(2 * phases + 4) if problem.linear else x[n + 2:]
    return Fit(fit.basis, x[:n], float(x[n]), float(x[n + 1]), fit.delta_rad + more[:phases],
               fit.eccentricity_rad + more[phases:phases + 2], fit.delay_s + float(more[phases + 2]),
               fit.offset_A + more[phases + 3:-1], fit.conductance_S + float(more[-1]), rows.flux_Wb - design @ x,
               fit.smoothness, fit.stiffness)


def _constrained(problem: _Problem, normal: sparse.csr_matrix, right: np.ndarray, n: int) -> np.ndarray:
    """The solution with the signs of a machine: others are drawn to their least value, with the
    rest of the map. IdentifyError: there is none."""
    signs, least = problem.signs, problem.least
    weight = _SIGN_WEIGHT * float(normal.diagonal()[:n].sum()) / float(signs.multiply(signs).sum())
    active = np.zeros(signs.shape[0], bool)
    for _ in range(_SIGN_ROUNDS):
        held = signs[active]
        of = normal + _widened(weight * (held.T @ held), normal.shape[0])
        more = right.copy()
        more[:n] += weight * (held.T @ least[active])
        try:
            x = _solved(of, more, problem.fit.basis)
        except linalg.LinAlgError:
            raise IdentifyError("the pulses do not determine the machine") from None
        violated = (signs @ x[:n] < least) & ~active
        if problem.linear or not violated.any():
            return np.asarray(x)
        active |= violated
    return np.asarray(x)


def rougher(rows: Rows, phases: int, fit: Fit) -> Fit:
    """The fit with a tenth of its smoothness: by how much it is another one shows what the smoothness hides."""
    rough = replace(fit, smoothness=(_ROUGHER * fit.smoothness[0], _ROUGHER * fit.smoothness[1]))
    return _solution(_problem(rows, phases, rough, linear=False), rows, phases)


def resampled(rows: Rows, phases: int, fit: Fit, samples: int, seed: int = 1) -> list[Fit]:
    """The fit of pulses drawn with repetition, once in each sample: it scatters as the result does, whatever
    correlates the rows of a pulse."""
    problem = _problem(rows, phases, fit, linear=False)
    random = np.random.default_rng(seed)
    pulses = int(rows.pulse.max()) + 1
    return [_solution(problem, rows, phases, random.multinomial(pulses, np.full(pulses, 1.0 / pulses))[rows.pulse]
                      .astype(float)) for _ in range(samples)]
