"""Scenarios: what is asked of a drive over a stretch of virtual time, from a TOML file to recording, log and summary.

    machine = "saturating"                  # a shipped machine's name or the path of a machine file
    controllers = ["traditional", "paper"]  # one run each
    duration_s = 0.4
    seed = 1                                # optional, as everything below
    initial_angle_deg = 0.0
    control_rate_hz = 40000
    encoder_bits = 17                       # 0: ideal
    encoder_edges = false                   # true: the board captures the encoder's edges
    adc_bits = 12
    immediate_pwm = false                   # true: duties act at once, not in the next period

    [parameters]                            # the drive's parameters by name, in their units
    torque_max_Nm = 19.1

    [bench]                                 # the bench variables (RIG_SET in rig.dbc), set at time 0
    current_noise_A = 0.02
    flux_linkage_gain = 1.05                # the machine is another one than the drive's tables say

    [[speed]]                               # from the first of these the drive is asked to run
    at_s = 0.0
    value_rpm = 600.0

    [[load]]
    at_s = 0.13
    torque_Nm = 8.0

    [record]                                # the true state, for figures; without it nothing is recorded
    step_us = 1.0
    from_s = 0.0

`load_scenarios` gives one Scenario for each controller, `run_scenario` runs one.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import can
import numpy as np

from salient.bench.bench import Bench
from salient.bench.drive import DriveError, write_request
from salient.bench.emulator import SimulatorOptions, executable, parameter_table
from salient.bench.rig import bench_variables
from salient.bus.log import write_logs
from salient.bus.signals import SignalTable, drive_database
from salient.cli import ADC_BITS, CONTROL_RATES_HZ, CONTROLLERS, ENCODER_BITS
from salient.errors import UsageError
from salient.experiments.metrics import losses
from salient.machine.file import load_machine, machine_path
from salient.toml_file import TextFileError, read_toml


@dataclass(frozen=True)
class SpeedStep:
    """From at_s on the drive is asked for value_rpm."""

    at_s: float
    value_rpm: float


@dataclass(frozen=True)
class LoadStep:
    """From at_s on the bench loads the shaft with torque_Nm, positive against forward motion."""

    at_s: float
    torque_Nm: float


@dataclass(frozen=True)
class Record:
    """The true state every step_us microseconds from from_s on."""

    step_us: float = 1.0
    from_s: float = 0.0


@dataclass(frozen=True)
class Scenario:
    """One run of one drive. Times in seconds of virtual time, not negative."""

    name: str
    duration_s: float
    machine: str = "saturating"
    controller: str = "traditional"
    seed: int = 1
    initial_angle_deg: float = 0.0
    control_rate_hz: int = 40_000
    encoder_bits: int = 17
    encoder_edges: bool = False
    adc_bits: int = 12
    immediate_pwm: bool = False
    parameters: dict[str, float] = field(default_factory=dict)
    bench: dict[str, float] = field(default_factory=dict)
    speed: tuple[SpeedStep, ...] = ()
    load: tuple[LoadStep, ...] = ()
    record: Record | None = None


@dataclass(frozen=True)
class RunResult:
    """What a run left behind.

    recording: structured array, one row each record.step_us (fields: emulator/plant/recorder.h), memory-mapped from
    recording_path; None when nothing was recorded.
    telemetry, truth: signals by name as they went over CAN (salient.bus.signals.SignalTable).
    fault: the drive's fault at the end, "none" when it is well.
    """

    scenario: Scenario
    folder: Path
    log_path: Path
    text_log_path: Path
    recording_path: Path | None
    recording: np.ndarray | None
    telemetry: SignalTable
    truth: SignalTable
    fault: str


# --- running --------------------------------------------------------------------------------------------------------

_RECORDING, _LOG, _TEXT_LOG = "recording.npy", "can.blf", "can.log"


def run_scenario(scenario: Scenario, out_dir: Path, can: str = "local", build: str = "host",
                 instructions: Path | None = None, execution: Path | None = None,
                 instruction_ns: int | None = None) -> RunResult:
    """Runs a scenario in lock-step and leaves recording.npy, can.blf and can.log in out_dir, which is made if needed.

    can: "local" for a bus of its own, or "socketcan:INTERFACE". Virtual time 0 is the start of the drive; parameters
    are written first, then the commands follow; the bench variables are set before all. For build, instructions,
    execution, instruction_ns see SimulatorOptions. UsageError for what the drive does not know or refuses.
    """
    recording_path = out_dir / _RECORDING if scenario.record else None
    options = replace(_simulator_options(scenario, recording_path, build), instructions=instructions,
                      execution=execution, instruction_ns=instruction_ns)
    writes = _parameter_writes(scenario, options)
    out_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        with Bench(options, f"unix:{folder}/can.sock" if can == "local" else can) as bench:
            for name, value in scenario.bench.items():
                bench.rig.set(name, value)
            for write in writes:  # ahead of the first command; the answers are looked at in the end
                bench.send(write)
            for step in scenario.load:
                bench.at(step.at_s).load_torque_Nm = step.torque_Nm
            for step in sorted(scenario.speed, key=lambda step: step.at_s):
                bench.advance_to(round(step.at_s * 1e9))
                bench.drive.speed_reference_rpm = step.value_rpm
            bench.advance_to(round(scenario.duration_s * 1e9))
            _check_parameters_taken(bench, len(writes))
            fault = bench.drive.fault
        write_logs(bench.log, out_dir / _LOG, out_dir / _TEXT_LOG)
    return RunResult(
        scenario=scenario,
        folder=out_dir,
        log_path=out_dir / _LOG,
        text_log_path=out_dir / _TEXT_LOG,
        recording_path=recording_path,
        recording=np.load(recording_path, mmap_mode="r") if recording_path else None,
        telemetry=bench.telemetry,
        truth=bench.truth,
        fault=fault,
    )


def _simulator_options(scenario: Scenario, recording_path: Path | None, build: str) -> SimulatorOptions:
    record = scenario.record or Record()
    return SimulatorOptions(
        machine=scenario.machine,
        controller=scenario.controller,
        control_rate_hz=scenario.control_rate_hz,
        encoder_bits=scenario.encoder_bits,
        encoder_edges=scenario.encoder_edges,
        adc_bits=scenario.adc_bits,
        immediate_pwm=scenario.immediate_pwm,
        seed=scenario.seed,
        initial_angle_deg=scenario.initial_angle_deg,
        record=recording_path,
        record_step_ns=round(record.step_us * 1000),
        record_from_us=round(record.from_s * 1e6),
        build=build,
    )


def _parameter_writes(scenario: Scenario, options: SimulatorOptions) -> list[can.Message]:
    """The frames that write the scenario's parameters; UsageError for what the drive does not know or would refuse."""
    if not scenario.parameters:
        return []
    rows = {row.name: row for row in parameter_table(options)}
    writes = []
    for name, value in scenario.parameters.items():
        row = rows.get(name)
        if row is None:
            raise UsageError(f"parameters.{name}: the drive has no such parameter; allowed: {', '.join(rows)}")
        if not row.minimum <= value <= row.maximum:
            allowed = f"{row.minimum:g} to {row.maximum:g} {row.unit}".rstrip()
            raise UsageError(f"parameters.{name}: {value:g}: allowed are {allowed}")
        writes.append(write_request(row, value))
    return writes


