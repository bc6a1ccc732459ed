"""compare mismatch: its wrong machine files, and that they are the firmware's while the motor is the right one."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from salient.cli import make_parser
from salient.errors import UsageError
from salient.experiments.compare import command, mismatch, table
from salient.experiments.compare.case import MACHINES, Case, make_scenario
from salient.experiments.compare.cases import GROUPS
from salient.experiments.compare.every_machine import EXAMPLES
from salient.experiments.compare.machine import subject, targets_of
from salient.experiments.compare.runner import RunMetrics, _with_ratios, run_all
from salient.experiments.compare.wrong_files import DRAWS, FAULTS, Fault, every_fault, random_fault, wrong_file
from salient.experiments.scenario import LoadStep, Record, SpeedStep, run_scenario
from salient.machine.definition import MachineError
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.toml_file import read_toml, toml_text

HERE_A = np.linspace(0.5, 60.0, 50)
OF_FILE = {"resistance": ("winding", "resistance_ohm"), "inertia": ("mechanics", "inertia_kg_m2"),
           "friction": ("mechanics", "friction_Nm_s")}


def compare(*line):
    """Returns exit code and output."""
    output = io.StringIO()
    code = command.run(make_parser().parse_args(["compare", *map(str, line)]), stream=output)
    return code, output.getvalue()


def magnetics(folder: Path, machine: str, fault: Fault):
    """Magnetics of the right and of the wrong file, and angles from aligned to unaligned."""
    path = wrong_file(machine_path(machine), fault, "some error", folder)
    right, wrong = load_machine(machine_path(machine)).magnetics, load_machine(path).magnetics
    assert wrong.form == right.form
    return right, wrong, np.linspace(0.0, right.pitch_rad / 2.0, 60)[:, None]


# --- files ----------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_flux_linkage_above_that_of_the_unaligned_rotor_and_torque_have_the_factor(tmp_path, machine, factor):
    right, wrong, angle_rad = magnetics(tmp_path, machine, Fault(flux=factor))
    unaligned_Wb = right.flux_linkage_Wb(right.pitch_rad / 2.0, HERE_A)
    excess_Wb = right.flux_linkage_Wb(angle_rad, HERE_A) - unaligned_Wb
    assert wrong.flux_linkage_Wb(angle_rad, HERE_A) - unaligned_Wb == pytest.approx(factor * excess_Wb, abs=1e-6)
    torque_Nm = right.torque_Nm(-angle_rad, HERE_A)
    assert np.abs(torque_Nm).max() > 20.0
    assert wrong.torque_Nm(-angle_rad, HERE_A) == pytest.approx(factor * torque_Nm, abs=1e-4)


@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_saturation_moves_along_the_inductance_of_weak_fields(tmp_path, machine, factor):
    right, wrong, angle_rad = magnetics(tmp_path, machine, Fault(saturation=factor))
    flux_Wb = right.flux_linkage_Wb(angle_rad, HERE_A)
    assert wrong.flux_linkage_Wb(angle_rad, factor * HERE_A) == pytest.approx(factor * flux_Wb, abs=1e-6)


@pytest.mark.parametrize("machine", MACHINES)
def test_unaligned_inductance_changes_nothing_of_aligned_poles(tmp_path, machine):
    right, wrong, angle_rad = magnetics(tmp_path, machine, Fault(unaligned=0.9))
    aligned, unaligned = (
        [of.flux_linkage_Wb(at_rad, HERE_A) for of in (right, wrong)] for at_rad in (0.0, right.pitch_rad / 2.0))
    assert aligned[1] == pytest.approx(aligned[0], abs=1e-6)
    assert unaligned[1] == pytest.approx(0.9 * unaligned[0], abs=1e-6)
    between = [of.flux_linkage_Wb(angle_rad, HERE_A) for of in (right, wrong)]
    assert np.all(between[1] <= between[0] + 1e-6)


@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
@pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if not fault.in_magnetics and fault.in_file])
def test_nothing_but_the_stated_value_differs(tmp_path, machine, name):
    right = machine_path(machine)
    path = wrong_file(right, FAULTS[name], name, tmp_path)
    before, after = read_toml(right), read_toml(path)
    ((key, factor),) = ((key, value) for key, value in vars(FAULTS[name]).items() if value != getattr(Fault(), key))
    table_of, value = OF_FILE[key]
    assert after[table_of].pop(value) == pytest.approx(factor * before[table_of].pop(value))
    assert after.pop("name") != before.pop("name")
    if before["magnetics"]["form"] == "map":
        maps = [folder / of["magnetics"].pop("file") for folder, of in ((right.parent, before), (tmp_path, after))]
        assert maps[0].read_text() == maps[1].read_text()
    assert after == before


def test_random_samples_are_reproducible_and_within_the_range_of_the_single_errors():
    samples = [random_fault(number) for number in range(300)]
    assert samples[:9] == [random_fault(number) for number in range(9)]
    for key, low, high in (("flux", 0.8, 1.2), ("saturation", 0.8, 1.25), ("unaligned", 0.9, 1.1),
                           ("resistance", 0.7, 1.3), ("inertia", 0.5, 2.0), ("friction", 0.2, 5.0),
                           ("angle_deg", -1.0, 1.0)):
        values = [getattr(sample, key) for sample in samples]
        assert low <= min(values) < low + 0.05 * (high - low) and high - 0.05 * (high - low) < max(values) <= high
    assert len(every_fault()) == len(FAULTS) + DRAWS


def test_written_tables_are_those_that_are_read(tmp_path):
    data = {"a": 1, "b": 0.1 + 0.2, "c": 'x"y', "d": True, "t": {"u": 1e-7, "v": {"w": "é"}}, "empty": {}}
    path = tmp_path / "some.toml"
    path.write_text(toml_text(data), encoding="utf-8")
    assert read_toml(path) == data


def test_an_error_that_a_machine_cannot_have_is_left_out_and_named(tmp_path, monkeypatch):
    """A saturated inductance below a sixth of the unaligned one: 1.2 times the flux linkage has a negative one."""
    monkeypatch.setattr(mismatch, "FOLDER", tmp_path / "made")
    path = tmp_path / "deep.toml"
    path.write_text(machine_path("saturating").read_text().replace('"saturating"', '"deep"', 1).replace(
        "saturated_inductance_H = 0.15e-3", "saturated_inductance_H = 0.1e-3"))
    assert load_machine(path).magnetics.form == "saturating"
    with pytest.raises(MachineError, match=re.escape("magnetics.saturated_inductance_H")):
        wrong_file(path, FAULTS["flux linkage x 1.2"], "flux linkage x 1.2", tmp_path / "other")
    assert list((tmp_path / "other").iterdir()) == []
    conditions = {case.condition for case in mismatch.mismatch(False, (str(path),))}
    assert "deep, flux linkage x 1.1" in conditions and "deep, flux linkage x 1.2" not in conditions
    lines = mismatch.refused((str(path),))
    assert lines and lines[0].startswith("deep, flux linkage x 1.2: left out: ")
    assert "saturated_inductance_H" in lines[0] and "\n" not in lines[0]


# --- runs -----------------------------------------------------------------------------------------------------------

@pytest.mark.in_turns
def test_wrong_files_are_of_the_firmware_and_the_motor_is_the_right_one():
    cases = list(GROUPS["mismatch"].cases(False))
    conditions = {case.condition for case in cases}
    assert {condition.split(", ")[0] for condition in conditions} == set(MACHINES)
    assert not any("saturation" in condition for condition in conditions if condition.startswith("linear"))
    for case in cases:
        machine, name = case.condition.split(", ")
        assert (case.relative_to or case.condition) == f"{machine}, right file" and case.scenario.plant == machine
        fault = every_fault().get(name, Fault())
        assert case.scenario.bench.get("encoder_offset_deg", 0.0) == fault.angle_deg
        assert (Path(case.scenario.machine).parent.name == machine) is fault.in_file


def test_speeds_and_loads_are_those_of_the_right_machine():
    fan = list(mismatch.mismatch(False, (str(EXAMPLES / "fan12.toml"),)))
    on = subject(str(EXAMPLES / "fan12.toml"))
    for case in fan:
        assert {step.value_rpm for step in case.scenario.speed} <= {on.scale.rpm(150.0), on.scale.rpm(600.0)}
        assert {step.torque_Nm for step in case.scenario.load} <= {on.scale.Nm(8.0)}
    assert {key[1] for key in targets_of(on) if key[0] == "mismatch"} <= {case.condition for case in fan}


def step_case(condition: str, machine: str, true_machine: str | None) -> Case:
    """A load step, by `salient`."""
    scenario = make_scenario(machine=machine, true_machine=true_machine, controller="salient", duration_s=0.3,
                             speed=(SpeedStep(0.0, 150.0),), load=(LoadStep(0.13, 8.0),), record=Record(1.0, 0.13))
    return Case("mismatch", condition, "salient", "mismatch_step", scenario, relative_to="saturating, right file")


def test_drop_is_that_of_the_motor_whatever_the_file_says(tmp_path):
    """Before the torque follows, the speed falls by load over inertia of the motor. A drive whose file has half of the
    motor's inertia takes the load for half, and loses most of what the heavier rotor gains; with twice the motor's in
    its file the drop is larger."""
    file = str(wrong_file(machine_path("saturating"), Fault(inertia=2.0), "inertia x 2", tmp_path))
    names = ("saturating, right file", "saturating, motor", "saturating, file")
    pairs = (("saturating", None), ("saturating", file), (file, "saturating"))
    cases = [step_case(name, *pair) for name, pair in zip(names, pairs, strict=True)]
    runs = run_all(cases, 2, io.StringIO(), tmp_path / "runs")
    assert [run.failed for run in runs] == ["", "", ""]
    right, motor, of_file = (run.metrics for run in runs)
    assert "dip_to_right" not in right
    assert motor["dip_to_right"] == pytest.approx(motor["speed_dip_rpm"] / right["speed_dip_rpm"])
    assert 0.8 < motor["dip_to_right"] < 0.97
    assert 1.1 < of_file["dip_to_right"] < 1.4
    fallen_rpm = []
    for number, case in enumerate(cases):
        result = run_scenario(replace(case.scenario, duration_s=0.131), tmp_path / str(number))
        speed_rpm = result.recording["speed_rpm"]
        fallen_rpm.append(float(speed_rpm[0] - speed_rpm[40]))
    expected_rpm = 8.0 / 0.02 * 40e-6 * 30.0 / np.pi
    assert fallen_rpm == pytest.approx([expected_rpm, 0.5 * expected_rpm, expected_rpm], rel=0.1)


def test_motor_makes_the_torque_that_the_file_leaves_out(tmp_path):
    """The file's torque is 0.8 times the motor's at every angle and current; the current is the file's."""
    cases = [case for case in GROUPS["mismatch"].cases(True)
             if case.extractor == "mismatch_held" and case.controller in {"paper", "salient"}]
    runs = run_all(cases, 2, io.StringIO(), tmp_path)
    for run in runs:
        if run.case.condition == "saturating, flux linkage x 0.8":
            assert run.metrics["torque_to_right"] == pytest.approx(1.0 / 0.8, rel=0.01)
            assert run.metrics["torque_error_percent"] == pytest.approx(25.0, abs=1.0)
            assert run.metrics["torque_error_2s_percent"] < 6.0  # learned meanwhile
        else:
            assert run.metrics["torque_error_percent"] < 1.0
    assert len(runs) == 6


