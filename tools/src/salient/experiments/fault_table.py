"""Reactions of the drive to the faults of the test bench, measured: fault x controller x machine.

    python -m salient.experiments.fault_table [--jobs N]

runs every cell and writes docs/reference/drive-faults.md, with the longest times of campaign.branching. In each run the
drive starts, carries a load, and has the fault then, or had it before the start.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from salient.config import CONTROLLERS
from salient.errors import exit_code
from salient.experiments.campaign import branching
from salient.experiments.scaled import scale_of_name
from salient.experiments.scenario import FaultStep, LoadStep, Record, Scenario, SpeedStep, run_scenario
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.paths import REFERENCE, ROOT
from salient.workers import process_pool

PAGE = REFERENCE / "drive-faults.md"
BRANCHES = ROOT / "tests" / "campaign" / "branching"
MACHINES = ("saturating", "linear_cosine", "linear_trapezoid", "finite_element")
SPEED_RPM, LOAD_NM = 600.0, 12.0
AFTER_S = 0.35
"""Time for which a run goes on after the fault."""
_START_S, _SETTLED_S, _BEFORE_S, _RECORD_US = 0.02, 0.12, 0.001, 5.0


@dataclass(frozen=True)
class FaultCase:
    """A fault as it is asked for. at_standstill: it begins before the start. rated_torque: attribute torque_Nm in
    units of the machine's. unseen: why a drive may run on. unsupported: why the host cannot have the fault."""

    name: str
    kind: str
    arguments: dict[str, float | str] = field(default_factory=dict)
    at_standstill: bool = False
    duration_s: float | None = None
    rated_torque: float | None = None
    unseen: str = ""
    unsupported: str = ""


@dataclass(frozen=True)
class Reaction:
    """A reaction. fault: the first cause, "none" when it runs on. detected_s: from the start of the fault, or of
    the run when that is later, to the first cause, None without one. peak: largest true phase current after that begin,
    of the trip. travel_deg: largest rotation of the shaft from it to the first cause."""

    fault: str
    detected_s: float | None
    peak: float
    travel_deg: float


_SATURATED = "within a third of the other phases: the flux linkage of a saturated phase hardly depends on its current"
_PLAUSIBLE = "a reading in the range of the sensor is a temperature; the models of the currents remain"

