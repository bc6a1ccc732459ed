"""The control rate and the sensors that [drive] of a machine file states, in `sim`, in scenarios and in the fixture."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from salient import __main__
from salient.experiments.scenario import load_scenarios
from salient.paths import MACHINES

STATED = """[drive]
control_rate_hz = 100000
encoder_bits = 14
encoder_edges = true
adc_bits = 14
"""


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A machine file that states them."""
    path = tmp_path / "stated.toml"
    text = (MACHINES / "saturating.toml").read_text()
    path.write_text(text.replace('"saturating"', '"stated"', 1).replace("[drive]\n", STATED, 1))
    return path


@pytest.fixture
def sim(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Runs `sim` up to the start of the executable; returns its options."""

    def run(*arguments: str | Path) -> dict[str, str]:
        lines: list[list[str]] = []
        monkeypatch.setattr(os, "execv", lambda file, line: lines.append(line))
        monkeypatch.setattr(sys, "argv", ["salient", "sim", "--can", f"unix:{tmp_path}/bus", *map(str, arguments)])
        __main__.main()
        (line,) = lines
        return {name: value for name, value in zip(line[1:], [*line[2:], ""], strict=True) if name.startswith("--")}

    return run


def test_sim_takes_control_rate_and_sensors_from_the_machine_file(sim, machine: Path) -> None:
    line = sim("--machine", machine)
    assert (line["--control-rate-hz"], line["--encoder-bits"], line["--adc-bits"]) == ("100000", "14", "14")
    assert "--encoder-edges" in line
    assert (line["--controller"], line["--seed"]) == ("salient", "1")


def test_options_of_sim_override_the_machine_file(sim, machine: Path) -> None:
    line = sim("--machine", machine, "--control-rate-hz", "40000", "--adc-bits", "12")
    assert (line["--control-rate-hz"], line["--encoder-bits"], line["--adc-bits"]) == ("40000", "14", "12")


def test_sim_of_a_machine_that_states_none_has_the_defaults(sim) -> None:
    line = sim("--machine", "saturating")
    assert (line["--control-rate-hz"], line["--encoder-bits"], line["--adc-bits"]) == ("40000", "17", "12")
    assert "--encoder-edges" not in line


def test_a_scenario_takes_what_it_does_not_state_from_the_machine_file(machine: Path) -> None:
    path = machine.with_name("scenario.toml")
    path.write_text('machine = "stated.toml"\ncontrollers = ["salient"]\nduration_s = 0.1\nadc_bits = 12\n')
    (scenario,) = load_scenarios(path)
    assert (scenario.control_rate_hz, scenario.encoder_bits, scenario.adc_bits) == (100_000, 14, 12)
    assert scenario.encoder_edges


def test_a_bench_of_the_fixture_has_those_of_the_machine_file_unless_the_test_states_them(make_bench, machine) -> None:
    bench = make_bench(machine=str(machine), adc_bits=12)
    options = bench.options
    assert (options.control_rate_hz, options.encoder_bits, options.encoder_edges, options.adc_bits) == (
        100_000, 14, True, 12)
    bench.run_for(0.15)
    assert bench.telemetry["DRIVE_HEARTBEAT.control_rate_hz"].last == 100_000
    options = make_bench().options
    assert (options.control_rate_hz, options.encoder_bits, options.encoder_edges, options.adc_bits) == (
        40_000, 17, False, 12)


@pytest.mark.parametrize(("noise_A", "differs"), [(0.0, False), (0.05, True)])
def test_a_seed_changes_the_motion_through_noise_alone(make_bench, noise_A: float, differs: bool) -> None:
    speeds = []
    for seed in (1, 2):
        bench = make_bench(seed=seed)
        bench.rig.current_noise_A = noise_A
        bench.drive.speed_reference_rpm = 150
        bench.run_for(0.1)
        speeds.append(list(bench.truth["speed_rpm"].value))
    assert (speeds[0] != speeds[1]) == differs
