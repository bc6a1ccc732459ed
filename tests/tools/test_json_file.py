"""JSON of results: readable by every parser."""

from __future__ import annotations

import json
import math

import numpy as np

from salient.experiments import scenario
from salient.json_file import json_text


def refused(text):
    raise ValueError(text)


def test_numbers_that_are_not_finite_are_null_and_others_exact():
    content = {"a": [math.nan, (math.inf, -math.inf)], "b": {"c": np.float64("nan"), "d": 0.1 + 0.2, "e": "NaN"}}
    assert json.loads(json_text(content), parse_constant=refused) == {
        "a": [None, [None, None]], "b": {"c": None, "d": 0.1 + 0.2, "e": "NaN"}}


def test_results_of_a_run_that_is_shorter_than_the_telemetry_are_json(tmp_path):
    path = tmp_path / "short.toml"
    path.write_text('machine = "saturating"\ncontrollers = ["salient"]\nduration_s = 0.001\n'
                    "[[position]]\nat_s = 0.0\nvalue_deg = 10\n")
    scenario.run_all(scenario.load_scenarios(path), tmp_path)
    found = json.loads((tmp_path / "results.json").read_text(), parse_constant=refused)
    assert found["controllers"]["salient"]["position"] == {
        "final_deg": None, "following_error_max_deg": None, "state": "unknown"}
