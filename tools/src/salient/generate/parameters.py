"""Writes the reference page of the drive's parameters from their table, firmware/drive/parameters.def.

    python -m salient.generate.parameters

writes firmware/PARAMETERS.md.
"""

from __future__ import annotations

import sys

from salient.machine.parameter_table import read_table
from salient.paths import ROOT

PAGE = ROOT / "firmware" / "PARAMETERS.md"

_HEAD = """# Parameters of the drive

Generated from `drive/parameters.def` by `python -m salient.generate.parameters`; do not edit.

The index addresses a parameter over CAN (PARAMETER_REQUEST in `comms/drive.dbc`); the raw value has an LSB of
2^-(fraction bits) of the unit. Writes are accepted outside state run. Angles are electrical degrees of the phase: 180
is the unaligned, 360 the aligned position. (traditional, paper, salient): used by these controllers only.

| index | name | unit | minimum | maximum | default | fraction bits | meaning |
| ---: | --- | --- | ---: | ---: | ---: | ---: | --- |
"""


def page() -> str:
    """The reference page."""
    lines = []
    for row in read_table():
        limits = " | ".join(row.physical(raw) for raw in (row.minimum, row.maximum, row.default))
        lines.append(
            f"| {row.index} | `{row.name}` | {row.unit} | {limits} | {row.fraction_bits} | {row.text} |"
        )
    return _HEAD + "\n".join(lines) + "\n"


def main() -> int:
    """Writes the page; returns the exit code."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
