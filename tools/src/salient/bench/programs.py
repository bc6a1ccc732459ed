"""The programs that a drive and its test bench are: the host executable, or one that starts QEMU with an image for a
board; and their command line.

Few imports: `salient sim` starts as fast as these.
"""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

from salient.builder import build_preset, run_commands
from salient.config import BOARD_BUILD, TARGET_BUILDS, TARGETS, WASM_BUILD, BenchConfig
from salient.elf import ElfImage
from salient.errors import RunFailed, UsageError
from salient.machine.cache import content_key, machine_image
from salient.machine.path import machine_path
from salient.paths import BUILD, IS_WHEEL, MACHINES, ROOT, build_lock, from_root, keep_text, program

_BUILDERS = {"host": "any tools/salient command",
             "debug": "cmake --preset debug && cmake --build --preset debug",
             **{build: f"any tools/salient command with --target {build}" for build in TARGETS[1:]}}
_IMAGE_PARTS = ("drive_codec", "salient_firmware", "salient_port", "salient_main")
"""Targets of CMake that images of every machine have in common."""
BOARD_CLOCK_MHZ = 100
"""Clock of the images that the model runs: its ticks are whole nanoseconds, as the plant's."""
BOARD_ADC_BITS = 12


class EmulatorError(RunFailed):
    """A program failed; the text includes its standard error."""


def executable(build: str = "host") -> Path:
    """The executable of a build (BenchConfig.build), for a target build the program that starts QEMU, for
    WebAssembly the module. UsageError: it is not built."""
    if IS_WHEEL and build != "host":
        raise UsageError(f"--target {build}: only in a clone of the repository, where it is built; must be host")
    if build in TARGET_BUILDS:
        return _built("host", "salient_target", _builder(build))
    if build == BOARD_BUILD:
        return _built("host", "salient_stm32g4", _builder("host"))
    if build == WASM_BUILD:
        return _built(build, "salient.wasm", _builder(build))
    return _built(build, "salient_host", _builder(build))


def reference_executable() -> Path:
    """The program that runs a machine with the reference model of the controller. UsageError: it is not built."""
    return _built("host", "salient_reference", "tools/salient compare")


def image(machine: str, build: str) -> Path:
    """The firmware for a machine as an image for the board of a target build; that for a user's machine file is built
    first. UsageError: no such machine, a mistake in its file, or the image of a bundled machine is not built."""
    machine_image(machine)  # checks the file
    path = machine_path(machine)
    if path.parent == MACHINES:
        return _built(build, f"salient_{path.stem}.elf", _builder(build))
    from salient.machine.file import load_machine  # NumPy and pydantic, and here only

    return _build_custom(path, content_key(path), build, load_machine(path).phases)


def deferred_instructions(instructions: Path) -> Path:
    """The file with the instruction counts of the deferred interrupts, from the control interrupts' file."""
    return instructions.with_name(f"{instructions.name}.deferred")


def command_line(config: BenchConfig) -> list[str]:
    """The command line that starts a test bench. UsageError: as executable() and image(), and options that exclude each
    other."""
    arguments = replace(config, machine_image=config.machine_image or machine_image(config.machine, config.true_machine)
                        ).arguments()
    start = str(config.program or executable(config.build))
    if config.build == BOARD_BUILD:
        return [start, *_board_arguments(config), *arguments]
    if config.build not in TARGET_BUILDS:
        if config.instruction_ns is not None:
            raise UsageError(f"--instruction-ns {config.instruction_ns}: only with --target cortex-m4")
        if config.build == WASM_BUILD:
            return [sys.executable, "-m", "salient.bench.wasm", start, *arguments]
        return [start, *arguments]
    if config.drives > 1:
        raise UsageError(f"--drives {config.drives}: only with --target host")
    elf = image(config.machine, config.build)
    line = [start, str(elf)]
    if config.instructions is not None:
        line += ["--instructions", str(config.instructions),
                 "--deferred-instructions", str(deferred_instructions(config.instructions))]
    if config.execution is not None:
        end, begin = ElfImage(elf).stack()
        line += ["--execution", str(config.execution), f"{end:#x}-{begin:#x}"]
    if config.instruction_ns is not None:
        line += ["--instruction-ns", str(config.instruction_ns)]
    return [*line, *arguments]


