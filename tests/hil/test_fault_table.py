"""The page of measured reactions, docs/reference/drive-faults.md: complete, bounded, and what the drive does now."""

from __future__ import annotations

import re

import pytest

from salient.config import CONTROLLERS
from salient.experiments.fault_table import CASES, MACHINES, PAGE, measured_text

CELL = re.compile(r"`(?P<fault>\w+)`, (?P<time>[\d.]+) (?P<unit>µs|ms)(, (?P<travel_deg>[\d.]+)°)?, (?P<peak>[\d.]+)")
TRAVEL_MAX_DEG, FROZEN_MAX_S = 5.0, 0.3
DEAD_SENSOR_PEAK = 1.2


def table() -> dict[tuple[str, str, str], str]:
    """Cells of the page by case, machine and controller."""
    cells = {}
    machine = ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            machine = line.removeprefix("## ")
        row = [column.strip() for column in line.strip("|").split("|")]
        if machine in MACHINES and len(row) == 1 + len(CONTROLLERS) and row[0] not in ("fault", "---"):
            cells |= {(row[0], machine, name): cell for name, cell in zip(CONTROLLERS, row[1:], strict=True)}
    return cells


def test_the_page_has_every_case_machine_and_controller():
    assert list(table()) == [(case.name, machine, controller) for machine in MACHINES for case in CASES
                             for controller in CONTROLLERS]


@pytest.mark.parametrize("number", range(len(CASES)), ids=[case.name for case in CASES])
def test_the_drive_reacts_as_the_page_says(number: int):
    """One cell of each fault; machine and controller change from one to the next."""
    case = CASES[number]
    machine, controller = MACHINES[number % len(MACHINES)], CONTROLLERS[number % len(CONTROLLERS)]
    assert measured_text(case, machine, controller) == table()[case.name, machine, controller]


def test_a_drive_that_runs_on_has_a_reason():
    reasons = {case.name: case.unseen for case in CASES}
    runs_on = {case for (case, _, _), cell in table().items() if cell.startswith("runs on")}
    assert runs_on == {name for name, reason in reasons.items() if reason}


def test_a_fault_that_the_host_cannot_have_has_a_reason():
    reasons = {case.name: case.unsupported for case in CASES}
    unsupported = {case for (case, _, _), cell in table().items() if cell == "unsupported"}
    assert unsupported == {name for name, reason in reasons.items() if reason}


def test_dead_sensors_and_encoders_are_found_within_their_limits():
    found = 0
    for (case, machine, controller), cell in table().items():
        match = CELL.fullmatch(cell)
        if case.startswith(("current sensor open", "current sensor stuck", "current sensor, gain 0.3")):
            assert match and float(match["peak"]) < DEAD_SENSOR_PEAK, (case, machine, controller)
            found += 1
        if case == "encoder stuck before the start":
            assert match and match["fault"] == "encoder", (machine, controller)
            time_s = float(match["time"]) * (1e-3 if match["unit"] == "ms" else 1e-6)
            assert 1e-3 < time_s < FROZEN_MAX_S and 0.2 < float(match["travel_deg"]) < TRAVEL_MAX_DEG
            found += 1
    assert found == 5 * len(MACHINES) * len(CONTROLLERS)
