"""The drive over CAN: commands, parameters, state."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import can
from cantools.database.can import Message

from salient.bench.client import Client, KnownAttributes
from salient.bus import e2e
from salient.bus.signals import drive_database, signal_range, value_numbers
from salient.errors import RunFailed, UsageError

_COMMAND = drive_database().get_message_by_name("DRIVE_COMMAND")
_TORQUE_COMMAND = drive_database().get_message_by_name("DRIVE_TORQUE_COMMAND")
REQUESTS = value_numbers(drive_database(), "DRIVE_COMMAND", "request")
assert _COMMAND.cycle_time is not None  # GenMsgCycleTime in drive.dbc
COMMAND_PERIOD_NS = _COMMAND.cycle_time * 1_000_000
"""Period of the commands in virtual time; the drive stops when they are no longer sent."""

READY_TIMEOUT_S = 0.02
"""Time after its start in which a drive without a failing check is ready: 1 ms of passed checks, and its telemetry."""

_RESPONSE_TIMEOUT_S = 0.1
_TEXT_PARTS_MAX = 64
_OPERATIONS = value_numbers(drive_database(), "PARAMETER_REQUEST", "operation")


class DriveError(Exception):
    """The drive rejected a request or did not respond; the message has the reason."""


class OtherDatabase(DriveError, UsageError):
    """A reference for a drive whose DBC is not that of the session: the drive would take it for another one."""


class DriveNotReady(DriveError, RunFailed):
    """A check keeps the drive in state initialise; the message names it."""


def command_frame(counter: int, request: str, speed_reference_rpm: float, message: Message = _COMMAND) -> can.Message:
    """A DRIVE_COMMAND with its checksum. counter 0..255; request one of REQUESTS; the speed within the range of the
    message, which is that of the drive's DBC."""
    return _protected(message, counter, request, {"speed_reference_rpm": speed_reference_rpm})


def torque_command_frame(counter: int, request: str, torque_reference_Nm: float,
                         message: Message = _TORQUE_COMMAND) -> can.Message:
    """A DRIVE_TORQUE_COMMAND with its checksum, as command_frame."""
    return _protected(message, counter, request, {"torque_reference_Nm": torque_reference_Nm})


def _protected(command: Message, counter: int, request: str, reference: Mapping[str, float]) -> can.Message:
    signals = {"checksum": 0, "counter": counter, "request": REQUESTS[request], **reference}
    payload = command.encode(signals)[e2e.HEADER_BYTES :]
    data = e2e.protect(e2e.data_id(command), counter, payload)
    return can.Message(arbitration_id=command.frame_id, is_extended_id=False, data=data)


