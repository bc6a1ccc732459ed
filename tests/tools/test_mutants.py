"""Mutants of the firmware's sources: which places there are, and what judges them."""

import re

import pytest

from salient.experiments import mutants
from salient.experiments.mutants import EQUIVALENT, INVALID, KILLED, SURVIVED, Mutant, drawn, judge, summary
from salient.paths import ROOT

SOURCE = '''/* a < b, 3 */
#include "x/y.h"
#define LIMIT 8u

static bool over(int a) {
    const int shown = a << 2; /* 4 */
    if (a >= LIMIT && shown != 0) {
        count += 1;
        report("5 < 6");
        return true;
    }
    return a->b - 1 > 0x10;
}
'''
LINES = {
    "#define LIMIT 8u": ["8 -> 9"],
    "const int shown = a << 2; /* 4 */": ["<< -> >>", "2 -> 3"],
    "if (a >= LIMIT && shown != 0) {": [">= -> >", "!= -> ==", "&& -> ||", "0 -> 1",
                                        "(a >= LIMIT && shown != 0) -> (!(a >= LIMIT && shown != 0))"],
    "count += 1;": ["+= -> -=", "1 -> 2", "count += 1; -> ;"],
    "return true;": ["true -> false"],
    "return a->b - 1 > 0x10;": ["> -> >=", "- -> +", "1 -> 2"],
}


@pytest.fixture
def source(tmp_path, monkeypatch):
    (tmp_path / "firmware" / "x").mkdir(parents=True)
    (tmp_path / "firmware" / "x" / "y.c").write_text(SOURCE, encoding="utf-8")
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    return "firmware/x/y.c"


def test_places_are_those_of_the_operators_without_comments_strings_and_includes(source):
    found = {}
    for mutant in mutants.mutants(source):
        line = SOURCE[SOURCE.rfind("\n", 0, mutant.offset) + 1:].partition("\n")[0].strip()
        found.setdefault(line, []).append(f"{mutant.old.strip()} -> {mutant.new.strip()}")
    report = found.pop('report("5 < 6");')
    assert {line: sorted(changes) for line, changes in found.items()} == {
        line: sorted(changes) for line, changes in LINES.items()}
    assert len(report) == 1 and report[0].endswith("-> ;")


def test_a_mutant_changes_its_place_alone_and_has_a_name_of_its_own(source):
    every = mutants.mutants(source)
    assert len({mutant.name for mutant in every}) == len(every)
    for mutant in every:
        text = mutant.text()
        assert text[:mutant.offset] == SOURCE[:mutant.offset]
        assert text[mutant.offset + len(mutant.new):] == SOURCE[mutant.offset + len(mutant.old):]
        assert text != SOURCE


def test_a_seed_draws_the_same_places_and_another_one_others(source):
    assert drawn([source], 5, 1) == drawn([source], 5, 1)
    assert drawn([source], 5, 1) != drawn([source], 5, 2)
    assert len(drawn([source], 5, 1)) == 5
    assert drawn([source], None, 1) == mutants.mutants(source)


def test_every_source_of_the_firmware_has_tests_that_judge_it():
    sources = [path.relative_to(ROOT).as_posix() for path in (ROOT / "firmware").rglob("*.c")]
    assert len(sources) > 70
    assert all("test_drive" in mutants.finders(file) for file in sources)
    assert mutants.finders("firmware/control/speed_smc.c")[0] == "test_control_speed_smc"


def test_a_source_without_tests_of_its_name_is_judged_by_those_that_share_its_first_word():
    assert mutants.finders("firmware/comms/canopen_lss.c") == (
        "test_comms_canopen_drive", "test_comms_canopen_fuzz", "test_comms_canopen_objects", "test_comms_canopen_pdo",
        "test_comms_canopen_position", "test_comms_canopen_sdo", "test_drive")


@pytest.mark.parametrize(("old", "new", "state"), [
    (">> 31", ">> 30", KILLED),
    ("+ ONE_Q22;", "+ ONE_Q22 * 1;", EQUIVALENT),
    ("+ ONE_Q22;", "+ ONE_Q22", INVALID),
])
def test_a_mutant_is_judged_by_the_tests_of_its_module(old, new, state):
    file = "firmware/control/speed_smc.c"
    text = (ROOT / file).read_text(encoding="utf-8")
    assert text.count(old) == 1
    mutant = Mutant("a mutant", file, old, new, mutants.finders(file), offset=text.index(old))
    assert judge(mutant) == {"state": state, "by": "test_control_speed_smc" if state == KILLED else ""}


def test_the_summary_names_survivors_without_a_reason_and_reasons_that_are_not_needed():
    of = [Mutant(name, "firmware/x.c", "", "", ("test_drive",)) for name in "abcd"]
    found = [(of[0], {"state": SURVIVED}), (of[1], {"state": SURVIVED}), (of[2], {"state": KILLED}),
             (of[3], {"state": EQUIVALENT})]
    note = summary(found, {"a": "reason", "c": "reason"}, 1, 4)
    assert (note["mutants"], note["killed"], note["survived"], note["equivalent"]) == (3, 1, 2, 1)
    assert (note["known"], note["unknown"], note["known_and_killed"]) == (["a"], ["b"], ["c"])


def test_reasons_are_for_mutants_that_exist():
    reasons = mutants.read_exceptions(mutants.KNOWN)
    files = {re.match("[^:]*", name)[0] for name in reasons}
    names = {mutant.name for file in files for mutant in mutants.mutants(file)}
    assert set(reasons) <= names
    assert all(reason.strip() for reason in reasons.values())