def _check_parameters_taken(bench: Bench, count: int) -> None:
    message = drive_database().get_message_by_name("PARAMETER_RESPONSE")
    answers = [m for _, m in bench.log if m.arbitration_id == message.frame_id and not m.is_extended_id]
    refused = [a for a in answers if message.decode(bytes(a.data))["status"] != "done"]
    if refused or len(answers) != count:
        raise DriveError(f"{count} parameters written, {len(answers)} answers, {len(refused)} of them refusals")


def summary(result: RunResult) -> dict[str, Any]:
    """Figures of a run in general: speeds and torques over the recording (or, without one, the true state on CAN).

    With a recording also its losses (metrics.losses), from its first row to its last; of a processor that takes time
    also the control interrupt's longest, what it has, and how many were late.
    """
    source: Any = result.recording
    if source is None:
        source = {name: result.truth[name].value for name in ("speed_rpm", "torque_Nm")}
    speed_rpm, torque_Nm = np.asarray(source["speed_rpm"]), np.asarray(source["torque_Nm"])
    figures = {
        "max_speed_rpm": float(speed_rpm.max()),
        "final_speed_rpm": float(speed_rpm[-1]),
        "torque_max_Nm": float(torque_Nm.max()),
        "torque_min_Nm": float(torque_Nm.min()),
        "torque_mean_Nm": float(torque_Nm.mean(dtype=float)),
        "frames": result.telemetry.count("DRIVE_STATUS"),
        "fault": result.fault,
    }
    worst_us = result.telemetry["DRIVE_PROCESSOR.worst_us"].last
    if worst_us > 0:
        figures["processor"] = {
            "worst_us": worst_us,
            "available_us": result.telemetry["DRIVE_PROCESSOR.available_us"].last,
            "late_interrupts": int(result.telemetry["DRIVE_PROCESSOR.late_interrupts"].last),
        }
    if result.recording is not None and len(result.recording) > 1:
        window_s = (float(result.recording["time_s"][0]), float(result.recording["time_s"][-1]))
        figures["losses"] = losses(result.recording, load_machine(machine_path(result.scenario.machine)), window_s)
    return figures


