"""Random contradictions of machine files: a legal machine with a key changed to what another one rules out.

Kinds of contradiction are independent of the rules of salient.machine.contradictions: each changes a text, by physics
of its own, and names the two keys that the refusal has to name.
"""

from __future__ import annotations

import math
import random
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from salient.experiments.compare.random_machines import WHOLE_RANGE, random_machine
from salient.experiments.compare.random_maps import random_map
from salient.machine.drive_data import DriveData, derive
from salient.machine.file import Machine, load_machine
from salient.paths import EXAMPLE_MACHINES, MACHINES, ROOT

SEED = 20261128
_RPM = 30.0 / math.pi
FILES = sorted([*MACHINES.glob("*.toml"), *EXAMPLE_MACHINES.glob("*.toml"), *(ROOT / "tests/machines").glob("*.toml")])


@dataclass(frozen=True)
class Legal:
    """A machine file without a contradiction, and what follows from it."""

    text: str
    machine: Machine
    data: DriveData


RANDOM, MAPS = 24, 6
"""Random machines of each kind that are changed."""


@lru_cache
def legal_machine(number: int, folder: Path) -> Legal:
    """A bundled machine, one of the examples or a random one; its map, if it has one, is written to the folder."""
    if number < len(FILES):
        text = FILES[number].read_text(encoding="utf-8")
        for table in FILES[number].parent.glob("*.csv"):
            (folder / table.name).write_bytes(table.read_bytes())
    elif number < len(FILES) + RANDOM:
        text = random_machine(number, WHOLE_RANGE)
    else:
        text, table_text = random_map(number)
        (folder / f"random_map_{number:02}.csv").write_text(table_text, encoding="utf-8")
    path = folder / "legal.toml"
    path.write_text(text, encoding="utf-8")
    machine = load_machine(path)
    return Legal(text, machine, derive(machine))


class Text:
    """A machine file whose keys can be set."""

    def __init__(self, text: str) -> None:
        self.tables: dict[str, dict[str, object]] = {}
        for name, value in tomllib.loads(text).items():
            if isinstance(value, dict):
                inner = {key: each for key, each in value.items() if isinstance(each, dict)}
                self.tables[name] = {key: each for key, each in value.items() if key not in inner}
                self.tables |= {f"{name}.{key}": each for key, each in inner.items()}
            else:
                self.name = value

    def set(self, **keys: float) -> None:
        """drive__current_peak_A = 3: key current_peak_A of table [drive]; drive_parameters__x of [drive.parameters]."""
        for place, value in keys.items():
            table, key = place.split("__")
            self.tables.setdefault(table.replace("drive_parameters", "drive.parameters"), {})[key] = value

    def forget(self, *tables: str) -> None:
        """Leaves tables out."""
        for table in tables:
            self.tables.pop(table, None)

    def __str__(self) -> str:
        lines = [f'name = "{self.name}"']
        for table, keys in self.tables.items():
            lines += [f"[{table}]", *(f"{key} = {_toml(value)}" for key, value in keys.items())]
        return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:.6g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Case:
    """Facts that a kind of contradiction may use."""

    text: Text
    machine: Machine
    data: DriveData
    chance: random.Random

    def factor(self, low: float = 1.1, high: float = 1000.0) -> float:
        """By which a value is beyond what is possible."""
        return math.exp(self.chance.uniform(math.log(low), math.log(high)))

    @property
    def saturating(self) -> bool:
        return "flux_linkage_max_Wb" in self.text.tables["magnetics"]

    @property
    def is_map(self) -> bool:
        return "file" in self.text.tables["magnetics"]

    def magnetic(self, key: str) -> float:
        value = self.text.tables["magnetics"][key]
        assert isinstance(value, int | float)
        return float(value)


Keys = tuple[str, str]
"""The two keys that contradict each other: either may be one of several, apart by |."""
Kind = Callable[[Case], Keys | None]
"""Changes a text; None where the machine has no such keys."""

