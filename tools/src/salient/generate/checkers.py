"""Writes the list of the campaign's checkers from their sources, emulator/campaign/checkers.

    python -m salient.generate.checkers

writes docs/reference/checkers.md. A checker's text is the first comment of its file.
"""

from __future__ import annotations

import re
import sys

from salient.paths import REFERENCE, ROOT

CAMPAIGN = ROOT / "emulator" / "campaign"
PAGE = REFERENCE / "checkers.md"

_HEAD = """# The campaign's checkers

Generated from `emulator/campaign/checkers/` by `python -m salient.generate.checkers`; do not edit.

Each judges one property of every world of a [campaign](../testing/campaigns.md). Inputs are the plant's true values,
the present faults, the clients' intent, and the drive's state, first cause and measurements (`observation.h`).

- `fault_effects.c` has the quantities that each fault disturbs, and the causes that it may have.
- A disturbance excuses while it is present and for 200 ms after its end.
- A rule has no exception for a weakness of the drive. Known deviations are in `tests/campaign/known.toml`, by seed.
"""

_GROUPS = {
    "CHECKER_NEVER": "Never",
    "CHECKER_IN_TIME": "In time",
    "CHECKER_SOMETIMES": "Sometimes",
}


def table() -> list[tuple[str, str]]:
    """Group and name of each checker, in the order of the table in the code, which also has its kinds of worlds."""
    text = (CAMPAIGN / "checkers" / "table.c").read_text(encoding="utf-8")
    return re.findall(r"\{(CHECKER_\w+), CHECKER_\w+, &(\w+)_checker\}", text)


def property_of(name: str) -> str:
    """Property that a checker's file states, without its marks (salient.traceability)."""
    text = (CAMPAIGN / "checkers" / f"{name}.c").read_text(encoding="utf-8")
    found = re.match(r"/\*(.*?)\*/", text, re.DOTALL)
    text = re.sub(r" \[SR-\d\d\]", "", found[1].replace("\n *", " ")) if found else ""
    return " ".join(text.split())


def page() -> str:
    """The list, in Markdown."""
    lines = [_HEAD]
    for group, title in _GROUPS.items():
        rows = [f"| `{name}` | {property_of(name)} |" for of, name in table() if of == group]
        lines.append("\n".join([f"## {title}", "", "| rule | property |", "| --- | --- |", *rows, ""]))
    return "\n".join(lines)


def main() -> int:
    """Writes the page; returns the exit code."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
