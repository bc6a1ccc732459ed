"""A drive that measures its own motor: experiments, limits, the loss of the client, and the machine that it finds."""

from __future__ import annotations

import math
import random
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from salient.bench.drive import Experiment
from salient.experiments import identified_aborts, identified_starts
from salient.experiments.identified import CONDITIONS, errors, identified
from salient.identify.command import identify
from salient.identify.link import HOLD_RECORD_S, IDLE, LOSS_MS, IdentifyError, linked
from salient.identify.result import write_machine
from salient.identify.sequence import Sequence
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.paths import ROOT

LIMIT_A = 52.0
GATES_OFF_S = 1e-3


def plate_of(folder: Path, *changes: tuple[str, str]) -> Path:
    """A name plate of `saturating`: another flux linkage, resistance and inertia than the motor's."""
    text = machine_path("saturating").read_text(encoding="utf-8")
    of_others = (('name = "saturating"', 'name = "plate"'),
                 ("\naligned_inductance_H = 23.6e-3", "\naligned_inductance_H = 0.03"),
                 ("resistance_ohm = 0.05", "resistance_ohm = 0.1"), ("inertia_kg_m2 = 0.02", "inertia_kg_m2 = 0.01"))
    for old, new in (*of_others, *changes):
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / "plate.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def identifying(make_bench):
    def make(**options):
        return make_bench(controller="salient", telemetry_period_ms=20, **options)
    return make


def pulse_level_A(bench) -> float:
    return max(float(np.max(bench.truth[f"current_{phase}_A"].value)) for phase in "abc")


def test_the_machine_is_found_and_the_name_plate_s_magnetics_are_not_used(identifying, tmp_path):
    plate = plate_of(tmp_path)
    bench = identifying(machine=str(plate), true_machine="saturating")
    result = identify(bench, load_machine(plate), 24, 1, lambda _: None)
    found = write_machine(result, plate, tmp_path / "motor.toml")
    true = load_machine(machine_path("saturating"))
    angle, current = np.meshgrid(np.linspace(0.0, math.pi / 4.0, 31), np.linspace(0.02, 0.95, 30) * LIMIT_A,
                                 indexing="ij")
    flux = true.magnetics.flux_linkage_Wb(angle, current)
    torque = true.magnetics.torque_Nm(angle, current)
    flux_error = found.magnetics.flux_linkage_Wb(angle, current) - flux
    torque_error = found.magnetics.torque_Nm(angle, current) - torque
    assert np.sqrt(np.mean(flux_error**2)) < 0.001 * flux.max()
    assert np.sqrt(np.mean(torque_error**2)) < 0.004 * np.abs(torque).max()
    assert found.resistance_ohm == pytest.approx(true.resistance_ohm, rel=0.005)
    assert found.inertia_kg_m2 == pytest.approx(true.inertia_kg_m2, rel=0.02)
    assert found.friction_Nm_s == pytest.approx(true.friction_Nm_s, rel=0.05)
    assert not result.warnings
    assert result.log["current_A"].max() <= 1.05 * LIMIT_A
    assert pulse_level_A(bench) <= 1.05 * LIMIT_A
    assert bench.time_s < 30.0


@pytest.mark.in_turns
@pytest.mark.parametrize("condition", ["17 bits", "17 bits, load", "17 bits, eddy 1 mS"])
def test_noise_friction_eccentricity_and_a_load_change_the_result_little(tmp_path, condition):
    """Noise of 2 LSB, offsets, 0.05 degrees of eccentricity, Coulomb friction of 2 %, load of 20 % of rated torque."""
    path = machine_path("saturating")
    result, file, time_s = identified(path, CONDITIONS[condition], tmp_path, lambda _: None)
    found = errors(load_machine(file), load_machine(path), result)
    for name, most in (("flux_rms", 0.1), ("flux_max", 1.0), ("torque_rms", 0.4), ("torque_max", 3.0),
                       ("angle_deg", 0.02), ("resistance", 0.5), ("inertia", 2.0)):
        assert 1e-6 < abs(found[name]) < most, name
    assert 95.0 < found["peak"] <= 105.0
    assert 5.0 < time_s < 30.0
    conductance_S = CONDITIONS[condition].get("eddy_S", 0.0)
    assert found["eddy_mS"] == pytest.approx(1e3 * conductance_S, abs=0.02)
    assert load_machine(file).circuit["eddy_conductance_S"] == pytest.approx(conductance_S, abs=2e-5)