def run_all(scenarios: list[Scenario], out_dir: Path, can: str = "local", build: str = "host",
            instruction_ns: int | None = None,
            progress: Callable[[str], None] = lambda line: None) -> dict[str, RunResult]:
    """Runs the scenarios of one file, each into out_dir/CONTROLLER, and writes out_dir/results.json. build,
    instruction_ns: see SimulatorOptions."""
    check_parameters(scenarios, build)
    results = {}
    for scenario in scenarios:
        progress(f"{scenario.name}: {scenario.controller}, {scenario.duration_s:g} s of virtual time")
        results[scenario.controller] = run_scenario(scenario, out_dir / scenario.controller, can, build,
                                                    instruction_ns=instruction_ns)
    write_summaries(scenarios, results, out_dir)
    return results


def check_parameters(scenarios: list[Scenario], build: str) -> None:
    """UsageError for parameters that the drive does not know or would refuse, before the first run."""
    for scenario in scenarios:
        _parameter_writes(scenario, _simulator_options(scenario, None, build))


def write_summaries(scenarios: list[Scenario], results: dict[str, RunResult], out_dir: Path) -> None:
    """Writes out_dir/results.json for the runs of one file by controller."""
    content = {
        "schema": 1,
        "scenario": {key: value for key, value in asdict(scenarios[0]).items() if key != "controller"},
        "controllers": {controller: summary(result) for controller, result in results.items()},
    }
    text = json.dumps(content, indent=2, sort_keys=True) + "\n"
    (out_dir / "results.json").write_text(text, encoding="utf-8")


# --- reading --------------------------------------------------------------------------------------------------------

# Key -> (smallest, largest) or the values allowed.
_DURATION_S = (1e-3, 3600.0)
_SEED = (0, 2**63 - 1)
_STEPS: dict[str, dict[str, tuple[float, float]]] = {
    "speed": {"at_s": (0.0, 3600.0), "value_rpm": (-3000.0, 3000.0)},
    "load": {"at_s": (0.0, 3600.0), "torque_Nm": (-200.0, 200.0)},
}
_RECORD = {"step_us": (0.1, 1e6), "from_s": (0.0, 3600.0)}
_TOP = ("machine", "controllers", "duration_s", "seed", "initial_angle_deg", "control_rate_hz", "encoder_bits",
        "encoder_edges", "adc_bits", "immediate_pwm", "parameters", "bench", "speed", "load", "record")  # fmt: skip


