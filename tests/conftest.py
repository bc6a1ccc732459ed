"""Shared fixtures and the distribution of tests over processes. `bench` and `make_bench` come from the package."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from salient.paths import ROOT

LAUNCHER_TIMEOUT_S = 300


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """With `pytest -n N --dist loadgroup`, tests that share a fixture of a module run in one process, which makes it
    once. A mark xdist_group of the test's own comes first."""
    for item in items:
        definitions = item._fixtureinfo.name2fixturedefs.values()
        shared = [definition for definition in (found[-1] for found in definitions if found)
                  if definition.scope == "module" and definition.baseid]
        if shared and item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))


@pytest.fixture
def salient(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs tools/salient with the given arguments and returns exit code and output."""

    def run(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
        command = [str(ROOT / "tools" / "salient"), *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, stdin=subprocess.DEVNULL,
                              env=environment or None, timeout=LAUNCHER_TIMEOUT_S)

    return run