CASES = (
    FaultCase("open winding", "winding_open", {"phase": "b"}),
    FaultCase("shorted turns, 10 %", "winding_shorted", {"phase": "b", "turns_percent": 10.0}),
    FaultCase("shorted turns, 50 %", "winding_shorted", {"phase": "b", "turns_percent": 50.0}),
    FaultCase("switch open, high", "switch_open", {"phase": "b", "leg": "high"}),
    FaultCase("switch open, low", "switch_open", {"phase": "b", "leg": "low"}),
    FaultCase("switch shorted, high", "switch_shorted", {"phase": "b", "leg": "high"}),
    FaultCase("switch shorted, low", "switch_shorted", {"phase": "b", "leg": "low"}),
    FaultCase("diode open, high", "diode_open", {"phase": "b", "leg": "high"}),
    FaultCase("gate supply lost", "gate_supply_lost", {"phase": "b"}),
    FaultCase("current sensor open", "current_sensor_open", {"phase": "b"}),
    FaultCase("current sensor stuck, middle", "current_sensor_stuck", {"phase": "b", "code": 800}),
    FaultCase("current sensor at its high rail", "current_sensor_high_rail", {"phase": "b"}),
    FaultCase("current sensor, gain 0.3", "current_sensor_gain", {"phase": "b", "gain": 0.3}),
    FaultCase("current sensor, gain 0.6", "current_sensor_gain", {"phase": "b", "gain": 0.6}, unseen=_SATURATED),
    FaultCase("current sensor, gain 0.75", "current_sensor_gain", {"phase": "b", "gain": 0.75}, unseen=_SATURATED),
    FaultCase("current sensor, gain 1.5", "current_sensor_gain", {"phase": "b", "gain": 1.5}, unseen=_SATURATED),
    FaultCase("current sensor, gain 3", "current_sensor_gain", {"phase": "b", "gain": 3.0}),
    FaultCase("current sensors swapped", "current_sensor_swapped", {"phase": "b", "with_phase": "c"}),
    FaultCase("current sensor open before the start", "current_sensor_open", {"phase": "b"}, at_standstill=True),
    FaultCase("link sensor open", "dc_link_sensor_open"),
    FaultCase("link sensor at its high rail", "dc_link_sensor_high_rail"),
    FaultCase("link sensor, gain 0.8", "dc_link_sensor_gain", {"gain": 0.8},
              unseen="all phases agree, and nothing else measures the DC link"),
    FaultCase("encoder stuck", "encoder_stuck"),
    FaultCase("encoder stuck before the start", "encoder_stuck", at_standstill=True),
    FaultCase("encoder jump of 1 deg", "encoder_jump", {"angle_deg": 1.0}),
    FaultCase("encoder jump of 5 deg", "encoder_jump", {"angle_deg": 5.0}),
    FaultCase("encoder jump of 180 deg", "encoder_jump", {"angle_deg": 180.0}),
    FaultCase("encoder reversed", "encoder_reversed"),
    FaultCase("encoder reversed before the start", "encoder_reversed", at_standstill=True),
    FaultCase("encoder slips, 60 deg/s", "encoder_slip", {"slip_deg_s": 60.0}),
    FaultCase("encoder loses counts, 5000 a turn", "encoder_lost_counts", {"counts_per_turn": 5000}),
    FaultCase("encoder noise, 1 deg", "encoder_noise", {"deviation_deg": 1.0}),
    FaultCase("encoder does not answer", "encoder_no_answer"),
    FaultCase("shaft locked", "shaft_locked"),
    FaultCase("shaft locked before the start", "shaft_locked", at_standstill=True),
    FaultCase("Coulomb friction of the rated torque", "coulomb_friction", rated_torque=1.0),
    FaultCase("load dropped", "load_dropped", unseen="no fault of the drive: it holds the speed"),
    FaultCase("supply lost", "supply_lost"),
    FaultCase("supply lost for 20 ms", "supply_lost", duration_s=0.02,
              unseen="the capacitor of the DC link bridges it"),
    FaultCase("supply sags by 20 %", "supply_sagged", {"depth_percent": 20.0},
              unseen="above the threshold of under-voltage: the drive uses what there is"),
    FaultCase("supply surges by 50 %", "supply_surged", {"height_percent": 50.0}),
    FaultCase("triggers lost for 30 ms", "interrupt_lost", duration_s=0.03),
    FaultCase("background hung for 30 ms", "background_hung", duration_s=0.03),
    FaultCase("temperature sensor of a winding open", "winding_temperature_sensor_open", {"phase": "b"}),
    FaultCase("temperature sensor of a winding shorted", "winding_temperature_sensor_shorted", {"phase": "b"}),
    FaultCase("temperature sensor of a winding stuck", "winding_temperature_sensor_stuck",
              {"phase": "b", "code": 20480}, unseen=_PLAUSIBLE),
    FaultCase("temperature sensor of a winding, -50 K", "winding_temperature_sensor_offset",
              {"phase": "b", "offset_K": -50.0}, unseen=_PLAUSIBLE),
    FaultCase("temperature sensor of switches open", "inverter_temperature_sensor_open", {"phase": "b"}),
    FaultCase("temperature sensor of switches shorted", "inverter_temperature_sensor_shorted", {"phase": "b"}),
    FaultCase("bit of the current trip flipped", "limit_flipped", {"bit": 12}),
    FaultCase("bit of a constant flipped", "constant_flipped", {"bit": 3064}),
    FaultCase("bit of the state flipped", "state_flipped", {"bit": 0}),
    FaultCase("bit of the program flipped", "code_flipped", {"byte": 0},
              unsupported="the program of the host is not the drive's alone; tests/hil/test_self_test.py flips it on "
                          "the Cortex-M4 and RV32"),
    FaultCase("guard word of the stack changed", "stack_guard_flipped", {"bit": 0},
              unsupported="the stack of the host belongs to its operating system; as the program"),
    FaultCase("bit of the timer's period flipped", "period_register_flipped", {"bit": 3}),
    FaultCase("clock 6 % off", "clock_drift", {"drift_percent": 6.0}),
)


def measure(case: FaultCase, machine: str, controller: str) -> Reaction:
    """Runs one cell."""
    scale, data = scale_of_name(machine), derive(load_machine(machine_path(machine)))
    speed_rpm = scale.rpm(SPEED_RPM)
    settled_s = _SETTLED_S + scale.delay_s(speed_rpm, _SETTLED_S)
    begin_s = 0.5 * _START_S if case.at_standstill else settled_s + 0.05
    since_s = max(begin_s, _START_S)
    arguments = dict(case.arguments)
    if case.rated_torque is not None:
        arguments["torque_Nm"] = scale.Nm(case.rated_torque * data.torque_rated_Nm / scale.torque)
    scenario = Scenario(
        name="fault", machine=machine, controller=controller, duration_s=since_s + AFTER_S,
        speed=(SpeedStep(_START_S, speed_rpm),), load=(LoadStep(settled_s, scale.Nm(LOAD_NM)),),
        fault=(FaultStep(case.kind, begin_s, case.duration_s, arguments),),
        record=Record(_RECORD_US, since_s - _BEFORE_S))
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        result = run_scenario(scenario, Path(folder))
        recording = result.recording
        assert recording is not None
        time_s = np.asarray(recording["time_s"])
        after = time_s >= since_s
        currents = [name for name in recording.dtype.names or () if name.startswith("current_")]
        peak_A = max(float(recording[name][after].max()) for name in currents)
        angle_deg = np.unwrap(np.asarray(recording["rotor_angle_deg"], dtype=float), period=360.0)
    cause = result.telemetry["DRIVE_FAULT_CAUSE.fault"]
    detected_s = None
    if len(cause):
        latched_s = result.telemetry["DRIVE_FAULT_CAUSE.time_us"].value[0].item() * 1e-6
        # A reset by the watchdog sets the drive's clock back: the time is the time of its first report.
        detected_s = max(0.0, (latched_s if latched_s > since_s - _BEFORE_S else cause.time_s[0].item()) - since_s)
    first = cause.between(-np.inf, cause.time_s[0] + 1e-9).last_name if len(cause) else "none"
    until_s = scenario.duration_s if detected_s is None else since_s + detected_s
    return Reaction(first, detected_s, peak_A / data.current_trip_A, float(np.ptp(angle_deg[time_s <= until_s])))