def load_scenarios(path: Path) -> list[Scenario]:
    """Reads and checks a scenario file; one Scenario for each controller it names.

    UsageError names file, key and what is allowed. A relative path of a machine file is taken from the scenario's
    folder.
    """
    try:
        data = read_toml(path)
    except TextFileError as error:
        raise UsageError(f"{path}: {error}") from None
    reader = _Reader(path)
    reader.known_keys("", data, _TOP)
    for key in ("machine", "controllers", "duration_s"):
        if key not in data:
            raise UsageError(f"{path}: {key}: missing")
    if not isinstance(data["machine"], str):
        raise UsageError(f"{path}: machine: {data['machine']!r} is not the name of a machine or of its file")
    beside = path.parent / data["machine"]
    machine = str(beside.resolve()) if beside.suffix == ".toml" else data["machine"]
    record = reader.table("record", data.get("record", {}), _RECORD)
    parameters = data.get("parameters", {})
    if not isinstance(parameters, dict):
        raise UsageError(f"{path}: parameters: a table [parameters] is wanted")
    common: dict[str, Any] = {
        "name": path.stem,
        "machine": machine,
        "duration_s": reader.number("duration_s", data["duration_s"], *_DURATION_S),
        "seed": reader.whole("seed", data.get("seed", 1), *_SEED),
        "initial_angle_deg": reader.number("initial_angle_deg", data.get("initial_angle_deg", 0.0), -360.0, 360.0),
        "control_rate_hz": reader.one_of("control_rate_hz", data.get("control_rate_hz", 40_000), CONTROL_RATES_HZ),
        "encoder_bits": reader.one_of("encoder_bits", data.get("encoder_bits", 17), ENCODER_BITS),
        "encoder_edges": reader.switch("encoder_edges", data.get("encoder_edges", False)),
        "adc_bits": reader.one_of("adc_bits", data.get("adc_bits", 12), ADC_BITS),
        "immediate_pwm": reader.switch("immediate_pwm", data.get("immediate_pwm", False)),
        "parameters": {key: reader.number(f"parameters.{key}", value) for key, value in parameters.items()},
        "bench": reader.table("bench", data.get("bench", {}), _bench_ranges()),
        "speed": tuple(SpeedStep(**step) for step in reader.steps("speed", data.get("speed", []))),
        "load": tuple(LoadStep(**step) for step in reader.steps("load", data.get("load", []))),
        "record": Record(**record) if "record" in data else None,
    }
    controllers = data["controllers"]
    if not isinstance(controllers, list) or not controllers or len(set(map(str, controllers))) != len(controllers):
        raise UsageError(f"{path}: controllers: a list of different ones of {', '.join(CONTROLLERS)} is wanted")
    for controller in controllers:
        reader.one_of("controllers", controller, CONTROLLERS)
    executable(machine)
    return [Scenario(controller=controller, **common) for controller in controllers]


def _bench_ranges() -> dict[str, tuple[float, float]]:
    return {name: (signal.minimum, signal.maximum) for name, signal in bench_variables().items()}


class _Reader:
    """Checks values; every mistake names file and key."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def known_keys(self, section: str, table: dict, allowed: tuple[str, ...]) -> None:
        for key in table:
            if key not in allowed:
                name = f"{section}.{key}" if section else key
                raise UsageError(f"{self._path}: {name}: unknown key; allowed: {', '.join(allowed)}")

    def number(self, key: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise UsageError(f"{self._path}: {key}: {value!r} is not a number")
        if not low <= value <= high:
            raise UsageError(f"{self._path}: {key}: {value:g}: allowed are {low:g} to {high:g}")
        return float(value)

    def whole(self, key: str, value: Any, low: int, high: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise UsageError(f"{self._path}: {key}: {value!r} is not a whole number from {low} to {high}")
        return value

    def switch(self, key: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise UsageError(f"{self._path}: {key}: {value!r} is not true or false")
        return value

    def one_of(self, key: str, value: Any, allowed: tuple) -> Any:
        if isinstance(value, bool) or value not in allowed:
            names = ", ".join(map(str, allowed))
            raise UsageError(f"{self._path}: {key}: {value!r}: allowed are {names}")
        return value

    def table(self, section: str, table: Any, ranges: dict[str, tuple[float, float]]) -> dict[str, float]:
        if not isinstance(table, dict):
            raise UsageError(f"{self._path}: {section}: a table [{section}] is wanted")
        self.known_keys(section, table, tuple(ranges))
        return {key: self.number(f"{section}.{key}", value, *ranges[key]) for key, value in table.items()}

    def steps(self, section: str, steps: Any) -> list[dict[str, float]]:
        if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
            raise UsageError(f"{self._path}: {section}: tables [[{section}]] are wanted")
        ranges = _STEPS[section]
        checked = [self.table(section, step, ranges) for step in steps]
        for step in checked:
            for key in ranges:
                if key not in step:
                    raise UsageError(f"{self._path}: {section}.{key}: missing")
        return checked
