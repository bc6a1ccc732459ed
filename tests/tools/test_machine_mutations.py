"""Mutated machine files and flux-linkage maps: rejected by one line that names the file and the key or the row, never
by a traceback, and never built. A mutation that is still valid is checked to be a machine.
"""

from __future__ import annotations

import dataclasses
import math
import os
import random
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from salient.machine.cache import FOLDER, content_key
from salient.machine.drive_data import derive
from salient.machine.file import Machine, MachineError, load_machine, machine_path
from salient.machine.magnetics import Formula
from salient.machine.parameter_table import read_table
from salient.paths import BUILD, EXAMPLE_MACHINES

SEED = 20
LINE_MAX = 600  # characters of a rejection without the path

NAME = "mutant"
POLES = {"stator": "6", "rotor": "4"}
# Every table and key that a machine file may have.
GOOD_TABLES = {
    "poles": POLES,
    "winding": {"resistance_ohm": "0.05"},
    "mechanics": {"inertia_kg_m2": "0.02", "friction_Nm_s": "0.02"},
    "magnetics": {
        "form": '"saturating"',
        "unaligned_inductance_H": "0.67e-3",
        "aligned_inductance_H": "23.6e-3",
        "saturated_inductance_H": "0.15e-3",
        "flux_linkage_max_Wb": "0.486",
        "current_at_flux_linkage_max_A": "450.0",
    },
    "converter": {
        "supply_voltage_V": "240.0",
        "switch_drop_V": "1.0",
        "switch_resistance_ohm": "0.01",
        "diode_drop_V": "0.9",
        "diode_resistance_ohm": "0.005",
        "minimum_pulse_ns": "500.0",
    },
    "dc_link": {
        "capacitance_F": "2e-3",
        "source_resistance_ohm": "0.1",
        "chopper_resistance_ohm": "20.0",
        "chopper_on_V": "280.0",
        "chopper_off_V": "270.0",
    },
    "sensors": {
        "current_gain": "1.01",
        "current_offset_A": "0.1",
        "current_noise_A": "0.02",
        "current_limit_A": "80.0",
        "current_delay_ns": "1000.0",
        "encoder_eccentricity_deg": "0.1",
    },
    "iron_loss": {
        "turns_area_m2": "0.5",
        "mass_kg": "6.0",
        "steinmetz_k": "0.003",
        "steinmetz_alpha": "1.4",
        "steinmetz_beta": "1.8",
    },
    "drive": {
        "supply_min_V": "200.0",
        "supply_max_V": "260.0",
        "current_rated_A": "40.0",
        "current_peak_A": "50.0",
        "torque_rated_Nm": "14.0",
        "torque_peak_Nm": "18.0",
        "speed_base_rpm": "1400.0",
        "speed_max_rpm": "3500.0",
        "thermal_time_constant_s": "90.0",
        "control_rate_hz": "50000",
        "encoder_bits": "14",
        "encoder_edges": "true",
        "adc_bits": "13",
        "adc_current_A": "80.0",
        "adc_voltage_V": "512.0",
    },
    "drive.parameters": {
        "speed_kp": "5.0",
        "current_trip_A": "70.0",
        "smc_k": "1200.0",
        "pulses_per_period": "1",
    },
}
MAY_BE_LEFT_OUT = {(table, key) for table in ("converter", "sensors", "drive", "drive.parameters")
                   for key in GOOD_TABLES[table]}
MAY_BE_LEFT_OUT -= {("converter", "supply_voltage_V")}


def toml(tables: dict[str, dict[str, str]], name: str = f'"{NAME}"') -> str:
    lines = [f"name = {name}"]
    for table, keys in tables.items():
        lines += ["", f"[{table}]", *(f"{key} = {value}" for key, value in keys.items())]
    return "\n".join(lines) + "\n"


GOOD = toml(GOOD_TABLES)
MAP_MACHINE = toml({**GOOD_TABLES, "magnetics": {"form": '"map"', "file": f'"{NAME}.csv"'}})

FORMULA = Formula("saturating", 4, {key: float(value) for key, value in GOOD_TABLES["magnetics"].items()
                                    if key != "form"})  # fmt: skip
ANGLES_DEG = np.linspace(0.0, 45.0, 10)
CURRENTS_A = np.linspace(8.0, 80.0, 10)
HEADER = "angle_deg,current_A,flux_linkage_Wb"
ROWS = [
    f"{angle:g},{current:g},{float(FORMULA.flux_linkage_Wb(math.radians(angle), current)):.6g}"
    for angle in ANGLES_DEG
    for current in CURRENTS_A
]


def csv(rows: list[str], header: str = HEADER) -> str:
    return "\n".join([header, *rows]) + "\n"


GOOD_MAP = csv(ROWS)


# --- The checks ---


def write(folder: Path, machine: str | bytes, flux_map: str | bytes | None = None) -> Path:
    path = folder / f"{NAME}.toml"
    path.write_bytes(machine.encode() if isinstance(machine, str) else machine)
    if flux_map is not None:
        (folder / f"{NAME}.csv").write_bytes(flux_map.encode() if isinstance(flux_map, str) else flux_map)
    return path


