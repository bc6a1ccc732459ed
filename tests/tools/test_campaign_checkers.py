"""The campaign's checkers: the list of them, and the table of what each fault disturbs."""

from __future__ import annotations

import re

from salient.bench.faults import fault_kinds
from salient.generate.checkers import CAMPAIGN, PAGE, page, property_of, table


def test_list_is_generated_from_the_checkers() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m salient.generate.checkers"


def test_every_checker_is_in_the_table_once_with_a_text_and_its_own_name() -> None:
    defined = {}
    for path in (CAMPAIGN / "checkers").glob("*.c"):
        found = re.search(r'const checker_t (\w+)_checker = \{\s*\.name = "(\w+)"', path.read_text(encoding="utf-8"))
        if found:
            assert found[1] == found[2] == path.stem
            defined[path.stem] = property_of(path.stem)
    assert len(table()) == len(defined) >= 39 and {name for _, name in table()} == set(defined)
    assert all(text.endswith(".") and len(text) > 40 for text in defined.values())
    assert {group for group, _ in table()} == {"CHECKER_NEVER", "CHECKER_IN_TIME", "CHECKER_SOMETIMES"}


def test_every_kind_of_fault_has_a_row_that_says_what_it_disturbs() -> None:
    text = (CAMPAIGN / "fault_effects.c").read_text(encoding="utf-8")
    rows = re.findall(r"\[FAULT_(\w+)\] = \{(\w+)", text)
    assert len(rows) == len(dict(rows)) and set(dict(rows)) == {name.upper() for name in fault_kinds()}
    assert all(disturbs != "0" for _, disturbs in rows)


def test_no_condition_goes_by_the_order_of_kinds_of_faults() -> None:
    kind = rf"FAULT_(?:{'|'.join(name.upper() for name in fault_kinds())})\b"
    ordered = re.compile(rf"(?<!-)[<>]=? {kind}|\b{kind} [<>]")
    assert ordered.search("event->what <= FAULT_SWITCH_OPEN") and ordered.search("FAULT_SWITCH_OPEN < what")
    for path in CAMPAIGN.rglob("*.[ch]"):
        assert not ordered.search(path.read_text(encoding="utf-8")), path
