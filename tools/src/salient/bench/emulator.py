"""Starts a drive and its bench in one process: the host executable, or QEMU with an image for one of its boards."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from salient.bench.drive import ParameterRow, read_parameter_table
from salient.bench.session import Session
from salient.elf import ElfImage
from salient.errors import UsageError
from salient.machine.file import MachineError, load_machine, machine_path
from salient.machine.firmware_tables import machine_phase_map
from salient.paths import BUILD, MACHINES, ROOT

_END_TIMEOUT_S = 60.0

TARGET_BUILDS = ("cortex-m4", "cortex-m4-O0", "cortex-m4-Os", "rv32")
"""The image for the Cortex-M4 as it is meant to be, without optimisation, and optimised for size; that for RV32."""


class SimulatorError(Exception):
    """The executable failed; the text has what it wrote."""


@dataclass(frozen=True)
class SimulatorOptions:
    """What a drive and its bench are started with; the executable checks the values.

    machine: a shipped machine's name or a machine file's path. encoder_bits 0: ideal. encoder_edges: the board captures
    the encoder's edges. adc_bits: 12..16. immediate_pwm: what the control writes acts at once, as with no converter
    there is; it is for the conditions of simulations. record: file for the true state
    (.npy), every record_step_ns from record_from_us on. record_switches: file for the compare values of each control
    period. build: host or sanitize, or one of TARGET_BUILDS for the firmware on a board of QEMU. instructions: file
    for the instructions of each control interrupt, uint32 little endian; execution: file for what the processor did,
    as salient.target.trace reads it; both in QEMU only. instruction_ns: time of an instruction, one of INSTRUCTION_NS,
    or None and the drive takes no time; on the Cortex-M4 only.
    """

    machine: str = "saturating"
    controller: str = "traditional"
    control_rate_hz: int = 40_000
    encoder_bits: int = 17
    encoder_edges: bool = False
    adc_bits: int = 12
    immediate_pwm: bool = False
    seed: int = 1
    initial_angle_deg: float = 0.0
    pace: str = "lockstep"
    bit_rate: int = 1_000_000
    record: Path | None = None
    record_step_ns: int = 1000
    record_from_us: int = 0
    record_switches: Path | None = None
    build: str = "host"
    instructions: Path | None = None
    execution: Path | None = None
    instruction_ns: int | None = None

    def arguments(self, can: str) -> list[str]:
        """The executable's command line on the bus `can`."""
        line = [
            *self._program(), "--can", can, "--pace", self.pace,
            "--controller", self.controller, "--control-rate-hz", str(self.control_rate_hz),
            "--encoder-bits", str(self.encoder_bits), "--seed", str(self.seed),
            "--initial-angle-deg", f"{self.initial_angle_deg:.17g}", "--bit-rate", str(self.bit_rate),
            "--adc-bits", str(self.adc_bits),
        ]  # fmt: skip
        if self.encoder_edges:
            line.append("--encoder-edges")
        if self.immediate_pwm:
            line.append("--immediate-pwm")
        if self.record is not None:
            line += ["--record", str(self.record), "--record-step-ns", str(self.record_step_ns)]
            line += ["--record-from-us", str(self.record_from_us)]
        if self.record_switches is not None:
            line += ["--record-switches", str(self.record_switches)]
        return line

    def _program(self) -> list[str]:
        program = executable(self.machine, self.build)
        if self.build not in TARGET_BUILDS:
            if self.instruction_ns is not None:
                raise UsageError(f"--instruction-ns {self.instruction_ns}: only with --target cortex-m4")
            return [str(program)]
        line = [str(program), str(image(self.machine, self.build))]
        if self.instructions is not None:
            line += ["--instructions", str(self.instructions)]
        if self.execution is not None:
            end, begin = ElfImage(image(self.machine, self.build)).stack()
            line += ["--execution", str(self.execution), f"{end:#x}-{begin:#x}"]
        if self.instruction_ns is not None:
            line += ["--instruction-ns", str(self.instruction_ns)]
        return line