def test_only_one_phase_carries_current_and_all_are_off_at_the_end(identifying):
    bench = identifying()
    with linked(bench) as link:
        for phase in range(3):
            log = link.run(Experiment("pulse", phase, 0.5), 0.2)
            assert 0.4 * LIMIT_A < log["current_A"].max() <= 0.5 * LIMIT_A
            assert log["state"][-1] == IDLE
    bench.run_for(0.02)
    assert bench.drive.state == "ready"
    assert not bench.drive.armed


def test_a_run_does_not_follow_from_experiments(identifying):
    bench = identifying()
    with linked(bench) as link:
        link.rest(0.02)
        bench.drive.speed_reference_rpm = 300
        bench.run_for(0.2)
        assert abs(bench.truth["speed_rpm"].last) < 1.0
        assert bench.drive.fault == "command_error"  # commands that the drive does not take
    bench.run_for(0.05)
    bench.drive.clear_fault()
    bench.run_for(0.1)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.3)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(300, abs=5)


def test_a_limit_of_earlier_experiments_does_not_refuse_the_next_ones(identifying):
    """A hold for longer than the copper loss permits; the drive keeps the reason until its next run."""
    bench = identifying()
    with linked(bench) as link:
        link.run(Experiment("pulse", 0, 0.1), 0.2)
        with pytest.raises(IdentifyError, match="has had its copper loss"):
            link.run(Experiment("hold", 0, 0.5), 6.0)
    bench.run_for(0.05)
    assert not bench.drive.armed
    with linked(bench) as link:
        assert len(link.rest(0.01)) > 5
        link.check()


@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_other_controllers_are_refused_by_name(make_bench, controller):
    bench = make_bench(controller=controller, telemetry_period_ms=20)
    with pytest.raises(IdentifyError, match="controller must be salient"), linked(bench):
        pass


@pytest.mark.parametrize("seed", range(12))
def test_the_loss_of_the_client_at_any_instant_opens_the_switches(identifying, seed):
    """Within the command timeout; the drive is usable again."""
    bench = identifying(seed=seed + 1)
    of = random.Random(seed)
    with linked(bench) as link:
        link.run(Experiment("pulse", 0, 0.1), 0.2)
        kind = of.choice(["hold", "pulse", "freewheel"])
        bench.drive.begin_experiment(Experiment(kind, 0, 0.4, time_ms=4000))
        bench.run_for(of.uniform(0.0, 0.03))
        bench.drive.silence()
        bench.run_for(0.05 + 0.01 + GATES_OFF_S)
        bench.run_for(0.03)
        assert bench.drive.state == "ready"
        assert abs(bench.truth["current_a_A"].last) < 0.1
        bench.run_for(1.0)
        assert abs(bench.truth["current_a_A"].last) < 0.1
        link._take()
    bench.run_for(0.05)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.4)
    assert bench.drive.state == "run"


@pytest.mark.parametrize("seed", range(6))
def test_a_fault_at_any_instant_ends_them_and_can_be_cleared(identifying, seed):
    bench = identifying(seed=seed + 1)
    of = random.Random(seed)
    with linked(bench) as link:
        link.run(Experiment("pulse", 0, 0.1), 0.2)
        bench.drive.begin_experiment(Experiment("hold", 0, 0.4))
        bench.run_for(of.uniform(0.0, 0.03))
        bench.rig.sto_1 = bench.rig.sto_2 = 1
        bench.run_for(0.05)
        assert abs(bench.truth["current_a_A"].last) < 0.1
        with pytest.raises(IdentifyError, match="fault sto"):
            link.check()
    bench.rig.sto_1 = bench.rig.sto_2 = 0
    bench.run_for(0.05)
    bench.drive.clear_fault()
    bench.run_for(0.1)
    assert bench.drive.state == "ready"
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.4)
    assert bench.drive.state == "run"


BUNDLED = ("finite_element", "linear_cosine", "linear_trapezoid", "saturating")


@pytest.mark.in_turns
@pytest.mark.parametrize("seed", range(1, 25))
def test_order_direction_and_angles_are_right_from_any_start(seed):
    """Or the name plate has another number of poles, and is refused."""
    start = identified_starts.drawn(seed, BUNDLED)
    poles = load_machine(machine_path(start.machine)).rotor_poles
    result = identified_starts.run_one(start)
    assert result["verdict"] == ("right" if start.plate_poles == poles else "refused"), result


