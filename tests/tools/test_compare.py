"""salient compare: its runs, its table, and the comparison with a baseline."""

import base64
import io
import json
import re
import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from salient.cli import make_parser
from salient.config import CONTROLLERS
from salient.errors import RunFailed, UsageError
from salient.experiments.compare import (
    baseline,
    command,
    random_cases,
    results_file,
    speed_range,
    summary_file,
    table,
)
from salient.experiments.compare.case import Case
from salient.experiments.compare.cases import GROUPS, scenario_toml, start_scenario
from salient.experiments.compare.every_machine import EXAMPLES
from salient.experiments.compare.machine import cases_of, is_allowed, subject, targets_of
from salient.experiments.compare.metrics import EXTRACTORS, METRICS, failures, peak_current_max_A
from salient.experiments.compare.random_cases import random_drive, random_load
from salient.experiments.compare.runner import RunMetrics, _run, run_all
from salient.experiments.compare.targets import TARGETS, Target
from salient.experiments.scenario import LoadStep, Record, Scenario, SpeedStep, TorqueStep, load_scenarios
from salient.experiments.tasks import read_results
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.parameter_table import read_table
from salient.paths import MACHINES
from salient.reference.torque_speed_bound import MOTORING, Limits, largest_torque


@cache
def all_cases() -> dict[str, list[Case]]:
    """All cases of each group, which take longer to make than most tests."""
    return {name: list(group.cases(False)) for name, group in GROUPS.items()}


def compare(*line):
    """Returns exit code and output."""
    output = io.StringIO()
    code = command.run(make_parser().parse_args(["compare", *map(str, line)]), stream=output)
    return code, output.getvalue()


def run_metrics(controller="paper", sample="", failed="", condition="saturating", group="start", **values):
    case = Case(group, condition, controller, "start", start_scenario(controller=controller), sample)
    return RunMetrics(case, values, failed)


@pytest.fixture(scope="module")
def start_folder(tmp_path_factory):
    """Folder and output of the quick group `start` with two jobs."""
    folder = tmp_path_factory.mktemp("compare")
    code, output = compare("start", "--quick", "--jobs", 2, "--out", folder)
    assert code == 0
    return folder, output


# --- runs -----------------------------------------------------------------------------------------------------------

def test_every_target_belongs_to_a_row():
    conditions = {(case.group, case.condition) for of in all_cases().values() for case in of}
    for group, condition, metric, statistic in TARGETS:
        assert (group, condition) in conditions
        assert (metric, statistic) in GROUPS[group].columns


def test_every_controller_runs_in_every_group_that_it_supports():
    for name, of in all_cases().items():
        salient = {key: {"salient"} for key in ("rates", "misalignment", "standing_error", "hold",
                                                "torque_speed_random", "partial_torque", "copper", "copper_random",
                                                "transition", "torque_conditions", "every_speed")}
        expected = {"paper_conditions": {"traditional", "paper"}, "compressor": {"paper", "salient"}}
        assert {case.controller for case in of} == (expected | salient).get(name, set(CONTROLLERS))


def test_quick_runs_are_a_subset_of_the_conditions():
    for name, group in GROUPS.items():
        quick = list(group.cases(True))
        assert 0 < len(quick) < len(all_cases()[name])
        assert {case.condition for case in quick} <= {case.condition for case in all_cases()[name]}


def test_load_steps_are_equally_spaced_over_one_stroke():
    steps_s = sorted({case.scenario.load[0].at_s for case in all_cases()["dip"]})
    assert len(steps_s) == 24
    assert np.diff(steps_s) * 6.0 * 150.0 == pytest.approx(30.0 / 24)


def test_moving_loads_are_judged_over_two_periods_after_the_transient():
    for case in all_cases()["moving"]:
        scenario = case.scenario
        period_s = 1.0 / scenario.bench["load_sine_frequency_Hz"]
        window_s = scenario.duration_s - scenario.record.from_s
        assert window_s == pytest.approx(max(0.15, 2.0 * period_s))
        assert scenario.record.from_s - scenario.load[0].at_s >= max(0.3, period_s) - 1e-6
        assert scenario.load[0].at_s >= 0.2 + scenario.speed[0].value_rpm / 5000.0 - 1e-9


@pytest.mark.parametrize("group", ["torque_speed", "partial_torque", "torque_conditions"])
def test_held_torque_is_recorded_over_whole_revolutions_of_a_shaft_that_has_its_speed(group):
    rotor_poles = {"saturating": 4, "linear_cosine": 4, "linear_trapezoid": 4, "finite_element": 6}
    for case in all_cases()[group]:
        scenario = case.scenario
        speed_rpm = scenario.bench["held_speed_rpm"]
        (step,) = scenario.torque
        assert step.at_s >= speed_rpm / 10_000 + 0.01
        assert scenario.record.from_s >= step.at_s + 0.1 - 1e-9
        recorded_s = scenario.duration_s - scenario.record.from_s
        turns = recorded_s * speed_rpm / 60.0 * rotor_poles[scenario.machine]
        assert turns == pytest.approx(max(1, round(turns)), abs=2e-3) and turns > 0.99
        assert case.controller == "salient" or step.value_Nm > 0


def test_largest_torque_is_requested_from_a_quarter_to_twice_the_base_speed_in_both_quadrants():
    for machine in ("saturating", "finite_element"):
        of = [case for case in all_cases()["torque_speed"]
              if case.scenario.machine == machine and case.controller == "salient"]
        speeds_rpm = sorted({case.scenario.bench["held_speed_rpm"] for case in of})
        assert speeds_rpm == [375.0, 750.0, 1125.0, 1500.0, 1875.0, 2250.0, 3000.0]
        (most_Nm,) = (row.limits[1] for row in read_table() if row.name == "torque_max_Nm")
        assert {case.scenario.torque[0].value_Nm for case in of} == {most_Nm, -most_Nm}
        assert all(case.scenario.parameters == {"torque_max_Nm": most_Nm} for case in of)


def test_parts_of_the_torque_are_those_of_the_largest_one_above_base_speed():
    limits = Limits(52.0, 300.0, 240.0)
    (largest,) = largest_torque(load_machine(machine_path("linear_cosine")), [2250.0], limits, MOTORING)
    parts = {case.condition.split(", ")[3]: case.scenario.torque[0].value_Nm / largest.torque_Nm
             for case in all_cases()["partial_torque"] if "linear_cosine, 2250 r/min, motoring" in case.condition}
    assert parts == pytest.approx({"25 %": 0.25, "50 %": 0.5, "75 %": 0.75}, rel=0.03)
    assert {case.scenario.bench["held_speed_rpm"] for case in all_cases()["partial_torque"]} == {1875.0, 2250.0, 3000.0}


