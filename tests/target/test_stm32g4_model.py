"""Register-level model of the STM32G474RE: small bare-metal programs, each with one subject, by the reference manual.

The programs of stm32g4/ know neither the port nor the model: they check themselves and end with the line of the first
check that fails."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

import pytest

from salient.paths import BUILD, ROOT

SOURCES = ROOT / "tests" / "target" / "stm32g4"
MODEL = BUILD / "host" / "bin" / "salient_stm32g4"
COMPILER = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-O1", "-ffreestanding", "-nostdlib", "-Wall", "-Wextra",
            "-Werror", "-T", str(SOURCES / "part.ld"), str(SOURCES / "part.c")]
VIOLATION = 70


@cache
def _image(folder: Path, name: str, definitions: tuple[str, ...]) -> Path:
    image = folder / f"{name}{len(definitions)}{'_'.join(definitions)}.elf".replace("=", "_").replace("/", "_")
    subprocess.run([*COMPILER, *(f"-D{item}" for item in definitions), str(SOURCES / f"{name}.c"), "-lgcc", "-o",
                    str(image)], check=True)
    return image


def run(folder: Path, name: str, *options: str, definitions: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Runs a program alone on the model."""
    return subprocess.run([str(MODEL), str(_image(folder, name, definitions)), "--alone", *options],
                          capture_output=True, text=True, check=False, timeout=120)


def passes(result: subprocess.CompletedProcess[str]) -> bool:
    """True when every check of the program held; else the message names the line."""
    assert result.returncode == 0, f"exit code {result.returncode} (a line of the program, or {VIOLATION}): {result.stderr}"
    return True


def test_exceptions_come_in_the_order_of_their_priorities(tmp_path: Path) -> None:
    assert passes(run(tmp_path, "nvic"))
