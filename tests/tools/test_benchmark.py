"""Results of tools/salient benchmark except the times: the reference solvers solve the problem of the plant, with the
reported accuracy; the instruction counts."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from reference_plant import Run, machine_from, run_reference

from salient.benchmark import callgrind
from salient.benchmark import command as benchmark
from salient.benchmark.solvers import PLANT, REFERENCE_SOLVERS, REFERENCE_TOLERANCE
from salient.benchmark.switching_pattern import SwitchingPattern, deviation, program, record, run_plant
from salient.machine.file import load_machine
from salient.paths import BUILD, MACHINES, ROOT
from salient.reference.scipy_plant import dop853, run_scipy

pytestmark = pytest.mark.in_turns

PERIODS = 800  # 20 ms, two and a half strokes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recorded")


@pytest.fixture(scope="module")
def pattern(folder: Path) -> SwitchingPattern:
    return record(folder, duration_s=PERIODS * 25e-6)


def test_switching_pattern_reproduces_the_drive(pattern: SwitchingPattern, folder: Path) -> None:
    recording = np.load(folder / "recording.npy")
    assert pattern.periods == PERIODS and len(recording) == PERIODS + 1
    replayed = run_plant(pattern, passes=1)
    for phase in range(pattern.phases):
        recorded = recording[f"current_{'abcd'[phase]}_A"][1:]
        assert np.max(recorded) > 20.0, "every phase is to have carried current"
        assert np.max(np.abs(replayed.current_A[:, phase] - recorded)) < 2e-5 * np.max(recorded)
    assert np.max(np.abs(replayed.torque_Nm - recording["torque_Nm"][1:])) < 5e-4
    load_and_friction_Nm = 8.0 + 0.02 * 600.0 * math.pi / 30.0
    assert abs(np.mean(replayed.torque_Nm) - load_and_friction_Nm) < 0.1


def test_reference_agrees_with_the_independent_model(pattern: SwitchingPattern) -> None:
    """reference_plant.py has flux linkages as state, events, and an independent switching pattern."""
    machine = machine_from(load_machine(MACHINES / "saturating.toml"))
    compares = list(zip(pattern.upper.tolist(), pattern.lower.tolist(), strict=True))
    run = Run(pattern.period_ticks, compares, pattern.speed_rad_s, math.degrees(pattern.angle_rad),
              pattern.load_torque_Nm, pattern.current_A)
    independent, ends = run_reference(machine, run)
    assert len(ends) >= 1, "the run is to contain an end of conduction"
    reference = run_scipy(pattern, dop853(REFERENCE_TOLERANCE))
    assert np.max(np.abs(reference.current_A.T - independent["currents"][:, 1:])) < 1e-9
    assert np.max(np.abs(reference.torque_Nm - independent["torque"][1:])) < 1e-9
    assert np.max(np.abs(reference.speed_rad_s - independent["speed"][1:])) < 1e-10
    assert np.max(np.abs(reference.angle_rad - independent["angle"][1:])) < 1e-11


# Largest deviation of current and torque from the reference: (at least, at most).
ACCURACY = {
    "plant": (1e-11, 2e-8),
    "plant, steps of 1/8": (1e-13, 1e-9),
    "plant, steps of 1/32": (1e-14, 1e-11),
    "SciPy LSODA, 1e-6": (1e-6, 1e-3),
    "SciPy LSODA, 1e-9": (1e-9, 1e-5),
    "SciPy LSODA, 1e-12": (1e-12, 1e-8),
    "SciPy DOPRI5, 1e-6": (1e-14, 1e-9),
    "ngspice, 1 us": (1e-6, 1e-3),
}


def test_every_solver_reports_its_accuracy_and_is_compared_with_a_plant_at_least_as_accurate(
    pattern: SwitchingPattern, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(benchmark, "record", lambda folder, **_: pattern)
    content = json.loads(json.dumps(benchmark.compare_solvers(runs=1)))
    rows = {row["solver"]: row for row in content["solvers"]}
    assert list(rows) == [*PLANT, *REFERENCE_SOLVERS] == list(ACCURACY)
    output = capsys.readouterr().out.splitlines()
    for name, row in rows.items():
        (line,) = [line for line in output if line.startswith(f"  {name} ")]
        assert ("times faster" in line) == (row.get("plant_times_faster") is not None)
    for name, (least, most) in ACCURACY.items():
        for quantity in ("current", "torque"):
            assert least < rows[name]["deviation"][quantity] < most, (name, rows[name])
    for name in REFERENCE_SOLVERS:
        row = rows[name]
        if row["compared_with"] is not None:
            plant = rows[row["compared_with"]]
            assert all(plant["deviation"][key] <= value for key, value in row["deviation"].items())
            assert row["plant_times_faster"] == row["processor_s"] / plant["processor_s"]
    assert rows["SciPy LSODA, 1e-6"]["compared_with"] == rows["ngspice, 1 us"]["compared_with"] == "plant"
    # At least one step for each of 4 to 5 segments per period, and no fewer evaluations for a smaller tolerance.
    lsoda = [rows[f"SciPy LSODA, 1e-{digits}"]["evaluations_per_period"] for digits in (6, 9, 12)]
    assert 10.0 < lsoda[0] < lsoda[1] < lsoda[2] < 300.0


def test_deviation_is_relative_to_the_reference(pattern: SwitchingPattern) -> None:
    reference = run_plant(pattern, passes=1)
    off = type(reference)(reference.angle_rad, reference.speed_rad_s + 0.25 * np.ptp(reference.speed_rad_s),
                          1.5 * reference.torque_Nm, 0.9 * reference.current_A, 0.0)
    assert deviation(off, reference) == pytest.approx({"current": 0.1, "torque": 0.5, "speed": 0.25})


def test_instruction_counts_of_the_plant_are_reproducible(pattern: SwitchingPattern) -> None:
    count = callgrind.of_plant(pattern)
    assert 2000.0 < count < 6000.0
    assert callgrind.of_plant(pattern) == count


def test_instruction_counts_of_the_drive_are_reproducible_except_for_the_client() -> None:
    """The bundling of a client's frames in the socket, the arming's among them, depends on the load of the
    computer: up to 0.6 % of the whole was seen in this short span."""
    first, second = (callgrind.of_drive("paper", 0.01) for _ in range(2))
    assert first["plant"] == second["plant"] and first["control laws"] == second["control laws"]
    assert sum(second.values()) == pytest.approx(sum(first.values()), rel=0.02)


@pytest.mark.parametrize(("controller", "least", "most"), [
    ("traditional", 2000.0, 6000.0), ("paper", 4500.0, 11000.0), ("salient", 7500.0, 15000.0)])
def test_instructions_of_the_drive_are_grouped(controller: str, least: float, most: float) -> None:
    counts = callgrind.of_drive(controller, 0.02)
    total = sum(counts.values())
    assert least < total < most, counts
    assert 0.3 < counts["plant"] / total < 0.8, counts
    assert 0.05 < counts["control laws"] / total < 0.5, counts
    assert 0.02 < counts["drive"] / total < 0.35, counts
    assert 0.002 < counts["CAN"] / total < 0.15, counts
    assert 0.002 < counts["rig"] / total < 0.15, counts
    assert 0.0 <= counts["other"] / total < 0.03, counts


def test_callgrind_counts_are_attributed_to_the_source_they_were_inlined_from() -> None:
    text = """events: Ir
