"""Machine files that contradict physics are refused by one line that names both keys; legal ones are not refused."""

from __future__ import annotations

import re

import pytest
from contradictions import KINDS, contradiction

from salient.experiments.compare.random_machines import WHOLE_RANGE, random_machine
from salient.machine.file import MachineError, load_machine
from salient.machine.scaling import scaling_of

CONTRADICTIONS, LEGAL, PART = 500, 200, 50


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("machines")


def refusal(folder) -> str:
    """The line with which the file of a contradiction is refused, without its path; empty when it is not."""
    path = folder / "contradiction.toml"
    try:
        scaling_of(path, load_machine(path))
    except MachineError as error:
        text = str(error)
        assert text.startswith(f"{path}: ") and text.isprintable()
        return text.removeprefix(f"{path}: ")
    return ""


def wrong(numbers: range, folder) -> dict[str, tuple[str, tuple[str, str]]]:
    """Those that are not refused, or by a line that does not name both keys, with values."""
    found = {}
    for number in numbers:
        case = contradiction(number, folder)
        text = refusal(folder)
        named = all(any(re.search(rf"{re.escape(key)}(?:\b|_)", text) for key in keys.split("|")) for keys in case.keys)
        if not named or not re.search(r": [-\d.e+]+( [^:]+)?: must (not )?be ", text):
            found[f"{number} {case.kind}"] = (text, case.keys)
    return found


def test_every_kind_of_contradiction_names_both_keys(folder):
    assert not wrong(range(len(KINDS)), folder)


@pytest.mark.in_turns
@pytest.mark.parametrize("first", range(0, CONTRADICTIONS, PART))
def test_random_contradiction_names_both_keys(folder, first):
    assert not wrong(range(first, first + PART), folder)


@pytest.mark.parametrize("first", [
    0, *(pytest.param(first, marks=pytest.mark.in_turns) for first in range(20, LEGAL, 20))])
def test_random_legal_machine_is_not_refused(tmp_path, first):
    for number in range(first, first + 20):
        path = tmp_path / f"{number}.toml"
        path.write_text(random_machine(number, WHOLE_RANGE))
        load_machine(path)
