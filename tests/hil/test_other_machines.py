"""Machines with other pole numbers and three or four phases need a machine file only, no change of C code."""

from __future__ import annotations

from pathlib import Path

import pytest

from salient.paths import MACHINES


@pytest.fixture(scope="module")
def machine_file(tmp_path_factory):
    """Path of the file of a machine with these poles: one file, and so one build, for all controllers."""
    folder = tmp_path_factory.mktemp("machines")

    def write(stator: int, rotor: int) -> Path:
        text = (MACHINES / "saturating.toml").read_text()
        file = folder / f"poles_{stator}_{rotor}.toml"
        file.write_text(
            text.replace("stator = 6", f"stator = {stator}")
            .replace("rotor = 4", f"rotor = {rotor}")
            .replace('"saturating"\n\n[poles]', f'"poles_{stator}_{rotor}"\n\n[poles]')
        )
        return file

    return {poles: write(*poles) for poles in ((8, 6), (12, 8))}


@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
@pytest.mark.parametrize(("stator", "rotor", "phases"), [(8, 6, 4), (12, 8, 3)])
def test_starts_and_holds_speed_under_load(make_bench, machine_file, controller, stator, rotor, phases):
    file = machine_file[stator, rotor]
    bench = make_bench(machine=str(file), controller=controller)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert bench.telemetry["DRIVE_HEARTBEAT.phases"].last == phases
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)
    bench.load_torque_Nm = 8
    bench.run_for(0.3)
    steady = bench.truth["speed_rpm"].between(bench.time_s - 0.1, bench.time_s)
    assert steady.value.min() > 597
    assert steady.value.max() < 603
    currents = [bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].value.max() for phase in "abcd"]
    assert sum(current > 20 for current in currents) == phases
    assert max(currents) < 75
    if controller == "salient":  # the other controllers are single-quadrant
        bench.drive.speed_reference_rpm = -600
        bench.run_for(0.3)
        backwards = bench.truth["speed_rpm"].between(bench.time_s - 0.1, bench.time_s)
        assert -600.5 < backwards.value.min() < backwards.value.max() < -599.5
        assert steady.value.min() > 599.8
        assert steady.value.max() < 600.2
    assert bench.drive.fault == "none"