_FLUX = ("magnetics.file|magnetics.flux_linkage_max_Wb|magnetics.aligned_inductance_H|drive.torque_peak_Nm|"
         "drive.torque_rated_Nm|drive.current_peak_A")
"""Sources of the torque and the currents of a machine."""
_SUPPLY = "converter.supply_voltage_V|drive.supply_max_V|drive.supply_min_V"
_PEAK = f"drive.current_peak_A|{_FLUX}"


# --- magnetics ---

def aligned_below_unaligned(case: Case) -> Keys | None:
    if case.is_map:
        return None
    unaligned_H = case.magnetic("unaligned_inductance_H")
    case.text.set(magnetics__aligned_inductance_H=max(unaligned_H / case.factor(), 2e-6))
    return "magnetics.aligned_inductance_H", "magnetics.unaligned_inductance_H"


def unaligned_above_aligned(case: Case) -> Keys | None:
    if case.is_map:
        return None
    aligned_H = case.magnetic("aligned_inductance_H")
    case.text.set(magnetics__unaligned_inductance_H=min(aligned_H * case.factor(1.1, 50.0), 10.0))
    return "magnetics.aligned_inductance_H", "magnetics.unaligned_inductance_H"


def unaligned_in_another_unit(case: Case) -> Keys | None:
    """uH for H, or mH twice over."""
    if case.is_map:
        return None
    small = case.magnetic("unaligned_inductance_H") / 1000.0
    if small < 1e-6:
        return None
    if case.saturating:
        case.text.set(magnetics__saturated_inductance_H=max(0.2 * small, 1e-7))
    case.text.set(magnetics__unaligned_inductance_H=small)
    return "magnetics.aligned_inductance_H", "magnetics.unaligned_inductance_H"


def aligned_in_another_unit(case: Case) -> Keys | None:
    if case.is_map or case.magnetic("aligned_inductance_H") > 0.01:
        return None
    case.text.set(magnetics__aligned_inductance_H=1000.0 * case.magnetic("aligned_inductance_H"))
    return "magnetics.aligned_inductance_H", "magnetics.unaligned_inductance_H"


def saturated_above_unaligned(case: Case) -> Keys | None:
    if not case.saturating:
        return None
    case.text.set(magnetics__saturated_inductance_H=min(case.magnetic("unaligned_inductance_H")
                                                        * case.factor(1.01, 30.0), 9.0))
    return "magnetics.saturated_inductance_H", "magnetics.unaligned_inductance_H"


def flux_beyond_the_inductance(case: Case) -> Keys | None:
    if not case.saturating:
        return None
    most_Wb = case.magnetic("aligned_inductance_H") * case.magnetic("current_at_flux_linkage_max_A")
    case.text.set(magnetics__flux_linkage_max_Wb=min(most_Wb * case.factor(), 100.0))
    return (None if most_Wb > 99.0
            else ("magnetics.flux_linkage_max_Wb", "magnetics.aligned_inductance_H"))


def current_of_the_point_too_small(case: Case) -> Keys | None:
    if not case.saturating:
        return None
    least_A = case.magnetic("flux_linkage_max_Wb") / case.magnetic("aligned_inductance_H")
    case.text.set(magnetics__current_at_flux_linkage_max_A=max(least_A / case.factor(), 0.1))
    return ("magnetics.flux_linkage_max_Wb", "magnetics.current_at_flux_linkage_max_A") if least_A > 0.11 else None


def flux_below_the_saturated_inductance(case: Case) -> Keys | None:
    if not case.saturating:
        return None
    least_Wb = case.magnetic("saturated_inductance_H") * case.magnetic("current_at_flux_linkage_max_A")
    case.text.set(magnetics__flux_linkage_max_Wb=max(least_Wb / case.factor(1.01, 50.0), 1e-4))
    return ("magnetics.flux_linkage_max_Wb", "magnetics.saturated_inductance_H") if least_Wb > 1.1e-4 else None


