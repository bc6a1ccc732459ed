"""Build step: the C sources of a machine, `machine_tables.c` for the firmware and `machine_plant.c` for the emulator.

    python -m salient.generate.machine FILE.toml OUTDIR
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

from salient.generate.files import write_files
from salient.machine.file import Machine, MachineError, load_machine
from salient.machine.firmware_tables import CURRENT_A, NODE_OFFSET, PhaseMap, Surface, machine_phase_map
from salient.machine.flux_map import FluxMap


def quantise(value: float, fraction_bits: int, bits: int) -> int:
    """Nearest integer of `value` in a signed format, saturated to `bits`."""
    limit = 1 << (bits - 1)
    return max(-limit, min(limit - 1, math.floor(value * (1 << fraction_bits) + 0.5)))


def tables_source(machine: Machine, tables: PhaseMap) -> str:
    """C source of the firmware's tables."""
    return "\n".join(
        [
            f"/* Generated from the machine file of '{machine.name}'. */",
            '#include "control/machine_tables.h"',
            "",
            "const machine_tables_t machine_tables = {",
            f"    .phases = {machine.phases},",
            f"    .rotor_poles = {machine.rotor_poles},",
            f"    .inertia_q30 = {quantise(machine.inertia_kg_m2, 30, 32)},",
            f"    .friction_q30 = {quantise(machine.friction_Nm_s, 30, 32)},",
            f"    .resistance_q24 = {quantise(machine.resistance_ohm, 24, 32)},",
            f"    .current_slew_rate_A_s = {quantise(machine.current_rise_A_s, 0, 32)},",
            "    .row = {",
            *(f"        {{{start}u, {reciprocal}u}}," for start, reciprocal in tables.rows()),
            "    },",
            f"    .angle_bin_row = {{{_listed(tables.angle_bin_row())}}},",
            *_format_lines("torque_format", tables.torque_per_ampere),
            *_format_lines("flux_format", tables.flux_per_ampere),
            "    .node = {",
            *_column_lines(tables.torque_per_ampere.node - NODE_OFFSET, tables.flux_per_ampere.node - NODE_OFFSET),
            "    },",
            "    .curvature = {",
            *_column_lines(*(np.pad(surface.curvature, ((0, 1), (0, 0)))
                             for surface in (tables.torque_per_ampere, tables.flux_per_ampere))),
            "    },",
            "};",
            "",
        ]
    )


def _format_lines(name: str, surface: Surface) -> list[str]:
    return [
        f"    .{name} = {{",
        f"        .curvature_shift = {surface.curvature_shift},",
        f"        .result_shift = {surface.result_shift},",
        "    },",
    ]


def _column_lines(torque: np.ndarray, flux: np.ndarray) -> list[str]:
    """Arrays by row and column in the layout of firmware/control/machine_tables.h."""
    return [f"        {_listed(of[:, column])}," for column in range(len(CURRENT_A)) for of in (torque, flux)]


def _listed(values: np.ndarray) -> str:
    return ", ".join(map(str, values.tolist()))


def plant_source(machine: Machine) -> str:
    """C source of the emulator's machine, every number to the last bit."""
    magnetics = machine.magnetics
    if isinstance(magnetics, FluxMap):
        flux_map = [*_flux_map_lines(magnetics), ""]
        magnetics_lines = _members({"unaligned_inductance_H": magnetics.unaligned_inductance_H})
        magnetics_lines += ["        .map = &flux_map,"]
    else:
        flux_map = []
        magnetics_lines = _members(magnetics.parameters)
    return "\n".join(
        [
            f"/* Generated from the machine file of '{machine.name}'. */",
            '#include "plant/machine.h"',
            "",
            *flux_map,
            "const machine_t machine_plant = {",
            f'    .name = "{machine.name}",',
            f"    .stator_poles = {machine.stator_poles},",
            f"    .rotor_poles = {machine.rotor_poles},",
            f"    .phases = {machine.phases},",
            f"    .resistance_ohm = {machine.resistance_ohm!r},",
            f"    .inertia_kg_m2 = {machine.inertia_kg_m2!r},",
            f"    .friction_Nm_s = {machine.friction_Nm_s!r},",
            f"    .supply_voltage_V = {machine.supply_voltage_V!r},",
            "    .magnetics = {",
            f"        .form = MAGNETICS_{magnetics.form.upper()},",
            *magnetics_lines,
            "    },",
            "    .converter = {",
            *_members(machine.converter),
            "    },",
            "    .dc_link = {",
            *_members(machine.dc_link or {"capacitance_F": 0.0}),
            "    },",
            "    .sensors = {",
            *_members(machine.sensors),
            "    },",
            "};",
            "",
        ]
    )


def _members(values: dict[str, float]) -> list[str]:
    return [f"        .{key} = {value!r}," for key, value in values.items()]


def _flux_map_lines(flux_map: FluxMap) -> list[str]:
    inductance_min_H, _, _, current_scale_A = flux_map.inductance_extremes()
    return [
        "static const flux_map_t flux_map = {",
        f"    .current_max_A = {flux_map.current_max_A!r},",
        f"    .inductance_min_H = {inductance_min_H!r},",
        f"    .current_scale_A = {current_scale_A!r},",
        "    .coenergy_J = {",
        *("        {" + ", ".join(map(repr, row)) + "}," for row in flux_map.coefficients_J.tolist()),
        "    },",
        "};",
    ]


def machine_files(file: str, folder: Path) -> dict[str, str]:
    """Contents of machine_tables.c, machine_plant.c and their dependency file machine.d, to be written to `folder`;
    MachineError."""
    machine = load_machine(file)
    sources = {
        "machine_tables.c": tables_source(machine, machine_phase_map(file, machine)),
        "machine_plant.c": plant_source(machine),
    }
    outputs = " ".join(_escaped(folder / name) for name in sources)
    # Never empty: CMake drops a dependency file without inputs, and Ninja would regenerate on every build.
    inputs = [Path(file).resolve()]
    if isinstance(machine.magnetics, FluxMap) and machine.magnetics.file is not None:
        inputs.append(machine.magnetics.file)
    return sources | {"machine.d": f"{outputs}: {' '.join(map(_escaped, inputs))}\n"}


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