def rejection(path: Path) -> str | None:
    """The error of load_machine without the path; None when it accepts the file. Anything but a MachineError of one
    line that begins with the file at fault fails."""
    try:
        machine = load_machine(path)
    except MachineError as error:
        text = str(error)
    else:
        assert_is_a_machine(machine)
        return None
    at_fault = re.match(rf"({re.escape(str(path))}|{re.escape(str(path.parent))}/.*\.csv): ", text)
    assert at_fault, text
    text = text[at_fault.end() :]
    assert text and text.isprintable() and len(text) < LINE_MAX, text
    return text


def assert_is_a_machine(machine: Machine) -> None:
    """Finite numbers of the right sign, and magnetics of a reluctance machine."""
    assert machine.name.isidentifier()
    assert machine.phases == machine.stator_poles // math.gcd(machine.stator_poles, machine.rotor_poles)
    assert 3 <= machine.phases <= 6
    numbers = dataclasses.asdict(dataclasses.replace(machine, magnetics=None))
    for table in ("converter", "dc_link", "sensors", "iron_loss"):
        numbers |= {f"{table}.{key}": value for key, value in (numbers.pop(table) or {}).items()}
    for key, value in numbers.items():
        if isinstance(value, float):
            assert math.isfinite(value) and (value >= 0.0 or key == "sensors.current_offset_A"), (key, value)
    assert machine.resistance_ohm > 0.0 and machine.inertia_kg_m2 > 0.0 and machine.supply_voltage_V > 0.0
    current_A = np.linspace(1.0, 80.0, 30)
    angle_rad = np.linspace(0.0, machine.pitch_rad / 2.0, 40)[:, None]
    flux_Wb = machine.magnetics.flux_linkage_Wb(angle_rad, current_A)
    assert np.all(np.isfinite(flux_Wb)) and np.all(flux_Wb > 0.0)
    assert np.all(np.diff(flux_Wb, axis=1) > 0.0), "rises with the current"
    assert np.all(flux_Wb[0] > flux_Wb[-1]), "more aligned than unaligned"
    between_rad = machine.pitch_rad * 0.75
    assert np.all(machine.magnetics.torque_Nm(between_rad, current_A) > 0.0), "motoring torque towards aligned"


# --- Machine files ---

TOO_LONG = "a whole number of 5000 digits"  # Python reads at most 4300 and raises another error
WRONG_VALUES = {
    "text": '"0.05"',
    "empty text": '""',
    "truth": "true",
    "array": "[0.05]",
    "table": "{ value = 0.05 }",
    "date": "2024-02-29",
    "nan": "nan",
    "infinite": "inf",
    "minus infinite": "-inf",
    "negative": "-1e3",
    "huge": "1e30",
    "beyond a double": "1e999",
    "a whole number of 400 digits": "9" * 400,
    TOO_LONG: "9" * 5000,
    "a hexadecimal of 5000 digits": "0x" + "f" * 5000,
    "a long text": '"' + "x" * 5000 + '"',
    "a text of two lines": '"a\\nb"',
}
ZERO_ALLOWED = {("mechanics", "friction_Nm_s"), ("sensors", "current_gain")} | MAY_BE_LEFT_OUT
ZERO_ALLOWED -= {("sensors", "current_limit_A"), ("sensors", "current_gain")}
ZERO_ALLOWED -= {("drive", key) for key in GOOD_TABLES["drive"] if key != "encoder_bits"}
ZERO_ALLOWED -= {("drive.parameters", "current_trip_A"), ("drive.parameters", "pulses_per_period")}

BEYOND_THE_CIRCUIT = {
    "coupling.neighbours": ("1.5", "-0.3", "nan", "[0.1, 0.1]", "[0.1, 0.1, true]", '"0.1"'),
    "eddy_current.conductance_S": ("1e-9", "0.15", "0.3", "-1e-3", "[1e-3]"),
    "spread.flux_linkage": ("[0.3, 0, 0]", "[0, 0]", "false"),
    "spread.angle_deg": ("[0, 0, -2.1]", "inf"),
}
"""Values that no magnetic circuit of three phases has, by the key that the rejection names."""

Case = tuple[str, str, str]
"""(what was done, machine file, what the rejection must name)."""


def with_value(table: str, key: str, value: str) -> str:
    return toml({**GOOD_TABLES, table: {**GOOD_TABLES[table], key: value}})


def key_cases() -> list[Case]:
    cases: list[Case] = []
    for table, keys in GOOD_TABLES.items():
        for key in keys:
            name = table if table == "poles" else f"{table}.{key}"
            others = {other: value for other, value in keys.items() if other != key}
            if (table, key) not in MAY_BE_LEFT_OUT:
                cases.append((f"{name} removed", toml({**GOOD_TABLES, table: others}), f"{table}.{key}"))
            renamed = toml({**GOOD_TABLES, table: {f"{key}s" if old == key else old: v for old, v in keys.items()}})
            cases.append((f"{name} renamed", renamed, f"{table}.{key}"))
            line = f"{key} = {keys[key]}\n"
            cases.append((f"{name} twice", GOOD.replace(line, line + line, 1), "line "))
            wrong = {what: value for what, value in WRONG_VALUES.items() if value != keys[key]}
            wrong |= ({} if (table, key) in ZERO_ALLOWED else {"zero": "0"})
            cases += [(f"{name} {what}", with_value(table, key, value), "not TOML" if what == TOO_LONG else name)
                      for what, value in wrong.items()]  # fmt: skip
    return cases


