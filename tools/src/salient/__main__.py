"""The commands, for an installed package: python -m salient COMMAND ..."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from salient.cli import make_parser
from salient.config import OPTIONS
from salient.errors import RunFailed, UsageError, exit_code
from salient.guard import removes_socket
from salient.kept_files import keep_read_files
from salient.light_can import without_mf4
from salient.paths import BUILD, OUT, make_folder, scenario_path


def main() -> int:
    """Runs a command; returns the exit code: 0 done, 1 the thing tested failed, 2 a mistake of the caller."""
    without_mf4()
    # Matrices are small: on a loaded computer threads of the linear algebra wait for one another, for seconds instead
    # of milliseconds. Processes share the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options = argparse.Namespace()
    return exit_code(lambda: _run_command(options), lambda: _place(options))


def _place(options: argparse.Namespace) -> str | None:
    """The option of what a command writes, with its value."""
    for name in ("out", "json", "file"):
        if value := getattr(options, name, None):
            return str(value) if name == "file" else f"--{name} {value}"
    return None


def _run_command(options: argparse.Namespace) -> int:
    make_parser().parse_args(namespace=options)
    if getattr(options, "can", None) == "auto":
        options.can = _automatic_can()
    keep_read_files(options)
    try:
        return _COMMANDS[options.command](options)
    except Exception as error:
        can = sys.modules.get("can")  # most commands start faster without it
        if can is None or not isinstance(error, can.CanError):
            raise
        bus = getattr(options, "can", None) or "the bus"
        raise RunFailed(str(error) if bus in str(error) else f"{bus}: {error}") from None


def _automatic_can() -> str:
    """vcan0 when it is up, else the local bus."""
    try:
        up = int(Path("/sys/class/net/vcan0/flags").read_text(), 16) & 1
    except OSError:
        up = 0
    return "socketcan:vcan0" if up else f"unix:{BUILD}/salient.sock"


def _demo(options: argparse.Namespace) -> int:
    from salient.experiments import demo

    try:
        return demo.run(options)
    except demo.DemoFailed as error:
        print(f"salient: {error}", file=sys.stderr)
        return 1


def _test(options: argparse.Namespace) -> int:
    from salient import test_runner as checks

    return checks.run(options.only, thorough=options.thorough)


def _sim(options: argparse.Namespace) -> int:
    from salient.bench.programs import command_line
    from salient.machine.cache import bench_config

    given = {name: value for name, value in vars(options).items() if name in OPTIONS and value is not None}
    config = bench_config(given)
    command = command_line(config)
    if config.can.startswith("unix:"):
        removes_socket(Path(config.can.removeprefix("unix:")))
    os.execv(command[0], command)


def _run(options: argparse.Namespace) -> int:
    from salient.experiments.scenario import load_scenarios, run_all, with_true_machine

    path = scenario_path(options.scenario)
    scenarios = with_true_machine(load_scenarios(path), options.true_machine)
    out = options.out or OUT / options.scenario.stem
    make_folder(out)
    results = run_all(scenarios, out, build=options.build, instruction_ns=options.instruction_ns,
                      progress=lambda line: print(line, flush=True), source=path)
    if scenarios[0].position:
        from salient.experiments.plots import plot_position  # matplotlib, for these alone

        for result in results.values():
            plot_position(result)
    print(f"results: {out / 'results.json'}")
    faults = [f"{controller}: {result.fault}" for controller, result in results.items() if result.fault != "none"]
    if faults:
        print(f"salient: the drive ended in a fault: {', '.join(faults)}", file=sys.stderr)
        return 1
    return 0


def _log(options: argparse.Namespace) -> int:
    from salient.bus.databases import load_databases

    others = load_databases(options.dbc, options.node)
    if options.convert:
        from salient.bus.log_reader import convert

        if options.duration_s is not None:
            raise UsageError("--duration-s: not with --convert, which reads the whole file")
        count, place = convert(options.convert, options.out, options.machine, options.node, options.rotate,
                               others)
        print(f"{count} frames: {place}")
        return 0
    from salient.bus.monitor import record

    return record(options.can, options.out, options.duration_s, options.machine, options.node, options.rotate, others)


def _monitor(options: argparse.Namespace) -> int:
    from salient.bus.monitor import monitor

    return monitor(options)


def _command(options: argparse.Namespace) -> int:
    from salient.bench.shell import run

    return run(options)


def _view(options: argparse.Namespace) -> int:
    from salient.view.command import run

    return run(options)


def _tab(options: argparse.Namespace) -> int:
    from salient.tab.file import run

    return run(options.out, options.machine)


def _identify(options: argparse.Namespace) -> int:
    from salient.identify.command import run

    return run(options)


def _scope(options: argparse.Namespace) -> int:
    from salient.bench.scope import run

    return run(options)


def _tables(options: argparse.Namespace) -> int:
    from salient.bench.tables import run

    return run(options)


def _parameters(options: argparse.Namespace) -> int:
    from salient.bench.parameter_file import run

    return run(options)


def _benchmark(options: argparse.Namespace) -> int:
    from salient.benchmark.command import run

    return run(options.runs, options.json, options.page, options.tab)


def _compare(options: argparse.Namespace) -> int:
    from salient.experiments.compare.command import run

    return run(options)


def _sweep(options: argparse.Namespace) -> int:
    from salient.experiments.sweep import run

    return run(options)


def _machine(options: argparse.Namespace) -> int:
    from salient.machine.report import run

    code = run(options.machine, options.out, options.json, options.dbc, options.node, options.table)
    if options.a2l is not None:
        from salient.bench.a2l import write_a2l

        write_a2l(options.a2l, options.machine, node=options.node)
    if options.eds is not None:
        from salient.machine.eds import write_eds

        write_eds(options.eds, options.machine, options.node)
    return code


def _wheel(options: argparse.Namespace) -> int:
    from salient.wheel import build

    return build(options.out, options.tag)


def _docs(options: argparse.Namespace) -> int:
    from salient import documents

    return documents.run(options.out, generate=options.generate)


def _evidence(options: argparse.Namespace) -> int:
    from salient import evidence

    return evidence.run(options.out, options.names, rerun=options.run)


def _pil(options: argparse.Namespace) -> int:
    from salient.target.pil import run

    return run(options)


def _board(options: argparse.Namespace) -> int:
    from salient.board.command import run

    return run(options)


def _campaign(options: argparse.Namespace) -> int:
    from salient.experiments.campaign.command import run_campaign

    return run_campaign(options)


def _replay(options: argparse.Namespace) -> int:
    from salient.experiments.campaign.command import run_replay

    return run_replay(options)


_COMMANDS = {
    "demo": _demo,
    "test": _test,
    "sim": _sim,
    "run": _run,
    "log": _log,
    "monitor": _monitor,
    "command": _command,
    "board": _board,
    "campaign": _campaign,
    "replay": _replay,
    "view": _view,
    "tab": _tab,
    "scope": _scope,
    "tables": _tables,
    "identify": _identify,
    "parameters": _parameters,
    "benchmark": _benchmark,
    "compare": _compare,
    "sweep": _sweep,
    "machine": _machine,
    "pil": _pil,
    "wheel": _wheel,
    "docs": _docs,
    "evidence": _evidence,
}

if __name__ == "__main__":
    sys.exit(main())