def text(case: FaultCase, reaction: Reaction) -> str:
    """A cell of the page."""
    result = "runs on" if reaction.detected_s is None else f"`{reaction.fault}`, {_time(reaction.detected_s)}"
    if case.at_standstill and case.kind.startswith("encoder"):
        result += f", {reaction.travel_deg:.1f}°"
    return f"{result}, {reaction.peak:.2f}"


def _time(time_s: float) -> str:
    return f"{time_s * 1e6:.0f} µs" if time_s < 9.995e-4 else f"{time_s * 1e3:.3g} ms"


def measured_text(case: FaultCase, machine: str, controller: str) -> str:
    """Runs one cell, if the host can have its fault."""
    return "unsupported" if case.unsupported else text(case, measure(case, machine, controller))


def _measure(cell: tuple[FaultCase, str, str]) -> str:
    return measured_text(*cell)


# --- The page ---

_INTRODUCTION = f"""\
# Reaction of the drive to faults

Measured and written by `python -m salient.experiments.fault_table`; do not edit.

[Faults of the test bench](bench-faults.md) explains the first column, [safety](../safety/protections.md) and
[phases and encoder](../safety/phases-and-encoder.md) the drive's causes.

Each cell is one run at 40 kHz with default parameters, a 12-bit converter and a 17-bit encoder. The fault begins at
{SPEED_RPM:g} r/min under {LOAD_NM:g} N m, or before a start to that speed, in phase b where it has a phase.
A cell has, in order:

1. the drive's first cause;
2. the time to it from the start of the fault or of the run;
3. the rotation until then, for an encoder that failed before the start;
4. the largest true phase current after the start of the fault, as a multiple of the trip.

After the first cause all switches are open. A current above 1.1 of the trip is then driven by the rotor through the
diodes, and no switch can end it. A reset by the watchdog is reported once the background runs.

Causes that a drive cannot tell apart have one name. A phase without current has an open winding, an open switch, no
gate supply or a dead sensor. A shaft that is locked within a period looks like a frozen encoder.
"""


def page(cells_of: dict[tuple[str, str, str], str]) -> str:
    """Text of the page; cells_of: by name of the case, machine and controller."""
    parts = [_INTRODUCTION]
    for machine in MACHINES:
        parts.append(f"\n## {machine}\n\n| fault | {' | '.join(CONTROLLERS)} |\n"
                     f"|{' --- |' * (1 + len(CONTROLLERS))}\n")
        parts += [f"| {case.name} | {' | '.join(cells_of[case.name, machine, name] for name in CONTROLLERS)} |\n"
                  for case in CASES]
    parts.append("\n## Reasons why a drive runs on\n\n| fault | reason |\n| --- | --- |\n")
    parts += [f"| {case.name} | {case.unseen} |\n" for case in CASES if case.unseen]
    parts.append("\n## Faults that the host cannot have\n\n| fault | reason |\n| --- | --- |\n")
    parts += [f"| {case.name} | {case.unsupported} |\n" for case in CASES if case.unsupported]
    return with_branches("".join(parts))


def with_branches(text: str) -> str:
    """A page with the section of the committed results of branching, its last one, rewritten."""
    head = text.partition(f"## {branching.HEADING}\n")[0].rstrip()
    return f"{head}\n\n{branching.section(branching.read(BRANCHES))}"


def main() -> int:
    """Measures all cells and writes the page."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.fault_table", description=__doc__)
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="simultaneous runs")
    options = parser.parse_args()
    every = [(case, machine, controller) for machine in MACHINES for case in CASES for controller in CONTROLLERS]
    found: dict[tuple[str, str, str], str] = {}
    with process_pool(options.jobs) as pool:
        for (case, machine, controller), cell in zip(every, pool.map(_measure, every), strict=True):
            found[case.name, machine, controller] = cell
            print(f"{len(found)}/{len(every)} {machine}, {controller}, {case.name}: {cell}", flush=True)
    PAGE.write_text(page(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
