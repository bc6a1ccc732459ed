"""Writes the reference page of the drive's parameters from their table, firmware/storage/parameters.def.

    python -m salient.generate.parameters

writes docs/reference/parameters.md.
"""

from __future__ import annotations

import sys

from salient.machine.parameter_table import read_table
from salient.paths import REFERENCE

PAGE = REFERENCE / "parameters.md"

_HEAD = """# Parameters of the drive

Generated from `firmware/storage/parameters.def` by `python -m salient.generate.parameters`; do not edit.

- *Index*: addresses the parameter over CAN.
- *Fraction bits*: the raw value has an LSB of 2^-(fraction bits) of the unit.
- *In run*: may be changed in state run, without a step of the law's state. The others change outside of it only.
- Angles are electrical degrees of the phase: 180 is the unaligned, 360 the aligned position.
- (traditional, paper, salient): used by these controllers only.

Read one with `PARAMETER_REQUEST`; change several as [one set](../can/parameters.md#a-set-of-parameters).

| index | name | unit | minimum | maximum | default | fraction bits | in run | meaning |
| ---: | --- | --- | ---: | ---: | ---: | ---: | --- | --- |
"""


def page() -> str:
    """The reference page."""
    lines = []
    for row in read_table():
        limits = " | ".join(row.physical(raw) for raw in (row.minimum, row.maximum, row.default))
        lines.append(
            f"| {row.index} | `{row.name}` | {row.unit} | {limits} | {row.fraction_bits} | "
            f"{'yes' if row.tunable else ''} | {row.text} |"
        )
    return _HEAD + "\n".join(lines) + "\n"


def main() -> int:
    """Writes the page; returns the exit code."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