def test_load_steps_above_base_speed_are_preceded_by_those_below():
    for case in all_cases()["transition"]:
        scenario = case.scenario
        if case.extractor != "fast_step":
            continue
        slow, fast = scenario.speed
        assert fast.value_rpm == pytest.approx(3.0 * slow.value_rpm)
        ends_s = [step.at_s for step in scenario.load]
        assert ends_s == sorted(ends_s) and len(ends_s) == 16
        assert ends_s[7] < fast.at_s < ends_s[8] and ends_s[0] > 0.1
        assert [step.torque_Nm > 0.0 for step in scenario.load] == [True, False] * 8


def test_ramps_have_their_lengths():
    for case in all_cases()["ramps"]:
        ramp_s = case.scenario.load[0].torque_Nm / case.scenario.bench["load_ramp_Nm_s"]
        assert case.condition.endswith(f", {ramp_s * 1000:g} ms")
        assert case.scenario.duration_s == pytest.approx(case.scenario.load[0].at_s + ramp_s + 0.3)


def test_compressors_are_judged_over_three_turns_after_20_turns_of_load():
    for case in all_cases()["compressor"]:
        turn_s = 60.0 / case.scenario.speed[0].value_rpm
        (load,) = case.scenario.load
        assert case.scenario.record.from_s - load.at_s == pytest.approx(20 * turn_s, abs=1e-5)
        assert case.scenario.duration_s - case.scenario.record.from_s == pytest.approx(3 * turn_s, abs=1e-5)
        assert load.profile_Nm > 0 and ("one cylinder" in case.condition) == ("one" in case.scenario.load_profile)


def test_random_drives_cover_their_ranges_and_are_reproducible():
    drives = [random_drive(number) for number in range(random_cases.DRIVES)]
    assert drives[:5] == [random_drive(number) for number in range(5)]
    assert {drive.encoder_bits for drive in drives} == set(range(14, 21))
    for name, low, high in (("flux_linkage_gain", 0.9, 1.1), ("resistance_gain", 0.8, 1.5), ("inertia_gain", 0.5, 3.0),
                            ("friction_gain", 0.0, 5.0), ("supply_voltage_V", 200.0, 280.0),
                            ("encoder_offset_deg", -0.1, 0.1), ("current_noise_A", 0.0, 0.04)):
        values = [drive.bench[name] for drive in drives]
        assert low - 1e-6 <= min(values) < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < max(values) <= high + 1e-6


def test_random_loads_are_of_every_kind_and_within_what_the_drive_can_make():
    loads = [random_load(number) for number in range(200)]
    assert loads[:5] == [random_load(number) for number in range(5)]
    assert {load.machine for load in loads} == {"saturating", "linear_cosine", "linear_trapezoid", "finite_element"}
    speeds_rpm = [load.speed[0].value_rpm for load in loads]
    assert 10.0 <= min(speeds_rpm) < 12.0 and 1300.0 < max(speeds_rpm) <= 1500.0
    sines = [load for load in loads if "load_sine_frequency_Hz" in load.bench]
    ramps = [load for load in loads if "load_ramp_Nm_s" in load.bench]
    assert min(len(sines), len(ramps), 200 - len(sines) - len(ramps)) > 50
    for load in loads:
        friction_Nm = (0.002 if load.machine == "finite_element" else 0.02) * load.bench["friction_gain"]
        peak_Nm = load.load[0].torque_Nm + load.bench.get("load_sine_amplitude_Nm", 0.0)
        assert 0.9 < peak_Nm < max(1.2, 17.3 - friction_Nm * load.speed[0].value_rpm * np.pi / 30)
    for load in sines:
        window_s = load.duration_s - load.load[0].at_s - 3.0
        periods = window_s * load.bench["load_sine_frequency_Hz"]
        assert window_s > 0.499 and periods == pytest.approx(max(2, round(periods)), abs=1e-3)


def test_encoders_are_judged_over_angles_spread_over_a_stroke():
    of = [case for case in all_cases()["encoders"] if case.condition == "saturating, 12 bits and edge stamps, 10 r/min"]
    assert sorted(case.scenario.initial_angle_deg for case in of) == pytest.approx(np.arange(24) * 1.25)
    assert all(case.scenario.encoder_edges and case.scenario.encoder_bits == 12 for case in of)


def test_mean_speed_is_taken_over_whole_turns():
    for case in all_cases()["standing_error"]:
        scenario = case.scenario
        turns = (scenario.duration_s - scenario.record.from_s) * scenario.speed[0].value_rpm / 60.0
        assert turns == pytest.approx(max(1, round(turns)), abs=1e-4)


def test_moving_load_of_the_misaligned_drive_is_constant_before_the_ripple_is_taken():
    moving = [case for case in all_cases()["misalignment"] if case.condition.endswith("moving load")]
    for case in moving:
        scenario = case.scenario
        steps = scenario.load
        assert steps[-1].torque_Nm == 6.0 and steps[-1].at_s <= scenario.record.from_s - 0.29
        if case.sample == "misaligned":
            assert {step.torque_Nm for step in steps[:-1]} == {2.0, 10.0} and len(steps) > 20
            # A ramp from 10 to 2 N m takes as long as a step lasts.
            assert scenario.bench["load_ramp_Nm_s"] * (steps[1].at_s - steps[0].at_s) == pytest.approx(8.0)
        else:
            assert len(steps) == 1


# --- metrics --------------------------------------------------------------------------------------------------------

def recording_of(step_s=1e-3, **columns):
    """A recording of equal steps from 0 s on."""
    count = len(next(iter(columns.values())))
    columns = {"time_s": np.arange(count) * step_s, **columns}
    return np.rec.fromarrays([np.asarray(column, dtype=float) for column in columns.values()], names=list(columns))


def test_torque_against_the_load_is_timed_in_control_periods():
    torque_Nm = np.full(400, 8.0)
    torque_Nm[20:25] = -0.79  # within a tenth of the load
    torque_Nm[50:58] = -2.0
    torque_Nm[100:105] = -19.0
    recording = recording_of(5e-6, torque_Nm=torque_Nm, speed_rpm=np.full(400, 149.0))
    scenario = Scenario(name="", duration_s=0.002, speed=(SpeedStep(0.0, 150.0),), load=(LoadStep(0.0, 8.0),))
    values = EXTRACTORS["encoder"](scenario, recording)
    assert values == pytest.approx({"against_periods": 8 * 5 / 25, "speed_dip_rpm": 1.0})


