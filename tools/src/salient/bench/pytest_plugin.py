"""pytest plugin: the fixtures `bench` and `make_bench`.

    @pytest.mark.bench_options(machine="linear_cosine", controller="paper", seed=7)
    def test_something(bench):
        bench.drive.speed_reference_rpm = 600
        bench.run_for(0.1)

`bench` is one drive with its test bench; `make_bench(**options)` starts any number of them, one after the other or (on
local buses) simultaneously. The options are the fields of BenchConfig. A failed test leaves its logs, a plot of the
last moments, seed and replay command in a folder that the failure message names.

Marks: `both_transports`, the test is also run over real SocketCAN; `socketcan`, the test requires an interface and is
only run with --salient-can socketcan:INTERFACE.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import pluggy
import pytest

from salient.bench.bench import Bench
from salient.config import HOST_BUILDS, TARGET_BUILDS, WASM_BUILD, BenchConfig
from salient.paths import BUILD, ROOT
from salient.tab.link import link_of

_benches_key = pytest.StashKey[list[Bench]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("salient")
    group.addoption("--salient-can", default="local", metavar="BUS",
                    help="local (default): a local bus for each bench; or socketcan:INTERFACE")
    group.addoption("--salient-build", default="host", choices=(*HOST_BUILDS, *TARGET_BUILDS, WASM_BUILD),
                    help="build under test (default host)")
    group.addoption("--salient-failures", default=str(BUILD / "failures"), metavar="DIR",
                    help="parent of the folders that failed tests leave")


def pytest_configure(config: pytest.Config) -> None:
    can = config.getoption("--salient-can")
    if can != "local" and not re.fullmatch(r"socketcan:\S+", can):
        raise pytest.UsageError(f"--salient-can {can}: must be local or socketcan:INTERFACE")
    config.addinivalue_line("markers", "bench_options(**options): fields of BenchConfig for the fixture bench")
    config.addinivalue_line("markers", "both_transports: the test is also run over SocketCAN")
    config.addinivalue_line("markers", "socketcan: the test requires --salient-can socketcan:INTERFACE")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselects tests that are not for the transport of this run."""
    on_interface = config.getoption("--salient-can") != "local"
    selected: list[pytest.Item] = []
    deselected: list[pytest.Item] = []
    for item in items:
        interface_only = item.get_closest_marker("socketcan") is not None
        both = item.get_closest_marker("both_transports") is not None
        is_selected = interface_only or both if on_interface else not interface_only
        (selected if is_selected else deselected).append(item)
    if deselected:
        config.hook.pytest_deselected(items=deselected)
        items[:] = selected


@pytest.fixture
def make_bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Starts benches: make_bench(machine=..., controller=..., seed=...). can: a bus other than that of the run."""
    benches: list[Bench] = []
    request.node.stash[_benches_key] = benches
    bus = request.config.getoption("--salient-can")
    build = request.config.getoption("--salient-build")

    def make(can: str | None = None, **options: Any) -> Bench:
        options.setdefault("build", build)
        if can is None and bus != "local":
            can = bus
        bench = Bench(BenchConfig(**options), can or f"unix:{tmp_path}/can{len(benches)}.sock")
        benches.append(bench)
        return bench

    yield make
    errors = []
    for bench in benches:
        try:
            bench.close()
        except Exception as error:
            errors.append(error)
    if errors:
        raise errors[0]


@pytest.fixture
def bench(request: pytest.FixtureRequest, make_bench: Callable[..., Bench]) -> Bench:
    """One drive and its test bench at virtual time 0, with the options of the mark bench_options."""
    mark = request.node.get_closest_marker("bench_options")
    return make_bench(**(mark.kwargs if mark else {}))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]
                              ) -> Generator[None, pluggy.Result[pytest.TestReport], None]:
    outcome = yield
    report = outcome.get_result()
    if call.when != "call" or not report.failed:
        return
    options = [f"--salient-can={item.config.getoption('--salient-can')}"]
    options.append(f"--salient-build={item.config.getoption('--salient-build')}")
    test = "::".join([os.path.relpath(item.path, ROOT), *item.nodeid.split("::")[1:]])
    replay = shlex.join(["build/venv/bin/python", "-m", "pytest", test, *options])
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", item.nodeid).strip("_")
    benches: list[Bench] = item.stash.get(_benches_key, [])
    for number, bench in enumerate(benches):
        folder = Path(item.config.getoption("--salient-failures")) / name / str(number)
        try:
            bench.save(folder, replay)
        except Exception as error:  # must not hide the failure of the test
            report.sections.append(("salient bench", f"nothing saved in {folder}: {error!r}"))
            continue
        lines = [f"log, plot, seed {bench.options.seed}: {folder}", f"replay: {replay}"]
        link = link_of(bench)
        if link is not None:
            lines.append(f"in a browser (tools/salient tab): {link}")
        report.sections.append(("salient bench", "\n".join(lines)))
