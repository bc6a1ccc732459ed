"""Description of a drive for a page, as JSON: Info of page/source.js."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cantools.database.can import Database, Message, Signal

from salient.bench.faults import FaultKind, fault_kinds
from salient.bus.databases import messages_of
from salient.bus.signals import (
    big_endian_bit,
    drive_database,
    group_of,
    is_enumeration,
    is_of_any_source,
    rig_database,
    signal_range,
)
from salient.dbc import database_hash
from salient.errors import UsageError
from salient.machine.drive_data import derive
from salient.machine.file import MachineError, load_machine, machine_path
from salient.machine.parameter_table import CHOICES

EXTENDED = 0x80000000
"""Flag of a 29-bit identifier, as in can_id of Linux."""
_BYTES_MAX = 8
_MAP_ANGLES, _MAP_CURRENTS = 61, 41


def description(machine: str, node: int, others: Sequence[Database] = ()) -> dict[str, Any]:
    """Databases, machine, faults and named values of parameters of a drive; others: databases of other nodes, of which
    a page has the messages of up to 8 bytes. UsageError: no such machine."""
    try:
        path = machine_path(machine)
        return {
            "databases": [_message(message) for database in (drive_database(machine, node), rig_database(node))
                          for message in _sorted(database)]
                         + [_message(message, is_of_file=True) for message in messages_of(others)
                            if message.length <= _BYTES_MAX],
            "database_hash": database_hash(drive_database(machine)),
            "machine": machine_of(path),
            "faults": [_fault(kind) for kind in fault_kinds().values()],
            "parameter_choices": CHOICES,
        }
    except MachineError as error:
        raise UsageError(str(error)) from None


def machine_of(path: Path) -> dict[str, Any]:
    """Poles, limits and flux linkage of a machine file."""
    machine = load_machine(path)
    data = derive(machine)
    # Beyond the peak by a third, and within what a measured map knows.
    current_A = np.linspace(0.0, min(data.current_peak_A * 4.0 / 3.0, machine.magnetics.current_max_A), _MAP_CURRENTS)
    angle_rad = np.linspace(0.0, machine.pitch_rad, _MAP_ANGLES)
    flux_Wb = machine.magnetics.flux_linkage_Wb(angle_rad[np.newaxis, :], current_A[:, np.newaxis])
    return {
        "name": machine.name, "stator_poles": machine.stator_poles, "rotor_poles": machine.rotor_poles,
        "phases": machine.phases, "resistance_ohm": machine.resistance_ohm,
        "supply_voltage_V": machine.supply_voltage_V, "current_peak_A": data.current_peak_A,
        "torque_rated_Nm": data.torque_rated_Nm, "torque_peak_Nm": data.torque_peak_Nm,
        "speed_base_rpm": data.speed_base_rpm, "speed_max_rpm": data.speed_max_rpm,
        "flux_map": {
            "angle_deg": [_rounded(math.degrees(angle)) for angle in angle_rad],
            "current_A": [_rounded(current) for current in current_A],
            "flux_linkage_Wb": [[_rounded(value) for value in row] for row in flux_Wb],
        },
    }


def _sorted(database: Database) -> list[Message]:
    return sorted(database.messages, key=lambda message: message.frame_id)


def _message(message: Message, *, is_of_file: bool = False) -> dict[str, Any]:
    return {
        "id": message.frame_id | (EXTENDED if message.is_extended_frame else 0), "name": message.name,
        "node": message.senders[0], "length": message.length, "comment": message.comment or "",
        "signals": [_signal(signal) for signal in message.signals],
        **({"may_be_longer": True} if is_of_file else {}),
        **({"group": group_of(message.frame_id)} if is_of_file and is_of_any_source(message) else {}),
    }


def _signal(signal: Signal) -> dict[str, Any]:
    choices: Mapping[int, object] = (signal.choices or {}) if is_enumeration(signal) else {}
    is_reversed = signal.byte_order != "little_endian"
    start = 8 * _BYTES_MAX - big_endian_bit(signal) - signal.length if is_reversed else signal.start
    return {
        "name": signal.name, "unit": signal.unit or "", "comment": signal.comment or "", "start": start,
        "length": signal.length, "signed": signal.is_signed, "float": signal.is_float,
        "factor": float(signal.scale), "offset": float(signal.offset), "minimum": _number(signal.minimum),
        "maximum": _number(signal.maximum),
        "choices": {str(number): str(text) for number, text in sorted(choices.items())} or None,
        "multiplexer": signal.is_multiplexer, "multiplexed": signal.multiplexer_ids,
        **({"selector": signal.multiplexer_signal} if signal.multiplexer_ids else {}),
        **({"reversed": True} if is_reversed else {}),
    }


def _fault(kind: FaultKind) -> dict[str, Any]:
    attribute = None
    if kind.attribute is not None:
        name, signal = kind.attribute
        low, high = signal_range(signal)
        attribute = {"name": name, "unit": signal.unit or "", "minimum": float(low), "maximum": float(high),
                     "choices": kind.choices}
    return {"name": kind.name, "text": kind.text, "phase": kind.has_phase, "leg": kind.has_leg,
            "attribute": attribute}


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _rounded(value: float) -> float:
    return float(f"{value:.7g}")
