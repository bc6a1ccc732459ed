"""Writes the diagnostic coverage of each part of the drive, from the measured page of its reactions to faults.

    python -m salient.generate.diagnostic_coverage

reads docs/reference/drive-faults.md (salient.experiments.fault_table) and writes docs/reference/diagnostic-coverage.md.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from dataclasses import dataclass, field

from salient.experiments import fault_table
from salient.experiments.fault_table import CASES, FaultCase
from salient.paths import REFERENCE

PAGE = REFERENCE / "diagnostic-coverage.md"

PARTS = {
    "winding and load": ("winding_open", "winding_shorted", "shaft_locked", "coulomb_friction"),
    "switches, diodes, gate supply": ("switch_open", "switch_shorted", "diode_open", "gate_supply_lost"),
    "current sensors": ("current_sensor_open", "current_sensor_stuck", "current_sensor_high_rail",
                        "current_sensor_gain", "current_sensor_swapped"),
    "sensor of the DC link": ("dc_link_sensor_open", "dc_link_sensor_high_rail", "dc_link_sensor_gain"),
    "supply": ("supply_lost", "supply_surged"),
    "encoder": ("encoder_stuck", "encoder_jump", "encoder_reversed", "encoder_slip", "encoder_lost_counts",
                "encoder_noise", "encoder_no_answer"),
    "temperature sensors": tuple(f"{part}_temperature_sensor_{kind}" for part in ("winding", "inverter")
                                 for kind in ("open", "shorted", "stuck", "offset")),
    "processor": ("interrupt_lost", "background_hung"),
    "memory, program, registers, clock": ("limit_flipped", "constant_flipped", "state_flipped", "code_flipped",
                                          "stack_guard_flipped", "period_register_flipped", "clock_drift"),
}
"""Kinds of faults of the bench by the part of the drive that fails."""
NO_FAILURES = ("load_dropped", "supply_sagged")
"""Kinds that are no failure of a part: the drive has to run on."""
_TIME = re.compile(r", (?P<number>[\d.]+) (?P<unit>µs|ms)")


@dataclass
class Part:
    """Measured cells of a part. longest_ms: time to the first cause; undetected: cells by the name of the case."""

    cells: int = 0
    detected: int = 0
    not_measured: int = 0
    longest_ms: float = 0.0
    slowest: str = ""
    undetected: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    @property
    def percent(self) -> int:
        """Diagnostic coverage, rounded down."""
        return 100 * self.detected // self.cells if self.cells else 0


def table(text: str) -> dict[str, list[str]]:
    """Cells of the machines' tables by the name of the case."""
    cells: dict[str, list[str]] = defaultdict(list)
    names = {case.name for case in CASES}
    machines = [section for section in text.split("\n## ") if section.partition("\n")[0] in fault_table.MACHINES]
    for line in "\n".join(machines).splitlines():
        name, *row = (cell.strip() for cell in line.strip("| ").split(" | "))
        if name in names:
            cells[name] += row
    return cells


def part_of(case: FaultCase) -> str:
    """Part of the drive that fails; "" when the case is no failure."""
    if case.kind in NO_FAILURES or (case.kind == "supply_lost" and case.duration_s is not None):
        return ""
    return next(part for part, kinds in PARTS.items() if case.kind in kinds)


def parts(text: str) -> dict[str, Part]:
    """Coverage of each part by the measured page."""
    cells = table(text)
    found = {part: Part() for part in PARTS}
    for case in CASES:
        name = part_of(case)
        for cell in cells[case.name] if name else ():
            _count(found[name], case.name, cell)
    return found


def _count(part: Part, name: str, cell: str) -> None:
    if cell == "unsupported":
        part.not_measured += 1
        return
    part.cells += 1
    if cell.startswith("runs on"):
        part.undetected[name] += 1
        return
    part.detected += 1
    time = _TIME.search(cell)
    time_ms = float(time["number"]) * (1e-3 if time["unit"] == "µs" else 1.0) if time else 0.0
    if time_ms > part.longest_ms:
        part.longest_ms, part.slowest = time_ms, name


_HEAD = """# Diagnostic coverage

Generated from the measured [reactions to faults](drive-faults.md) by `tools/salient docs --generate`; do not edit.

A cell is one fault of one machine with one controller, at one operating point. The diagnostic coverage of a part is the
share of its cells that end in a fault of the drive. All faults of a part have equal weight here; with failure rates of
real parts another figure follows. It is no figure of a certified drive.
"""


def page(text: str) -> str:
    """The page, in Markdown. text: of the measured page."""
    found = parts(text)
    lines = [_HEAD, "| part | cells | detected | coverage, % | longest time, ms | not measured on the host |",
             "| --- | --- | --- | --- | --- | --- |"]
    for name, part in found.items():
        lines.append(f"| {name} | {part.cells} | {part.detected} | {part.percent} | {part.longest_ms:.3g}, "
                     f"{part.slowest} | {part.not_measured or '-'} |")
    cells, detected = sum(part.cells for part in found.values()), sum(part.detected for part in found.values())
    lines += [f"| all | {cells} | {detected} | {100 * detected // cells} | | "
              f"{sum(part.not_measured for part in found.values())} |", "", "## Not detected", "",
              "| fault | cells | reason |", "| --- | --- | --- |"]
    reasons = {case.name: case.unseen for case in CASES}
    lines += [f"| {name} | {number} | {reasons[name] or '-'} |" for part in found.values()
              for name, number in part.undetected.items()]
    return "\n".join([*lines, ""])


def write() -> None:
    """Writes the page."""
    PAGE.write_text(page(fault_table.PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def main() -> int:
    """Writes the page; returns the exit code."""
    write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
