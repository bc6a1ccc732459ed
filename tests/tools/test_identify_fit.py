"""The fit of the identification by itself, on samples of a known map (of the drive: tests/hil/test_identify.py)."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from salient.experiments.identified_intervals import LIMIT_A, Motor, grid_of, pulses_of
from salient.identify import fit as electrical
from salient.identify.basis import FluxBasis


@pytest.mark.parametrize("decades", [0.0, 3.0])
def test_the_banded_solution_is_the_dense_one(decades):
    """The map's functions and their roughness, of bends with weights over decades, as a band, three further unknowns as
    its border."""
    basis = FluxBasis(6, 50.0, 12, 5)
    of = np.random.default_rng(1)
    stiffness = 10.0 ** of.uniform(-decades, decades, basis.bends(np.zeros(basis.size)).shape)
    design = sparse.hstack([basis.design(of.uniform(0.0, np.pi / 6.0, 900), of.uniform(0.0, 50.0, 900)),
                            sparse.csr_matrix(of.normal(size=(900, 3)))]).tocsr()
    by_angle, by_current = (electrical._widened(form, design.shape[1]) for form in basis.roughness(stiffness))
    normal = (design.T @ design + by_angle + by_current + sparse.eye(design.shape[1])).tocsr()
    right = of.normal(size=design.shape[1])
    dense = np.linalg.solve(normal.toarray(), right)
    assert np.abs(dense).max() > 1e-3
    assert electrical._solved(normal, right, basis) == pytest.approx(dense, rel=1e-9, abs=1e-12)


# --- smoothness and stiffness ----------------------------------------------------------------------------------------

ANGLES, CURRENTS = 24, 8
_CORNER_ROWS = [range(4, 7), range(18, 22)]
"""Third differences over the trapezoid's ends, at 0.15 and 0.75 of the angles; a difference is 1.5 steps further."""
_STRAIGHT = range(9, 16)
"""Between both, where the torque over the angle is flat."""


@lru_cache
def fitted(corners: bool, noise_lsb: float) -> tuple[electrical.Rows, electrical.Fit]:
    """Half as many pulses as a drive's, of a motor in closed form, on a coarse map: 0.6 s."""
    motor = Motor(corners=corners)
    found, pulses = pulses_of(motor, 1, count=108, noise_lsb=noise_lsb)
    rows = electrical.rows_of(found, pulses)
    return rows, electrical.solve(rows, 3, motor.rotor_poles, LIMIT_A, ANGLES, CURRENTS)


@pytest.mark.parametrize("alike", [1, 3])
def test_a_weight_of_the_bends_is_the_inverse_of_the_bend_with_a_mean_of_one(alike):
    bends = np.tile(np.array([4.0, 0.0, 1.0, 0.0])[:, None], (1, 6))
    basis = SimpleNamespace(bends=lambda _: bends, size=24)
    stiffness = electrical._stiffness(basis, alike, np.zeros(24))
    assert stiffness.mean() == pytest.approx(1.0)
    product = stiffness * (bends + 0.01 * bends.mean())
    assert product == pytest.approx(product[0, 0])
    bends = np.full((4, 6), 3e-9)
    assert electrical._stiffness(basis, alike, np.zeros(24)) == pytest.approx(1.0)


def test_a_map_is_soft_at_a_bend_for_a_third_of_the_currents_and_in_the_first_round_for_all():
    bends = np.zeros((4, 15))
    bends[2, 9] = 1.0
    basis = SimpleNamespace(bends=lambda _: bends, size=60)
    soft, of_all = (each < 0.5 * each.max() for each in (electrical._stiffness(basis, alike, np.zeros(60))
                                                         for alike in (3, 1)))
    assert np.argwhere(soft).tolist() == [[2, column] for column in range(7, 12)]
    assert np.argwhere(of_all).tolist() == [[2, column] for column in range(15)]


def test_weighted_roughness_is_the_weighted_sum_of_the_bends():
    basis, of = FluxBasis(6, 50.0, 12, 5), np.random.default_rng(2)
    coefficients = of.normal(size=basis.size)
    bends = basis.bends(coefficients)
    weights = 10.0 ** of.uniform(-3.0, 3.0, bends.shape)
    by_angle, _ = basis.roughness(weights)
    assert coefficients @ by_angle @ coefficients == pytest.approx((weights * bends).sum())
    assert coefficients @ basis.roughness()[0] @ coefficients == pytest.approx(bends.sum())