def table_cases() -> list[Case]:
    cases: list[Case] = []
    for table, content in GOOD_TABLES.items():
        without = {name: keys for name, keys in GOOD_TABLES.items() if name != table}
        if table not in ("dc_link", "sensors", "iron_loss", "drive", "drive.parameters"):
            cases.append((f"[{table}] removed", toml(without), table))
        cases += [
            (f"[{table}] renamed", toml({**without, f"{table}s": content}), f"{table}s"),
            (f"[{table}] twice", GOOD + f"[{table}]\n", "line "),
            (f"[{table}] in brackets of an array", GOOD.replace(f"[{table}]", f"[[{table}]]"), table),
            (f"[{table}] a number", f"{table} = 1\n" + toml(without), "line " if table.startswith("drive") else table),
            (f"[{table}] open", GOOD.replace(f"[{table}]", f"[{table}"), "line "),
        ]
    return cases


def other_cases() -> list[Case]:
    return [
        ("empty", "", "name"),
        ("only blanks", " \n\t\n", "name"),
        ("name removed", toml(GOOD_TABLES).split("\n", 1)[1], "name"),
        *((f"name {value[:20]}", toml(GOOD_TABLES, value), "name")
          for value in ("3", "true", '""', '"a b"', '"../x"', '"1a"', '"m\\u00fcller"', '"a\\nb"', f'"{"-" * 5000}"')),
        *((f"{key} = {value}", GOOD + f"[{key.partition('.')[0]}]\n{key.partition('.')[2]} = {value}\n", key)
          for key, values in BEYOND_THE_CIRCUIT.items() for value in values),
        ("a key of two lines", GOOD.replace("resistance_ohm", '"a\\nb"', 1), "winding"),
        ("a key of 5000 letters", GOOD.replace("resistance_ohm", "x" * 5000, 1), "winding"),
        ("a table of two lines", GOOD + '["a\\nb"]\n', "unknown key"),
        ("arrays in arrays", "a = " + "[" * 20_000, "not TOML"),
        ("tables in tables", "[" + "a." * 20_000 + "a]\n", "unknown key"),
        ("poles of one phase", with_value("poles", "rotor", "6"), "poles.stator, poles.rotor: 6/6: 1 phase,"),
        ("poles of two phases", with_value("poles", "rotor", "3"), "poles.stator, poles.rotor: 6/3: 2 phases,"),
        ("poles of seven phases", with_value("poles", "stator", "14"), "poles.stator, poles.rotor: 14/4: 7 phases,"),
        ("poles of a rotor too fine", with_value("poles", "rotor", "41"), "poles.stator, poles.rotor: 6/41: must"),
        ("poles the other way round", toml({**GOOD_TABLES, "poles": {"stator": "4", "rotor": "6"}}), "poles"),
        ("poles with a point", with_value("poles", "stator", "6.0"), "poles"),
        ("inductances the wrong way round", with_value("magnetics", "aligned_inductance_H", "0.5e-3"),
         "magnetics.aligned_inductance_H"),
        ("saturated above unaligned", with_value("magnetics", "saturated_inductance_H", "0.7e-3"),
         "magnetics.saturated_inductance_H"),
        ("no flux left for the knee", with_value("magnetics", "flux_linkage_max_Wb", "0.05"),
         "magnetics.flux_linkage_max_Wb"),
        ("millihenries as henries", with_value("magnetics", "aligned_inductance_H", "23.6"),
         "magnetics.aligned_inductance_H"),
        ("milliohms as ohms", with_value("winding", "resistance_ohm", "500.0"), "winding.resistance_ohm"),
        ("kilovolts as volts", with_value("converter", "supply_voltage_V", "0.24"), "converter.supply_voltage_V"),
        ("microfarads as farads", with_value("dc_link", "capacitance_F", "2000"), "dc_link.capacitance_F"),
        ("chopper below the supply", with_value("dc_link", "chopper_off_V", "230"), "dc_link.chopper_off_V"),
        ("chopper the wrong way round", with_value("dc_link", "chopper_on_V", "265"), "dc_link.chopper_off_V"),
        ("keys of another form", with_value("magnetics", "flat_deg", "1.0"), "magnetics.flat_deg"),
        ("another form with these keys", with_value("magnetics", "form", '"linear_cosine"'), "magnetics.saturated"),
        ("the form misspelt", GOOD.replace("\nform = ", "\nfrom = "), "magnetics.from: unknown key; the nearest of "),
        ("a map without its file", toml({**GOOD_TABLES, "magnetics": {"form": '"map"'}}), "magnetics.file"),
        ("a decimal comma", with_value("winding", "resistance_ohm", "0,05"), "line "),
        ("a NUL byte", GOOD.replace("0.05", "0.05\0"), "line "),
    ]  # fmt: skip


