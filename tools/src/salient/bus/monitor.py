"""Listen-only commands: log and monitor."""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import can
from cantools.database.can import Database

from salient.bus.clock import VirtualTimeReader, has_plain_data, nodes_of_drives, open_bus
from salient.bus.databases import load_databases, messages_of
from salient.bus.frame_bits import BitRates
from salient.bus.identity import IDENTITY_WAIT_NS, Carrier
from salient.bus.interface import closed_in_order
from salient.bus.log import DECODED_SUFFIXES, open_log
from salient.bus.log_reader import read_log
from salient.bus.selected_signals import SelectedSignals
from salient.bus.signals import FrameKeys, SignalTable, drive_database, rig_database
from salient.bus.traffic import Traffic
from salient.bus.traffic_text import event_line, load_text, report_lines
from salient.config import Rotation
from salient.errors import UsageError

_COLUMNS = (
    ("state", "DRIVE_STATUS.state", "{:>10}"),
    ("fault", "DRIVE_STATUS.fault", "{:>17}"),
    ("speed", "speed_rpm", "{:>9.2f}"),
    ("reference", "DRIVE_MOTION.speed_reference_rpm", "{:>9.2f}"),
    ("torque", "torque_estimate_Nm", "{:>8.2f}"),
    ("reference", "torque_reference_Nm", "{:>8.2f}"),
    ("load", "load_torque_estimate_Nm", "{:>8.2f}"),
    ("DC link", "DRIVE_TORQUE.bus_voltage_V", "{:>8.1f}"),
)
"""Title, signal and number format, in the order of a line."""
_WIDTH = 120
"""Characters of a line where the output is no terminal."""
_LOOK_S = 0.02
_ABSENT_S = 1.0
"""Without a frame of a drive, whose heartbeat comes every 100 ms, until that is told: virtual time, and where no frame
moves it, as on an interface without any drive, wall time."""


class _BusClosed(Exception):
    """The bus ended while this command was listening; the text is the reason of python-can."""


def record(address: str, path: Path, duration_s: float | None, machine: str | None, node: int = 0,
           rotation: Rotation | None = None, others: Sequence[Database] = ()) -> int:
    """Writes every frame on a bus to a log file, on virtual time. machine, node: of the drive whose signals an MF4 file
    has, by default the machine that it reports. rotation: see RotatingLog. others: databases of other nodes, whose
    signals it has as well.

    Ends when `duration_s` of virtual time have passed, on an interrupt, or when the bus closes; the file is complete in
    every case. Returns the exit code: 1 when the bus closed early (see _report_closed) or an MF4 file has no frame of
    the drive, else 0.
    """
    open_bus(address).shutdown()  # fails before a file is created when there is no such bus
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}") from None
    log = open_log(path, machine, node, address, rotation, others)
    count, closed = 0, None
    # The formats with frames have the frames of all nodes.
    nodes = _Nodes(address, node if path.suffix in DECODED_SUFFIXES else None, others)
    try:
        for timed in nodes.watch(_frames(address, duration_s, "recording", nodes)):
            log.write(*timed)
            count += 1
    except KeyboardInterrupt:
        pass
    except _BusClosed as end:
        closed = str(end)
    finally:
        log.close()
    print(f"{count} frames: {log.place}", flush=True)
    return _finish(address, duration_s, closed, nodes)


