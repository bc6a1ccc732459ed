"""The drive over CAN: commands, parameters, state."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import can
import numpy as np
from cantools.database.can import Database, Message

from salient.bench.arming import ArmingSequence
from salient.bench.client import Client, KnownAttributes
from salient.bench.parameter_set import ParameterSetWriter, SetResult
from salient.bus import e2e
from salient.bus.identity import OtherDatabase
from salient.bus.signals import SignalTable, drive_database, signal_range, value_numbers
from salient.config import either
from salient.dbc import FIRST_PHASES, PHASES, phases_above
from salient.errors import RunFailed, close_names
from salient.machine.parameter_table import CHOICES, read_table, value_name

_COMMAND = drive_database().get_message_by_name("DRIVE_COMMAND")
_TORQUE_COMMAND = drive_database().get_message_by_name("DRIVE_TORQUE_COMMAND")
_POSITION_COMMAND = drive_database().get_message_by_name("DRIVE_POSITION_COMMAND")
ORDERS = value_numbers(drive_database(), "DRIVE_POSITION_COMMAND", "order")
_IDENTIFY_COMMAND, _IDENTIFY_WINDOW = "DRIVE_IDENTIFY_COMMAND", "DRIVE_IDENTIFY_WINDOW"
EXPERIMENTS = value_numbers(drive_database(), _IDENTIFY_COMMAND, "kind")
REQUESTS = value_numbers(drive_database(), "DRIVE_COMMAND", "request")
assert _COMMAND.cycle_time is not None  # GenMsgCycleTime in drive.dbc
COMMAND_PERIOD_NS = _COMMAND.cycle_time * 1_000_000
"""Period of the commands in virtual time; the drive stops when they are no longer sent."""

_CYCLE_MAX_NS = 1_000_000 * next(row.maximum for row in read_table() if row.name == "position_cycle_ms")
"""The longest cycle. A cyclic position that is repeated is another target: it is repeated when the next one has
not come after half a cycle more."""

_DISARMED_NS = 2_000_000
"""Time in which a report that the drive is armed may be older than the command that has disarmed it."""

READY_TIMEOUT_S = 0.02
"""Time after its start in which a drive without a failing check is ready: 1 ms of passed checks, and its telemetry."""

_RESPONSE_TIMEOUT_S = 0.1
_ATTEMPTS = 20
"""Requests that are made for one response. Where time moves by itself, a client that does not keep up loses frames."""
_TEXT_PARTS_MAX = 64
_REQUESTS_AT_ONCE = 16  # fewer than the frames that the drive's receive and transmit queues hold
_SAVE_TIMEOUT_S = 2.0
_MEMORY_ITEMS = ("saving", "origin", "start", "newest_fault", "sets", "stack_unused", "code_passes")
_SAVING, _SAVED = 1, 2
ORIGINS = ("defaults", "memory", "unusable")
_FAULT_ITEMS = ("fault", "state", "checks", "start", "time_us", "time_wraps", "speed_rpm", "bus_voltage_V",
                "current_max_A", "torque_reference_Nm", "current_a", "current_b", "current_c", "current_d", "angle",
                "self_test", "phases", "current_e", "current_f")
_FAULT_ITEMS_OF_MORE = 2
"""Parts of the operations memory and fault_log, as drive.dbc lists them; the last ones of a drive of more phases."""
LOGGED_FAULTS = 16
TRACE_PERIODS = 64
_TRACE_PARTS = 8
_TRACE_MORE_PARTS = 3
"""Parts for two phases more; two phases a part."""
_OPERATIONS = value_numbers(drive_database(), "PARAMETER_REQUEST", "operation")


class DriveError(RunFailed):
    """The drive rejected a request or did not respond; the message has the reason."""


class DriveNotReady(DriveError):
    """A check keeps the drive in state initialise; the message names it."""


def command_frame(counter: int, request: str, speed_reference_rpm: float, message: Message = _COMMAND) -> can.Message:
    """A DRIVE_COMMAND with its checksum. counter 0..255; request one of REQUESTS; the speed within the range of the
    message in the drive's DBC."""
    return _protected(message, counter, request, {"speed_reference_rpm": speed_reference_rpm})


def torque_command_frame(counter: int, request: str, torque_reference_Nm: float,
                         message: Message = _TORQUE_COMMAND) -> can.Message:
    """A DRIVE_TORQUE_COMMAND with its checksum, as command_frame."""
    return _protected(message, counter, request, {"torque_reference_Nm": torque_reference_Nm})


