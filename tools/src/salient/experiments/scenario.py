"""Scenarios: references and loads of a drive over virtual time, from a TOML file to recording, log and summary.

    machine = "saturating"                  # name of a bundled machine or path of a machine file
    controllers = ["traditional", "paper"]  # one run each
    duration_s = 0.4
    load_profile = "compressor_one_cylinder"  # optional: torque over the rotor angle, tools/loads or path of a CSV file
    true_machine = "mine.toml"              # optional: the emulated machine, where it is not the firmware's
    seed = 1                                # optional, as everything below; other fields of
    control_rate_hz = 40000                 # salient.config.Conditions likewise, also in [drive] of the machine file

    [parameters]                            # parameters of the drive by name, in their units
    torque_max_Nm = 19.1

    [bench]                                 # variables of the rig (RIG_SET in rig.dbc), set at time 0
    current_noise_A = 0.02
    flux_linkage_gain = 1.05                # the machine differs from the tables of the drive

    [[speed]]                               # the first one requests the drive to run
    at_s = 0.0
    value_rpm = 600.0

    [[torque]]                              # from here on in torque mode, until the next [[speed]]
    at_s = 0.2
    value_Nm = 5.0

    [[position]]                            # in position mode, a move to an absolute position
    at_s = 0.3
    value_deg = 90.0

    [[load]]
    at_s = 0.13
    torque_Nm = 8.0
    profile_Nm = 2.0                        # optional: with a load_profile, the torque of its value 1

    [[fault]]                               # of the test bench, with its places and attribute: bench-faults.md
    kind = "switch_open"
    phase = "b"
    leg = "low"
    at_s = 0.2
    duration_s = 0.01                       # optional: without it to the end

    [record]                                # the true state; without the table nothing is recorded
    step_us = 1.0
    from_s = 0.0

`load_scenarios` returns one Scenario per controller, `run_scenario` runs one.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import numpy as np
from pydantic import create_model

from salient.bench.bench import Bench
from salient.bench.drive import READY_TIMEOUT_S
from salient.bench.emulator import parameter_table
from salient.bench.faults import FaultError, attribute_names, fault_signals
from salient.bench.load_profile import load_profile_path, read_load_profile
from salient.bench.rig import CHANGES_MAX, bench_variables, variable_range
from salient.bus.log import write_logs
from salient.bus.signals import SignalTable, drive_database, signal_range
from salient.config import CONDITIONS, CONTROLLERS, DEFAULTS, BenchConfig, Conditions, either
from salient.dbc import PHASES
from salient.errors import UsageError, close_names
from salient.experiments.consistency import check_consistency
from salient.experiments.metrics import losses
from salient.json_file import json_text
from salient.machine.cache import machine_image
from salient.machine.file import load_machine, machine_path
from salient.machine.path import stated_conditions
from salient.toml_file import Table, TextFileError, any_number, number, one_of, option, read_toml, shown_key, validate


@dataclass(frozen=True)
class SpeedStep:
    """Speed reference from at_s on."""

    at_s: float
    value_rpm: float


@dataclass(frozen=True)
class TorqueStep:
    """Torque reference from at_s on, in torque mode."""

    at_s: float
    value_Nm: float


@dataclass(frozen=True)
class PositionStep:
    """Target of a move from at_s on, in position mode."""

    at_s: float
    value_deg: float


@dataclass(frozen=True)
class LoadStep:
    """Load torque on the shaft from at_s on, positive against forward motion; profile_Nm: the rig's load_profile_Nm,
    None leaves it."""

    at_s: float
    torque_Nm: float
    profile_Nm: float | None = None


@dataclass(frozen=True)
class FaultStep:
    """A fault of the test bench from at_s on, for duration_s, None: to the end. arguments: places and attribute."""

    kind: str
    at_s: float
    duration_s: float | None = None
    arguments: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Record:
    """Recording of the true state every step_us microseconds from from_s on."""

    step_us: float = 1.0
    from_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Scenario(Conditions):
    """One run of one drive. Times in seconds of virtual time, not negative. load_profile: name of a bundled load
    profile or path of a CSV file (salient.bench.load_profile)."""

    name: str
    duration_s: float
    parameters: dict[str, float] = field(default_factory=dict)
    bench: dict[str, float] = field(default_factory=dict)
    speed: tuple[SpeedStep, ...] = ()
    torque: tuple[TorqueStep, ...] = ()
    position: tuple[PositionStep, ...] = ()
    load: tuple[LoadStep, ...] = ()
    load_profile: str | None = None
    fault: tuple[FaultStep, ...] = ()
    record: Record | None = None

    @property
    def plant(self) -> str:
        """The machine that the emulator has, by name or file."""
        return self.true_machine or self.machine


@dataclass(frozen=True)
class RunResult:
    """Results of a run.

    recording: structured array, one row per record.step_us (fields: emulator/plant/recorder.h), memory-mapped from
    recording_path; None when nothing was recorded.
    telemetry, truth: signals by name as received over CAN (salient.bus.signals.SignalTable).
    fault: the fault of the drive at the end, "none" without one.
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

