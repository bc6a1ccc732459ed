"""The units of the firmware's formats for a machine, and its CAN database in them."""

from __future__ import annotations

import math
import random
import re
from dataclasses import replace
from pathlib import Path

import pytest

from salient.bus.signals import drive_database
from salient.dbc import database_hash, drive_dbc_of_phases
from salient.generate import resolution
from salient.machine.file import Machine, MachineError, load_machine
from salient.machine.image import firmware_tables
from salient.machine.magnetics import Formula
from salient.machine.parameter_table import read_table
from salient.machine.scaling import Exponents, Scaling, database_of, drive_dbc, scaling_of
from salient.machine.sources import tables_source
from salient.paths import DRIVE_DBC, MACHINES, ROOT

OTHERS = ROOT / "tests" / "machines"
SEED = 14


def scaling_of_file(path: Path) -> Scaling:
    return scaling_of(path, load_machine(path))


def random_exponents(count: int) -> list[Exponents]:
    chance = random.Random(SEED)
    return [Exponents(chance.randint(-5, 6), chance.randint(-5, 2), chance.randint(-10, 6), chance.randint(0, 3))
            for _ in range(count)]


# --- rule -----------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("path", sorted(MACHINES.glob("*.toml")), ids=lambda path: path.stem)
def test_bundled_machines_are_in_si_units_with_the_database_and_defaults_of_the_firmware(path):
    scaling = scaling_of_file(path)
    assert scaling.exponents == Exponents()
    assert scaling.dbc() == drive_dbc_of_phases(DRIVE_DBC.read_text(), 4)
    of_machine = {"inertia_kg_m2", "friction_Nm_s", "resistance_ohm", "speed_kp", "speed_ki", "smc_k", "smc_delta",
                  "winding_current_A", "bp_error_scale_Nm"}
    if path.stem == "finite_element":  # poles overlap later than the paper's
        of_machine |= {"turn_on_angle_deg", "turn_off_angle_deg", "outgoing_off_angle_deg", "hand_over_angle_deg"}
    for row, raw in zip(read_table(), scaling.raw_parameters(), strict=True):
        assert raw == row.default or row.name in of_machine, row.name
    assert scaling.fraction_bits() == [row.fraction_bits for row in read_table()]


@pytest.mark.parametrize(("name", "exponents"), [
    ("smallest", Exponents(-6, -4, -8, 0)), ("largest", Exponents(5, 2, 6, 0)), ("fastest", Exponents(0, 0, -4, 3)),
])
def test_units_follow_the_machine(name, exponents):
    path = OTHERS / f"{name}.toml"
    scaling = scaling_of_file(path)
    assert scaling.exponents == exponents
    data = scaling.data
    for value, unit, full_scale, least in (
        (data.adc_current_A, "A", 80.0, 0.5), (data.adc_voltage_V, "V", 512.0, 0.25),
        (data.torque_peak_Nm, "N m", 40.0, 0.25), (data.over_speed_rpm, "r/min", 4800.0, 0.1),
    ):
        assert least < math.ldexp(value, -exponents.of_unit(unit)) / full_scale <= 1.0, unit


@pytest.mark.parametrize("name", ["smallest", "largest", "fastest"])
def test_no_derived_default_is_beyond_the_range_of_its_parameter(name):
    scaling = scaling_of_file(OTHERS / f"{name}.toml")
    for row, raw in zip(read_table(), scaling.raw_parameters(), strict=True):
        lsb = math.ldexp(1.0, -scaling.exponents.fraction_bits(row))
        assert raw * lsb == pytest.approx(scaling.data.parameters[row.name], rel=1e-6, abs=lsb / 2), row.name


@pytest.mark.parametrize(("old", "new", "text"), [
    ("inertia_kg_m2 = 4.0", "inertia_kg_m2 = 200.0",
     r"mechanics\.inertia_kg_m2: 200 kg m\^2: must be a number from 0\.0064 to 121\.6 kg m\^2, "
     r"for a machine of "),
    ("inertia_kg_m2 = 4.0", "inertia_kg_m2 = 0.001",
     r"mechanics\.inertia_kg_m2: 0\.001 kg m\^2: must be a number from 0\.006"),
    ("friction_Nm_s = 0.5", "friction_Nm_s = 200.0",
     r"mechanics\.friction_Nm_s: 200 N m s: must not be above 9\.877 N m s, "),
    ("torque_peak_Nm = 2000.0", "torque_peak_Nm = 2000.0\n[drive.parameters]\ntorque_max_Nm = 7000.0",
     r"drive\.parameters\.torque_max_Nm: 7000 N m: must be a number from 0 to 6400 N m, "),
    ("inertia_kg_m2 = 4.0", "inertia_kg_m2 = 200.0",
     r"mechanics\.inertia_kg_m2: 200 kg m\^2: .* for a machine of drive\.torque_peak_Nm, 2000 N m$"),
])
def test_machine_that_its_units_do_not_fit_is_refused_in_one_line(tmp_path, old, new, text):
    file = tmp_path / "refused.toml"
    file.write_text((OTHERS / "largest.toml").read_text().replace(old, new))
    with pytest.raises(MachineError, match=f"^{re.escape(str(file))}: {text}[^\n]*$"):
        scaling_of_file(file)


