"""Build step: the C sources of a machine, `machine_tables.c` for the firmware and `machine_plant.c` for the emulator.

    python -m salient.generate.machine FILE.toml OUTDIR
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

from salient.dbc import database_hash
from salient.generate.codec import raw_range
from salient.generate.files import write_files
from salient.machine.file import Machine, MachineError, load_machine
from salient.machine.firmware_tables import CURRENT_A, NODE_OFFSET, PhaseMap, Surface, machine_phase_map
from salient.machine.flux_map import FluxMap
from salient.machine.parameter_table import TABLE
from salient.machine.scaling import LOAD_TORQUE_RANGE_NM, Scaling, database_of, scaling_of
from salient.paths import DRIVE_DBC


def quantise(value: float, fraction_bits: int, bits: int) -> int:
    """Nearest integer of `value` in a signed format, saturated to `bits`."""
    limit = 1 << (bits - 1)
    return max(-limit, min(limit - 1, math.floor(math.ldexp(value, fraction_bits) + 0.5)))


def tables_source(machine: Machine, scaling: Scaling, tables: PhaseMap) -> str:
    """C source of the firmware's tables."""
    return "\n".join(
        [
            f"/* Generated from the machine file of '{machine.name}'. */",
            '#include "control/machine_tables.h"',
            "",
            "const machine_tables_t machine_tables = {",
            f"    .phases = {machine.phases},",
            f"    .rotor_poles = {machine.rotor_poles},",
            *(f"    .{name} = {value}," for name, value in scalars(machine, scaling).items()),
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
            f"    .parameter_default = {{{', '.join(map(str, scaling.raw_parameters()))}}},",
            f"    .parameter_fraction_bits = {{{', '.join(map(str, scaling.fraction_bits()))}}},",
            "};",
            "",
        ]
    )


def scalars(machine: Machine, scaling: Scaling) -> dict[str, int]:
    """Members of machine_tables_t that are single numbers of the machine's units and its bus."""
    exponents, data = scaling.exponents, scaling.data
    database = database_of(scaling.dbc())
    reference = database.get_message_by_name("DRIVE_COMMAND").get_signal_by_name("speed_reference_rpm")
    return {
        "speed_exponent": exponents.speed,
        "current_range_q9": quantise(data.adc_current_A, 9 - exponents.current, 17),
        "voltage_range_q6": quantise(data.adc_voltage_V, 6 - exponents.voltage, 17),
        "current_slew_rate_A_s": quantise(machine.current_rise_A_s, -exponents.current, 32),
        "speed_reference_max": raw_range(reference)[1],
        "dbc_hash": database_hash(database),
    }


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


def sensor_ranges(scaling: Scaling) -> dict[str, float]:
    """Members of the emulator's sensor_ranges_t."""
    return {
        "current_A": scaling.data.adc_current_A,
        "dc_link_V": scaling.data.adc_voltage_V,
        "load_torque_Nm": math.ldexp(LOAD_TORQUE_RANGE_NM, scaling.exponents.torque),
    }


def plant_source(machine: Machine, scaling: Scaling) -> str:
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
            "    .ranges = {",
            *_members(sensor_ranges(scaling)),
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
    scaling = scaling_of(file, machine)
    sources = {
        "machine_tables.c": tables_source(machine, scaling, machine_phase_map(file, machine, scaling.exponents)),
        "machine_plant.c": plant_source(machine, scaling),
    }
    outputs = " ".join(_escaped(folder / name) for name in sources)
    # Never empty: CMake drops a dependency file without inputs, and Ninja would regenerate on every build.
    inputs = [Path(file).resolve(), TABLE, DRIVE_DBC]
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