def _trapezoid(case: Case) -> float | None:
    """Makes the magnetics a trapezoid; half a rotor pitch in degrees."""
    if case.is_map or case.saturating:
        return None
    case.text.tables["magnetics"] = {
        "form": "linear_trapezoid", **{key: case.magnetic(key) for key in ("unaligned_inductance_H",
                                                                          "aligned_inductance_H")}}
    return 180.0 / case.machine.rotor_poles


def flats_beyond_the_stroke(case: Case) -> Keys | None:
    half_deg = _trapezoid(case)
    if half_deg is None:
        return None
    most_deg = 0.5 * half_deg - half_deg / case.machine.phases
    case.text.set(magnetics__flat_deg=min(most_deg * case.factor(1.05, 3.0), 20.0), magnetics__blend_deg=0.5)
    return "magnetics.flat_deg", "poles.rotor"


def blends_beyond_the_pitch(case: Case) -> Keys | None:
    half_deg = _trapezoid(case)
    if half_deg is None:
        return None
    flat_deg = case.chance.uniform(0.5, 0.95) * (0.5 * half_deg - half_deg / case.machine.phases)
    blend_deg = (0.5 * half_deg - flat_deg) * case.factor(1.02, 1.3)
    case.text.set(magnetics__flat_deg=flat_deg, magnetics__blend_deg=blend_deg)
    return ("magnetics.blend_deg", "magnetics.flat_deg") if blend_deg <= 20.0 else None


# --- supply and DC link ---

def supply_below_its_range(case: Case) -> Keys:
    case.text.forget("dc_link")
    case.text.set(drive__supply_min_V=case.machine.supply_voltage_V * case.factor(1.02, 1.9),
                  drive__supply_max_V=2000.0)
    return "drive.supply_min_V", "converter.supply_voltage_V"


def supply_above_its_range(case: Case) -> Keys:
    top_V = max(case.machine.supply_voltage_V / case.factor(1.02, 30.0), 1.0)
    case.text.set(drive__supply_min_V=1.0, drive__supply_max_V=top_V)
    return "drive.supply_max_V", "converter.supply_voltage_V"


def over_voltage_below_the_supply(case: Case) -> Keys:
    case.text.set(drive_parameters__over_voltage_V=case.data.supply_max_V / case.factor(1.01, 20.0))
    return "drive.parameters.over_voltage_V", _SUPPLY


def under_voltage_above_the_supply(case: Case) -> Keys:
    case.text.set(drive_parameters__under_voltage_V=case.data.supply_min_V * case.factor(1.01, 20.0))
    return "drive.parameters.under_voltage_V", _SUPPLY


def divider_below_the_trip(case: Case) -> Keys:
    case.text.set(drive__adc_voltage_V=max(case.data.over_voltage_V / case.factor(1.02, 20.0), 1.0))
    return "drive.adc_voltage_V", f"{_SUPPLY}|dc_link.chopper_on_V|drive.parameters.over_voltage_V"


def divider_far_above_the_trip(case: Case) -> Keys | None:
    full_V = case.data.supply_max_V * case.factor(20.0, 1000.0)
    case.text.set(drive__adc_voltage_V=full_V)
    return ("drive.adc_voltage_V", _SUPPLY) if full_V <= 5000.0 else None


def _link(case: Case, **keys: float) -> None:
    case.text.forget("dc_link")
    case.text.set(dc_link__capacitance_F=5e-3, dc_link__source_resistance_ohm=0.001,
                  **{f"dc_link__{key}": value for key, value in keys.items()})


def chopper_below_the_supply(case: Case) -> Keys | None:
    supply_V = case.data.supply_max_V
    off_V = supply_V / case.factor(1.01, 1.9)
    _link(case, chopper_resistance_ohm=50.0, chopper_on_V=1.1 * supply_V, chopper_off_V=max(off_V, 5.0))
    return "dc_link.chopper_off_V", _SUPPLY


