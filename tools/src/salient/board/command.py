"""salient board: an image for the NUCLEO-G474RE, and its writing into the flash of one."""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import shutil
import struct
import subprocess
import sys
from functools import cache
from pathlib import Path

from salient.builder import build_preset, run_commands
from salient.config import CONTROLLERS
from salient.elf import ElfImage
from salient.errors import RunFailed, UsageError
from salient.machine.path import machine_path
from salient.paths import BUILD, ROOT, build_lock, from_root, make_folder
from salient.toml_file import TextFileError, read_bytes

PRESET = "stm32g4"
PHASES_MAX = 4
FLASH_BEGIN, FLASH_BYTES = 0x08000000, 256 * 1024
"""Bank 1; the parameters are in bank 2."""
RAM_BEGIN, RAM_BYTES = 0x20000000, 128 * 1024
CAN_QUANTA = 10
"""Quanta of a bit: PRESCALER in hal/stm32g4/can.c must be a whole number up to 512."""
_PARTS = ("drive_codec", "salient_firmware")
_OPENOCD = ("-f", "board/st_nucleo_g4.cfg")
SUFFIXES = (".elf", ".hex", ".bin")
_TCL = {letter: f"\\{letter}" for letter in "{}[]\"\\$; #"} | {"\n": "\\n", "\t": "\\t", "\r": "\\r"}
"""Characters with a meaning in OpenOCD's language, as themselves."""
_FILE_BYTES_MAX = 100_000_000
"""Size of an ELF file with its debug information; the flash takes less."""


def run(options: argparse.Namespace) -> int:
    """Runs an action of the command."""
    return _build(options) if options.action == "build" else flash(options.file)


def _build(options: argparse.Namespace) -> int:
    make_folder(options.out)
    elf = build_image(options.machine, clock_mhz=int(options.clock), controller=options.controller, node=options.node,
                      bit_rate=options.bit_rate, index=options.encoder == "index", stored_tables=options.stored_tables)
    name = machine_path(options.machine).stem
    made = options.out / f"{name}.elf"
    shutil.copyfile(elf, made)
    image = ElfImage(made)
    for suffix, kind in ((".bin", "binary"), (".hex", "ihex")):
        image.copy_to(made.with_suffix(suffix), kind)
    used = image.sections()
    flash_bytes = sum(used.get(section, 0) for section in (".text", ".code_check", ".ARM.exidx", ".data"))
    ram_bytes = sum(used.get(section, 0) for section in (".data", ".bss", ".stack"))
    print(f"{made}, .bin, .hex: flash {flash_bytes} of {FLASH_BYTES} bytes, RAM {ram_bytes} of {RAM_BYTES} bytes "
          f"with a stack of at least {used.get('.stack', 0)} bytes")
    return 0


