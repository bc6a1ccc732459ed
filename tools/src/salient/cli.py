"""The command line of tools/salient. Standard library only: the launcher reads it before anything is installed."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import NoReturn

from salient.compare_options import add_options as add_compare_options
from salient.version import VERSION

CONTROLLERS = ("traditional", "paper", "salient")
CONTROL_RATES_HZ = (20_000, 40_000, 50_000, 100_000, 1_000_000)
ENCODER_BITS = (0, *range(8, 25))
ADC_BITS = (12, 13, 14, 15, 16)
TARGETS = ("host", "cortex-m4", "rv32")
"""Where the firmware runs: in the bench's own process, or on a Cortex-M4 or RV32 that QEMU emulates."""
INSTRUCTION_NS = (1, 2, 4, 8, 16, 32, 64)
"""What an instruction of the Cortex-M4 may take; QEMU knows powers of two."""
LOG_SUFFIXES = (".blf", ".log")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line and exit code 2."""
        command = re.match(r"argument COMMAND: invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if command:
            message = f"no command {command[1]}: allowed are {command[2]}".replace("'", "")
        message = re.sub(r"^argument ([^:]*): ", r"\1 ", message)
        print(f"salient: {message} ({self.prog} --help)", file=sys.stderr)
        sys.exit(2)


def make_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = _Parser(prog="tools/salient", description="Salient: a switched-reluctance drive and its bench.")
    parser.add_argument("--version", action="version", version=f"salient {VERSION}")
    parser.add_argument("--no-install", action="store_true", help="name what is missing instead of installing it")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)

    def command(name: str, text: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=text, description=text, prog=f"tools/salient {name}")
        made.add_argument("--no-install", action="store_true", default=argparse.SUPPRESS,
                          help="name what is missing instead of installing it")
        return made

    demo = command("demo", "the paper's two experiments by every controller, with report and CAN logs")
    demo.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="folder (default out/demo)")
    demo.add_argument("--machine", metavar="NAME|FILE", help="machine (default saturating)")
    demo.add_argument("--control-rate-hz", type=_one_of(CONTROL_RATES_HZ), metavar="N", help="default 40000")
    demo.add_argument("--encoder-bits", type=_one_of(ENCODER_BITS), metavar="N", help="default 17; 0 is ideal")
    demo.add_argument("--seed", type=_seed, metavar="N", help="default 1")

    _add_target(demo)

    test = command("test", "every test; ends with the numbers of passed and failed")
    test.add_argument("--only", action="append", type=_one_of(TEST_STEPS), metavar="STEP",
                      help=f"one step only, may be repeated: {', '.join(TEST_STEPS)}")

    sim = command("sim", "the drive and its bench until interrupted; prints one JSON line when ready")
    sim.add_argument("--machine", default="saturating", metavar="NAME|FILE", help="default saturating")
    sim.add_argument("--controller", type=_one_of(CONTROLLERS), default="paper", help="traditional or paper (default)")
    sim.add_argument("--can", type=_can, default="auto", metavar="BUS",
                     help="unix:PATH, socketcan:INTERFACE or auto (default): vcan0 where it is up, else "
                     "unix:build/salient.sock")
    sim.add_argument("--pace", type=_pace, default="realtime", help="lockstep, realtime (default), xN or free")
    sim.add_argument("--seed", type=_seed, default=1, metavar="N", help="default 1")
    sim.add_argument("--control-rate-hz", type=_one_of(CONTROL_RATES_HZ), default=40_000, metavar="N",
                     help="20000, 40000 (default), 50000, 100000 or 1000000")
    sim.add_argument("--encoder-bits", type=_one_of(ENCODER_BITS), default=17, metavar="N",
                     help="8 to 24, default 17; 0 is ideal")
    sim.add_argument("--encoder-edges", action="store_true", help="the board captures the encoder's edges")
    sim.add_argument("--adc-bits", type=_one_of(ADC_BITS), default=12, metavar="N", help="12 (default) to 16")
    sim.add_argument("--immediate-pwm", action="store_true",
                     help="duties act at once, not in the next control period, as no converter does")
    sim.add_argument("--initial-angle-deg", type=float, default=0.0, metavar="X", help="-360 to 360, default 0")
    sim.add_argument("--bit-rate", type=int, default=1_000_000, metavar="N", help="of the bus, default 1000000")

    _add_target(sim)
    _add_instruction_ns(sim)

    run = command("run", "one scenario, to a folder")
    run.add_argument("scenario", type=Path, metavar="SCENARIO.toml")
    run.add_argument("--out", type=Path, metavar="DIR", help="folder (default out/NAME)")
    _add_target(run)
    _add_instruction_ns(run)

    log = command("log", "record a running bus until it ends, or is interrupted")
    log.add_argument("--can", type=_can, default="auto", metavar="BUS", help="as with sim")
    log.add_argument("--out", type=_log_path, default=Path("out/can.blf"), metavar="FILE",
                     help="FILE.blf or FILE.log, candump text (default out/can.blf)")
    log.add_argument("--duration-s", type=_positive, metavar="X", help="end after so much virtual time")

    monitor = command("monitor", "watch a running drive, one line of values each period")
    monitor.add_argument("--can", type=_can, default="auto", metavar="BUS", help="as with sim")
    monitor.add_argument("--every-s", type=_positive, default=0.1, metavar="X", help="virtual time, default 0.1")
    monitor.add_argument("--duration-s", type=_positive, metavar="X", help="end after so much virtual time")

    bench = command("bench", "the figures of the README: speed, also beside SciPy and ngspice; worth of the network")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    bench.add_argument("--runs", type=int, default=5, metavar="N", help="runs of each kind, default 5")

    add_compare_options(command("compare", "the controllers beside each other, what is wanted, and an earlier run"))

    machine = command("machine", "check a machine file, say what is in it, draw its magnetics")
    machine.add_argument("machine", metavar="NAME|FILE")
    machine.add_argument("--out", type=Path, default=Path("out/machine"), metavar="DIR",
                         help="folder of the picture (default out/machine)")

    pil = command("pil", "processor in the loop: a scenario on the target, and what the processor did")
    task = pil.add_mutually_exclusive_group(required=True)
    task.add_argument("scenario", type=Path, nargs="?", metavar="SCENARIO.toml")
    pil.add_argument("--out", type=Path, metavar="DIR", help="folder (default out/pil_NAME)")
    pil.add_argument("--target", type=_one_of(TARGETS[1:]), default=TARGETS[1], metavar="NAME",
                     help=f"{', '.join(TARGETS[1:])} (default {TARGETS[1]})")
    task.add_argument("--search", type=_positive, metavar="SECONDS",
                     help="instead: look for dearer interrupts than those known, so long for each controller")
    pil.add_argument("--seed", type=_seed, default=1, metavar="N", help="of the search, default 1")
    task.add_argument("--figures", action="store_true",
                     help="instead: measure the committed figures of the target again and write them")
    return parser


TEST_STEPS = ("style", "unit", "sanitize", "target", "hil", "plant", "tools", "socketcan")
"""The steps of `test`, in order."""


def _add_target(command: argparse.ArgumentParser) -> None:
    command.add_argument("--target", type=_one_of(TARGETS), default="host", metavar="NAME",
                         help="host (default), or cortex-m4 or rv32: the same firmware in QEMU")


def _add_instruction_ns(command: argparse.ArgumentParser) -> None:
    command.add_argument("--instruction-ns", type=_one_of(INSTRUCTION_NS), metavar="N",
                         help="what an instruction takes on the cortex-m4: 1, 2, 4, 8, 16, 32 or 64; without it "
                         "the drive takes no time")


def _one_of(allowed: tuple):
    def convert(text: str):
        for value in allowed:
            if text == str(value):
                return value
        raise argparse.ArgumentTypeError(f"{text}: allowed are {', '.join(map(str, allowed))}")

    return convert


def _seed(text: str) -> int:
    if not re.fullmatch("[0-9]+", text) or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"{text}: allowed are whole numbers from 0 to {2**63 - 1}")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: allowed are numbers above 0")
    return value


def _pace(text: str) -> str:
    if text not in ("lockstep", "realtime", "free") and not re.fullmatch(r"x[0-9]*\.?[0-9]+", text):
        raise argparse.ArgumentTypeError(f"{text}: allowed are lockstep, realtime, free and xN, N times real time")
    return text


def _can(text: str) -> str:
    if text != "auto" and not re.fullmatch(r"(unix|socketcan):.+", text):
        raise argparse.ArgumentTypeError(f"{text}: allowed are auto, unix:PATH and socketcan:INTERFACE")
    return text


def _log_path(text: str) -> Path:
    path = Path(text)
    if path.suffix not in LOG_SUFFIXES:
        raise argparse.ArgumentTypeError(f"{text}: the file's suffix must be {' or '.join(LOG_SUFFIXES)}")
    return path
