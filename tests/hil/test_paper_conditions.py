"""The controllers under the paper's conditions: 1 MHz without delay, exact sensing, known load."""

import pytest

from salient.experiments.compare.cases import GROUPS
from salient.experiments.compare.metrics import EXTRACTORS
from salient.experiments.scenario import run_scenario

CASES = {(case.condition, case.controller): case for case in GROUPS["paper_conditions"].cases(False)}


def metrics_of(condition, controller, folder):
    case = CASES[condition, controller]
    result = run_scenario(case.scenario, folder)
    assert result.fault == "none"
    return EXTRACTORS[case.extractor](case.scenario, result.recording)


@pytest.mark.parametrize(("machine", "least", "most"), [
    ("saturating", 0.0006, 0.0025), ("linear_cosine", 0.0006, 0.003), ("linear_trapezoid", 0.003, 0.008)])
def test_paper_controller_has_less_than_the_published_ripple(machine, least, most, tmp_path):
    assert least < metrics_of(f"{machine}, load step", "paper", tmp_path)["ripple"] < most < 0.0197


@pytest.mark.parametrize(("machine", "least", "most"), [
    ("saturating", 0.011, 0.017), ("linear_cosine", 0.006, 0.010), ("linear_trapezoid", 0.006, 0.010)])
def test_hysteresis_with_bands_for_the_rate_has_less_than_the_published_ripple(machine, least, most, tmp_path):
    assert least < metrics_of(f"{machine}, load step", "traditional", tmp_path)["ripple"] < most < 0.043


def test_known_load_leaves_the_dip_of_the_rotor_angle_and_an_observed_load_increases_it(tmp_path):
    step = metrics_of("saturating, load step", "paper", tmp_path / "step")
    assert 0.4 < step["speed_dip_rpm"] < 1.95
    assert 0.0 < step["recovery_time_s"] < 0.0017
    assert 149.99 < step["speed_after_rpm"] < 150.05
    slow = metrics_of("saturating, load step, usual parameters", "paper", tmp_path / "slow")
    assert 1.7 < slow["speed_dip_rpm"] < 2.2


def test_start_settles_as_published_with_less_overshoot(tmp_path):
    start = metrics_of("saturating, start", "paper", tmp_path)
    assert 0.0677 < start["settling_time_s"] < 0.0700
    assert start["overshoot_percent"] < 0.01
