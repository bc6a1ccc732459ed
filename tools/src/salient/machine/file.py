"""Machine files: one TOML file describes a drive's motor, converter and sensors to the emulator and to the firmware.

`load_machine` reads and checks a file; every mistake is a `MachineError` of one line that names the file and the key.
The meaning of the keys: emulator/plant/machine.h.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, create_model

from salient.dbc import PHASES_MAX, PHASES_MIN
from salient.errors import close_names, shown
from salient.machine.circuit import Coupling, EddyCurrent, Spread, circuit_of
from salient.machine.contradictions import contradiction
from salient.machine.definition import Machine, MachineError
from salient.machine.facts import Facts
from salient.machine.flux_map import FluxMap, FluxMapError
from salient.machine.flux_map_csv import load_flux_map
from salient.machine.magnetics import FORMULA_KEYS, INDUCTANCES, Formula
from salient.machine.parameter_table import SAME_UNITS, read_table
from salient.machine.path import machine_path
from salient.toml_file import Table, TextFileError, checked, number, one_of, option, read_toml, shown_key, validate

__all__ = ["FORMS", "MAGNETICS", "Converter", "Machine", "MachineError", "MachineFile", "Sensors", "load_machine",
           "machine_path", "poles_and_phases"]

FORMS = (*FORMULA_KEYS, "map")

ROTOR_POLES = range(2, 41)
"""A misalignment of 4 mechanical degrees, which the drive learns, is less than half a revolution of its angles."""
STATOR_POLES = range(PHASES_MIN, PHASES_MAX * (ROTOR_POLES.stop - 1) + 1)


# --- tables ---------------------------------------------------------------------------------------------------------

# The ranges suit machines from 0.05 to 2000 N m and 12 to 1000 V, and more; whether inertia and friction suit a
# machine's units in the firmware is checked with them (scaling.py). Defaults stand for ideal devices and sensors.

class Poles(Table):
    stator: Any
    rotor: Any


class Winding(Table):
    resistance_ohm: Annotated[float, number(1e-5, 100.0)]


class Mechanics(Table):
    inertia_kg_m2: Annotated[float, number(1e-9, 1000.0)]
    friction_Nm_s: Annotated[float, number(0.0, 1000.0)]


class Converter(Table):
    supply_voltage_V: Annotated[float, number(5.0, 1500.0)]
    switch_drop_V: Annotated[float, number(0.0, 5.0)] = 0.0
    switch_resistance_ohm: Annotated[float, number(0.0, 1.0)] = 0.0
    diode_drop_V: Annotated[float, number(0.0, 5.0)] = 0.0
    diode_resistance_ohm: Annotated[float, number(0.0, 1.0)] = 0.0
    minimum_pulse_ns: Annotated[float, number(0.0, 2000.0)] = 0.0


class DcLink(Table):
    """Without the table: an ideal supply that absorbs energy."""

    capacitance_F: Annotated[float, number(1e-5, 1.0)]
    source_resistance_ohm: Annotated[float, number(0.001, 10.0)]
    chopper_resistance_ohm: Annotated[float, number(0.1, 1000.0)] | None = None
    chopper_on_V: Annotated[float, number(5.0, 2000.0)] | None = None
    chopper_off_V: Annotated[float, number(5.0, 2000.0)] | None = None


class Sensors(Table):
    current_gain: Annotated[float, number(0.0, 10.0)] = 1.0
    current_offset_A: Annotated[float, number(-100.0, 100.0)] = 0.0
    current_noise_A: Annotated[float, number(0.0, 80.0)] = 0.0
    current_limit_A: Annotated[float, number(0.1, 8000.0)] = 8000.0
    current_delay_ns: Annotated[float, number(0.0, 8000.0)] = 0.0
    encoder_eccentricity_deg: Annotated[float, number(0.0, 5.0)] = 0.0


class IronLoss(Table):
    """Without the table: no estimate."""

    turns_area_m2: Annotated[float, number(1e-6, 10.0)]
    mass_kg: Annotated[float, number(1e-3, 1000.0)]
    steinmetz_k: Annotated[float, number(1e-6, 10.0)]
    steinmetz_alpha: Annotated[float, number(1.0, 2.0)]
    steinmetz_beta: Annotated[float, number(1.5, 3.0)]


class Thermal(Table):
    """Heat path of one winding, and of the switches of one phase; what is left out is derived (heat.py)."""

    winding_capacity_J_K: Annotated[float, number(1e-3, 1e7)] | None = None
    winding_resistance_K_W: Annotated[float, number(1e-5, 1e5)] | None = None
    inverter_capacity_J_K: Annotated[float, number(1e-3, 1e7)] | None = None
    inverter_resistance_K_W: Annotated[float, number(1e-5, 1e5)] | None = None


class Drive(Table):
    """Keys left out are derived (drive_data.py)."""

    supply_min_V: Annotated[float, number(1.0, 2000.0)] | None = None
    supply_max_V: Annotated[float, number(1.0, 2000.0)] | None = None
    current_rated_A: Annotated[float, number(0.01, 5000.0)] | None = None
    current_peak_A: Annotated[float, number(0.01, 5000.0)] | None = None
    torque_rated_Nm: Annotated[float, number(1e-4, 20_000.0)] | None = None
    torque_peak_Nm: Annotated[float, number(1e-4, 20_000.0)] | None = None
    speed_base_rpm: Annotated[float, number(1.0, 100_000.0)] | None = None
    speed_max_rpm: Annotated[float, number(1.0, 100_000.0)] | None = None
    thermal_time_constant_s: Annotated[float, number(0.1, 100_000.0)] | None = None
    control_rate_hz: Annotated[int, option("control_rate_hz")] | None = None
    encoder_bits: Annotated[int, option("encoder_bits")] | None = None
    encoder_edges: Annotated[bool, option("encoder_edges")] | None = None
    adc_bits: Annotated[int, option("adc_bits")] | None = None
    adc_current_A: Annotated[float, number(0.1, 10_000.0)] | None = None
    adc_voltage_V: Annotated[float, number(1.0, 5000.0)] | None = None
    parameters: dict[str, Any] = Field(default={})


class MapMagnetics(Table):
    form: Annotated[str, one_of(("map",))]
    file: Annotated[str, checked("the name of a .csv file", lambda name: name.isprintable() and name.endswith(".csv"))]



def _formula_model(form: str, limits: Mapping[str, tuple[float, float]]) -> type[Table]:
    fields: dict[str, Any] = {key: (Annotated[float, number(low, high)], ...) for key, (low, high) in limits.items()}
    return create_model(form, __base__=Table, form=(Annotated[str, one_of((form,))], ...), **fields)


MAGNETICS: dict[str, type[Table]] = {"map": MapMagnetics} | {
    form: _formula_model(form, limits) for form, limits in FORMULA_KEYS.items()
}
"""The table [magnetics] by its form."""


_NAME_MAX = 100
"""Characters of a name, which the names of files have within them."""


class Named(Table):
    name: Annotated[str, checked(f"a word of letters, digits and underscores, at most {_NAME_MAX}",
                                 lambda name: name.isidentifier() and name.isascii() and len(name) <= _NAME_MAX)]


class MachineFile(Named):
    poles: Poles
    winding: Winding
    mechanics: Mechanics
    magnetics: dict[str, Any]
    converter: Converter
    dc_link: DcLink | None = None
    coupling: Coupling | None = None
    eddy_current: EddyCurrent | None = None
    spread: Spread = Spread()
    sensors: Sensors = Sensors()
    iron_loss: IronLoss | None = None
    thermal: Thermal = Thermal()
    drive: Drive = Drive()


# --- machine --------------------------------------------------------------------------------------------------------



def load_machine(path: Path | str) -> Machine:
    """Reads and checks a machine file."""
    path = Path(path)
    try:
        data = read_toml(path)
        file = validate(MachineFile, data)
        stator, rotor, phases = poles_and_phases(file.poles)
        magnetics = _magnetics(path, file.magnetics, rotor)
        if file.dc_link is not None:
            _check_chopper(file.dc_link)
        machine = _machine(file, (stator, rotor, phases), magnetics)
        mistake = contradiction(Facts(machine))
        if mistake is not None:
            raise TextFileError(mistake)
    except TextFileError as error:
        raise MachineError(f"{path}: {error}") from None
    return machine


def _machine(file: MachineFile, poles: tuple[int, int, int], magnetics: Formula | FluxMap) -> Machine:
    stator, rotor, phases = poles
    return Machine(
        name=file.name,
        stator_poles=stator,
        rotor_poles=rotor,
        phases=phases,
        **file.winding.model_dump(),
        **file.mechanics.model_dump(),
        supply_voltage_V=file.converter.supply_voltage_V,
        magnetics=magnetics,
        circuit=circuit_of(file.coupling, file.eddy_current, file.spread, phases),
        converter=file.converter.model_dump(exclude={"supply_voltage_V"}),
        dc_link=None if file.dc_link is None else file.dc_link.model_dump(exclude_none=True),
        sensors=file.sensors.model_dump(),
        iron_loss=None if file.iron_loss is None else file.iron_loss.model_dump(),
        thermal=file.thermal.model_dump(exclude_none=True),
        drive=file.drive.model_dump(exclude_none=True, exclude={"parameters"}),
        drive_parameters=_parameters(file.drive.parameters),
    )


def poles_and_phases(poles: Poles) -> tuple[int, int, int]:
    """Stator poles, rotor poles and phases."""
    stator, rotor = poles.stator, poles.rotor
    keys = f"poles.stator, poles.rotor: {shown(stator)}/{shown(rotor)}"
    if any(type(number) is not int or number not in poles
           for number, poles in ((stator, STATOR_POLES), (rotor, ROTOR_POLES))):
        raise TextFileError(f"{keys}: must be whole numbers, from {STATOR_POLES.start} to {STATOR_POLES.stop - 1} and"
                            f" from {ROTOR_POLES.start} to {ROTOR_POLES.stop - 1}")
    phases = phases_of(stator, rotor)
    if phases < PHASES_MIN:
        raise TextFileError(f"{keys}: {phases} phase{'s' * (phases > 1)}, {stator} / gcd({stator}, {rotor}), which"
                            f" cannot start from every angle; must have {PHASES_MIN} to {PHASES_MAX}")
    if phases > PHASES_MAX:
        raise TextFileError(f"{keys}: {phases} phases, {stator} / gcd({stator}, {rotor}); must have {PHASES_MIN} to"
                            f" {PHASES_MAX}")
    return stator, rotor, phases


def phases_of(stator: int, rotor: int) -> int:
    """Phases of a machine: the stator poles at one angle of the rotor's pitch make a phase. The angles of all
    poles divide the pitch evenly, so that phases are a stroke apart whichever of the two has more poles."""
    return stator // math.gcd(stator, rotor)


def _check_chopper(link: DcLink) -> None:
    """All keys of the chopper or none."""
    chopper = {key: getattr(link, key) for key in DcLink.model_fields if key.startswith("chopper_")}
    missing = [key for key, value in chopper.items() if value is None]
    if missing and len(missing) < len(chopper):
        raise TextFileError(f"dc_link.{missing[0]}: missing")


def _parameters(table: dict[str, Any]) -> dict[str, float]:
    """[drive.parameters]: names, and for values whose unit is the same for every machine the ranges of the drive."""
    rows = {row.name: row for row in read_table()}
    for name, value in table.items():
        row = rows.get(name)
        if row is None:
            raise TextFileError(f"drive.parameters.{shown_key(name)}: unknown key; {close_names(name, rows)}; "
                                "all are in docs/reference/parameters.md")
        low, high = row.limits if row.unit in SAME_UNITS else (0.0, 1e6)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not low <= value <= high or (row.fraction_bits == 0 and value != int(value)):
            kind = "a whole number" if row.fraction_bits == 0 else "a number"
            raise TextFileError(f"drive.parameters.{name}: {shown(value)}: must be {kind} from {low:g} to {high:g}")
    return {name: float(value) for name, value in table.items()}


def _magnetics(path: Path, table: dict[str, Any], rotor_poles: int) -> Formula | FluxMap:
    keys_of_all = [name for model in MAGNETICS.values() for name in model.model_fields]
    for name in table if "form" not in table else ():  # the misspelt form, or a key of no form
        if name not in keys_of_all:
            raise TextFileError(f"magnetics.{shown_key(name)}: unknown key; {close_names(name, keys_of_all)}")
    form = table.get("form")
    if not isinstance(form, str) or form not in MAGNETICS:
        raise TextFileError(f"magnetics.form: {shown(form)}: must be one of {', '.join(FORMS)}")
    keys = validate(MAGNETICS[form], table, "magnetics")
    if isinstance(keys, MapMagnetics):
        return _flux_map(path.parent / keys.file, rotor_poles)
    return Formula(form, rotor_poles, keys.model_dump(exclude={"form"}))


def _flux_map(path: Path, rotor_poles: int) -> FluxMap:
    try:
        flux_map = load_flux_map(path, rotor_poles)
    except FluxMapError as error:
        raise MachineError(str(error)) from None
    # A wrong unit is a factor of 1000, which takes the inductances of many machines out of the range.
    for key, angle_rad in (("unaligned_inductance_H", flux_map.pitch_rad / 2.0), ("aligned_inductance_H", 0.0)):
        inductance_H, (low, high) = float(flux_map.derivative(angle_rad, 0.0, 0, 2)), INDUCTANCES[key]
        if not low <= inductance_H <= high:
            raise MachineError(f"{path}: {key} of the map: {inductance_H:.3g}: must be a number from {low:g} to"
                               f" {high:g}; are the columns in the units of the header?")
    return flux_map
