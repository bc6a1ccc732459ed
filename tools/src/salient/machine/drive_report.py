"""The drive's data of a machine as a table and as JSON."""

from __future__ import annotations

import json

from salient.machine.definition import Machine
from salient.machine.drive_data import DEFAULT, Derivation, derive


def drive_lines(machine: Machine) -> list[str]:
    """Every value that the file states or a formula gives: name, value, unit, source, formula."""
    data = derive(machine)
    shown = [each for each in data.derivations if each.source != DEFAULT or each.name not in data.parameters]
    name_width = max(len(each.name) for each in shown)
    lines = [f"  {each.name:<{name_width}} {_number(each):>9} {each.unit:<8} {each.source:<10} {each.formula}"
             for each in shown]
    return [f"drive of {machine.name}, from its file or derived", *(line.rstrip() for line in lines),
            f"  {len(data.derivations) - len(shown)} more parameters have the same default for every machine"
            " (firmware/PARAMETERS.md)"]


def drive_json(machine: Machine) -> str:
    """All values by name; a derived one is not rounded."""
    values = {each.name: {"value": each.value, "unit": each.unit, "source": each.source, "formula": each.formula}
              for each in derive(machine).derivations}
    return json.dumps({"machine": machine.name, "drive": values}, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _number(each: Derivation) -> str:
    return str(each.value).lower() if isinstance(each.value, bool) else f"{each.value:.5g}"
