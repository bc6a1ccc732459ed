"""The table of verdicts in docs/safety/phases-and-encoder.md is the one that is compiled, monitors/flux_verdict.def."""

from __future__ import annotations

import re

from salient.paths import ROOT

ROW = re.compile(r"FLUX_VERDICT\((?P<fault>[A-Z_]+),\s+(?P<condition>[^\"]+),\s+(?P<text>(\"[^\"]*\"\s*)+)\)\n")
LEAST_ROWS = 8


def compiled() -> list[tuple[str, str]]:
    """Text and fault of each row of the file."""
    source = (ROOT / "firmware" / "monitors" / "flux_verdict.def").read_text(encoding="utf-8")
    code = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    rows = [("".join(re.findall(r"\"([^\"]*)\"", match["text"])), match["fault"].lower())
            for match in ROW.finditer(code)]
    assert len(rows) == code.count("FLUX_VERDICT(") > LEAST_ROWS
    return rows


def documented() -> list[tuple[str, str]]:
    """The same of the page."""
    page = (ROOT / "docs" / "safety" / "phases-and-encoder.md").read_text(encoding="utf-8")
    section = page.partition("## Verdicts by flux linkage\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| (.+) \| `(\w+)` \|$", section, flags=re.MULTILINE)


def test_the_table_of_the_page_is_the_compiled_one() -> None:
    assert documented() == compiled()
