"""The command line of tools/salient. Standard library only: the launcher imports this module before anything is
installed."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn

from salient.config import (
    BUSES,
    CONDITIONS,
    DEFAULTS,
    FLAG,
    LOG_SUFFIXES,
    OPTIONS,
    READABLE_SUFFIXES,
    TARGETS,
    Rotation,
    description,
    either,
    flag_of,
)
from salient.errors import close_names
from salient.paths import BUILD, COMMAND, IS_WHEEL, OUT, from_root
from salient.version import VERSION

TEST_STEPS = ("style", "unit", "sanitize", "target", "hil", "plant", "tools", "socketcan")
"""The steps of `test`, in order."""
CLONE_ONLY = ("test", "benchmark", "pil", "wheel", "tab", "campaign", "replay", "docs", "evidence", "board")
"""Commands that need the sources."""
BOARD_CLOCKS = ("170", "100")
BOARD_ENCODERS = ("absolute", "index")
_SHOWN_OUT, _SHOWN_BUILD = (text.replace("%", "%%") for text in (str(OUT), from_root(BUILD)))
"""For argparse, which formats a text of help."""
_SECONDS_MAX = 1e9
"""A time in seconds is at most 31 years: 64 bits of nanoseconds, and the clocks of the system, can have it."""
CHANGE_PERCENT = 10.0
"""Smaller changes of a ripple, which is an extreme of one run, are within its scatter."""


class _Parser(argparse.ArgumentParser):
    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # By itself argparse takes -1e3, -1,2 and -inf for options, which then lack their value or are not known.
        self._negative_number_matcher = re.compile(r"-(\.?\d|inf|nan)", re.ASCII | re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        """One line and exit code 2."""
        message = re.sub(r"^argument ([^:]*): expected (?:at least )?one argument$", r"\1: requires a value", message)
        message = re.sub(r"^argument ([^:]*): not allowed with argument ", r"\1: not allowed with ", message)
        message = re.sub(r"^argument ([^:]*): ", r"\1 ", message)
        print(f"salient: {' '.join(message.splitlines())} ({self.prog} --help)", file=sys.stderr)
        sys.exit(2)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:  # COMMAND or ACTION: no option has choices
            self.error(f"unknown {str(action.metavar).lower()} '{value}': {close_names(value, action.choices)}")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Names a misspelt option ahead of what is missing because of it, and leaves no argument to the parser above,
        which knows the options of no command."""
        for option in sys.argv[1:] if args is None else args:
            if option == "--" or (self._subparsers and not option.startswith("-")):
                break  # the rest is for the command
            name = option.partition("=")[0]
            if name.startswith("--") and " " not in name and not any(
                    known.startswith(name) for known in self._option_string_actions):
                self._unrecognised(name)
        parsed, others = super().parse_known_args(args, namespace)
        if others:
            self._unrecognised(" ".join(others))
        return parsed, others

    def _unrecognised(self, text: str) -> NoReturn:
        options = [name for name in self._option_string_actions if name.startswith("--")]
        near = f"; {close_names(text.split(maxsplit=1)[0], options)}" if text.startswith("-") else ""
        self.error(f"unrecognised argument {text}{near}")


