"""The configuration of a test bench: every option of the drive and its emulator, written once.

From the record BenchConfig follow
- the options of `sim`, `demo` and `run` (salient.cli),
- the keys of a scenario and of a worst-case input (salient.toml_file makes their types),
- the keywords of the pytest fixtures `bench` and `make_bench`,
- the command line of the host executable (salient.generate.options writes its table in C).

Standard library only: the launcher imports this module before anything is installed.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

CONTROLLERS = ("traditional", "paper", "salient")
"""Numbered as drive_controller_t of the firmware."""
PROTOCOLS = ("salient", "canopen")
"""From 0: protocol_index of the executable's options."""
HOST_BUILDS = ("host", "debug", "sanitize")
TARGET_BUILDS = ("cortex-m4", "cortex-m4-O0", "cortex-m4-Os", "rv32")
"""Images for boards of QEMU: Cortex-M4 with -O2, -O0 and -Os, and RV32."""
WASM_BUILD = "wasm"
"""Firmware and emulator in WebAssembly, run by Node (salient.bench.wasm)."""
TARGETS = ("host", "cortex-m4", "rv32")
"""Builds that a command offers: the process of the emulator, or QEMU."""
BOARD_BUILD = "stm32g4"
"""Image for the NUCLEO-G474RE in the register-level model of its part (emulator/stm32g4)."""
PACES = ("lockstep", "realtime", "free")
PACE_FACTOR_MIN, PACE_FACTOR_MAX = 0.01, 1000.0
"""PACING_FACTOR_MIN and PACING_FACTOR_MAX of emulator/rig/pacing.h."""
NODE_MAX = 7
BUSES = "unix:PATH or socketcan:INTERFACE"
LOG_SUFFIXES = (".asc", ".mf4", ".csv", ".parquet", ".blf", ".log")
"""Formats of a log that is written: ASC, BLF and the text of candump -L, and MF4, CSV and Parquet of signals."""
READABLE_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc", ".txt")
"""Formats of a log that is read."""
ROTATION_UNITS = {"kB": 1000, "MB": 1000**2, "GB": 1000**3, "s": 1_000_000_000, "min": 60_000_000_000,
                  "h": 3_600_000_000_000}
"""Bytes or nanoseconds of a unit."""


@dataclass(frozen=True)
class Rotation:
    """When a log continues in another file: after as many bytes, or as much time between its frames."""

    limit: int
    is_time: bool

    @staticmethod
    def parse(text: str) -> Rotation:
        """Reads 100MB or 10min; ValueError names what is allowed."""
        match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?) ?([a-zA-Z]+)", text, re.ASCII)
        units = {unit.lower(): unit for unit in ROTATION_UNITS}
        unit = units.get(match[2].lower()) if match else None
        if match is None or unit is None or float(match[1]) <= 0.0:
            raise ValueError(f"must be a size or a time above 0, in {either(ROTATION_UNITS)}, as 100MB or 10min")
        return Rotation(max(1, round(float(match[1]) * ROTATION_UNITS[unit])), unit in ("s", "min", "h"))


FLAG, INTEGER, NUMBER, WORD, FILE, BUS, PACE = "flag", "integer", "number", "word", "file", "bus", "pace"
MACHINE = "machine"
"""Kinds of options."""