MACHINE_CASES = key_cases() + table_cases() + other_cases()


def test_unmutated_files_are_valid_machines(tmp_path: Path) -> None:
    assert rejection(write(tmp_path, GOOD)) is None
    assert rejection(write(tmp_path, MAP_MACHINE, GOOD_MAP)) is None


@pytest.mark.in_turns
def test_every_mutation_of_a_key_or_table_is_rejected_by_one_line_that_names_it(tmp_path: Path) -> None:
    assert len(MACHINE_CASES) > 600
    messages = {what: (rejection(write(tmp_path, text)), named) for what, text, named in MACHINE_CASES}
    wrong = {what: text for what, (text, named) in messages.items() if text is None or named not in text}
    assert not wrong, wrong


@pytest.mark.parametrize(("aligned_H", "flux_Wb", "current_A", "most"), [
    ("110e-3", "3.0", "25.0", "2.75 Wb"),
    ("110e-3", "75.0", "25.0", "2.75 Wb"),
    ("23.6e-3", "10.7", "450.0", "10.62 Wb"),
    ("23.6e-3", "0.486", "20.0", "0.472 Wb"),
])
def test_flux_linkage_above_what_the_inductance_gives_names_both_keys(tmp_path, aligned_H, flux_Wb, current_A, most):
    keys = {"aligned_inductance_H": aligned_H, "flux_linkage_max_Wb": flux_Wb,
            "current_at_flux_linkage_max_A": current_A}
    text = rejection(write(tmp_path, toml({**GOOD_TABLES, "magnetics": {**GOOD_TABLES["magnetics"], **keys}})))
    assert text == (
        f"magnetics.flux_linkage_max_Wb: {float(flux_Wb):g} Wb: must not be above {most}, which "
        f"magnetics.aligned_inductance_H, {float(aligned_H):g} H gives without saturation at "
        f"magnetics.current_at_flux_linkage_max_A, {float(current_A):g} A")


def test_flux_linkage_without_saturation_is_a_machine(tmp_path):
    keys = {"flux_linkage_max_Wb": "0.472", "current_at_flux_linkage_max_A": "20.0"}  # 23.6 mH times 20 A
    assert rejection(write(tmp_path, toml({**GOOD_TABLES, "drive": {}, "drive.parameters": {},
                                           "magnetics": {**GOOD_TABLES["magnetics"], **keys}}))) is None


@pytest.mark.parametrize("factor", [1.1, 50.0])
def test_map_point_above_what_lower_currents_give_names_both_lines(tmp_path, factor):
    """The flux linkage at the last current and the aligned position, as a multiple of that without saturation."""
    rows = list(ROWS)
    first_Wb = float(ROWS[0].split(",")[2])
    most_Wb = first_Wb / 8.0 * 80.0
    last_Wb = f"{factor * most_Wb:.6g}"
    rows[9] = f"0,80,{last_Wb}"
    text = rejection(write(tmp_path, MAP_MACHINE, csv(rows)))
    assert text == (
        f"line 11: at 0 deg the flux linkage is {float(last_Wb):.4g} Wb at 80 A; must not be above {most_Wb:.4g} Wb, "
        f"which the inductance of line 2, {first_Wb / 8.0:.4g} H at 8 A, gives without saturation, but for 5% of the "
        "map's largest")


@pytest.mark.parametrize("rise", [0.9, 0.95, 1.0])
def test_map_with_low_permeability_in_weak_fields_is_a_machine(tmp_path, rise):
    """At the lowest current the inductance of iron is lower than where its permeability is highest."""
    rows = [row.split(",") for row in ROWS]
    for row in rows[::len(CURRENTS_A)]:
        row[2] = f"{rise * float(row[2]):.6g}"
    assert rejection(write(tmp_path, MAP_MACHINE, csv([",".join(row) for row in rows]))) is None


def drive(**keys: str) -> str:
    """A machine file whose [drive] has nothing but these keys; one with a point in its name is of [drive.parameters]
    ("parameters.smc_k")."""
    tables: dict[str, dict[str, str]] = {"drive": {}, "drive.parameters": {}}
    for key, value in keys.items():
        *_, name = key.split(".")
        tables["drive.parameters" if "." in key else "drive"][name] = value
    return toml({**GOOD_TABLES, **tables})


