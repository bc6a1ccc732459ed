"""salient identify: the experiments of a running drive, or of one that it simulates; machine file, map and page."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from salient.bench.session import SILENCE_MAX_S, Session
from salient.bench.settings import parse_values
from salient.bench.xcp import load_client
from salient.errors import UsageError
from salient.identify.link import linked
from salient.identify.report import write_report
from salient.identify.result import Result, result_of, write_machine
from salient.identify.sequence import Sequence
from salient.machine.file import Machine, load_machine
from salient.machine.path import machine_path
from salient.paths import make_folder

MAP_MAX_S, SPIN_RPM_OF_DRIFT = 22.0, 8.0
TELEMETRY_PERIOD_MS = 20


def run(options: argparse.Namespace) -> int:
    """Identifies; returns the exit code: 0, also with warnings. UsageError, MachineError: a mistake in the options or
    the name plate; IdentifyError: the drive does not take the experiments, or they do not determine the machine; then
    nothing is written."""
    plate = machine_path(options.machine)
    load_machine(plate)
    if options.out.suffix != ".toml":
        raise UsageError(f"--out {options.out}: must be FILE.toml")
    make_folder(options.out.parent)
    with _session(options) as session:
        result = measure(session, plate, options.out, options.bins, options.repeats, lambda line: print(
            f"{session.time_s:7.2f} s  {line}", flush=True))
    for quantity in result.quantities:
        print(f"{quantity.name:45} {quantity.value:12.6g} +- {quantity.half_width:.2g} {quantity.unit}: "
              f"{quantity.verdict}")
    for warning in result.warnings:
        print(f"not ready to run: {warning}")
    print(f"machine: {options.out}\nreport:  {options.out.with_suffix('.html')}")
    return 0


def measure(session: Session, plate: Path, out: Path, bins: int, repeats: int, print_line: Callable[[str], None]
            ) -> Result:
    """identify, and its files: the machine file `out`, its map and its page. They are written at the end: until then,
    and when there is no result, the files of an earlier run stay."""
    machine = load_machine(plate)
    result = identify(session, machine, bins, repeats, print_line)
    write_machine(result, plate, out, lambda found, page: write_report(result, found, machine, page))
    return result


def identify(session: Session, plate: Machine, bins: int, repeats: int, print_line: Callable[[str], None]
             ) -> Result:
    """All experiments of a session's drive, and the machine by them. IdentifyError: see run."""
    with linked(session) as link:
        sequence = Sequence(link, plate.phases, plate.rotor_poles, print_line)
        sequence.probe()
        sequence.align()
        sequence.map(bins, repeats, MAP_MAX_S)
        sequence.spin(SPIN_RPM_OF_DRIFT * 60.0 / plate.rotor_poles / 0.25)
        log, limit_A = link.log, link.limit_A
    print_line("fit: flux linkage, resistance, angles, inertia; uncertainty by resampled pulses")
    return result_of(sequence.found, log, limit_A)


@contextmanager
def _session(options: argparse.Namespace) -> Iterator[Session]:
    """Session with the drive on the bus, or of one that is simulated with another motor."""
    if options.true_machine is None:
        for name in ("set", "encoder_bits", "seed"):
            if getattr(options, name):
                raise UsageError(f"--{name.replace('_', '-')}: only with --true-machine")
        load_client()
        with Session(options.can, lockstep=False, machine=options.machine, node=options.node,
                     silence_max_s=SILENCE_MAX_S, machine_option="--machine") as session:
            yield session
        return
    from salient.bench.bench import Bench
    from salient.machine.cache import bench_config

    given = {name: value for name in ("machine", "true_machine", "encoder_bits", "seed", "node")
             if (value := getattr(options, name)) is not None}
    config = bench_config(given | {"controller": "salient", "telemetry_period_ms": TELEMETRY_PERIOD_MS})
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(config, f"unix:{Path(folder) / 'bus'}")
        try:
            for text in options.set:
                name, values = parse_values(text)
                if len(values) != 1:
                    raise UsageError(f"--set {text}: must be one value")
                setattr(bench.rig, name, values[0])
            yield bench
        finally:
            bench.close()
