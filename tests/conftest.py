"""Shared fixtures. `bench` and `make_bench` come from the package."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from salient.__main__ import main
from salient.paths import ROOT

# Tests of the benchmark use the reference model of the plant, too.
sys.path.append(str(ROOT / "tests" / "plant"))


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
