"""pytest plugin: the fixtures `bench` and `make_bench`.

    @pytest.mark.bench_options(machine="linear_cosine", controller="paper", seed=7)
    def test_something(bench):
        bench.drive.speed_reference_rpm = 600
        bench.run_for(0.1)

`bench` is one drive with its test bench; `make_bench(**options)` starts any number of them, one after the other or (on
local buses) simultaneously. The options are the fields of BenchConfig; control rate and sensors that a test does not
state come from [drive] of the machine file, as with `sim`. A test that fails, in its set-up, its call or its
teardown, leaves a folder that the failure message names: logs, plots, true state, seed and replay command.

Marks: `bench_each(machine=[...], controller=[...], target=[...])`, the test runs once for each combination, as with
--salient-machine, --salient-controller and --salient-target do all tests that do not state these; `both_transports`,
the test is also run over real SocketCAN; `socketcan`, the test requires an interface.

With --salient-can BUS the drive is the one that is on this bus already, a real one or another process: tests that need
the test bench are skipped. With an interface, tests of the two marks for transports start their emulator on it.
"""

from __future__ import annotations

import itertools
import os
import re
import shlex
import sys
import zlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType
from typing import Any

import pluggy
import pytest

from salient.bench import failure
from salient.bench.bench import Bench
from salient.bench.session import Session
from salient.config import CONTROLLERS, HOST_BUILDS, TARGET_BUILDS, TARGETS, WASM_BUILD
from salient.errors import UsageError
from salient.json_file import json_text
from salient.machine.cache import bench_config, check_options
from salient.paths import COMMAND
from salient.tab.link import link_of

_AXES = {"machine": "machine", "controller": "controller", "target": "build"}
"""Parameters of tests: keyword of bench_each -> option of a bench."""
_OF_THE_BENCH = frozenset(("rig", "rigs", "truth", "at", "fault", "clear_fault", "load_torque_Nm", "held_speed_rpm",
                           "simulator", "options"))
"""Attributes of `bench` that a drive without its test bench has not."""
_OF_ANY_DRIVE = frozenset(("machine", "node"))
"""Options that only describe a drive."""
_CHANGES_SHOWN, _STIMULI_SHOWN = 8, 40


@dataclass
class _State:
    """State of a test. folder: what its first failure has left; saved: the benches with their folders there."""

    benches: list[Session] = field(default_factory=list)
    recordings: dict[int, Path] = field(default_factory=dict)
    folder: Path | None = None
    saved: dict[int, Path] = field(default_factory=dict)


_FOLDER_NAME_MAX = 200
"""Characters of the name of a folder; a file system takes 255 bytes, with the checksum and the phase of a test."""
_state_key = pytest.StashKey[_State]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("salient")
    group.addoption("--salient-can", default="local", metavar="BUS",
                    help="local (default): a local bus and an emulator for each bench; or the bus of a drive that runs "
                    "already, without a test bench: unix:PATH or socketcan:INTERFACE")
    group.addoption("--salient-build", default="host", choices=(*HOST_BUILDS, *TARGET_BUILDS, WASM_BUILD),
                    help="build under test (default host)")
    group.addoption("--salient-program", type=Path, metavar="FILE",
                    help="executable under test: firmware of your own joined with the emulator")
    group.addoption("--salient-machine", action="append", default=[], metavar="NAME|FILE",
                    help="machine of tests that do not state one; may be repeated")
    group.addoption("--salient-controller", action="append", default=[], choices=CONTROLLERS,
                    help="controller of tests that do not state one; may be repeated")
    group.addoption("--salient-target", action="append", default=[], choices=TARGETS,
                    help="processor of tests that do not state one; may be repeated")
    group.addoption("--salient-failures", metavar="DIR",
                    help="parent of the folders that failed tests leave (default build/failures in pytest's root)")


