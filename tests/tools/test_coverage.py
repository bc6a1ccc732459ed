"""Coverage of the firmware by its unit tests: what is open does not grow, and growth is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from salient.errors import UsageError
from salient.exceptions import read_exceptions
from salient.experiments import coverage
from salient.experiments.coverage import COMMITTED, EXCEPTIONS, Coverage, falls, measure, not_needed, note_of
from salient.paths import ROOT

FILE = "firmware/module.c"


def measured(*missed: tuple[int, str]) -> dict[str, Coverage]:
    """A file with ten conditions, of which some are not covered."""
    counts = dict.fromkeys(coverage.KINDS, 10)
    covered = {**counts, "conditions": 10 - len(missed)}
    return {FILE: Coverage(covered, counts, {"conditions": list(missed)})}


def test_a_condition_that_is_no_longer_covered_is_told_and_one_more_that_is_not() -> None:
    one, two = measured((3, "a && b")), measured((3, "a && b"), (5, "c || d"))
    assert falls(note_of(one, {}), note_of(two, {})) == falls(note_of(one, {}), note_of(one, {})) == []
    assert falls(note_of(two, {}), note_of(one, {})) == [f"{FILE}: 2 conditions open, 1 committed"]
    assert falls(note_of(one, {}), note_of(measured(), {})) == [f"{FILE}: 1 conditions open, 0 committed"]


def test_an_exception_is_not_open_and_one_of_what_is_covered_is_not_needed() -> None:
    reason = {f"{FILE}: a && b": "the caller's range"}
    found = measured((3, "a && b"), (5, "c || d"))
    note = note_of(found, reason)
    assert note["open"] == {FILE: {"conditions": 1}} and note["conditions"]["covered"] == 8
    assert not_needed(found, reason) == []
    assert not_needed(measured((5, "c || d")), reason) == [
        f"{FILE}: a && b: an exception of coverage.toml that is not needed"]


def test_committed_files_and_exceptions_are_of_this_repository() -> None:
    note = json.loads(COMMITTED.read_text(encoding="utf-8"))
    assert all((ROOT / file).is_file() for file in note["open"])
    assert [note[kind]["percent"] > 90 for kind in coverage.KINDS] == [True] * 3
    for name, reason in read_exceptions(EXCEPTIONS).items():
        file, _, text = name.partition(": ")
        assert reason and text in [line.strip() for line in (ROOT / file).read_text(encoding="utf-8").splitlines()]


def test_without_the_compiler_s_counters_the_package_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(coverage, "RUNTIME", tmp_path / "none.a")
    with pytest.raises(UsageError, match="libclang-rt-19-dev"):
        measure(tmp_path)


@pytest.mark.in_turns
def test_no_more_is_open_than_committed(tmp_path: Path) -> None:
    found = measure(tmp_path / "coverage")
    exceptions = read_exceptions(EXCEPTIONS)
    note = note_of(found, exceptions)
    assert falls(note, json.loads(COMMITTED.read_text(encoding="utf-8"))) == [], "salient.experiments.coverage --open"
    assert not_needed(found, exceptions) == []
    # Every source that has a function is counted.
    sources = [path for path in (ROOT / "firmware").rglob("*.c") if path.parent.name != "layout"]
    assert {str(path.relative_to(ROOT)) for path in sources if "\n}\n" in path.read_text(encoding="utf-8")} \
        == set(found)