def make_parser() -> argparse.ArgumentParser:  # noqa: PLR0915 - a list of commands and options, without a branch
    """All commands and their options."""
    parser = _Parser(prog=COMMAND, description="Salient: a switched-reluctance drive and its test bench.")
    parser.add_argument("--version", action="version", version=f"salient {VERSION}")
    parser.add_argument("--no-install", action="store_true", help="name what is missing instead of installing it")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)

    def command(name: str, text: str) -> argparse.ArgumentParser:
        if IS_WHEEL and name in CLONE_ONLY:
            return _Parser()
        made = commands.add_parser(name, help=text, description=text, prog=f"{COMMAND} {name}")
        made.add_argument("--no-install", action="store_true", default=argparse.SUPPRESS,
                          help="name what is missing instead of installing it")
        return made

    demo = command("demo", "the paper's two experiments with every controller, with report and CAN logs")
    demo.add_argument("--out", type=Path, default=OUT / "demo", metavar="DIR", help="folder (default %(default)s)")
    _add_bench_options(demo, "demo")
    # Options that are not given leave the scenarios of the demo as they are.
    demo.set_defaults(**{name: None for name in CONDITIONS if "demo" in OPTIONS[name].commands})

    test = command("test", "all tests; the last line has the numbers of passed and failed")
    test.add_argument("--only", action="append", type=_one_of(TEST_STEPS), metavar="STEP",
                      help=f"one step only, may be repeated: {', '.join(TEST_STEPS)}")
    test.add_argument("--thorough", action="store_true",
                      help="all tests that take long, not only those whose turn it is with this commit")

    sim = command("sim", "the drive and its test bench until interrupted; prints one JSON line when ready")
    _add_bench_options(sim, "sim")
    sim.set_defaults(**{name: None for name in CONDITIONS if name != "machine"})  # as the machine file states

    run = command("run", "one scenario, to a folder")
    run.add_argument("scenario", type=Path, metavar="SCENARIO.toml")
    run.add_argument("--out", type=Path, metavar="DIR", help=f"folder (default {_SHOWN_OUT}/NAME)")
    _add_bench_options(run, "run")

    log = command("log", "record a running bus until it ends, or is interrupted; or convert a log")
    source = log.add_mutually_exclusive_group()
    _add_can(source)
    source.add_argument("--convert", type=Path, metavar="FILE",
                        help=f"instead: the frames of a log ({', '.join(READABLE_SUFFIXES)}; also with .gz), into "
                        "the format of --out")
    log.add_argument("--out", type=_log_path, default=OUT / "can.blf", metavar="FILE",
                     help="FILE.blf, FILE.asc, FILE.log (candump text), or decoded signals: FILE.mf4, FILE.csv, "
                     "FILE.parquet (default %(default)s)")
    log.add_argument("--rotate", type=_rotation, metavar="SIZE|TIME",
                     help="continue in FILE_0002 and so on after this size or time, as 100MB or 10min")
    log.add_argument("--duration-s", type=_positive, metavar="X", help="virtual time after which it ends")
    _add_machine(log, "whose signals are decoded: ")
    _add_node(log)
    _add_databases(log, "whose signals are decoded, too, where --out has decoded signals")

    monitor = command("monitor", "watch a running drive, or a log, one line of values per period")
    watched = monitor.add_mutually_exclusive_group()
    _add_can(watched)
    watched.add_argument("--replay", type=Path, metavar="FILE", help="instead: a log, as log --convert reads it")
    monitor.add_argument("--every-s", type=_positive, default=0.1, metavar="X",
                         help="period in virtual time (default 0.1)")
    monitor.add_argument("--duration-s", type=_positive, metavar="X", help="virtual time after which it ends")
    monitor.add_argument("--signals", nargs="+", metavar="NAME",
                         help="these signals of drive, test bench and --dbc: MESSAGE.SIGNAL, or SIGNAL where only one "
                         "message has it, or MESSAGE for all of it")
    monitor.add_argument("--bus", action="store_true",
                         help="the traffic instead: load, cycle times beside the expected ones, missing and unknown "
                         "messages, by node, as a table per period")
    _add_machine(monitor)
    _add_node(monitor)
    _add_databases(monitor, "whose signals can be named, and whose messages are watched")
    _add_bit_rates(monitor)

    commands_from_shell = command("command", "command a running drive and its test bench from a shell")
    actions = commands_from_shell.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=_Parser)
    for name, metavar, text in (
            ("speed", "RPM", "arm the drive and run it at a speed, then stop it: after --duration-s or by Ctrl-C (a "
             "second one opens the switches at once)"),
            ("torque", "NM", "likewise with a torque"),
            ("position", "DEG", "likewise with a move to an absolute position"),
            ("load", "NM", "set the load torque of the test bench"),
            ("stop", None, "ramp the drive to zero, taking over from the command that runs it"),
            ("clear", None, "clear a fault"),
            ("arm", None, "arm the drive and let it be, to see that it can be armed; speed, torque and position do it "
             "by themselves")):
        action = actions.add_parser(name, help=text, description=text, prog=f"{COMMAND} command {name}")
        if metavar is not None:
            action.add_argument("value", type=_finite, metavar=metavar)
        if name in ("speed", "torque", "position"):
            action.add_argument("--duration-s", type=_positive, metavar="X",
                                help="virtual time after which it stops the drive (default: when interrupted)")
        _add_can(action)
        _add_machine(action)
        _add_node(action)

    view = command("view", "the live page of a running drive, or of a log, in a browser; prints its link")
    shown = view.add_mutually_exclusive_group()
    _add_can(shown)
    shown.add_argument("--replay", type=Path, metavar="FILE",
                       help="instead: a log, as log --convert reads it, or the folder of a failed test")
    _add_machine(view, "whose poles and signals are shown: ")
    _add_node(view)
    _add_databases(view, "whose signals are shown, too")
    _add_bit_rates(view)
    view.set_defaults(node=None)  # a failed test has noted them

    tab = command("tab", "the live page with a drive inside, as one file for a browser: no installation, no server")
    tab.add_argument("--out", type=Path, default=OUT / "tab.html", metavar="FILE",
                     help="the file (default %(default)s)")
    tab.add_argument("--machine", metavar="NAME|FILE", help="one more machine than the bundled ones: a machine file")

    benchmark = command("benchmark", "performance: speed, also compared with SciPy and "
                        "ngspice; effect of the network")
    benchmark.add_argument("--json", type=Path, metavar="FILE", help="also write the results to a file")
    benchmark.add_argument("--runs", type=_count, default=5, metavar="N", help="runs of each kind (default 5)")
    benchmark.add_argument("--page", type=_positive, nargs="?", const=20.0, metavar="SECONDS",
                           help="instead: the live page in Chromium for this wall time (default 20)")
    benchmark.add_argument("--tab", action="store_true", help="instead: the drive in a tab, in Chromium")

    _add_compare_options(command("compare", "the controllers compared with each other, their targets and an earlier "
                                 "run"))

    _add_sweep_options(command("sweep", "a scenario over parameters, machines, controllers, loads and "
                               "seeds: one table"))

    machine = command("machine", "check a machine file, summarise it, list what follows for its drive, draw its "
                      "magnetics")
    machine.add_argument("machine", metavar="NAME|FILE")
    machine.add_argument("--out", type=Path, default=OUT / "machine", metavar="DIR",
                         help="folder of the plot, and of what --import writes (default %(default)s)")
    machine.add_argument("--import", dest="table", type=Path, metavar="FILE",
                         help="first import a table of flux linkages of any layout (CSV, text, MAT) as the map of the "
                         "machine: writes its machine file with the map to the folder")
    machine.add_argument("--json", type=Path, metavar="FILE", help="also write the drive's data to a file")
    machine.add_argument("--a2l", type=Path, metavar="FILE.a2l",
                         help="also write the A2L file of its drive, for measurement and calibration tools (XCP)")
    machine.add_argument("--eds", type=Path, metavar="FILE.eds",
                         help="also write the electronic data sheet of its drive as a CANopen device")
    machine.add_argument("--dbc", type=Path, metavar="FILE.dbc",
                         help="also write the CAN database of its drive, with the factors and ranges of this machine")
    _add_node(machine)

    pil = command("pil", "processor in the loop: a scenario on the target, and its load on the processor")
    task = pil.add_mutually_exclusive_group(required=True)
    task.add_argument("scenario", type=Path, nargs="?", metavar="SCENARIO.toml")
    pil.add_argument("--out", type=Path, metavar="DIR", help=f"folder (default {_SHOWN_OUT}/pil_NAME)")
    _add_bench_options(pil, "pil")
    pil.add_argument("--target", type=_one_of(TARGETS[1:]), default=TARGETS[1], metavar="NAME",
                     help=f"{either(TARGETS[1:])} (default {TARGETS[1]})")
    task.add_argument("--bound", nargs="?", const="all", metavar="VARIANT",
                      help="instead: compute the bound of the interrupts of the target from its machine code; with the "
                      "name of a variant its longest path by function")
    task.add_argument("--figures", action="store_true",
                     help="instead: repeat the measurements of the committed baseline and write it")

    board = command("board", "an image for the board NUCLEO-G474RE, never run on hardware")
    actions = board.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=_Parser)
    text = "build the image for a machine: ELF, BIN and HEX, and a line with the flash and RAM that it takes"
    action = actions.add_parser("build", help=text, description=text, prog=f"{COMMAND} board build")
    for name in ("machine", "controller", "node", "bit_rate"):
        action.add_argument(flag_of(name), dest=name, type=_option_type(name), default=DEFAULTS[name],
                            metavar=OPTIONS[name].metavar, help=description(name))
    action.add_argument("--clock", type=_one_of(BOARD_CLOCKS), default=BOARD_CLOCKS[0], metavar="MHZ",
                        help=f"clock of processor and timers: {either(BOARD_CLOCKS)}, the second for comparison with "
                        f"the emulator (default {BOARD_CLOCKS[0]})")
    action.add_argument("--encoder", type=_one_of(BOARD_ENCODERS), default=BOARD_ENCODERS[0], metavar="KIND",
                        help=f"{either(BOARD_ENCODERS)}: it counts to its absolute position at power-up, or is "
                        "absolute after its index has passed, before which no switch closes (default "
                        f"{BOARD_ENCODERS[0]})")
    action.add_argument("--stored-tables", action="store_true", help="the drive takes the tables of another machine "
                        "file over CAN (tables); its laws are not compiled for one machine")
    action.add_argument("--out", type=Path, default=OUT / "board", metavar="DIR", help="folder (default %(default)s)")
    text = "write an image into the flash of a board, by OpenOCD or st-flash"
    action = actions.add_parser("flash", help=text, description=text, prog=f"{COMMAND} board flash")
    action.add_argument("file", type=Path, metavar="FILE", help="of board build: .elf, .hex or .bin")

    campaign = command("campaign", "random worlds by seed, judged by the plant: faults, hostile clients, machines; "
                       "exit code 1 when a property is violated")
    campaign.add_argument("--seeds", type=_seeds, default=1000, metavar="N", help="number of seeds (default 1000)")
    campaign.add_argument("--first", type=_seed, default=1, metavar="SEED", help="the first one (default 1)")
    campaign.add_argument("--shard", type=shard, default=(1, 1), metavar="I/N",
                          help="every N-th seed only, beginning with the I-th; shards may share a folder")
    campaign.add_argument("--scheduler", metavar="ADDRESS",
                          help="Dask scheduler, tcp://HOST:PORT, whose workers have this installation")
    campaign.add_argument("--out", type=Path, default=OUT / "campaign", metavar="DIR",
                          help="folder (default %(default)s); what it has of these seeds is not run again")
    campaign.add_argument("--jobs", type=_count, metavar="N", help="simultaneous runs (default: number of cores)")
    campaign.add_argument("--healthy", dest="kind", action="store_const", const="healthy", default="faults",
                          help="worlds without faults instead, in which a fault of the drive is a false alarm")
    campaign.add_argument("--motion", dest="kind", action="store_const", const="motion", default="faults",
                          help="worlds of positions instead, by drive.dbc or a CANopen master")
    campaign.add_argument("--no-shrink", action="store_true", help="write no folders of failures")

    replay = command("replay", "a seed of a campaign, or a failure that it left, once more on the usual bench, with "
                     "log and plot")
    replay.add_argument("what", metavar="SEED|FOLDER")
    replay.add_argument("--healthy", dest="kind", action="store_const", const="healthy", default="faults",
                        help="the seed is one of campaign --healthy")
    replay.add_argument("--motion", dest="kind", action="store_const", const="motion", default="faults",
                        help="the seed is one of campaign --motion")
    replay.add_argument("--out", type=Path, default=OUT / "replay", metavar="DIR",
                        help="parent of the folder for a seed (default %(default)s)")
    replay.add_argument("--target", dest="build", type=_one_of(TARGETS), default=TARGETS[0], metavar="NAME",
                        help=f"{either(TARGETS)} (default {TARGETS[0]})")
    wheel = command("wheel", "the Python package with its programs, for suites in other repositories")
    wheel.add_argument("--out", type=Path, default=OUT / "wheel", metavar="DIR",
                       help="folder (default %(default)s)")
    wheel.add_argument("--tag", metavar="vX.Y.Z", help="tag of a release: must be the version's")

    docs = command("docs", "the documents as a site, for a browser")
    docs.add_argument("--out", type=Path, default=OUT / "docs", metavar="DIR", help="folder (default %(default)s)")
    docs.add_argument("--generate", action="store_true",
                      help="first write the reference pages that follow from the sources")

    evidence = command("evidence", "each claim about the drive with its measurement, and whether that holds: a page")
    evidence.add_argument("names", nargs="*", metavar="NAME", help="claims of tests/evidence.toml (default all)")
    evidence.add_argument("--out", type=Path, default=OUT / "evidence.html", metavar="FILE.html",
                          help="page (default %(default)s)")
    evidence.add_argument("--run", action="store_true",
                          help="first run the commands of the claims that are red: hours, resumable")

    scope = command("scope", "variables of a running drive at its control rate around a trigger, or the control "
                    "periods before its last fault: table and plot")
    _add_can(scope)
    scope.add_argument("--signals", nargs="+", default=[], metavar="NAME",
                       help="variables, at most 8, as speed_rpm, current_a_A or control.observer.speed_q22 (--list); "
                       "without: the periods before the last fault")
    scope.add_argument("--trigger", metavar="EXPRESSION",
                       help='"NAME > VALUE" (>=, <, <=, ==, rises to, falls to), "NAME changes" (default: at once)')
    scope.add_argument("--before", type=_finite, default=0.25, metavar="PART",
                       help="part of the buffer before the trigger (default %(default)s)")
    scope.add_argument("--divider", type=_count, default=1, metavar="N",
                       help="every N-th control period (default %(default)s)")
    scope.add_argument("--timeout", type=_positive, default=10.0, metavar="S",
                       help="time to wait for the trigger (default %(default)s)")
    scope.add_argument("--list", action="store_true", help="instead: list the short names, and the variables")
    scope.add_argument("--out", type=Path, default=OUT / "scope", metavar="DIR|FILE",
                       help="folder (default %(default)s); with --signals also a file .csv, .mf4 or .parquet")
    _add_machine(scope)
    _add_node(scope)
    _add_databases(scope, "whose signals while the buffer is read are a table, too, and whose messages are watched")
    _add_bit_rates(scope)

    identify = command("identify", "a drive measures its own motor: machine file with flux-linkage map, and a page")
    _add_can(identify)
    identify.add_argument("--machine", required=True, metavar="NAME|FILE", help="name plate: poles, board and ratings, "
                          "in the machine file that the drive carries; its magnetics are not used")
    identify.add_argument("--true-machine", type=_option_type("true_machine"), metavar="NAME|FILE",
                          help="instead of --can: simulates a drive of the name plate with this motor")
    identify.add_argument("--set", action="append", default=[], metavar="NAME=VALUE",
                          help="with --true-machine: variable of the test bench; may be repeated")
    for name, kind in (("encoder_bits", "encoder_bits"), ("seed", "seed")):
        identify.add_argument(f"--{name.replace('_', '-')}", dest=name, type=_option_type(kind), metavar="N",
                              help=f"with --true-machine: {OPTIONS[name].help} (default as the name plate)")
    identify.add_argument("--bins", type=_count, default=36, metavar="N",
                          help="windows of an electrical revolution from which pulses begin (default %(default)s)")
    identify.add_argument("--repeats", type=_count, default=2, metavar="N",
                          help="pulses of each window (default %(default)s)")
    identify.add_argument("--out", type=Path, default=OUT / "identify" / "motor.toml", metavar="FILE.toml",
                          help="machine file; its map and its page have the same name (default %(default)s)")
    _add_node(identify)

    tables = command("tables", "write the tables of another machine file into the memory of a running drive, which has "
                     "them from its next start on")
    tables.add_argument("file", metavar="NAME|FILE", help="machine file, as of identify")
    _add_can(tables)
    _add_machine(tables)
    _add_node(tables)
    tables.add_argument("--out", type=Path, metavar="FILE.bin", help="instead: write them to a file, for another tool")

    parameters = command("parameters", "parameters and fault log of a running drive")
    actions = parameters.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=_Parser)
    for name, text in (("save", "write the parameters to a file"),
                       ("compare", "list the differences from a file, exit code 1 when there are any"),
                       ("load", "set the parameters that a file has, all or none"),
                       ("faults", "print the log of faults")):
        action = actions.add_parser(name, help=text, description=text, prog=f"{COMMAND} parameters {name}")
        if name != "faults":
            action.add_argument("file", type=Path, metavar="FILE.toml")
        if name == "load":
            action.add_argument("--store", action="store_true", help="also store them in the memory of the drive, so "
                                "that they survive a reset")
        _add_can(action)
        _add_machine(action)
        _add_node(action)

    return parser