def position_command_frame(counter: int, request: str, order: str, position_deg: float,
                           message: Message = _POSITION_COMMAND) -> can.Message:
    """A DRIVE_POSITION_COMMAND with its checksum, as command_frame; order one of ORDERS."""
    return _protected(message, counter, request, {"order": ORDERS[order], "position_deg": position_deg})


def _protected(command: Message, counter: int, request: str, reference: Mapping[str, float]) -> can.Message:
    return e2e.protected_frame(command, counter, {"request": REQUESTS[request], **reference})


@dataclass(frozen=True)
class Experiment:
    """An experiment of a drive that measures its own motor (firmware/control/identify.h). kind: one of EXPERIMENTS;
    phase: from 0; level: current, part of current_limit_A, 0 to below 1; time_ms: 0 to 4095; angle, width: window, of
    a revolution of the encoder, 0 to below 1. ValueError: out of these ranges."""

    kind: str
    phase: int = 0
    level: float = 0.0
    time_ms: int = 0
    angle: float = 0.0
    width: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in EXPERIMENTS:
            raise ValueError(f"kind {self.kind}: must be {either(list(EXPERIMENTS))}")
        for name, low, high in (("phase", 0, 5), ("level", 0, 4095 / 4096), ("time_ms", 0, 4095),
                                ("angle", 0, 65535 / 65536), ("width", 0, 65535 / 65536)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} {getattr(self, name)}: must be from {low} to {high:g}")


