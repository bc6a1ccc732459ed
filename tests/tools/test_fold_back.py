"""Ranges of the DC-link voltage in which braking torque decreases, from a machine file."""

from __future__ import annotations

import numpy as np
import pytest

from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.machine.fold_back import field_J, fold_back_V, mean_fold_back_V
from salient.paths import MACHINES


def ranges_V(folder, link: str) -> tuple[float, float, float]:
    """Both ranges and the rise, of the saturating machine with a link: 240 V, trip at 300 V."""
    file = folder / "with_link.toml"
    text = (MACHINES / "saturating.toml").read_text()
    file.write_text(text.replace("[drive]", f"[dc_link]\nsource_resistance_ohm = 0.1\n{link}\n[drive]", 1))
    machine = load_machine(file)
    data = derive(machine)
    flux_Wb = machine.magnetics.flux_linkage_Wb(0.0, np.linspace(0.0, 52.0, 20_001))
    current_A = np.linspace(0.0, 52.0, 20_001)
    field = float(np.sum(0.5 * (current_A[1:] + current_A[:-1]) * np.diff(flux_Wb)))
    assert field_J(machine, 52.0) == pytest.approx(field, rel=1e-5)
    return fold_back_V(machine, data), mean_fold_back_V(machine, data), field / machine.dc_link["capacitance_F"] / 300.0


CHOPPER = "\nchopper_resistance_ohm = {}\nchopper_on_V = {}\nchopper_off_V = 270.0"


def test_without_a_chopper_there_is_room_for_four_times_the_field_of_a_phase(tmp_path):
    range_V, mean_V, rise_V = ranges_V(tmp_path, "capacitance_F = 4.0e-3")
    assert 2.0 < rise_V < 15.0
    assert range_V == pytest.approx(4.0 * rise_V, rel=1e-4)
    assert mean_V == range_V


@pytest.mark.parametrize("chopper_on_V", [275.0, 290.0])
@pytest.mark.parametrize(("ohm", "rises"), [
    (10.0, 1.5), (11.5, 1.5), (12.0, 4.0 - 5.0 * 25.0 / 52.0), (20.0, 4.0 - 5.0 * 15.0 / 52.0),
    (60.0, 4.0 - 5.0 * 5.0 / 52.0)])
def test_a_chopper_needs_less_the_more_it_takes_and_a_lasting_excess_counts_from_its_voltage_on(
        tmp_path, chopper_on_V, ohm, rises):
    range_V, mean_V, rise_V = ranges_V(tmp_path, "capacitance_F = 5.0e-3" + CHOPPER.format(ohm, chopper_on_V))
    above_V = 1.75 * (300.0 - chopper_on_V)
    assert range_V == pytest.approx(max(1.5 * rise_V, min(rises * rise_V, above_V)), rel=1e-4)
    assert mean_V == pytest.approx(min(range_V, 300.0 - chopper_on_V))


def test_range_ends_at_the_supply_and_a_supply_that_takes_energy_back_has_none(tmp_path):
    assert ranges_V(tmp_path, "capacitance_F = 1.0e-4")[0] == pytest.approx(60.0)
    machine = load_machine(MACHINES / "saturating.toml")
    assert fold_back_V(machine, derive(machine)) == 0.0 == mean_fold_back_V(machine, derive(machine))


def test_the_bundled_link_is_large_its_field_needs_hardly_more_than_the_least_range_of_the_firmware():
    machine = load_machine(MACHINES / "finite_element.toml")
    assert 0.97 < fold_back_V(machine, derive(machine)) / (300.0 / 32.0) < 1.05