# --- similar machines -----------------------------------------------------------------------------------------------

_POWERS_OF_DRIVE = {"supply_min_V": "V", "supply_max_V": "V", "current_rated_A": "A", "current_peak_A": "A",
                    "torque_rated_Nm": "N m", "torque_peak_Nm": "N m", "adc_current_A": "A", "adc_voltage_V": "V"}


def similar(machine: Machine, a: int, v: int) -> Machine:
    """The machine with 2^a times the current and 2^v times the voltage and flux linkage, and so 2^(a + v) times the
    torque, at the same speeds."""
    exponents = Exponents(a, v, a + v, 0)

    def times(value: float, unit: str) -> float:
        return math.ldexp(value, exponents.of_unit(unit))

    assert isinstance(machine.magnetics, Formula)
    powers = {"H": v - a, "Wb": v, "A": a, "deg": 0}
    magnetics = {key: math.ldexp(value, powers[key.rpartition("_")[2]])
                 for key, value in machine.magnetics.parameters.items()}
    return replace(
        machine,
        resistance_ohm=times(machine.resistance_ohm, "ohm"),
        inertia_kg_m2=times(machine.inertia_kg_m2, "kg m^2"),
        friction_Nm_s=times(machine.friction_Nm_s, "N m s"),
        supply_voltage_V=times(machine.supply_voltage_V, "V"),
        magnetics=replace(machine.magnetics, parameters=magnetics),
        drive={key: times(value, _POWERS_OF_DRIVE.get(key, "")) if isinstance(value, float) else value
               for key, value in machine.drive.items()},
        drive_parameters={row.name: math.ldexp(machine.drive_parameters[row.name], exponents.of_parameter(row))
                          for row in read_table() if row.name in machine.drive_parameters},
    )


def in_no_unit(machine: Machine, scaling: Scaling) -> str:
    """The source of the firmware's tables but for what states the units."""
    tables = firmware_tables(MACHINES / "saturating.toml", machine, scaling)
    return re.sub(r"\.(parameter_fraction_bits|dbc_hash|machine_hash) = [^.]*", "",
                  tables_source(machine, scaling, tables))


@pytest.mark.in_turns
@pytest.mark.parametrize("name", ["saturating", "linear_cosine", "linear_trapezoid"])
def test_similar_machines_have_the_same_firmware_to_the_bit(name):
    path = MACHINES / f"{name}.toml"
    machine = load_machine(path)
    expected = in_no_unit(machine, scaling_of(path, machine))
    chance = random.Random(SEED)
    for _ in range(4):
        a, v = chance.randint(-5, 5), chance.randint(-5, 2)
        a += (a + v) % 2  # the torque's exponent is even
        other = similar(machine, a, v)
        scaling = scaling_of(path, other)
        assert scaling.exponents == Exponents(a, v, a + v, 0)
        assert in_no_unit(other, scaling) == expected


# --- CAN database ---------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("exponents", random_exponents(12), ids=str)
def test_database_in_other_units_has_the_same_frames_and_exact_factors(exponents):
    scaled, si = database_of(drive_dbc(exponents, 3_000_000, 4)), drive_database()
    assert [m.frame_id for m in scaled.messages] == [m.frame_id for m in si.messages]
    changed = 0
    for message, original in zip(scaled.messages, si.messages, strict=True):
        for signal, before in zip(message.signals, original.signals, strict=True):
            assert (signal.name, signal.start, signal.length, signal.unit) == (
                before.name, before.start, before.length, before.unit)
            exponent = exponents.of_unit(before.unit or "")
            assert signal.scale == math.ldexp(before.scale, exponent), signal.name
            if (message.name, signal.name) != ("DRIVE_COMMAND", "speed_reference_rpm"):
                assert signal.maximum == math.ldexp(before.maximum, exponent), signal.name
                assert signal.minimum == math.ldexp(before.minimum, exponent), signal.name
            changed += exponent != 0
    assert (database_hash(scaled) != database_hash(si)) == (changed > 0)


