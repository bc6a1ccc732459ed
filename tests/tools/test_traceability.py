"""Requirements: this repository's are met by marks, each kind of breach is told, and the pages are generated."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from salient import traceability
from salient.errors import UsageError
from salient.experiments import fault_table, planted
from salient.generate import diagnostic_coverage, requirements
from salient.paths import ROOT
from salient.traceability import in_c, in_tests, violations

TABLE = """[hazard]
H-1 = "It falls."
[function]
F = { term = "", name = "Stays", does = "something" }
[requirement.SR-01]
function = "F"
hazards = ["H-1"]
text = "It stays."
faults = ["fall"]
"""
SOURCE = """/* A module. */
#include "module.h"

/* It stays. [SR-01] */
bool stays(int x) {
    return x > 0;
}

static int other(int x) {
    return x + 1;
}
"""
TEST = """// [SR-01]
TEST(Module, stays) {
}
"""
PLANTED = """[[group]]
file = "firmware/module.c"
found_by = ["test_module"]
bugs = [["fall: it falls", "x > 0", "x < 0"], ["rise: it rises", "x + 1", "x + 2"]]
"""
UNIT, HIL = "tests/unit/monitors/test_module.cpp", "tests/hil/test_stall.py"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with one requirement, its implementation, its test, and two bugs."""
    for name, text in (("firmware/requirements.toml", TABLE), ("firmware/module.c", SOURCE), (UNIT, TEST),
                       ("tests/planted.toml", PLANTED), ("tests/mutants.toml", "")):
        write(tmp_path, name, text)
    return tmp_path


def write(root: Path, name: str, text: str) -> None:
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(text, encoding="utf-8")


def replace(root: Path, name: str, old: str, new: str) -> None:
    text = (root / name).read_text(encoding="utf-8")
    assert old in text
    write(root, name, text.replace(old, new))


def test_every_requirement_of_this_repository_is_met_and_every_test_of_the_safety_part_has_one() -> None:
    assert violations() == []
    table = traceability.read()
    assert 30 <= len(table.requirements) <= 70
    in_part = [test for test in traceability.every_test() if traceability._in_safety_part(test.file)]
    assert len(in_part) > 400
    assert all((ROOT / pattern).exists() for pattern in traceability.SAFETY_PART if "*" not in pattern)


def test_no_test_is_overlooked() -> None:
    for path in (*sorted((ROOT / "tests").glob("unit/**/test_*.cpp")), *sorted((ROOT / "tests").glob("hil/test_*.py"))):
        text = path.read_text(encoding="utf-8")
        found = [test for test in in_tests(str(path), text) if test.name != "?"]
        assert len(found) == len(re.findall(r"^(?:TEST|def test_)", text, re.MULTILINE)), path


def test_a_checkout_whose_requirements_are_met_has_no_breach(checkout: Path) -> None:
    assert violations(checkout) == []


@pytest.mark.parametrize(("name", "old", "new", "line"), [
    ("firmware/module.c", " [SR-01]", "", "firmware/requirements.toml: SR-01: no function implements it"),
    (UNIT, "// [SR-01]\n", "// [SR-01]\n// a second line\n", ""),
    (UNIT, "// [SR-01]\n", "", f"{UNIT}:1: Module.stays: a test of the safety part without a requirement"),
    (UNIT, "TEST(Module, stays)", "static void helper(void)", "firmware/requirements.toml: SR-01: no test"),
    (UNIT, "[SR-01]", "[SR-01] [SR-02]", f"{UNIT}:2: [SR-02]: no requirement of firmware/requirements.toml"),
    ("firmware/module.c", "[SR-01]", "[SR-01] [SR-03]",
     "firmware/module.c:4: [SR-03]: no requirement of firmware/requirements.toml"),
    ("firmware/module.c", "    return x > 0;", "    return x > 0; /* [SR-01] */",
     "firmware/module.c:6: SR-01: belongs to no function, test or row"),
    ("firmware/requirements.toml", 'hazards = ["H-1"]', 'hazards = ["H-2"]',
     "firmware/requirements.toml: SR-01: H-2: no hazard of the file"),
    ("firmware/requirements.toml", 'function = "F"', 'function = "G"',
     "firmware/requirements.toml: SR-01: G: no safety function of the file"),
])  # fmt: skip
def test_each_kind_of_breach_is_told(checkout: Path, name: str, old: str, new: str, line: str) -> None:
    replace(checkout, name, old, new)
    lines = violations(checkout)
    assert line in lines if line else lines == []


def test_a_second_test_of_the_safety_part_needs_a_mark_of_its_own_or_the_file_s(checkout: Path) -> None:
    write(checkout, UNIT, f"{TEST}TEST_F(Module, falls) {{\n}}\n")
    assert violations(checkout) == []  # the first comment is the file's
    write(checkout, UNIT, f"#include <x>\n{TEST}TEST_F(Module, falls) {{\n}}\n")
    assert violations(checkout) == [f"{UNIT}:5: Module.falls: a test of the safety part without a requirement"]
    write(checkout, HIL, '"""Stall."""\n\n\n# [SR-01]\n@pytest.mark.parametrize("a", [\n    1,\n])\n'
                         "def test_a(a):\n    pass\n\n\ndef test_b():\n    pass\n")
    assert f"{HIL}:12: test_b: a test of the safety part without a requirement" in violations(checkout)
    assert not any("test_a" in line for line in violations(checkout))