def _add_bench_options(parser: argparse.ArgumentParser, command: str) -> None:
    """The options of the test bench that a command has; each arrives under the name of its field."""
    for name, option in OPTIONS.items():
        if command not in option.commands:
            continue
        if name == "can":
            _add_can(parser)
        elif option.kind == FLAG:
            parser.add_argument(flag_of(name), action="store_true", help=option.help)
        else:
            parser.add_argument(flag_of(name), dest=name, type=_option_type(name), default=DEFAULTS[name],
                                metavar=option.metavar, help=description(name))


def _add_machine(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    option = OPTIONS["machine"]
    parser.add_argument("--machine", type=_option_type("machine"), metavar=option.metavar,
                        help=f"{purpose}{option.help}: {option.allowed} (default the one that the drive reports)")


def _add_node(parser: argparse.ArgumentParser) -> None:
    low, high = OPTIONS["node"].minimum, OPTIONS["node"].maximum
    parser.add_argument("--node", type=_option_type("node"), default=DEFAULTS["node"], metavar="N",
                        help=f"node number of the drive: {low} to {high} (default {DEFAULTS['node']})")


def _add_databases(parser: argparse.ArgumentParser, purpose: str) -> None:
    parser.add_argument("--dbc", action="append", type=Path, default=[], metavar="FILE.dbc",
                        help=f"database of other nodes of the bus, {purpose}; may be repeated")


def _add_bit_rates(parser: argparse.ArgumentParser) -> None:
    option = OPTIONS["bit_rate"]
    parser.add_argument("--bit-rate", type=_option_type("bit_rate"), default=DEFAULTS["bit_rate"], metavar="N",
                        help=f"of the bus in bit/s, for its load: {option.allowed} (default {DEFAULTS['bit_rate']})")
    parser.add_argument("--data-bit-rate", type=_data_bit_rate, metavar="N",
                        help="of the data of flexible data rate frames that switch it: a whole number from 10000 to "
                        "20000000 (default: as --bit-rate)")


def _add_can(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--can", type=lambda text: text if text == "auto" else _convert("can", text), default="auto",
                        metavar="BUS", help=f"{BUSES}, or auto (default): vcan0 when it is up, else "
                        f"unix:{_SHOWN_BUILD}/salient.sock")


def _option_type(name: str) -> Callable[[str], Any]:
    return lambda text: _convert(name, text)


def _convert(name: str, text: str) -> Any:
    try:
        return OPTIONS[name].parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}") from None


