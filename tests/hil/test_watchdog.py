"""The watchdog: what hangs ends with open switches and a reset, and the drive starts in fault. [SR-47]"""

from __future__ import annotations

from itertools import pairwise

import pytest

from salient.bench.bench import Bench


def hang_background(bench: Bench) -> None:
    bench.fault("background_hung")


def hang_interrupt(bench: Bench) -> None:
    bench.rig.interrupt_time_us = 10000


def lose_interrupts(bench: Bench) -> None:
    bench.fault("interrupt_lost")


def heal(bench: Bench) -> None:
    bench.clear_fault("background_hung")
    bench.clear_fault("interrupt_lost")
    bench.rig.interrupt_time_us = 0


HANGS = {"background": hang_background, "control_interrupt": hang_interrupt, "triggers": lose_interrupts}


def running(bench: Bench) -> None:
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1)
    bench.load_torque_Nm = 5
    bench.run_for(0.03)
    assert bench.drive.state == "run"


def currents_A(bench: Bench, from_s: float) -> list[float]:
    """Largest true current at each time since from_s."""
    signals = [bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"] for phase in "abc"]
    return [max(at) for time_s, *at in zip(
        signals[0].time_s, *(each.value for each in signals), strict=True) if time_s >= from_s]


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", ["traditional", "salient"])
@pytest.mark.parametrize("hang", HANGS)
def test_what_hangs_ends_within_20_ms_with_open_switches_and_a_drive_in_fault(make_bench, controller, hang):
    """Not before 17 ms, the watchdog's time less that between two kicks: a background that hangs leaves the control
    interrupt in control until then."""
    bench = make_bench(controller=controller)
    running(bench)
    bench.rig.truth_period_us = 5
    hangs_s = bench.time_s
    HANGS[hang](bench)
    bench.run_for(0.0165)
    if hang == "background":
        assert max(currents_A(bench, hangs_s + 0.016)) > 3
    bench.run_for(0.0055)
    opened = currents_A(bench, hangs_s + 0.019)
    assert all(later < earlier or later == 0 for earlier, later in pairwise(opened))
    bench.run_for(0.05)
    assert max(currents_A(bench, hangs_s + 0.03)) == 0, "nothing runs between one reset and the next"

    heal(bench)
    bench.rig.truth_period_us = 1000
    bench.run_for(0.15)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "watchdog")
    assert bench.telemetry["DRIVE_FAULT_MASK.watchdog"].last == 1
    assert not bench.drive.armed


# [SR-48]
def test_a_drive_that_the_watchdog_has_reset_runs_after_it_was_cleared_and_armed_and_not_before(bench):
    running(bench)
    bench.fault("background_hung", duration_s=0.025)
    bench.run_for(0.5)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "watchdog"), "the request to run has continued"
    assert bench.drive.fault_log.read()[-1].fault == "watchdog"
    bench.drive.clear_fault()
    bench.run_for(0.01)
    assert bench.drive.state == "ready"
    bench.load_torque_Nm = 0
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)


@pytest.mark.parametrize("short", [("background_hung", 0.0165), ("interrupt_lost", 0.0165)], ids=lambda each: each[0])
def test_a_shorter_standstill_is_no_reset(bench, short):
    bench.run_for(0.03)
    bench.fault(short[0], duration_s=short[1])
    bench.run_for(0.1)
    assert bench.drive.fault in ("none", "interrupt_overrun")
    assert max(bench.telemetry["DRIVE_STATUS.time_us"].value) > 125_000


@pytest.mark.parametrize("interrupt_us", [1, 12, 24])
@pytest.mark.parametrize("control_rate_hz", [20000, 40000])
def test_interrupts_that_end_in_time_are_no_reset(make_bench, interrupt_us, control_rate_hz):
    bench = make_bench(controller="salient", control_rate_hz=control_rate_hz)
    bench.rig.interrupt_time_us = interrupt_us
    running(bench)
    bench.run_for(0.3)
    assert bench.drive.state == "run"


# [SR-48]
def test_a_reset_from_outside_is_no_fault(bench):
    running(bench)
    bench.rig.drive_reset = 1
    bench.run_for(0.1)
    assert bench.drive.fault == "none"
    assert bench.drive.state == "ready"
