"""The command pil: what it leaves, that its figures hang together, and its mistakes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from salient.errors import UsageError
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
                                 "figures": False, **given})


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SCENARIO)
    return path


def test_pil_leaves_what_run_leaves_and_figures_of_the_processor_that_hang_together(scenario, tmp_path, capsys):
    assert pil.run(options(scenario=scenario, out=tmp_path / "out")) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "results.json", "processor.json", "report.html", "interrupts.png", "traditional", "salient"}
    assert set(json.loads((tmp_path / "out/results.json").read_text())["controllers"]) == {"traditional", "salient"}
    content = json.loads((tmp_path / "out/processor.json").read_text())
    printed = capsys.readouterr().out
    for controller, of in content["controllers"].items():
        assert of["interrupts"] == 1200
        assert 300 < of["instructions"]["typical"] < of["instructions"]["worst"] < 10_000
        assert 300 < sum(of["mean_by_part"].values()) < of["instructions"]["worst"]
        assert abs(sum(of["worst_by_part"].values()) - of["instructions"]["worst"]) <= len(of["worst_by_part"])
        assert of["stack_bytes"]["deepest"] == of["stack_bytes"]["background"] + of["stack_bytes"]["interrupt"]
        assert 0.3 < of["coverage"]["executed"] / of["coverage"]["instructions"] < 1
        assert f"{controller}: instructions a control interrupt: typical {of['instructions']['typical']}" in printed
    page = (tmp_path / "out/report.html").read_text()
    assert "data:image/png;base64," in page and "predictive_torque" in page and "$" not in page


def test_equal_runs_leave_equal_pages(scenario, tmp_path):
    for name in ("first", "second"):
        pil.run(options(scenario=scenario, out=tmp_path / name))
    for name in ("processor.json", "report.html"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


def test_a_drive_that_ends_in_a_fault_is_exit_code_1(tmp_path, capsys):
    path = tmp_path / "fault.toml"
    path.write_text(SCENARIO + "[parameters]\ncurrent_trip_A = 2\n")
    assert pil.run(options(scenario=path, out=tmp_path / "out")) == 1
    assert "the drive ended in a fault: salient: over_current" in capsys.readouterr().out


@pytest.mark.parametrize("given", [{}, {"search": 1.0, "figures": True}])
def test_exactly_one_thing_is_asked_for(given):
    with pytest.raises(UsageError, match="one of SCENARIO.toml, --search SECONDS and --figures"):
        pil.run(options(**given))


@pytest.mark.parametrize(("instructions", "verdicts"), [
    (1100, {20_000: "yes", 40_000: "yes", 50_000: "yes", 100_000: "yes"}),
    (1200, {20_000: "yes", 40_000: "yes", 50_000: "yes", 100_000: "open"}),
    (3000, {20_000: "yes", 40_000: "open", 50_000: "open", 100_000: "no"}),
    (8000, {20_000: "no", 40_000: "no", 50_000: "no", 100_000: "no"}),
])
def test_an_interrupt_fits_when_every_estimate_of_its_cycles_is_less_than_the_period(instructions, verdicts):
    assert pil.fits(instructions) == verdicts
