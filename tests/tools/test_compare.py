"""salient compare: its runs, its table, and the comparison with a baseline."""

import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from salient.cli import make_parser
from salient.config import CONTROLLERS
from salient.errors import UsageError
from salient.experiments.compare import baseline, cases, command, results_file, table
from salient.experiments.compare.cases import GROUPS, Case, random_drive, scenario_toml, start_scenario
from salient.experiments.compare.metrics import METRICS, failures
from salient.experiments.compare.runner import RunMetrics, run_all
from salient.experiments.compare.targets import TARGETS, Target
from salient.experiments.scenario import load_scenarios

ALL_CASES = {name: list(group.cases(False)) for name, group in GROUPS.items()}


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
    conditions = {(case.group, case.condition) for of in ALL_CASES.values() for case in of}
    for group, condition, metric, statistic in TARGETS:
        assert (group, condition) in conditions
        assert (metric, statistic) in GROUPS[group].columns


def test_every_controller_runs_in_every_group_that_it_supports():
    for name, of in ALL_CASES.items():
        expected = {"paper_conditions": {"traditional", "paper"}, "ablation": set(CONTROLLERS) - {"traditional"}}
        assert {case.controller for case in of} == expected.get(name, set(CONTROLLERS))


def test_quick_runs_are_a_subset_of_the_conditions():
    for name, group in GROUPS.items():
        quick = list(group.cases(True))
        assert 0 < len(quick) < len(ALL_CASES[name])
        assert {case.condition for case in quick} <= {case.condition for case in ALL_CASES[name]}


def test_load_steps_are_equally_spaced_over_one_stroke():
    steps_s = sorted({case.scenario.load[0].at_s for case in ALL_CASES["dip"]})
    assert len(steps_s) == 24
    assert np.diff(steps_s) * 6.0 * 150.0 == pytest.approx(30.0 / 24)


def test_moving_loads_are_judged_over_two_periods_after_the_transient():
    for case in ALL_CASES["moving"]:
        scenario = case.scenario
        period_s = 1.0 / scenario.bench["load_sine_frequency_Hz"]
        window_s = scenario.duration_s - scenario.record.from_s
        assert window_s == pytest.approx(max(0.15, 2.0 * period_s))
        assert scenario.record.from_s - scenario.load[0].at_s >= max(0.3, period_s) - 1e-6
        assert scenario.load[0].at_s >= 0.2 + scenario.speed[0].value_rpm / 5000.0 - 1e-9


def test_ramps_have_their_lengths():
    for case in ALL_CASES["ramps"]:
        ramp_s = case.scenario.load[0].torque_Nm / case.scenario.bench["load_ramp_Nm_s"]
        assert case.condition.endswith(f", {ramp_s * 1000:g} ms")
        assert case.scenario.duration_s == pytest.approx(case.scenario.load[0].at_s + ramp_s + 0.3)


def test_random_drives_cover_their_ranges_and_are_reproducible():
    drives = [random_drive(number) for number in range(cases.DRIVES)]
    assert drives[:5] == [random_drive(number) for number in range(5)]
    assert {drive.encoder_bits for drive in drives} == set(range(14, 21))
    for name, low, high in (("flux_linkage_gain", 0.9, 1.1), ("resistance_gain", 0.8, 1.5), ("inertia_gain", 0.5, 3.0),
                            ("friction_gain", 0.0, 5.0), ("supply_voltage_V", 200.0, 280.0),
                            ("encoder_offset_deg", -0.1, 0.1), ("current_noise_A", 0.0, 0.04)):
        values = [drive.bench[name] for drive in drives]
        assert low - 1e-6 <= min(values) < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < max(values) <= high + 1e-6


