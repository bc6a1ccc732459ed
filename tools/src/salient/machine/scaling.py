"""Units of the firmware's formats for a machine: powers of two of the SI units (firmware/control/machine_tables.h).

    current 2^a A, voltage and flux linkage 2^v V and Wb, torque 2^t N m, speed 2^w rad/s, time s, angle rev

A power of two moves the binary point of a format and nothing else: the firmware's arithmetic, the codes of its sensors
and the integers of its parameters are the same for every machine, and a factor of the bus stays an exact number. Torque
is not tied to current, voltage and speed, because no law of the firmware uses T = dW / dtheta: it has a table of its
own.

The rule, the same for every machine:

- current and voltage: the sensors' full scale is within 80 units of current, 512 of voltage, and above half of it. The
  flux linkage up to the full scale of the current must be below 4 units: otherwise the voltage's unit is larger, by a
  factor of four at most.
- torque: torque_peak_Nm is within 40 units, the range of torque_max_Nm, and above 10. The format has 10^7
  steps per N m, so that a finer unit would have no use; the firmware's thresholds, such as 1 N m for learning and
  0.05 N m for a shortfall, suit machines of which the largest has four times the torque of the smallest.
- speed: over_speed_rpm is within 4800 units of r/min; never below one rad/s, as 2.4e-7 rad/s are fine enough for any.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache

import cantools
from cantools.database.can import Database

from salient.dbc import drive_dbc_of_phases
from salient.machine.drive_data import CURRENT_RANGE_A, SAMPLES_PER_TURN_MIN, DriveData, derive
from salient.machine.facts import Facts
from salient.machine.file import Machine, MachineError
from salient.machine.parameter_table import ParameterDefinition, read_table
from salient.paths import DRIVE_DBC

VOLTAGE_RANGE_V, LOAD_TORQUE_RANGE_NM = 512.0, 64.0
"""As CURRENT_RANGE_A, full scales of the sensors in units of the machine, at most; the torque transducer's
always."""
FLUX_LINKAGE_RANGE_WB, TORQUE_RANGE_NM, SPEED_RANGE_RPM = 4.0, 40.0, 4800.0
FLUX_LINKAGE_MORE = 2
SPEED_EXPONENT_MAX = 3
SPEED_COMMAND_RPM = 3000.0
"""A frame of every drive may command up to this speed, of a faster machine up to its own; the drive limits it to the
machine's."""
SPEED_REFERENCE_PART = 7.0 / 8.0
"""Part of over_speed_rpm to which the firmware limits a speed reference (firmware/interrupts/configure.c)."""
SPEED_LSB_RPM = Fraction(1, 1000)
"""Factor of the speeds in the DBC with SI units."""
_COMMAND, _COMMAND_SIGNAL = "DRIVE_COMMAND", "speed_reference_rpm"


@dataclass(frozen=True)
class Exponents:
    """Powers of two, for the units of a machine's formats; 0: SI."""

    current: int = 0
    voltage: int = 0
    torque: int = 0
    speed: int = 0

    def of_unit(self, unit: str) -> int:
        """Exponent of an SI unit (r/min with a speed): 0 for one that no exponent changes."""
        return {
            "A": self.current,
            "V": self.voltage,
            "Wb": self.voltage,
            "ohm": self.voltage - self.current,
            "N m": self.torque,
            "N m/s": self.torque,
            "1/(N m)": -self.torque,
            "N m s": self.torque - self.speed,
            "kg m^2": self.torque - self.speed,
            "r/min": self.speed,
            "r/min/s": self.speed,
            "r/min/s^2": self.speed,
            "s/rad": -self.speed,
            "N m/rad": self.torque - self.speed,
        }.get(unit, 0)

    def of_parameter(self, row: ParameterDefinition) -> int:
        """For a parameter's unit. Per angle as per speed and second: an integral of the speed is in its units."""
        unit = {"speed_ki": "N m/rad", "smc_delta": "s/rad"}.get(row.name, row.unit)
        return self.of_unit(unit)

    def fraction_bits(self, row: ParameterDefinition) -> int:
        """Bits of a parameter's raw value in its SI unit; negative: the LSB is a power of two above one."""
        return row.fraction_bits - self.of_parameter(row)

    def raw(self, row: ParameterDefinition, value: float) -> int:
        """The raw value nearest to one in the SI unit, within the parameter's range."""
        return max(row.minimum, min(row.maximum, math.floor(math.ldexp(value, self.fraction_bits(row)) + 0.5)))


