"""Torque ripple of drives whose tables are of an imported map, on the motor that the table was taken of: at half the
rated torque, slow and at base speed, at most 1.2 times the ripple of the drive with a map of the right values at the
same points.

The table has the motor's flux linkages with another origin, as three phases that differ, or with halves that differ.
Its points are not the ones of the motor's own map: how coarse they are costs ripple with the right values, too.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from salient.experiments import metrics
from salient.experiments.compare.random_maps import random_map
from salient.machine.drive_data import derive
from salient.machine.file import Machine, load_machine, machine_path
from salient.machine.flux_map import FluxMap
from salient.machine.image import FLUX_MAP, PLANT, TABLES, firmware_tables, joined
from salient.machine.map_import.command import import_map, with_map
from salient.machine.scaling import scaling_of

RATIO_MAX = 1.2
RIPPLE_MAX = 0.010  # below it no ratio is judged, as in compare
PARTS_OF_BASE = (0.05, 1.0)
ANGLES, CURRENTS = 91, 20
KINDS = ("0.5 deg off", "2 deg off", "phases differ", "halves differ", "half a pitch, 0.5 deg off",
         "half a pitch, 2 deg off")


def currents(machine: Machine) -> np.ndarray:
    most_A = min(1.5 * derive(machine).parameters["current_limit_A"], machine.magnetics.current_max_A)
    return np.linspace(0.0, most_A, CURRENTS + 1)[1:]


def source_of(name: str, folder: Path) -> Path:
    """The machine file of a bundled machine, or of a random one by its number."""
    if not name.startswith("random"):
        return machine_path(name)
    text, values = random_map(int(name.removeprefix("random")))
    path = folder / f"{tomllib.loads(text)['name']}.toml"
    path.write_text(text, encoding="utf-8")
    path.with_suffix(".csv").write_text(values, encoding="utf-8")
    return path


def right_map(source: Path, machine: Machine, folder: Path) -> Path:
    """A machine file with a map of the right values at the angles and currents of the table."""
    folder.mkdir()
    angles_deg, currents_A = np.linspace(0.0, 180.0 / machine.rotor_poles, ANGLES // 2 + 1), currents(machine)
    flux_Wb = machine.magnetics.flux_linkage_Wb(np.radians(angles_deg)[:, None], currents_A)
    lines = [f"{angle:.9g},{current:.9g},{psi:.9g}" for angle, fluxes in zip(angles_deg, flux_Wb, strict=True)
             for current, psi in zip(currents_A, fluxes, strict=True)]
    (folder / "right.csv").write_text("\n".join(["angle_deg,current_A,flux_linkage_Wb", *lines, ""]))
    text = source.read_text(encoding="utf-8")
    file = folder / f"{machine.name}.toml"
    file.write_text(with_map(text, tomllib.loads(text), "right.csv", "right.csv"), encoding="utf-8")
    return file


def table(machine: Machine, kind: str) -> str:
    """A table over a whole or half a pitch, in mechanical degrees."""
    pitch_deg = 360.0 / machine.rotor_poles
    angles_deg, currents_A = np.linspace(0.0, pitch_deg, ANGLES), currents(machine)
    if kind.startswith("half a pitch"):
        angles_deg = angles_deg[: ANGLES // 2 + 1]
    shift_deg = 0.5 if "0.5 deg off" in kind else 2.0 if "2 deg off" in kind else 0.0
    lines = ["phase,angle_deg,current_A,flux_linkage_Wb"]
    for phase, gain in enumerate((0.97, 1.0, 1.03) if kind == "phases differ" else (1.0,)):
        at_deg = angles_deg - shift_deg - phase * pitch_deg / machine.phases
        flux_Wb = gain * machine.magnetics.flux_linkage_Wb(np.radians(at_deg)[:, None], currents_A)
        if kind == "halves differ":  # by up to 6 % where the poles overlap in part
            flux_Wb *= 1.0 + 0.03 * np.sin(2.0 * math.pi * at_deg / pitch_deg)[:, None]
        lines += [f"{phase},{angle:.9g},{current:.9g},{psi:.9g}"
                  for angle, fluxes in zip(angles_deg, flux_Wb, strict=True)
                  for current, psi in zip(currents_A, fluxes, strict=True)]
    return "\n".join([*lines, ""])


def image_of(drive: Path, motor: Machine) -> bytes:
    """The machine image of a drive of one file with another motor."""
    machine = load_machine(drive)
    scaling = scaling_of(drive, machine)
    return joined([
        TABLES.packed(machine, scaling, firmware_tables(drive, machine, scaling)),
        PLANT.packed(motor, scaling),
        FLUX_MAP.packed(motor.magnetics) if isinstance(motor.magnetics, FluxMap) else b"",
        machine.name.encode("ascii") + b"\0",
    ])


def ripple(make_bench, folder: Path, drive: Path, motor: Machine, of_base: float) -> float:
    """K_t of a held shaft over whole electrical revolutions."""
    data = derive(motor)
    speed_rpm = of_base * data.speed_base_rpm
    turn_s = 60.0 / (speed_rpm * motor.rotor_poles)
    from_s = 0.02 + speed_rpm / 10_000.0 + max(0.15, turn_s)
    to_s = from_s + math.ceil(0.02 / turn_s) * turn_s
    image, recording = folder / "mixed.machine", folder / "recording.npy"
    image.write_bytes(image_of(drive, motor))
    bench = make_bench(machine=str(drive), machine_image=image, controller="salient", record=recording,
                       record_step_ns=1000, record_from_us=math.floor(1e6 * from_s))
    bench.held_speed_rpm = speed_rpm
    bench.run_for(0.02 + speed_rpm / 10_000.0)
    bench.drive.torque_reference_Nm = 0.5 * data.torque_rated_Nm
    bench.run_for(to_s + 0.001 - bench.time_s)
    bench.close()
    truth = np.load(recording)
    torque = metrics.torque_metrics(truth["time_s"], truth["torque_Nm"], (from_s + 1e-5, to_s))
    assert torque["torque_mean_Nm"] == pytest.approx(0.5 * data.torque_rated_Nm, rel=0.05)
    return torque["torque_ripple"]


@pytest.mark.in_turns
@pytest.mark.parametrize("of_base", PARTS_OF_BASE)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["finite_element", "saturating", "random4", "random5"])
def test_ripple_with_an_imported_map_is_at_most_1_2_times_that_with_the_right_one(
        make_bench, tmp_path, name, kind, of_base):
    source = source_of(name, tmp_path)
    motor = load_machine(source)
    file = tmp_path / "table.csv"
    file.write_text(table(motor, kind), encoding="utf-8")
    imported, lines = import_map(source, file, tmp_path / "imported")
    of_right = ripple(make_bench, tmp_path, right_map(source, motor, tmp_path / "right"), motor, of_base)
    of_import = ripple(make_bench, tmp_path, imported, motor, of_base)
    print(f"{name}, {kind}, {of_base:g} of base speed: K_t {of_import:.4f}, with the right map {of_right:.4f},"
          f" ratio {of_import / of_right:.3f}; {'; '.join(lines)}")
    assert of_import <= max(RIPPLE_MAX, RATIO_MAX * of_right)
