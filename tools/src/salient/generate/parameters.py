"""Writes the reference page of the drive's parameters from their table, firmware/drive/parameters.def.

    python -m salient.generate.parameters

writes firmware/PARAMETERS.md.
"""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass
from fractions import Fraction

from salient.paths import ROOT

TABLE = ROOT / "firmware" / "drive" / "parameters.def"
PAGE = ROOT / "firmware" / "PARAMETERS.md"

_CONSTANTS = {"INT32_MAX": 2**31 - 1}
_HEAD = """# Parameters of the drive

Generated from `drive/parameters.def` by `python -m salient.generate.parameters`; do not edit.

The index addresses a parameter over CAN (PARAMETER_REQUEST in `comms/drive.dbc`); the raw value has an LSB of
2^-(fraction bits) of the unit. Writes are accepted outside state run. Angles are electrical degrees of the phase: 180
is the unaligned, 360 the aligned position. (traditional, paper, salient): used by these controllers only.

| index | name | unit | minimum | maximum | default | fraction bits | meaning |
| ---: | --- | --- | ---: | ---: | ---: | ---: | --- |
"""


@dataclass(frozen=True)
class ParameterDefinition:
    """One row of the table; minimum, maximum and default are raw."""

    index: int
    constant: str
    name: str
    unit: str
    fraction_bits: int
    minimum: int
    maximum: int
    default: int
    text: str

    def physical(self, raw: int) -> str:
        """A raw value in the unit: the shortest decimal number that identifies it."""
        lsb = Fraction(1, 1 << self.fraction_bits)
        value = raw * lsb
        for digits in range(12):
            rounded = round(value, digits)
            if abs(rounded - value) < lsb / 2:
                return f"{float(rounded):.{digits}f}"
        raise ValueError(f"{self.name}: {raw} has no decimal number of 11 digits")


def read_table() -> list[ParameterDefinition]:
    """All rows of parameters.def, by index."""
    source = re.sub(r"/\*.*?\*/", "", TABLE.read_text(encoding="ascii"), flags=re.DOTALL)
    calls = ast.parse(re.sub(r"\)\s*PARAMETER\(", ")\nPARAMETER(", source.strip())).body
    rows = []
    for index, statement in enumerate(calls):
        match statement:
            case ast.Expr(value=ast.Call(args=[
                ast.Name(id=constant), ast.Constant(value=str(name)), ast.Constant(value=str(unit)),
                ast.Constant(value=int(bits)), minimum, maximum, default, ast.Constant(value=str(text)),
            ])):
                rows.append(ParameterDefinition(index, constant, name, unit, bits, _value(minimum), _value(maximum),
                                                _value(default), text))
            case _:
                raise ValueError(f"{TABLE}: {ast.unparse(statement)} is not a row of the table")
    return rows


def _value(node: ast.expr) -> int:
    """Value of a constant expression as C computes it; Q is FIXED_CONSTANT of fixed/fixed.h."""
    match node:
        case ast.Constant(value=int(value)):
            return value
        case ast.Name(id=name) if name in _CONSTANTS:
            return _CONSTANTS[name]
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            return _value(left) - _value(right)
        case ast.Call(func=ast.Name(id="Q"), args=[numerator, denominator, bits]):
            divisor = _value(denominator)
            return ((_value(numerator) << _value(bits)) + divisor // 2) // divisor
    raise ValueError(f"{TABLE}: {ast.unparse(node)} is not a constant of the table")


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
