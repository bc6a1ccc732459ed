"""A drive that does not become ready sends the check that keeps it; contradicting parameters are refused. [SR-43]"""

import subprocess
import sys

import pytest

from salient.bench.drive import DriveNotReady
from salient.errors import UsageError
from salient.experiments.scenario import Scenario, SpeedStep, check_parameters, run_scenario

HEAD = 'machine = "saturating"\ncontrollers = ["salient"]\nduration_s = 0.1\n'
SPEED = "[[speed]]\nat_s = 0\nvalue_rpm = 100\n"


@pytest.mark.parametrize(("supply_V", "check"), [(149, "under_voltage"), (301, "over_voltage")])
def test_check_that_keeps_the_drive_from_starting_is_sent_until_it_passes(bench, supply_V, check):
    bench.rig.supply_voltage_V = supply_V
    bench.drive.speed_reference_rpm = 100
    with pytest.raises(DriveNotReady, match=f"the drive is not ready: its check {check} fails"):
        bench.drive.wait_until_ready()
    assert (bench.drive.state, bench.drive.fault) == ("initialise", "none")
    with pytest.raises(AssertionError, match=f"the drive is not ready: its check {check} fails"):
        bench.run_until(lambda: bench.drive.state == "run", timeout=0.01)
    bench.rig.supply_voltage_V = 240
    bench.drive.wait_until_ready()
    assert bench.drive.start_inhibited_by == "none"
    bench.run_until(lambda: bench.drive.state == "run", timeout=0.01)
    bench.rig.supply_voltage_V = supply_V
    bench.run_for(0.005)
    assert bench.drive.fault == check, "afterwards it is a fault"
    assert bench.drive.start_inhibited_by == "none"


def test_drive_that_becomes_ready_is_inhibited_by_nothing(bench):
    bench.drive.wait_until_ready()
    assert set(bench.telemetry["DRIVE_STATUS.start_inhibited_by"].value) == {0}


def test_run_ends_with_the_check_that_fails_instead_of_waiting(tmp_path):
    path = tmp_path / "off.toml"
    path.write_text(f"{HEAD}{SPEED}[bench]\nsto_1 = 1\n")
    done = subprocess.run([sys.executable, "-m", "salient", "run", path, "--out", tmp_path / "out"],
                          capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "salient: the drive is not ready: its check sto fails\n"


def test_scenario_without_a_command_may_leave_the_drive_as_it_is(tmp_path):
    scenario = Scenario(name="off", duration_s=0.05, bench={"supply_voltage_V": 100.0})
    assert run_scenario(scenario, tmp_path).fault == "none"


# [SR-56]
@pytest.mark.parametrize(("parameters", "bench", "message"), [
    ({"under_voltage_V": 310}, {},
     "parameters.under_voltage_V: 310 V: must be below over_voltage_V, 300 V"),
    ({"current_limit_A": 79}, {}, "parameters.current_limit_A: 79 A: must not be above current_trip_A, 75 A"),
    ({"current_limit_A": 30, "current_trip_A": 29}, {},
     "parameters.current_limit_A: 30 A: must not be above current_trip_A, 29 A"),
    ({"under_voltage_V": 241}, {}, "supply_voltage_V: 240 V: must not be below under_voltage_V, 241 V"),
    ({"over_voltage_V": 239}, {}, "supply_voltage_V: 240 V: must not be above over_voltage_V, 239 V"),
    ({}, {"supply_voltage_V": 48.0}, "supply_voltage_V: 48 V: must not be below under_voltage_V, 150 V"),
])  # fmt: skip
def test_contradiction_is_refused_in_one_line_that_names_both(parameters, bench, message):
    scenario = Scenario(name="a", duration_s=0.1, speed=(SpeedStep(0.0, 100.0),), parameters=parameters, bench=bench)
    with pytest.raises(UsageError) as caught:
        check_parameters([scenario], "host")
    assert str(caught.value) == message


# [SR-56]
@pytest.mark.parametrize("parameters", [{}, {"current_limit_A": 75}, {"current_trip_A": 20},
                                        {"under_voltage_V": 240, "over_voltage_V": 241}])
def test_consistent_parameters_and_a_lowered_trip_are_accepted(parameters):
    check_parameters([Scenario(name="a", duration_s=0.1, parameters=parameters)], "host")