@lru_cache
def executable(machine: str, build: str = "host") -> Path:
    """The executable for a machine; the one for a foreign machine file is built first. UsageError.

    Of a target build: the host's program that starts QEMU with image().
    """
    try:
        path = machine_path(machine)
        checked = load_machine(path)
        if path.parent != MACHINES:
            machine_phase_map(path, checked)  # or the build would fail
    except MachineError as error:
        raise UsageError(str(error)) from None
    needed = {"host": f"salient_target_{path.stem}", build: f"salient_{path.stem}.elf"}
    if build not in TARGET_BUILDS:
        needed = {build: f"salient_{path.stem}"}
    programs = [BUILD / preset / "bin" / name for preset, name in needed.items()]
    for preset, program in zip(needed, programs, strict=True):
        if path.parent != MACHINES:
            _build_foreign(path, program, preset)
        if not program.exists():
            builder = "tools/salient test --only target" if build in TARGET_BUILDS else "any tools/salient command"
            raise UsageError(f"{program.relative_to(ROOT)} is not built; {builder} builds it")
    return programs[0]


def image(machine: str, build: str) -> Path:
    """What executable() runs of a target build. UsageError."""
    executable(machine, build)
    return BUILD / build / "bin" / f"salient_{machine_path(machine).stem}.elf"


def _build_foreign(path: Path, program: Path, build: str) -> None:
    if (MACHINES / path.name).exists():
        raise UsageError(f"{path}: a shipped machine is called {path.stem}; give the file another name")
    if not path.stem.isidentifier() or not path.stem.isascii():
        raise UsageError(f"{path}: the file's name must be letters, digits and underscores")
    if shutil.which("cmake") is None:
        raise UsageError("cmake is missing, and a machine file of your own needs a build")
    log = BUILD / f"machine_{path.stem}.log"
    with log.open("wb") as output:
        for command in (
            ["cmake", "--preset", build, f"-DSALIENT_MACHINE_FILE={path}"],
            ["cmake", "--build", "--preset", build, "--target", program.name],
            # The build folder does not keep hold of a file that may go away.
            ["cmake", "--preset", build, "-DSALIENT_MACHINE_FILE="],
        ):
            if subprocess.run(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT).returncode != 0:
                raise SimulatorError(f"building for {path} failed: see {log.relative_to(ROOT)}")


class Simulator:
    """A running executable, ended with this process or by close().

    prefix: a command that runs the executable's, as a profiler's does.
    ready: what its JSON line said. UsageError when it refuses its options, SimulatorError when it fails.
    """

    def __init__(self, options: SimulatorOptions, can: str, prefix: Sequence[str] = ()) -> None:
        self.options = options
        self.can = can
        self.command = [*prefix, *options.arguments(can)]
        self._errors = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [*self.command, "--follow-stdin"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )
        line = self._process.stdout.readline()
        if not line:
            self._raise_failure(self._process.wait())
        self.ready = json.loads(line)

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    @property
    def errors(self) -> str:
        """What it wrote to its standard error so far."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()

    def close(self) -> None:
        """Lets it end: recording finished, socket removed. SimulatorError when it ends with anything but 0."""
        if self._process.poll() is None:
            self._process.stdin.close()
            try:
                self._process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process.stdout.close()
        if self._process.returncode != 0:
            self._raise_failure(self._process.returncode)

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    def _raise_failure(self, code: int) -> None:
        errors = self.errors
        if code == 2:
            raise UsageError(errors.removeprefix("salient: "))
        raise SimulatorError(f"{self.command[0]} ended with {code}: {errors or 'it wrote nothing'}")


def parameter_table(options: SimulatorOptions) -> list[ParameterRow]:
    """The parameters of the drive that these options start, asked from a drive of its own, so that asking takes no time
    on the bus of an experiment."""
    return _parameter_table(replace(options, record=None, record_switches=None, instructions=None, execution=None,
                                    instruction_ns=None, pace="lockstep"))


@lru_cache
def _parameter_table(options: SimulatorOptions) -> list[ParameterRow]:
    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        can = f"unix:{folder}/can.sock"
        with Simulator(options, can), Session(can) as session:
            session.rig.truth_period_us = 0
            return read_parameter_table(session)
