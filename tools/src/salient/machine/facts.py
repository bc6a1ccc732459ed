"""The values of a machine by the keys of its file, and those that follow from them, for messages that name both.

A value that the file leaves out is shown with the key that it follows from: "current_limit_A (from
drive.current_peak_A, 52 A), 52 A". What follows from what is as drive_data.py derives it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData, derive, sampled_speed_rpm
from salient.machine.flux_map import FluxMap
from salient.machine.parameter_table import read_table

MAP_FILE = "magnetics.file"
"""The only key without a number."""

_UNITS = {"_ohm": "ohm", "_V": "V", "_A": "A", "_H": "H", "_Wb": "Wb", "_Nm": "N m", "_rpm": "r/min", "_hz": "Hz",
          "_F": "F", "_deg": "deg", "_s": "s", "_C": "C", "_m2": "m^2", "_K_W": "K/W", "_J_K": "J/K",
          "_Nm_s": "N m s", "_kg_m2": "kg m^2", "_S": "S"}  # fmt: skip


def unit_of(name: str) -> str:
    """Unit of a key or a name, with a blank before it; empty where it has none."""
    ends = [end for end in _UNITS if name.endswith(end)]
    units = {row.name: row.unit for row in read_table()} | ({name: _UNITS[max(ends, key=len)]} if ends else {})
    unit = units.get(name, units.get(name.rpartition(".")[2], ""))
    return f" {unit}" if unit else ""


class Facts:
    """A name with a point is a key of the file ("winding.resistance_ohm"), another one of the drive's data."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.is_map = isinstance(machine.magnetics, FluxMap)
        tables = {"winding": {"resistance_ohm": machine.resistance_ohm},
                  "mechanics": {"inertia_kg_m2": machine.inertia_kg_m2, "friction_Nm_s": machine.friction_Nm_s},
                  "poles": {"stator": machine.stator_poles, "rotor": machine.rotor_poles},
                  "converter": {"supply_voltage_V": machine.supply_voltage_V, **machine.converter},
                  "magnetics": getattr(machine.magnetics, "parameters", {"file": 0.0}),
                  "eddy_current": {"conductance_S": machine.circuit["eddy_conductance_S"]},
                  "dc_link": machine.dc_link or {}, "sensors": machine.sensors, "iron_loss": machine.iron_loss or {},
                  "thermal": machine.thermal, "drive": machine.drive, "drive.parameters": machine.drive_parameters}
        self._stated: dict[str, float] = {f"{table}.{key}": value for table, keys in tables.items()
                                          for key, value in keys.items()}

    @cached_property
    def data(self) -> DriveData:
        """Derived at the first use: magnetics that contradict themselves have none."""
        return derive(self.machine)

    @cached_property
    def _derived(self) -> dict[str, float]:
        return {each.name: each.value for each in self.data.derivations}

    def __getitem__(self, name: str) -> float:
        return self._stated[name] if "." in name else self._derived[name]

    def __contains__(self, name: str) -> bool:
        """False for a key that the file leaves out; the drive's data are complete."""
        return "." not in name or name in self._stated

    def key(self, name: str) -> str | None:
        """The key of a name in the file, if it is there."""
        places = (name,) if "." in name else (f"drive.{name}", f"drive.parameters.{name}")
        return next((place for place in places if place in self._stated), None)

    @property
    def flux_key(self) -> str:
        """The key that bounds the flux linkage."""
        return next(key for key in (MAP_FILE, "magnetics.flux_linkage_max_Wb", "magnetics.aligned_inductance_H")
                    if key in self)

    @property
    def inductance_key(self) -> str:
        """The key of the unaligned inductance."""
        return MAP_FILE if self.is_map else "magnetics.unaligned_inductance_H"

    def origin(self, name: str) -> str:
        """The key that a value follows from; the name itself when it has a default that the file does not state."""
        while (key := self.key(name)) is None and name in _FOLLOWS:
            name = _FOLLOWS[name](self)
        return key or name

    def shown(self, name: str, separator: str = ", ") -> str:
        """Name, value and unit in a message."""
        key, origin = self.key(name), self.origin(name)
        if name == MAP_FILE:
            return name
        where = key or (f"{name} (default)" if origin == name else f"{name} (from {self.shown(origin)})")
        return f"{where}{separator}{self[name]:.6g}{unit_of(name)}"


def _of_supply(name: str, other: str) -> Callable[[Facts], str]:
    """An end of the supply's range is the supply, or the other end where the file states one beyond."""
    supply = "converter.supply_voltage_V"
    return lambda of: other if of.key(other) and of[name] != of[supply] else supply


def _base_speed(of: Facts) -> str:
    if of.key("speed_max_rpm") and of["speed_base_rpm"] == of["speed_max_rpm"]:
        return "speed_max_rpm"
    return "control_rate_hz" if _sampled(of, "speed_base_rpm") else "supply_min_V"


def _sampled(of: Facts, name: str) -> bool:
    """Whether the control rate limits a speed."""
    return of[name] >= sampled_speed_rpm(of["control_rate_hz"], of.machine) * (1.0 - 1e-9)


def _peak_current(of: Facts) -> str:
    names = ("torque_peak_Nm", "torque_rated_Nm", "current_rated_A")
    return next((name for name in names if of.key(name)), of.flux_key)


def _over_voltage(of: Facts) -> str:
    chopper = "dc_link.chopper_on_V"
    return chopper if chopper in of and 1.03 * of[chopper] > 1.25 * of["supply_max_V"] else "supply_max_V"


def _same(name: str) -> Callable[[Facts], str]:
    return lambda of: name


_FOLLOWS: dict[str, Callable[[Facts], str]] = {
    "supply_min_V": _of_supply("supply_min_V", "supply_max_V"),
    "supply_max_V": _of_supply("supply_max_V", "supply_min_V"),
    "current_peak_A": _peak_current,
    "torque_peak_Nm": _same("current_peak_A"),
    "torque_rated_Nm": lambda of: "current_rated_A" if of.key("current_rated_A") else "torque_peak_Nm",
    "current_rated_A": _same("torque_rated_Nm"),
    "speed_base_rpm": _base_speed,
    "speed_max_rpm": lambda of: "control_rate_hz" if _sampled(of, "speed_max_rpm") else "speed_base_rpm",
    "adc_current_A": _same("current_peak_A"),
    "adc_voltage_V": _same("over_voltage_V"),
    "current_limit_A": _same("current_peak_A"),
    "current_trip_A": lambda of: "adc_current_A" if of.key("adc_current_A") else "current_peak_A",
    "over_voltage_V": _over_voltage,
    "under_voltage_V": _same("supply_min_V"),
    "over_speed_rpm": _same("speed_max_rpm"),
    "torque_band_inner_Nm": _same("torque_rated_Nm"),
    "torque_band_outer_Nm": _same("torque_rated_Nm"),
    "turn_on_angle_deg": _same("converter.supply_voltage_V"),
    "turn_off_angle_deg": _same("turn_on_angle_deg"),
    "outgoing_off_angle_deg": _same("turn_on_angle_deg"),
    "winding_current_A": _same("current_rated_A"),
    "switch_current_A": _same("current_peak_A"),
    "winding_time_constant_s": _same("thermal_time_constant_s"),
}