def _add_compare_options(parser: argparse.ArgumentParser) -> None:
    """The groups are checked by salient.experiments.compare.command, which defines them."""
    parser.add_argument("groups", nargs="*", metavar="GROUP", help="measurements (default all but the long ones)")
    parser.add_argument("--list", action="store_true", help="list the groups")
    parser.add_argument("--machine", metavar="NAME|FILE", help="of one machine only, its speeds fractions of its base "
                        "speed and its loads of its rated torque, as with the paper's machine")
    parser.add_argument("--true-machine", type=_option_type("true_machine"), metavar="NAME|FILE",
                        help="with --machine: the machine of the emulated motor, converter and supply instead; speeds, "
                        "loads, targets and bounds stay as for --machine")
    parser.add_argument("--quick", action="store_true", help="fewer machines, rates and angles: about 20 s")
    parser.add_argument("--out", type=Path, default=OUT / "compare", metavar="DIR",
                        help="folder (default %(default)s)")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE",
                        help="parameter of the drive or variable of the test bench, in every run; may be repeated")
    _add_execution_options(parser)
    parser.add_argument("--samples", type=_count, metavar="N",
                        help="only the first N samples (drives, angles, seeds) of each condition")
    parser.add_argument("--resume", action="store_true",
                        help="keep the finished runs in the folder, of the same scenario, machine and executable")
    parser.add_argument("--baseline", type=Path, metavar="DIR|FILE",
                        help="folder or compare.json of an earlier run: list the changes, exit code 1 if anything "
                        "got worse")
    parser.add_argument("--worse-percent", type=_percent, default=CHANGE_PERCENT, metavar="X",
                        help=f"a larger change is reported (default {CHANGE_PERCENT:g})")


