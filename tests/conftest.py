"""What the tests here share. The fixtures `bench` and `make_bench` come from the package's own plugin."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from salient.paths import ROOT

LAUNCHER_TIMEOUT_S = 300


@pytest.fixture
def salient(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs tools/salient with the given arguments and gives back exit code and output."""

    def run(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
        command = [str(ROOT / "tools" / "salient"), *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, stdin=subprocess.DEVNULL,
                              env=environment or None, timeout=LAUNCHER_TIMEOUT_S)

    return run
