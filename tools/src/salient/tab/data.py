"""Data that the page of a tab has beside its scripts: module, machines, databases; packed by salient.tab.file, read by
page/data.js."""

from __future__ import annotations

from typing import Any

from salient.bus import e2e
from salient.bus.signals import drive_database
from salient.dbc import attributes
from salient.machine.path import machine_path
from salient.paths import MACHINES
from salient.tab.variables import factors, variables_data
from salient.view.description import description

_MACHINE_DEPENDENT = ("factor", "offset", "minimum", "maximum")
_FLUX_DIGITS = 5
"""Digits in the picture of the machine."""


def bundled_machines() -> list[str]:
    """Names of the machines that every tab has."""
    return sorted(path.stem for path in MACHINES.glob("*.toml"))


def shared_data() -> dict[str, Any]:
    """Faults, named values of parameters, data IDs and variables, which no machine changes."""
    any_machine = description(bundled_machines()[0], 0)
    return {
        "faults": any_machine["faults"],
        "parameter_choices": any_machine["parameter_choices"],
        "data_ids": {message.name: e2e.data_id(message) for message in drive_database().messages
                     if "E2EDataId" in attributes(message)},
        "variables": variables_data(),
    }


def machine_data(machines: list[str]) -> dict[str, Any]:
    """Databases of the first machine, and for each what it has instead of that, by its name."""
    first, *_ = found = [description(machine, 0) for machine in machines]
    return {
        "databases": first["databases"],
        "machines": {
            machine_path(name).stem: {
                "machine": _rounded(each["machine"]), "database_hash": each["database_hash"],
                "signals": _different(first["databases"], each["databases"]), "factors": of_kinds,
            } for name, each, of_kinds in zip(machines, found, factors(machines), strict=True)
        },
    }


def _different(base: list[dict[str, Any]], databases: list[dict[str, Any]]) -> list[list[Any]]:
    """[message, signal, factor, offset, minimum, maximum] by index, where they differ."""
    return [[at, number, *(signal[key] for key in _MACHINE_DEPENDENT)]
            for at, (old, new) in enumerate(zip(base, databases, strict=True))
            for number, (before, signal) in enumerate(zip(old["signals"], new["signals"], strict=True))
            if any(before[key] != signal[key] for key in _MACHINE_DEPENDENT)]


def _rounded(machine: dict[str, Any]) -> dict[str, Any]:
    """The flux linkage by angle and then by current, which packs better: the angles are symmetrical."""
    flux = machine["flux_map"]
    columns = [[float(f"{value:.{_FLUX_DIGITS}g}") for value in column]
               for column in zip(*flux["flux_linkage_Wb"], strict=True)]
    return {**machine, "flux_map": {**flux, "flux_linkage_Wb": columns}}