class Drive(KnownAttributes):
    """Commands a drive. Assigning speed_reference_rpm, torque_reference_Nm or position_deg requests run in speed,
    torque or position mode; the command is sent immediately and then every COMMAND_PERIOD_NS as the session's time
    advances, until `silence`.
    Nothing is sent before the first request. A request to run arms a drive that is not armed, while time advances: the
    drive runs about a millisecond later. One that was disarmed by a fault stays so until the next request.
    OtherDatabase instead of a request to run when the drive's DBC is another
    than the session's (Session.require_drive_database); off, stop and clear_fault have no scaling.
    """

    command_due_ns: int | None
    lowest_speed_rpm: float
    """Below it a speed reference other than 0 is refused (salient.machine.lowest_speed); 0 of a drive whose encoder is
    not known here."""
    parameters: Parameters
    fault_log: FaultLog

    def __init__(self, session: Client, parameter_table: Callable[[], list[ParameterRow]] | None = None) -> None:
        self._session = session
        self._command = session.drive_database.get_message_by_name(_COMMAND.name)
        self._torque_command = session.drive_database.get_message_by_name(_TORQUE_COMMAND.name)
        self._request: str | None = None
        self._speed_reference_rpm = 0.0
        self._torque_reference_Nm = 0.0
        self._position_command = session.drive_database.get_message_by_name(_POSITION_COMMAND.name)
        self._position_deg = 0.0
        self._order = "profile"
        self._followed_ns = 0
        self._cycle_ns = COMMAND_PERIOD_NS
        self._mode = "speed"
        self._experiment = Experiment("rest")
        self._experiment_number = 0
        self._counter = 0
        self._arming: ArmingSequence | None = None
        self._arming_counter = 0
        self._arming_given_up = False
        self._disarmed_ns: int | None = None
        self.command_due_ns = None
        self.lowest_speed_rpm = 0.0
        self.parameters = Parameters(session, parameter_table)
        self.fault_log = FaultLog(session)

    @property
    def telemetry(self) -> SignalTable:
        """The signals of this drive."""
        return self._session.telemetry

    @property
    def speed_reference_rpm(self) -> float:
        """Last requested value, in the range of the drive's DBC, which is the machine's; negative is reverse, and
        0 to a controller that drives forward only. DriveError out of that range, and below lowest_speed_rpm but for 0.
        The drive limits it to 7/8 of over_speed_rpm."""
        return self._speed_reference_rpm

    @speed_reference_rpm.setter
    def speed_reference_rpm(self, value: float) -> None:
        checked = _checked(self._command, "speed_reference_rpm", value)
        if 0.0 < abs(checked) < self.lowest_speed_rpm:
            raise DriveError(f"speed_reference_rpm {value:g}: the drive's encoder allows 0, or from "
                             f"{self.lowest_speed_rpm:.2f} r/min on")
        self._speed_reference_rpm = checked
        self._mode = "speed"
        self.ask("run")

    @property
    def torque_reference_Nm(self) -> float:
        """Last requested value, which the drive limits to +-torque_max_Nm; a negative one drives in reverse or brakes,
        and is 0 to a controller that drives forward only. Requests from here on are in torque mode."""
        return self._torque_reference_Nm

    @torque_reference_Nm.setter
    def torque_reference_Nm(self, value: float) -> None:
        self._torque_reference_Nm = _checked(self._torque_command, "torque_reference_Nm", value)
        self._mode = "torque"
        self.ask("run")

    @property
    def position_deg(self) -> float:
        """Last requested position over any number of turns; assigning it moves there by the profile of the parameters
        position_*. Requests from here on are in position mode; the position itself is DRIVE_POSITION.position_deg.
        DriveError beyond +-8192 turns."""
        return self._position_deg

    @position_deg.setter
    def position_deg(self, value: float) -> None:
        self._order_position("profile", value)

    def follow_position(self, position_deg: float) -> None:
        """The next one of cyclic positions, which come every position_cycle_ms."""
        passed_ns = self._session.time_ns - self._followed_ns
        ceased = passed_ns > 2 * _CYCLE_MAX_NS
        self._cycle_ns = COMMAND_PERIOD_NS if ceased else min(max(passed_ns, COMMAND_PERIOD_NS), _CYCLE_MAX_NS)
        self._followed_ns = self._session.time_ns
        self._order_position("cyclic", position_deg)

    def home(self, position_deg: float = 0.0) -> None:
        """Homes by the parameter homing_method; the place that it finds is called position_deg. Another order or mode
        ends it."""
        self._order_position("home", position_deg)

    def halt(self) -> None:
        """Stops by the profile and holds; acknowledges a following error."""
        self._order_position("halt", self._position_deg)

    def _order_position(self, order: str, position_deg: float) -> None:
        self._position_deg = _checked(self._position_command, "position_deg", position_deg)
        self._order = order
        self._mode = "position"
        self.ask("run")

    def begin_experiment(self, experiment: Experiment) -> int:
        """Requests an experiment; returns its number, 0 to 255, the lowest four bits of which its records have. The
        first one, outside of a run, arms the drive; it begins a run, which ends without commands, as any other."""
        self._experiment = experiment
        self._mode = "experiment"
        self._experiment_number = (self._experiment_number + 1) % 256
        window = self._session.drive_database.get_message_by_name(_IDENTIFY_WINDOW)
        self._session.send(e2e.protected_frame(window, self._counter, {
            "angle": experiment.angle, "width": experiment.width}))
        self._counter = (self._counter + 1) % 256
        self.ask("run")
        return self._experiment_number

    def stop(self) -> None:
        """Ramp to zero, then open the switches."""
        self.ask("stop")

    def off(self) -> None:
        """Open all switches now."""
        self.ask("off")

    def clear_fault(self) -> None:
        """Leave the fault state, if its cause has ended. The drive clears when the request changes: hence off first."""
        self.ask("off")
        self.ask("clear_fault")

    def continue_from(self, counter: int) -> None:
        """The next command continues the sequence of another sender, whose last counter this is, 0..255."""
        self._counter = (counter + 1) % 256

    def silence(self) -> None:
        """Send no more commands until the next request."""
        self.command_due_ns = None
        self._end_arming()

    def time_restarts(self) -> None:
        """The session's time is an earlier one from here on: what is to be repeated is due now, an arming has ended."""
        if self.command_due_ns is not None:
            self.command_due_ns = self._session.time_ns
        if self._disarmed_ns is not None:
            self._disarmed_ns = self._session.time_ns
        self._end_arming()

    def ask(self, request: str) -> None:
        """Request off, run, stop or clear_fault; sends it immediately."""
        if request not in REQUESTS:
            *most, last = REQUESTS
            raise DriveError(f"request '{request}': must be {', '.join(most)} or {last}")
        self._request = request
        self._arming_given_up = False
        if request == "run":
            self._require_drive_database()
            if self._arming is None and not self.armed:
                self._arming = ArmingSequence(self._session, self._arming_counter)
        else:
            self._end_arming()
            if request != "stop":
                self._disarmed_ns = self._session.time_ns
        self.send_command()

    @property
    def armed(self) -> bool:
        """The drive accepts requests to run, by its latest telemetry and what was requested since."""
        report = self._session.telemetry["DRIVE_ARMING.armed"]
        known = self._disarmed_ns is None or report.last_time_s * 1e9 > self._disarmed_ns + _DISARMED_NS
        return known and report.last == 1

    @property
    def due_ns(self) -> int | None:
        """When `send_due` has something to send next; None: never."""
        due = [self.command_due_ns, None if self._arming is None else self._arming.due_ns]
        return min((time_ns for time_ns in due if time_ns is not None), default=None)

    def send_due(self) -> None:
        """Sends what is due: a command, a step of the arming."""
        if self.command_due_ns is not None and self.command_due_ns <= self._session.time_ns:
            self.send_command()
        if self._arming is not None and self._arming.due_ns <= self._session.time_ns:
            self._arming.step()
            if self._arming.armed:
                self._disarmed_ns = None
            if self._arming.armed or self._arming.given_up:
                self._arming_given_up = self._arming.given_up
                self._end_arming()

    def _end_arming(self) -> None:
        if self._arming is not None:
            self._arming_counter = self._arming.counter
            self._arming = None

    def _require_drive_database(self) -> None:
        try:
            self._session.require_drive_database()
        except OtherDatabase:
            self.silence()
            raise

    def send_command(self) -> None:
        """Repeats the present request now; the next is due a period later."""
        if self._request is None:
            raise DriveError("no request to repeat")
        if self._request == "run":
            self._require_drive_database()
        counter = self._counter
        period_ns = COMMAND_PERIOD_NS
        if self._mode == "position":
            self._session.send(position_command_frame(counter, self._request, self._order, self._position_deg,
                                                      self._position_command))
            period_ns = self._cycle_ns * 3 // 2 if self._order == "cyclic" else period_ns
        elif self._mode == "experiment":
            self._session.send(self._experiment_frame(self._experiment, counter))
        elif self._mode == "torque":
            self._session.send(torque_command_frame(counter, self._request, self._torque_reference_Nm,
                                                    self._torque_command))
        else:
            self._session.send(command_frame(counter, self._request, self._speed_reference_rpm, self._command))
        self._counter = (counter + 1) % 256
        self.command_due_ns = self._session.time_ns + period_ns

    def _experiment_frame(self, experiment: Experiment, counter: int) -> can.Message:
        assert self._request is not None
        message = self._session.drive_database.get_message_by_name(_IDENTIFY_COMMAND)
        return e2e.protected_frame(message, counter, {
            "request": REQUESTS[self._request], "kind": EXPERIMENTS[experiment.kind], "phase": experiment.phase,
            "number": self._experiment_number, "level": experiment.level, "time_ms": experiment.time_ms})

    @property
    def state(self) -> str:
        """initialise, ready, run or fault, by its latest telemetry."""
        return self._session.telemetry["DRIVE_STATUS.state"].last_name

    @property
    def fault(self) -> str:
        """Name of the latched fault, or none, by its latest telemetry."""
        return self._session.telemetry["DRIVE_STATUS.fault"].last_name

    @property
    def mode(self) -> str:
        """speed, torque or position, by its latest telemetry."""
        return self._session.telemetry["DRIVE_STATUS.mode"].last_name

    @property
    def start_inhibited_by(self) -> str:
        """Name of the check that keeps the drive in state initialise, or none, by its latest telemetry."""
        return self._session.telemetry["DRIVE_STATUS.start_inhibited_by"].last_name

    @property
    def hindrance(self) -> str:
        """Why the drive does not run though it has no fault, by its latest telemetry: a check that fails, or an arming
        without a result. Empty when nothing is known to hinder it."""
        if self.state == "initialise" and self.start_inhibited_by not in ("none", "unknown"):
            return f"not ready: its check {self.start_inhibited_by} fails"
        if self._arming_given_up:
            return "not armed: the requests to arm were refused or had no answer"
        return ""

    def fault_trace(self) -> FaultTrace:
        """The control periods before the last fault; kept until the drive runs again. See read_fault_trace."""
        return read_fault_trace(self._session)

    def check_ready(self) -> None:
        """DriveNotReady, with the check that fails, while the drive is in state initialise. Not a failure before
        READY_TIMEOUT_S have passed since its start."""
        if self.state == "initialise":
            raise DriveNotReady(f"the drive is not ready: its check {self.start_inhibited_by} fails")

    def wait_until_ready(self) -> None:
        """Lets virtual time pass until the drive has left state initialise; DriveNotReady after READY_TIMEOUT_S."""
        deadline_ns = self._session.time_ns + round(READY_TIMEOUT_S * 1e9)
        while self.state in ("initialise", "unknown") and self._session.time_ns < deadline_ns:
            self._session.advance_to(self._session.time_ns + 1_000_000)
        self.check_ready()


