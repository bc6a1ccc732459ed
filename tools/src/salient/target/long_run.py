"""Inputs with long control interrupts: lists of timed actions on a drive and its bench. What they run in QEMU shows how
far the computed bound is above it, executes nearly every instruction, and contradicts a wrong fact of the bound.

An input is a TOML file. An action is time in ms, name, and a value for actions that have one:

    machine = "saturating"
    controller = "salient"
    seed = 1
    initial_angle_deg = 0.0
    duration_ms = 60.0
    actions = [
        [0.0, "speed_rpm", 600.0],             # run command; torque_Nm: in torque mode
        [0.0, "parameter.smc_k", 2000.0],      # parameter of the drive, in its unit
        [20.5, "bench.load_torque_Nm", 8.0],   # rig variable of RIG_SET in rig.dbc
        [30.0, "commands", 20.0],              # burst of that many commands
        [40.0, "stop"],                        # or off, clear_fault, silence
    ]
"""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from salient.bench.bench import Bench
from salient.bench.drive import DriveError
from salient.bench.rig import RigError, bench_variables
from salient.config import CONTROLLERS, BenchConfig
from salient.errors import UsageError
from salient.paths import ROOT
from salient.target.isr_profile import IsrProfile, read_profile
from salient.toml_file import Table, TextFileError, any_number, checked, number, option, read_toml, validate

FOLDER = ROOT / "tests" / "target" / "long_runs"

_REQUESTS = ("stop", "off", "clear_fault")
_WITHOUT_VALUE = ("silence", *_REQUESTS)
_WITH_VALUE = ("speed_rpm", "torque_Nm", "commands")


@dataclass(frozen=True)
class Variant:
    """A configuration with a bound of its own. label: for tables."""

    label: str
    controller: str
    machine: str = "saturating"


VARIANTS = {
    **{controller: Variant(controller, controller) for controller in CONTROLLERS},
    **{f"{controller}_four_phases": Variant(f"{controller}, four phases", controller, "finite_element")
       for controller in CONTROLLERS},
}


@dataclass(frozen=True)
class Action:
    """value: None for actions without one."""

    at_ms: float
    what: str
    value: float | None = None


@dataclass(frozen=True)
class Input:
    """Actions in order of time; the board is the default BenchConfig's."""

    machine: str
    controller: str
    seed: int
    initial_angle_deg: float
    duration_ms: float
    actions: tuple[Action, ...]


# --- files ----------------------------------------------------------------------------------------------------------

def _is_action(what: str) -> bool:
    """The drive knows its parameters; they are checked when they are written."""
    scope, _, name = what.partition(".")
    return what in (*_WITH_VALUE, *_WITHOUT_VALUE) or scope == "parameter" or (
        scope == "bench" and name in bench_variables())


class _InputFile(Table):
    machine: Annotated[str, option("machine")]
    controller: Annotated[str, option("controller")]
    seed: Annotated[int, option("seed")]
    initial_angle_deg: Annotated[float, option("initial_angle_deg")]
    duration_ms: Annotated[float, number(0.0, 3.6e6)]
    actions: list[list[Any]]


class _ActionRow(Table):
    at_ms: Annotated[float, number(0.0, 3.6e6)]
    what: Annotated[str, checked("the name of an action", _is_action)]
    value: Annotated[float, any_number()] | None = None


def read_input(path: Path) -> Input:
    """Reads and checks a file; UsageError names file, key and the values allowed."""
    try:
        file = validate(_InputFile, read_toml(path))
        actions = tuple(_read_action(at, row) for at, row in enumerate(file.actions, start=1))
    except TextFileError as error:
        raise UsageError(f"{path}: {error}") from None
    return Input(file.machine, file.controller, file.seed, file.initial_angle_deg, file.duration_ms, actions)


def _read_action(row_number: int, row: list[Any]) -> Action:
    section = f"actions row {row_number}"
    if len(row) > len(_ActionRow.model_fields):
        raise TextFileError(f"{section}: must be time in ms, action and value")
    action = validate(_ActionRow, dict(zip(_ActionRow.model_fields, row, strict=False)), section)
    needs_value = action.what in _WITH_VALUE or "." in action.what
    if needs_value != (action.value is not None):
        raise TextFileError(f"{section}: {action.what}: {'requires a' if needs_value else 'has no'} value")
    return Action(action.at_ms, action.what, action.value)


# --- running --------------------------------------------------------------------------------------------------------

def profile(given: Input, **options: Any) -> IsrProfile:
    """Profile of the interrupts of an input. options: of BenchConfig, for another board or build."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        instructions, trace = Path(name) / "instructions", Path(name) / "trace"
        board = _board(given, instructions=instructions, execution=trace, **options)
        _run(given, board)
        return read_profile(instructions, trace, board.machine, board.build)


def _board(given: Input, **options: Any) -> BenchConfig:
    fields: dict[str, Any] = {"build": "cortex-m4", **options}
    return BenchConfig(machine=given.machine, controller=given.controller, seed=given.seed,
                            initial_angle_deg=given.initial_angle_deg, **fields)


def _run(given: Input, board: BenchConfig) -> None:
    with tempfile.TemporaryDirectory(prefix="salient-") as folder, Bench(board, f"unix:{folder}/can.sock") as bench:
        bench.rig.truth_period_us = 0
        for action in given.actions:
            bench.advance_to(round(action.at_ms * 1e6))
            _do(bench, action)
        bench.advance_to(round(given.duration_ms * 1e6))


def _do(bench: Bench, action: Action) -> None:
    what, value = action.what, 0.0 if action.value is None else action.value
    scope, _, name = what.partition(".")
    if what == "speed_rpm":
        bench.drive.speed_reference_rpm = value
    elif what == "torque_Nm":
        bench.drive.torque_reference_Nm = value
    elif scope == "bench":
        with contextlib.suppress(RigError):  # a rejected value has no effect
            bench.rig.set(name, value)
    elif scope == "parameter":
        with contextlib.suppress(DriveError):  # likewise
            bench.drive.parameters[name] = value
    elif what == "commands":
        for _ in range(int(value) if bench.drive.command_due_ns is not None else 0):
            bench.drive.send_command()
    elif what == "silence":
        bench.drive.silence()
    elif what in _REQUESTS:
        bench.drive.ask(what)
    else:
        raise UsageError(f"{what}: unknown action")


def committed(variant: str) -> Path:
    """The file of a variant."""
    return FOLDER / f"{variant}.toml"