def test_ratio_is_to_the_condition_that_a_run_is_relative_to():
    of_right = "saturating, right file"
    case = step_case(of_right, "saturating", None)
    runs = [RunMetrics(replace(case, condition=condition), {"ripple_step": value}, "")
            for condition, value in ((of_right, 0.01), ("saturating, a", 0.02), ("saturating, b", 0.005))]
    assert [run.metrics.get("ripple_step_to_right") for run in _with_ratios(runs)] == [None, 2.0, 0.5]
    failed = [RunMetrics(case, {}, "fault stall"), runs[1]]
    assert "ripple_step_to_right" not in _with_ratios(failed)[1].metrics
    rows = {row.key[1:3]: row for row in table.make_rows(_with_ratios(runs))}
    (row,) = (row for key, row in rows.items() if key == ("saturating, a", "ripple_step_to_right"))
    assert row.label == "K_t from 20 ms after a load step, of the right file's" and row.values == {"salient": 2.0}


@pytest.mark.parametrize(("options", "refusal"), [
    (("--machine", "saturating", "--true-machine", "linear_cosine"), "--true-machine linear_cosine: not with mismatch"),
    (("--true-machine", "linear_cosine"), "--true-machine linear_cosine: only with --machine"),
    (("--machine", "nonesuch"), "machine 'nonesuch': no such file"),
    (("--set", "torque_max_Nm=1,2"), "--set torque_max_Nm=1,2: must be one value"),
    (("--set", "torque_max_Nm=high"), "--set torque_max_Nm=high: must be NAME=VALUE"),
    (("--baseline", "nonesuch.json"), "--baseline nonesuch.json: no such file"),
])
def test_an_option_is_refused_before_a_case_or_its_files_are_made(monkeypatch, tmp_path, options, refusal):
    made = []
    monkeypatch.setitem(GROUPS, "mismatch", replace(GROUPS["mismatch"], cases=lambda quick: made.append(quick) or []))
    with pytest.raises(UsageError, match=re.escape(refusal)):
        compare("mismatch", *options, "--out", tmp_path / "out")
    assert made == [] and not (tmp_path / "out").exists()


