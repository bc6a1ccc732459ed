"""Starts a drive and its test bench in one process: the host executable, or QEMU with an image for a board."""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from salient.bench.drive import ParameterRow, read_parameter_table
from salient.bench.session import Session
from salient.builder import run_commands
from salient.config import TARGET_BUILDS, BenchConfig
from salient.elf import ElfImage
from salient.errors import UsageError
from salient.machine.file import MachineError, load_machine, machine_path
from salient.machine.firmware_tables import machine_phase_map
from salient.machine.scaling import scaling_of
from salient.paths import BUILD, MACHINES, ROOT


class EmulatorError(Exception):
    """The executable failed; the text includes its standard error."""


_BUILDERS = {"host": "any tools/salient command",
             "debug": "cmake --preset debug && cmake --build --preset debug"}
_TESTS = "tools/salient test"


# --- programs -------------------------------------------------------------------------------------------------------

def executable(machine: str, build: str = "host") -> Path:
    """The executable for a machine and a build (BenchConfig.build); that for a user's machine file is built first.

    For a target build it is the program that starts QEMU with image(). UsageError: no such machine, a mistake in its
    file, or the executable of a bundled machine is not built.
    """
    return _programs(machine, build)[0]


def image(machine: str, build: str) -> Path:
    """The image that executable() runs for a target build. UsageError as executable()."""
    return _programs(machine, build)[1]


def deferred_instructions(instructions: Path) -> Path:
    """The file with the instruction counts of the deferred interrupts, from that of the control interrupts."""
    return instructions.with_name(f"{instructions.name}.deferred")


def command_line(config: BenchConfig) -> list[str]:
    """The command line that starts a test bench. UsageError: as executable(), and options that exclude each other."""
    program = str(executable(config.machine, config.build))
    if config.build not in TARGET_BUILDS:
        if config.instruction_ns is not None:
            raise UsageError(f"--instruction-ns {config.instruction_ns}: only with --target cortex-m4")
        return [program, *config.arguments()]
    elf = image(config.machine, config.build)
    line = [program, str(elf)]
    if config.instructions is not None:
        line += ["--instructions", str(config.instructions),
                 "--deferred-instructions", str(deferred_instructions(config.instructions))]
    if config.execution is not None:
        end, begin = ElfImage(elf).stack()
        line += ["--execution", str(config.execution), f"{end:#x}-{begin:#x}"]
    if config.instruction_ns is not None:
        line += ["--instruction-ns", str(config.instruction_ns)]
    return [*line, *config.arguments()]


@lru_cache
def _programs(machine: str, build: str) -> list[Path]:
    """The program to start, and for a target build the image."""
    try:
        path = machine_path(machine)
        checked = load_machine(path)
        is_bundled = path.parent == MACHINES
        if not is_bundled:
            machine_phase_map(path, checked, scaling_of(path, checked).exponents)  # or the build would fail
    except MachineError as error:
        raise UsageError(str(error)) from None
    names = {build: f"salient_{path.stem}"}
    if build in TARGET_BUILDS:
        names = {"host": f"salient_target_{path.stem}", build: f"salient_{path.stem}.elf"}
    if not is_bundled:
        return _build_custom(path, names)
    programs = [BUILD / preset / "bin" / name for preset, name in names.items()]
    for program in programs:
        if not program.exists():
            raise UsageError(f"{program.relative_to(ROOT)} is not built; {_BUILDERS.get(build, _TESTS)} builds it")
    return programs


def _build_custom(path: Path, names: dict[str, str]) -> list[Path]:
    """Builds the programs (preset: name) for a user's machine file in a folder of the file, one process at a time."""
    if (MACHINES / path.name).exists():
        raise UsageError(f"{path}: a bundled machine has the name {path.stem}; rename the file")
    if not path.stem.isidentifier() or not path.stem.isascii():
        raise UsageError(f"{path}: the name of the file must be letters, digits and underscores")
    if shutil.which("cmake") is None:
        raise UsageError("cmake is missing; a machine file of your own requires a build")
    _remove_orphans()
    folder = BUILD / f"machine-{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (folder / "machine_file").write_text(str(path), encoding="utf-8")
        commands = []
        for preset, name in names.items():
            if not (folder / preset / "build.ninja").exists():
                commands.append(["cmake", "--preset", preset, "-B", str(folder / preset),
                                 f"-DSALIENT_MACHINE_FILE={path}"])
            commands.append(["cmake", "--build", str(folder / preset), "--target", name])
        log = folder / "build.log"

        def notice() -> None:
            print(f"salient: building the drive for {path}", file=sys.stderr, flush=True)

        if not run_commands(commands, ROOT, log, notice):
            raise EmulatorError(f"building the drive for {path} failed: see {log.relative_to(ROOT)}")
    return [folder / preset / "bin" / name for preset, name in names.items()]


def _remove_orphans() -> None:
    """Removes the builds of machine files that no longer exist."""
    for note in BUILD.glob("machine-*/machine_file"):
        try:
            if not Path(note.read_text(encoding="utf-8")).exists():
                shutil.rmtree(note.parent, ignore_errors=True)
        except OSError:
            continue  # another process removes it


# --- process --------------------------------------------------------------------------------------------------------

class EmulatorProcess:
    """A running executable, ended with this process or by close().

    prefix: a command that runs the executable's, such as a profiler.
    config: with the bus that it is on. command: its command line. ready: its JSON line. UsageError when it refuses its
    options, EmulatorError when it fails.
    """

    def __init__(self, config: BenchConfig, can: str, prefix: Sequence[str] = ()) -> None:
        self.config = replace(config, can=can)
        self.command = [*prefix, *command_line(self.config)]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - read as long as the object exists
        self._process = subprocess.Popen(
            [*self.command, "--follow-stdin"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )
        assert self._process.stdin is not None and self._process.stdout is not None  # pipes
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        line = self._stdout.readline()
        if not line:
            self._raise_failure(self._process.wait())
        self.ready = json.loads(line)

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """It has not ended; one that a debugger has stopped is alive."""
        return self._process.poll() is None

    @property
    def errors(self) -> str:
        """Its standard error so far."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()

    def close(self) -> None:
        """Ends it and waits: recording finished, socket removed. EmulatorError when its exit code is not 0."""
        if self.is_alive:
            self._stdin.close()
            self._process.wait()
        self._stdout.close()
        if self._process.returncode != 0:
            self._raise_failure(self._process.returncode)

    def __enter__(self) -> EmulatorProcess:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _raise_failure(self, code: int) -> None:
        errors = self.errors
        if code == 2:
            raise UsageError(errors.removeprefix("salient: "))
        raise EmulatorError(f"{self.command[0]} ended with {code}: {errors or 'its standard error is empty'}")


def parameter_table(config: BenchConfig) -> list[ParameterRow]:
    """The parameters of the drive of a test bench, read from a second drive, so that reading takes no time on the bus
    of an experiment."""
    return _parameter_table(replace(config, can="auto", pace="lockstep", record=None, record_step_ns=1000,
                                    record_from_us=0, record_switches=None, instructions=None, execution=None,
                                    instruction_ns=None))


@lru_cache
def _parameter_table(config: BenchConfig) -> list[ParameterRow]:
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        can = f"unix:{folder}/can.sock"
        with EmulatorProcess(config, can) as process, Session(
                can, is_alive=lambda: process.is_alive, machine=config.machine) as session:
            session.rig.truth_period_us = 0
            return read_parameter_table(session)
