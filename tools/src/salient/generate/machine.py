"""Build step: a machine as C sources, `machine_tables.c` for the firmware and `machine_plant.c` for the emulator, and
as an image, `machine.image`, for programs that read it when they start. All follow from salient.machine.image.

    python -m salient.generate.machine FILE.toml OUTDIR
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from salient.generate.files import write_files
from salient.machine.file import FORMS, Machine, MachineError, load_machine
from salient.machine.flux_map import FluxMap
from salient.machine.image import FLUX_MAP, PLANT, TABLES, FirmwareTables, Member, Structure, firmware_tables, image
from salient.machine.scaling import Scaling, scaling_of
from salient.paths import DRIVE_DBC, PARAMETERS

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


def machine_files(file: str, folder: Path) -> dict[str, str | bytes]:
    """Contents of machine_tables.c, machine_plant.c, machine.image and their dependency file machine.d, to be written
    to `folder`; MachineError."""
    machine = load_machine(file)
    scaling = scaling_of(file, machine)
    tables = firmware_tables(file, machine, scaling)
    made: dict[str, str | bytes] = {
        "machine_tables.c": tables_source(machine, scaling, tables),
        "machine_plant.c": plant_source(machine, scaling),
        "machine.image": image(machine, scaling, tables),
    }
    outputs = " ".join(_escaped(folder / name) for name in made)
    # Never empty: CMake drops a dependency file without inputs, and Ninja would regenerate on every build.
    inputs = [Path(file).resolve(), PARAMETERS, DRIVE_DBC]
    if isinstance(machine.magnetics, FluxMap) and machine.magnetics.file is not None:
        inputs.append(machine.magnetics.file)
    return made | {"machine.d": f"{outputs}: {' '.join(map(_escaped, inputs))}\n"}


def _escaped(path: Path) -> str:
    """For a dependency file, as make reads it."""
    return str(path).replace(" ", "\\ ")


def main(arguments: list[str]) -> int:
    if len(arguments) != 2:
        print("usage: python -m salient.generate.machine FILE.toml OUTDIR", file=sys.stderr)
        return 2
    folder = Path(arguments[1])
    return write_files("salient", folder, lambda: machine_files(arguments[0], folder), MachineError)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
