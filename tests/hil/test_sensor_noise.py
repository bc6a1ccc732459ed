"""Noise of the current sensors: off by default, and determined by the seed alone."""

from __future__ import annotations

import numpy as np
import pytest


def currents_A(make_bench, seed: int, noise_A: float) -> np.ndarray:
    """Measured currents of idle phases over 0.1 s, followed by 150 r/min under load."""
    bench = make_bench(controller="traditional", seed=seed)
    bench.rig.current_noise_A = noise_A
    bench.run_for(0.1)
    measured = bench.telemetry["DRIVE_CURRENTS.current_a_A"].value
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.1)
    bench.load_torque_Nm = 8
    bench.run_for(0.1)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(150, abs=1.5)
    return measured


def test_noise_is_off_by_default(make_bench):
    assert not currents_A(make_bench, seed=1, noise_A=0.0).any()


def test_noise_depends_on_the_seed_alone(make_bench):
    first, again, other = (currents_A(make_bench, seed, noise_A=0.04) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    # The ADC is unipolar: of noise with a standard deviation of 2 LSB around 0 A only the upper half appears.
    for measured in (first, other):
        assert 0.008 < measured.mean() < 0.024
        assert 0.04 < measured.max() < 0.2