def chopper_the_wrong_way_round(case: Case) -> Keys:
    on_V = 1.1 * case.data.supply_max_V
    _link(case, chopper_resistance_ohm=50.0, chopper_on_V=on_V, chopper_off_V=on_V * case.factor(1.0, 1.5))
    return "dc_link.chopper_off_V", "dc_link.chopper_on_V"


def chopper_above_the_trip(case: Case) -> Keys:
    over_V = 1.3 * case.data.supply_max_V
    _link(case, chopper_resistance_ohm=50.0, chopper_on_V=over_V * case.factor(1.01, 1.4),
          chopper_off_V=1.1 * case.data.supply_max_V)
    case.text.set(drive_parameters__over_voltage_V=over_V)
    return "dc_link.chopper_on_V", "drive.parameters.over_voltage_V"


def source_too_weak_for_the_power(case: Case) -> Keys | None:
    _link(case)
    # No source gives more than V^2 / 4 R.
    power_W = case.data.torque_rated_Nm * case.data.speed_base_rpm / _RPM
    ohm = case.data.supply_max_V**2 / 4.0 / power_W * case.factor(1.1, 100.0)
    case.text.set(dc_link__source_resistance_ohm=ohm)
    return ("dc_link.source_resistance_ohm", _SUPPLY) if 0.001 <= ohm <= 10.0 else None


# --- currents and sensors ---

def rated_above_peak(case: Case) -> Keys:
    peak_A = case.data.current_peak_A
    case.text.set(drive__current_peak_A=peak_A, drive__current_rated_A=peak_A * case.factor(1.01, 4.0))
    return "drive.current_rated_A", "drive.current_peak_A"


def sensors_below_peak(case: Case) -> Keys:
    case.text.set(drive__adc_current_A=max(case.data.current_peak_A / case.factor(1.0, 8.0), 0.1))
    return "drive.adc_current_A", _PEAK


def sensors_far_above_peak(case: Case) -> Keys | None:
    case.text.set(drive__adc_current_A=min(case.data.current_peak_A * 1000.0, 10_000.0))
    return ("drive.adc_current_A", _PEAK) if case.data.current_peak_A < 200.0 else None


def limit_above_trip(case: Case) -> Keys:
    peak_A = case.data.current_peak_A
    case.text.set(drive_parameters__current_trip_A=1.2 * peak_A,
                  drive_parameters__current_limit_A=1.2 * peak_A * case.factor(1.0, 1.15))
    return "drive.parameters.current_limit_A", "drive.parameters.current_trip_A"


def trip_below_peak(case: Case) -> Keys:
    case.text.set(drive_parameters__current_trip_A=case.data.current_peak_A / case.factor(1.01, 10.0))
    return "drive.parameters.current_trip_A", f"{_PEAK}|drive.parameters.current_limit_A"


def trip_beyond_the_sensors(case: Case) -> Keys:
    full_A = 1.6 * case.data.current_peak_A
    case.text.set(drive__adc_current_A=full_A, drive_parameters__current_trip_A=full_A * case.factor(1.0, 30.0))
    return "drive.parameters.current_trip_A", "drive.adc_current_A"


def sensor_that_saturates_below_the_limit(case: Case) -> Keys | None:
    limit_A = case.data.parameters["current_limit_A"] / case.factor(1.05, 20.0)
    case.text.set(sensors__current_limit_A=limit_A)
    return ("sensors.current_limit_A", f"{_PEAK}|drive.parameters.current_limit_A") if limit_A > 0.1 else None


def sensor_gain_beyond_the_trip(case: Case) -> Keys | None:
    gain = case.data.current_trip_A / case.data.parameters["current_limit_A"] * case.factor(1.02, 4.0)
    case.text.set(sensors__current_gain=gain)
    trip = f"{_PEAK}|drive.parameters.current_trip_A|drive.adc_current_A"
    return ("sensors.current_gain", trip) if gain < 10.0 else None