_SETTING_NS = 1_000_000
"""The first command after the parameters is sent at a multiple of this, a cycle of telemetry; a set takes 5 ms."""
_RECORDING, _LOG, _TEXT_LOG = "recording.npy", "can.blf", "can.log"


def run_scenario(scenario: Scenario, out_dir: Path, can: str = "local", build: str = "host",
                 **options: Any) -> RunResult:
    """Runs a scenario in lock-step and writes recording.npy, can.blf and can.log to out_dir, which is made if needed.

    can: "local" for a new local bus, or "socketcan:INTERFACE". Virtual time 0 is the start of the drive; the variables
    of the rig are set first, then parameters are written, then commands follow. build, options: see BenchConfig.
    UsageError: a parameter that the drive does not know or refuses. DriveNotReady: a check keeps it from starting.
    """
    recording_path = out_dir / _RECORDING if scenario.record else None
    config = replace(_bench_config(scenario, recording_path, build), **options)
    _check_parameter_names(scenario, config)
    profile = read_load_profile(load_profile_path(scenario.load_profile)) if scenario.load_profile else ()
    out_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        with Bench(config, f"unix:{folder}/can.sock" if can == "local" else can) as bench:
            if profile:
                bench.rig.set_load_profile(profile)
            for name, value in scenario.bench.items():
                bench.rig.set(name, value)
            for load in scenario.load:
                bench.at(load.at_s).load_torque_Nm = load.torque_Nm
                if load.profile_Nm is not None:
                    bench.at(load.at_s).load_profile_Nm = load.profile_Nm
            for fault_step in scenario.fault:
                bench.at(fault_step.at_s).fault(fault_step.kind, duration_s=fault_step.duration_s,
                                                **fault_step.arguments)
            if scenario.parameters:  # one set; the run begins at the same time whatever the lengths of its frames
                bench.drive.parameters.update(scenario.parameters)
                bench.advance_to(-(-bench.time_ns // _SETTING_NS) * _SETTING_NS)
            steps: list[SpeedStep | TorqueStep | PositionStep] = [*scenario.speed, *scenario.torque, *scenario.position]
            for step in sorted(steps, key=lambda step: step.at_s):
                _advance(bench, step.at_s)
                if isinstance(step, SpeedStep):
                    bench.drive.speed_reference_rpm = step.value_rpm
                elif isinstance(step, TorqueStep):
                    bench.drive.torque_reference_Nm = step.value_Nm
                else:
                    bench.drive.position_deg = step.value_deg
            _advance(bench, scenario.duration_s)
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


def _advance(bench: Bench, to_s: float) -> None:
    """Lets virtual time pass; a drive that is commanded and not ready in time has failed."""
    if bench.time_s < READY_TIMEOUT_S <= to_s:
        bench.advance_to(round(READY_TIMEOUT_S * 1e9))
        if bench.drive.command_due_ns is not None:
            bench.drive.check_ready()
    bench.advance_to(round(to_s * 1e9))


def _bench_config(scenario: Scenario, recording_path: Path | None, build: str) -> BenchConfig:
    record = scenario.record or Record()
    return BenchConfig(
        **{name: getattr(scenario, name) for name in CONDITIONS},
        record=recording_path,
        record_step_ns=round(record.step_us * 1000),
        record_from_us=round(record.from_s * 1e6),
        build=build,
    )


def _check_parameter_names(scenario: Scenario, config: BenchConfig) -> None:
    """UsageError: the drive does not know a parameter of a scenario or would refuse its value."""
    if not scenario.parameters:
        return
    rows = {row.name: row for row in parameter_table(config)}
    for name, value in scenario.parameters.items():
        row = rows.get(name)
        if row is None:
            raise UsageError(f"parameters.{shown_key(name)}: unknown parameter; {close_names(name, rows)}")
        if not row.minimum <= value <= row.maximum:
            allowed = f"{row.minimum:g} to {row.maximum:g} {row.unit}".rstrip()
            raise UsageError(f"parameters.{name}: {value:g}: must be a number from {allowed}")


def summary(result: RunResult) -> dict[str, Any]:
    """Metrics of any run: speeds and torques over the recording (or, without one, the true state on CAN).

    With a recording also the losses over it (metrics.losses); with instruction timing also the longest control
    interrupt, the time available to it, and the number of late ones.
    """
    source: Any = result.recording
    if source is None:
        source = {name: result.truth[name].value for name in ("speed_rpm", "torque_Nm")}
    speed_rpm, torque_Nm = np.asarray(source["speed_rpm"]), np.asarray(source["torque_Nm"])
    metrics = {
        "max_speed_rpm": float(speed_rpm.max()),
        "final_speed_rpm": float(speed_rpm[-1]),
        "torque_max_Nm": float(torque_Nm.max()),
        "torque_min_Nm": float(torque_Nm.min()),
        "torque_mean_Nm": float(torque_Nm.mean(dtype=float)),
        "frames": result.telemetry.count("DRIVE_STATUS"),
        "fault": result.fault,
    }
    if result.scenario.position:
        metrics["position"] = _position_summary(result)
    worst_us = result.telemetry["DRIVE_PROCESSOR.worst_us"].last
    if worst_us > 0:
        metrics["processor"] = {
            "worst_us": worst_us,
            "available_us": result.telemetry["DRIVE_PROCESSOR.available_us"].last,
            "late_interrupts": int(result.telemetry["DRIVE_PROCESSOR.late_interrupts"].last),
        }
    if result.recording is not None and len(result.recording) > 1:
        window_s = (float(result.recording["time_s"][0]), float(result.recording["time_s"][-1]))
        metrics["losses"] = losses(result.recording, load_machine(machine_path(result.scenario.plant)), window_s)
    return metrics


def _position_summary(result: RunResult) -> dict[str, Any]:
    """Telemetry of a position: the last one, the largest following error, and the state at the end."""
    errors_deg = np.abs(np.asarray(result.telemetry["DRIVE_POSITION.following_error_deg"].value, dtype=float))
    return {
        "final_deg": result.telemetry["DRIVE_POSITION.position_deg"].last,
        "following_error_max_deg": float(errors_deg.max()) if len(errors_deg) else math.nan,
        "state": result.telemetry["DRIVE_POSITION.position_state"].last_name,
    }


def run_all(scenarios: list[Scenario], out_dir: Path, can: str = "local", build: str = "host",
            instruction_ns: int | None = None, progress: Callable[[str], None] = lambda line: None,
            source: Path | None = None) -> dict[str, RunResult]:
    """Runs the scenarios of one file, each into out_dir/CONTROLLER, and writes out_dir/results.json. build,
    instruction_ns: see BenchConfig; source: see check_parameters."""
    check_parameters(scenarios, build, source)
    results = {}
    for scenario in scenarios:
        progress(f"{scenario.name}: {scenario.controller}, {scenario.duration_s:g} s of virtual time")
        results[scenario.controller] = run_scenario(scenario, out_dir / scenario.controller, can, build,
                                                    instruction_ns=instruction_ns)
    write_summaries(scenarios, results, out_dir)
    return results


def check_parameters(scenarios: list[Scenario], build: str, source: Path | None = None) -> None:
    """UsageError before the first run: a parameter that the drive does not know or would refuse, parameters that
    contradict each other or the supply, or what the test bench would refuse (check_bench). source: the file that has
    the values, which the line names."""
    for scenario in scenarios:
        config = _bench_config(scenario, None, build)
        with _named(source):
            check_bench(scenario)
            _check_parameter_names(scenario, config)
            values = {row.name: row.default for row in parameter_table(config)} | scenario.parameters
            supply_V = load_machine(machine_path(scenario.plant)).supply_voltage_V
            check_consistency(values, scenario.parameters, scenario.bench.get("supply_voltage_V", supply_V))


@contextmanager
def _named(source: Path | None) -> Iterator[None]:
    """A UsageError of a value of a file names the file."""
    try:
        yield
    except UsageError as error:
        if source is None:
            raise
        raise UsageError(f"{source}: {error}") from None


def check_bench(scenario: Scenario) -> None:
    """UsageError, one line that begins with the key: a phase that the machine does not have, more changes than wait on
    the test bench, or a run of which nothing would be known."""
    phases = PHASES[:load_machine(machine_path(scenario.machine)).phases]
    for step in scenario.fault:
        if step.arguments.get("phase", phases[0]) not in phases:
            raise UsageError(f"fault.phase: {step.arguments['phase']!r}: must be {either(phases)}, the phases of "
                             f"{Path(scenario.machine).stem}")
    later = [load for load in scenario.load if round(load.at_s * 1e6) > 0]  # the others change at once
    waiting = {"load": len(later) + sum(load.profile_Nm is not None for load in later),
               "fault": sum((round(step.at_s * 1e6) > 0) + (step.duration_s is not None) for step in scenario.fault)}
    for key, changes in waiting.items():
        if changes > CHANGES_MAX:
            raise UsageError(f"{key}: {changes} changes after the start: must be at most {CHANGES_MAX}")
    record, duration_us = scenario.record, round(scenario.duration_s * 1e6)
    if record is not None and round(record.from_s * 1e6) >= duration_us:
        raise UsageError(f"record.from_s: {record.from_s:g}: must be below duration_s, {scenario.duration_s:g}")
    truth_us = scenario.bench.get("truth_period_us")
    if record is None and truth_us is not None and not 1.0 <= truth_us <= duration_us:
        raise UsageError(f"bench.truth_period_us: {truth_us:g}: without [record] must be a number from 1 to "
                         f"{duration_us}, the duration")


def write_summaries(scenarios: list[Scenario], results: dict[str, RunResult], out_dir: Path) -> None:
    """Writes out_dir/results.json for the runs of one file by controller."""
    content = {
        "schema": 1,
        "scenario": {key: value for key, value in asdict(scenarios[0]).items() if key != "controller"},
        "controllers": {controller: summary(result) for controller, result in results.items()},
    }
    (out_dir / "results.json").write_text(json_text(content, sort_keys=True), encoding="utf-8")


# --- reading --------------------------------------------------------------------------------------------------------

_Time = Annotated[float, number(0.0, 3600.0)]


class _SpeedTable(Table):
    at_s: _Time
    value_rpm: Annotated[float, number(-38_400.0, 38_400.0)]


class _TorqueTable(Table):
    at_s: _Time
    value_Nm: Annotated[float, number(-10_000.0, 10_000.0)]


class _PositionTable(Table):
    at_s: _Time
    value_deg: Annotated[float, number(-2_949_120.0, 2_949_119.0)]


class _LoadTable(Table):
    at_s: _Time
    torque_Nm: Annotated[float, number(-10_000.0, 10_000.0)]
    profile_Nm: Annotated[float | None, number(-200.0, 200.0)] = None


_FAULT_STEP = ("kind", "at_s", "duration_s")


@lru_cache
def _fault_table() -> type[Table]:
    """The model of a [[fault]]: any place and any attribute; which of them a kind has is checked afterwards."""
    fields: dict[str, Any] = {
        "kind": (str, ...),
        "at_s": (_Time, ...),
        "duration_s": (Annotated[float | None, number(1e-6, 3600.0)], None),
        **dict.fromkeys(("phase", "leg", *attribute_names()), (str | float | None, None)),
    }
    return create_model("fault", __base__=Table, **fields)


def _fault_steps(path: Path, tables: list[Any]) -> tuple[FaultStep, ...]:
    """UsageError for a fault, a place or an attribute that the test bench does not know."""
    steps = []
    for table in tables:
        values = table.model_dump(exclude_none=True)
        arguments = {name: value for name, value in values.items() if name not in _FAULT_STEP}
        try:
            fault_signals(table.kind, arguments, True, 0)
        except FaultError as error:
            raise UsageError(f"{path}: fault: {error}") from None
        steps.append(FaultStep(table.kind, table.at_s, table.duration_s, arguments))
    return tuple(steps)


class _RecordTable(Table):
    step_us: Annotated[float, number(0.1, 1e6)] = Record.step_us
    from_s: _Time = Record.from_s


@lru_cache
def _scenario_file() -> type[Table]:
    """The model of a file; the ranges of [bench] are from rig.dbc."""
    variables: dict[str, Any] = {name: (Annotated[float, number(*variable_range(name))], None)
                                 for name in bench_variables()}
    bench = create_model("bench", __base__=Table, **variables)
    kinds = get_type_hints(Conditions)
    options: dict[str, Any] = {name: (Annotated[kinds[name], option(name)], DEFAULTS[name])
                               for name in CONDITIONS if name not in ("machine", "true_machine", "controller")}
    fields: dict[str, Any] = {
        "machine": (Annotated[str, option("machine")], ...),
        "true_machine": (Annotated[str | None, option("true_machine")], None),
        "controllers": (list[Annotated[str, one_of(CONTROLLERS)]], ...),
        "duration_s": (Annotated[float, number(1e-3, 3600.0)], ...),
        **options,
        "parameters": (dict[str, Annotated[float, any_number()]], {}),
        "bench": (bench, bench()),
        "speed": (list[_SpeedTable], []),
        "torque": (list[_TorqueTable], []),
        "position": (list[_PositionTable], []),
        "load": (list[_LoadTable], []),
        "load_profile": (str, None),
        "fault": (list[_fault_table()], []),  # type: ignore[misc]
        "record": (_RecordTable, None),
    }
    return create_model("scenario", __base__=Table, **fields)


def _check_reference(path: Path, machine: str, name: str, key: str, value: float) -> None:
    """UsageError for a reference that the drive of the machine does not take."""
    message, signal = name.split(".")
    reference = drive_database(machine).get_message_by_name(message).get_signal_by_name(signal)
    low, high = signal_range(reference)
    if not low <= value <= high:
        raise UsageError(f"{path}: {key}: {value:g}: must be a number from {low:g} to {high:g} {reference.unit}")


def load_scenarios(path: Path) -> list[Scenario]:
    """Reads and checks a scenario file; returns one Scenario for each controller that it names.

    UsageError names file, key and the values allowed. The relative path of a machine file starts at the folder of the
    scenario.
    """
    try:
        data = read_toml(path)
        file: Any = validate(_scenario_file(), data)  # its fields follow from rig.dbc and Conditions
        _check_controllers(file.controllers)
    except TextFileError as error:
        raise UsageError(f"{path}: {error}") from None
    machine = _machine_of(path, file.machine)
    true_machine = None if file.true_machine is None else _machine_of(path, file.true_machine)
    with _named(path):
        machine_image(machine, true_machine)  # checks them
    for step in file.speed:
        _check_reference(path, machine, "DRIVE_COMMAND.speed_reference_rpm", "speed.value_rpm", step.value_rpm)
    for step in file.torque:
        _check_reference(path, machine, "DRIVE_TORQUE_COMMAND.torque_reference_Nm", "torque.value_Nm", step.value_Nm)
    profile = _load_profile_of(path, file.load_profile) if file.load_profile is not None else None
    common: dict[str, Any] = {name: getattr(file, name) for name in CONDITIONS if name in type(file).model_fields}
    common |= {name: value for name, value in stated_conditions(machine_path(machine)).items() if name not in data}
    common |= {
        "name": path.stem,
        "machine": machine,
        "true_machine": true_machine,
        "duration_s": file.duration_s,
        "parameters": file.parameters,
        "bench": {name: getattr(file.bench, name) for name in data.get("bench", {})},  # set in the order of the file
        "speed": tuple(SpeedStep(**step.model_dump()) for step in file.speed),
        "torque": tuple(TorqueStep(**step.model_dump()) for step in file.torque),
        "position": tuple(PositionStep(**step.model_dump()) for step in file.position),
        "load": tuple(LoadStep(**step.model_dump()) for step in file.load),
        "load_profile": profile,
        "fault": _fault_steps(path, file.fault),
        "record": None if file.record is None else Record(**file.record.model_dump()),
    }
    scenarios = [Scenario(controller=controller, **common) for controller in file.controllers]
    with _named(path):
        check_bench(scenarios[0])
    return scenarios


def with_true_machine(scenarios: list[Scenario], true_machine: str | None) -> list[Scenario]:
    """The scenarios of one file with another machine in the emulator, None for the file's. UsageError: the two do
    not fit."""
    if true_machine is None:
        return scenarios
    machine_image(scenarios[0].machine, true_machine)  # checks them
    return [replace(scenario, true_machine=true_machine) for scenario in scenarios]


def _machine_of(path: Path, name: str) -> str:
    """Name or path of a machine of a scenario file."""
    relative = path.parent / name
    return str(relative.resolve()) if relative.suffix == ".toml" else name


def _load_profile_of(path: Path, name: str) -> str:
    """Name or path of the load profile of a scenario file; it is read to be checked."""
    relative = path.parent / name
    profile = str(relative.resolve()) if relative.suffix == ".csv" else name
    with _named(path):
        read_load_profile(load_profile_path(profile))
    return profile


def _check_controllers(controllers: list[str]) -> None:
    if not controllers or len(set(controllers)) != len(controllers):
        raise TextFileError(f"controllers: must be a list of different values, each {either(CONTROLLERS)}")


def with_setting(scenario: Scenario, name: str, value: float) -> Scenario:
    """The scenario with a parameter or a variable of the bench set."""
    if name in bench_variables():
        return replace(scenario, bench={**scenario.bench, name: value})
    return replace(scenario, parameters={**scenario.parameters, name: value})
