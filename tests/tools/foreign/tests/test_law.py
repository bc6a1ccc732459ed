"""Purpose of this repository's speed law."""

import pytest


@pytest.mark.bench_options(controller="traditional")
def test_start_at_the_torque_limit_leaves_no_windup(bench):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.3)
    assert 600 <= bench.truth["speed_rpm"].value.max() < 606
