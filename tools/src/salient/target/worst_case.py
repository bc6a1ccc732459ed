"""Worst-case search for the control interrupt: an input is a list of timed actions on a drive and its bench; a random
search mutates inputs and keeps those whose longest interrupt takes more instructions.

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
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from salient.bench.bench import Bench
from salient.bench.drive import DriveError, ParameterRow
from salient.bench.emulator import parameter_table
from salient.bench.rig import RigError, bench_variables
from salient.bus.signals import signal_range
from salient.config import CONTROLLERS, BenchConfig
from salient.errors import UsageError
from salient.paths import ROOT
from salient.target.isr_profile import IsrProfile, read_profile
from salient.toml_file import Table, TextFileError, any_number, checked, number, option, read_toml, validate

FOLDER = ROOT / "tests" / "target" / "worst_case"

_REQUESTS = ("stop", "off", "clear_fault")
_WITHOUT_VALUE = ("silence", *_REQUESTS)
_WITH_VALUE = ("speed_rpm", "torque_Nm", "commands")
_FIXED_PARAMETERS = ("controller", "bp_mode")
"""Parameters that select another controller; the variant determines them."""
_DURATION_MS = (2.0, 120.0)
_TIME_STEP_MS = 0.025
_ACTIONS_MAX = 24
_COMMANDS_MAX = 40
_ELITE = 6
_WORKERS = 2


@dataclass(frozen=True)
class Variant:
    """A configuration with a separate worst case. label: for tables."""

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
    """Actions in order of time; the board is that of the default BenchConfig."""

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


def write_input(path: Path, found: Input) -> None:
    """Writes an input in the format of read_input, with all digits of its numbers."""
    rows = "".join(f'    [{a.at_ms!r}, "{a.what}"' + ("" if a.value is None else f", {a.value!r}") + "],\n"
                   for a in found.actions)
    path.write_text(
        "# Known worst case of the control interrupt; tools/salient pil --search searches for longer ones.\n"
        f'machine = "{found.machine}"\ncontroller = "{found.controller}"\n'
        f"seed = {found.seed}\ninitial_angle_deg = {found.initial_angle_deg!r}\n"
        f"duration_ms = {found.duration_ms!r}\nactions = [\n{rows}]\n", encoding="utf-8")


# --- running --------------------------------------------------------------------------------------------------------

def profile(given: Input, **options: Any) -> IsrProfile:
    """Profile of the interrupts of an input. options: of BenchConfig, for another board or build."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        instructions, trace = Path(name) / "instructions", Path(name) / "trace"
        board = _board(given, instructions=instructions, execution=trace, **options)
        _run(given, board)
        return read_profile(instructions, trace, board.machine, board.build)


def longest_interrupt(given: Input) -> int:
    """Instructions of the longest interrupt; faster than profile."""
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        instructions = Path(name) / "instructions"
        _run(given, _board(given, instructions=instructions))
        return int(np.fromfile(instructions, "<u4").max())


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


@lru_cache
def _rows(controller: str) -> dict[str, ParameterRow]:
    return {row.name: row for row in parameter_table(BenchConfig(controller=controller))}


# --- directed -------------------------------------------------------------------------------------------------------