@pytest.mark.parametrize("group", GROUPS)
def test_written_scenario_equals_the_one_that_ran(group, tmp_path):
    for case in ALL_CASES[group][:: max(1, len(ALL_CASES[group]) // 20)]:
        path = tmp_path / "compare.toml"
        path.write_text(scenario_toml(case))
        assert load_scenarios(path) == [case.scenario]


def test_run_that_ends_in_a_fault_is_reported_and_reproducible(tmp_path):
    scenario = replace(start_scenario(controller="paper"), duration_s=0.1, parameters={"over_speed_rpm": 300.0})
    case = Case("start", "saturating", "paper", "start", scenario)
    (run,) = run_all([case], 1, io.StringIO())
    assert (run.metrics, run.failed) == ({}, "fault over_speed")
    (row, *_) = table.make_rows([run])
    assert row.failed == {"paper": "fault over_speed"} and row.values == {}
    assert "paper: fault over_speed" in table.table([row])
    ((_, path),) = command._write_failed(tmp_path, [run])
    assert path.name == "start_saturating_paper.toml"
    assert load_scenarios(path) == [replace(scenario, name=path.stem)]


def test_identical_runs_are_executed_once():
    progress = io.StringIO()
    case = Case("start", "saturating", "paper", "start", replace(start_scenario(controller="paper"), duration_s=0.01))
    first, second = run_all([case, replace(case, condition="again")], 2, progress)
    assert first.metrics == second.metrics and second.case.condition == "again"
    assert progress.getvalue() == "1/1 start: saturating by paper\n"


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
    (None, "No such file"),
    ("{", "not JSON"),
    ("[]", "schema 1"),
    ('{"schema": 2, "rows": []}', "schema 1"),
    ('{"schema": 1, "quick": true, "rows": []}', "made with --quick"),
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


def test_page_is_complete_and_self_contained(tmp_path):
    # One plot of each kind, from short runs.
    code, output = compare("ripple", "speeds", "--quick", "--out", tmp_path)
    assert code == 0 and "compare.html" in output
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 3 == page.count("<img")
    assert not re.search(r"https?://|<script|<link", page)
    for case in (*GROUPS["ripple"].cases(True), *GROUPS["speeds"].cases(True)):
        assert case.condition in page
    content = json.loads((tmp_path / "compare.json").read_text())
    ripple = {row["condition"]: row["values"] for row in content["rows"] if row["figure"] == "ripple"}
    assert 0.5 < ripple["saturating, 40 kHz, one pulse"]["traditional"] < 1.0
    assert 0.04 < ripple["saturating, 40 kHz, one pulse"]["paper"] < 0.08
    traces = {(trace["controller"], trace["condition"]): trace for trace in content["traces"]}
    torque_Nm = np.array(traces["paper", "saturating, 40 kHz, one pulse"]["torque_Nm"])
    assert np.ptp(torque_Nm) / 8.314 == pytest.approx(ripple["saturating, 40 kHz, one pulse"]["paper"], rel=0.01)


def test_studies_have_plots_and_quick_targets_are_not_judged(tmp_path):
    code, output = compare("dip", "ablation", "robustness", "--quick", "--out", tmp_path)
    assert code == 0
    assert "not judged (6 of 24 angles)" in output and "not judged (10 of 500 drives)" in output
    assert "REACHED" not in output and "0 of 0 targets reached, " in output
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 3 and "not judged (6 of 24 angles)" in page
    content = json.loads((tmp_path / "compare.json").read_text())
    values = {(row["group"], row["figure"], row["statistic"]): row["values"] for row in content["rows"]
              if row["group"] != "ablation"}
    assert all(row["reached"] is None for row in content["rows"])
    # Six load steps over a stroke of 30 degrees.
    assert 5.0 <= values["dip", "step_angle_deg", "gap"]["paper"] < 5.3
    assert 0.0 <= values["robustness", "failed", "count"]["paper"] <= 10.0
    assert 40.0 < values["robustness", "peak_current_A", "worst"]["paper"] < 90.0


def test_drive_follows_moving_loads(tmp_path):
    code, output = compare("moving", "ramps", "--quick", "--out", tmp_path)
    assert code == 0 and "6 of 6 targets reached" in output
    content = json.loads((tmp_path / "compare.json").read_text())
    values = {row["condition"]: row["values"] for row in content["rows"]}
    for condition, controller, low_rpm, high_rpm in (
        ("saturating, 150 r/min, 5 Hz", "salient", 0.3, 0.7), ("saturating, 150 r/min, 5 Hz", "paper", 0.6, 0.9),
        ("saturating, 150 r/min, 20 Hz", "traditional", 9.0, 13.0), ("saturating, 20 ms", "salient", 0.3, 0.8),
        ("finite_element, 20 ms", "paper", 4.5, 6.5), ("finite_element, 200 ms", "salient", 0.3, 0.6)):
        assert low_rpm < values[condition][controller] < high_rpm


def test_groups_are_listed():
    code, output = compare("--list")
    assert code == 0
    assert [line.split()[0] for line in output.splitlines()] == list(GROUPS)
    assert [line.split()[0] for line in output.splitlines() if "only when named" in line] == [
        "ablation", "robustness", "machines"]


def test_unknown_group_is_reported():
    with pytest.raises(UsageError, match="unknown group dips: must be one of ripple, speeds"):
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
