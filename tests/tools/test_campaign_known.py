"""Known deviations of the campaign: they are counted apart, still there, and everything else fails."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from salient.cli import make_parser
from salient.errors import RunFailed
from salient.experiments.campaign import command, known, report
from salient.experiments.campaign.command import run_campaign
from salient.experiments.campaign.failure import classes
from salient.experiments.campaign.known import Known
from salient.experiments.campaign.runner import run_world


@pytest.mark.in_turns
@pytest.mark.parametrize("entry", known.known(), ids=lambda entry: f"{entry.seed}-{entry.violation}")
def test_a_known_deviation_is_still_there_and_has_a_reason(entry: Known) -> None:
    found = classes(run_world(entry.seed, kind=entry.kind))
    assert entry.violation in found, f"{entry.seed}: remove it from {known.FILE.name}"
    assert len(entry.reason) > 60


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, entries: tuple[Known, ...]) -> int:
    """A campaign of seed 3, which breaks a rule."""
    result = {"seed": 3, "violations": [{"rule": "mute", "number": 0, "at_us": 5}]}
    monkeypatch.setattr(command, "run", lambda tasks, *_: [(tasks[0], result)])
    monkeypatch.setattr(known, "known", lambda: entries)
    return run_campaign(make_parser().parse_args(["campaign", "--first", "3", "--seeds", "1", "--no-shrink", "--out",
                                                  str(tmp_path)]))


def test_a_listed_violation_is_counted_as_known(monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
                                                capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, tmp_path, (Known(3, "faults", "mute", "r"),)) == 0
    note = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert note["violations"] == {} and note["known_deviations"] == {"mute": {"count": 1, "seeds": [3]}}
    assert "0 violations, 1 known deviations" in capsys.readouterr().out
    assert report._violations(note) == "0 violations, 1 known deviations"


@pytest.mark.parametrize("entry", [Known(4, "faults", "mute", "r"), Known(3, "healthy", "mute", "r"),
                                   Known(3, "faults", "misled", "r")])
def test_a_violation_of_another_world_or_rule_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
                                                    entry: Known) -> None:
    assert run(monkeypatch, tmp_path, (entry,)) == 1


def test_a_known_deviation_that_has_gone_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
                                                  capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, tmp_path, (Known(3, "faults", "mute", "r"), Known(3, "faults", "misled", "r")))
    assert "no longer a deviation, to be removed from known.toml: seed 3 misled" in capsys.readouterr().out


@pytest.mark.parametrize(("text", "message"), [
    ('[[known]]\nseed = 1\nkind = "faults"\nviolation = "mute"\n', "must have seed, kind, violation, reason"),
    ('[[known]]\nseed = "1"\nkind = "faults"\nviolation = "mute"\nreason = ""\n', "must have"),
    ('[[known]]\nseed = 1\nkind = "faults"\nviolation = "mute"\nreason = ""\n' * 2, "twice"),
])  # fmt: skip
def test_an_entry_that_is_not_complete_is_refused(text: str, message: str) -> None:
    with pytest.raises(RunFailed, match=message):
        known.parse(text)