def _checked(command: Message, name: str, value: float) -> float:
    """The value of a reference; DriveError when it is out of the range in the DBC."""
    signal = command.get_signal_by_name(name)
    low, high = signal_range(signal)
    if not low <= value <= high:
        raise DriveError(f"{name} {value:g}: must be {low:g} to {high:g} {signal.unit}")
    return float(value)


@dataclass(frozen=True)
class ParameterRow:
    """One parameter as described by the drive; limits and default in its unit."""

    index: int
    name: str
    unit: str
    fraction_bits: int
    minimum: float
    maximum: float
    default: float


class Parameters(MutableMapping[str, float]):
    """The drive's parameters by name, read and written in their units.

    The table is read from the drive at the first use, unless `table` returns it. Writing arms the drive for
    configuration and applies a set, of one parameter or, with `update`, of several: all of them or none. In a run the
    drive takes tunable parameters only. KeyError: unknown name. DriveError: set refused by the drive; the message names
    the parameters.
    """

    def __init__(self, session: Client, table: Callable[[], list[ParameterRow]] | None = None) -> None:
        self._session = session
        self._writer = ParameterSetWriter(session)
        self._table = table
        self._loaded: dict[str, ParameterRow] | None = None

    @property
    def rows(self) -> dict[str, ParameterRow]:
        """Descriptions by name, in the drive's order."""
        if self._loaded is None:
            rows = self._table() if self._table else read_parameter_table(self._session)
            self._loaded = {row.name: row for row in rows}
        return self._loaded

    def row(self, name: str) -> ParameterRow:
        """Description of one parameter; KeyError names the nearest."""
        if name not in self.rows:
            raise KeyError(f"no parameter '{name}'; {close_names(name, self.rows)}")
        return self.rows[name]

    def __getitem__(self, name: str) -> float:
        row = self.row(name)
        return math.ldexp(_access(self._session, "read", row.index)[1], -row.fraction_bits)

    def __setitem__(self, name: str, value: float) -> None:
        self.update({name: value})

    def update(self, *values: Any, **named: float) -> None:
        """Sets several parameters in one piece; arguments as for dict.update."""
        wanted: dict[str, float] = dict(*values, **named)
        writes = {self.row(name).index: raw_value(self.row(name), value) for name, value in wanted.items()}
        if writes:
            self._require_done(self._writer.apply(writes), wanted)

    def _require_done(self, result: SetResult, wanted: Mapping[str, float], what: str = "") -> None:
        """DriveError with names and values of the parameters for which a set is refused."""
        if result.status == "done":
            return
        rows = list(self.rows.values())
        row, other = rows[result.index], rows[result.other]
        prefix = f"{what}: " if what else ""

        def value(of: ParameterRow) -> str:
            number = wanted[of.name] if of.name in wanted else of.default if what else self[of.name]
            return value_name(of.name, number) or f"{number:g}"

        match result.status:
            case "out_of_range":
                text = f"{row.name} {value(row)}: must be {_allowed(row)}"
            case "contradiction":
                text = f"{row.name} {value(row)}: contradicts {other.name}, {value(other)} {row.unit}".rstrip()
            case "excludes_supply":
                present_V = self._session.telemetry["DRIVE_TORQUE.bus_voltage_V"].last
                text = f"{row.name} {value(row)}: excludes the present DC-link voltage, {present_V:.4g} V"
            case "memory":
                text = f"{what or ', '.join(wanted)}: a parameter has changed in the drive's memory; reset the drive"
                prefix = ""
            case "not_while_running":
                text = "not_while_running" if what else f"{row.name} {value(row)}: not_while_running"
            case status:
                text = status if what else f"{', '.join(wanted)}: {status}"
        raise DriveError(prefix + text)

    def save(self) -> None:
        """Stores the present values in the drive's memory; lets virtual time pass until that is done. DriveError while
        the drive runs, and when the memory does not accept them."""
        self._require_done(self._writer.save(), {}, "save")
        deadline_ns = self._session.time_ns + round(_SAVE_TIMEOUT_S * 1e9)
        while (saving := memory_item(self._session, "saving")) == _SAVING and self._session.time_ns < deadline_ns:
            pass  # each request takes time
        if saving != _SAVED:
            raise DriveError(f"save: not stored within {_SAVE_TIMEOUT_S:g} s" if saving == _SAVING
                             else "save: the memory does not accept the parameters")

    def restore_defaults(self) -> None:
        """Sets all parameters to their defaults, without storing them. DriveError while the drive runs."""
        self._require_done(self._writer.apply({}, defaults=True), {}, "restore_defaults")

    @property
    def origin(self) -> str:
        """Parameters at the last start: defaults, memory, or unusable, which are the defaults because no set in the
        memory could be used."""
        return ORIGINS[memory_item(self._session, "origin")]

    def __delitem__(self, name: str) -> None:
        raise TypeError("a drive's parameters cannot be deleted")

    def __iter__(self) -> Iterator[str]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class LoggedFault:
    """A fault in the log of the drive. number counts from 1 and never begins again; start is the number of the start
    of the drive, time_s the time since then; checks are the names of all checks that failed in that tick; the values
    are from that tick, torque and speed from the period before."""

    number: int
    start: int
    time_s: float
    fault: str
    checks: tuple[str, ...]
    state: str
    speed_rpm: float
    bus_voltage_V: float
    current_max_A: float
    torque_reference_Nm: float
    currents_A: tuple[float, ...]
    """Phases a to f; 0 for one that the machine does not have."""
    rotor_angle_deg: float
    self_test: tuple[str, ...]
    """Checks of DRIVE_SELF_TEST that had failed."""
    phases: str
    """Letters of the phases of DRIVE_PHASE_FAULT."""