CONTRADICTIONS: list[tuple[dict[str, str], str, str]] = [
    ({"parameters.current_limit_A": "60", "parameters.current_trip_A": "50"}, "drive.parameters.current_limit_A: 60",
     "drive.parameters.current_trip_A, 50"),
    ({"parameters.current_trip_A": "40"}, "current_limit_A (from magnetics.flux",
     "drive.parameters.current_trip_A, 40 A"),
    ({"current_peak_A": "90", "adc_current_A": "80"}, "drive.current_peak_A: 90", "drive.adc_current_A, 80"),
    ({"adc_current_A": "70", "parameters.current_trip_A": "70"}, "drive.parameters.current_trip_A: 70",
     "drive.adc_current_A, 70"),
    ({"supply_min_V": "250"}, "drive.supply_min_V: 250", "converter.supply_voltage_V, 240"),
    ({"supply_max_V": "230"}, "converter.supply_voltage_V: 240", "drive.supply_max_V, 230"),
    ({"parameters.over_voltage_V": "200"}, "supply_max_V (from converter.supply_voltage_V, 240 V): 240 V",
     "drive.parameters.over_voltage_V"),
    ({"parameters.over_voltage_V": "275"}, "dc_link.chopper_on_V: 280", "drive.parameters.over_voltage_V, 275"),
    ({"parameters.under_voltage_V": "300"}, "drive.parameters.under_voltage_V: 300",
     "supply_min_V (from converter.supply_voltage_V, 240 V)"),
    ({"adc_voltage_V": "256"}, "over_voltage_V (from converter.supply_voltage_V, 240 V): 300 V",
     "drive.adc_voltage_V, 256"),
    ({"current_rated_A": "60", "current_peak_A": "50"}, "drive.current_rated_A: 60", "drive.current_peak_A, 50"),
    ({"torque_rated_Nm": "20", "torque_peak_Nm": "19"}, "drive.torque_rated_Nm: 20", "drive.torque_peak_Nm, 19"),
    ({"torque_peak_Nm": "40", "current_peak_A": "52"}, "drive.torque_peak_Nm: 40", "drive.current_peak_A, 52"),
    ({"speed_base_rpm": "3000", "speed_max_rpm": "2000"}, "drive.speed_base_rpm: 3000", "drive.speed_max_rpm, 2000"),
    ({"speed_max_rpm": "30000"}, "drive.speed_max_rpm: 30000 r/min: must not be above 2.4e+04 r/min, for 25",
     "control_rate_hz (default), 40000 Hz"),
    ({"speed_max_rpm": "20000", "control_rate_hz": "20000"}, "drive.speed_max_rpm: 20000",
     "drive.control_rate_hz, 20000"),
    ({"speed_max_rpm": "3000", "parameters.over_speed_rpm": "2900"}, "drive.speed_max_rpm: 3000",
     "drive.parameters.over_speed_rpm, 2900"),
    ({"parameters.torque_band_inner_Nm": "2", "parameters.torque_band_outer_Nm": "1"},
     "drive.parameters.torque_band_inner_Nm: 2", "drive.parameters.torque_band_outer_Nm, 1"),
    ({"control_rate_hz": "30000"}, "drive.control_rate_hz: 30000", "must be 20000, 40000"),
    ({"encoder_bits": "7"}, "drive.encoder_bits: 7", "must be 0 or 8 to 24"),
    ({"parameters.smc_K": "7"}, "drive.parameters.smc_K: unknown key", " are smc_k, "),
    ({"parameters.pulses_per_period": "1.5"}, "drive.parameters.pulses_per_period: 1.5", "a whole number from 1 to 2"),
]


@pytest.mark.parametrize(("keys", "first", "second"), CONTRADICTIONS,
                         ids=[" ".join(keys) for keys, _, _ in CONTRADICTIONS])
def test_contradictory_data_of_the_drive_are_refused_by_a_line_that_names_both(
        tmp_path: Path, keys: dict[str, str], first: str, second: str) -> None:
    text = rejection(write(tmp_path, drive(**keys)))
    assert text is not None and text.startswith(first) and second in text, text


@pytest.mark.in_turns
@pytest.mark.parametrize("map_file", [False, True], ids=["formula", "map"])
def test_random_data_of_the_drive_are_refused_by_a_line_that_names_one_or_give_finite_values(
        tmp_path: Path, map_file: bool) -> None:
    chance = random.Random(SEED)
    names = [*GOOD_TABLES["drive"], *(f"parameters.{row.name}" for row in read_table())]
    refused, accepted = 0, 0
    for _ in range(60 if map_file else 400):
        keys = {}
        for name in chance.sample(names, chance.randrange(1, 5)):
            good = GOOD_TABLES["drive"].get(name)
            near = f"{float(good) * chance.uniform(0.5, 2.0):.6g}" if good and good != "true" else "1"
            keys[name] = chance.choice([near, near, f"{10.0 ** chance.uniform(-4.0, 5.0):.6g}",
                                        str(chance.randrange(-2, 20)), chance.choice(list(WRONG_VALUES.values()))])
        text = drive(**keys)
        if map_file:
            text = text.replace(toml({"magnetics": GOOD_TABLES["magnetics"]}).split("\n", 2)[2],
                                f'[magnetics]\nform = "map"\nfile = "{NAME}.csv"\n')
        path = write(tmp_path, text, GOOD_MAP)
        message = rejection(path)
        if message is None:
            accepted += 1
            data = derive(load_machine(path))
            assert all(math.isfinite(each.value) for each in data.derivations), keys
            assert data.parameters["current_limit_A"] < data.current_trip_A < data.adc_current_A, keys
        else:
            refused += 1
            stated = [f"drive.{name}" for name in keys]
            assert any(name in message for name in stated) or "line " in message or "not TOML" in message, message
    assert refused > 20 and accepted > 5