def pytest_configure(config: pytest.Config) -> None:
    can, program = config.getoption("--salient-can"), config.getoption("--salient-program")
    if can != "local" and not re.fullmatch(r"(unix|socketcan):\S+", can):
        raise pytest.UsageError(f"--salient-can {can}: must be local, unix:PATH or socketcan:INTERFACE")
    if program is not None and not os.access(program, os.X_OK):
        raise pytest.UsageError(f"--salient-program {program}: must be an executable file")
    for line in ("bench_options(**options): fields of BenchConfig for the fixture bench",
                 "bench_each(machine=[...], controller=[...], target=[...]): once for each combination",
                 "both_transports: the test is also run over SocketCAN",
                 "socketcan: the test requires --salient-can socketcan:INTERFACE"):
        config.addinivalue_line("markers", line)


# --- which tests run, and how often ---------------------------------------------------------------------------------

def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrises tests by machine, controller and target."""
    if "bench_choice" not in metafunc.fixturenames:
        return
    stated: dict[str, Any] = {}
    for mark in metafunc.definition.iter_markers("bench_options"):
        stated |= mark.kwargs
    axes: dict[str, list[str]] = {}
    for mark in metafunc.definition.iter_markers("bench_each"):
        for name, values in mark.kwargs.items():
            if name not in _AXES:
                raise pytest.UsageError(f"{metafunc.definition.nodeid}: bench_each has no {name}; it has "
                                        f"{', '.join(_AXES)}")
            axes.setdefault(name, list(values))
    for name, option in _AXES.items():
        values = metafunc.config.getoption(f"--salient-{name}")
        if values and name not in axes and option not in stated:
            axes[name] = values
    if axes:
        choices = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
        metafunc.parametrize("bench_choice", choices, indirect=True,
                             ids=["-".join(Path(value).stem for value in choice.values()) for choice in choices])


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselects tests that are for another transport, and skips those that need a test bench where there is none."""
    bus = config.getoption("--salient-can")
    deselected = [item for item in items if item.get_closest_marker("socketcan") and not bus.startswith("socketcan:")]
    if deselected:
        config.hook.pytest_deselected(items=deselected)
        items[:] = [item for item in items if item not in deselected]
    for item in items:
        if bus != "local" and not _starts_emulator(item) and (reason := _needs_bench(item)):
            item.add_marker(pytest.mark.skip(reason=f"needs the test bench ({reason}), and on {bus} there is a drive "
                                             "alone"))


def _starts_emulator(item: pytest.Item) -> bool:
    """True unless the drive is on the bus of this run already."""
    bus = item.config.getoption("--salient-can")
    marked = item.get_closest_marker("both_transports") or item.get_closest_marker("socketcan")
    return bus == "local" or bool(bus.startswith("socketcan:") and marked)


def _needs_bench(item: pytest.Item) -> str:
    """Name that a test uses and only a test bench has, as far as its code shows; "" for nothing."""
    if not isinstance(item, pytest.Function) or "make_bench" not in item.fixturenames:
        return ""
    options = {name for mark in item.iter_markers("bench_options") for name in mark.kwargs} - _OF_ANY_DRIVE
    used = sorted(options.union(*(mark.kwargs for mark in item.iter_markers("bench_each"))))
    if used:
        return f"option {used[0]}"
    used = sorted(_names(item.function.__code__) & _OF_THE_BENCH - {"fault"})  # a drive has one, too
    return f"bench.{used[0]}" if used else ""


def _names(code: CodeType) -> set[str]:
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


# --- fixtures -------------------------------------------------------------------------------------------------------

