"""An image that cannot continue ends QEMU with an exit code and one line with the reason, on every board."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from salient.bench.programs import executable
from salient.machine.cache import machine_image
from salient.paths import BUILD, ROOT

TIMEOUT_S = 30
EXIT_FAULT, EXIT_LAYOUT = 70, 78
_LAYOUT = r"(#define MAILBOX_LAYOUT_OF\(phases\) \()([0-9]+)u"

COMPILERS = {
    "mps2_an386": ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-nostartfiles"],
    "rv32_virt": ["riscv64-unknown-elf-gcc", "-march=rv32imac", "-misa-spec=2.2", "-mabi=ilp32", "-nostartfiles",
                  "-nolibc", f"-I{ROOT}/hal/qemu/rv32_virt/c_library"],
}

DRIVE = """
#include "drive/drive.h"
#include "hal_pwm.h"

bool drive_init(drive_t *drive, hal_t *hal, const drive_config_t *config) {
    hal_pwm_start(hal, 2500);
    return true;
}

void drive_control_interrupt(drive_t *drive, hal_t *hal) {
    static int calls;
    if (++calls == 10) {
        __builtin_trap();
    }
}

void drive_deferred_interrupt(drive_t *drive, hal_t *hal) {
}

void drive_background(drive_t *drive, hal_t *hal) {
}
"""
"""Replaces the firmware: traps in its tenth control interrupt."""


@pytest.fixture(params=COMPILERS)
def make_image(request, tmp_path: Path) -> Callable[[int], Path]:
    """Makes an image of DRIVE with the board's program, with the mailbox layout identifier `layout`."""
    hal = ROOT / "hal"

    def make(layout: int) -> Path:
        mailbox = tmp_path / "qemu" / "mailbox.h"
        mailbox.parent.mkdir()
        text, count = re.subn(_LAYOUT, rf"\g<1>{layout}u", (hal / "qemu/mailbox.h").read_text())
        assert count == 1
        mailbox.write_text(text)
        drive, image = tmp_path / "drive.c", tmp_path / "image.elf"
        drive.write_text(DRIVE)
        folders = [tmp_path, hal, ROOT / "firmware", ROOT / "emulator",
                   *(BUILD / "cortex-m4" / "firmware" / generated for generated in ("codec", "dictionary"))]
        sources = [ROOT / "emulator/qemu/image/main.c", *sorted((hal / "qemu").glob("*.c")),
                   *sorted((hal / "qemu" / request.param).glob("*.c"))]
        scripts = [hal / "qemu" / request.param / "memory.ld", hal / "qemu" / "sections.ld"]
        command = [*COMPILERS[request.param], "-std=c11", "-O1", "-ffreestanding", "-DHAL_PHASES_MAX=4",
                   *(f"-I{one}" for one in folders),
                   *map(str, sources), str(drive), *(f"-Wl,-T,{one}" for one in scripts), "-o", str(image)]
        subprocess.run(command, check=True, timeout=TIMEOUT_S)
        return image

    return make


def layout_of_world() -> int:
    return int(re.search(_LAYOUT, (ROOT / "hal/qemu/mailbox.h").read_text())[2])


def run(image: Path, folder: Path) -> subprocess.CompletedProcess:
    command = [executable("cortex-m4"), image, "--can", f"unix:{folder}/bus", "--pace", "free",
               "--machine-image", machine_image("saturating"), "--stop-at-s", "1", "--record", folder / "state.npy"]
    return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL)


@pytest.mark.in_turns
def test_cpu_exception_is_reported_and_the_recording_is_kept(make_image, tmp_path: Path):
    result = run(make_image(layout_of_world()), tmp_path)
    assert result.returncode == EXIT_FAULT
    assert result.stderr == "salient: the drive's program stopped on an unexpected CPU exception\n"
    assert not (tmp_path / "bus").exists()
    assert 240 <= len(np.load(tmp_path / "state.npy")) <= 252  # one row per microsecond, ten periods of 25 us


def test_image_with_another_mailbox_layout_is_rejected(make_image, tmp_path: Path):
    result = run(make_image(layout_of_world() + 1), tmp_path)
    assert result.returncode == EXIT_LAYOUT
    assert result.stdout == ""
    assert result.stderr == ("salient: the drive's image and this program have different mailbox layouts: "
                             "build both from the same sources\n")
    assert not (tmp_path / "bus").exists()
