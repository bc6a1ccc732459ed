"""A machine as C sources: its tables for the firmware and its plant for the emulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from salient.machine.file import FORMS, Machine, load_machine
from salient.machine.flux_map import FluxMap
from salient.machine.image import FLUX_MAP, PLANT, TABLES, FirmwareTables, Member, Structure, firmware_tables, image
from salient.machine.scaling import Scaling, scaling_of

_VALUES_A_LINE = 16


def tables_source(machine: Machine, scaling: Scaling, tables: FirmwareTables) -> str:
    """C source of the firmware's tables."""
    return _source(machine, "control/machine_tables.h", [
        "MACHINE_TABLES_CONST machine_tables_t machine_tables = {", *_initialisers(TABLES, machine, scaling, tables),
        "};",
    ])  # fmt: skip


def plant_source(machine: Machine, scaling: Scaling) -> str:
    """C source of the emulator's machine, every number to the last bit."""
    flux_map, of_map = [], []
    if isinstance(machine.magnetics, FluxMap):
        flux_map = ["static const flux_map_t flux_map = {", *_initialisers(FLUX_MAP, machine.magnetics), "};", ""]
        of_map = ["    .magnetics.map = &flux_map,"]
    return _source(machine, "plant/machine.h", [
        *flux_map, "const machine_t machine_plant = {", f'    .name = "{machine.name}",',
        *_initialisers(PLANT, machine, scaling), *of_map, "};",
    ])  # fmt: skip


def _source(machine: Machine, header: str, definitions: list[str]) -> str:
    head = [f"/* Generated from the machine file of '{machine.name}'. */", f'#include "{header}"', ""]
    return "\n".join([*head, *definitions, ""])


def _initialisers(structure: Structure, *source: Any) -> list[str]:
    return [f"    .{member.name} = {_initialiser(member, member.array(*source))}," for member in structure.members]


def _initialiser(member: Member, value: np.ndarray) -> str:
    if value.ndim == 0:
        return _element(member, value.item())
    if value.ndim > 1:
        return "{" + ",\n".join(_initialiser(member, row) for row in value) + "}"
    elements = [_element(member, element) for element in value.tolist()]
    lines = [", ".join(elements[at : at + _VALUES_A_LINE]) for at in range(0, len(elements), _VALUES_A_LINE)]
    return "{" + ",\n        ".join(lines) + "}"


def _element(member: Member, value: Any) -> str:
    if isinstance(value, tuple):  # a structure
        return "{" + ", ".join(map(repr, value)) + "}"
    return f"MAGNETICS_{FORMS[value].upper()}" if member.type == "magnetics_form_t" else repr(value)


def files_of(path: Path) -> tuple[str, str, bytes]:
    """C sources of tables and plant, and the image; MachineError."""
    machine = load_machine(path)
    scaling = scaling_of(path, machine)
    tables = firmware_tables(path, machine, scaling)
    return tables_source(machine, scaling, tables), plant_source(machine, scaling), image(machine, scaling, tables)