@pytest.mark.parametrize("exponents", random_exponents(12), ids=str)
def test_values_survive_the_round_trip_within_half_an_lsb(exponents):
    database = database_of(drive_dbc(exponents, 3_000_000, 4))
    chance = random.Random(SEED)
    for message in database.messages:
        for _ in range(20):
            values = {s.name: chance.uniform(float(s.minimum), float(s.maximum)) for s in message.signals}
            values |= {s.name: round(values[s.name]) for s in message.signals if s.scale == 1}
            decoded = message.decode(message.encode(values), decode_choices=False)
            for signal in message.signals:
                assert abs(decoded[signal.name] - values[signal.name]) <= 0.500001 * signal.scale, signal.name


@pytest.mark.parametrize(("speed_exponent", "speed_max_rpm", "over_speed_rpm", "limit_rpm", "raw"), [
    (0, 1200.0, 1440.0, 1200, 3_000_000), (0, 1200.0, 1300.0, 1137.5, 3_000_000),
    (0, 4000.5, 4800.0, 4000.5, 4_000_500), (3, 20_000.003, 24_000.0, 20_000, 2_500_000),
])
def test_commands_reach_the_largest_speed_of_the_machine_and_frames_3000_rpm_at_least(
        speed_exponent, speed_max_rpm, over_speed_rpm, limit_rpm, raw):
    path = MACHINES / "saturating.toml"
    data = scaling_of_file(path).data
    data = replace(data, speed_max_rpm=speed_max_rpm, parameters=data.parameters | {"over_speed_rpm": over_speed_rpm})
    scaling = Scaling(data, Exponents(speed=speed_exponent), 3)
    signal = database_of(scaling.dbc()).get_message_by_name("DRIVE_COMMAND").get_signal_by_name("speed_reference_rpm")
    assert (signal.minimum, signal.maximum) == (-limit_rpm, limit_rpm)
    assert scaling.speed_range_rpm == limit_rpm
    assert scaling.speed_reference_max == raw
    assert 0.0 < scaling.speed_max_q22 - math.ldexp(math.radians(6.0 * speed_max_rpm), 22 - speed_exponent) <= 2.0


# --- resolutions ----------------------------------------------------------------------------------------------------

def test_table_of_resolutions_in_the_readme_is_that_of_the_machines():
    assert resolution.PAGE.read_text(encoding="utf-8") == resolution.page(), "run python -m salient.generate.resolution"


@pytest.mark.parametrize("path", [*resolution.FILES, OTHERS / "fastest.toml"], ids=lambda path: path.stem)
def test_every_quantity_has_the_range_and_the_resolution_that_the_machine_needs(path):
    scaling = scaling_of_file(path)
    machine, data = load_machine(path), scaling.data
    of = {each.name: each for each in resolution.quantities(scaling)}
    rpm = 30.0 / math.pi
    flux_Wb = float(machine.magnetics.flux_linkage_Wb(0.0, data.adc_current_A))
    for name, largest, rated, part in (
        ("current", data.adc_current_A, data.current_rated_A, 1e-3),
        ("voltage", data.adc_voltage_V, data.supply_max_V, 1e-3),
        ("flux linkage", flux_Wb, flux_Wb, 1e-6),
        ("torque", 2.5 * data.torque_peak_Nm, data.torque_rated_Nm, 1e-6),
        ("speed", data.over_speed_rpm / rpm, data.speed_base_rpm / rpm, 1e-6),
        ("inertia", machine.inertia_kg_m2, machine.inertia_kg_m2, 1e-4),
        ("friction", machine.friction_Nm_s, machine.friction_Nm_s, 1e-4),
        ("resistance", machine.resistance_ohm, machine.resistance_ohm, 1e-4),
        ("current on the bus", data.adc_current_A, data.current_rated_A, 1e-3),
        ("voltage on the bus", data.adc_voltage_V, data.supply_max_V, 1e-3),
        ("torque on the bus", data.torque_peak_Nm, data.torque_rated_Nm, 1e-3),
        ("speed on the bus", data.over_speed_rpm, data.speed_base_rpm, 1e-5),
        ("current sensor", data.parameters["current_trip_A"], data.current_rated_A, 1e-3),
        ("DC-link divider", data.parameters["over_voltage_V"], data.supply_max_V, 1e-3),
        ("torque transducer", data.torque_peak_Nm, data.torque_rated_Nm, 1e-2),
    ):
        quantity = of.pop(name)
        assert quantity.maximum >= largest, name
        assert quantity.lsb < part * rated, name
        if quantity.unit in ("A", "V", "N m"):
            assert quantity.maximum < 17.0 * largest, f"{name}: most of its range is idle"
    assert not of