def test_truncated_machine_file_is_rejected_or_still_valid(tmp_path: Path) -> None:
    messages = [rejection(write(tmp_path, GOOD.encode()[:end])) for end in range(len(GOOD))]
    # After the last required key, [converter] supply_voltage_V, only a cut number can stay valid.
    needed = GOOD.index("switch_drop_V")
    assert all(messages[:needed - 5])
    assert sum(text is not None for text in messages) > needed


@pytest.mark.in_turns
@pytest.mark.parametrize("good", [GOOD, MAP_MACHINE], ids=["formula", "map"])
def test_machine_file_with_flipped_bytes_is_rejected_or_still_valid(tmp_path: Path, good: str) -> None:
    chance = random.Random(SEED)
    rejected = 0
    for _ in range(600):
        data = bytearray(good.encode())
        data[chance.randrange(len(data))] = chance.choice([0, 0xFF, 0x80, *range(9, 127)])
        rejected += rejection(write(tmp_path, bytes(data), GOOD_MAP)) is not None
    assert 300 < rejected < 600


def test_unreadable_file_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / f"{NAME}.toml"
    assert "no such file" in rejection(path)
    path.mkdir()
    assert "not a file" in rejection(path)
    path.rmdir()
    os.mkfifo(path)
    assert "not a file" in rejection(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "not a file" in rejection(path)
    path.unlink()
    path.symlink_to(path)
    assert "cannot be read" in rejection(path)
    path.unlink()
    with path.open("wb") as file:
        file.truncate(10_000_000_000)  # takes no space
    assert "larger than" in rejection(path)


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLE_MACHINES.glob("*.toml")))
def test_machines_of_the_examples_have_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert machine_path(name) == EXAMPLE_MACHINES / f"{name}.toml"
    assert load_machine(machine_path(name)).name == name
    with pytest.raises(MachineError, match=rf"no bundled machine of that name; the nearest of 10 are .*\b{name}\b"):
        machine_path(f"{name}_")


@pytest.mark.parametrize("name", ["", ".", "/", "x" * 5000, "a\nb", "a\0b", "pipe", "itself"])
def test_unknown_machine_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("itself").symlink_to("itself")
    with pytest.raises(MachineError) as caught:
        machine_path(name)
    line = str(caught.value)
    assert line.isprintable() and len(line) < LINE_MAX
    assert "no such file" in line and "; the nearest of 10 are " in line


# --- Flux-linkage maps ---


def row(angle: int, current: int) -> int:
    """Index of a row in ROWS."""
    return angle * len(CURRENTS_A) + current


def changed(at: int, text: str) -> list[str]:
    return [*ROWS[:at], text, *ROWS[at + 1 :]]


def scaled(column: int, factor: float) -> list[str]:
    cells = [line.split(",") for line in ROWS]
    for line in cells:
        line[column] = repr(float(line[column]) * factor)
    return [",".join(line) for line in cells]


def row_cases(chance: random.Random) -> list[tuple[str, str, str]]:
    """(what was done, map, what the rejection must name): kinds of errors, each in randomly selected rows."""
    cases = []
    for at in sorted(chance.sample(range(1, len(ROWS) - 1), 12)):
        angle, current, flux = ROWS[at].split(",")
        line = f"line {at + 2}:"
        texts = {
            "column missing": f"{angle},{current}",
            "column more": f"{angle},{current},{flux},1",
            "only the angle": angle,
            "semicolons": f"{angle};{current};{flux}",
            "decimal comma": f"{angle},{current},{flux.replace('.', ',')}",
            "empty cell": f"{angle},,{flux}",
            "text": f"{angle},{current},much",
            "unit after the number": f"{angle},{current},{flux} Wb",
            "nan": f"{angle},{current},nan",
            "infinite": f"{angle},inf,{flux}",
            "negative flux linkage": f"{angle},{current},-{flux}",
            "negative current": f"{angle},-{current},{flux}",
            "negative angle": f"-1,{current},{flux}",
            "no flux linkage": f"{angle},{current},0",
            "beyond a double": f"{angle},{current},1e999",
            "formula": f"{angle},{current},=0.1+0.1",
            "digits apart": f"{angle},{current},0.1_2",
            "NUL byte": f"{angle},{current},{flux}\0",
            "quoted": f'"{angle}","{current}","{flux}"',
        }
        cases += [(f"row {at}: {what}", csv(changed(at, text)), line) for what, text in texts.items()]
        cases.append((f"row {at} twice", csv([*ROWS[: at + 1], *ROWS[at:]]), "line "))
        swapped = [*ROWS[: at - 1], ROWS[at], ROWS[at - 1], *ROWS[at + 1 :]]
        cases.append((f"row {at} before the one above", csv(swapped), "line "))
    return cases


