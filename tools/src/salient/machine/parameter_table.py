"""The drive's parameters as firmware/storage/parameters.def has them."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

from salient.config import CONTROLLERS
from salient.paths import PARAMETERS

SAME_UNITS = ("", "1/s", "s", "ms", "deg", "rad/s", "C")
"""Units of the parameters whose range and resolution are the same for every machine."""

CHOICES = {
    "controller": CONTROLLERS,
    "bp_mode": ("off", "fixed_gains", "network_without_learning", "network_with_learning"),
    "load_source": ("observer", "torque_transducer"),
}
"""Names of the values of parameters that select something, from 0; their texts in the table have the same words."""

_CONSTANTS = {"INT32_MAX": 2**31 - 1}


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
    tunable: bool
    """It may be changed in a run."""

    @property
    def limits(self) -> tuple[float, float]:
        """Minimum and maximum in the unit."""
        return self.minimum / (1 << self.fraction_bits), self.maximum / (1 << self.fraction_bits)

    def physical(self, raw: int) -> str:
        """A raw value in the unit: the shortest decimal number that identifies it."""
        lsb = Fraction(1, 1 << self.fraction_bits)
        value = raw * lsb
        for digits in range(12):
            rounded = round(value, digits)
            if abs(rounded - value) < lsb / 2:
                return f"{float(rounded):.{digits}f}"
        raise ValueError(f"{self.name}: {raw} has no decimal number of 11 digits")


def value_name(name: str, value: float) -> str | None:
    """Name of a value of a parameter; None where it has none."""
    names = CHOICES.get(name, ())
    return names[int(value)] if value in range(len(names)) else None


def value_number(name: str, value: object) -> object:
    """The number of a value that is given by its name, else what is given."""
    names = CHOICES.get(name, ())
    return names.index(value) if isinstance(value, str) and value in names else value


@lru_cache
def read_table() -> tuple[ParameterDefinition, ...]:
    """All rows of parameters.def, by index."""
    source = re.sub(r"/\*.*?\*/", "", PARAMETERS.read_text(encoding="ascii"), flags=re.DOTALL)
    source = re.sub(r"^#.*$", "", source, flags=re.MULTILINE)  # directives
    calls = ast.parse(re.sub(r"\)\s*(TUNABLE_)?PARAMETER\(", r")\n\1PARAMETER(", source.strip())).body
    rows = []
    for index, statement in enumerate(calls):
        match statement:
            case ast.Expr(value=ast.Call(func=ast.Name(id=kind), args=[
                ast.Name(id=constant), ast.Constant(value=str(name)), ast.Constant(value=str(unit)),
                ast.Constant(value=int(bits)), minimum, maximum, default, ast.Constant(value=str(text)),
            ])):
                rows.append(ParameterDefinition(index, constant, name, unit, bits, _value(minimum), _value(maximum),
                                                _value(default), text, kind == "TUNABLE_PARAMETER"))
            case _:
                raise ValueError(f"{PARAMETERS}: {ast.unparse(statement)} is not a row of the table")
    return tuple(rows)


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
    raise ValueError(f"{PARAMETERS}: {ast.unparse(node)} is not a constant of the table")