def build_image(machine: str, *, clock_mhz: int = 170, controller: str = "salient", node: int = 0,
                bit_rate: int = 1_000_000, index: bool = False, stored_tables: bool = False) -> Path:
    """The ELF image for a machine and the options of the board; of the sources only tables and port are compiled where
    the firmware of the preset is up to date, all of them for stored_tables. UsageError: a machine that the board cannot
    drive, or a bit rate that its clock does not make. RunFailed: the build fails."""
    from salient.machine.file import load_machine  # NumPy and pydantic, and here only

    path = machine_path(machine)
    phases = load_machine(str(path)).phases
    if phases > PHASES_MAX:
        raise UsageError(f"{path}: {phases} phases: the board has outputs for {PHASES_MAX}")
    prescaler, rest = divmod(clock_mhz * 1_000_000, CAN_QUANTA * bit_rate)
    if rest or not 1 <= prescaler <= 512:
        raise UsageError(f"--bit-rate {bit_rate}: the clock of {clock_mhz} MHz makes no such rate; must divide "
                         f"{clock_mhz * 1_000_000 // CAN_QUANTA} into 1 to 512 parts, as 1000000, 500000 or 250000")
    for missing, package in (("cmake", "cmake"), ("arm-none-eabi-gcc", "gcc-arm-none-eabi")):
        if shutil.which(missing) is None:
            raise UsageError(f"{missing} is missing: install the Debian package {package}")
    settings = {"SALIENT_MACHINE_FILE": path, "SALIENT_PYTHON": sys.executable,
                **({"SALIENT_STORED_TABLES": "ON"} if stored_tables else {"SALIENT_BUILT": BUILD / PRESET}),
                "SALIENT_BOARD_CLOCK_MHZ": clock_mhz, "SALIENT_BOARD_CAN_BIT_RATE": bit_rate,
                "SALIENT_BOARD_CONTROLLER": CONTROLLERS.index(controller), "SALIENT_BOARD_NODE": node,
                "SALIENT_BOARD_ENCODER_INDEX": "ON" if index else "OFF"}
    digest = hashlib.sha256(repr(sorted(map(str, settings.items()))).encode()).hexdigest()[:12]
    folder = BUILD / f"board-{digest}" / PRESET
    folder.mkdir(parents=True, exist_ok=True)
    with (folder.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        commands = [["cmake", "--build", str(folder), "--target", "custom_image"]]
        if not (folder / "build.ninja").exists():
            commands.insert(0, ["cmake", "--preset", PRESET, "-B", str(folder),
                                *(f"-D{name}={value}" for name, value in settings.items())])
        log = folder.parent / "build.log"

        @cache
        def notice() -> None:
            print(f"salient: building the image for {path}", file=sys.stderr, flush=True)

        with build_lock():
            good = build_preset(ROOT, BUILD / PRESET, _PARTS, log, notice)
        if not (good and run_commands(commands, ROOT, log, notice)):
            raise RunFailed(f"building the image for {path} failed: see {from_root(log)}")
    return folder / "bin" / "salient_custom.elf"


def flash(file: Path) -> int:
    """Writes an image with OpenOCD, or st-flash where that is missing, and verifies it. UsageError: no image of this
    board, or neither program. RunFailed: the program fails."""
    check_image(file)
    if shutil.which("openocd"):
        place = f" 0x{FLASH_BEGIN:08x}" if file.suffix == ".bin" else ""
        command = ["openocd", *_OPENOCD, "-c", f"program {_tcl_word(file.resolve())}{place} verify reset exit"]
    elif shutil.which("st-flash"):
        if file.suffix == ".elf":
            raise UsageError(f"{file}: st-flash writes no ELF file; must be the .hex or the .bin beside it")
        command = ["st-flash", "--connect-under-reset", "--reset"]
        command += (["--format", "ihex", "write", str(file)] if file.suffix == ".hex"
                    else ["write", str(file), f"0x{FLASH_BEGIN:08x}"])
    else:
        raise UsageError("neither openocd nor st-flash is there: install the Debian package openocd or stlink-tools")
    done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          text=True)
    if done.returncode != 0:
        lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
        reasons = [line for line in lines if "error" in line.lower()] or lines[-1:] or ["no output"]
        raise RunFailed(f"{command[0]}: {reasons[0]}")
    print(f"{file}: written and verified")
    return 0


def _tcl_word(path: Path) -> str:
    """A path as a word of OpenOCD's language, whatever characters it has."""
    return "".join(_TCL.get(letter, letter) for letter in str(path))


def check_image(file: Path) -> None:
    """Refuses what is no image of this board. UsageError."""
    if file.suffix not in SUFFIXES:
        raise UsageError(f"{file}: must be a file {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} of board build")
    try:
        vectors = _first_bytes(file, read_bytes(file, _FILE_BYTES_MAX))
    except TextFileError as error:
        raise UsageError(f"{file}: {error}") from None
    stack, start = struct.unpack("<II", vectors) if len(vectors) == 8 else (0, 0)
    in_ram = RAM_BEGIN < stack <= RAM_BEGIN + RAM_BYTES and stack % 8 == 0
    if not in_ram or not (FLASH_BEGIN <= start < FLASH_BEGIN + FLASH_BYTES and start & 1):
        raise UsageError(f"{file}: no image for the NUCLEO-G474RE: its vector table begins with "
                         f"{vectors.hex() or 'nothing'}")


def _first_bytes(file: Path, content: bytes) -> bytes:
    """The first two vectors, as far as the file has them at the start of the flash."""
    if file.suffix == ".bin":
        return content[:8]
    if file.suffix == ".elf":
        try:
            return ElfImage(file).read(FLASH_BEGIN, 8)
        except (UsageError, struct.error):
            return b""
    base = 0
    try:
        for line in content.decode("ascii").splitlines():
            record = bytes.fromhex(line.removeprefix(":"))
            if record[3] == 4:  # upper half of the addresses that follow
                base = int.from_bytes(record[4:6], "big") << 16
            if record[3] == 0 and base + int.from_bytes(record[1:3], "big") == FLASH_BEGIN:
                return record[4: 4 + min(record[0], 8)]
    except (ValueError, IndexError):
        pass
    return b""