def _add_sweep_options(parser: argparse.ArgumentParser) -> None:
    """Names of --set and --machine are checked by salient.experiments.sweep."""
    parser.add_argument("scenario", type=Path, metavar="NAME|SCENARIO.toml",
                        help="bundled scenario or scenario file, for one machine of the sweep; on other machines its "
                        "speeds and loads are in terms of their base speed and rated torque")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUES",
                        help="parameter of the drive or variable of the test bench: VALUE,VALUE,... or "
                        "FIRST:LAST:COUNT; may be repeated")
    for name, metavar in (("machine", "NAME|FILE"), ("controller", "NAME")):
        parser.add_argument(f"--{name}", action="append", default=[], type=_option_type(name), metavar=metavar,
                            help=f"{name}; may be repeated (default as the scenario)")
    parser.add_argument("--load-Nm", dest="load_Nm", type=_numbers, default=[], metavar="X,X,...",
                        help="torques of the scenario's loads")
    parser.add_argument("--load-profile", action="append", default=[], metavar="NAME|FILE",
                        help="load profile; may be repeated")
    parser.add_argument("--seeds", type=_count, default=1, metavar="N", help="number of seeds (default 1)")
    parser.add_argument("--seed", type=_option_type("seed"), metavar="N", help="the first (default as the scenario)")
    parser.add_argument("--out", type=Path, default=OUT / "sweep", metavar="DIR", help="folder (default %(default)s)")
    parser.add_argument("--resume", action="store_true",
                        help="keep the finished runs in the folder; runs of shards are always kept")
    _add_execution_options(parser)
    parser.add_argument("--shard", type=shard, default=(1, 1), metavar="I/N",
                        help="only the I-th of N parts; keeps the finished runs in the folder")


