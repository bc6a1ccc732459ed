"""The skeleton of a port has every function of the interface, says at each what to fill in, and links."""

from __future__ import annotations

import re

import pytest

from salient.bench.programs import program
from salient.elf import ElfImage
from salient.paths import ROOT

HAL = ROOT / "hal"
PORTS = ("skeleton", "stm32g4")
COMPLETE = {"hal_memory"}
"""Functions of the skeleton that need nothing filled in."""


def functions_of_the_interface() -> set[str]:
    texts = (re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL) for path in HAL.glob("hal_*.h"))
    return {name for text in texts for name in re.findall(r"\b(hal_\w+)\([^)]*\);", text)}


def sources(port: str) -> str:
    shared = HAL / "qemu" / "memory.c"  # of all images with its linker script
    return "\n".join(path.read_text() for path in (*sorted((HAL / port).glob("*.c")), shared))


@pytest.mark.parametrize("port", PORTS)
def test_a_port_has_every_function_once(port):
    names = functions_of_the_interface()
    assert len(names) == 32
    defined = re.findall(r"^[a-z]\w*[\w ]*[ *](hal_\w+)\([^;{]*\)\s*\{", sources(port), re.MULTILINE)
    assert sorted(defined) == sorted(names)


def test_each_function_of_the_skeleton_says_what_to_fill_in():
    text = sources("skeleton")
    for name in functions_of_the_interface() - COMPLETE:
        assert re.search(rf"/\* FILL IN(?:(?!\*/).)*\*/\n[^\n]*\b{name}\(", text, re.DOTALL), name


def test_it_links_with_the_firmware():
    symbols = ElfImage(program("cortex-m4", "skeleton.elf")).symbols()
    assert {"drive_init", "drive_background", "control_handler", "deferred_handler", "program_start"} <= set(symbols)
    assert {"hal_pwm_break", "hal_pwm_write", "hal_can_receive", "hal_nvm_erase"} <= set(symbols)
