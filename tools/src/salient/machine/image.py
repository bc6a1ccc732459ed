"""Parts of a drive, member by member: the C structures that a machine file fills, and the machine image, the
file from which the emulator reads them when it starts (emulator/host/machine_image.h has its layout).

Each member is one line here. From it follow the C sources of programs that have a machine compiled in
(salient.generate.machine), the image, and the table by which the emulator reads an image
(salient.generate.machine_layout), which also checks name, type and size against the C structure.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from salient.dbc import PHASES_MAX, database_hash
from salient.machine.content import machine_hash
from salient.machine.file import FORMS, Converter, DcLink, Machine, Sensors, Thermal
from salient.machine.firmware_tables import (
    ANGLE_BINS,
    CURRENT_A,
    NODE_OFFSET,
    ROWS,
    PhaseMap,
    Surface,
    machine_phase_map,
)
from salient.machine.flux_map import ANGLE_INTERVALS, CURRENT_INTERVALS, FluxMap
from salient.machine.fold_back import fold_back_V, mean_fold_back_V
from salient.machine.heat import thermal_constants
from salient.machine.magnetics import FORMULA_KEYS
from salient.machine.partial_pulse import PARTS
from salient.machine.pulse_tables import PulseTables, pulse_tables
from salient.machine.scaling import Scaling, database_of
from salient.machine.sharing_tables import SharingTables, sharing_tables
from salient.machine.sharing_window import PARTS as SHARING_PARTS
from salient.machine.sharing_window import SPEEDS, sharing_window
from salient.machine.single_pulse import POINTS

MAGIC = b"SALIENTM"
HEADER = struct.Struct("<8sII4I")
"""Magic, LAYOUT, CRC-32 of everything after it, bytes of each part."""
_CHECKED_FROM = 16

_TYPES: dict[str, Any] = {
    "uint8_t": "<u1", "int8_t": "<i1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
    "unsigned": "<u4", "double": "<f8", "magnetics_form_t": "<u4",
    "machine_row_t": [("start", "<u4"), ("reciprocal", "<i4")],
    "machine_pulse_t": [(name, "<u2") for name in ("lead", "end", "smooth_torque", "mean_torque", "peak_torque")],
    "machine_partial_pulse_t": [("on", "<i1"), ("end", "<u1"), ("ripple", "<u1")],
    "machine_sharing_window_t": [("on", "<i2"), ("off", "<i2")],
}  # fmt: skip


@dataclass(frozen=True)
class Member:
    """A member of a C structure.

    name: as in C, with the structure that it is nested in. type: of an element, a key of _TYPES. value: number or array
    from what the structure is made of. shape: of an array.
    """

    name: str
    type: str
    value: Callable[..., Any]
    shape: tuple[int, ...] = ()

    @property
    def dtype(self) -> np.dtype[Any]:
        """Layout of an element in the image."""
        dtype: np.dtype[Any] = np.dtype(_TYPES[self.type])
        return dtype

    @property
    def size(self) -> int:
        """Bytes in the image."""
        return self.dtype.itemsize * math.prod(self.shape)

    @property
    def alignment(self) -> int:
        """Bytes in memory: of the largest number in an element."""
        return max(part.itemsize for part in ([self.dtype[name] for name in self.dtype.names] if self.dtype.names
                                              else [self.dtype]))

    def array(self, *source: Any) -> np.ndarray:
        """The value as it is in the image; OverflowError when the type cannot hold it."""
        value = self.value(*source)
        array = np.array(value, dtype=self.dtype)
        if array.shape != self.shape:
            raise ValueError(f"{self.name}: shape {array.shape}, must be {self.shape}")
        if array.dtype.kind in "iu" and not np.array_equal(array, value):
            raise OverflowError(f"{self.name}: does not fit into {self.type}")
        return array


@dataclass(frozen=True)
class Structure:
    """A C structure and its members, in the sequence of the image."""

    type: str
    members: tuple[Member, ...]

    @property
    def size(self) -> int:
        """Bytes in the image."""
        return sum(member.size for member in self.members)

    @property
    def offsets(self) -> list[int]:
        """Place of each member in memory, and at the end the size there. As on every processor here a number is at a
        multiple of its size. salient.generate.machine_layout checks them against the compiler's."""
        offsets, end = [], 0
        for member in self.members:
            offsets.append(-(-end // member.alignment) * member.alignment)
            end = offsets[-1] + member.size
        whole = max(member.alignment for member in self.members)
        return [*offsets, -(-end // whole) * whole]

    def in_memory(self, packed: bytes) -> bytes:
        """The structure as a program has it, from its part of an image; zeros between members."""
        memory, at = bytearray(self.offsets[-1]), 0
        for member, offset in zip(self.members, self.offsets, strict=False):
            memory[offset:offset + member.size] = packed[at:at + member.size]
            at += member.size
        return bytes(memory)

    def packed(self, *source: Any) -> bytes:
        """The part of the image."""
        return b"".join(member.array(*source).tobytes() for member in self.members)


def quantise(value: float, fraction_bits: int, bits: int) -> int:
    """Nearest integer of `value` in a signed format, saturated to `bits`."""
    limit = 1 << (bits - 1)
    return max(-limit, min(limit - 1, math.floor(math.ldexp(value, fraction_bits) + 0.5)))


# --- the firmware's tables ------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class FirmwareTables:
    """Values sampled or computed from a machine's magnetics."""

    phase_map: PhaseMap
    pulse: PulseTables
    sharing: SharingTables
    machine_hash: int
    """See salient.machine.cache."""


def firmware_tables(path: Path | str, machine: Machine, scaling: Scaling) -> FirmwareTables:
    """The tables of a machine file's machine; MachineError when the formats cannot hold them."""
    window = sharing_window(machine, scaling.data)
    return FirmwareTables(machine_phase_map(path, machine, scaling.exponents), pulse_tables(machine, scaling, window),
                          sharing_tables(window, scaling.exponents), machine_hash(Path(path)))


def _columns(torque: np.ndarray, flux: np.ndarray) -> np.ndarray:
    """Arrays by row and column in the layout of firmware/control/machine_tables.h; without a last row: 0 there."""
    columns = [np.pad(of, ((0, ROWS - len(of)), (0, 0))).T for of in (torque, flux)]
    return np.stack(columns, axis=1).reshape(-1)


def _format(name: str, surface: Callable[[PhaseMap], Surface]) -> tuple[Member, ...]:
    return (
        Member(f"{name}.curvature_shift", "uint8_t",
               lambda machine, scaling, tables: surface(tables.phase_map).curvature_shift),
        Member(f"{name}.result_shift", "uint8_t",
               lambda machine, scaling, tables: surface(tables.phase_map).result_shift),
    )


def _padded(values: list[int]) -> list[int]:
    """Values of every parameter, with zeros up to the size of the array."""
    return values + [0] * (_PARAMETERS_MAX - len(values))


_PARAMETERS_MAX = 96
_CELLS = (2 * ROWS * len(CURRENT_A),)
_RATIO_MAX = 64.0

TABLES = Structure("machine_tables_t", (
    Member("phases", "uint8_t", lambda machine, scaling, tables: machine.phases),
    Member("rotor_poles", "uint8_t", lambda machine, scaling, tables: machine.rotor_poles),
    Member("speed_exponent", "uint8_t", lambda machine, scaling, tables: scaling.exponents.speed),
    Member("current_range_q9", "uint16_t", lambda machine, scaling, tables: quantise(
        scaling.data.adc_current_A, 9 - scaling.exponents.current, 17)),
    Member("voltage_range_q6", "uint16_t", lambda machine, scaling, tables: quantise(
        scaling.data.adc_voltage_V, 6 - scaling.exponents.voltage, 17)),
    Member("device_drop_most_q6", "uint16_t", lambda machine, scaling, tables: quantise(
        2.0 * max(machine.converter["switch_drop_V"], machine.converter["diode_drop_V"]),
        6 - scaling.exponents.voltage, 17)),
    Member("device_resistance_q8", "uint16_t", lambda machine, scaling, tables: quantise(
        min(_RATIO_MAX, 2.0 * max(machine.converter["switch_resistance_ohm"],
                                  machine.converter["diode_resistance_ohm"]) / machine.resistance_ohm), 8, 17)),
    Member("minimum_pulse_ns", "uint16_t", lambda machine, scaling, tables: quantise(
        machine.converter["minimum_pulse_ns"], 0, 17)),
    Member("device_drop_q6", "uint16_t", lambda machine, scaling, tables: quantise(
        machine.converter["switch_drop_V"] + machine.converter["diode_drop_V"], 6 - scaling.exponents.voltage, 17)),
    Member("current_slew_rate_A_s", "int32_t", lambda machine, scaling, tables: quantise(
        machine.current_rise_A_s, -scaling.exponents.current, 32)),
    Member("fold_back_q6", "uint16_t", lambda machine, scaling, tables: quantise(
        fold_back_V(machine, scaling.data), 6 - scaling.exponents.voltage, 17)),
    Member("mean_fold_back_q6", "uint16_t", lambda machine, scaling, tables: quantise(
        mean_fold_back_V(machine, scaling.data), 6 - scaling.exponents.voltage, 17)),
    Member("row", "machine_row_t", lambda machine, scaling, tables: tables.phase_map.rows(), (ROWS + 1,)),
    Member("angle_bin_row", "uint8_t", lambda machine, scaling, tables: tables.phase_map.angle_bin_row(),
           (ANGLE_BINS,)),
    *_format("torque_format", lambda phase_map: phase_map.torque_per_ampere),
    *_format("flux_format", lambda phase_map: phase_map.flux_per_ampere),
    Member("curvature", "int8_t", lambda machine, scaling, tables: _columns(
        tables.phase_map.torque_per_ampere.curvature, tables.phase_map.flux_per_ampere.curvature), _CELLS),
    Member("node", "int16_t", lambda machine, scaling, tables: _columns(
        tables.phase_map.torque_per_ampere.node - NODE_OFFSET,
        tables.phase_map.flux_per_ampere.node - NODE_OFFSET), _CELLS),
    Member("pulse_index_scale", "uint32_t", lambda machine, scaling, tables: tables.pulse.index_scale),
    Member("pulse", "machine_pulse_t", lambda machine, scaling, tables: tables.pulse.pulses(), (2, POINTS)),
    Member("partial_pulse", "machine_partial_pulse_t", lambda machine, scaling, tables: tables.pulse.partial_pulses(),
           (2, len(PARTS), POINTS)),
    Member("pulse_base_index", "uint16_t", lambda machine, scaling, tables: tables.pulse.base_index),
    Member("sharing", "machine_sharing_window_t", lambda machine, scaling, tables: tables.sharing.windows(),
           (2, SPEEDS, len(SHARING_PARTS))),
    Member("sharing_torque", "uint16_t", lambda machine, scaling, tables: tables.sharing.torque),
    Member("braking_end", "uint16_t", lambda machine, scaling, tables: tables.pulse.braking_end, (POINTS,)),
    Member("braking_flux", "uint16_t", lambda machine, scaling, tables: tables.pulse.braking_flux, (POINTS,)),
    Member("parameter_default", "int32_t", lambda machine, scaling, tables: _padded(scaling.raw_parameters()),
           (_PARAMETERS_MAX,)),
    Member("parameter_fraction_bits", "int8_t", lambda machine, scaling, tables: _padded(scaling.fraction_bits()),
           (_PARAMETERS_MAX,)),
    Member("control_rate_min_hz", "uint32_t", lambda machine, scaling, tables: scaling.control_rate_min_hz(machine)),
    Member("speed_reference_max", "int32_t", lambda machine, scaling, tables: scaling.speed_reference_max),
    Member("speed_max_q22", "int32_t", lambda machine, scaling, tables: scaling.speed_max_q22),
    Member("dbc_hash", "uint32_t", lambda machine, scaling, tables: database_hash(database_of(scaling.dbc()))),
    Member("machine_hash", "uint32_t", lambda machine, scaling, tables: tables.machine_hash),
))  # fmt: skip
"""Members from a Machine, its Scaling and its FirmwareTables: firmware/control/machine_tables.h."""


# --- the emulator's machine -----------------------------------------------------------------------------------------

def _magnetics(machine: Machine, scaling: Scaling) -> Mapping[str, float]:
    if isinstance(machine.magnetics, FluxMap):
        return {"unaligned_inductance_H": machine.magnetics.unaligned_inductance_H}
    return machine.magnetics.parameters


def _of_phases(values: tuple[float, ...]) -> list[float]:
    """Values of every phase, with zeros up to the size of the array."""
    return [*values, *[0.0] * (PHASES_MAX - len(values))]


def _doubles(part: str, keys: Any, values: Callable[[Machine, Scaling], Mapping[str, float] | None]
             ) -> tuple[Member, ...]:
    """The members of a nested structure; those that a machine does not have are 0."""
    return tuple(Member(f"{part}.{key}", "double", lambda machine, scaling, key=key: (
        values(machine, scaling) or {}).get(key, 0.0))
                 for key in keys)


_MAGNETICS_KEYS = dict.fromkeys(key for keys in FORMULA_KEYS.values() for key in keys)

PLANT = Structure("machine_t", (
    Member("stator_poles", "unsigned", lambda machine, scaling: machine.stator_poles),
    Member("rotor_poles", "unsigned", lambda machine, scaling: machine.rotor_poles),
    Member("phases", "unsigned", lambda machine, scaling: machine.phases),
    Member("resistance_ohm", "double", lambda machine, scaling: machine.resistance_ohm),
    Member("inertia_kg_m2", "double", lambda machine, scaling: machine.inertia_kg_m2),
    Member("friction_Nm_s", "double", lambda machine, scaling: machine.friction_Nm_s),
    Member("supply_voltage_V", "double", lambda machine, scaling: machine.supply_voltage_V),
    Member("magnetics.form", "magnetics_form_t", lambda machine, scaling: FORMS.index(machine.magnetics.form)),
    *_doubles("magnetics", _MAGNETICS_KEYS, _magnetics),
    Member("circuit.coupling", "double", lambda machine, scaling: _of_phases(machine.circuit["coupling"]),
           (PHASES_MAX,)),
    Member("circuit.eddy_conductance_S", "double", lambda machine, scaling: machine.circuit["eddy_conductance_S"]),
    Member("circuit.flux_deviation", "double", lambda machine, scaling: _of_phases(machine.circuit["flux_deviation"]),
           (PHASES_MAX,)),
    Member("circuit.angle_deviation_deg", "double", lambda machine, scaling: _of_phases(
        machine.circuit["angle_deviation_deg"]), (PHASES_MAX,)),
    *_doubles("converter", [key for key in Converter.model_fields if key != "supply_voltage_V"],
              lambda machine, scaling: machine.converter),
    *_doubles("dc_link", DcLink.model_fields, lambda machine, scaling: machine.dc_link),
    *_doubles("sensors", Sensors.model_fields, lambda machine, scaling: machine.sensors),
    *_doubles("ranges", ("current_A", "dc_link_V", "load_torque_Nm"),
              lambda machine, scaling: scaling.sensor_ranges()),
    *_doubles("thermal", Thermal.model_fields, lambda machine, scaling: thermal_constants(
        machine, scaling.data.parameters, scaling.data.supply_max_V)),
    Member("trip_current_A", "double", lambda machine, scaling: scaling.data.comparator_trip_A),
))  # fmt: skip
"""From a Machine and its Scaling: emulator/plant/machine.h, without the name and the flux map, parts of their own."""

FLUX_MAP = Structure("flux_map_t", (
    Member("current_max_A", "double", lambda flux_map: flux_map.current_max_A),
    Member("inductance_min_H", "double", lambda flux_map: flux_map.inductance_extremes[0]),
    Member("current_scale_A", "double", lambda flux_map: flux_map.inductance_extremes[3]),
    Member("coenergy_J", "double", lambda flux_map: flux_map.coefficients_J,
           (CURRENT_INTERVALS + 4, ANGLE_INTERVALS + 3)),
))  # fmt: skip
"""Members from a FluxMap: emulator/plant/flux_map.h."""


# --- the image ------------------------------------------------------------------------------------------------------

STRUCTURES = (TABLES, PLANT, FLUX_MAP)

LAYOUT = zlib.crc32("\n".join(f"{structure.type} {member.name} {member.type} {member.shape}"
                              for structure in STRUCTURES for member in structure.members).encode())
"""Version of the image: changes with every change of a structure."""


def image(machine: Machine, scaling: Scaling, tables: FirmwareTables) -> bytes:
    """The machine image."""
    parts = [
        TABLES.packed(machine, scaling, tables),
        PLANT.packed(machine, scaling),
        FLUX_MAP.packed(machine.magnetics) if isinstance(machine.magnetics, FluxMap) else b"",
        machine.name.encode("ascii") + b"\0",
    ]
    return joined(parts)


def joined(parts: list[bytes]) -> bytes:
    """The image of its four packed parts: header, lengths, checksum."""
    checked = HEADER.pack(b"", 0, 0, *map(len, parts))[_CHECKED_FROM:] + b"".join(parts)
    return MAGIC + struct.pack("<II", LAYOUT, zlib.crc32(checked)) + checked