def test_a_test_outside_of_the_safety_part_needs_no_mark(checkout: Path) -> None:
    write(checkout, "tests/unit/control/test_law.cpp", "TEST(Law, holds) {\n}\n")
    assert violations(checkout) == []


def test_a_mark_of_a_test_replaces_the_file_s() -> None:
    text = "// Head. [SR-01]\n#include <x>\n// [SR-02]\nTEST(A, b) {\n}\nTEST(A, c) {\n}\n"
    marked = list(in_tests("test_a.cpp", text))
    assert [(each.name, each.names) for each in marked] == [("A.b", ("SR-02",)), ("A.c", ("SR-01",))]


def test_a_mark_of_a_c_file_is_the_file_s_a_function_s_or_a_row_s() -> None:
    text = ("/* Head. [SR-01] */\n/* [SR-02]\n */\nCOLD static uint32_t f(const int *a,\n    int b) {\n}\n"
            "const int c = 1; /* [SR-03] */\n")
    assert [(each.name, each.names) for each in in_c("a.c", text)] == [
        ("", ("SR-01",)), ("f", ("SR-02",)), ("?", ("SR-03",))]
    assert [each.name for each in in_c("a.def", "\n/* [SR-01] */\nROW(NAME, 1)\n")] == ["NAME"]
    assert list(in_c("a.c", 'const char *text = "/* [SR-01] */";\n')) == []


def bugs_of(root: Path, name: str) -> list[str]:
    planted.bugs.cache_clear()
    return traceability.trace(root)[name].bugs


def test_a_bug_belongs_to_the_requirements_of_its_function_by_its_claim(checkout: Path) -> None:
    assert bugs_of(checkout, "SR-01") == ["fall: it falls"]
    replace(checkout, "tests/planted.toml", "fall: it falls", "else: it falls")  # a claim of no requirement
    assert bugs_of(checkout, "SR-01") == ["else: it falls"]
    replace(checkout, "tests/planted.toml", "else: it falls", "fall: at once: it falls")
    another = TABLE[TABLE.index("[requirement."):].replace("SR-01", "SR-02").replace('["fall"]', '["fall: at once"]')
    write(checkout, "firmware/requirements.toml", TABLE.replace('["fall"]', '["fall: later"]') + another)
    replace(checkout, "firmware/module.c", "[SR-01]", "[SR-01] [SR-02]")
    assert (bugs_of(checkout, "SR-01"), bugs_of(checkout, "SR-02")) == ([], ["fall: at once: it falls"])


def test_most_requirements_have_a_planted_bug_and_every_one_a_bug_or_a_checker() -> None:
    traces = traceability.trace()
    assert [name for name, trace in traces.items() if not trace.bugs and not trace.checkers] == []
    assert sum(bool(trace.bugs) for trace in traces.values()) >= len(traces) - 1
    assert {bug for trace in traces.values() for bug in trace.bugs} <= {bug.name for bug in planted.bugs()}


def test_the_page_is_generated_and_prints_what_is_behind_a_row(monkeypatch: pytest.MonkeyPatch,
                                                               capsys: pytest.CaptureFixture[str]) -> None:
    expected = requirements.page(traceability.read(), traceability.trace())
    assert requirements.PAGE.read_text(encoding="utf-8") == expected, "run tools/salient docs --generate"
    monkeypatch.setattr("sys.argv", ["requirements", "SR-03"])
    assert requirements.main() == 0
    printed = capsys.readouterr().out
    assert "implemented: firmware/monitors/sto_monitor.c: sto_monitor_failed" in printed
    assert "test: tests/unit/monitors/test_sto_monitor.cpp: StoMonitor.other_breaks_are_no_discrepancy" in printed
    monkeypatch.setattr("sys.argv", ["requirements", "SR-99"])
    with pytest.raises(UsageError, match="SR-99"):
        requirements.main()


def test_the_diagnostic_coverage_is_counted_from_the_measured_page() -> None:
    text = fault_table.PAGE.read_text(encoding="utf-8")
    assert diagnostic_coverage.PAGE.read_text(encoding="utf-8") == diagnostic_coverage.page(text), \
        "run tools/salient docs --generate"
    parts = diagnostic_coverage.parts(text)
    measured = [case for case in fault_table.CASES if diagnostic_coverage.part_of(case)]
    assert sum(part.cells + part.not_measured for part in parts.values()) == 12 * len(measured)
    part = parts["sensor of the DC link"]
    assert (part.cells, part.detected, part.percent) == (36, 24, 66)
    assert dict(part.undetected) == {"link sensor, gain 0.8": 12}
    assert parts["encoder"].percent == 100 and parts["encoder"].longest_ms > 100
