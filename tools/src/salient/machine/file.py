"""Machine files: one TOML file describes a drive's motor, converter and sensors to the emulator and to the firmware.

`load_machine` reads and checks a file; every mistake is a `MachineError` of one line that names the file and the key.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from salient.machine.flux_map import FluxMap, FluxMapError
from salient.machine.flux_map_csv import load_flux_map
from salient.machine.magnetics import FORMULA_KEYS, INDUCTANCES, Formula
from salient.toml_file import TextFileError, read_toml

SHIPPED = Path(__file__).resolve().parents[3] / "machines"

FORMS = (*FORMULA_KEYS, "map")

_SHOWN_MAX = 60  # characters of a wrong value in a message

# Phases by stator and rotor poles.
_PHASES = {(6, 4): 3, (8, 6): 4, (12, 8): 3}

_TABLES = ("poles", "winding", "mechanics", "magnetics", "converter")
_OPTIONAL_TABLES = ("dc_link", "sensors", "iron_loss")

# (minimum, maximum) of every number, both allowed. Wide enough for any machine that the number formats of the firmware
# can carry (inertia and friction are Q1.30 there).
WINDING = {"resistance_ohm": (1e-4, 100.0)}
MECHANICS = {"inertia_kg_m2": (1e-4, 1.9), "friction_Nm_s": (0.0, 1.9)}
SUPPLY = {"supply_voltage_V": (10.0, 500.0)}

# The rest may be left out, key by key: (minimum, maximum, value when left out). What they mean stands in
# emulator/plant/machine.h. Ideal devices, ideal sensors.
CONVERTER: dict[str, tuple[float, float, float]] = {
    "switch_drop_V": (0.0, 5.0, 0.0),
    "switch_resistance_ohm": (0.0, 1.0, 0.0),
    "diode_drop_V": (0.0, 5.0, 0.0),
    "diode_resistance_ohm": (0.0, 1.0, 0.0),
    "minimum_pulse_ns": (0.0, 2000.0, 0.0),
}
SENSORS: dict[str, tuple[float, float, float]] = {
    "current_gain": (0.0, 10.0, 1.0),
    "current_offset_A": (-10.0, 10.0, 0.0),
    "current_noise_A": (0.0, 10.0, 0.0),
    "current_limit_A": (0.1, 1000.0, 1000.0),
    "current_delay_ns": (0.0, 8000.0, 0.0),
    "encoder_eccentricity_deg": (0.0, 5.0, 0.0),
}
# A table that is left out: an ideal supply that takes energy back.
DC_LINK = {"capacitance_F": (1e-5, 1.0), "source_resistance_ohm": (0.001, 10.0)}
CHOPPER = {"chopper_resistance_ohm": (0.1, 1000.0), "chopper_on_V": (10.0, 510.0), "chopper_off_V": (10.0, 510.0)}
# A table that is left out: no estimate.
IRON_LOSS = {
    "turns_area_m2": (1e-6, 10.0),
    "mass_kg": (1e-3, 1000.0),
    "steinmetz_k": (1e-6, 10.0),
    "steinmetz_alpha": (1.0, 2.0),
    "steinmetz_beta": (1.5, 3.0),
}


class MachineError(ValueError):
    """A machine file that cannot be used; the text is one line for the user."""


@dataclass(frozen=True)
class Machine:
    """A motor with its converter and sensors, in SI units."""

    name: str
    stator_poles: int
    rotor_poles: int
    phases: int
    resistance_ohm: float
    inertia_kg_m2: float
    friction_Nm_s: float
    supply_voltage_V: float
    magnetics: Formula | FluxMap
    converter: dict[str, float]
    """Every key of CONVERTER."""
    dc_link: dict[str, float] | None
    """None: ideal. The chopper's keys are there when it has one."""
    sensors: dict[str, float]
    """Every key of SENSORS."""
    iron_loss: dict[str, float] | None

    @property
    def pitch_rad(self) -> float:
        """Rotor pole pitch."""
        return 2.0 * math.pi / self.rotor_poles

    @property
    def current_rise_A_s(self) -> float:
        """Current slope at the supply voltage with the rotor unaligned and at rest, A/s."""
        return self.supply_voltage_V / self.magnetics.unaligned_inductance_H


def machine_path(name_or_path: str) -> Path:
    """The file meant by a shipped machine's name or by a path; MachineError when there is none."""
    shipped, path = SHIPPED / f"{name_or_path}.toml", Path(name_or_path)
    try:
        if shipped.is_file():
            return shipped
        if path.is_file():
            return path.resolve()
    except OSError:
        pass  # a name too long for a file: there is none
    names = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.toml")))
    raise MachineError(f"machine {_shown(name_or_path)}: no such file, and no shipped machine of that name ({names})")