@dataclass(frozen=True)
class Option:
    """The part of a field that its name, type and default do not state.

    choices: the values allowed; without choices minimum and maximum bound an integer or number, both included.
    commands: the commands of tools/salient that have the option. flag: its name there, when it is not the field's.
    argument: the host executable has it as well.
    """

    kind: str
    help: str
    metavar: str = ""
    choices: tuple[Any, ...] = ()
    minimum: int | float = 0
    maximum: int | float = 0
    commands: tuple[str, ...] = ()
    flag: str = ""
    argument: bool = True

    @property
    def allowed(self) -> str:
        """The values allowed, as the end of a sentence that begins with "must be"."""
        if self.choices:
            runs = _runs(self.choices)
            return f"a whole number from {runs[0]}" if len(runs) == 1 else either(runs)
        return {
            FLAG: "true or false",
            INTEGER: f"a whole number from {self.minimum} to {self.maximum}",
            NUMBER: f"a number from {_plain(self.minimum)} to {_plain(self.maximum)}",
            FILE: "the name of a file",
            MACHINE: "the name of a machine or the path of a machine file",
            BUS: BUSES,
            PACE: either([*PACES, f"xN with N from {PACE_FACTOR_MIN:g} to {PACE_FACTOR_MAX:g}"]),
        }[self.kind]

    def parse(self, text: str) -> Any:
        """The value that a text on a command line means; ValueError: it is not allowed."""
        if self.kind == INTEGER and re.fullmatch("[0-9]{1,20}", text):
            number = int(text)
            if number in self.choices if self.choices else self.minimum <= number <= self.maximum:
                return number
        elif self.kind == NUMBER and re.fullmatch(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?", text):
            value = float(text)
            if self.minimum <= value <= self.maximum:
                return value
        elif self.kind == FILE and text:
            return Path(text)
        elif self._is_text(text):
            return text
        raise ValueError(f"must be {self.allowed}")

    def _is_text(self, text: str) -> bool:
        """True for an allowed value of an option that is a text."""
        return {
            WORD: text in self.choices,
            BUS: re.fullmatch(r"(unix|socketcan):.+", text) is not None,
            PACE: text in PACES or _is_pace_factor(text),
            MACHINE: text != "",
        }.get(self.kind, False)


def either(values: Iterable[object]) -> str:
    """A, B or C."""
    *first, last = map(str, values)
    return f"{', '.join(first)} or {last}" if first else last


def _plain(number: float) -> str:
    """Without an exponent."""
    return f"{number:.9f}".rstrip("0").rstrip(".")


def _runs(choices: tuple[Any, ...]) -> list[str]:
    """The choices, three or more consecutive integers as a range."""
    parts: list[list[Any]] = []
    for choice in choices:
        if parts and isinstance(choice, int) and choice == parts[-1][-1] + 1:
            parts[-1].append(choice)
        else:
            parts.append([choice])
    return [text for part in parts
            for text in ([f"{part[0]} to {part[-1]}"] if len(part) > 2 else map(str, part))]


def _is_pace_factor(text: str) -> bool:
    return bool(re.fullmatch(r"x[0-9]*\.?[0-9]+", text)) and PACE_FACTOR_MIN <= float(text[1:]) <= PACE_FACTOR_MAX


def _option(default: Any, kind: str, text: str, **details: Any) -> Any:
    return dataclasses.field(default=default, metadata={"option": Option(kind, text, **details)})


_CONDITION = ("sim", "demo")


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """The drive and the conditions under which it runs: the options that a scenario has as well."""

    machine: str = _option("saturating", MACHINE, "machine", metavar="NAME|FILE", commands=_CONDITION, argument=False)
    true_machine: str | None = _option(None, MACHINE, "machine of the emulated motor, converter and supply, where it "
                                       "differs from the firmware's, its DBC's and the tools'", metavar="NAME|FILE",
                                       commands=("sim", "demo", "run", "pil"), argument=False)
    controller: str = _option("salient", WORD, "controller at the start", metavar="NAME", choices=CONTROLLERS,
                              commands=("sim",))
    control_rate_hz: int = _option(40_000, INTEGER, "rate of the control interrupt in Hz", metavar="N",
                                   choices=(20_000, 40_000, 50_000, 100_000, 1_000_000), commands=_CONDITION)
    encoder_bits: int = _option(17, INTEGER, "resolution of the encoder, 0 for an ideal one", metavar="N",
                                choices=(0, *range(8, 25)), commands=_CONDITION)
    encoder_edges: bool = _option(False, FLAG, "the board captures the edges of the encoder", commands=("sim",))
    adc_bits: int = _option(12, INTEGER, "resolution of the analogue-to-digital converters", metavar="N",
                            choices=(12, 13, 14, 15, 16), commands=("sim",))
    immediate_pwm: bool = _option(False, FLAG, "compare values act in the period that writes them, as in simulations "
                                  "and no converter", commands=("sim",))
    seed: int = _option(1, INTEGER, "seed of noise, of frame faults and of the challenges; without noise and such "
                        "faults it changes no motion", metavar="N", maximum=2**64 - 1, commands=_CONDITION)
    initial_angle_deg: float = _option(0.0, NUMBER, "rotor angle at the start", metavar="X", minimum=-360.0,
                                       maximum=360.0, commands=("sim",))


@dataclass(frozen=True, kw_only=True)
class BenchConfig(Conditions):
    """A drive and its test bench.

    can: the bus, "auto" until a command or a fixture has chosen one. machine_image: of `machine` with
    the plant of `true_machine`, from the cache unless given. build: a CMake preset, of HOST_BUILDS or
    TARGET_BUILDS or WASM_BUILD. instructions, execution, instruction_ns: in QEMU only, the last on the Cortex-M4 only;
    instructions gets the instruction count of each control interrupt (uint32, little endian) and a file beside it the
    count of each deferred interrupt (deferred_instructions), execution what salient.target.trace reads. instruction_ns
    None: the firmware takes no simulated time.
    """

    can: str = _option("auto", BUS, "CAN bus", metavar="BUS", commands=("sim",))
    pace: str = _option("realtime", PACE, "speed of virtual time", metavar="PACE",
                        commands=("sim",))
    bit_rate: int = _option(1_000_000, INTEGER, "bit rate of the emulated bus", metavar="N", minimum=10_000,
                            maximum=1_000_000, commands=("sim",))
    drive_only: bool = _option(False, FLAG, "the bus carries the drive alone; of the test bench only replies, no true "
                               "state and on SocketCAN no virtual time", commands=("sim",))
    machine_image: Path | None = _option(None, FILE, "the machine, as salient.generate.machine writes it",
                                         metavar="FILE")
    node: int = _option(0, INTEGER, "node number of the drive on the bus, of the first one of several", metavar="N",
                        maximum=NODE_MAX, commands=("sim",))
    drives: int = _option(1, INTEGER, "drives on the bus, each on a bench of its own, with ascending node numbers",
                          metavar="N", minimum=1, maximum=NODE_MAX + 1, commands=("sim",))
    protocol: str = _option("salient", WORD, "protocol on the bus at the start: drive.dbc, or CANopen with the "
                            "node-ID node + 1", metavar="NAME", choices=PROTOCOLS, commands=("sim",))
    telemetry_period_ms: int | None = _option(None, INTEGER, "period of the drive's fast telemetry at the start in ms; "
                                              "without it the default of the parameter", metavar="N", minimum=1,
                                              maximum=100, commands=("sim",))
    memory: Path | None = _option(None, FILE, "keeps the drive's non-volatile memory in a file, which is made when it "
                                  "does not exist; without it the memory is erased at the start", metavar="FILE",
                                  commands=("sim",))
    record: Path | None = _option(None, FILE, "records the true state", metavar="FILE.npy")
    record_step_ns: int = _option(1000, INTEGER, "step of the recording", metavar="N", minimum=100,
                                  maximum=1_000_000_000)
    record_from_us: int = _option(0, INTEGER, "virtual time at which the recording begins", metavar="N",
                                  maximum=(2**64 - 1) // 1000)
    record_switches: Path | None = _option(None, FILE, "records the compare values of each control period, for other "
                                           "simulators", metavar="FILE")
    stop_at_s: float | None = _option(None, NUMBER, "virtual time at which it ends; not with --pace lockstep",
                                      metavar="X", minimum=1e-6, maximum=281_474.0)
    follow_stdin: bool = _option(False, FLAG, "ends when standard input does")
    build: str = _option("host", WORD, "processor that runs the firmware: the host, one that QEMU emulates, "
                         "or a board's part in a register-level model",
                         metavar="NAME", choices=(*TARGETS, BOARD_BUILD), commands=("sim", "demo", "run"),
                         flag="target", argument=False)
    program: Path | None = _option(None, FILE, "executable of another project instead of the build's",
                                   argument=False)
    instructions: Path | None = _option(None, FILE, "instruction counts", argument=False)
    execution: Path | None = _option(None, FILE, "execution trace", argument=False)
    instruction_ns: int | None = _option(None, INTEGER, "time of an instruction on the cortex-m4; without it the "
                                         "firmware takes no time", metavar="N", choices=(1, 2, 4, 8, 16, 32, 64),
                                         commands=("sim", "run"), argument=False)

    def arguments(self) -> list[str]:
        """The options of the host executable, each with its value: a command line in a log is complete."""
        line = []
        for name, option in OPTIONS.items():
            value = getattr(self, name)
            if not option.argument or value is None or value is False:
                continue
            if name in ("record_step_ns", "record_from_us") and self.record is None:
                continue  # the executable rejects them without a recording
            line.append(flag_of(name))
            if option.kind != FLAG:
                line.append(f"{value:.17g}" if option.kind == NUMBER else str(value))
        return line


OPTIONS: dict[str, Option] = {field.name: field.metadata["option"] for field in dataclasses.fields(BenchConfig)}
"""The options of a test bench by the name of their field."""
DEFAULTS: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(BenchConfig)}
CONDITIONS = tuple(field.name for field in dataclasses.fields(Conditions))


def flag_of(name: str) -> str:
    """The option of a field on a command line."""
    return "--" + (OPTIONS[name].flag or name).replace("_", "-")


def description(name: str) -> str:
    """Meaning, values allowed and default, for a usage text."""
    option, default = OPTIONS[name], DEFAULTS[name]
    if option.kind in (FLAG, FILE):
        return option.help
    shown = _plain(default) if option.kind == NUMBER and default is not None else default
    return f"{option.help}: {option.allowed}" + ("" if default is None or option.kind == BUS else f" (default {shown})")