def file_cases() -> list[tuple[str, str | bytes, str]]:
    blocks = [ROWS[start : start + len(CURRENTS_A)] for start in range(0, len(ROWS), len(CURRENTS_A))]

    def of(order: list[int]) -> str:
        return csv([line for block in order for line in blocks[block]])

    every = list(range(len(blocks)))
    flux = [line.split(",")[2] for line in ROWS]
    return [
        ("empty", "", "no header"),
        ("only a header", csv([]), "angles"),
        ("only comments", "# nothing\n# at all\n", "no header"),
        ("no header", "\n".join(ROWS), "line 1:"),
        *((f"header {header}", csv(ROWS, header), "line 1:") for header in (
            "angle,current,flux", "angle_deg,current_A", "current_A,angle_deg,flux_linkage_Wb", HEADER.upper(),
            "angle_deg;current_A;flux_linkage_Wb", "angle_deg,current_mA,flux_linkage_Wb",
            "angle_turns,current_A,flux_linkage_Wb", HEADER + ",torque_Nm", HEADER.replace(",", '","'))),
        ("header twice", csv([HEADER, *ROWS]), "line 2:"),
        ("header in the middle", csv([*ROWS[:30], HEADER, *ROWS[30:]]), "line 32:"),
        ("angles falling", of(every[::-1]), "line "),
        ("two angles swapped", of([0, 1, 3, 2, *every[4:]]), "line "),
        ("an angle twice", of([0, 1, 1, *every[2:]]), "line "),
        ("first angle missing", of(every[1:]), "line 2:"),
        ("last angle missing", of(every[:-1]), "line "),
        ("five angles", of([0, 2, 4, 6, 9]), "angles"),
        ("five currents", csv(ROWS[1::2]), "line "),
        ("an angle without its upper half", csv([*ROWS[:35], *ROWS[40:]]), "line "),
        ("current by current", csv(sorted(ROWS, key=lambda line: float(line.split(",")[1]))), "line "),
        ("flux linkage without saliency", csv([line.rpartition(",")[0] + "," + flux[at % 10]
                                               for at, line in enumerate(ROWS)]), "line "),
        ("aligned and unaligned swapped", csv([line.rpartition(",")[0] + "," + flux[row(9 - at // 10, at % 10)]
                                               for at, line in enumerate(ROWS)]), "line "),
        ("milliwebers under webers", csv(scaled(2, 1e3)), "line "),
        ("kiloamperes under amperes", csv(scaled(1, 1e-3)), "aligned_inductance_H"),
        ("microwebers under milliwebers", csv(scaled(2, 1e6), HEADER.replace("Wb", "mWb")), "line "),
        ("webers under milliwebers", csv(ROWS, HEADER.replace("Wb", "mWb")), "must be at least 1e-06 H"),
        ("degrees under radians", csv(ROWS, HEADER.replace("deg", "rad")), "line "),
        ("radians under degrees", csv(scaled(0, math.pi / 180)), "line "),
        ("electrical degrees", csv(scaled(0, 4.0)), "line "),
        ("milliamperes under amperes", csv(scaled(1, 1e3)), "line "),
        ("invalid UTF-8", GOOD_MAP.encode()[:200] + b"\xff\xfe" + GOOD_MAP.encode()[200:], "not UTF-8"),
        ("UTF-16", GOOD_MAP.encode("utf-16"), "not UTF-8"),
        ("zeros", b"\0" * 5000, "line 1:"),
        ("noise", random.Random(SEED).randbytes(5000), "not UTF-8"),
        ("a spreadsheet", b"PK\x03\x04" + b"[Content_Types].xml" * 20, "line 1:"),
        ("one line of a megabyte", "x," * 500_000, "line 1:"),
    ]  # fmt: skip


def test_every_mutation_of_a_map_is_rejected_by_one_line_that_names_its_row(tmp_path: Path) -> None:
    cases = row_cases(random.Random(SEED)) + file_cases()
    assert len(cases) > 250
    messages = {what: (rejection(write(tmp_path, MAP_MACHINE, text)), named) for what, text, named in cases}
    wrong = {what: text for what, (text, named) in messages.items() if text is None or named not in text}
    assert not wrong, wrong


def test_truncated_map_is_rejected_or_still_valid(tmp_path: Path) -> None:
    data = GOOD_MAP.encode()
    last_angle = GOOD_MAP.rindex("\n45,8,")
    for end in range(0, last_angle, 13):
        assert rejection(write(tmp_path, MAP_MACHINE, data[:end])) is not None, end
    messages = [rejection(write(tmp_path, MAP_MACHINE, data[:end])) for end in range(last_angle, len(data))]
    assert sum(text is not None for text in messages) > 0.5 * len(messages)


def test_map_with_flipped_bytes_is_rejected_or_still_valid(tmp_path: Path) -> None:
    chance = random.Random(SEED)
    rejected = 0
    for _ in range(300):
        data = bytearray(GOOD_MAP.encode())
        data[chance.randrange(len(data))] = chance.choice([0, 0xFF, 0x80, *range(9, 127)])
        rejected += rejection(write(tmp_path, MAP_MACHINE, bytes(data))) is not None
    assert 150 < rejected < 300


def test_map_without_random_rows_is_rejected_or_still_valid(tmp_path: Path) -> None:
    chance = random.Random(SEED)
    messages = []
    for _ in range(60):
        left = sorted(chance.sample(range(len(ROWS)), chance.randrange(60, len(ROWS))))
        messages.append(rejection(write(tmp_path, MAP_MACHINE, csv([ROWS[at] for at in left]))))
    assert 5 < sum(text is not None for text in messages) < 60


@pytest.mark.parametrize(
    "file",
    ["nosuch.csv", "../nosuch.csv", "/nosuch/x.csv", "folder.csv", "pipe.csv", "zeros.csv", "itself.csv", "sparse.csv",
     "mutant.toml", "", "x.txt", "x" * 300 + ".csv", "a\\u0000b.csv", "a\\nb.csv", "3"],
)  # fmt: skip
def test_unreadable_map_is_rejected(tmp_path: Path, file: str) -> None:
    (tmp_path / "folder.csv").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "zeros.csv").symlink_to("/dev/zero")
    (tmp_path / "itself.csv").symlink_to(tmp_path / "itself.csv")
    with (tmp_path / "sparse.csv").open("wb") as sparse:
        sparse.truncate(10_000_000_000)
    text = toml({**GOOD_TABLES, "magnetics": {"form": '"map"', "file": f'"{file}"'}})
    with pytest.raises(MachineError) as caught:
        load_machine(write(tmp_path, text))
    line = str(caught.value)
    named = tmp_path / file if file.endswith(".csv") and file.isprintable() and "\\" not in file else "magnetics.file"
    assert str(named) in line and line.isprintable(), line


# --- Through the commands ---

COMMAND_CASES: dict[str, tuple[str, str | None, str]] = {
    "key_renamed": (GOOD.replace("inertia_kg_m2", "inertia"), None, "mechanics.inertia"),
    "value_nan": (GOOD.replace("0.05", "nan", 1), None, "winding.resistance_ohm"),
    "nested": ("a = " + "[" * 20_000, None, "not TOML"),
    "flux_linkage_beyond_its_format": (
        toml({**GOOD_TABLES, "mechanics": {"inertia_kg_m2": "0.02", "friction_Nm_s": "0.001"},
              "iron_loss": {**GOOD_TABLES["iron_loss"], "turns_area_m2": "10"},
              "magnetics": {"form": '"linear_cosine"', "unaligned_inductance_H": "40e-3",
                                           "aligned_inductance_H": "0.6"}}), None, "must be below 16 Wb"),
    "file_cut": (GOOD[: GOOD.index("[converter]")], None, "converter: missing"),
    "file_binary": ("\0" * 100, None, "line 1"),
    "map_missing": (MAP_MACHINE, None, "no such file"),
    "map_row_text": (MAP_MACHINE, csv(changed(17, "5,64,much")), "line 19"),
    "map_other_unit": (MAP_MACHINE, csv(scaled(2, 1e3)), "Wb"),
    "map_cut": (MAP_MACHINE, csv(ROWS[:-10]), "line "),
}


def built() -> set[str]:
    return {path.name for path in (BUILD / "host" / "bin").iterdir()}


def still_runs(words: str) -> bool:
    """Another process has these texts in its command line."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.parent.name != str(os.getpid()) and words in path.read_bytes().decode(errors="replace"):
                return True
        except OSError:
            continue  # it has ended
    return False


@pytest.mark.in_turns
@pytest.mark.parametrize("case", COMMAND_CASES)
def test_commands_end_with_one_line_and_exit_code_2_and_build_nothing(
    salient: Callable, tmp_path: Path, case: str
) -> None:
    text, flux_map, named = COMMAND_CASES[case]
    write(tmp_path, text, flux_map)
    path = tmp_path / f"{case}.toml"
    (tmp_path / f"{NAME}.toml").rename(path)
    (tmp_path / "scenario.toml").write_text(
        f'machine = "{path}"\ncontrollers = ["paper"]\nduration_s = 0.01\n'
    )
    before = {entry.name for entry in tmp_path.iterdir()}
    command = (
        ["sim", "--machine", path, "--can", f"unix:{tmp_path}/bus"],
        ["run", tmp_path / "scenario.toml", "--out", tmp_path / "out"],
        ["demo", "--machine", path, "--out", tmp_path / "out"],
    )[list(COMMAND_CASES).index(case) % 3]
    result = salient(*command)
    assert (result.returncode, result.stdout) == (2, ""), result
    # The launcher says so when its look at the build takes seconds, as on a loaded machine.
    (line,) = (text for text in result.stderr.splitlines() if text != "salient: building build/host")
    assert line.startswith(f"salient: {tmp_path}/") and named in line, line
    assert not any(case in name for name in built())
    assert case not in (BUILD / "host" / "CMakeCache.txt").read_text()
    assert not any(case in note.read_text() for note in BUILD.glob("machine-*/machine_file"))
    assert not (FOLDER / f"{content_key(path)}.machine").exists()
    assert not still_runs(str(tmp_path))
    assert {entry.name for entry in tmp_path.iterdir()} <= before | {"out"}