def test_mean_speed_and_movement_count_turns_beyond_360_degrees():
    # A turn a second, too fast by a thousandth.
    angle_deg = (350.0 + 360.0 * 1.001 * np.arange(1001) * 1e-3) % 360.0
    scenario = Scenario(name="", duration_s=1.0, speed=(SpeedStep(0.0, 60.0),), record=Record())
    recording = recording_of(rotor_angle_deg=angle_deg)
    assert EXTRACTORS["mean_error"](scenario, recording)["mean_error_rpm"] == pytest.approx(0.06)
    assert EXTRACTORS["hold"](scenario, recording)["drift_deg"] == pytest.approx(360.36)


def test_swing_is_the_excess_after_the_drop_or_the_oscillation_that_remains():
    scenario = Scenario(name="", duration_s=0.4, speed=(SpeedStep(0.0, 150.0),), load=(LoadStep(0.0, 8.0),))
    speed_rpm = np.full(400, 150.0)
    speed_rpm[:50] = 100.0
    speed_rpm[60:70] = 153.0
    recording = recording_of(speed_rpm=speed_rpm, torque_Nm=speed_rpm)
    assert EXTRACTORS["inertia_step"](scenario, recording)["swing_percent"] == pytest.approx(2.0)
    speed_rpm[350:] = 144.0
    recording = recording_of(speed_rpm=speed_rpm, torque_Nm=speed_rpm)
    assert EXTRACTORS["inertia_step"](scenario, recording)["swing_percent"] == pytest.approx(4.0)


def random_load_metrics(speed_rpm, **bench):
    """Metrics of 4 s at 60 r/min; the load of 8 N m is applied at 0.2 s."""
    scenario = Scenario(name="", duration_s=4.0, speed=(SpeedStep(0.0, 60.0),), load=(LoadStep(0.2, 8.0),),
                        bench={"inertia_gain": 2.0, **bench})
    recording = recording_of(speed_rpm=speed_rpm, torque_Nm=speed_rpm, current_a_A=np.full(4000, 20.0))
    return EXTRACTORS["random_load"](scenario, recording)


def test_constant_load_is_judged_three_seconds_after_it():
    speed_rpm = np.full(4000, 60.0)
    speed_rpm[200:3190] = 30.0
    assert failures(random_load_metrics(speed_rpm)) == []
    speed_rpm[3210] = 60.3 + 0.09
    assert failures(random_load_metrics(speed_rpm)) == []
    speed_rpm[3210] = 60.3 + 0.11
    assert failures(random_load_metrics(speed_rpm)) == ["deviation under a constant load beyond 0.5 % 0.11 r/min"]
    speed_rpm[100:200] = 67.6
    assert "maximum speed 105.07 % of reference" in failures(random_load_metrics(speed_rpm))
    speed_rpm[100:150] = 60.0
    assert failures(random_load_metrics(speed_rpm))[0] == "not at speed before the load step"


def test_sine_is_judged_by_the_swing_of_the_free_shaft():
    # 2 * 4 N m / (2 * 0.02 kg m^2 * 2 pi 10 Hz) is 3.183 rad/s, 30.4 r/min peak to peak.
    wave_rpm = np.sin(2.0 * np.pi * 10.0 * np.arange(4000) * 1e-3)
    sine = {"load_sine_amplitude_Nm": 4.0, "load_sine_frequency_Hz": 10.0}
    values = random_load_metrics(60.0 + 15.2 * wave_rpm, **sine)
    assert values["swing_ratio"] == pytest.approx((30.4 - 0.1) / 30.4, rel=2e-3)
    assert failures(values) == []
    assert failures(random_load_metrics(60.0 + 16.1 * wave_rpm, **sine)) == [
        "swing under a sine relative to the free shaft 1.056"]


def held(torque_Nm, current_A, request_Nm, speed_rpm=2250.0, **bench):
    """Metrics of a held shaft of linear_cosine, and metrics of a part of the torque."""
    scenario = Scenario(name="", machine="linear_cosine", duration_s=0.1, torque=(TorqueStep(0.0, request_Nm),),
                        bench={"held_speed_rpm": speed_rpm, **bench})
    recording = recording_of(torque_Nm=torque_Nm, current_a_A=current_A, current_b_A=current_A)
    return EXTRACTORS["held"](scenario, recording), EXTRACTORS["held_part"](scenario, recording)


@pytest.mark.in_turns
def test_held_torque_is_judged_by_its_bound_and_the_current_by_its_limit():
    motoring, part = held(np.linspace(20.0, 24.0, 101), np.linspace(0.0, 53.0, 101), 40.0)
    assert motoring["torque_bound_Nm"] == pytest.approx(25.9, rel=0.01)
    assert motoring["motoring_short_percent"] == pytest.approx(100.0 * (1.0 - 22.0 / motoring["torque_bound_Nm"]))
    assert "braking_short_percent" not in motoring
    assert (motoring["torque_mean_Nm"], motoring["ripple"]) == pytest.approx((22.0, 4.0 / 22.0))
    assert motoring["peak_to_limit"] == pytest.approx(53.0 / 52.0)
    assert part["torque_error_percent"] == pytest.approx(45.0)
    braking, _ = held(np.full(101, -13.0), np.full(101, 20.0), -13.0)
    assert braking["torque_bound_Nm"] == pytest.approx(-26.2, rel=0.01)
    assert braking["braking_short_percent"] == pytest.approx(50.4, rel=0.02)
    low, _ = held(np.full(101, 13.0), np.full(101, 20.0), 13.0, supply_voltage_V=168.0)
    assert low["torque_bound_Nm"] == pytest.approx(17.1, rel=0.01)


def test_partial_torque_is_judged_by_the_best_pulse_of_the_torque_that_was_made():
    _, part = held(np.full(101, 13.0), np.full(101, 17.0), 13.0)
    assert part["phase_rms_A"] == pytest.approx(17.0)
    assert part["rms_to_best"] == pytest.approx(17.0 / 15.3, rel=0.01)
    _, beyond = held(np.full(101, 30.0), np.full(101, 30.0), 30.0)
    assert beyond["rms_to_best"] is None