def test_fewer_poles_than_the_name_plate_s_are_refused(identifying):
    bench = identifying(initial_angle_deg=20.0)
    with linked(bench) as link:
        sequence = Sequence(link, 3, 8, lambda _: None)
        sequence.probe()
        with pytest.raises(IdentifyError, match="a multiple of 2 strokes of 8 rotor poles"):
            sequence.align()


@pytest.mark.parametrize("seed", range(1, 9))
def test_an_identification_broken_off_in_its_first_pulses(seed):
    """Client killed or silent, a fault, STO: gates off in time, no file touched, the drive usable by another client."""
    abort = replace(identified_aborts.drawn(seed), stage="rest", offset_s=0.03 + 0.004 * seed, loaded=False)
    result = identified_aborts.run_one(abort)
    assert result["place"], result
    assert not result["wrong"], result


@pytest.mark.in_turns
@pytest.mark.parametrize("seed", range(9, 25))
def test_an_identification_broken_off_at_any_instant(seed):
    """As above, in the holds, the map, the spin-up or the coasting."""
    result = identified_aborts.run_one(identified_aborts.drawn(seed))
    assert not result["wrong"], result


@pytest.mark.in_turns
def test_a_process_killed_while_it_writes_leaves_the_old_machine_or_the_new_one():
    result = identified_aborts.writing()
    assert int(result["ending"].split()[0]) > 10
    assert not result["wrong"], result


def test_a_gate_that_is_on_shows_in_the_recording():
    """240 V and 2 A that decay: with all gates off the link takes back 480 W, freewheeling nothing."""
    time_s = np.arange(4) * 5e-5
    record = np.zeros(4, [("time_s", "f8"), *((name, "f4") for name in (
        "bus_voltage_V", "current_a_A", "current_b_A", "energy_drawn_J", "energy_returned_J"))])
    record["time_s"], record["bus_voltage_V"], record["current_a_A"] = time_s, 240.0, 2.0
    record["energy_returned_J"] = 480.0 * np.minimum(time_s, 1e-4)
    assert identified_aborts.gates_on(record, 0.1).tolist() == [False, False, False, True]
    record["current_b_A"] = 0.05
    assert identified_aborts.gates_on(record, 3.0).tolist() == [False] * 4


def test_a_pause_of_the_client_ends_the_experiments_and_does_not_arm_again(identifying):
    bench = identifying()
    with linked(bench) as link:
        link.rest(0.02)
        bench.drive.silence()
        bench.run_for(0.3)
        with pytest.raises(IdentifyError, match="no command reached it"):
            link.run(Experiment("pulse", 0, 0.1), 0.2)
        assert bench.drive.state == "ready"
        assert not bench.drive.armed


def test_an_open_winding_is_refused_by_name(identifying):
    bench = identifying()
    bench.fault("winding_open", phase="b")
    with linked(bench) as link:
        sequence = Sequence(link, 3, 4, lambda _: None)
        with pytest.raises(IdentifyError, match="phase b: no current"):
            sequence.probe()


def test_constants_of_the_firmware_are_the_tools_own():
    """The loss that ends a map, and the time by which a settled rotor is judged."""
    firmware = "".join((ROOT / "firmware/control" / name).read_text(encoding="utf-8")
                       for name in ("identify.h", "identify.c"))
    of = {name: int(value) for name, value in re.findall(r"^#define (\w+) (\d+)u$", firmware, re.MULTILINE)}
    assert of["IDENTIFY_ENERGY_MS"] == LOSS_MS
    assert 1e-3 / of["HOLD_RECORDS"] == HOLD_RECORD_S


def test_experiments_out_of_range_are_refused():
    for wrong in ({"kind": "spin"}, {"kind": "pulse", "phase": 6}, {"kind": "pulse", "level": 1.0},
                  {"kind": "pulse", "time_ms": 4096}, {"kind": "pulse", "angle": -0.1}):
        with pytest.raises(ValueError, match=next(reversed(wrong))):
            Experiment(**wrong)


@pytest.mark.parametrize(("options", "text"), [
    (["--seed", "2"], "--seed: only with --true-machine"),
    (["--out", "motor.txt"], "must be FILE.toml"),
    (["--true-machine", "saturating", "--set", "encoder_offset_deg=9"], "must be a number from -5 to 5"),
    (["--true-machine", "finite_element"], "must have the same number"),
])
def test_a_mistake_in_an_option_is_one_line_and_leaves_no_file(tmp_path, options, text):
    command = [sys.executable, "-m", "salient", "identify", "--machine", "saturating", "--out", "motor.toml", *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stdout
    assert text in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not [path for path in tmp_path.iterdir() if path.is_file()]
