"""A drive of each kind of machine does what any drive must do: part of `compare machines`, with its run and its limits.

fan12 has 0.09 N m on three phases, traction 2500 N m, map86 four phases and a flux-linkage map, spindle 20,000 r/min at
100 kHz. Two random machines with light rotors reach 0.4 of their base speed in 4 ms.
"""

from __future__ import annotations

import pytest

from salient.experiments.compare import every_machine
from salient.experiments.compare.every_machine import EXAMPLES
from salient.experiments.compare.random_machines import random_machine
from salient.experiments.scenario import run_scenario


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["fan12", "traction", "map86", "spindle"])
def test_starts_takes_a_load_step_brakes_and_reverses_near_its_bounds(machine, tmp_path):
    scenario = every_machine.scenario(EXAMPLES / f"{machine}.toml", "salient")
    result = run_scenario(scenario, tmp_path)
    assert result.fault == "none"
    values = every_machine.extract(scenario, result.recording)
    assert every_machine.failures(values, "salient") == []
    assert min(values[f"{change}_to_bound"] for change in ("start", "brake", "reverse")) > 0.99, "faster than physics"
    assert 0.2 < values["dip_percent"] < 4.0
    assert values["recovery_time_s"] < 0.004
    assert values["hold_percent"] < 0.001
    assert 0.005 < values["ripple"] < 0.02


@pytest.mark.in_turns
@pytest.mark.parametrize("number", [13, 15])
def test_light_rotor_starts_and_reverses_near_its_bounds_without_overshoot(number, tmp_path):
    file = tmp_path / f"random_{number}.toml"
    file.write_text(random_machine(number))
    scenario = every_machine.scenario(file, "salient")
    recording = run_scenario(scenario, tmp_path).recording
    values = every_machine.extract(scenario, recording)
    assert every_machine.failures(values, "salient") == []
    _, braking, reversal = scenario.speed
    start = recording["speed_rpm"][recording["time_s"] < braking.at_s]
    assert 1.0 < start.max() / scenario.speed[0].value_rpm < 1.004
    assert 1.0 < recording["speed_rpm"].min() / reversal.value_rpm < 1.008


@pytest.mark.parametrize("controller", ["traditional", "paper"])
@pytest.mark.parametrize("machine", ["fan12", "traction"])
def test_other_controllers_start_and_hold_the_speed_under_load(machine, controller, tmp_path):
    scenario = every_machine.scenario(EXAMPLES / f"{machine}.toml", controller)
    result = run_scenario(scenario, tmp_path)
    assert result.fault == "none"
    values = every_machine.extract(scenario, result.recording)
    assert every_machine.failures(values, controller) == []
    assert 0.99 < values["start_to_bound"] < 1.25
    assert 0.3 < values["dip_percent"] < 6.0
