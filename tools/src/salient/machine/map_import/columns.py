"""Names and units of columns."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

_ANGLE = {"deg": "deg", "degree": "deg", "degrees": "deg", "grad": "deg", "°": "deg", "rad": "rad", "radian": "rad",
          "radians": "rad", "mrad": "mrad", "mdeg": "mdeg", "rev": "rev", "revs": "rev",
          "turn": "rev", "turns": "rev", "revolutions": "rev"}
_CURRENT = {"a": 1.0, "amp": 1.0, "amps": 1.0, "ampere": 1.0, "amperes": 1.0, "ma": 1e-3, "ka": 1e3}
_FLUX = {name: factor for prefix, factor in (("", 1.0), ("m", 1e-3), ("u", 1e-6), ("µ", 1e-6), ("μ", 1e-6))
         for name in (prefix + unit for unit in (
             "wb", "vs", "v.s", "v*s", "v s", "v-s", "wb-turns", "wb-turn", "wb-t", "wbt", "wb turns", "wb.turns",
             "webers", "weber"))}
_INDUCTANCE = {"h": 1.0, "henry": 1.0, "mh": 1e-3, "uh": 1e-6, "µh": 1e-6, "μh": 1e-6}
_OTHER = {"s", "ms", "us", "ns", "v", "mv", "nm", "n.m", "n m", "mnewtonmeter", "newtonmeter", "j",
          "mj", "w", "t", "ohm", "hz", "rpm", "kg"}
_NAMES = (
    ("phase", r"^(phase|ph|winding|coil|strang)(_?(no|nr|number|id))?$"),
    ("other", r"torque|drehmoment|^time|^t$|volt|energ|loss|speed|^mm|(?:incr|diff).*induct"),
    ("inductance", r"induct|induktiv|^l$|^l_"),
    ("flux", r"flux|fluss|linkage|lambda|psi|λ|ψ|^wb|^f(?:l|tbl)"),
    ("angle", r"angle|theta|position|winkel|rotor|θ|^pos|^deg|^phi|elec|mech|displ|^th$"),
    ("current", r"current|strom|courant|^i\d?$|^i_|_i$|^i[abcd]{1,2}\d?(_|$)|amp|^curr"),
)


@dataclass(frozen=True)
class Column:
    """Meaning of a column or a value: role angle, current, flux, inductance (flux linkage by current), phase or
    other."""

    role: str
    unit: str | None = None
    """Unit of an angle: deg, rad, mdeg, mrad or rev, with "electrical " before it where the name says so."""
    factor: float | None = None
    """To A, Wb or H; None where no unit is stated."""


def column(name: str) -> Column | None:
    """The meaning of a column by its header; None where it has none that is known."""
    plain = re.split(r"\s+-\s+\S+\s*=|\s*@", name)[0].strip().lower().replace("ω", "")
    bracketed = re.findall(r"\[([^\]]*)\]|\(([^)]*)\)", plain)
    units = [unit.strip(" '\"") for pair in bracketed for unit in pair if unit]
    tail = re.search(r"(?:[_/,:]|\bin\b|\s)\s*([^\s_/,:]+)$", plain)
    candidates = list(reversed(units)) + ([tail[1]] if tail else []) + [plain]
    base = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", plain).strip(" _")
    role = next((role for role, pattern in _NAMES if re.search(pattern, base)), None)
    for unit in candidates:
        meaning = _by_unit(unit, base)
        if meaning is not None and (role in (None, meaning.role) or meaning.role == "other"):
            return meaning
    if role == "angle":
        return Column("angle", None) if "elec" not in plain else Column("angle", "electrical")
    return None if role is None else Column(role)


def _by_unit(unit: str, name: str) -> Column | None:
    bare = re.sub(r"[\s_.]*(elect?r?i?c?a?l?|mech(anical)?)\.?[\s_]*", "", unit)
    if bare in _ANGLE:
        return Column("angle", ("electrical " if "elec" in unit + name else "") + _ANGLE[bare])
    if unit in _CURRENT:
        return Column("current", factor=_CURRENT[unit])
    if unit in _FLUX:
        return Column("flux", factor=_FLUX[unit])
    if unit in _INDUCTANCE:
        return Column("inductance", factor=_INDUCTANCE[unit])
    return Column("other") if unit in _OTHER else None


def condition(name: str) -> tuple[Column, float] | None:
    """The current or angle that a header or title states for its values: I='5A', current = 5 A, 10 deg, 2.5mA."""
    for label, text, unit in reversed(re.findall(
            r"([^\W\d](?:\w*[^\W\d])?)?\s*[=:@]?\s*'?([+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)\s*([^\W\d]+|°)?", name)):
        value = float(text.replace(",", "."))
        by_unit = _by_unit(unit.lower(), label.lower()) if unit else None
        meaning = by_unit or (column(label) if label else None)
        if meaning is not None and meaning.role in ("current", "angle"):
            return meaning, value
    return None


def radians(unit: str, rotor_poles: int) -> float:
    """Factor of an angle's unit to electrical radians."""
    factor = {"deg": math.pi / 180.0, "rad": 1.0, "mdeg": math.pi / 180e3, "mrad": 1e-3,
              "rev": 2.0 * math.pi}[unit.rsplit(maxsplit=1)[-1]]
    return factor if unit.startswith("electrical") else factor * rotor_poles
