"""Worlds by seed: equal bits everywhere, results that merge, failures that shrink and replay, bugs that are found."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from salient.cli import make_parser
from salient.experiments.campaign import canaries, names, same_bits
from salient.experiments.campaign.cluster import compare
from salient.experiments.campaign.command import run_campaign
from salient.experiments.campaign.failure import replay
from salient.experiments.campaign.machines import files
from salient.experiments.campaign.runner import branches, run_world, world
from salient.experiments.tasks import read_results


def salient(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "salient", *map(str, arguments)], capture_output=True, text=True,
                          check=False)


def test_shards_merge_to_what_one_run_has_and_nothing_runs_twice(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    common = ["campaign", "--first", "2", "--seeds", "6", "--no-shrink", "--jobs", "1", "--out"]

    def campaign(*arguments: object) -> int:
        return run_campaign(make_parser().parse_args([*common, *map(str, arguments)]))

    assert {campaign(whole), campaign(parts, "--shard", "1/2"), campaign(parts, "--shard", "2/2")} <= {0, 1}
    results = read_results(whole)
    assert len(results) == 6 and read_results(parts) == results
    assert len({result["hash"] for result in results.values()}) == 6
    before = {file.name: file.read_bytes() for file in parts.glob("runs*")}
    campaign(parts)
    after = {file.name: file.read_bytes() for file in parts.glob("runs*")}
    assert after.pop("runs.jsonl") == b"" and after == before
    note = json.loads((whole / "summary.json").read_text(encoding="utf-8"))
    assert (note["first"], note["seeds"], note["finished"]) == (2, 6, 6)
    assert 0 < note["cells_reached"] < note["cells"] == len(names.cells())
    assert len(note["cells_not_reached"]) == note["cells"] - note["cells_reached"]


def test_a_scheduler_whose_worker_is_killed_has_the_summary_of_one_computer_byte_for_byte(tmp_path: Path) -> None:
    note = compare(tmp_path, 50, 60)
    assert note["killed"] and note["equal"] and 20 <= note["killed_after"] < 60
    one, many = tmp_path / "one", tmp_path / "many"
    assert (many / "summary.json").read_bytes() == (one / "summary.json").read_bytes()
    assert read_results(many) == read_results(one) and len(read_results(one)) == 60
    rate = json.loads((one / "rate.json").read_text(encoding="utf-8"))
    assert rate["worlds"] == 60 and 0.1 < rate["processor_s"] < 60.0 and 10.0 < rate["virtual_s"] < 40.0


def test_leaving_an_event_out_moves_no_other() -> None:
    events = world(3)["events"]
    assert len(events) >= 4
    kept = sum(1 << event["index"] for event in events if event["index"] != 2)
    assert world(3, kept)["events"] == [event for event in events if event["index"] != 2]
    assert run_world(3, kept)["hash"] != run_world(3)["hash"] == run_world(3)["hash"]


def test_seeds_differ_in_machine_controller_and_events() -> None:
    worlds = [world(seed) for seed in range(1, 41)]
    assert len(files()) == 20
    assert 12 <= len({drawn["machine"] for drawn in worlds}) <= 20
    assert {drawn["controller"] for drawn in worlds} == {"traditional", "paper", "salient"}
    of_kinds = set(names.kinds().values())
    numbers = [sum(event["event"] in of_kinds for event in drawn["events"]) for drawn in worlds]
    assert min(numbers) <= 1 and 4 <= max(numbers) <= 6 and 2.0 < sum(numbers) / len(numbers) < 5.0


@pytest.mark.parametrize("seed", [2, 235, 819])
def test_a_seed_has_the_same_bits_on_the_usual_bench(tmp_path: Path, seed: int) -> None:
    again = replay(seed, folder=tmp_path)
    assert again.equal and again.campaign["causes"]
    left = {file.name for file in tmp_path.iterdir()}
    assert {"can.blf", "can.log", "failure.html", "failure.png", "bench.json"} <= left


@pytest.mark.parametrize("seed", [13, 19, 39, 87, 1584])
def test_warm_windings_of_small_machines_are_no_false_alarm(seed: int) -> None:
    result = run_world(seed, healthy=True)
    assert result["violations"] == [] and result["causes"] == []
    assert 300_000 < result["virtual_us"] < 4_000_000


def test_a_seed_has_the_same_bits_twice_on_the_bench_and_on_a_target(tmp_path: Path,
                                                                     capsys: pytest.CaptureFixture[str]) -> None:
    assert same_bits.main([str(tmp_path), "401", "2"]) == 0
    assert "2 of 2 with equal bits" in capsys.readouterr().out
    results = read_results(tmp_path)
    assert len({result["hash"] for result in results.values()}) == 2
    assert not same_bits.equal({**next(iter(results.values())), "on_target": "0"})


def test_the_text_of_every_canary_is_in_its_file_once() -> None:
    assert len({canary.name for canary in canaries.canaries()}) == 20


@pytest.mark.parametrize(("number", "violation", "events"), [
    (1, "no_command: fault cleared", 1),
    (20, "wrong_angle", 0),
])  # fmt: skip
def test_a_planted_bug_is_found_within_seconds_shrinks_and_replays(tmp_path: Path, number: int, violation: str,
                                                                   events: int) -> None:
    found = canaries.measure(number, tmp_path)
    assert found["violation"] == violation and found["replays"] and len(found["events"]) == events
    assert 0.001 < found["processor_s"] < 10.0 and 0.001 < found["shrinking_s"] < 60.0
    note = json.loads((tmp_path / str(number) / "failure.json").read_text(encoding="utf-8"))
    assert note["replay"] == found["command"] == f"tools/salient replay {tmp_path / str(number)}"
    without = {**note, "canary": None}
    (tmp_path / "failure.json").write_text(json.dumps(without), encoding="utf-8")
    done = salient("replay", tmp_path)  # the drive without the bug
    assert done.returncode == 0 and "violation" not in done.stdout


SLOW_OR_SILENT = {"load_dropped", "static_friction", "winding_temperature_sensor_offset",
                  "inverter_temperature_sensor_offset"}
"""Faults that change nothing which a drive should answer."""


def test_every_fault_is_found_at_ticks_all_over_an_electrical_period() -> None:
    found = branches(2, 600, 8, 0, 500, 50)
    assert len(found) == 56
    assert not {"code_flipped", "stack_guard_flipped"} & {row["fault"] for row in found}  # unsupported on the host
    assert sum(row["violations"] for row in found) == 0
    for row in found:
        name = row["fault"]
        assert row["branches"] in (1, 10)
        assert row["detected"] == (0 if name in SLOW_OR_SILENT else row["branches"]), name
    longest_us = {(row["fault"], row["leg"]): row["longest_us"] for row in found}
    assert longest_us["encoder_jump", 0] == longest_us["current_sensor_high_rail", 0] == 25  # the same interrupt
    assert 50 <= longest_us["interrupt_lost", 0] <= 75
    assert 1_000 < longest_us["winding_open", 0] < 13_000  # an electrical period has 12.5 ms


@pytest.mark.parametrize(("arguments", "message"), [
    (("replay", "12x"), "replay 12x: must be a seed, a whole number from 0, or the folder of a failure"),
    (("campaign", "--shard", "3/2"), "--shard 3/2: must be I/N, whole numbers with I from 1 to N"),
    (("campaign", "--seeds", "0"), "--seeds 0: must be a whole number from 1 to 99999999"),
])  # fmt: skip
def test_a_mistake_is_one_line_that_names_it(arguments: tuple[str, ...], message: str) -> None:
    done = salient(*arguments)
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1


def test_a_folder_without_a_failure_is_named(tmp_path: Path) -> None:
    done = salient("replay", tmp_path)
    assert done.returncode == 2 and f"{tmp_path}/failure.json: not the note of a failure" in done.stderr
