"""A true machine beside the file: firmware, DBC and tools are of --machine, the plant is of --true-machine."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from salient.errors import UsageError
from salient.experiments.scenario import load_scenarios, run_all
from salient.machine.cache import machine_image
from salient.machine.file import load_machine
from salient.machine.image import HEADER, PLANT, TABLES
from salient.machine.path import machine_path

IDENTITY = ("DRIVE_IDENTITY", "DRIVE_MACHINE")
RECORD_STEP_NS = 10_000
PLANT_NAMES = [member.name for member in PLANT.members]


def variation(folder: Path, name: str, *changes: tuple[str, str], of: str = "saturating") -> str:
    """A machine file that differs from a bundled one."""
    text = machine_path(of).read_text(encoding="utf-8").replace(f'name = "{of}"', f'name = "{name}"')
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def parts(image: Path) -> tuple[bytes, bytes]:
    """The firmware's tables of an image, and the rest."""
    data = image.read_bytes()
    return data[HEADER.size:HEADER.size + TABLES.size], data[HEADER.size + TABLES.size:]


def members(image: Path) -> dict[str, bytes]:
    """Members of the plant of an image."""
    plant, found, at = parts(image)[1], {}, 0
    for member in PLANT.members:
        found[member.name] = plant[at:at + member.size]
        at += member.size
    return found


def driven(make_bench, recording: Path, **options):
    """Identity frames, parameters and recording of a run with a load step."""
    bench = make_bench(controller="salient", record=recording, record_step_ns=RECORD_STEP_NS, **options)
    values = dict(bench.drive.parameters)
    bench.drive.speed_reference_rpm = 300
    bench.at(0.1).load_torque_Nm = 4
    bench.run_for(0.25)
    ids = {bench.drive_database.get_message_by_name(name).frame_id for name in IDENTITY}
    frames = {(message.arbitration_id, bytes(message.data)) for _, message in bench.log
              if message.arbitration_id in ids}
    dbc = bench.drive_database.as_dbc_string()
    bench.close()
    assert len(frames) == len(IDENTITY)
    return frames, values, dbc, np.load(recording)


def test_nothing_of_the_true_machine_reaches_firmware_or_tools(make_bench, tmp_path):
    heavy = variation(tmp_path, "heavy", ("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.04"))
    other = "linear_cosine"
    runs = [driven(make_bench, tmp_path / f"{number}.npy", machine="saturating", **options)
            for number, options in enumerate(({}, {"true_machine": heavy}, {"true_machine": other}))]
    alone, *others = runs
    for one in others:
        assert one[:3] == alone[:3]
    recordings = [run[3]["speed_rpm"] for run in runs]
    assert all(np.abs(a - b).max() > 1.0 for a, b in ((recordings[0], recordings[1]), (recordings[0], recordings[2]),
                                                       (recordings[1], recordings[2])))
    tables = {parts(machine_image("saturating", true))[0] for true in (None, heavy, other)}
    assert tables == {parts(machine_image("saturating"))[0]}


def test_the_plant_is_of_the_true_machine_and_the_board_of_the_firmware(tmp_path):
    other = variation(tmp_path, "other", ("adc_current_A = 80.0", "adc_current_A = 100.0"),
                      ("supply_voltage_V = 240.0", "supply_voltage_V = 250.0"))
    mixed, firmware, true = (members(machine_image(*pair)) for pair in (
        ("saturating", other), ("saturating",), (other,)))
    board = {name for name in PLANT_NAMES if name.startswith("ranges.") or name == "trip_current_A"}
    assert any(firmware[name] != true[name] for name in board)
    assert mixed == {**true, **{name: firmware[name] for name in board}}


def test_a_true_machine_that_is_the_machine_gives_its_image():
    assert machine_image("saturating", "saturating").read_bytes() == machine_image("saturating").read_bytes()


@pytest.mark.parametrize(("old", "new", "variable", "gain"), [
    ("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.04", "inertia_gain", 2.0),
    ("resistance_ohm = 0.05", "resistance_ohm = 0.065", "resistance_gain", 1.3)])
def test_a_true_machine_and_the_variable_of_the_rig_agree(make_bench, tmp_path, old, new, variable, gain):
    file = variation(tmp_path, "varied", (old, new))
    speeds = []
    for number, (options, value) in enumerate((({"true_machine": file}, 1.0), ({}, gain), ({}, 1.0))):
        recording = tmp_path / f"{number}.npy"
        bench = make_bench(machine="saturating", controller="salient", record=recording,
                           record_step_ns=RECORD_STEP_NS, **options)
        bench.rig.set(variable, value)
        bench.drive.speed_reference_rpm = 300
        bench.run_for(0.15)
        bench.close()
        speeds.append(np.load(recording)["speed_rpm"])
    of_file, of_variable, of_neither = speeds
    difference_rpm = np.abs(of_file - of_variable).max()
    print(f"{variable}: {difference_rpm:.3g} r/min; without it {np.abs(of_file - of_neither).max():.3g} r/min")
    assert difference_rpm < 1e-3 < np.abs(of_file - of_neither).max()


@pytest.mark.parametrize(("machine", "true", "expected"), [
    ("saturating", "map86", ("4 phases", "3")),
    ("saturating", "traction", ("8 rotor poles", "4")),
    ("saturating", "low", ("converter.supply_voltage_V: 100",)),
])
def test_machines_that_do_not_fit_are_one_line_with_both_files(tmp_path, machine, true, expected):
    if true == "low":
        true = variation(tmp_path, "low", ("supply_voltage_V = 240.0", "supply_voltage_V = 100.0"))
    with pytest.raises(UsageError) as caught:
        machine_image(machine, true)
    text = str(caught.value)
    for part in (str(machine_path(true)), str(machine_path(machine)), *expected):
        assert part in text
    assert "\n" not in text


def test_a_scenario_states_the_true_machine_and_its_results_say_so(tmp_path):
    variation(tmp_path, "resistive", ("resistance_ohm = 0.05", "resistance_ohm = 0.1"))
    losses = []
    for name, key in (("alone", ""), ("mixed", 'true_machine = "resistive.toml"\n')):
        path = tmp_path / f"{name}.toml"
        path.write_text(f'machine = "saturating"\n{key}controllers = ["salient"]\nduration_s = 0.1\n'
                        "[[speed]]\nat_s = 0.0\nvalue_rpm = 300.0\n[record]\nstep_us = 10.0\n", encoding="utf-8")
        run_all(load_scenarios(path), tmp_path / name)
        results = json.loads((tmp_path / name / "results.json").read_text(encoding="utf-8"))
        losses.append(results["controllers"]["salient"]["losses"])
    assert results["scenario"]["machine"] == "saturating"
    assert results["scenario"]["true_machine"] == str(tmp_path / "resistive.toml")
    assert load_machine(Path(results["scenario"]["true_machine"])).resistance_ohm == 0.1
    assert losses[0] != losses[1]
