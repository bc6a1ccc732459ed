"""The table of mutants of the protections fits the sources and the tests, and its page has a row for each of them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import cantools
import pytest

from salient.errors import UsageError
from salient.experiments import protection_mutants
from salient.experiments.protection_mutants import PAGE, check_tests, mutated, page, read_table
from salient.paths import DRIVE_DBC

MUTANTS = read_table()
NOT_DETECTED = {"none"}


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_the_old_text_occurs_once_and_the_tests_exist(mutant) -> None:
    assert mutant.new in mutated(mutant)
    check_tests(mutant)


def test_every_fault_of_the_drive_has_a_mutant() -> None:
    message = cantools.database.load_file(DRIVE_DBC).get_message_by_name("DRIVE_FAULT_CAUSE")
    faults = {str(fault) for fault in message.get_signal_by_name("fault").choices.values()}
    assert len(faults) > 20
    assert faults - {mutant.protection for mutant in MUTANTS} == NOT_DETECTED


def test_the_page_has_no_survivor_without_a_reason() -> None:
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|"))
            for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")][2:]
    mutant_of = {(mutant.protection, mutant.change): mutant for mutant in MUTANTS}
    assert len(rows) == len(MUTANTS)
    for protection, change, _, noticed in rows:
        mutant = mutant_of[protection, change]
        assert noticed == f"survives: {mutant.survives}" if mutant.survives else noticed.startswith("`")


@pytest.mark.parametrize(("change", "message"), [
    ({"old": "no such text"}, "has the old text 0 times"),
    ({"old": "return"}, r"has the old text \d+ times"),
    ({"file": "firmware/none.c"}, "no file firmware/none.c"),
    ({"tests": ("test_none",)}, "no test test_none"),
    ({"tests": ("tests/hil/test_stall.py::test_none",)}, "no test tests/hil/test_stall.py::test_none"),
])
def test_a_stale_mutant_is_an_error_that_names_it(change, message: str) -> None:
    mutant = dataclasses.replace(MUTANTS[0], **change)
    with pytest.raises(UsageError, match=f"{re.escape(mutant.name)}: .*{message}"):
        protection_mutants.run([mutant], of_all=False)


def test_an_incomplete_entry_is_an_error(tmp_path: Path) -> None:
    table = tmp_path / "mutants.toml"
    table.write_text('[[mutant]]\nprotection = "stall"\nchange = "none"\n')
    with pytest.raises(UsageError, match=r"mutants.toml: mutant 1 has the keys change, protection: must be"):
        read_table(table)


def test_a_survivor_without_a_reason_fails_the_run(monkeypatch, capsys, tmp_path: Path) -> None:
    judged = {"killed": "`Protection.test`", "alive": ""}
    mutants = [dataclasses.replace(MUTANTS[0], change=name) for name in judged]
    for name, value in (("RESULTS", tmp_path / "results.json"), ("PAGE", tmp_path / "page.md")):
        monkeypatch.setattr(protection_mutants, name, value)
    monkeypatch.setattr(protection_mutants, "_copy_sources", lambda: "")
    monkeypatch.setattr(protection_mutants, "_key", lambda mutant, sources: mutant.change)
    monkeypatch.setattr(protection_mutants, "_run", lambda command: type("Done", (), {"returncode": 0}))
    monkeypatch.setattr(protection_mutants, "check_unchanged", lambda mutants, passed: None)
    monkeypatch.setattr(protection_mutants, "judge", lambda mutant: judged[mutant.change])
    assert protection_mutants.run(mutants, of_all=True) == 1
    assert "survives: over_current: alive" in capsys.readouterr().out
    row = "| over_current | alive | `protection.c` | survives: no test notices it |"
    assert row in (tmp_path / "page.md").read_text()
    assert protection_mutants.run(mutants[:1], of_all=True) == 0
    explained = dataclasses.replace(mutants[1], survives="another check finds it")
    assert protection_mutants.run([explained], of_all=True) == 0
    assert "survives: another check finds it" in page([explained], {explained.name: ""}, "c0ffee")