def sensor_gain_too_small(case: Case) -> Keys:
    gain = case.data.parameters["current_limit_A"] / case.data.current_trip_A / case.factor(1.3, 1000.0)
    case.text.set(sensors__current_gain=case.chance.choice([gain, gain, 0.0]))
    return "sensors.current_gain", f"{_PEAK}|drive.parameters.current_trip_A|drive.adc_current_A"


def sensor_noise_beyond_the_trip(case: Case) -> Keys | None:
    noise_A = (case.data.current_trip_A - case.data.parameters["current_limit_A"]) * case.factor(0.5, 20.0)
    case.text.set(sensors__current_noise_A=noise_A)
    return (("sensors.current_noise_A", f"{_PEAK}|drive.parameters.current_trip_A|drive.adc_current_A")
            if noise_A < 80.0 else None)


def limit_beyond_the_map(case: Case) -> Keys | None:
    if not case.is_map:
        return None
    most_A = case.machine.magnetics.current_max_A
    case.text.set(drive__current_peak_A=most_A * case.factor(1.02, 3.0))
    case.text.tables["drive"].pop("adc_current_A", None)
    return "drive.current_peak_A", "magnetics.file"


def continuous_current_above_the_limit(case: Case) -> Keys:
    case.text.set(drive_parameters__winding_current_A=case.data.parameters["current_limit_A"] * case.factor(1.02, 1.5))
    return "drive.parameters.winding_current_A", f"{_PEAK}|drive.parameters.current_limit_A"


# --- torque ---

def rated_torque_above_peak(case: Case) -> Keys:
    peak_Nm = case.data.torque_peak_Nm
    case.text.set(drive__torque_peak_Nm=peak_Nm, drive__torque_rated_Nm=peak_Nm * case.factor(1.02, 5.0))
    return "drive.torque_rated_Nm", "drive.torque_peak_Nm"


def torque_beyond_the_current(case: Case) -> Keys | None:
    """The energy that a stroke converts is at most flux linkage times current."""
    peak_A, m = case.data.current_peak_A, case.machine
    most_Nm = (float(m.magnetics.flux_linkage_Wb(0.0, peak_A)) * peak_A * m.phases * m.rotor_poles / (2.0 * math.pi))
    case.text.tables.get("drive", {}).pop("torque_rated_Nm", None)
    name = case.chance.choice(["torque_peak_Nm", "torque_rated_Nm"])
    torque_Nm = most_Nm * case.factor()
    case.text.set(drive__current_peak_A=peak_A, drive__torque_peak_Nm=torque_Nm)
    if name == "torque_rated_Nm":
        case.text.set(drive__torque_rated_Nm=0.9 * torque_Nm)
    return ("drive.torque_peak_Nm", "drive.current_peak_A") if torque_Nm < 20_000.0 else None


def rated_torque_beyond_the_current_limit(case: Case) -> Keys | None:
    limit_A, m = 0.3 * case.data.current_peak_A, case.machine
    most_Nm = (float(m.magnetics.flux_linkage_Wb(0.0, limit_A)) * limit_A * m.phases * m.rotor_poles / (2.0 * math.pi))
    if most_Nm > case.data.torque_rated_Nm:
        return None
    case.text.set(drive__torque_rated_Nm=case.data.torque_rated_Nm, drive_parameters__current_limit_A=limit_A)
    case.text.tables.get("drive.parameters", {}).pop("winding_current_A", None)
    return "drive.torque_rated_Nm|drive.parameters.winding_current_A", "drive.parameters.current_limit_A"


def resistance_that_takes_the_supply(case: Case) -> Keys | None:
    ohm = case.data.supply_max_V / case.data.current_rated_A * case.factor(1.05, 1000.0)
    case.text.set(winding__resistance_ohm=ohm)
    return ("winding.resistance_ohm", _SUPPLY) if ohm <= 100.0 else None