class DriveOnBus(Session):
    """A session with a drive that runs by itself, without a test bench. A test that uses the bench is skipped."""

    def __init__(self, can: str, machine: str | None, node: int) -> None:
        def is_alive() -> bool:
            raise UsageError(f"--salient-can {can}: no frame for a second; is there a drive?")

        super().__init__(can, lockstep=False, is_alive=is_alive, machine=machine, node=node,
                         machine_option="--salient-machine")
        self._refuses_bench = True

    def release(self) -> None:
        """From here on the signals of a test bench, of which there are none, can be read, to save them."""
        self._refuses_bench = False

    def __getattribute__(self, name: str) -> Any:
        if name in _OF_THE_BENCH and object.__getattribute__(self, "__dict__").get("_refuses_bench"):
            pytest.skip(f"needs the test bench (bench.{name}), and on {self.address} there is a drive alone")
        return super().__getattribute__(name)


@pytest.fixture
def bench_choice(request: pytest.FixtureRequest) -> dict[str, str]:
    """Machine, controller and target of a test that is parametrised by them."""
    return getattr(request, "param", {})


@pytest.fixture
def make_bench(request: pytest.FixtureRequest, tmp_path: Path, bench_choice: dict[str, str]
               ) -> Iterator[Callable[..., Any]]:
    """Starts benches: make_bench(machine=..., controller=..., seed=...). can: a bus other than the run's."""
    state = request.node.stash.setdefault(_state_key, _State())
    bus = request.config.getoption("--salient-can")
    defaults = {"build": request.config.getoption("--salient-build"),
                "program": request.config.getoption("--salient-program"),
                **{_AXES[name]: value for name, value in bench_choice.items()}}
    starts_emulator = _starts_emulator(request.node)

    def make(can: str | None = None, **options: Any) -> Any:
        check_options(options)
        if not starts_emulator and can is None:
            session = DriveOnBus(bus, options.get("machine"), options.get("node", 0))
            state.benches.append(session)
            return session
        number = len(state.benches)
        recording = None
        if "record" not in options:
            recording = tmp_path / f"recording{number}.npy"
            options |= {"record": recording, "record_step_ns": failure.RECORD_STEP_NS}
        if can is None:
            can = f"unix:{tmp_path}/can{number}.sock" if bus == "local" else bus
        made = Bench(bench_config(defaults | options), can)
        state.benches.append(made)
        if recording:
            state.recordings[number] = recording
        return made

    yield make
    errors = []
    for number, bench in enumerate(state.benches):
        try:
            bench.close()
        except Exception as error:
            errors.append(error)
        if number in state.saved and number in state.recordings:  # complete now
            failure.save_truth(state.recordings[number], state.saved[number])
    if errors:
        raise errors[0]


@pytest.fixture
def bench(request: pytest.FixtureRequest, make_bench: Callable[..., Bench]) -> Bench:
    """One drive and its test bench at virtual time 0, with the options of the mark bench_options."""
    mark = request.node.get_closest_marker("bench_options")
    return make_bench(**(mark.kwargs if mark else {}))


# --- failures -------------------------------------------------------------------------------------------------------

@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]
                              ) -> Generator[None, pluggy.Result[pytest.TestReport], None]:
    outcome = yield
    report = outcome.get_result()
    if report.failed and "make_bench" in getattr(item, "fixturenames", ()):
        try:
            lines = _save(item, report)
        except Exception as error:  # must not hide the failure of the test
            lines = [f"nothing saved: {error!r}"]
        report.sections.append(("salient bench", "\n".join(lines)))
    if call.when == "teardown" and _state_key in item.stash:
        for recording in item.stash[_state_key].recordings.values():
            recording.unlink(missing_ok=True)
        del item.stash[_state_key]  # pytest keeps the items of a run to its end: the benches would stay with their logs


