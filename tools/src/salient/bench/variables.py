"""Variables of the drive's memory by name, with their units: for the triggered buffer, and for XCP's A2L file.

A name is the path of a member of drive_t ("control.observer.speed_q22", "control.measurement.current_q9[0]"), or one of
SIGNALS. Where a member's name tells its format ("torque..._q24": N m, Q7.24) its value is in that unit; with any other
fraction it is that number; else it is an integer, or the name of an enumeration's value.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from salient.dbc import PHASES
from salient.drive_layout import Layout, Variable, layout_file
from salient.errors import UsageError, close_names
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.machine.scaling import Exponents, scaling_of

SIGNALS = {
    "speed_rpm": "control.observer.speed_q22",
    "load_torque_Nm": "control.observer.load_torque_q24",
    "torque_reference_Nm": "control.torque_reference_q24",
    "torque_Nm": "control.measurement.torque_sum_q24",
    "dc_link_voltage_V": "control.measurement.dc_link_voltage_q6",
    "angle_deg": "control.measurement.angle",
    "encoder_angle_deg": "control.measurement.encoder_angle",
    "state": "control.state_machine.state",
    "fault": "control.state_machine.record.fault",
    "used_ticks": "used_ticks",
    **{f"current_{phase}_A": f"control.measurement.current_q9[{index}]" for index, phase in enumerate(PHASES)},
    **{f"duty_{phase}": f"control.duty_q15[{index}]" for index, phase in enumerate(PHASES)},
}
"""Short names of what is looked at most, with their units."""

_FORMATS = (
    (r"\w*(torque|load)\w*_q24", "N m", 1.0),
    (r"\w*speed\w*_q22", "r/min", 30.0 / math.pi),
    (r"\w*current\w*_q9", "A", 1.0),
    (r"\w*voltage\w*_q6", "V", 1.0),
    (r"\w*flux\w*_q29", "Wb", 1.0),
)
"""Unit of the members whose name has a quantity and its fraction bits (firmware/fixed/formats.h), and the factor to it
from the SI unit, by which the machine's exponents count."""
_REV_DEG = 360.0 / 2.0**32


@dataclass(frozen=True)
class Quantity:
    """A variable with its unit: value = raw * factor."""

    name: str
    variable: Variable
    unit: str
    factor: float


class Variables:
    """The variables of a build's drive. machine: of the drive, whose exponents its units have; None: SI units.
    UsageError: the build has no layout; of quantity(): there is no variable of that name."""

    def __init__(self, build: str = "host", machine: str | None = None) -> None:
        self.layout = Layout(layout_file(build))
        path = None if machine is None else machine_path(machine)
        self._exponents = Exponents() if path is None else scaling_of(path, load_machine(path)).exponents
        self._variables = {variable.path: variable for variable in self.layout.variables()}

    @property
    def paths(self) -> Collection[str]:
        """Paths of all variables."""
        return self._variables.keys()

    def quantities(self) -> Iterator[Quantity]:
        """All, in the order of the memory."""
        return (self._quantity(path, variable) for path, variable in self._variables.items())

    def quantity(self, name: str) -> Quantity:
        """A variable by its path or its name in SIGNALS."""
        path = SIGNALS.get(name, name)
        if path not in self._variables:
            raise UsageError(f"signal '{name}': no variable of the drive; "
                             f"{close_names(name, [*SIGNALS, *self._variables])}")
        return self._quantity(name, self._variables[path])

    def _quantity(self, name: str, variable: Variable) -> Quantity:
        member = variable.path.rsplit(".", 1)[-1].partition("[")[0]
        fraction = re.search(r"_q(\d+)$", member)
        if fraction is None:
            is_angle = (member == "angle" or member.endswith("_angle")) and variable.bytes == 4 \
                and not variable.is_signed
            return Quantity(name, variable, *(("deg", _REV_DEG) if is_angle else (_unit_of(member), 1.0)))
        for pattern, unit, factor in _FORMATS:
            if re.fullmatch(pattern, member):
                exponent = self._exponents.of_unit(unit) - int(fraction[1])
                return Quantity(name, variable, unit, math.ldexp(factor, exponent))
        return Quantity(name, variable, "", math.ldexp(1.0, -int(fraction[1])))


def _unit_of(member: str) -> str:
    """Unit of an integer by the end of its name."""
    for end, unit in (("_rad_s", "rad/s"), ("_us", "us"), ("_ms", "ms"), ("_ticks", "ticks"), ("_hz", "Hz")):
        if member.endswith(end):
            return unit
    return ""


def short_names(names: Mapping[int, str]) -> dict[int, str]:
    """Names of an enumeration's values as telemetry has them: without the words that all of them begin with, in lower
    case."""
    words = [name.split("_") for name in names.values()]
    shared = 0
    while words and all(len(each) > shared + 1 and each[shared] == words[0][shared] for each in words):
        shared += 1
    return {value: "_".join(each[shared:]).lower() for value, each in zip(names, words, strict=True)}