def test_torque_step_of_a_ramp_is_that_between_means_of_strokes():
    # 10 r/min: a stroke of 30 degrees takes 0.5 s.
    angle_deg = 60.0 * np.arange(20_000) * 1e-3
    stroke = np.floor(angle_deg / 30.0)
    torque_Nm = 8.0 + 2.0 * np.sin(2.0 * np.pi * angle_deg / 30.0) + np.where(stroke >= 12, 0.4, 0.0)
    scenario = Scenario(name="", machine="saturating", duration_s=20.0, load=(LoadStep(0.0, 8.0),),
                        speed=(SpeedStep(0.0, 5.0), SpeedStep(1.0, 10.0), SpeedStep(11.0, 5.0)),
                        parameters={"speed_ramp_rpm_s": 0.5})
    recording = recording_of(rotor_angle_deg=angle_deg % 360.0, torque_Nm=torque_Nm, speed_rpm=np.full(20_000, 10.1))
    values = EXTRACTORS["speed_ramps"](scenario, recording)
    assert values == pytest.approx({"torque_step_percent": 5.0, "highest_speed_percent": 101.0}, rel=1e-3)


def test_drop_above_base_speed_is_relative_to_that_below():
    speed_rpm = np.full(16_000, 500.0)
    speed_rpm[8000:] = 1500.0
    load = []
    for number in range(8):
        start = 2000 * number + 500
        speed_rpm[start:start + 100] -= (4.0, 2.0)[number // 4] * (1.0 - 0.1 * (number % 4))
        load += [LoadStep(start * 1e-3, (8.0, 2.0)[number // 4]), LoadStep(start * 1e-3 + 1.0, 0.0)]
    scenario = Scenario(name="", duration_s=16.0, speed=(SpeedStep(0.0, 500.0), SpeedStep(8.0, 1500.0)),
                        load=tuple(load))
    values = EXTRACTORS["fast_step"](scenario, recording_of(speed_rpm=speed_rpm, torque_Nm=speed_rpm))
    assert values == pytest.approx({"speed_dip_rpm": 2.0, "dip_ratio": 2.0, "recovery_time_s": 0.0})
    speed_rpm[2000 * 7 + 500:2000 * 7 + 1500] = 1400.0
    never = EXTRACTORS["fast_step"](scenario, recording_of(speed_rpm=speed_rpm, torque_Nm=speed_rpm))
    assert never["recovery_time_s"] is None and never["dip_ratio"] == pytest.approx(100.0)


# --- scenarios ------------------------------------------------------------------------------------------------------

@pytest.mark.in_turns
@pytest.mark.parametrize("group", GROUPS)
def test_written_scenario_equals_the_one_that_ran(group, tmp_path):
    for case in all_cases()[group][:: max(1, len(all_cases()[group]) // 20)]:
        path = tmp_path / "compare.toml"
        path.write_text(scenario_toml(case))
        assert load_scenarios(path) == [case.scenario]


def test_run_that_ends_in_a_fault_is_reported_and_reproducible(tmp_path):
    scenario = replace(start_scenario(controller="paper"), duration_s=0.1, parameters={"over_speed_rpm": 300.0},
                       load=(LoadStep(0.05, -20.0),))  # single-quadrant: it cannot hold a load that drives
    case = Case("start", "saturating", "paper", "start", scenario)
    (run,) = run_all([case], 1, io.StringIO(), tmp_path / "runs")
    assert (run.metrics, run.failed) == ({}, "fault over_speed")
    (row, *_) = table.make_rows([run])
    assert row.failed == {"paper": "fault over_speed"} and row.values == {}
    assert "paper: fault over_speed" in table.table([row])
    ((_, path),) = command._write_failed(tmp_path, [run])
    assert path.name == "start_saturating_paper.toml"
    assert load_scenarios(path) == [replace(scenario, name=path.stem)]


def test_ratios_are_relative_to_the_first_sample(tmp_path):
    step = replace(start_scenario(controller="salient"), duration_s=0.2, speed=(SpeedStep(0.0, 150.0),),
                   load=(LoadStep(0.1, 8.0),))
    doubled = {"inertia_gain": 2.0}
    samples = (("nominal", step), ("changed", replace(step, bench=doubled)))
    runs = run_all([Case("inertia", "saturating, inertia x 2", "salient", "inertia_step", scenario, sample)
                    for sample, scenario in samples], 1, io.StringIO(), tmp_path)
    nominal, changed = (run.metrics for run in runs)
    assert "recovery_ratio" not in nominal
    assert changed["recovery_ratio"] == pytest.approx(changed["recovery_time_s"] / nominal["recovery_time_s"])
    assert 0.5 < changed["recovery_ratio"] < 2.0


def test_interrupted_comparison_continues_with_the_runs_that_are_missing(tmp_path):
    path = tmp_path / "runs.jsonl"
    short = replace(start_scenario(controller="paper"), duration_s=0.01)
    first, second = (Case("start", "saturating", "paper", "start", replace(short, seed=seed)) for seed in (1, 2))
    (before,) = run_all([first], 1, io.StringIO(), tmp_path)
    (line,) = path.read_text().splitlines()
    path.write_text(f'{line}\n{{"cut off')
    after, added = run_all([first, second], 1, io.StringIO(), tmp_path)
    assert after == before and added.case == second
    assert len(path.read_text().splitlines()) == 2 and path.read_text().startswith(f"{line}\n")


def test_resumed_comparison_executes_nothing_again_and_a_new_one_everything(tmp_path):
    for option, lines in (((), 3), (("--resume",), 3), ((), 3)):
        modified_before = (tmp_path / "runs.jsonl").stat().st_mtime_ns if (tmp_path / "runs.jsonl").exists() else 0
        assert compare("start", "--quick", "--out", tmp_path, *option)[0] == 0
        keys = (tmp_path / "runs.jsonl").read_text().splitlines()
        assert len(keys) == lines
        executed = (tmp_path / "runs.jsonl").stat().st_mtime_ns > modified_before
        assert executed or option == ("--resume",)


def test_finished_run_counts_for_its_machine_file_only(tmp_path):
    text, machine = (MACHINES / "saturating.toml").read_text(), tmp_path / "machine.toml"
    case = Case("start", "machine", "paper", "start",
                replace(start_scenario(controller="paper"), machine=str(machine), duration_s=0.01))
    heavier = text.replace("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.03")
    for content, executed in ((text, True), (text, False), (heavier, True), (text, False)):
        machine.write_text(content)
        before = len(read_results(tmp_path))
        run_all([case], 1, io.StringIO(), tmp_path)
        assert len(read_results(tmp_path)) == before + executed


def test_cases_of_another_machine_have_its_speeds_and_torques():
    on = subject(str(EXAMPLES / "fan12.toml"))
    scale = on.scale
    for name, of in all_cases().items():
        if name in {"machines", "mismatch"} or name in speed_range.GROUPS:  # of its own
            continue
        of_paper = [case for case in of if case.scenario.machine == "saturating" and case.extractor != "counts"]
        own = [case for case in of_paper if is_allowed(replace(
            case.scenario, machine=on.path, speed=tuple(replace(step, value_rpm=scale.rpm(step.value_rpm))
                                                        for step in case.scenario.speed)))]
        of_machine = [case for case in cases_of(of, on) if case.extractor != "counts"]
        for case, scaled in zip(own, of_machine, strict=True):
            assert scaled.scenario.machine == on.path and "saturating" not in scaled.condition
            assert (scaled.group, scaled.sample, scaled.extractor) == (name, case.sample, case.extractor)
            assert [step.value_rpm for step in scaled.scenario.speed] == [
                scale.rpm(step.value_rpm) for step in case.scenario.speed]
            assert [step.torque_Nm for step in scaled.scenario.load] == [
                scale.Nm(step.torque_Nm) for step in case.scenario.load]
            assert scaled.scenario.record.from_s <= scaled.scenario.duration_s


def test_speeds_are_near_and_far_from_ratios_of_counts_with_all_resolutions_and_rates():
    cases = all_cases()["every_speed"]
    assert len(cases) == 2016 and len({case.scenario.machine for case in cases}) == 8
    assert {case.scenario.encoder_bits for case in cases} == set(range(10, 19))
    assert {case.scenario.control_rate_hz for case in cases} == {20_000, 40_000, 50_000, 100_000}
    beats_hz = []
    of_machine = {machine: derive(load_machine(machine_path(machine)))
                  for machine in {case.scenario.machine for case in cases}}
    for case in cases:
        scenario = case.scenario
        data = of_machine[scenario.machine]
        speed_rpm = scenario.speed[0].value_rpm
        assert 0.015 * data.speed_base_rpm <= speed_rpm <= 1.0001 * data.speed_base_rpm
        assert scenario.load[0].torque_Nm == pytest.approx(0.5 * data.torque_rated_Nm)
        counts = speed_rpm / 60.0 * 2**scenario.encoder_bits / scenario.control_rate_hz
        beats_hz.append(min(abs(q * counts - max(1, round(q * counts))) for q in (1, 2, 3, 4, 5))
                        * scenario.control_rate_hz)
    assert 0.3 < np.mean(np.array(beats_hz) < 1000.0) < 0.6


def test_the_worst_runs_are_named_and_the_spread_is_relative_to_the_median():
    runs = [run_metrics("salient", sample, group="speeds", ripple_step=value)
            for sample, value in (("a", 0.01), ("b", 0.03), ("c", 0.02))]
    (spread,) = (row for row in table.make_rows(runs) if row.key[3] == "spread")
    assert spread.values["salient"] == pytest.approx(1.5)
    assert spread.label == "max. over median of K_t from 20 ms after a load step"
    assert [line.split()[-1] for line in table.worst(runs)[1:]] == ["b", "c", "a"]
    assert table.worst([run_metrics()]) == []


def test_another_machine_has_its_own_runs_among_machines_of_all_sizes():
    path = EXAMPLES / "mill.toml"
    cases = cases_of(all_cases()["machines"], subject(str(path)))
    assert cases == [case for case in all_cases()["machines"] if case.condition.split(",")[0] == "mill"]
    assert [case.controller for case in cases[:3]] == ["traditional", "paper", "salient"]
    assert {case.extractor for case in cases[3:]} == {"held"} and len(cases) == 3 + 2 * 4


@pytest.mark.parametrize("group", [group for group in speed_range.GROUPS if not group.startswith("copper")])
def test_another_machine_has_its_own_speeds_and_torques_over_the_range_of_speeds(group):
    on = subject(str(EXAMPLES / "fan12.toml"))
    data = derive(on.machine)
    cases = cases_of(all_cases()[group], on)
    assert {case.condition.split(",")[0] for case in cases} == {"fan12"}
    assert {case.scenario.machine for case in cases} == {on.path}
    speeds_rpm = [case.scenario.bench.get("held_speed_rpm", 0.0) for case in cases]
    speeds_rpm += [step.value_rpm for case in cases for step in case.scenario.speed]
    assert 0.99 * 1.5 * data.speed_base_rpm < max(speeds_rpm) <= data.speed_max_rpm
    torques_Nm = [step.value_Nm for case in cases for step in case.scenario.torque]
    assert all(abs(torque_Nm) <= case.scenario.parameters["torque_max_Nm"]
               for case, torque_Nm in zip(cases, torques_Nm, strict=False))
    assert len(cases_of(GROUPS[group].cases(True), on, quick=True)) <= len(cases)


def test_another_machine_is_judged_by_relative_targets_only_and_a_bundled_one_by_its_own(tmp_path):
    on = subject(str(EXAMPLES / "fan12.toml"))
    targets = targets_of(on)
    conditions = {(case.group, case.condition) for of in all_cases().values() for case in cases_of(of, on)}
    assert targets and {key[:2] for key in targets} <= conditions
    assert {key[0] for key in targets} == {"inertia", "encoders", "misalignment", "standing_error", "mismatch"}
    limits = {key[:1] + key[2:]: target.limit for key, target in TARGETS.items()}
    for key, target in targets.items():
        if key[0] != "standing_error":
            assert target.limit == limits[key[:1] + key[2:]]
    slowest = min(target.limit for key, target in targets.items() if key[0] == "standing_error")
    assert slowest == pytest.approx(0.02 * on.scale.speed)
    impostor = tmp_path / "saturating.toml"
    impostor.write_text((EXAMPLES / "fan12.toml").read_text().replace('"fan12"', '"saturating"', 1))
    assert not subject(str(impostor)).is_bundled
    assert subject("finite_element").is_bundled


def test_file_of_a_failed_run_has_no_slash_of_a_unit_in_its_name(tmp_path):
    scenario = replace(start_scenario(controller="paper"), duration_s=0.01)
    case = Case("speeds", "saturating, 600 r/min", "paper", "start", scenario)
    ((_, path),) = command._write_failed(tmp_path, [RunMetrics(case, {}, "fault over_speed")])
    assert path.parent == tmp_path and path.name == "speeds_saturating_600_r_min_paper.toml"
    assert load_scenarios(path) == [replace(scenario, name=path.stem)]


def test_peak_current_is_judged_in_proportion_to_that_of_the_machine():
    limit_A = peak_current_max_A(load_machine(EXAMPLES / "fan12.toml"))
    assert limit_A == pytest.approx(12.6, rel=0.01)
    assert peak_current_max_A(load_machine(machine_path("saturating"))) == pytest.approx(90.0)
    assert failures({"peak_current_A": 0.99 * limit_A}, limit_A) == []
    assert len(failures({"peak_current_A": 1.01 * limit_A}, limit_A)) == 1


def test_summary_counts_runs_and_failures_of_a_commit(tmp_path):
    runs = [run_metrics(group="robustness", condition="random drives", sample=f"drive {number:03}",
                        failed="fault encoder" if number == 1 else "") for number in range(3)]
    summary_file.write(tmp_path / "summary.toml", runs, "tools/salient compare robustness")
    summary = tomllib.loads((tmp_path / "summary.toml").read_text())
    assert summary["command"] == "tools/salient compare robustness"
    assert re.fullmatch("[0-9a-f]{7,}(-dirty)?|unknown", summary["commit"])
    assert summary["study"] == [{
        "group": "robustness", "condition": "random drives", "controller": "paper", "first": "drive 000",
        "last": "drive 002", "runs": 3, "failed": 1, "failures": ["drive 001: fault encoder"]}]


def test_samples_are_the_first_ones_of_each_condition():
    kept = command._first_samples(all_cases()["robustness"], 3)
    assert {case.sample for case in kept} == {f"drive 00{n}" for n in range(3)} | {f"load 0{n}" for n in range(3)}
    assert len(kept) == 3 * 6
    assert command._first_samples(all_cases()["robustness"], None) == all_cases()["robustness"]


def test_identical_runs_are_executed_once(tmp_path):
    progress = io.StringIO()
    case = Case("start", "saturating", "paper", "start", replace(start_scenario(controller="paper"), duration_s=0.01))
    first, second = run_all([case, replace(case, condition="again")], 2, progress, tmp_path)
    assert first.metrics == second.metrics and second.case.condition == "again"
    assert progress.getvalue().startswith("1/1 start: ") and progress.getvalue().count("\n") == 1


def test_each_limit_of_the_robustness_study_fails_a_drive():
    good = {"settling_time_s": 0.1, "speed_error_percent": 0.1, "peak_current_A": 60.0, "highest_speed_percent": 101.0,
            "cycle_percent": 0.1}
    assert failures(good) == []
    beyond = {"settling_time_s": None, "speed_error_percent": 0.51, "peak_current_A": 90.1,
              "highest_speed_percent": 105.1, "cycle_percent": 1.01}
    for name, value in beyond.items():
        assert len(failures(good | {name: value})) == 1
    assert len(failures(beyond)) == 5


# --- table ----------------------------------------------------------------------------------------------------------

def test_rows_have_median_and_maximum_and_a_missing_event_sorts_above_all():
    runs = [run_metrics(group="dip", condition="saturating, 17 bits", sample=f"angle {number}", speed_dip_rpm=dip,
                        recovery_time_s=recovery_s)
                for number, (dip, recovery_s) in enumerate([(1.0, 0.001), (2.0, None), (4.0, 0.003)])]
    rows = {row.key[2:]: row for row in table.make_rows(runs)}
    assert rows["speed_dip_rpm", "median"].values == {"paper": 2.0}
    assert rows["speed_dip_rpm", "worst"].values == {"paper": 4.0}
    assert rows["recovery_time_s", "median"].values == {"paper": 0.003}
    lines = table.table(list(rows.values())).splitlines()
    assert re.fullmatch(r" +median recovery time to 0.5 %, ms +3\.00 +370 / 1", lines[5])


def test_widest_gap_between_angles_wraps_around_the_stroke():
    runs = [run_metrics(group="dip", condition="saturating, 17 bits", sample=str(angle), step_angle_deg=angle)
                for angle in (29.0, 6.0, 12.0, 18.0)]
    (row,) = table.make_rows(runs)
    assert row.values == {"paper": 11.0}


def test_failed_runs_are_counted_and_marked_by_an_asterisk():
    runs = [run_metrics(group="dip", condition="saturating, 17 bits", sample="a", speed_dip_rpm=1.0),
                run_metrics(group="dip", condition="saturating, 17 bits", sample="b", failed="fault over_current")]
    row = table.make_rows(runs)[0]
    assert row.values == {"paper": 1.0} and row.failed == {"paper": "1 of 2: fault over_current"}
    text = table.table([row])
    assert "1.00*" in text and "paper: 1 of 2: fault over_current" in text


@pytest.mark.parametrize(("values", "failed", "reached"), [
    ({"paper": 1.0}, {}, True),
    ({"paper": 1.0001}, {}, False),
    ({"paper": None}, {}, False),
    ({}, {"paper": "fault"}, False),
    ({"paper": 0.5}, {"paper": "1 of 2: fault"}, False),
    ({"traditional": 0.5}, {}, None),
])  # fmt: skip
def test_target_is_reached_only_if_all_runs_of_its_controller_comply(values, failed, reached):
    row = table.Row(("start", "saturating", "overshoot_percent", ""), values, failed, Target(1.0, "paper"))
    assert row.reached is reached


def test_target_is_not_judged_on_fewer_samples_than_it_is_defined_over():
    target = Target(1.0, "paper", samples=24, sample_unit="angles")
    key = ("dip", "saturating, 17 bits", "speed_dip_rpm", "median")
    few, all_angles = (table.Row(key, {"paper": 1.21}, {}, target, samples) for samples in (6, 24))
    assert few.reached is None and all_angles.reached is False
    assert table.status(few) == "not judged (6 of 24 angles)"
    assert "1.21" in table.table([few]) and "NOT REACHED" not in table.table([few])
    assert table.summary([few, all_angles]) == "0 of 1 targets reached, 1 not judged (too few samples)"


def test_missed_target_is_shown_with_its_reason():
    row = table.Row(("start", "saturating", "overshoot_percent", ""), {"paper": 2.0}, {},
                   Target(1.0, "paper", reason="The observer lags."))
    text = table.table([row])
    assert "NOT REACHED" in text and "The observer lags." in text
    assert table.summary([row]) == "0 of 1 targets reached"


# --- baseline ------------------------------------------------------------------------------------------------------

KEY = ("dip", "saturating, 17 bits", "speed_dip_rpm", "median")


def change_of(before, now, beyond_percent=5.0, before_failed=None, now_failed=None, key=KEY):
    """The change from one value of the paper's controller to another, None for none."""
    def row(value, failed):
        values = {} if value == "none" else {"paper": value}
        return table.Row(key, values, {"paper": failed} if failed else {}, Target())

    old = results_file.content([row(before, before_failed)], [], False)
    found, both = baseline.changes([row(now, now_failed)], old, beyond_percent)
    assert both == 1
    return found[0] if found else None


def test_change_within_the_threshold_or_the_resolution_is_ignored():
    assert change_of(2.0, 2.099) is None
    assert change_of(2.0, 1.901) is None
    assert change_of(0.1, 0.119) is None  # 19 %, but 0.02 r/min
    assert change_of(None, None) is None


def test_change_beyond_the_threshold_is_better_or_worse():
    worse, better = change_of(2.0, 2.11), change_of(2.0, 1.89)
    assert worse.worse and worse.percent == pytest.approx(5.5)
    assert not better.worse and better.percent == pytest.approx(-5.5)
    assert change_of(2.0, 2.11, beyond_percent=6.0) is None


def test_maximum_speed_is_judged_by_its_excess_over_the_reference():
    key = ("dip", "saturating, 17 bits", "speed_after_rpm", "worst")
    assert change_of(150.1, 150.2, key=key).excess_percent == pytest.approx(100.0, rel=1e-6)
    assert change_of(149.9, 150.0, key=key).excess_percent is None
    assert change_of(150.01, 150.05, key=key) is None


def test_reported_percentage_refers_to_the_same_metric_in_the_baseline():
    assert baseline.change_text(change_of(2.0, 2.5)).endswith(": median speed drop, r/min 2.00 -> 2.50 (+25.0 %)")
    key = ("dip", "saturating, 17 bits", "speed_after_rpm", "worst")
    change = change_of(150.1, 150.2, key=key)
    assert change.percent == pytest.approx(100.0 * 0.1 / 150.1)
    assert baseline.change_text(change).endswith(
        " 150.10 -> 150.20 (+0.07 %; +100.0 % of the excess over 150)")


def test_missing_event_and_fault_are_worse_than_any_value():
    assert change_of(2.0, None).worse and not change_of(None, 2.0).worse
    assert change_of(2.0, "none", now_failed="fault").worse
    assert not change_of("none", 9.0, before_failed="fault").worse
    assert change_of("none", "none", before_failed="fault", now_failed="fault") is None


@pytest.mark.in_turns
def test_same_drive_has_no_change_and_a_modified_baseline_is_detected(start_folder, tmp_path):
    folder, _ = start_folder
    code, output = compare("start", "--quick", "--jobs", 1, "--out", tmp_path / "again", "--baseline", folder)
    assert code == 0
    metrics = 2 * len(CONTROLLERS)
    assert f"0 worse, 0 better, {metrics} of {metrics} metrics unchanged (within 10 %)" in output
    # Equal bytes, independent of the number of jobs.
    assert (tmp_path / "again/compare.json").read_bytes() == (folder / "compare.json").read_bytes()

    modified = json.loads((folder / "compare.json").read_text())
    for row in modified["rows"]:
        if row["figure"] == "settling_time_s":
            row["values"]["paper"] *= 0.9
            row["values"]["traditional"] *= 1.2
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps(modified))
    code, output = compare("start", "--quick", "--out", tmp_path / "worse", "--baseline", earlier)
    assert code == 1
    assert f"1 worse, 1 better, {metrics - 2} of {metrics} metrics unchanged (within 10 %)" in output
    assert re.search(r"WORSE  start, saturating, paper: settling time .* 0\.06\d\d\d -> 0\.06\d\d\d \(\+11\.1 %\)",
                     output)
    assert re.search(r"better  start, saturating, traditional: .* \(-16\.7 %\)", output)
    page = (tmp_path / "worse/compare.html").read_text(encoding="utf-8")
    assert "WORSE  start" in page and page.count("data:image/png;base64,") == 1
    code, _ = compare("start", "--quick", "--out", tmp_path / "lenient", "--baseline", earlier, "--worse-percent", 20)
    assert code == 0


@pytest.mark.parametrize(("content", "expected_text"), [
    (None, "no such file"),
    ("{", "not JSON"),
    ("[]", "schema 1"),
    ('{"schema": 2, "rows": []}', "schema 1"),
    ('{"schema": 1, "quick": true, "rows": []}', "made with --quick"),
    ('{"schema": 1, "quick": false, "rows": [1]}', "schema 1: rows.0"),
    ('{"schema": 1, "quick": false, "rows": [{"group": "start"}]}', "schema 1: rows.0.condition"),
    ('{"schema": 1, "quick": false, "rows": [{"group": "start", "condition": "a", "figure": "b", "statistic": "",'
     ' "values": {"paper": "1"}, "failed": {}}]}', "schema 1: rows.0.values.paper"),
])  # fmt: skip
def test_invalid_baseline_is_reported(tmp_path, content, expected_text):
    path = tmp_path / "earlier.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UsageError, match=f"--baseline .*earlier.json: .*{expected_text}"):
        compare("start", "--out", tmp_path / "out", "--baseline", path)
    assert not (tmp_path / "out").exists()


# --- output files --------------------------------------------------------------------------------------------------

def test_metrics_of_a_start_are_those_of_the_drive(start_folder):
    folder, output = start_folder
    content = json.loads((folder / "compare.json").read_text())
    assert content["quick"] is True
    values = {row["figure"]: row["values"] for row in content["rows"]}
    assert 0.0677 < values["settling_time_s"]["paper"] < 0.0697
    assert 0.0677 < values["settling_time_s"]["traditional"] < 0.0720
    assert 0.0 <= values["overshoot_percent"]["paper"] < 0.05
    assert 0.1 < values["overshoot_percent"]["traditional"] < 0.3
    assert "0.18 / 0.07" in output
    assert [run["controller"] for run in content["runs"]] == list(CONTROLLERS)


@pytest.mark.in_turns
def test_page_is_complete_and_self_contained(tmp_path):
    # One plot of each kind, from short runs.
    code, output = compare("ripple", "speeds", "--quick", "--out", tmp_path)
    assert code == 0 and "compare.html" in output
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    shown = re.findall('src="data:image/png;base64,([^"]*)"', page)
    assert len(shown) == 3 == page.count("<img")
    files = [tmp_path / "plots" / name for name in ("ripple.png", "ripple_2.png", "speeds.png")]
    assert [base64.b64encode(path.read_bytes()).decode() for path in files] == shown
    assert sorted(files) == sorted((tmp_path / "plots").iterdir())
    assert not re.search(r"https?://|<script|<link", page)
    for case in (*GROUPS["ripple"].cases(True), *GROUPS["speeds"].cases(True)):
        assert case.condition in page
    content = json.loads((tmp_path / "compare.json").read_text())
    ripple = {row["condition"]: row["values"] for row in content["rows"] if row["figure"] == "ripple"}
    assert 0.5 < ripple["saturating, 40 kHz, one pulse"]["traditional"] < 1.0
    assert 0.01 < ripple["saturating, 40 kHz, one pulse"]["paper"] < 0.03
    traces = {(trace["controller"], trace["condition"]): trace for trace in content["traces"]}
    torque_Nm = np.array(traces["paper", "saturating, 40 kHz, one pulse"]["torque_Nm"])
    assert np.ptp(torque_Nm) / 8.314 == pytest.approx(ripple["saturating, 40 kHz, one pulse"]["paper"], rel=0.01)


@pytest.mark.in_turns
def test_studies_have_plots_and_quick_targets_are_not_judged(tmp_path):
    code, output = compare("dip", "robustness", "--quick", "--out", tmp_path)
    assert code == 0
    assert "not judged (6 of 24 angles)" in output and "not judged (10 of 500 drives)" in output
    assert "not judged (4 of 20 loads)" in output
    assert "REACHED" not in output and "0 of 0 targets reached, " in output
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 2 and "not judged (6 of 24 angles)" in page
    content = json.loads((tmp_path / "compare.json").read_text())
    values = {(row["group"], row["figure"], row["statistic"]): row["values"] for row in content["rows"]
              if row["condition"] != "random machines, speeds and loads"}
    assert all(row["reached"] is None for row in content["rows"])
    # Six load steps over a stroke of 30 degrees.
    assert 5.0 <= values["dip", "step_angle_deg", "gap"]["paper"] < 5.3
    assert 0.0 <= values["robustness", "failed", "count"]["paper"] <= 10.0
    assert 40.0 < values["robustness", "peak_current_A", "worst"]["paper"] < 90.0


@pytest.mark.in_turns
def test_drive_follows_moving_loads(tmp_path):
    code, output = compare("moving", "ramps", "--quick", "--out", tmp_path)
    assert code == 0 and "6 of 6 targets reached" in output
    content = json.loads((tmp_path / "compare.json").read_text())
    values = {row["condition"]: row["values"] for row in content["rows"] if row["figure"] != "swing_of_free"}
    for condition, controller, low_rpm, high_rpm in (
        ("saturating, 150 r/min, 5 Hz", "salient", 0.3, 0.7), ("saturating, 150 r/min, 5 Hz", "paper", 0.4, 0.8),
        ("saturating, 150 r/min, 20 Hz", "traditional", 9.0, 13.0), ("saturating, 20 ms", "salient", 0.6, 1.2),
        ("finite_element, 20 ms", "paper", 1.7, 3.0), ("finite_element, 200 ms", "salient", 0.4, 0.76)):
        assert low_rpm < values[condition][controller] < high_rpm


@pytest.mark.in_turns
def test_ranges_have_figures_and_plots(tmp_path):
    code, output = compare("inertia", "rates", "encoders", "misalignment", "standing_error", "hold", "--quick",
                           "--out", tmp_path)
    assert code == 0 and "13 of 13 targets reached, 16 not judged" in output
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 6
    content = json.loads((tmp_path / "compare.json").read_text())
    values = {(row["condition"], row["figure"]): row["values"].get("salient") for row in content["rows"]}
    for row, low, high in (
        (("saturating, inertia x 0.33", "recovery_ratio"), 1.0, 2.0),
        (("saturating, inertia x 0.33", "swing_percent"), 0.005, 0.1),
        (("saturating, 20 kHz", "ripple"), 0.006, 0.015), (("saturating, 100 kHz", "speed_dip_rpm"), 1.0, 3.0),
        (("saturating, 17 bits, 10 r/min", "speed_dip_rpm"), 2.0, 4.5),
        (("saturating, 17 bits, 600 r/min", "against_periods"), -0.1, 2.0),
        (("saturating, 600 r/min, 0.5 deg", "ripple_6s_ratio"), 0.9, 1.3),
        (("saturating, 600 r/min, 8 N m", "mean_error_rpm"), -0.1, 0.005),
        (("saturating, 8 N m", "drift_deg"), 0.0, 0.02)):
        assert low < values[row] < high, row


def test_groups_are_listed():
    code, output = compare("--list")
    assert code == 0
    assert [line.split()[0] for line in output.splitlines()] == list(GROUPS)
    assert [line.split()[0] for line in output.splitlines() if "only when named" in line] == [
        "every_speed", "torque_speed_random", "partial_torque", "copper_random", "transition", "torque_conditions",
        "encoders", "misalignment", "standing_error", "hold", "mismatch", "robustness", "machines"]


def test_unknown_group_is_reported():
    with pytest.raises(UsageError, match="unknown group dips: the nearest of .* are dip, .*--list"):
        compare("dips")


@pytest.mark.parametrize(("line", "expected_text"), [
    (("--jobs", "0"), "--jobs 0: must be a whole number from 1"),
    (("--worse-percent", "much"), "--worse-percent much: must be a number from 0"),
])  # fmt: skip
def test_invalid_option_is_reported(line, expected_text, capsys):
    with pytest.raises(SystemExit, match="2"):
        compare(*line)
    assert expected_text in capsys.readouterr().err


def test_unwritable_folder_is_reported_before_anything_runs(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="--out .*: cannot write there"):
        compare("start", "--out", tmp_path / "file" / "out")


def test_every_metric_of_a_row_has_a_label():
    for group in GROUPS.values():
        for metric, _ in group.columns:
            assert METRICS[metric].label


def test_a_worker_with_another_build_ends_the_comparison():
    with pytest.raises(RunFailed, match="a worker has another build of the drive than this computer"):
        _run((all_cases()["dip"][0], "digest of another build"))
