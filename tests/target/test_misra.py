"""MISRA C:2012 by cppcheck: each finding has a deviation, a new one and a growing count are told, and so is a deviation
that is not needed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from salient.errors import UsageError
from salient.experiments import misra
from salient.experiments.misra import TABLE, Deviation, Finding, deviations, judge, lowered, text_of
from salient.paths import BUILD, ROOT

FILE = "firmware/fixed/crc32.c"
PLANTED = """
static int32_t planted(int32_t a) {
    int32_t unset;
    if (a > 0) return unset;
    return a << 3;
}
"""


def found(*places: tuple[str, str]) -> list[Finding]:
    return [Finding(file, line, 1, rule) for line, (file, rule) in enumerate(places, start=1)]


def test_a_finding_without_a_deviation_is_told() -> None:
    table = [Deviation("15.5", "reason", {"firmware": 1})]
    assert judge(found((FILE, "15.5")), table) == []
    assert judge(found((FILE, "15.5"), (FILE, "17.7"), ("hal/hal.h", "15.5")), table) == [
        f"{FILE}:2: 17.7: no deviation of misra.toml", "hal/hal.h:3: 15.5: no deviation of misra.toml"]


def test_a_deviation_that_is_not_needed_and_a_count_that_grows_are_told() -> None:
    table = [Deviation("18.4", "reason", {FILE: 1})]
    assert judge([], table) == [f"{FILE}: 18.4: a deviation of misra.toml that is not needed"]
    assert judge(found((FILE, "18.4"), (FILE, "18.4")), table) == [
        f"{FILE}: 18.4: 2 findings, 1 stated; --list 18.4"]


def test_a_finding_belongs_to_the_narrowest_scope() -> None:
    table = [Deviation("5.9", "wide", {"firmware": 3}), Deviation("5.9", "narrow", {"firmware/fixed": 1, FILE: 2})]
    places = found((FILE, "5.9"), ("firmware/fixed/fixed.h", "5.9"), ("firmware/fixed.c", "5.9"))
    assert judge(places, table) == []
    assert [each.findings for each in lowered(places[:2], table)] == [{"firmware/fixed": 1, FILE: 1}]


@pytest.mark.parametrize(("entry", "message"), [
    ('rule = "5.9"', "no table"),
    ('rule = "5.9"\nreason = " "\nfindings = { "hal" = 1 }', "5.9: a deviation has a reason"),
    ('rule = "5.9"\nreason = "a"\nfindings = { "emulator" = 1 }', "emulator: no scope of its own"),
    ('rule = "5.9"\nreason = "a"\nfindings = { "hal" = 0 }', "hal: no scope of its own"),
    *((f'rule = "{rule}"\nreason = "a"\nfindings = {{ "firmware" = 1 }}', "firmware: this rule is explained by file")
      for rule in ("1.3", "9.1", "12.2", "13.4", "17.7", "18.4", "21.15", "22.1", "uninitvar")),
])
def test_a_wrong_table_is_an_error_that_names_it(entry: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "misra.toml").write_text(f"[[deviation]]\n{entry}\n", encoding="utf-8")
    with pytest.raises(UsageError, match=message):
        deviations(tmp_path / "misra.toml")


def test_the_committed_table_is_as_it_is_written_and_of_files_that_exist() -> None:
    text = TABLE.read_text(encoding="utf-8")
    assert text_of(deviations(), text.partition("[[")[0]) == text
    assert all((ROOT / scope).exists() for each in deviations() for scope in each.findings)


def test_without_cppcheck_its_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    misra.addon.cache_clear()
    with pytest.raises(UsageError, match="apt-get install cppcheck"):
        misra.addon()


@pytest.mark.in_turns
def test_a_planted_violation_is_found(tmp_path: Path) -> None:
    misra.build()
    unit = next(unit for unit in misra.units() if unit.source == FILE)
    misra.copy_sources(tmp_path)
    def findings() -> list[Finding]:
        return [Finding(*each) for each in misra.analyse((unit, tmp_path))["found"] if each[0] == FILE]

    before = findings()
    counts = Counter(each.rule for each in before)
    table = [Deviation(rule, "reason", {FILE: count}) for rule, count in counts.items()]
    assert "15.5" not in counts and counts["17.8"] > 0 and judge(before, table) == []
    source = tmp_path / FILE
    source.write_text(source.read_text(encoding="utf-8") + PLANTED, encoding="utf-8")
    rules = {line.split(": ")[1] for line in judge(findings(), table)}
    assert {"15.5", "15.6", "10.1", "uninitvar"} <= rules


@pytest.mark.in_turns
def test_all_findings_have_a_deviation_and_all_deviations_findings() -> None:
    assert judge(misra.measure(BUILD / "misra"), deviations()) == []