def _has_more_phases(session: Client) -> bool:
    """The drive's machine has more phases than FIRST_PHASES."""
    return any(phases_above(message) > 0 for message in session.drive_database.messages)


def _self_tests() -> dict[int, str]:
    """Names of the checks by their bits in the log: DRIVE_SELF_TEST's, then the sensors of phases e and f."""
    signals = drive_database().get_message_by_name("DRIVE_SELF_TEST").signals
    more = [f"{part}_sensor_{phase}" for part in ("winding", "inverter") for phase in PHASES[FIRST_PHASES:]]
    return {signal.start: signal.name for signal in signals} | dict(enumerate(more, start=len(signals)))


class FaultLog(Sequence[LoggedFault]):
    """The last faults in the memory of the drive, 16 at most, the oldest first; read from the drive at each access.
    They survive a reset."""

    def __init__(self, session: Client) -> None:
        self._session = session

    def read(self) -> list[LoggedFault]:
        """All of them. One that a fault pushes out meanwhile is left out."""
        newest = memory_item(self._session, "newest_fault")
        found = (self._read(number) for number in range(max(1, newest - LOGGED_FAULTS + 1), newest + 1))
        return [fault for fault in found if fault is not None]

    def __len__(self) -> int:
        return len(self.read())

    def __getitem__(self, index: Any) -> Any:
        return self.read()[index]

    def _read(self, number: int) -> LoggedFault | None:
        items = dict.fromkeys(_FAULT_ITEMS, 0)
        count = len(_FAULT_ITEMS) - (0 if _has_more_phases(self._session) else _FAULT_ITEMS_OF_MORE)
        for part, name in enumerate(_FAULT_ITEMS[:count]):
            status, items[name] = _access(self._session, "fault_log", 0, part, number)
            if status != "done":
                return None
        snapshot = self._session.drive_database.get_message_by_name("DRIVE_FAULT_SNAPSHOT")
        physical = {signal.name: items[signal.name] * float(signal.scale) for signal in snapshot.signals}
        names = {value: name for name, value in value_numbers(drive_database(), "DRIVE_STATUS", "fault").items()}
        states = {value: name for name, value in value_numbers(drive_database(), "DRIVE_STATUS", "state").items()}
        time_us = (items["time_wraps"] << 32) + (items["time_us"] & 0xFFFFFFFF)
        return LoggedFault(
            number=number, start=items["start"], time_s=time_us / 1e6,
            fault=names.get(items["fault"], str(items["fault"])),
            checks=tuple(name for value, name in names.items() if value > 0 and items["checks"] >> value & 1),
            state=states.get(items["state"], str(items["state"])),
            currents_A=tuple(items[f"current_{phase}"] * float(snapshot.get_signal_by_name("current_max_A").scale)
                             for phase in PHASES),
            rotor_angle_deg=items["angle"] * 360.0 / 65536.0,
            self_test=tuple(name for bit, name in _self_tests().items() if items["self_test"] >> bit & 1),
            phases="".join(phase for bit, phase in enumerate(PHASES) if items["phases"] >> bit & 1), **physical)