class Drive(KnownAttributes):
    """Commands a drive. Assigning speed_reference_rpm or torque_reference_Nm requests run in speed or torque mode; the
    command is sent immediately and then every COMMAND_PERIOD_NS as the session's time advances, until `silence`.
    Nothing is sent before the first request. OtherDatabase instead of a request to run when the drive's DBC is another
    than that of the session (Session.require_drive_database); off, stop and clear_fault have no scaling.
    """

    command_due_ns: int | None
    parameters: Parameters

    def __init__(self, session: Client, parameter_table: Callable[[], list[ParameterRow]] | None = None) -> None:
        self._session = session
        self._command = session.drive_database.get_message_by_name(_COMMAND.name)
        self._torque_command = session.drive_database.get_message_by_name(_TORQUE_COMMAND.name)
        self._request: str | None = None
        self._speed_reference_rpm = 0.0
        self._torque_reference_Nm = 0.0
        self._torque_mode = False
        self._counter = {False: 0, True: 0}
        self.command_due_ns = None
        self.parameters = Parameters(session, parameter_table)

    @property
    def speed_reference_rpm(self) -> float:
        """Last requested value, in the range of the drive's DBC, at least -3000..3000; negative is reverse, and 0 to a
        controller that drives forward only."""
        return self._speed_reference_rpm

    @speed_reference_rpm.setter
    def speed_reference_rpm(self, value: float) -> None:
        self._speed_reference_rpm = _checked(self._command, "speed_reference_rpm", value)
        self._torque_mode = False
        self.ask("run")

    @property
    def torque_reference_Nm(self) -> float:
        """Last requested value, which the drive limits to +-torque_max_Nm; a negative one drives in reverse or brakes,
        and is 0 to a controller that drives forward only. Requests from here on are in torque mode."""
        return self._torque_reference_Nm

    @torque_reference_Nm.setter
    def torque_reference_Nm(self, value: float) -> None:
        self._torque_reference_Nm = _checked(self._torque_command, "torque_reference_Nm", value)
        self._torque_mode = True
        self.ask("run")

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

    def silence(self) -> None:
        """Send no more commands until the next request."""
        self.command_due_ns = None

    def ask(self, request: str) -> None:
        """Request off, run, stop or clear_fault; sends it immediately."""
        if request not in REQUESTS:
            *most, last = REQUESTS
            raise DriveError(f"request '{request}': must be {', '.join(most)} or {last}")
        self._request = request
        self.send_command()

    def send_command(self) -> None:
        """Repeats the present request now; the next is due a period later."""
        if self._request is None:
            raise DriveError("no request to repeat")
        if self._request == "run":
            try:
                self._session.require_drive_database()
            except OtherDatabase:
                self.silence()
                raise
        counter = self._counter[self._torque_mode]
        if self._torque_mode:
            self._session.send(torque_command_frame(counter, self._request, self._torque_reference_Nm,
                                                    self._torque_command))
        else:
            self._session.send(command_frame(counter, self._request, self._speed_reference_rpm, self._command))
        self._counter[self._torque_mode] = (counter + 1) % 256
        self.command_due_ns = self._session.time_ns + COMMAND_PERIOD_NS

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
        """speed or torque, by its latest telemetry."""
        return self._session.telemetry["DRIVE_STATUS.mode"].last_name

    @property
    def start_inhibited_by(self) -> str:
        """Name of the check that keeps the drive in state initialise, or none, by its latest telemetry."""
        return self._session.telemetry["DRIVE_STATUS.start_inhibited_by"].last_name

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

    The table is read from the drive at the first use, unless `table` returns it. KeyError: unknown name. DriveError:
    value rejected by the drive.
    """

    def __init__(self, session: Client, table: Callable[[], list[ParameterRow]] | None = None) -> None:
        self._session = session
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
        """Description of one parameter; KeyError lists the names."""
        if name not in self.rows:
            raise KeyError(f"no parameter '{name}'; the parameters are {', '.join(self.rows)}")
        return self.rows[name]

    def __getitem__(self, name: str) -> float:
        row = self.row(name)
        return math.ldexp(_access(self._session, "read", row.index)[1], -row.fraction_bits)

    def __setitem__(self, name: str, value: float) -> None:
        row = self.row(name)
        status, _ = _access(self._session, "write", row.index, value=raw_value(row, value))
        if status == "out_of_range":
            raise DriveError(f"{name} {value:g}: must be {row.minimum:g} to {row.maximum:g} {row.unit}".rstrip())
        if status != "done":
            raise DriveError(f"{name} {value:g}: {status}")

    def __delitem__(self, name: str) -> None:
        raise TypeError("a drive's parameters cannot be deleted")

    def __iter__(self) -> Iterator[str]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)


def raw_value(row: ParameterRow, value: float) -> int:
    """Raw integer of a physical value; DriveError when it exceeds 32 bits."""
    raw = round(math.ldexp(value, row.fraction_bits))
    if not -(2**31) <= raw < 2**31:
        raise DriveError(f"{row.name} {value:g}: must be {row.minimum:g} to {row.maximum:g} {row.unit}".rstrip())
    return raw


def read_parameter_table(session: Client) -> list[ParameterRow]:
    """Reads the descriptions of all parameters from the drive; takes some 0.1 s of virtual time."""
    rows: list[ParameterRow] = []
    while True:
        index = len(rows)
        status, fraction_bits = _access(session, "fraction_bits", index)
        if status != "done":
            return rows
        limits = (math.ldexp(_access(session, what, index)[1], -fraction_bits)
                  for what in ("minimum", "maximum", "default"))
        name, unit = (_read_text(session, what, index) for what in ("name", "unit"))
        rows.append(ParameterRow(index, name, unit, fraction_bits, *limits))


def write_request(row: ParameterRow, value: float) -> can.Message:
    """The PARAMETER_REQUEST that writes a value."""
    return _request("write", row.index, 0, raw_value(row, value))


def _request(operation: str, index: int, part: int, value: int) -> can.Message:
    message = drive_database().get_message_by_name("PARAMETER_REQUEST")
    signals = {"operation": _OPERATIONS[operation], "index": index, "part": part, "value": value}
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=message.encode(signals))


def _access(session: Client, operation: str, index: int, part: int = 0, value: int = 0) -> tuple[str, int]:
    """(status, value) of the drive's response; lets virtual time pass until it arrives."""
    session.send(_request(operation, index, part, value))
    message = drive_database().get_message_by_name("PARAMETER_RESPONSE")
    head = bytes([_OPERATIONS[operation], index, part])
    try:
        response = session.advance_until_frame(
            lambda m: m.arbitration_id == message.frame_id and not m.is_extended_id and bytes(m.data[:3]) == head,
            _RESPONSE_TIMEOUT_S,
        )
    except TimeoutError:
        text = f"no response to PARAMETER_REQUEST {operation} {index} within {_RESPONSE_TIMEOUT_S} s"
        raise DriveError(text) from None
    signals: Mapping[str, Any] = message.decode_simple(bytes(response.data))
    return str(signals["status"]), int(signals["value"])


def _read_text(session: Client, operation: str, index: int) -> str:
    text = b""
    for part in range(_TEXT_PARTS_MAX):
        four = _access(session, operation, index, part)[1].to_bytes(4, "little", signed=True)
        text += four.rstrip(b"\0")
        if four.endswith(b"\0"):
            break
    return text.decode("ascii")