def test_a_map_is_soft_at_corners_of_the_torque_and_stiff_between():
    stiffness = fitted(True, 2.0)[1].stiffness
    assert stiffness is not None and stiffness.mean() == pytest.approx(1.0)
    for rows in _CORNER_ROWS:
        assert stiffness[rows].min() < 0.05 * stiffness[_STRAIGHT].min()
    assert any(int(stiffness.argmin()) // stiffness.shape[1] in rows for rows in _CORNER_ROWS)


def test_a_smooth_map_has_no_place_softer_than_its_neighbours():
    stiffness = fitted(False, 0.25)[1].stiffness
    inner = stiffness[range(5, 23)].mean(axis=1)
    assert int(inner.argmin()) + 5 in range(10, 18)  # the largest third derivative of a cosine
    neighbours = inner[1:] / inner[:-1]
    assert neighbours.max() < 2.0 and neighbours.min() > 0.5


def test_more_noise_asks_for_a_smoother_map_and_corners_for_a_rougher_one():
    """The weight is inside of the range that is tried, and is one of it."""
    weights = {key: fitted(*key)[1].smoothness for key in ((False, 0.25), (False, 8.0), (True, 2.0))}
    for by_angle, by_current in weights.values():
        assert by_angle in electrical._ANGLE_WEIGHTS[1:-1] and by_current in electrical._CURRENT_WEIGHTS[:-1]
    assert weights[False, 8.0][0] > weights[False, 0.25][0] > weights[True, 2.0][0]


def test_the_smoothness_is_the_one_that_predicts_left_out_pulses_best():
    """Against dense solutions of the pulses of the other folds."""
    rows, fit = fitted(True, 2.0)
    rows = electrical.Rows(*(np.array(getattr(rows, each.name)[::3]) for each in fields(rows)))
    small = electrical.solve(rows, 3, fit.basis.rotor_poles, LIMIT_A, 8, 4)
    problem = electrical._problem(rows, 3, small, linear=False)
    design = problem.design.toarray()

    def error(smoothness):
        forms = electrical._forms(problem, smoothness, small.stiffness).toarray() + np.diag(problem.ridge)
        total = 0.0
        for fold in range(4):
            out = rows.pulse % 4 == fold
            weighted = design[~out] * problem.weights[~out, None]
            x = np.linalg.solve(weighted.T @ design[~out] + forms, weighted.T @ rows.flux_Wb[~out] + problem.pull)
            total += problem.weights[out] @ (rows.flux_Wb[out] - design[out] @ x) ** 2
        return total

    by_angle = min(electrical._ANGLE_WEIGHTS, key=lambda weight: error((weight, small.smoothness[1])))
    by_current = min(electrical._CURRENT_WEIGHTS, key=lambda weight: error((by_angle, weight)))
    least, found = electrical._smoothness(problem, electrical._folds(problem, rows), electrical._ANGLE_WEIGHTS,
                                          electrical._CURRENT_WEIGHTS)
    assert found == (by_angle, by_current)
    assert least == pytest.approx(error(found))


def test_the_stiffness_makes_the_torque_of_corners_better_than_an_equal_one():
    """Where the torque is flat: an even smoothness follows the corners with noise there."""
    rows, fit = fitted(True, 2.0)
    problem = electrical._problem(rows, 3, replace(fit, stiffness=None), linear=False)
    _, smoothness = electrical._smoothness(problem, electrical._folds(problem, rows), electrical._ANGLE_WEIGHTS,
                                           electrical._CURRENT_WEIGHTS)
    even = electrical._solution(replace(problem, fit=replace(problem.fit, smoothness=smoothness)), rows, 3)
    motor = Motor(corners=True)
    angle, current = grid_of(motor)
    folded = angle * motor.rotor_poles / np.pi
    flat = (folded > 0.3) & (folded < 0.6)
    of_stiff, of_even = (float(np.sqrt(np.mean((each.torque_Nm(angle, current) - motor.torque_Nm(angle, current))[flat]
                                               ** 2))) for each in (fit, even))
    print(f"torque: {of_stiff:.3g} N m, with an equal stiffness {of_even:.3g} N m")
    assert of_stiff < 0.8 * of_even


def test_resampled_and_rougher_fits_have_the_stiffness_of_the_fit():
    rows, fit = fitted(True, 2.0)
    (other,), rough = electrical.resampled(rows, 3, fit, 1), electrical.rougher(rows, 3, fit)
    assert other.stiffness is rough.stiffness is fit.stiffness
    assert other.smoothness == fit.smoothness
    assert rough.smoothness == pytest.approx([0.1 * weight for weight in fit.smoothness])


def test_rounds_of_the_stiffness_end_when_left_out_pulses_are_predicted_worse(monkeypatch):
    """The first is taken in any case; pulses that are left out have no part in the stiffness of theirs."""
    rows, fit = fitted(True, 2.0)
    problem = electrical._problem(rows, 3, replace(fit, stiffness=None), linear=False)
    errors, of_folds = iter([1.0, 1.1, 1.05, 1.06]), []

    def smoothness(_, folds, by_angles, by_currents):
        of_folds.append([fold.stiffness for fold in folds])
        return next(errors), (by_angles[0], by_currents[0])

    monkeypatch.setattr(electrical, "_smoothness", smoothness)
    found = electrical._smoothed(problem, rows, 3)
    assert len(of_folds) == 4 and of_folds[0] == [None] * 4
    assert all(not np.array_equal(of_folds[1][0], other) for other in of_folds[1][1:])
    assert np.ptp(of_folds[1][0], axis=1).max() == pytest.approx(0.0, abs=1e-12)  # of all currents in the first round
    assert np.ptp(found.fit.stiffness, axis=1).max() > 0.1  # the second round, better than the first, is the last


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "least", "most"), [(1, 0.4, 0.7), (2, 0.9, 1.1)])
def test_further_rounds_make_the_torque_between_corners_better_than_one_or_leave_it(monkeypatch, seed, least, most):
    """Root mean squares where the torque is flat; two draws of the noise, a map of 48 angles."""
    motor = Motor(corners=True)
    found, pulses = pulses_of(motor, seed)
    rows = electrical.rows_of(found, pulses)
    angle, current = grid_of(motor)
    folded = angle * motor.rotor_poles / np.pi
    flat = (folded > 0.25) & (folded < 0.65)
    rms = {}
    for rounds in (1, 3):
        monkeypatch.setattr(electrical, "_SHARPENED", rounds)
        fit = electrical.solve(rows, 3, motor.rotor_poles, LIMIT_A, 48, 16)
        rms[rounds] = float(np.sqrt(np.mean((fit.torque_Nm(angle, current) - motor.torque_Nm(angle, current))[flat]
                                            ** 2)))
    print(f"torque: {rms[3]:.3g} N m, after one round {rms[1]:.3g} N m")
    assert least < rms[3] / rms[1] < most