@dataclass(frozen=True)
class FaultTrace:
    """The control periods up to the one that latched a fault, the last row: what was measured at their starts, and the
    duties that were written in them and act in the next one. Of phases, one column for each. Rows before the start of
    the drive are zero."""

    time_s: np.ndarray
    """0 at the last row."""
    current_A: np.ndarray
    bus_voltage_V: np.ndarray
    rotor_angle_deg: np.ndarray
    speed_rpm: np.ndarray
    torque_reference_Nm: np.ndarray
    upper_duty: np.ndarray
    lower_duty: np.ndarray


def _read_trace_parts(session: Client, parts: Sequence[int]) -> np.ndarray:
    """A row for each period, two signed numbers of 16 bits for each part."""
    raw = np.zeros((TRACE_PERIODS, 2 * len(parts)), dtype="<i2")
    for period in range(TRACE_PERIODS):
        for column, part in enumerate(parts):
            status, value = _access(session, "fault_trace", period, part)
            if status != "done":
                reason = ": the drive keeps no record; it has had no fault, or has run since"
                raise DriveError(f"fault trace: {status}{reason if status == 'no_such_entry' else ''}")
            raw[period, 2 * column : 2 * column + 2] = np.frombuffer(value.to_bytes(4, "little", signed=True),
                                                                     dtype="<i2")
    return raw


