"""The drive's data of a machine as a table and as JSON."""

from __future__ import annotations

import json
import math

from salient.machine.definition import Machine
from salient.machine.drive_data import DEFAULT, Derivation, DriveData, derive
from salient.machine.single_pulse import single_pulse

_PULSES_SHOWN = slice(2, None, 2)


def drive_lines(machine: Machine) -> list[str]:
    """Every value that the file states or a formula gives: name, value, unit, source, formula."""
    data = derive(machine)
    shown = [each for each in data.derivations if each.source != DEFAULT or each.name not in data.parameters]
    name_width = max(len(each.name) for each in shown)
    lines = [f"  {each.name:<{name_width}} {_number(each):>9} {each.unit:<8} {each.source:<10} {each.formula}"
             for each in shown]
    return [f"drive of {machine.name}, from its file or derived", *(line.rstrip() for line in lines),
            f"  {len(data.derivations) - len(shown)} more parameters have the same default for every machine"
            " (docs/reference/parameters.md)"]


def pulse_lines(machine: Machine, data: DriveData) -> list[str]:
    """Largest mean torque over the speed, and the angles that make it."""
    of = single_pulse(machine, data)
    rpm = of.speed_per_voltage * machine.supply_voltage_V * 30.0 / math.pi
    begins_deg = (180.0, 360.0)
    lines = []
    for point in range(len(rpm))[_PULSES_SHOWN]:
        halves = "   ".join(f"{of.mean_Nm[half, point]:9.4g} N m {begin_deg - of.lead_deg[half, point]:5.0f} to"
                            f" {begin_deg + of.end_deg[half, point]:3.0f} deg" for half, begin_deg in
                            enumerate(begins_deg))
        lines.append(f"  {rpm[point]:7.0f} r/min{halves}")
    return [f"largest mean torque of {machine.name} at {machine.supply_voltage_V:g} V, motoring and braking, and the"
            " electrical angles between which a phase has full voltage (180 unaligned, 360 aligned)", *lines]


def drive_json(machine: Machine) -> str:
    """All values by name; a derived one is not rounded."""
    values = {each.name: {"value": each.value, "unit": each.unit, "source": each.source, "formula": each.formula}
              for each in derive(machine).derivations}
    return json.dumps({"machine": machine.name, "drive": values}, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _number(each: Derivation) -> str:
    return str(each.value).lower() if isinstance(each.value, bool) else f"{each.value:.5g}"
