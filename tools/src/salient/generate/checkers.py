"""Writes the list of the campaign's checkers from their sources, emulator/campaign/checkers.

    python -m salient.generate.checkers

writes emulator/campaign/CHECKERS.md. A checker's text is the first comment of its file.
"""

from __future__ import annotations

import re
import sys

from salient.paths import ROOT

CAMPAIGN = ROOT / "emulator" / "campaign"
PAGE = CAMPAIGN / "CHECKERS.md"

_HEAD = """# The campaign's checkers

Generated from `checkers/` by `python -m salient.generate.checkers`; do not edit.

Each judges one property of every world, from true values of the plant, the faults that are there, what the clients
meant, and of the drive its state, its first cause and its measurements (`observation.h`). What each fault disturbs and
which causes it may have is in `fault_effects.c`. A disturbance excuses while it is there and for 200 ms after its end.
A rule has no exception for a weakness of the drive: deviations that are known are in `tests/campaign/known.toml`, by
seed.
"""

_GROUPS = {
    "CHECKER_NEVER": "Never",
    "CHECKER_IN_TIME": "In time",
    "CHECKER_SOMETIMES": "Sometimes",
}


def table() -> list[tuple[str, str]]:
    """Group and name of each checker, in the order of the table in the code."""
    text = (CAMPAIGN / "checkers" / "table.c").read_text(encoding="utf-8")
    return re.findall(r"\{(CHECKER_\w+), &(\w+)_checker\}", text)


def property_of(name: str) -> str:
    """Property that a checker's file states."""
    text = (CAMPAIGN / "checkers" / f"{name}.c").read_text(encoding="utf-8")
    found = re.match(r"/\*(.*?)\*/", text, re.DOTALL)
    return " ".join(found[1].replace("\n *", " ").split()) if found else ""


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
