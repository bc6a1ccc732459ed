"""Parameters of a drive in a TOML file: `tools/salient parameters`.

    # parameters of a drive, in the units of the comments
    current_trip_A = 75.0  # A, 1 to 79
    controller = "salient"  # traditional, paper or salient

A value is the shortest decimal number that gives the drive's integer again, so that a file that was saved is loaded
without a difference. Of a parameter that selects something it is the name; its number is taken as well.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

from salient.bench.drive import ParameterRow, raw_value
from salient.bench.session import SILENCE_MAX_S, Session
from salient.config import either
from salient.errors import UsageError, close_names, shown
from salient.machine.parameter_table import CHOICES, value_name, value_number
from salient.paths import write_whole
from salient.toml_file import TextFileError, read_toml


def run(options: argparse.Namespace) -> int:
    """The action of a command line; its exit code."""
    with Session(options.can, lockstep=False, machine=options.machine, node=options.node,
                 silence_max_s=SILENCE_MAX_S, machine_option="--machine") as session:
        match options.action:
            case "save":
                return save(session, options.file)
            case "compare":
                return compare(session, options.file)
            case "load":
                return load(session, options.file, options.store)
            case _:
                return faults(session)


def save(session: Session, path: Path) -> int:
    """Writes all parameters of the drive; the file may exist."""
    parameters = session.drive.parameters
    lines = ["# parameters of a drive"]
    for name, row in parameters.rows.items():
        comment = f"{row.unit + ', ' if row.unit else ''}{_allowed(row)}"
        value = named(row, parameters[name])
        lines.append(f"{name} = {json.dumps(value) if name in CHOICES and not value.isdigit() else value}  # {comment}")
    try:
        write_whole(path, ("\n".join(lines) + "\n").encode())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    print(f"{len(parameters)} parameters: {path}")
    return 0


def compare(session: Session, path: Path) -> int:
    """Prints each parameter that differs and returns 1 when one does. Parameters that the file does not have are not
    compared."""
    wanted = read(path, session.drive.parameters.rows)
    differences = 0
    for name, value in wanted.items():
        row = session.drive.parameters.row(name)
        present = session.drive.parameters[name]
        if raw_value(row, value) != raw_value(row, present):
            differences += 1
            print(f"{name}: {named(row, present)} in the drive, {named(row, value)} in {path} {row.unit}".rstrip())
    print(f"{differences} of {len(wanted)} parameters differ")
    return 1 if differences else 0


def load(session: Session, path: Path, store: bool) -> int:
    """Sets the parameters that the file has, in one piece; nothing when the drive refuses them. store: in the memory as
    well."""
    values = read(path, session.drive.parameters.rows)
    session.drive.parameters.update(values)
    for name, value in values.items():
        print(f"{name} = {named(session.drive.parameters.row(name), value)}")
    if store:
        session.drive.parameters.save()
        print("stored in the memory of the drive")
    return 0


def faults(session: Session) -> int:
    """Prints the log of faults, the newest last."""
    log = session.drive.fault_log.read()
    for fault in log:
        others = [check for check in fault.checks if check != fault.fault]
        print(f"{fault.number:>5}  start {fault.start}  {fault.time_s:.6f} s  {fault.fault} in state {fault.state}  "
              f"{fault.speed_rpm:.2f} r/min  {fault.bus_voltage_V:.1f} V  {fault.current_max_A:.1f} A  "
              f"{fault.torque_reference_Nm:.2f} N m" + (f"  also {', '.join(others)}" if others else ""))
    if not log:
        print("no fault in the log")
    return 0


def read(path: Path, rows: dict[str, ParameterRow]) -> dict[str, float]:
    """The values of a file by name; UsageError with a line for each entry that cannot be used."""
    try:
        entries = read_toml(path)
    except TextFileError as error:
        raise UsageError(f"{path}: {error}") from None
    entries = {name: value_number(name, value) for name, value in entries.items()}
    mistakes = [f"{path}: {text}" for name, value in entries.items() if (text := _mistake(name, value, rows))]
    for line in mistakes[:-1]:
        print(f"salient: {line}", file=sys.stderr)
    if mistakes:
        raise UsageError(mistakes[-1])
    return {name: float(value) for name, value in entries.items()}


def _mistake(name: str, value: object, rows: dict[str, ParameterRow]) -> str:
    if name not in rows:
        return f"{shown(name)}: unknown parameter; {close_names(name, rows)}"
    row = rows[name]
    kind = "" if name in CHOICES else "a number from "
    allowed = f"{name}: {shown(value)}: must be {kind}{_allowed(row)} {row.unit}".rstrip()
    if isinstance(value, bool) or not isinstance(value, int | float) or (name in CHOICES and value != value // 1):
        return allowed
    lsb = math.ldexp(1.0, -row.fraction_bits)  # compared as it is: no float may have a whole number of a file
    return "" if row.minimum - lsb / 2 <= value <= row.maximum + lsb / 2 else allowed


def _allowed(row: ParameterRow) -> str:
    return either(CHOICES[row.name]) if row.name in CHOICES else _range(row)


def named(row: ParameterRow, value: float) -> str:
    """A value by its name, or as `decimal`."""
    return value_name(row.name, value) or decimal(row, value)


def _range(row: ParameterRow) -> str:
    return f"{decimal(row, row.minimum)} to {decimal(row, row.maximum)}"


def decimal(row: ParameterRow, value: float) -> str:
    """The shortest decimal number with the raw integer of the value."""
    raw = raw_value(row, value)
    if row.fraction_bits <= 0:
        return str(round(math.ldexp(raw, -row.fraction_bits)))
    for digits in range(1, 12):
        text = f"{value:.{digits}f}"
        if round(math.ldexp(float(text), row.fraction_bits)) == raw:
            return text
    return repr(value)