def read_fault_trace(session: Client) -> FaultTrace:
    """Reads the trace from the drive, which keeps it from a fault to the next run; takes some 0.3 s of virtual time.
    DriveError when there is none."""
    raw = _read_trace_parts(session, range(_TRACE_PARTS))
    if _has_more_phases(session):
        more = _read_trace_parts(session, range(_TRACE_PARTS, _TRACE_PARTS + _TRACE_MORE_PARTS))
        raw = np.concatenate((raw, more), axis=1)
    phases = int(session.telemetry["DRIVE_HEARTBEAT.phases"].last)
    snapshot = session.drive_database.get_message_by_name("DRIVE_FAULT_SNAPSHOT")
    scale = {signal.name: float(signal.scale) for signal in snapshot.signals}
    positive = raw.astype(np.uint16).astype(float)
    columns = [[*range(first, first + FIRST_PHASES), more, more + 1][:phases]
               for first, more in ((0, 16), (8, 18), (8 + FIRST_PHASES, 20))]
    return FaultTrace(
        time_s=np.arange(1 - TRACE_PERIODS, 1) / session.telemetry["DRIVE_HEARTBEAT.control_rate_hz"].last,
        current_A=positive[:, columns[0]] * scale["current_max_A"],
        bus_voltage_V=positive[:, 4] * scale["bus_voltage_V"],
        rotor_angle_deg=positive[:, 5] * 360.0 / 65536.0,
        speed_rpm=raw[:, 6] * scale["speed_rpm"],
        torque_reference_Nm=raw[:, 7] * scale["torque_reference_Nm"],
        upper_duty=positive[:, columns[1]] / 32768.0,
        lower_duty=positive[:, columns[2]] / 32768.0)


def raw_value(row: ParameterRow, value: float) -> int:
    """Raw integer of a physical value; DriveError when it exceeds 32 bits."""
    raw = round(math.ldexp(value, row.fraction_bits))
    if not -(2**31) <= raw < 2**31:
        raise DriveError(f"{row.name} {value:g}: must be {_allowed(row)}")
    return raw


def _allowed(row: ParameterRow) -> str:
    """The values of a parameter, by their names where they have them."""
    names = CHOICES.get(row.name)
    return either(names) if names else f"{row.minimum:g} to {row.maximum:g} {row.unit}".rstrip()