def devices_that_take_the_supply(case: Case) -> Keys | None:
    supply_V = case.data.supply_max_V
    if supply_V > 9.0 * 2:
        ohm = supply_V / case.data.current_rated_A / 2.0 * case.factor(1.05, 10.0)
        case.text.set(converter__switch_resistance_ohm=ohm)
        return ("converter.switch_resistance_ohm", _SUPPLY) if ohm <= 1.0 else None
    drop_V = supply_V / 2.0 * case.factor(1.05, 2.0)
    case.text.set(converter__switch_drop_V=drop_V)
    return ("converter.switch_drop_V", _SUPPLY) if drop_V <= 5.0 else None


def supply_below_the_resistance(case: Case) -> Keys | None:
    supply_V = case.machine.resistance_ohm * case.data.current_rated_A / case.factor(1.05, 10.0)
    case.text.set(drive__current_rated_A=case.data.current_rated_A, converter__supply_voltage_V=supply_V,
                  drive__current_peak_A=case.data.current_peak_A)
    for name in ("supply_min_V", "supply_max_V", "adc_voltage_V", "speed_base_rpm", "speed_max_rpm"):
        case.text.tables["drive"].pop(name, None)
    return ("winding.resistance_ohm|converter.switch_drop_V|converter.switch_resistance_ohm",
            _SUPPLY) if supply_V >= 5.0 and "dc_link" not in case.text.tables else None


def friction_above_the_torque(case: Case) -> Keys | None:
    friction = case.data.torque_peak_Nm / (case.data.speed_base_rpm / _RPM) * case.factor()
    case.text.set(mechanics__friction_Nm_s=friction)
    return ("mechanics.friction_Nm_s", _FLUX) if friction <= 1000.0 else None


def inertia_of_a_starting_hour(case: Case) -> Keys | None:
    inertia = 3600.0 * case.data.torque_peak_Nm / (case.data.speed_base_rpm / _RPM) * case.factor(1.0, 100.0)
    case.text.set(mechanics__inertia_kg_m2=inertia)
    return ("mechanics.inertia_kg_m2", _FLUX) if inertia <= 1000.0 else None


def inertia_of_a_few_control_periods(case: Case) -> Keys | None:
    """From rest to the base speed in less than two of them."""
    inertia = (2.0 / case.data.control_rate_hz * case.data.torque_peak_Nm / (case.data.speed_base_rpm / _RPM)
               / case.factor(1.0, 100.0))
    case.text.set(mechanics__inertia_kg_m2=inertia)
    return ("mechanics.inertia_kg_m2", _FLUX) if inertia >= 1e-9 else None


# --- speed ---

def base_above_largest_speed(case: Case) -> Keys:
    base_rpm = case.data.speed_base_rpm
    case.text.set(drive__speed_base_rpm=base_rpm, drive__speed_max_rpm=max(base_rpm / case.factor(1.01, 5.0), 1.0))
    return "drive.speed_base_rpm", "drive.speed_max_rpm"


def speed_beyond_the_control_rate(case: Case) -> Keys | None:
    rpm = 60.0 * case.data.control_rate_hz / 25.0 / case.machine.rotor_poles * case.factor(1.01, 10.0)
    case.text.set(drive__speed_max_rpm=rpm)
    return ("drive.speed_max_rpm", "control_rate_hz") if rpm <= 100_000.0 else None


def speed_trip_below_the_largest(case: Case) -> Keys:
    case.text.set(drive__speed_max_rpm=case.data.speed_max_rpm,
                  drive_parameters__over_speed_rpm=max(math.floor(case.data.speed_max_rpm / case.factor(1.01, 5.0)), 1))
    return "drive.parameters.over_speed_rpm", "drive.speed_max_rpm"


