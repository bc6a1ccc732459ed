"""The fit of the identification by itself, on samples of a known map (of the drive: tests/hil/test_identify.py)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from salient.identify import fit as electrical
from salient.identify.basis import FluxBasis


def test_the_banded_solution_is_the_dense_one():
    """The map's functions and their roughness as a band, three further unknowns as its border."""
    basis = FluxBasis(6, 50.0, 12, 5)
    of = np.random.default_rng(1)
    design = sparse.hstack([basis.design(of.uniform(0.0, np.pi / 6.0, 900), of.uniform(0.0, 50.0, 900)),
                            sparse.csr_matrix(of.normal(size=(900, 3)))]).tocsr()
    by_angle, by_current = (electrical._widened(form, design.shape[1]) for form in basis.roughness())
    normal = (design.T @ design + by_angle + by_current + sparse.eye(design.shape[1])).tocsr()
    right = of.normal(size=design.shape[1])
    dense = np.linalg.solve(normal.toarray(), right)
    assert np.abs(dense).max() > 1e-3
    assert electrical._solved(normal, right, basis) == pytest.approx(dense, rel=1e-9, abs=1e-12)