def _board_arguments(config: BenchConfig) -> list[str]:
    """Image and wiring for the model of the board's part. Telemetry has the parameter's period: an image has no option
    for it. UsageError: an option that the image cannot have."""
    from salient.board.command import build_image  # cantools and NumPy, and here only
    from salient.board.pins import read_pins

    refused = {"--drives": config.drives > 1, "--instruction-ns": config.instruction_ns is not None,
               "--instructions": config.instructions is not None, "--execution": config.execution is not None,
               "--protocol": config.protocol != "salient", "--adc-bits": config.adc_bits != BOARD_ADC_BITS,
               "--encoder-edges": config.encoder_edges}
    for option, given in refused.items():
        if given:
            raise UsageError(f"{option}: not with --target {BOARD_BUILD}")
    elf = build_image(config.machine, clock_mhz=BOARD_CLOCK_MHZ, controller=config.controller, node=config.node,
                      bit_rate=config.bit_rate, stored_tables=config.memory is not None)
    wiring = BUILD / "stm32g4.wiring"
    keep_text(wiring, "".join(f"{pin.signal} {pin.pin}\n" for pin in read_pins()))
    return [str(elf), "--wiring", str(wiring)]


def _builder(build: str) -> str:
    return _BUILDERS.get(build, "tools/salient test")


def _built(build: str, name: str, builder: str) -> Path:
    path = program(build, name)
    if not path.exists():
        raise UsageError(f"{from_root(path)} is not built; {builder} builds it")
    return path


@lru_cache
def _build_custom(path: Path, key: str, build: str, phases: int) -> Path:
    """Builds the image for a user's machine file in a folder for its path and content, one process at a time. Of the
    sources only its tables are compiled: it links the firmware of the target build, of a machine of more than four
    phases the firmware of a build with room for six."""
    from salient.dbc import FIRST_PHASES, PHASES_MAX  # cantools, and here only

    if shutil.which("cmake") is None:
        raise UsageError("cmake is missing; a machine file of your own on a target requires a build")
    _remove_orphans()
    folder = BUILD / f"machine-{hashlib.sha256(f'{path} {key}'.encode()).hexdigest()[:12]}"
    folder.mkdir(exist_ok=True)
    parts, options = BUILD / build, tuple[str, ...]()
    if phases > FIRST_PHASES:
        parts, options = BUILD / f"phases-{PHASES_MAX}" / build, (f"-DSALIENT_PHASES_MAX={PHASES_MAX}",)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (folder / "machine_file").write_text(str(path), encoding="utf-8")
        commands = []
        if not (folder / build / "build.ninja").exists():
            commands.append(["cmake", "--preset", build, "-B", str(folder / build), f"-DSALIENT_MACHINE_FILE={path}",
                             f"-DSALIENT_BUILT={parts}", f"-DSALIENT_PYTHON={sys.executable}", *options])
        commands.append(["cmake", "--build", str(folder / build), "--target", "custom_image"])
        log = folder / "build.log"

        @cache
        def notice() -> None:
            print(f"salient: building the firmware for {path}", file=sys.stderr, flush=True)

        if not (_build_parts(parts, options, log, notice) and run_commands(commands, ROOT, log, notice)):
            raise EmulatorError(f"building the firmware for {path} failed: see {from_root(log)}")
    return folder / build / "bin" / "salient_custom.elf"


def _build_parts(folder: Path, options: Sequence[str], log: Path, notice: Callable[[], None]) -> bool:
    """Brings what the images of a target build link up to date; no two commands build at once."""
    with build_lock():
        folder.parent.mkdir(exist_ok=True)
        python = (f"-DSALIENT_PYTHON={sys.executable}",) if options else ()
        return build_preset(ROOT, folder, _IMAGE_PARTS, log, notice, (*options, *python))


def _remove_orphans() -> None:
    """Removes the builds of machine files that no longer exist."""
    for note in BUILD.glob("machine-*/machine_file"):
        try:
            if not Path(note.read_text(encoding="utf-8")).exists():
                shutil.rmtree(note.parent, ignore_errors=True)
        except OSError:
            continue  # another process removes it
