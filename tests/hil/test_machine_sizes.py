"""Machines of other sizes than the bundled ones: the smallest, the largest, the fastest, and similar ones."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest

from salient.bench.drive import DriveError
from salient.bench.session import Session
from salient.dbc import database_hash, load_database
from salient.errors import UsageError
from salient.machine import cache
from salient.machine.parameter_table import read_table
from salient.machine.scaling import Exponents
from salient.paths import MACHINES, ROOT

OTHERS = ROOT / "tests" / "machines"

# Powers of 2^a and 2^v of a key, by its end.
UNITS = {"_ohm": (-1, 1), "_H": (-1, 1), "_V": (0, 1), "_Wb": (0, 1), "_A": (1, 0), "_Nm": (1, 1), "_kg_m2": (1, 1),
         "_Nm_s": (1, 1)}


def similar_file(name: str, a: int, v: int, folder: Path) -> Path:
    """The file of a bundled machine with 2^a times the current and 2^v times the voltage, and so with 2^(a + v) times
    the torque and inertia."""
    tables = tomllib.loads((MACHINES / f"{name}.toml").read_text())
    assert tables.pop("name") == name
    parameters = tables["drive"].pop("parameters", {})
    exponents = Exponents(a, v, a + v)
    lines = ['name = "similar"']
    for table, content in tables.items():
        lines.append(f"[{table}]")
        for key, value in content.items():
            powers = [power for end, power in UNITS.items() if key.endswith(end) and isinstance(value, float)]
            if powers:
                of_a, of_v = powers[-1]
                lines.append(f"{key} = {math.ldexp(value, a * of_a + v * of_v)!r}")
            else:
                lines.append(f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}")
    lines.append("[drive.parameters]")
    lines += [f"{row.name} = {math.ldexp(parameters[row.name], exponents.of_parameter(row))!r}"
              for row in read_table() if row.name in parameters]
    file = folder / f"similar_{a + 8}_{v + 8}.toml"
    file.write_text("\n".join(lines) + "\n")
    return file


def frames_of_a_load_step(make_bench, machine: str, controller: str, load_Nm: float) -> list[tuple[int, int, bytes]]:
    """Frames of the drive but for its identity, the hash of its database, while it starts and takes a load step."""
    bench = make_bench(machine=machine, controller=controller, seed=3)
    bench.drive.speed_reference_rpm = 600
    bench.at(0.12).load_torque_Nm = load_Nm
    bench.run_for(0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=10)
    assert bench.drive.fault == "none"
    bench.close()
    return [(time_ns, message.arbitration_id, bytes(message.data)) for time_ns, message in bench.log
            if not message.is_extended_id and message.arbitration_id not in {647, 1792}]


@pytest.fixture(scope="module")
def similar_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("machines")
    return {exponents: similar_file("saturating", *exponents, folder) for exponents in ((-3, -1), (4, 2))}


@pytest.mark.parametrize("exponents", [(-3, -1), (4, 2)])
@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
def test_similar_machine_runs_to_the_bit_as_its_model(make_bench, similar_files, controller, exponents):
    """Sensors, laws and bus have no unit of their own: the frames of both drives are equal."""
    load_Nm = math.ldexp(8.0, sum(exponents))
    similar = frames_of_a_load_step(make_bench, str(similar_files[exponents]), controller, load_Nm)
    assert similar == frames_of_a_load_step(make_bench, "saturating", controller, 8.0)


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
@pytest.mark.parametrize(("name", "speed_rpm", "load_Nm"), [
    ("smallest", 400.0, 0.02), ("largest", 1000.0, 800.0), ("fastest", 12_000.0, 0.4),
])
def test_machine_at_the_end_of_the_range_starts_and_holds_speed_under_load(make_bench, name, speed_rpm, load_Nm,
                                                                           controller):
    bench = make_bench(machine=str(OTHERS / f"{name}.toml"), controller=controller)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.5)
    bench.load_torque_Nm = load_Nm
    bench.run_for(0.3)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    steady = bench.truth["speed_rpm"].between(bench.time_s - 0.1, bench.time_s).value
    within = 0.001 if controller == "salient" else 0.03  # traditional and paper: ripple of the torque
    assert (1.0 - within) * speed_rpm < steady.min() <= steady.max() < (1.0 + within) * speed_rpm
    # Values that the drive sends, in its own units, is the truth.
    for signal, true, tolerance in (("speed_rpm", "speed_rpm", within * speed_rpm),
                                    ("load_torque_estimate_Nm", "load_torque_Nm", 0.15 * load_Nm)):
        assert bench.telemetry[signal].last == pytest.approx(bench.truth[true].last, abs=tolerance), signal
    assert bench.telemetry["DRIVE_TORQUE.bus_voltage_V"].last == pytest.approx(
        bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].last, rel=0.005)
    limit_A, trip_A = (bench.drive.parameters[f"current_{what}_A"] for what in ("limit", "trip"))
    true_A = max(bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].value.max() for phase in "abcd")
    measured_A = max(bench.telemetry[f"DRIVE_CURRENTS.current_{phase}_A"].value.max() for phase in "abcd")
    assert 0.3 * limit_A < measured_A < trip_A
    assert 0.7 * measured_A < true_A < 1.5 * measured_A
    parameters = bench.drive.parameters
    parameters_read = {row.name: parameters[row.name] for row in parameters.rows.values()}
    defaults = {row.name: row.default for row in parameters.rows.values()}
    assert parameters_read == defaults | {"telemetry_period_ms": 1.0}, "the period of a bench"


def test_control_rate_too_low_for_the_highest_speed_of_the_file_is_refused_with_that_reason(make_bench):
    reason = ("machine fastest at 20000 Hz: fewer than 25 control periods in an electrical revolution at its "
              "drive.speed_max_rpm")
    with pytest.raises(UsageError, match=f"^{reason}$"):
        make_bench(machine=str(OTHERS / "fastest.toml"), control_rate_hz=20_000)
    assert make_bench(machine=str(OTHERS / "fastest.toml"), control_rate_hz=50_000).drive.fault in ("none", "unknown")


def test_parameters_are_written_and_read_in_si_units(make_bench):
    bench = make_bench(machine=str(OTHERS / "fastest.toml"))
    parameters = bench.drive.parameters
    assert parameters.row("over_speed_rpm").fraction_bits == -3
    for name, value in (("over_speed_rpm", 16_000.0), ("torque_max_Nm", 1.125), ("current_limit_A", 20.25),
                        ("inertia_kg_m2", 1.25e-4), ("smc_delta", 0.5)):
        row = parameters.row(name)
        parameters[name] = value
        assert parameters[name] == pytest.approx(value, abs=0.5 * 2.0**-row.fraction_bits), name
    with pytest.raises(DriveError, match="torque_max_Nm 7: must be 0 to 6.25 N m"):
        parameters["torque_max_Nm"] = 7.0


def test_database_written_for_a_machine_is_that_of_its_drive_and_another_is_reported(make_bench, salient, tmp_path,
                                                                                    capsys):
    file, dbc = OTHERS / "smallest.toml", tmp_path / "smallest.dbc"
    result = salient("machine", file, "--out", tmp_path, "--dbc", dbc)
    assert result.returncode == 0, result.stderr
    bench = make_bench(machine=str(file))
    bench.run_for(0.02)
    assert bench.telemetry["dbc_hash"].last == database_hash(load_database(dbc))
    assert "carries" not in capsys.readouterr().err
    with Session(bench.address) as session:
        session.run_for(0.15)
    assert f"the drive carries {cache.FOLDER}/" in (line := capsys.readouterr().err) and "smallest.toml, this" in line
