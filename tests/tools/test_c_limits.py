"""Limits of C functions and files: excesses are found, exceptions have a reason and are needed."""

from __future__ import annotations

from pathlib import Path

import pytest

from salient import c_limits


def function(lines: int = 3, conditions: int = 0) -> str:
    """A function of so many lines and of the complexity conditions + 1."""
    tests = "".join(f"    if (value == {n}) return {n};\n" for n in range(conditions))
    filling = "    value++;\n" * (lines - 3 - conditions)
    return f"int step(int value) {{\n{tests}{filling}    return value;\n}}\n"


def write(root: Path, text: str, file: str = "firmware/drive/step.c") -> Path:
    for folder in c_limits.FOLDERS:
        (root / folder).mkdir(exist_ok=True)
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    (root / file).write_text(text)
    return root


@pytest.mark.parametrize(("text", "found"), [
    (function(lines=70), []),
    (function(lines=71), ["firmware/drive/step.c: step: 71 lines, at most 70"]),
    (function(lines=20, conditions=14), []),
    (function(lines=20, conditions=15), ["firmware/drive/step.c: step: complexity 16, at most 15"]),
    (function() + "\n" * 497, []),
    (function() + "\n" * 498, ["firmware/drive/step.c: 501 lines, at most 500"]),
])
def test_excess_is_found(tmp_path: Path, text: str, found: list[str]) -> None:
    assert c_limits.violations({}, write(tmp_path, text)) == found


@pytest.mark.parametrize("file", ["emulator/plant/step.h", "hal/qemu/step.c"])
def test_every_folder_counts(tmp_path: Path, file: str) -> None:
    assert c_limits.violations({}, write(tmp_path, function(lines=71), file)) == [
        f"{file}: step: 71 lines, at most 70"]


def test_exception_needs_a_reason(tmp_path: Path) -> None:
    write(tmp_path, function(lines=71))
    name = "firmware/drive/step.c: step"
    assert c_limits.violations({name: "a table"}, tmp_path) == []
    assert c_limits.violations({name: " "}, tmp_path) == [f"{name}: 71 lines, at most 70"]


@pytest.mark.parametrize("name", ["firmware/drive/step.c: step", "firmware/drive/step.c", "firmware/gone.c: step"])
def test_exception_that_is_not_needed_is_found(tmp_path: Path, name: str) -> None:
    write(tmp_path, function())
    assert c_limits.violations({name: "a table"}, tmp_path) == [
        f"{name}: an exception of c_limits.toml that is not needed"]
