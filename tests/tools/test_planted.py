"""Planted bugs fit the sources and the tests, are found by the tests that have to find them, or reported as missed."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import cantools
import pytest

from salient.errors import UsageError
from salient.experiments import planted
from salient.experiments.planted import Bug, Finding, bugs, build, campaign_programs, check_finders, first_failure
from salient.paths import BUILD, DRIVE_DBC

OVER_SPEED = planted.named("over_speed: one direction only")
CLEARED = planted.named("clearing: a fault clears itself once its cause has gone")


@pytest.mark.parametrize("bug", bugs(), ids=lambda bug: bug.name)
def test_the_old_text_is_there_once_and_what_finds_it_exists(bug: Bug) -> None:
    assert bug.new in bug.text()
    check_finders(bug)


def test_no_two_bugs_are_the_same() -> None:
    assert len({(bug.file, "".join(bug.text().split())) for bug in bugs()}) == len(bugs()) > 200


def test_every_fault_of_the_drive_has_a_bug() -> None:
    message = cantools.database.load_file(DRIVE_DBC).get_message_by_name("DRIVE_FAULT_CAUSE")
    faults = {str(fault) for fault in message.get_signal_by_name("fault").choices.values()}
    assert len(faults) > 20
    claims = {claim for bug in bugs() for claim in bug.name.partition(": ")[0].split(", ")}
    assert faults - claims == {"none"}


def test_the_summary_counts_the_bugs_of_the_campaign() -> None:
    of = json.loads(planted.SUMMARY.read_text(encoding="utf-8"))["campaign"]
    assert 50 < of["found"] <= of["looked"] and of["replayed"] <= of["found"]


@pytest.mark.parametrize(("change", "message"), [
    ({"old": "no such text"}, "has the old text 0 times"),
    ({"old": "return"}, r"has the old text \d+ times"),
    ({"file": "firmware/none.c"}, "firmware/none.c has the old text 0 times"),
    ({"found_by": ("test_none",)}, "no test test_none"),
    ({"found_by": ("test_stall.py::test_none",)}, "no test test_stall.py::test_none"),
])
def test_a_stale_bug_is_an_error_that_names_it(change, message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"{re.escape(OVER_SPEED.name)}: .*{message}"):
        planted.run([dataclasses.replace(OVER_SPEED, **change)], planted.KINDS, tmp_path)


GROUP = '[[group]]\nfile = "a.c"\nfound_by = []\nbugs = [["a: b", "c"'


@pytest.mark.parametrize(("text", "message"), [
    ("", "no table of bugs"), (f"{GROUP}]]", "no table of bugs"), (f'{GROUP}, "d"]]', "a: b: must have")])  # fmt: skip
def test_an_incomplete_table_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    table = tmp_path / "planted.toml"
    table.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=f"planted.toml: {message}"):
        bugs(table)


def test_a_unit_test_fails_with_a_bug_and_passes_without_it(tmp_path: Path) -> None:
    program = build(OVER_SPEED, tmp_path, "test_monitors_encoder_monitor")[0]
    assert first_failure("test_monitors_encoder_monitor", program).startswith("EncoderMonitor.the_observer_shows_over")
    assert first_failure("test_monitors_encoder_monitor", BUILD / "host" / "bin" / program.name) == ""


def test_a_bug_that_is_missed_is_told_and_what_was_found_is_not_looked_for_again(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    looked = tmp_path / "looked"

    def look(bug: Bug, kind: str, out: Path, seeds_max: int) -> Finding:  # in a worker process
        with looked.open("a", encoding="utf-8") as file:
            file.write(f"{kind}\n")
        return {"by": "Suite.test" if kind == "unit" else "", "processor_s": 1.0}

    monkeypatch.setattr(planted, "look", look)
    monkeypatch.setattr(planted, "build_unchanged", lambda finders: None)
    chosen = [dataclasses.replace(OVER_SPEED, found_by=("test_monitors_encoder_monitor",)),
              dataclasses.replace(OVER_SPEED, name="over_speed: alive", found_by=("campaign",))]
    assert planted.run(chosen[:1], planted.KINDS, tmp_path) == 0 and looked.read_text() == "unit\n"
    assert planted.run(chosen, planted.KINDS, tmp_path) == 1 and looked.read_text() == "unit\ncampaign\n"
    told = capsys.readouterr().out
    assert "| over_speed: one direction only | Suite.test | - | - |" in told
    assert "| over_speed: alive | - | - | MISSED |" in told and "missed by campaign: over_speed: alive" in told
    note = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert (note["bugs"], note["found"], note["missed"]) == (2, 1, {"over_speed: alive": ["campaign"]})


@pytest.mark.in_turns
def test_the_campaign_finds_a_bug_within_seconds_shrinks_and_replays_it(tmp_path: Path) -> None:
    folder = tmp_path / "found"
    found = planted.hunt_and_replay(CLEARED, folder)
    assert found["by"] and found["replays"] and len(found["events"]) == 1
    assert 0.001 < found["processor_s"] < 10.0 and 0.001 < found["shrinking_s"] < 60.0
    note = json.loads((folder / "failure.json").read_text(encoding="utf-8"))
    assert note["replay"] == f"tools/salient replay {folder}"
    page = (folder / "failure.html").read_text(encoding="utf-8")
    at_us = note["result"]["violations"][0]["at_us"]
    assert f"{found['by']} at {at_us} us" in page and "The violation" in page and note["replay"] in page
    (tmp_path / "failure.json").write_text(json.dumps({**note, "bug": None}), encoding="utf-8")
    done = salient("replay", tmp_path)  # the drive without the bug
    assert done.returncode == 0 and "violation" not in done.stdout


def test_the_campaign_finds_an_angle_that_is_a_count_off(tmp_path: Path) -> None:
    bug = planted.named("encoder_angle: the edge of the encoder on the wrong side of the count")
    found = planted.hunt(campaign_programs(bug, tmp_path), seeds_max=20)
    assert found["by"] and found["processor_s"] < 10.0


def test_a_planted_bug_is_replayed_on_the_host_alone(tmp_path: Path) -> None:
    note = {"seed": 4, "kept": "0x0", "kind": "faults", "bug": CLEARED.name}
    (tmp_path / "failure.json").write_text(json.dumps(note), encoding="utf-8")
    done = salient("replay", tmp_path, "--target", "rv32")
    assert done.returncode == 2 and "--target rv32" in done.stderr and done.stderr.count("\n") == 1


def salient(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "salient", *map(str, arguments)], capture_output=True, text=True,
                          check=False)