def directed(variant: str) -> list[Input]:
    """Hand-written inputs with combinations of rare events. variant: key of VARIANTS."""
    of = VARIANTS[variant]
    reverse_rpm = -400.0 if of.controller == "salient" else 100.0
    quick = [Action(0.0, "bench.inertia_gain", 0.2), Action(1.0, "speed_rpm", 600.0)]
    lists = {
        "load step": [*quick, Action(40.0, "bench.load_torque_Nm", 8.0)],
        "maximum noise": [*quick, Action(5.0, "bench.current_noise_A", 10.0),
                             Action(20.0, "bench.load_torque_Nm", 15.0)],
        "every phase conducts": [*quick, Action(5.0, "bench.current_sensor_offset_A", 10.0),
                                 Action(20.0, "bench.load_torque_Nm", 15.0)],
        "every phase conducts, noisy": [*quick, Action(5.0, "bench.current_sensor_offset_A", 5.0),
                                        Action(5.0, "bench.current_noise_A", 5.0),
                                        Action(20.0, "bench.load_torque_Nm", 15.0)],
        "voltage sags": [*quick, Action(30.0, "bench.load_torque_Nm", 8.0),
                         Action(40.0, "bench.supply_voltage_V", 155.0), Action(50.0, "bench.supply_voltage_V", 290.0)],
        "voltage limit": [*quick[:-1], Action(0.0, "bench.supply_voltage_V", 160.0),
                             Action(1.0, "speed_rpm", 2000.0)],
        "reversal": [*quick, Action(30.0, "speed_rpm", reverse_rpm), Action(60.0, "speed_rpm", 600.0)],
        "noisy reversal with a torque reserve": [
            Action(0.0, "bench.inertia_gain", 0.2), Action(0.0, "bench.current_noise_A", 5.0),
            Action(0.3, "parameter.torque_reserve_Nm", 18.0), Action(1.0, "speed_rpm", 3000.0),
            Action(10.0, "speed_rpm", 5.0 * reverse_rpm), Action(13.0, "bench.flux_linkage_gain", 2.5)],
        "encoder jumps": [*quick, Action(40.0, "bench.encoder_fault", 2.0), Action(45.0, "bench.encoder_fault", 0.0),
                          Action(46.0, "off"), Action(46.5, "clear_fault"), Action(47.0, "speed_rpm", 600.0)],
        "run, fault, run": [*quick, Action(20.0, "off"), Action(20.3, "speed_rpm", 600.0), Action(30.0, "off"),
                            Action(30.3, "speed_rpm", 900.0), Action(40.0, "bench.interrupt_time_us", 80.0),
                            Action(41.0, "bench.interrupt_time_us", 0.0), Action(42.0, "off"),
                            Action(42.5, "clear_fault"), Action(43.0, "speed_rpm", 600.0)],
        "commands in a burst": [*quick, Action(20.0, "commands", 40.0), Action(30.0, "bench.load_torque_Nm", 8.0),
                                Action(30.0, "commands", 40.0)],
        "parameters while running": [*quick, Action(20.0, "parameter.torque_max_Nm", 40.0),
                                     Action(25.0, "parameter.current_limit_A", 79.0),
                                     Action(30.0, "bench.load_torque_Nm", 20.0)],
        "misaligned, eccentric": [Action(0.0, "bench.encoder_offset_deg", 3.0),
                                  Action(0.0, "bench.encoder_eccentricity_deg", 2.0), *quick,
                                  Action(40.0, "bench.load_torque_Nm", 8.0)],
    }
    return [Input(of.machine, of.controller, 1, 7.0, 80.0, tuple(actions)) for actions in lists.values()]


# --- search ---------------------------------------------------------------------------------------------------------

def search(variant: str, begin: Iterable[Input], seconds: float, seed: int,
           progress: Callable[[int, int], None] = lambda tried, longest: None) -> tuple[int, Input]:
    """Searches for the longest interrupt; returns its instructions and its input. Starts from `begin` and mutates the
    best inputs at random.

    seconds: of the wall clock, so the result depends on the computer; the instruction count of an input does not. The
    seed determines the sequence of mutations.
    """
    random_source = random.Random(f"{variant} {seed}")
    elite: list[tuple[int, Input]] = []
    waiting = list(begin)
    tried = 0
    end_s = time.monotonic() + seconds
    with ProcessPoolExecutor(_WORKERS, initializer=_leave_interrupts_to_parent) as workers:
        while waiting or time.monotonic() < end_s:
            while len(waiting) < _WORKERS * 4:
                parent = random_source.choice(elite)[1] if elite else directed(variant)[0]
                waiting.append(mutated(parent, random_source))
            batch, waiting = waiting[: _WORKERS * 4], waiting[_WORKERS * 4:]
            elite += zip(workers.map(longest_interrupt, batch), batch, strict=True)
            elite = sorted(elite, key=lambda found: -found[0])[:_ELITE]
            tried += len(batch)
            progress(tried, elite[0][0])
        return _pruned(*elite[0], workers)


def _pruned(longest: int, found: Input, workers: Executor) -> tuple[int, Input]:
    """Removes the actions that do not contribute, which shows the cause."""
    while True:
        shorter = [replace(found, actions=found.actions[:i] + found.actions[i + 1:])
                   for i, action in enumerate(found.actions) if not _fixed(action)]
        for count, one in zip(workers.map(longest_interrupt, shorter), shorter, strict=True):
            if count >= longest:
                longest, found = count, one
                break
        else:
            return longest, found


def _leave_interrupts_to_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def mutated(given: Input, source: random.Random) -> Input:
    """One to three mutations: adds, removes, moves or changes an action, or changes angle, seed or duration."""
    result = given
    for _ in range(source.randint(1, 3)):
        result = source.choice(_MUTATIONS)(result, source)
    ordered = tuple(sorted(result.actions, key=lambda action: action.at_ms))
    return replace(result, actions=ordered)


