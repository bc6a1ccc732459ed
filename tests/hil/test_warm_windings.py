"""Windings from -40 to 155 C, whose resistance the drive does not know: no faults, and faults that are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from salient.experiments.healthy_drives import run_drive
from salient.machine.path import MachineError

CONTROLLERS = ("traditional", "paper", "salient")
RATED_NM, BASE_RPM = 0.19, 1107.0
SMALL = """\
name = "small24"
[poles]
stator = 6
rotor = 4
[winding]
resistance_ohm = 1.2
[mechanics]
inertia_kg_m2 = 3e-05
friction_Nm_s = 1e-05
[magnetics]
form = "saturating"
unaligned_inductance_H = 0.001
aligned_inductance_H = 0.009
saturated_inductance_H = 0.0007
flux_linkage_max_Wb = 0.035
current_at_flux_linkage_max_A = 14
[converter]
supply_voltage_V = 24
"""
"""The current for the rated torque takes 0.45 of the supply when the winding has 25 C."""


@pytest.fixture
def small(make_bench, tmp_path: Path):
    """Starts a drive of the small machine, at half of its base speed."""
    file = tmp_path / "small24.toml"
    file.write_text(SMALL, encoding="utf-8")

    def make(controller: str, **options):
        bench = make_bench(machine=file, controller=controller, **options)
        bench.drive.speed_reference_rpm = 0.5 * BASE_RPM
        bench.at(0.2).load_torque_Nm = 0.5 * RATED_NM
        return bench

    return make


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("temperature_C", [-40.0, 130.0])
def test_a_cold_or_warm_winding_of_a_small_machine_is_no_fault(small, controller, temperature_C):
    """Up to 5 K below where the measured temperature limits the torque."""
    bench = small(controller)
    bench.rig.held_winding_C = temperature_C
    bench.run_for(0.6)
    assert bench.drive.state == "run"
    assert bench.truth["winding_temperature_C"].last == pytest.approx(temperature_C, abs=0.2)
    assert 0.98 < bench.truth["speed_rpm"].last / (0.5 * BASE_RPM) < 1.02


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("gain", [0.72, 1.4, 1.55])
def test_any_resistance_of_a_winding_of_a_small_machine_is_no_fault(small, controller, gain):
    bench = small(controller, control_rate_hz=20_000 if gain == 1.4 else 100_000)
    bench.rig.resistance_gain = gain
    bench.run_for(0.6)
    assert bench.drive.state == "run"
    assert 0.98 < bench.truth["speed_rpm"].last / (0.5 * BASE_RPM) < 1.02


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("gain", [0.75, 1.5])
def test_an_open_winding_of_a_small_machine_is_found_within_a_revolution_cold_or_warm(small, controller, gain):
    """Each phase conducts four times in a revolution, of 108 ms; the tolerance takes full voltage for 45 us."""
    bench = small(controller)
    bench.rig.resistance_gain = gain
    bench.at(0.4012).fault("winding_open", phase="b")
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.6)
    bench.run_for(0.002)
    detected_s = bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last * 1e-6 - 0.4012
    assert bench.drive.fault == "phase_open"
    assert 45e-6 <= detected_s < 1.05 * 60.0 / (0.5 * BASE_RPM) / 4.0


@pytest.mark.in_turns
@pytest.mark.parametrize("number", [11, 75, 258, 420, 489])
def test_healthy_drives_of_the_whole_range_with_warm_windings_are_no_false_alarm(number):
    """Drives of experiments.healthy_drives that tripped once."""
    done = run_drive(number)
    assert not isinstance(done, MachineError)
    _, result = done
    assert result["causes"] == []
    assert 300_000 < result["virtual_us"] < 4_000_000
