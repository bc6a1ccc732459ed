"""The drive's records at its control rate, as table and plot: `tools/salient scope`. With signals they are made around
a trigger (salient.bench.sampler). Without, it is the control periods up to the one that latched a fault, which the
drive keeps from the fault to the next run. It does not keep the signals of other nodes: those are of the time in which
the buffer is read."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import can
import numpy as np
from cantools.database.can import Database

from salient.bench import sampler
from salient.bench.drive import FaultTrace
from salient.bench.recording import COLOURS, FORMATS, label_axes, write_columns
from salient.bench.session import SILENCE_MAX_S, Session
from salient.bench.variables import SIGNALS as SHORT_NAMES
from salient.bench.variables import Variables
from salient.bench.xcp import load_client
from salient.bus.databases import load_databases, messages_of
from salient.bus.frame_bits import BitRates
from salient.bus.log import open_log
from salient.bus.traffic import MISSING_CYCLES, Traffic
from salient.bus.traffic_text import report_lines
from salient.dbc import PHASES
from salient.errors import UsageError
from salient.paths import make_folder

TABLE, PLOT, SIGNALS = "scope.csv", "scope.png", "signals.csv"
LISTEN_MAX_S = 5.0
"""To other nodes; a message of a longer cycle may be told as one that never came."""
_MS_PER_S, _PERCENT = 1000.0, 100.0


def run(options: argparse.Namespace) -> int:
    """Reads the buffer of a running drive into a folder; returns the exit code. dbc: databases of other nodes; with
    them the signals of the bus meanwhile are a table, too, and its traffic is printed. UsageError: see
    load_databases; without signals a file instead of a folder."""
    if options.list:
        return _list(options.machine)
    if options.signals:
        if options.dbc:
            raise UsageError(f"--dbc {options.dbc[0]}: not with --signals, whose table has the drive's variables")
        return _record(options)
    if options.trigger is not None:
        raise UsageError(f"--trigger {options.trigger}: only with --signals; without, it is the last fault")
    if options.out.suffix in FORMATS:
        raise UsageError(f"--out {options.out}: without --signals it is a folder")
    others = load_databases(options.dbc, options.node)
    make_folder(options.out, [TABLE, PLOT, *([SIGNALS] if others else [])])
    with Session(options.can, lockstep=False, machine=options.machine, node=options.node,
                 silence_max_s=SILENCE_MAX_S, machine_option="--machine") as session:
        trace = session.drive.fault_trace()
        log = session.drive.fault_log.read()
        if others:
            _listen(session, others)
    title = f"{log[-1].fault} in state {log[-1].state}" if log else "fault"
    write_table(trace, options.out / TABLE)
    plot(trace, options.out / PLOT, title)
    print(f"{title}: {len(trace.time_s)} control periods: {options.out / TABLE}, {options.out / PLOT}")
    if others:
        _tell_bus(options, session.log, others)
    return 0


def _list(machine: str | None) -> int:
    variables = Variables(machine=machine)
    for name, path in SHORT_NAMES.items():
        print(f"{name:22} {path}")
    print("\n".join(quantity.name for quantity in variables.quantities()))
    return 0


def _record(options: argparse.Namespace) -> int:
    """UsageError: see sampler.arm; ScopeError: the trigger has not come."""
    is_file = options.out.suffix in FORMATS
    table = options.out if is_file else options.out / TABLE
    pictures = [] if is_file else [options.out / PLOT]
    make_folder(table.parent, [path.name for path in (table, *pictures)])
    load_client()
    with Session(options.can, lockstep=False, machine=options.machine, node=options.node,
                 silence_max_s=SILENCE_MAX_S, machine_option="--machine") as session:
        scope = sampler.arm(session, options.signals, options.trigger, before=options.before, divider=options.divider)
        recording = scope.read(options.timeout)
    recording.write(table)
    for path in pictures:
        recording.plot(path, scope.title)
    print(f"{scope.title}: {len(recording.time_s)} records from {1e3 * recording.time_s[0]:.3f} to "
          f"{1e3 * recording.time_s[-1]:.3f} ms: {', '.join(map(str, (table, *pictures)))}")
    return 0


def _listen(session: Session, others: Sequence[Database]) -> None:
    """Receives until a message of any cycle would be missing."""
    longest_s = max((message.cycle_time or 0 for message in messages_of(others)), default=0) / _MS_PER_S
    end_ns = session.log[0][0] + round(1e9 * min(LISTEN_MAX_S, MISSING_CYCLES * longest_s))
    session.advance_to(max(session.time_ns, end_ns))


def _tell_bus(options: argparse.Namespace, frames: Sequence[tuple[int, can.Message]], others: Sequence[Database]
              ) -> None:
    """Writes the signals of some frames, and prints their traffic."""
    path = options.out / SIGNALS
    log = open_log(path, options.machine, options.node, options.can, others=others)
    traffic = Traffic(BitRates(options.bit_rate, options.data_bit_rate), others, options.node)
    for time_ns, message in frames:
        log.write(time_ns, message)
        traffic.add(time_ns, message)
    log.close()
    print(f"signals of the bus while it was read: {path}")
    print("\n".join(report_lines(traffic.total())))


def columns(trace: FaultTrace) -> dict[str, np.ndarray]:
    """A column for each quantity, of phases one for each, by names with their units."""
    found: dict[str, np.ndarray] = {}
    for name, values in vars(trace).items():
        if values.ndim == 1:
            found[name] = values
            continue
        quantity, _, unit = name.partition("_")
        for phase, of_phase in zip(PHASES, values.T, strict=False):
            found[f"{quantity}_{phase}_A" if unit == "A" else f"{name}_{phase}"] = of_phase
    return found


def write_table(trace: FaultTrace, path: Path) -> None:
    """Comma-separated values, the last row at the fault."""
    write_columns(columns(trace), path)


def plot(trace: FaultTrace, path: Path, title: str) -> None:
    """Currents, torque reference and speed, voltage and the duties of both switches of each phase over the time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 9), layout="constrained")
    FigureCanvasAgg(figure)
    phases = trace.current_A.shape[1]
    currents, torque, speed, voltage, *of_phases = figure.subplots(
        4 + phases, 1, sharex=True, height_ratios=[2.5, 1.5, 1.5, 1.5, *[1] * phases])
    time_ms = trace.time_s * _MS_PER_S
    for phase, duties in enumerate(of_phases):
        currents.plot(time_ms, trace.current_A[:, phase], color=COLOURS[phase], label=f"phase {PHASES[phase]}")
        duties.step(time_ms, _PERCENT * trace.upper_duty[:, phase], where="post", color=COLOURS[phase], label="upper")
        duties.step(time_ms, _PERCENT * trace.lower_duty[:, phase], where="post", color=COLOURS[phase],
                    linestyle="dotted", label="lower")
        label_axes(duties, f"duty {PHASES[phase]}, %")
        duties.set_ylim(-5, 105)
        duties.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="small")
    label_axes(currents, "current, A")
    currents.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="small")
    for axes, name, values in ((torque, "torque\nreference, N m", trace.torque_reference_Nm),
                               (speed, "speed, r/min", trace.speed_rpm), (voltage, "DC link, V", trace.bus_voltage_V)):
        axes.plot(time_ms, values, color=COLOURS[2])
        label_axes(axes, name)
    of_phases[-1].set_xlim(time_ms[0], time_ms[-1] - time_ms[0] * 0.02)
    of_phases[-1].set_xlabel("time before the control interrupt that latched the fault, ms")
    figure.suptitle(title)
    figure.savefig(path, dpi=90, metadata={"Software": None})
