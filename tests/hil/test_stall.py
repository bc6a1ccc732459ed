"""Stalled rotor. [SR-24]"""

from __future__ import annotations

import math

import pytest


@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
def test_locked_shaft_is_a_fault_after_100_ms(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.held_speed_rpm = 0
    bench.run_for(0.01)
    bench.drive.speed_reference_rpm = 600
    bench.run_until(lambda: bench.drive.state == "run", timeout=0.05)
    started_s = bench.time_s
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.3)
    assert bench.drive.fault == "stall"
    assert 0.099 < bench.time_s - started_s < 0.12  # `run` is seen in telemetry of 1 ms
    bench.run_for(0.02)
    assert [bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].last for phase in "abc"] == [0, 0, 0]


def test_shaft_locked_while_it_turns_is_a_fault_after_100_ms_and_can_be_cleared(bench):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.15)
    bench.held_speed_rpm = 0  # reached after 60 ms
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.3)
    assert bench.drive.fault == "stall"
    bench.held_speed_rpm = math.nan
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.02)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)


@pytest.mark.parametrize("inertia_gain", [1, 5])
def test_start_and_reversal_at_the_torque_limit_are_no_stall(make_bench, inertia_gain):
    bench = make_bench()
    bench.rig.inertia_gain = inertia_gain
    for speed_rpm in (900, -900):
        bench.drive.speed_reference_rpm = speed_rpm
        bench.run_for(0.2 + 0.3 * inertia_gain)
        assert bench.drive.state == "run"
        assert bench.truth["speed_rpm"].last == pytest.approx(speed_rpm, abs=9)


def test_load_held_at_a_reference_of_0_is_no_stall(bench):
    bench.drive.speed_reference_rpm = 0
    bench.run_for(0.05)
    bench.load_torque_Nm = 15
    bench.run_for(0.4)
    assert bench.drive.state == "run"
