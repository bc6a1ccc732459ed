"""Equal runs give identical files, independent of computer load, folder and transport."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from salient.config import CONTROLLERS
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep, run_all, run_scenario

FILES = ("can.blf", "can.log", "recording.npy")


def scenario(controller: str, **changes) -> Scenario:
    """A start, a load step and a change of speed within 50 ms, with modified parameters."""
    settings = {
        "name": "short",
        "duration_s": 0.05,
        "controller": controller,
        "seed": 5,
        "initial_angle_deg": 12.0,
        "parameters": {"torque_max_Nm": 15.0, "speed_ramp_rpm_s": 8000.0},
        "speed": (SpeedStep(0.0, 150.0), SpeedStep(0.0333, 200.0)),
        "load": (LoadStep(0.0251, 6.0),),
        "record": Record(step_us=10.0),
    }
    return Scenario(**(settings | changes))


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in FILES}


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_equal_runs_give_identical_files(tmp_path, controller):
    results = []
    for name in ("first", "second_with_a_longer_name"):
        run_all([scenario(controller)], tmp_path / name)
        results.append((contents(tmp_path / name / controller), (tmp_path / name / "results.json").read_bytes()))
    assert results[0] == results[1]
    assert json.loads(results[0][1])["controllers"][controller]["fault"] == "none"


def test_different_initial_angles_give_different_runs(tmp_path):
    """Shows that the comparison above can fail."""
    for angle in (12.0, 13.0):
        run_scenario(scenario("paper", initial_angle_deg=angle), tmp_path / str(angle))
    first, second = contents(tmp_path / "12.0"), contents(tmp_path / "13.0")
    assert all(first[name] != second[name] for name in FILES)


def test_scheduled_steps_act_at_their_times(tmp_path):
    """The load acts at exactly 25.1 ms: a sample at that instant is without it, the next one has it. A later speed is
    commanded at its time, and arrives after its transmission time on the bus."""
    result = run_scenario(scenario("paper"), tmp_path)
    recording = result.recording
    loaded_s = recording["time_s"][recording["load_torque_Nm"] > 5.9]
    assert loaded_s[0] == pytest.approx(0.0251 + 10e-6, abs=1e-9)
    reference = result.telemetry["DRIVE_MOTION.speed_reference_rpm"]
    assert 0.0333 < reference.time_s[reference.value > 150.0][0] < 0.0353


def test_division_of_time_into_steps_changes_nothing(make_bench):
    """One long step of the clock or many short ones give the same frames at the same times."""
    logs = []
    for steps in (1, 50):
        bench = make_bench(controller="paper")
        bench.drive.speed_reference_rpm = 600
        for _ in range(steps):
            bench.run_for(0.05 / steps)
        logs.append([(t, m.arbitration_id, bytes(m.data)) for t, m in bench.log if m.arbitration_id < 0x800])
    assert logs[0] == logs[1]


@pytest.mark.socketcan
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_both_transports_give_identical_files(tmp_path, request, controller):
    interface = request.config.getoption("--salient-can")
    for name, can in (("local", "local"), ("socketcan", interface)):
        run_scenario(scenario(controller), tmp_path / name, can)
    local, socketcan = contents(tmp_path / "local"), contents(tmp_path / "socketcan")
    assert local["can.log"].decode().splitlines() == socketcan["can.log"].decode().splitlines()
    assert local == socketcan
