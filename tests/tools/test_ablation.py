"""The mechanisms of the ablation fit the sources, its runs are the same for all, and its ratios are right."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from salient.errors import UsageError
from salient.experiments.ablation import __main__ as ablation
from salient.experiments.ablation.cases import COUNT, PARTS, Case, make_case
from salient.experiments.ablation.measure import MEASURES
from salient.experiments.ablation.table import Ablation, cost, line, logarithms
from salient.experiments.planted import Bug

MECHANISMS = ablation.mechanisms()


@cache
def cases() -> list[Case]:
    return [make_case(number, 1) for number in range(COUNT)]


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda mechanism: mechanism.name)
def test_the_text_of_a_mechanism_is_there_once_and_its_parts_have_runs(mechanism: Bug) -> None:
    assert mechanism.new in mechanism.text()
    assert set(mechanism.found_by) <= set(PARTS)


def test_no_two_removals_are_the_same_and_each_mechanism_has_its_reason() -> None:
    assert len({(each.file, "".join(each.text().split())) for each in MECHANISMS}) == len(MECHANISMS) > 20
    assert ablation.needs().keys() == {each.name for each in MECHANISMS}


def test_a_stale_text_names_the_table(tmp_path: Path) -> None:
    table = tmp_path / "mechanisms.toml"
    group = '[[group]]\nfile = "firmware/control/inertia.c"\nfound_by = ["all"]\nbugs = [["a", "no such text", ""]]\n'
    table.write_text(group, encoding="utf-8")
    with pytest.raises(UsageError, match=r"mechanisms.toml: a: .* has the old text 0 times"):
        ablation.bugs(table)[0].text()


def test_a_seed_changes_what_a_case_does_not_have_on_purpose() -> None:
    for case in cases():
        other = make_case(case.number, 2)
        assert other.parts == case.parts and other.scenario.speed == case.scenario.speed
        assert other.scenario.encoder_bits == case.scenario.encoder_bits
        assert other.scenario.bench != case.scenario.bench
        assert len(other.scenario.load) == len(case.scenario.load) <= 62


def test_each_part_of_the_set_has_runs() -> None:
    assert {part for case in cases() for part in case.parts} == set(PARTS)
    assert len({case.scenario.machine for case in cases()}) == 20
    assert {case.scenario.encoder_bits for case in cases()} == {9, 10, 12, 13, 14, 15, 17}


def test_cost_is_the_mean_of_the_ratios_and_of_the_worst_tenth() -> None:
    found = cost(np.log([1.0] * 18 + [2.0, 8.0]))
    assert found.mean == pytest.approx(16.0 ** (1 / 20)) and found.worst == pytest.approx(4.0)


def test_small_values_do_not_count_and_missing_ones_are_left_out() -> None:
    without = {0: {"ripple": 1e-9}, 1: "fault stall", 2: {"ripple": 0.2}, 3: {"dip": 1.0}}
    whole = {0: {"ripple": 1e-6}, 1: {"ripple": 0.1}, 2: {"ripple": 0.1}, 3: {"ripple": 0.1}}
    ratios = logarithms(without, whole, [0, 1, 2, 3], "ripple")
    assert ratios == pytest.approx([0.0, math.log(0.205 / 0.105)], abs=1e-3)


def test_a_row_is_missed_beyond_the_scatter_of_the_seeds_and_when_runs_fail() -> None:
    values = dict.fromkeys(MEASURES, 0.1)
    whole = [{case.number: {name: value * (1.0 + 0.01 * seed) for name, value in values.items()} for case in cases()}
             for seed in range(3)]
    table = Ablation(cases(), whole)
    assert not table.row("a", ("all",), whole[0]).is_missed
    worse = whole[0] | {number: {**values, "swing": 0.3} for number in table.numbers(("moving",))}
    row = table.row("a", ("moving",), worse)
    assert row.is_missed and row.changed == len(table.numbers(("moving",))) and row.most is not None
    assert row.most[:2] == ("swing", "moving") and "**3.00 (3.00)**" in line(row, ("moving",), "moving loads")
    assert not table.row("a", ("step",), worse).is_missed
    failing = table.row("a", ("step",), whole[0] | {0: "fault stall"})
    assert failing.is_missed and failing.failed == 1


@pytest.mark.in_turns
def test_one_mechanism_is_removed_and_measured_and_kept(tmp_path: Path) -> None:
    line_of = [sys.executable, "-m", "salient.experiments.ablation", "--only", "torque_offset", "--runs", "3", "--out",
               str(tmp_path)]
    done = subprocess.run(line_of, capture_output=True, text=True, check=True)
    assert "| torque_offset | all | 3 of 3 |" in done.stdout
    kept = (tmp_path / "runs.jsonl").read_text(encoding="utf-8")
    results = [json.loads(each)["result"] for each in kept.splitlines()]
    assert len(results) == 12 and all(set(each) == set(MEASURES) for each in results)
    again = subprocess.run(line_of, capture_output=True, text=True, check=True)
    assert again.stdout == done.stdout and (tmp_path / "runs.jsonl").read_text(encoding="utf-8") == kept