def _folder_name(test: str) -> str:
    """The folder of a test's failures, its name with "_" between the parts. A parameter with other characters, as +1
    beside 1, or a name longer than a file system takes, has a checksum besides: no test shares a folder."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", test).strip("_")
    if len(name) <= _FOLDER_NAME_MAX and re.fullmatch(r"[^\[]*(\[[A-Za-z0-9_.-]+\])?", test):
        return name
    return f"{name[:_FOLDER_NAME_MAX]}_{zlib.crc32(test.encode()):08x}"


def _save(item: pytest.Item, report: pytest.TestReport) -> list[str]:
    """Writes the folder of a failure; the lines tell of it. A failure of the teardown after another one adds its error
    alone, in a folder of its own."""
    state = item.stash.setdefault(_state_key, _State())
    parent = Path(item.config.getoption("--salient-failures") or item.config.rootpath / "build" / "failures")
    name = _folder_name(item.nodeid)
    folder = parent.absolute() / (name if state.folder is None else f"{name}_{report.when}")
    command = _replay(item)
    notes = {"test": item.nodeid, "phase": report.when, "replay": command, "replay_in": str(item.config.rootpath)}
    folder.mkdir(parents=True, exist_ok=True)
    for of_earlier_bench in folder.glob("[0-9]*"):
        failure.clear(of_earlier_bench)
    error = {"error": report.longreprtext.splitlines()}
    (folder / "failure.json").write_text(json_text(notes | error), encoding="utf-8")
    lines = [f"folder: {folder}"]
    if state.folder is not None:
        return lines
    state.folder = folder
    seeds, heads = [], []
    for number, bench in enumerate(state.benches):
        of_bench = state.saved[number] = folder / str(number)
        if isinstance(bench, DriveOnBus):
            bench.release()
        saved = failure.save(bench, of_bench, notes, getattr(bench, "options", None), report.longreprtext)
        if report.when == "teardown" and number in state.recordings:  # complete since the fixture has ended
            failure.save_truth(state.recordings[number], of_bench)
        if isinstance(bench, Bench):
            seeds.append(str(bench.options.seed))
        of = f" of bench {number}" if len(state.benches) > 1 else ""
        heads.append(f"last stimulus{of}: {saved.last}")
        heads += [f"the drive{of}: {saved.drive}"] if saved.drive else []
        seed = f"seed {seeds[-1]}, " if seeds else ""
        lines.append(f"log and plots ({seed}ended at {bench.time_s:.6f} s): {of_bench}")
        lines.append(f"everything that was done{of.replace('of', 'to')}:")
        if len(saved.stimuli) > _STIMULI_SHOWN:
            lines.append(f"    {len(saved.stimuli) - _STIMULI_SHOWN} earlier ones: {of_bench / 'failure.html'}")
        lines += [f"    {stimulus}" for stimulus in saved.stimuli[-_STIMULI_SHOWN:]] or ["    nothing"]
        lines.append(f"what changed in the last {failure.BEFORE_S:g} s:")
        lines += [f"    {change}" for change in saved.changes[-_CHANGES_SHOWN:]] or ["    nothing"]
        link = link_of(bench) if isinstance(bench, Bench) else None
        if link is not None:
            lines.append(f"in a browser ({COMMAND} tab): {link}")
    lines.append(f"replay in {item.config.rootpath}: {command}")
    properties = [("salient_folder", str(folder)), ("salient_seed", " ".join(seeds)), ("salient_replay", command)]
    item.user_properties += properties  # for the reports that follow
    report.user_properties += properties
    return heads + lines


def _replay(item: pytest.Item) -> str:
    """The command that runs a test again, in pytest's root."""
    root, python = item.config.rootpath, Path(sys.executable)
    test = "::".join([os.path.relpath(item.path, root), *item.nodeid.split("::")[1:]])
    start = str(python.relative_to(root)) if python.is_relative_to(root) else str(python)
    options = []
    for name, default in (("can", "local"), ("build", "host"), ("program", None), ("machine", []), ("controller", []),
                          ("target", [])):
        value = item.config.getoption(f"--salient-{name}")
        if value != default:
            values = value if isinstance(value, list) else [value]
            options += [f"--salient-{name}={one.absolute() if isinstance(one, Path) else one}" for one in values]
    return shlex.join([start, "-m", "pytest", test, *options])