def monitor(options: argparse.Namespace) -> int:
    """Prints signals of the drive of a machine and node number, and of other nodes, every `every_s` of virtual time:
    the named ones, else the main ones of the drive; ends as `record` does, with its exit code, which is 1 as well when
    no frame of the drive or of another node with a database has come. Without a machine it is that which the drive
    reports. replay: a log, instead of a bus; LogDamaged, after the lines of what can be read. dbc: databases of other
    nodes. With them, or with bus, the load is part of a line, what goes missing a line of its own, and the end is a
    table of the messages; with bus a line is such a table, too. UsageError: no such machine, database, or signal;
    OtherDatabase: see Carrier."""
    address = options.can if options.replay is None else str(options.replay)
    carrier = Carrier(address, options.machine, options.node)
    others = load_databases(options.dbc, options.node)
    lines = _Lines(options, others)
    period, closed = _Period(round(options.every_s * 1e9)), None
    heard = True
    nodes = _Nodes(address, options.node, others, lines.traffic)
    frames = nodes.watch(_frames(address, options.duration_s, "monitoring", nodes) if options.replay is None
                         else _logged(options.replay, options.duration_s))
    try:
        for time_ns, message, begins in identified(frames, carrier):
            if begins:
                lines.decode_as(carrier.likely)
                heard = carrier.machine is not None
            lines.add(time_ns, message)
            if not period.ends(time_ns):
                continue
            line = lines.line(time_ns)
            if line and not heard and carrier.machine is None and not nodes.absent:
                heard = True
                hint = "; --machine states another" if options.machine is None else ", of --machine"
                print(f"salient: {address}: no DRIVE_IDENTITY within {IDENTITY_WAIT_NS / 1e9:g} s: the signals are "
                      f"taken for {carrier.likely}'s{hint}", file=sys.stderr, flush=True)
            if line:
                _write(line)
    except KeyboardInterrupt:
        pass
    except _BusClosed as end:
        closed = str(end)
    finally:
        lines.finish()
    return _finish(address, options.duration_s, closed, nodes)