@dataclass(frozen=True)
class Scaling:
    """A machine's data and units."""

    data: DriveData
    exponents: Exponents
    phases: int

    def raw_parameters(self) -> list[int]:
        """Raw default of every parameter, by index."""
        return [self.exponents.raw(row, self.data.parameters[row.name]) for row in read_table()]

    def fraction_bits(self) -> list[int]:
        """Bits of every parameter, by index."""
        return [self.exponents.fraction_bits(row) for row in read_table()]

    def sensor_ranges(self) -> dict[str, float]:
        """Full scales: the emulator's sensor_ranges_t."""
        return {"current_A": self.data.adc_current_A, "dc_link_V": self.data.adc_voltage_V,
                "load_torque_Nm": math.ldexp(LOAD_TORQUE_RANGE_NM, self.exponents.torque)}

    def control_rate_min_hz(self, machine: Machine) -> int:
        """Control rate that the highest speed of the file requires; 0 when the file states none: it is then derived
        from the control rate of the file, and lower at a lower one."""
        turns_1_s = self.data.speed_max_rpm / 60.0 * machine.rotor_poles
        return math.ceil(SAMPLES_PER_TURN_MIN * turns_1_s * (1.0 - 1e-9)) if "speed_max_rpm" in machine.drive else 0

    @property
    def speed_range_rpm(self) -> float:
        """Largest speed reference of the machine with its default parameters, in whole LSBs of the bus."""
        return float(self._bus_speed(self._limit_rpm) * self._bus_lsb_rpm)

    @property
    def _limit_rpm(self) -> float:
        return min(self.data.speed_max_rpm, SPEED_REFERENCE_PART * self.data.over_speed_rpm)

    @property
    def speed_max_q22(self) -> int:
        """The machine's highest speed as the firmware has it, with an LSB more for the conversion of a command."""
        return math.ceil(math.ldexp(self.data.speed_max_rpm * math.pi / 30.0, 22 - self.exponents.speed)) + 1

    @property
    def speed_reference_max(self) -> int:
        """Magnitude of the largest command that a frame may have, in LSBs of the bus."""
        return self._bus_speed(max(SPEED_COMMAND_RPM, self.data.speed_max_rpm))

    def _bus_speed(self, speed_rpm: float) -> int:
        """In LSBs of the bus, rounded down."""
        return math.floor(Fraction(speed_rpm) / self._bus_lsb_rpm)

    @property
    def _bus_lsb_rpm(self) -> Fraction:
        return SPEED_LSB_RPM * Fraction(2) ** self.exponents.speed

    def dbc(self) -> str:
        """Text of the drive's CAN database: firmware/comms/drive.dbc with the factors and ranges of this machine."""
        return drive_dbc(self.exponents, self._bus_speed(self._limit_rpm), self.phases)


def scaling_of(path: object, machine: Machine) -> Scaling:
    """The units for a machine; MachineError, with its path, for one that they do not fit."""
    data = derive(machine)
    try:
        exponents = choose(data, machine)
        _check(data, exponents, machine)
    except _OutOfRange as error:
        raise MachineError(f"{path}: {error}") from None
    return Scaling(data, exponents, machine.phases)


class _OutOfRange(ValueError):
    """A key and the range that its value has to be in."""


def choose(data: DriveData, machine: Machine) -> Exponents:
    """The exponents of a machine, by the rule above."""
    current = _exponent(data.adc_current_A, CURRENT_RANGE_A)
    flux_Wb = float(machine.magnetics.flux_linkage_Wb(0.0, math.ldexp(CURRENT_RANGE_A, current)))
    voltage = _exponent(data.adc_voltage_V, VOLTAGE_RANGE_V)
    return Exponents(
        current=current,
        voltage=max(voltage, min(_exponent(flux_Wb, 0.98 * FLUX_LINKAGE_RANGE_WB), voltage + FLUX_LINKAGE_MORE)),
        torque=2 * math.ceil(_exponent(data.torque_peak_Nm, TORQUE_RANGE_NM) / 2),
        speed=max(0, _exponent(data.over_speed_rpm, SPEED_RANGE_RPM)),
    )