def supply_too_low_for_the_rated_power(case: Case) -> Keys | None:
    """The mean power of the phases is at most supply times current, each on for half of the time."""
    case.text.set(drive__torque_rated_Nm=case.data.torque_rated_Nm, drive__current_peak_A=case.data.current_peak_A,
                  drive__torque_peak_Nm=case.data.torque_peak_Nm)
    most_W = 0.5 * case.machine.phases * case.data.supply_max_V * case.data.current_peak_A
    rpm = most_W / case.data.torque_rated_Nm * _RPM * case.factor(1.0, 20.0)
    case.text.set(drive__speed_base_rpm=rpm, drive__speed_max_rpm=rpm)
    return ("drive.speed_base_rpm", _SUPPLY) if rpm * case.machine.rotor_poles * 25.0 < 55.0 * (
        case.data.control_rate_hz) else None


# --- heat, iron ---

def thermal_path_beyond_the_limit(case: Case) -> Keys | None:
    loss_W = case.machine.resistance_ohm * case.data.parameters["winding_current_A"] ** 2
    resistance = (case.data.parameters["winding_limit_C"] - 25.0) / loss_W * case.factor(1.05, 100.0)
    case.text.set(thermal__winding_resistance_K_W=resistance)
    return ("thermal.winding_resistance_K_W", "winding_limit_C") if 1e-5 < resistance < 1e5 else None


def limit_of_temperature_at_ambient(case: Case) -> Keys:
    case.text.set(drive_parameters__winding_limit_C=case.chance.randrange(40, 45))
    return "drive.parameters.winding_limit_C", "25 C"


def time_constants_that_differ(case: Case) -> Keys | None:
    loss_W = case.machine.resistance_ohm * case.data.parameters["winding_current_A"] ** 2
    resistance_K_W = 80.0 / loss_W
    capacity_J_K = case.data.thermal_time_constant_s / resistance_K_W / case.factor(2.2, 100.0)
    case.text.set(thermal__winding_resistance_K_W=resistance_K_W, thermal__winding_capacity_J_K=capacity_J_K)
    return (("thermal.winding_capacity_J_K", "thermal_time_constant_s")
            if 1e-3 <= capacity_J_K <= 1e7 and 1e-5 <= resistance_K_W <= 1e5 else None)


def iron_beyond_saturation(case: Case) -> Keys | None:
    flux_Wb = float(case.machine.magnetics.flux_linkage_Wb(0.0, case.data.current_peak_A))
    area_m2 = flux_Wb / 3.0 / case.factor(1.1, 1000.0)
    case.text.set(iron_loss__turns_area_m2=area_m2, iron_loss__mass_kg=1.0, iron_loss__steinmetz_k=0.003,
                  iron_loss__steinmetz_alpha=1.5, iron_loss__steinmetz_beta=1.8)
    return ("iron_loss.turns_area_m2", "magnetics.") if area_m2 >= 1e-6 else None


def angles_the_wrong_way_round(case: Case) -> Keys:
    off_deg = case.chance.uniform(181.0, 300.0)
    case.text.set(drive_parameters__turn_off_angle_deg=off_deg,
                  drive_parameters__turn_on_angle_deg=case.chance.uniform(off_deg + 1.0, 359.0))
    return "drive.parameters.turn_on_angle_deg", "drive.parameters.turn_off_angle_deg"


KINDS: tuple[Kind, ...] = tuple(
    value for name, value in list(globals().items())
    if re.fullmatch(r"[a-z]\w*", name) and getattr(value, "__annotations__", {}).get("case") == "Case"
)


@dataclass(frozen=True)
class Contradiction:
    """A file and the keys that its refusal has to name."""

    kind: str
    text: str
    keys: Keys


def contradiction(number: int, folder: Path) -> Contradiction:
    """A random one, by its number; its file is written as contradiction.toml in a folder."""
    chance = random.Random(SEED + number)
    kind = KINDS[number % len(KINDS)]
    while True:
        legal = legal_machine(chance.randrange(len(FILES) + RANDOM + MAPS), folder)
        case = Case(Text(legal.text), legal.machine, legal.data, chance)
        keys = kind(case)
        if keys is not None:
            (folder / "contradiction.toml").write_text(str(case.text), encoding="utf-8")
            return Contradiction(kind.__name__, str(case.text), keys)
