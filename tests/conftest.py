"""Shared fixtures. `bench` and `make_bench` come from the package."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

from salient.__main__ import main
from salient.builder import build_preset
from salient.config import TARGET_BUILDS, WASM_BUILD
from salient.errors import UsageError
from salient.guard import guarded, outside
from salient.paths import BUILD, ROOT, build_lock, from_root
from salient.turns import TURNS, turn_of_name

BUILDS = {
    "hil": {"host": ["salient_host"]},
    "plant": {"host": []},
    "tools": {"host": [], WASM_BUILD: []},
    "target": {preset: [] for preset in ("host", *TARGET_BUILDS, "stm32g4", WASM_BUILD)},
}
"""Folder of tests: the presets that it runs, each with its targets, none for all."""

# Tests of the benchmark use the reference model of the plant, too.
sys.path.append(str(ROOT / "tests" / "plant"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--turn", type=int, choices=range(TURNS), metavar=f"0..{TURNS - 1}",
                     help="of the tests that are marked in_turns, only this turn's; default: all of them")
    parser.addini("cache_dir", "cache of pytest", default=str(BUILD / "pytest_cache"))  # as all that is made here


def pytest_configure(config: pytest.Config) -> None:
    if config.option.salient_failures is None:
        config.option.salient_failures = BUILD / "failures"
    config.addinivalue_line("markers", "in_turns: takes long, and is run with one commit of several (salient.turns)")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves the tests out that have another turn."""
    turn = config.getoption("--turn")
    waiting = [] if turn is None else [item for item in items if _turn_of(item) not in (None, turn)]
    if waiting:
        config.hook.pytest_deselected(items=waiting)
        items[:] = [item for item in items if item not in set(waiting)]


def _turn_of(item: pytest.Item) -> int | None:
    """Turn of a marked test; one of all tests of a file that is marked as a whole, because they share its fixtures."""
    module = item.getparent(pytest.Module)
    if module is not None and any(mark.name == "in_turns" for mark in module.own_markers):
        return turn_of_name(module.nodeid)
    return turn_of_name(item.nodeid) if item.get_closest_marker("in_turns") else None


def pytest_sessionstart(session: pytest.Session) -> None:
    """Brings the builds up to date that the selected folders run; ends the session when one fails. With a drive that
    runs already, or in the VM, nothing is built."""
    config = session.config
    # Processes and temporary files of a test end with pytest, whatever ends it. The folders of tmp_path stay where
    # pytest has them, and as long.
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(outside()))
    run = ExitStack()
    run.enter_context(guarded())
    config.add_cleanup(run.close)
    if hasattr(config, "workerinput") or config.option.collectonly or config.getoption("--salient-can") != "local":
        return
    selected = [Path(argument.partition("::")[0]).absolute() for argument in config.args]
    try:
        _build(selected)
    except UsageError as error:
        pytest.exit(str(error), 2)


def _build(selected: Sequence[Path]) -> None:
    with build_lock():
        for preset, targets in builds_of(selected).items():
            log = BUILD / "build.log"
            notice = partial(print, f"building {from_root(BUILD / preset)}", flush=True)
            if not build_preset(ROOT, BUILD / preset, targets, log, notice):
                print(log.read_text(encoding="utf-8", errors="replace")[-4000:])
                pytest.exit(f"building {preset} failed; `tools/salient test` installs the compilers that it needs", 1)


def builds_of(selected: Sequence[Path]) -> dict[str, list[str]]:
    """Presets, with their targets, that selected files and folders run."""
    found: dict[str, list[str]] = {}
    for name, presets in BUILDS.items():
        folder = ROOT / "tests" / name
        if any(path.is_relative_to(folder) or folder.is_relative_to(path) for path in selected):
            for preset, targets in presets.items():
                former = found.setdefault(preset, targets)
                found[preset] = sorted({*former, *targets}) if former and targets else []
    return found


@pytest.fixture
def salient(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs tools/salient with the given arguments and returns exit code and output."""

    def run(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
        command = [str(ROOT / "tools" / "salient"), *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, stdin=subprocess.DEVNULL,
                              env=environment or None)

    return run


@pytest.fixture
def salient_without_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
                          ) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs a command in this process, without the preparation by tools/salient (1 s of processor time)."""

    def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        argv = [*map(str, arguments)]
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["salient", *argv])
        capsys.readouterr()
        code = main()
        return subprocess.CompletedProcess(argv, code, *capsys.readouterr())

    return run


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, None, None]:
    """Frees what the tests of a file kept for each other, after the last of them: a process runs a hundred files."""
    yield
    of, next_of = (each and each.getparent(pytest.Module) for each in (item, nextitem))
    if isinstance(of, pytest.Module) and of is not next_of:
        clear_caches(of.obj)
        gc.collect()


def clear_caches(module: ModuleType) -> None:
    """Empties the caches that a module made; those that it imported serve other modules, too."""
    for name, value in vars(module).items():
        if hasattr(value, "cache_clear"):
            home = sys.modules.get(value.__module__)
            if home is module or getattr(home, name, None) is not value:
                value.cache_clear()