def _add_execution_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=_count, metavar="N", help="simultaneous runs (default: number of cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS",
                        help="Dask scheduler whose workers run them instead: tcp://HOST:PORT")


def shard(text: str) -> tuple[int, int]:
    """I/N, whole numbers with I from 1 to N."""
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"{text}: must be I/N, whole numbers with I from 1 to N")
    return int(match[1]), int(match[2])


def _numbers(text: str) -> list[float]:
    values = [_number(part) for part in text.split(",")]
    if not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{text}: must be numbers with commas between them")
    return values


def _one_of(allowed: Iterable[str]) -> Callable[[str], str]:
    def convert(text: str) -> str:
        if text not in allowed:
            raise argparse.ArgumentTypeError(f"{text}: must be {either(allowed)}")
        return text

    return convert


def _count(text: str) -> int:
    if not re.fullmatch("[0-9]{1,4}", text) or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number from 1 to 1024")
    return int(text)


def _data_bit_rate(text: str) -> int:
    if not re.fullmatch("[0-9]{1,8}", text) or not 10_000 <= int(text) <= 20_000_000:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number from 10000 to 20000000")
    return int(text)


def _seed(text: str) -> int:
    if not re.fullmatch("[0-9]{1,18}", text):
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number from 0 to 10^18 - 1")
    return int(text)


def _seeds(text: str) -> int:
    if not re.fullmatch("[0-9]{1,8}", text) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number from 1 to 99999999")
    return int(text)


def _percent(text: str) -> float:
    value = _number(text)
    if not 0.0 <= value <= 1000.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number from 0 to 1000")
    return value


def _positive(text: str) -> float:
    value = _number(text)
    if not 0.0 < value <= _SECONDS_MAX:
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0 and at most {_SECONDS_MAX:.0f}")
    return value


def _finite(text: str) -> float:
    value = _number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: must be a number")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _rotation(text: str) -> Rotation:
    try:
        return Rotation.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}") from None


def _log_path(text: str) -> Path:
    path = Path(text)
    if path.suffix not in LOG_SUFFIXES:
        raise argparse.ArgumentTypeError(f"{text}: the suffix must be {either(LOG_SUFFIXES)}")
    return path