def _added(given: Input, source: random.Random) -> Input:
    if len(given.actions) >= _ACTIONS_MAX:
        return _removed(given, source)
    names = [f"bench.{name}" for name in bench_variables() if name != "truth_period_us"]
    names += [f"parameter.{name}" for name in _rows(given.controller) if name not in _FIXED_PARAMETERS]
    names += ["speed_rpm", "torque_Nm", "commands", "silence", *_REQUESTS] * 4
    action = Action(_time(given, source), source.choice(names))
    return replace(given, actions=(*given.actions, _with_value(given, action, source)))


def _removed(given: Input, source: random.Random) -> Input:
    removable = [i for i, action in enumerate(given.actions) if not _fixed(action)]
    if not removable:
        return given
    index = source.choice(removable)
    return replace(given, actions=given.actions[:index] + given.actions[index + 1:])


def _changed(given: Input, source: random.Random) -> Input:
    return _replaced(given, source, lambda action: _with_value(given, action, source))


def _moved(given: Input, source: random.Random) -> Input:
    return _replaced(given, source, lambda action: replace(action, at_ms=_time(given, source)))


def _restarted(given: Input, source: random.Random) -> Input:
    what = source.randrange(3)
    if what == 0:
        return replace(given, initial_angle_deg=round(source.uniform(0.0, 360.0), 2))
    if what == 1:
        return replace(given, seed=source.randrange(1000))
    last = max((action.at_ms for action in given.actions), default=0.0)
    low, high = max(_DURATION_MS[0], last + 1.0), _DURATION_MS[1]
    return replace(given, duration_ms=round(source.uniform(low, max(low, high)), 1))


def _replaced(given: Input, source: random.Random, change: Callable[[Action], Action]) -> Input:
    removable = [i for i, action in enumerate(given.actions) if not _fixed(action)]
    if not removable:
        return given
    index = source.choice(removable)
    return replace(given, actions=(*given.actions[:index], change(given.actions[index]), *given.actions[index + 1:]))


_MUTATIONS = (_added, _added, _removed, _changed, _changed, _moved, _restarted)


def _fixed(action: Action) -> bool:
    return action.what.partition(".")[2] in _FIXED_PARAMETERS


def _time(given: Input, source: random.Random) -> float:
    return round(source.randrange(round(given.duration_ms / _TIME_STEP_MS)) * _TIME_STEP_MS, 3)


def _with_value(given: Input, action: Action, source: random.Random) -> Action:
    """Sets a value of the action's range: random, at an end, or near the present one."""
    scope, _, name = action.what.partition(".")
    if action.what == "speed_rpm":
        low, high = -3000.0, 3000.0
    elif action.what == "torque_Nm":
        low, high = -40.0, 40.0
    elif action.what == "commands":
        low, high = 1.0, _COMMANDS_MAX
    elif scope == "bench":
        low, high = map(float, signal_range(bench_variables()[name]))
    elif scope == "parameter":
        row = _rows(given.controller)[name]
        low, high = row.minimum, row.maximum
    else:
        return action
    if action.value is not None and source.random() < 0.5:
        value = min(high, max(low, action.value + source.gauss(0.0, 0.1) * max(abs(action.value), 0.01 * (high - low))))
    elif source.random() < 0.3:
        value = source.choice((low, high))
    else:
        value = low + (high - low) * source.random() ** 2  # most ranges extend far beyond useful values
    return replace(action, value=float(f"{value:.6g}"))


# --- the command ----------------------------------------------------------------------------------------------------

def committed(variant: str) -> Path:
    """The file of the known worst case."""
    return FOLDER / f"{variant}.toml"


def search_and_write(seconds: float, seed: int) -> int:
    """Searches every variant, starting from the known worst case and the directed inputs; writes longer ones to FOLDER.
    Returns 0."""
    wrote = False
    for variant in VARIANTS:
        known = [read_input(committed(variant))] if committed(variant).exists() else []
        before = longest_interrupt(known[0]) if known else 0

        def progress(tried: int, longest: int, variant: str = variant) -> None:
            if sys.stdout.isatty():
                print(f"\r{variant}: {tried} inputs tried, longest {longest}", end="", flush=True)

        longest, found = search(variant, [*known, *directed(variant)], seconds, seed, progress)
        both = profile(found).sum_metrics()["max"]
        print(f"{chr(13) * sys.stdout.isatty()}{variant}: longest {longest}, before {before};"
              f" with the deferred interrupt of the same period up to {both}", flush=True)
        if longest > before or len(found.actions) < len(known[0].actions):
            FOLDER.mkdir(exist_ok=True)
            write_input(committed(variant), found)
            print(f"{variant}: written to {committed(variant).relative_to(ROOT)}", flush=True)
            wrote = True
    if wrote:
        print("update the baseline with: tools/salient pil --figures")
    return 0
