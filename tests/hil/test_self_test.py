"""Checks that the drive makes of itself, each with a bit that flips in what it looks at.
[SR-49] [SR-50] [SR-51] [SR-54] [SR-55] [SR-57]
"""

from __future__ import annotations

import pytest

from salient.bench.drive import memory_item
from salient.bench.faults import FaultError
from salient.bench.programs import image
from salient.elf import ElfImage

PERIOD_S = 25e-6
LIMITS = {"limits", "constants"}  # a limit is one of the constants
CASES = {
    "current trip": ("limit_flipped", {"bit": 12}, "memory", LIMITS, 5 * PERIOD_S),
    "over-voltage, lowest bit": ("limit_flipped", {"bit": 32}, "memory", LIMITS, 5 * PERIOD_S),
    "a constant": ("constant_flipped", {"bit": 3000}, "memory", {"constants"}, 2e-3),
    "state, run to fault": ("state_flipped", {"bit": 0}, "memory", {"fault_latch"}, 2 * PERIOD_S),
    "state, run to initialise": ("state_flipped", {"bit": 1}, "memory", {"fault_latch"}, 2 * PERIOD_S),
    "number of the fault": ("fault_latch_flipped", {"bit": 3}, "memory", {"fault_latch"}, 2 * PERIOD_S),
    "period of the timer": ("period_register_flipped", {"bit": 3}, "memory", {"registers"}, 10e-3),
    "clock 6 % fast": ("clock_drift", {"drift_percent": 6.0}, "clock", {"clock"}, 22e-3),
    "clock that stands": ("clock_drift", {"drift_percent": -100.0}, "clock", {"clock"}, 22e-3),
}
"""Fault of the bench, the drive's, the failed checks, longest time."""
ON_TARGETS = {
    "guard of the stack": ("stack_guard_flipped", {"bit": 7}, "memory", {"stack"}, 5 * PERIOD_S),
}


def byte_of_the_tables(build: str) -> int:
    """A byte of the machine's tables in the program, whose change makes no code go astray."""
    symbols = ElfImage(image("saturating", build)).symbols()
    return symbols["machine_tables"] + 2000 - symbols["code_start"]


def start(bench) -> None:
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1)
    assert bench.drive.state == "run"


def failed_checks(bench) -> set[str]:
    message = bench.drive_database.get_message_by_name("DRIVE_SELF_TEST")
    return {signal.name for signal in message.signals if bench.telemetry[f"DRIVE_SELF_TEST.{signal.name}"].last}


def check(bench, kind: str, arguments: dict[str, float], fault: str, failed: set[str],
          longest_s: float) -> None:
    start(bench)
    begin_s = bench.time_s
    bench.fault(kind, **arguments)
    bench.run_for(0.15)
    assert (bench.drive.state, bench.drive.fault) == ("fault", fault)
    assert 0.0 < bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last * 1e-6 - begin_s <= longest_s
    assert failed_checks(bench) == failed
    assert max(bench.truth[f"current_{phase}_A"].last for phase in "abc") < 0.1


@pytest.mark.parametrize("case", CASES)
def test_change_is_a_fault_in_time_that_names_what_has_changed(bench, case):
    check(bench, *CASES[case])


# [SR-41] [SR-51]
def test_memory_that_has_changed_is_a_fault_until_a_reset(bench):
    check(bench, *CASES["current trip"])
    bench.rig.clear_fault("limit_flipped")  # the bit is right again
    bench.drive.off()
    bench.run_for(0.05)
    bench.drive.clear_fault()
    bench.run_for(0.1)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "memory")
    bench.rig.drive_reset = 1
    bench.run_for(0.2)
    assert bench.drive.state == "ready"
    assert bench.drive.fault_log[-1].self_test == ("limits",)


# [SR-51]
def test_a_fault_that_becomes_run_by_a_flipped_bit_stays_without_current(bench):
    """State fault and run differ in one bit, and the command to run is still there."""
    start(bench)
    bench.fault("winding_temperature_sensor_open", phase="a", duration_s=0.05)
    bench.run_for(0.1)
    assert bench.drive.fault == "temperature_sensor"
    bench.fault("state_flipped", bit=0)
    bench.run_for(0.1)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "memory")
    assert max(bench.truth[f"current_{phase}_A"].value[-90:].max() for phase in "abc") < 2.0


# [SR-55]
def test_clock_that_is_right_again_can_be_cleared(bench):
    start(bench)
    bench.fault("clock_drift", drift_percent=-7.0, duration_s=0.05)
    bench.run_for(0.04)
    assert bench.drive.fault == "clock"
    bench.run_for(0.04)
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert bench.drive.state == "ready"


# [SR-55]
@pytest.mark.parametrize("drift_percent", [-4.5, 4.5])
def test_clock_within_5_percent_is_no_fault(bench, drift_percent):
    start(bench)
    bench.fault("clock_drift", drift_percent=drift_percent)
    bench.run_for(0.2)
    assert bench.drive.state == "run"


# [SR-53]
def test_what_the_host_has_not_is_unsupported(bench):
    for kind, arguments in (("code_flipped", {"byte": 5}), ("stack_guard_flipped", {"bit": 5})):
        with pytest.raises(FaultError, match="unsupported"):
            bench.fault(kind, **arguments)
    bench.run_for(0.01)
    assert memory_item(bench, "code_passes") == memory_item(bench, "stack_unused") == 0


# [SR-49] [SR-50] [SR-51] [SR-53] [SR-54] [SR-55]
@pytest.mark.in_turns
@pytest.mark.parametrize("build", ["cortex-m4", "rv32"])
@pytest.mark.parametrize("case", ["current trip", "state, run to fault", "period of the timer", "guard of the stack"])
def test_change_on_a_target_is_a_fault_in_time(make_bench, build, case):
    check(make_bench(build=build), *(CASES | ON_TARGETS)[case])


# [SR-53]
@pytest.mark.parametrize("build", ["cortex-m4", "rv32"])
def test_a_flipped_bit_of_the_program_is_found_at_a_start_which_it_prevents(make_bench, build):
    bench = make_bench(build=build)
    bench.run_for(0.05)
    assert bench.drive.state == "ready"
    bench.fault("code_flipped", byte=byte_of_the_tables(build))
    bench.rig.drive_reset = 1
    bench.run_for(0.2)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "code")
    assert failed_checks(bench) == {"code"}
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "code")
    bench.rig.clear_fault("code_flipped")
    bench.rig.drive_reset = 1
    bench.run_for(0.2)
    assert bench.drive.state == "ready"


# [SR-53] [SR-54]
@pytest.mark.in_turns
def test_program_is_checked_within_a_minute_and_the_stack_has_unused_words(make_bench):
    bench = make_bench(build="cortex-m4", telemetry_period_ms=100)
    bench.run_for(8.0)  # 16 bytes in a millisecond: a pass takes 6.6 s
    assert memory_item(bench, "code_passes") == 1
    assert 15_000 < memory_item(bench, "stack_unused") < 24_000
    bench.fault("code_flipped", byte=byte_of_the_tables("cortex-m4"))
    begin_s = bench.time_s
    bench.run_until(lambda: bench.drive.state == "fault", timeout=8.0)
    assert bench.drive.fault == "code"
    assert 0.0 < bench.time_s - begin_s < 7.5
