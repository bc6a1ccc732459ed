"""Names that a message about a misspelt one states."""

from __future__ import annotations

import pytest

from salient.errors import NAMES_MAX, close_names
from salient.machine.parameter_table import read_table

PARAMETERS = [row.name for row in read_table()]


def test_few_names_are_all_listed_in_their_order():
    few = [f"name_{number}" for number in range(NAMES_MAX, 0, -1)]
    assert close_names("x", few) == f"must be one of {', '.join(few)}"


@pytest.mark.parametrize(("names", "text"), [([], "there is none"), (["only"], "must be only")])
def test_none_and_a_single_name_read_well(names: list[str], text: str):
    assert close_names("x", names) == text


def test_of_many_the_nearest_three_are_named():
    assert close_names("x", map(str, range(100, 250))).count(", ") == 2


@pytest.mark.in_turns
def test_every_name_with_a_letter_lost_doubled_or_exchanged_is_among_the_nearest():
    for name in PARAMETERS:
        for at in range(len(name) - 1):
            for wrong in (name[:at] + name[at + 1:], name[:at] + name[at] + name[at:],
                          name[:at] + name[at + 1] + name[at] + name[at + 2:]):
                if wrong not in PARAMETERS:
                    assert name in close_names(wrong, PARAMETERS).partition(" are ")[2].split(", "), wrong


@pytest.mark.parametrize("wrong", ["CURRENT_TRIP_A", "current_trip", "trip_A"])
def test_case_unit_and_beginning_may_be_missing(wrong: str):
    assert close_names(wrong, PARAMETERS).startswith(f"the nearest of {len(PARAMETERS)} are current_trip_A, ")


@pytest.mark.parametrize("wrong", ["", "?" * 100_000, 7, None])
def test_anything_has_nearest_names(wrong: object):
    assert len(close_names(wrong, PARAMETERS)) < 160