fl=(1) /x/emulator/plant/plant.c
fn=(1) plant_advance
10 100
fi=(2) /x/firmware/./fixed/fixed.h
+3 20
fi=(3) /usr/lib/gcc/include/emmintrin.h
-1 7
fe=(1)
* 1
cfi=(4) ./math/exp.c
cfn=(2) exp
calls=3 0
11 5000
12 2
fl=(4)
fn=(2)
1 30
"""
    assert callgrind.read_counts(text) == {"plant": 110, "control laws": 20, "other": 30}


@pytest.mark.parametrize("condition", [name for name in benchmark.CONDITIONS if name != "cortex-m4"])
def test_each_condition_can_be_measured(condition: str) -> None:
    assert benchmark.measure("paper", condition) > 0.0


def test_the_command_builds_the_programs_that_it_runs() -> None:
    """The suite builds everything before: in a fresh clone it ended for want of one."""
    code = "import sys; sys.path.insert(0, sys.argv[1]); import launcher; print(*launcher.host_targets(*sys.argv[2:]))"
    targets = subprocess.run([sys.executable, "-c", code, str(ROOT / "tools"), "benchmark", "cortex-m4"],
                             capture_output=True, text=True, check=True).stdout.split()
    listed = subprocess.run(["ninja", "-C", str(BUILD / "host"), "-t", "commands", *targets],
                            capture_output=True, text=True, check=True).stdout.split()
    for machine in MACHINES.glob("*.toml"):
        assert str(program(machine.stem).relative_to(BUILD / "host")) in listed