def _exponent(value: float, full_scale: float) -> int:
    """The least n for which the value is at most full_scale * 2^n."""
    return math.ceil(math.log2(value / full_scale) - 1e-9)


def _check(data: DriveData, exponents: Exponents, machine: Machine) -> None:
    if exponents.speed > SPEED_EXPONENT_MAX:
        limit = math.ldexp(SPEED_RANGE_RPM, SPEED_EXPONENT_MAX)
        raise _OutOfRange(f"drive.speed_max_rpm: its limit over_speed_rpm is {data.over_speed_rpm:g} r/min; must be at"
                          f" most {limit:g}")
    rows = {row.name: row for row in read_table()}
    values = {f"drive.parameters.{name}": (rows[name], value) for name, value in machine.drive_parameters.items()}
    values["mechanics.inertia_kg_m2"] = (rows["inertia_kg_m2"], machine.inertia_kg_m2)
    values["mechanics.friction_Nm_s"] = (rows["friction_Nm_s"], machine.friction_Nm_s)
    for key, (row, value) in values.items():
        low, high = (math.ldexp(raw, -exponents.fraction_bits(row)) for raw in (row.minimum, row.maximum))
        if not low - 1e-6 * abs(low) <= value <= high + 1e-6 * abs(high):
            unit, facts = f" {row.unit}".rstrip(), Facts(machine)
            of_speed = f" and {facts.shown('speed_max_rpm')}" if exponents.speed and exponents.of_parameter(row) else ""
            raise _OutOfRange(f"{key}: {value:g}{unit}: must be a number from {low:.4g} to {high:.4g}{unit}, for a"
                              f" machine of {facts.shown('torque_peak_Nm')}{of_speed}")


# --- CAN database ---------------------------------------------------------------------------------------------------

_MESSAGE_LINE = re.compile(r"BO_ \d+ (\w+):")
_SIGNAL_LINE = re.compile(r'( SG_ (\w+) [^(]*)\(([^,]+),([^)]+)\) \[([^|]+)\|([^]]+)\] ("([^"]*)".*)')


def drive_dbc(exponents: Exponents, speed_range: int, phases: int) -> str:
    """Text of firmware/comms/drive.dbc for these units: factors and ranges times powers of two, and the range of the
    commands in LSBs, with the messages that a machine of so many phases has. With SI units, 3000 r/min and more than
    four phases it is that file."""
    lines, message = [], ""
    text = drive_dbc_of_phases(DRIVE_DBC.read_text(encoding="ascii"), phases)
    for line in text.splitlines(keepends=True):
        if found := _MESSAGE_LINE.match(line):
            message = found[1]
        found = _SIGNAL_LINE.match(line)
        lines.append(_signal_line(message, found, exponents, speed_range) if found else line)
    return "".join(lines)


def _signal_line(message: str, line: re.Match[str], exponents: Exponents, speed_range: int) -> str:
    """The line of a signal of a message, with its factor, offset and range in the units."""
    head, name, *numbers, tail, unit = line.groups()
    exponent = exponents.of_unit(unit)
    factor, offset, low, high = (_plain(Fraction(number) * Fraction(2) ** exponent) if exponent else number
                                 for number in numbers)
    if (message, name) == (_COMMAND, _COMMAND_SIGNAL):
        high = _plain(Fraction(factor) * speed_range)
        low = f"-{high}"
    return f"{head}({factor},{offset}) [{low}|{high}] {tail}\n"


def _plain(number: Fraction) -> str:
    """Exact decimal number; `number` has a power of ten as a multiple of its denominator."""
    exact = Decimal(number.numerator) / Decimal(number.denominator)
    assert Fraction(exact) == number
    return f"{exact:f}"


@lru_cache
def database_of(text: str) -> Database:
    """A CAN database from the text of a DBC file."""
    database = cantools.database.load_string(text, "dbc", strict=True)
    assert isinstance(database, Database)  # as every DBC gives
    return database