def _write(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _tell_events(traffic: Traffic) -> None:
    """Prints what has gone missing and what is back."""
    for event in traffic.take_events():
        _write(event_line(event))


class _Period:
    """The period of the lines, in the time of the frames: a pause has one end of a period, whatever its length."""

    def __init__(self, every_ns: int) -> None:
        self._every_ns = every_ns
        self._due_ns: int | None = None

    def ends(self, time_ns: int) -> bool:
        """Whether a period ends with the frame of a time. A time that is a period before the last end begins again:
        another recording follows in the log, or the drive has restarted."""
        if self._due_ns is None or time_ns < self._due_ns - 2 * self._every_ns:
            self._due_ns = time_ns + self._every_ns
        if time_ns < self._due_ns:
            return False
        if self._every_ns > 0:
            self._due_ns += ((time_ns - self._due_ns) // self._every_ns + 1) * self._every_ns
        return True


class _Lines:
    """Output of a monitor: signals, and the traffic of the bus where that is wanted."""

    def __init__(self, options: argparse.Namespace, others: Sequence[Database]) -> None:
        """UsageError: no signal of a name."""
        self._node, self._signals, self._others = options.node, options.signals, others
        self._table = options.bus
        rates = BitRates(options.bit_rate, options.data_bit_rate)
        self.traffic = Traffic(rates, others, options.node) if options.bus or others else None
        self._shown = self._signals_of(None)

    def _signals_of(self, machine: str | None) -> _MainSignals | SelectedSignals:
        database = drive_database(machine, self._node)
        if not self._signals:
            return _MainSignals(database)
        width = shutil.get_terminal_size((_WIDTH, 1)).columns
        return SelectedSignals((database, rig_database(self._node)), self._signals, width, self._others)

    def decode_as(self, machine: str) -> None:
        """The drive's machine is known, or taken to be one."""
        self._shown = self._signals_of(machine)

    def add(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame; what has gone missing before it is told at once."""
        self._shown.add(time_ns, message)
        if self.traffic is not None:
            self.traffic.add(time_ns, message)
            _tell_events(self.traffic)

    def line(self, time_ns: int) -> str:
        """The values at a time; empty when there are none."""
        shown = self._shown.line(time_ns)
        if self.traffic is None:
            return shown
        report = self.traffic.report()
        if not self._table:
            return f"{shown or f'{time_ns * 1e-9:10.4f} s'}  {load_text(report)}"
        return "\n".join([*([shown] if self._signals else []), *report_lines(report)])

    def finish(self) -> None:
        """The table of all messages."""
        if self.traffic is not None and self.traffic.first_ns is not None:
            _tell_events(self.traffic)
            _write("\n".join(report_lines(self.traffic.total())))


def identified(frames: Iterator[tuple[int, can.Message]], carrier: Carrier) -> Iterator[tuple[int, can.Message, bool]]:
    """The frames, held back until the drive has reported its machine, or has not for IDENTITY_WAIT_NS; the first one
    says so. OtherDatabase of the carrier."""
    held: list[tuple[int, can.Message]] = []
    knows = False
    for time_ns, message in frames:
        known = carrier.take(message)
        if knows:
            yield time_ns, message, False
            continue
        held.append((time_ns, message))
        if known or time_ns - held[0][0] > IDENTITY_WAIT_NS:
            knows = True
            yield from _from_first(held)
    if not knows:
        yield from _from_first(held)


def _from_first(held: list[tuple[int, can.Message]]) -> Iterator[tuple[int, can.Message, bool]]:
    return ((time_ns, message, number == 0) for number, (time_ns, message) in enumerate(held))


class _Nodes:
    """The drives that are heard on a bus, and one line when the one of a node number is not, nor another node with a
    database."""

    def __init__(self, address: str, wanted: int | None, others: Sequence[Database] = (),
                 traffic: Traffic | None = None) -> None:
        """wanted: its node number; None when none in particular is listened to. traffic: is told of silence."""
        self._address = address
        self._wanted = wanted
        self._heard: set[int] = set()
        self._of_files = FrameKeys(messages_of(others))
        self._others_heard = False
        self._traffic = traffic
        self._from_ns: int | None = None
        self._told = False

    @property
    def absent(self) -> bool:
        """Whether no frame of the drive has come."""
        return self._wanted is not None and self._wanted not in self._heard

    @property
    def nothing(self) -> bool:
        """Whether no frame has come that can be decoded."""
        return self.absent and not self._others_heard

    def add(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame; tells when the drive has been absent for _ABSENT_S since the first one."""
        if not self.absent:
            return
        self._others_heard = self._others_heard or self._of_files.find(
            message.arbitration_id, message.is_extended_id) in self._of_files.exact
        node = None if message.is_extended_id or not has_plain_data(message) else nodes_of_drives().get(
            message.arbitration_id)
        if node is not None:
            self._heard.add(node)
        self._from_ns = time_ns if self._from_ns is None else self._from_ns
        if time_ns - self._from_ns > _ABSENT_S * 1e9:
            self.tell_absence("; listening on")

    @property
    def look_s(self) -> float:
        """Time between two looks at an interface that is silent."""
        return _ABSENT_S if self._traffic is None else _LOOK_S

    def take_silence(self, silent_s: float, last_ns: int | None) -> None:
        """No frame has come for a time. last_ns: of the one before, where time goes on by itself."""
        if silent_s >= _ABSENT_S:
            self.tell_absence()
        if self._traffic is not None and last_ns is not None:
            self._traffic.advance(last_ns + round(silent_s * 1e9))
            _tell_events(self._traffic)

    def watch(self, frames: Iterator[tuple[int, can.Message]]) -> Iterator[tuple[int, can.Message]]:
        """The frames, each of which is taken."""
        for time_ns, message in frames:
            self.add(time_ns, message)
            yield time_ns, message

    def tell_absence(self, end: str = "; listening on") -> None:
        """One line, once, when the drive is absent."""
        if self.nothing and not self._told:
            heard = " and ".join(map(str, sorted(self._heard)))
            others = f", but of node {heard}" if heard else " or of any other drive"
            files = " or of the messages of --dbc" if self._of_files.exact else ""
            print(f"salient: {self._address}: no frame of a drive with node number {self._wanted} (--node){files}"
                  f"{others}{end}", file=sys.stderr, flush=True)
            self._told = True


def _finish(address: str, duration_s: float | None, closed: str | None, nodes: _Nodes) -> int:
    """The exit code, after a line for a bus that closed and for a drive that was not heard."""
    code = 0 if closed is None else _report_closed(address, duration_s, closed)
    nodes.tell_absence("")
    return 1 if nodes.nothing else code


def _frames(address: str, duration_s: float | None, activity: str, nodes: _Nodes) -> Iterator[tuple[int, can.Message]]:
    """Frames until `duration_s` of virtual time have passed or an interrupt; _BusClosed when the bus closes first.
    nodes: is told where an interface is silent; the time of a local bus may stand still."""
    end_ns = None
    timeout_s = None if address.startswith("unix:") else nodes.look_s
    silent_s, last_ns = 0.0, None
    # A termination request ends the command like an interrupt, so that its output is complete; not one that nohup has
    # set to be ignored.
    for request in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(request) != signal.SIG_IGN:
            signal.signal(request, signal.default_int_handler)
    with open_bus(address) as bus:
        reader = VirtualTimeReader(bus)
        print(f"{activity} {address}", flush=True)
        while True:
            try:
                timed = reader.receive(timeout_s)
            except can.CanOperationError as error:
                raise _BusClosed(str(error)) from None
            except KeyboardInterrupt:
                return
            if timed is None:
                silent_s += timeout_s or 0.0
                nodes.take_silence(silent_s, None if reader.has_virtual_time else last_ns)
                continue
            silent_s, last_ns = 0.0, timed[0]
            if end_ns is None and duration_s is not None:
                end_ns = timed[0] + round(duration_s * 1e9)
            if end_ns is not None and timed[0] > end_ns:
                return
            yield timed


def _logged(path: Path, duration_s: float | None) -> Iterator[tuple[int, can.Message]]:
    """The frames of a log, until `duration_s` have passed in it; LogDamaged is raised after the rest was shown."""
    begin_ns = None
    for time_ns, message in read_log(path, "--replay"):
        begin_ns = time_ns if begin_ns is None else begin_ns
        if duration_s is not None and time_ns - begin_ns > duration_s * 1e9:
            return
        yield time_ns, message


def _report_closed(address: str, duration_s: float | None, reason: str) -> int:
    """Prints in one line how the bus closed. Returns 0 when the drive was stopped in order and no duration was
    requested, else 1: the emulator was killed or crashed, an interface failed for a reason, or the requested duration
    is incomplete."""
    early = "" if duration_s is None else f" before --duration-s {duration_s:g} had passed"
    if not address.startswith("unix:"):
        print(f"salient: {address}: the interface failed{early}: {reason}", file=sys.stderr, flush=True)
        return 1
    in_order = closed_in_order(address)
    cause = "the drive was stopped" if in_order else "the emulator was killed or crashed"
    print(f"salient: {address}: the drive's bus closed{early}: {cause}", file=sys.stderr, flush=True)
    return 0 if in_order and duration_s is None else 1


class _MainSignals:
    """The signals of _COLUMNS, the check that keeps the drive from starting, and the direction in which the load
    exceeds the torque, with what limits it."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._telemetry = SignalTable(database, "DRIVE")
        self._exceeded = ""

    def add(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame."""
        self._telemetry.add(time_ns, message)

    def line(self, time_ns: int) -> str:
        """The values at a time; empty when the drive has sent none since the last line."""
        telemetry, self._telemetry = self._telemetry, SignalTable(self._database, "DRIVE")
        if not telemetry.count("DRIVE_TORQUE"):
            return ""
        if telemetry.count("DRIVE_AVAILABLE_TORQUE"):  # comes less often than lines may
            self._exceeded = _exceeding(telemetry)
        cells = [f"{time_ns * 1e-9:10.4f} s"]
        for title, name, number_format in _COLUMNS:
            value = telemetry[name]
            shown = number_format.format(value.last_name if value.choices else value.last)
            cells.append(f"{title} {shown} {value.unit}".rstrip())
        held = telemetry["DRIVE_STATUS.start_inhibited_by"].last_name
        if held not in ("none", "unknown"):
            cells.append(f"start inhibited by {held}")
        if self._exceeded:
            cells.append(self._exceeded)
        return "  ".join(cells)


def _exceeding(telemetry: SignalTable) -> str:
    """The direction in which the load exceeds the torque: the direction of the torque that would hold it; empty when it
    does not."""
    if telemetry["DRIVE_AVAILABLE_TORQUE.load_exceeds"].last_name != "yes":
        return ""
    side = "forward" if telemetry["load_torque_estimate_Nm"].last > 0.0 else "backward"
    available, limit = (telemetry[f"DRIVE_AVAILABLE_TORQUE.{side}_{name}"] for name in ("Nm", "limited_by"))
    return f"load exceeds the torque {side}, {available.last:.2f} N m by {limit.last_name}"
