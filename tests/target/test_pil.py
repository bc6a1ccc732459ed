"""The command pil: its files, the consistency of its metrics, its errors."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from salient.cli import make_parser
from salient.errors import UsageError
from salient.experiments.scenario import load_scenarios, run_all, with_true_machine
from salient.machine.path import machine_path
from salient.target import pil

SCENARIO = """
machine = "saturating"
controllers = ["traditional", "salient"]
duration_s = 0.03
[[speed]]
at_s = 0.0
value_rpm = 300.0
[[load]]
at_s = 0.02
torque_Nm = 5.0
"""


def options(**given) -> argparse.Namespace:
    return argparse.Namespace(**{"scenario": None, "out": None, "target": "cortex-m4", "search": None, "seed": 1,
                                 "bound": None, "figures": False, "true_machine": None, **given})


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SCENARIO)
    return path


@pytest.mark.in_turns
def test_pil_writes_the_files_of_run_and_consistent_processor_metrics(scenario, tmp_path, capsys):
    assert pil.run(options(scenario=scenario, out=tmp_path / "out")) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "results.json", "processor.json", "report.html", "interrupts.png", "traditional", "salient"}
    assert set(json.loads((tmp_path / "out/results.json").read_text())["controllers"]) == {"traditional", "salient"}
    content = json.loads((tmp_path / "out/processor.json").read_text())
    output = capsys.readouterr().out
    for controller, of in content["controllers"].items():
        assert of["interrupts"] == 1200
        assert 300 < of["instructions"]["median"] < of["instructions"]["max"] < 10_000
        assert 300 < sum(of["mean_by_module"].values()) < of["instructions"]["max"]
        assert abs(sum(of["max_by_module"].values()) - of["instructions"]["max"]) <= len(of["max_by_module"])
        assert of["stack_bytes"]["deepest"] == of["stack_bytes"]["background"] + of["stack_bytes"]["interrupt"]
        assert 0.3 < of["coverage"]["executed"] / of["coverage"]["instructions"] < 1
        assert f"{controller}: instructions per control interrupt: median {of['instructions']['median']}" in output
    page = (tmp_path / "out/report.html").read_text()
    assert "data:image/png;base64," in page and "predictive_torque" in page and "$" not in page


@pytest.mark.in_turns
def test_equal_runs_write_equal_pages(scenario, tmp_path):
    for name in ("first", "second"):
        pil.run(options(scenario=scenario, out=tmp_path / name))
    for name in ("processor.json", "report.html"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


@pytest.mark.in_turns
def test_motor_of_another_file_is_that_of_pil_and_of_the_host(scenario, tmp_path):
    """The image has the firmware's tables only; the plant is the pair's, bit for bit as on the host."""
    scenario.write_text(SCENARIO.replace('"traditional", ', "") + "[record]\nstep_us = 10.0\n")
    heavy = tmp_path / "heavy.toml"
    heavy.write_text(machine_path("saturating").read_text().replace("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.04"))
    for name, true_machine in (("alone", None), ("pair", str(heavy))):
        assert pil.run(options(scenario=scenario, out=tmp_path / name, true_machine=true_machine)) == 0
    run_all(with_true_machine(load_scenarios(scenario), str(heavy)), tmp_path / "host")
    alone, pair, host = (np.load(tmp_path / name / "salient" / "recording.npy") for name in ("alone", "pair", "host"))
    assert pair.tobytes() == host.tobytes()
    assert pair["speed_rpm"].max() == pytest.approx(0.5 * alone["speed_rpm"].max(), rel=0.05)


def test_true_machine_without_a_scenario_is_refused():
    with pytest.raises(UsageError, match="--true-machine saturating: only with a scenario"):
        pil.run(options(figures=True, true_machine="saturating"))


@pytest.mark.in_turns
def test_fault_of_the_drive_is_exit_code_1(tmp_path, capsys):
    path = tmp_path / "fault.toml"
    path.write_text(SCENARIO + "[parameters]\ncurrent_trip_A = 2\n")
    assert pil.run(options(scenario=path, out=tmp_path / "out")) == 1
    assert "the drive ended in a fault: salient: over_current" in capsys.readouterr().out


@pytest.mark.parametrize(("line", "message"), [
    ([], "one of the arguments SCENARIO.toml --bound --figures is required"),
    (["--bound", "--figures"], "--figures: not allowed with --bound"),
    (["--bound", "salient", "--figures"], "--figures: not allowed with --bound"),
    (["a.toml", "--figures"], "--figures: not allowed with SCENARIO.toml"),
])
def test_exactly_one_task_is_required_before_anything_is_installed(line, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        make_parser().parse_args(["pil", *line])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("instructions", "verdicts"), [
    (1100, {20_000: "yes", 40_000: "yes", 50_000: "yes", 100_000: "yes"}),
    (1200, {20_000: "yes", 40_000: "yes", 50_000: "yes", 100_000: "open"}),
    (3000, {20_000: "yes", 40_000: "open", 50_000: "open", 100_000: "no"}),
    (8000, {20_000: "no", 40_000: "no", 50_000: "no", 100_000: "no"}),
])
def test_an_interrupt_fits_when_all_estimates_of_its_cycles_are_below_the_period(instructions, verdicts):
    assert pil.fits(instructions) == verdicts
