"""Openings of the switches without the firmware: comparators, safe torque off, compare values that are not renewed.
[SR-01]
"""

from __future__ import annotations

from itertools import pairwise

import pytest

from salient.bench.bench import Bench

PERIOD_US = 25
TRIP_A = 75.0
"""current_trip_A of the saturating machine."""


def running(bench: Bench, speed_rpm: float = 600, load_Nm: float = 12) -> None:
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.1)
    bench.load_torque_Nm = load_Nm
    bench.run_for(0.03)
    bench.rig.truth_period_us = 5
    assert bench.drive.state == "run"


def currents_A(bench: Bench, from_s: float = 0.0) -> list[float]:
    """Largest true current at each time since from_s."""
    signals = [bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"] for phase in "abc"]
    return [max(at) for time_s, *at in zip(
        signals[0].time_s, *(each.value for each in signals), strict=True) if time_s >= from_s]


def fall_together(currents: list[float]) -> bool:
    """No switch conducts: the largest current falls from each instant to the next."""
    return all(later < earlier or later == 0 for earlier, later in pairwise(currents))


# [SR-10]
@pytest.mark.in_turns
@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
@pytest.mark.parametrize("gain", [0.0, 0.3])
def test_true_current_stays_below_1_2_times_the_trip_with_dead_or_weak_sensors(make_bench, controller, gain):
    bench = make_bench(controller=controller)
    running(bench)
    from_s = bench.time_s
    bench.rig.current_sensor_gain = gain
    bench.run_for(0.05)
    assert bench.drive.state == "fault"
    assert bench.drive.fault in ("hardware_over_current", "over_speed", "encoder", "phase_open")
    peak_A = max(currents_A(bench, from_s))
    assert peak_A < 1.2 * TRIP_A
    if bench.drive.fault == "hardware_over_current":
        assert peak_A > 1.05 * TRIP_A  # between two of the true values
    assert currents_A(bench)[-1] == 0


@pytest.mark.parametrize("line", ["sto_1", "sto_2"])
@pytest.mark.parametrize("interrupt_us", [0, 8000], ids=["healthy", "interrupt_hangs"])
def test_either_line_of_safe_torque_off_opens_the_switches_at_once(bench, line, interrupt_us):
    running(bench)
    bench.rig.interrupt_time_us = interrupt_us
    off_s = bench.time_s + (10 if interrupt_us == 0 else 30) * 1e-6
    setattr(bench.rig.at(off_s), line, 1)
    bench.run_for(0.015)
    assert max(currents_A(bench, off_s)) > 5
    assert fall_together(currents_A(bench, off_s))
    bench.rig.truth_period_us = 1000
    bench.rig.interrupt_time_us = 0
    bench.run_for(0.12)
    assert bench.drive.state == "fault"
    assert bench.telemetry["DRIVE_FAULT_MASK.sto"].last == 1
    assert bench.telemetry[f"DRIVE_GATES.{line}"].last_name == "torque_off"


# [SR-01] [SR-02]
@pytest.mark.in_turns
def test_safe_torque_off_is_reported_within_a_period_and_is_cleared_only_when_both_lines_are_energised(bench):
    running(bench)
    off_us = bench.time_ns / 1000
    bench.rig.sto_1 = 1
    bench.rig.sto_2 = 1
    bench.run_for(0.02)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "sto")
    assert 0 <= bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last - off_us <= PERIOD_US
    bench.rig.sto_1 = 0
    bench.drive.clear_fault()
    bench.run_for(0.01)
    assert bench.drive.state == "fault"
    bench.rig.sto_2 = 0
    bench.run_for(0.01)
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.01)
    assert (bench.drive.state, bench.drive.fault) == ("ready", "none")
    bench.load_torque_Nm = 0
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)


# [SR-03]
def test_lines_that_differ_for_200_ms_are_a_fault_until_both_have_been_off(bench):
    bench.run_for(0.01)
    assert bench.drive.state == "ready"
    bench.rig.sto_2 = 1
    bench.run_for(0.19)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "sto")
    bench.run_for(0.02)
    bench.rig.sto_2 = 0
    bench.drive.clear_fault()
    bench.run_for(0.02)
    assert bench.drive.state == "fault"
    bench.rig.sto_1 = 1
    bench.rig.sto_2 = 1
    bench.run_for(0.02)
    bench.rig.sto_1 = 0
    bench.rig.sto_2 = 0
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.02)
    assert bench.drive.state == "ready"


# [SR-45]
@pytest.mark.parametrize("controller", ["traditional", "salient"])
@pytest.mark.parametrize("control_rate_hz", [20000, 40000, 100000])
def test_interrupt_that_does_not_end_leaves_no_switch_on_after_two_periods(make_bench, controller, control_rate_hz):
    bench = make_bench(controller=controller, control_rate_hz=control_rate_hz)
    running(bench)
    period_s = 1 / control_rate_hz
    hangs_s = bench.time_s
    bench.rig.interrupt_time_us = 10000
    bench.run_for(0.009)
    assert fall_together(currents_A(bench, hangs_s + 3 * period_s + 1e-6))
    assert max(currents_A(bench, hangs_s)) < 1.1 * TRIP_A
    assert currents_A(bench)[-1] == 0
    bench.rig.truth_period_us = 1000
    bench.rig.interrupt_time_us = 0
    bench.run_for(0.12)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "interrupt_overrun")