def read_parameter_table(session: Client) -> list[ParameterRow]:
    """Reads the descriptions of all parameters from the drive; takes some 0.1 s of virtual time."""
    fraction_bits: list[int] = []
    while True:
        block = range(len(fraction_bits), len(fraction_bits) + _REQUESTS_AT_ONCE)
        answers = _access_all(session, [("fraction_bits", index, 0) for index in block])
        known = [value for status, value in answers if status == "done"]
        fraction_bits += known
        if len(known) < len(block):
            break
    indices = range(len(fraction_bits))
    limits = [[value for _, value in _access_all(session, [(what, index, 0) for index in indices])]
              for what in ("minimum", "maximum", "default")]
    names, units = (_read_texts(session, what, len(indices)) for what in ("name", "unit"))
    return [ParameterRow(index, names[index], units[index], fraction_bits[index],
                         *(math.ldexp(limit[index], -fraction_bits[index]) for limit in limits)) for index in indices]


def _request(database: Database, operation: str, index: int, part: int, value: int) -> can.Message:
    message = database.get_message_by_name("PARAMETER_REQUEST")
    signals = {"operation": _OPERATIONS[operation], "index": index, "part": part, "value": value}
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=message.encode(signals))


def _access(session: Client, operation: str, index: int, part: int = 0, value: int = 0) -> tuple[str, int]:
    """(status, value) of the drive's response; lets virtual time pass until it arrives."""
    message = session.drive_database.get_message_by_name("PARAMETER_RESPONSE")
    head = bytes([_OPERATIONS[operation], index, part])
    for _ in range(_ATTEMPTS):
        session.send(_request(session.drive_database, operation, index, part, value))
        try:
            response = session.advance_until_frame(
                lambda m: m.arbitration_id == message.frame_id and not m.is_extended_id and bytes(m.data[:3]) == head,
                _RESPONSE_TIMEOUT_S,
            )
        except TimeoutError:
            continue
        signals: Mapping[str, Any] = message.decode_simple(bytes(response.data))
        return str(signals["status"]), int(signals["value"])
    raise DriveError(f"no response to {_ATTEMPTS} PARAMETER_REQUEST {operation} {index} in "
                     f"{_ATTEMPTS * _RESPONSE_TIMEOUT_S:g} s")


def memory_item(session: Client, name: str) -> int:
    """An item of the state of the memory."""
    return _access(session, "memory", 0, _MEMORY_ITEMS.index(name))[1]


def _read_texts(session: Client, operation: str, count: int) -> list[str]:
    """Texts of parameters 0 to count - 1, four characters a part; a text ends with a part that ends in a zero."""
    texts = [b""] * count
    open_texts = list(range(count))
    for part in range(_TEXT_PARTS_MAX):
        answers = _access_all(session, [(operation, index, part) for index in open_texts])
        fours = [value.to_bytes(4, "little", signed=True) for _, value in answers]
        for index, four in zip(open_texts, fours, strict=True):
            texts[index] += four.rstrip(b"\0")
        open_texts = [index for index, four in zip(open_texts, fours, strict=True) if not four.endswith(b"\0")]
        if not open_texts:
            break
    return [text.decode("ascii") for text in texts]


def _access_all(session: Client, requests: Sequence[tuple[str, int, int]]) -> list[tuple[str, int]]:
    """(status, value) of each request (operation, index, part), several under way at once; a lost one is repeated."""
    message = session.drive_database.get_message_by_name("PARAMETER_RESPONSE")
    answers: list[tuple[str, int]] = []
    for start in range(0, len(requests), _REQUESTS_AT_ONCE):
        block = requests[start:start + _REQUESTS_AT_ONCE]
        waiting = {bytes([_OPERATIONS[operation], index, part]): number
                   for number, (operation, index, part) in enumerate(block)}
        found: dict[int, tuple[str, int]] = {}

        def take(frame: can.Message, waiting: dict[bytes, int] = waiting,
                 found: dict[int, tuple[str, int]] = found) -> bool:
            if frame.arbitration_id == message.frame_id and not frame.is_extended_id:
                number = waiting.pop(bytes(frame.data[:3]), None)
                if number is not None:
                    signals: Mapping[str, Any] = message.decode_simple(bytes(frame.data))
                    found[number] = str(signals["status"]), int(signals["value"])
            return not waiting

        for operation, index, part in block:
            session.send(_request(session.drive_database, operation, index, part, 0))
        with contextlib.suppress(TimeoutError):
            session.advance_until_frame(take, _RESPONSE_TIMEOUT_S)
        answers += [found[number] if number in found else _access(session, *request)
                    for number, request in enumerate(block)]
    return answers