def load_machine(path: Path | str) -> Machine:
    """Reads and checks a machine file."""
    path = Path(path)
    try:
        data = read_toml(path)
    except TextFileError as error:
        raise MachineError(f"{path}: {error}") from None

    _check_keys(path, "", data, ["name", *_TABLES], _OPTIONAL_TABLES)
    name = data["name"]
    if not isinstance(name, str) or not name.isidentifier() or not name.isascii():
        raise MachineError(f"{path}: name: {_shown(name)} is not a plain word (letters, digits, underscore)")
    for section in (*_TABLES, *_OPTIONAL_TABLES):
        if not isinstance(data.get(section, {}), dict):
            raise MachineError(f"{path}: {section}: a table [{section}] is wanted")

    stator, rotor, phases = _poles(path, data["poles"])
    values = _numbers(path, "winding", data["winding"], WINDING)
    values |= _numbers(path, "mechanics", data["mechanics"], MECHANICS)
    converter = _numbers(path, "converter", data["converter"], SUPPLY | CONVERTER)
    sensors = _numbers(path, "sensors", data.get("sensors", {}), SENSORS)
    supply_voltage_V = converter.pop("supply_voltage_V")
    dc_link = _dc_link(path, data["dc_link"], supply_voltage_V) if "dc_link" in data else None
    iron_loss = _numbers(path, "iron_loss", data["iron_loss"], IRON_LOSS) if "iron_loss" in data else None
    return Machine(
        name=name,
        stator_poles=stator,
        rotor_poles=rotor,
        phases=phases,
        supply_voltage_V=supply_voltage_V,
        magnetics=_magnetics(path, data["magnetics"], rotor),
        converter=converter,
        dc_link=dc_link,
        sensors=sensors,
        iron_loss=iron_loss,
        **values,
    )


def _shown(value: object) -> str:
    """A value or key of the user's, short and on one line."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "a value too long to show"
    return text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."


def _check_keys(path: Path, section: str, table: dict, needed, optional=()) -> None:
    prefix = f"{section}." if section else ""
    for key in table:
        if key not in needed and key not in optional:
            shown = key if key.isidentifier() and len(key) <= _SHOWN_MAX else _shown(key)
            raise MachineError(f"{path}: {prefix}{shown}: unknown key; allowed: {', '.join([*needed, *optional])}")
    for key in needed:
        if key not in table:
            raise MachineError(f"{path}: {prefix}{key}: missing")


def _numbers(path: Path, section: str, table: dict, ranges: dict[str, tuple]) -> dict[str, float]:
    """The numbers of a table; a range of three has its default, a range of two is needed."""
    needed = [key for key, limits in ranges.items() if len(limits) == 2]
    _check_keys(path, section, table, needed, [key for key in ranges if key not in needed])
    values = {}
    for key, (low, high, *default) in ranges.items():
        value = table.get(key, *default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            raise MachineError(f"{path}: {section}.{key}: {_shown(value)} is not a number from {low:g} to {high:g}")
        values[key] = float(value)
    return values


def _poles(path: Path, table: dict) -> tuple[int, int, int]:
    _check_keys(path, "poles", table, ["stator", "rotor"])
    stator, rotor = table["stator"], table["rotor"]
    if type(stator) is int and type(rotor) is int and (stator, rotor) in _PHASES:
        return stator, rotor, _PHASES[stator, rotor]
    names = ", ".join(f"{s}/{r}" for s, r in _PHASES)
    raise MachineError(f"{path}: poles: {_shown(stator)}/{_shown(rotor)} is not one of {names}")


def _dc_link(path: Path, table: dict, supply_voltage_V: float) -> dict[str, float]:
    has_chopper = any(key in table for key in CHOPPER)
    link = _numbers(path, "dc_link", table, DC_LINK | (CHOPPER if has_chopper else {}))
    if has_chopper and not supply_voltage_V < link["chopper_off_V"] < link["chopper_on_V"]:
        raise MachineError(
            f"{path}: dc_link.chopper_off_V: must lie between converter.supply_voltage_V and dc_link.chopper_on_V"
        )
    return link


def _magnetics(path: Path, table: dict, rotor_poles: int) -> Formula | FluxMap:
    form = table.get("form")
    if form not in FORMS:
        raise MachineError(f"{path}: magnetics.form: {_shown(form)} is not one of {', '.join(FORMS)}")
    if form == "map":
        return _flux_map(path, table, rotor_poles)
    parameters = {key: value for key, value in table.items() if key != "form"}
    formula = Formula(form, rotor_poles, _numbers(path, "magnetics", parameters, FORMULA_KEYS[form]))
    mistake = formula.mistake()
    if mistake is not None:
        raise MachineError(f"{path}: magnetics.{mistake[0]}: {mistake[1]}")
    return formula


def _flux_map(path: Path, table: dict, rotor_poles: int) -> FluxMap:
    _check_keys(path, "magnetics", table, ["form", "file"])
    name = table["file"]
    if not isinstance(name, str) or not name.isprintable() or not name.endswith(".csv"):
        raise MachineError(f"{path}: magnetics.file: {_shown(name)} is not the name of a .csv file")
    try:
        flux_map = load_flux_map(path.parent / name, rotor_poles)
    except FluxMapError as error:
        raise MachineError(str(error)) from None
    # A unit mixed up is a factor of 1000, which takes the inductances of many machines out of the range.
    for key, angle_rad in (("unaligned_inductance_H", flux_map.pitch_rad / 2.0), ("aligned_inductance_H", 0.0)):
        inductance_H, (low, high) = float(flux_map.derivative(angle_rad, 0.0, 0, 2)), INDUCTANCES[key]
        if not low <= inductance_H <= high:
            raise MachineError(
                f"{path.parent / name}: {key} of the map is {inductance_H:.3g}, allowed are {low:g} to {high:g};"
                " are the columns in the header's units?"
            )
    return flux_map