def test_machine_files_of_a_folder_without_results_of_a_run_stay(monkeypatch, tmp_path):
    monkeypatch.setitem(GROUPS, "mismatch", replace(GROUPS["mismatch"], cases=lambda quick: []))
    kept = [tmp_path / "machines" / "mine" / "motor.toml", tmp_path / "failed" / "mine.toml"]
    for path in kept:
        path.parent.mkdir(parents=True)
        path.write_text("of the user")
    assert compare("mismatch", "--out", tmp_path)[0] == 0
    assert all(path.read_text() == "of the user" for path in kept)
    kept[1].write_text("of the run before")
    assert compare("mismatch", "--out", tmp_path)[0] == 0
    assert not kept[1].exists()  # beside the results of a run


@pytest.mark.in_turns
def test_quick_group_has_files_ratios_and_plots(tmp_path):
    code, output = compare("mismatch", "--quick", "--jobs", 2, "--out", tmp_path)
    assert code == 0
    files = sorted(path.name for path in (tmp_path / "machines" / "saturating").iterdir())
    assert files == ["saturating_flux_linkage_08.toml", "saturating_inertia_2.toml"]
    assert f"--machine {tmp_path}/machines/saturating/{files[0]} --true-machine saturating" in output
    assert "speed drop, of the right file's" in output and "NOT REACHED" not in output
    page = (tmp_path / "compare.html").read_text()
    for controller in ("traditional", "paper", "salient"):
        assert f"Cost of a wrong machine file, {controller}" in page
    assert page.count("data:image/png;base64,") == 3
