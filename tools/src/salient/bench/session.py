"""A session with a drive and its test bench on one bus: time, commands, signals, the log.

    from salient.bench.session import Session
    session = Session("unix:build/salient.sock", lockstep=False)
    session.drive.speed_reference_rpm = 600
    session.run_for(1.0)
    print(session.telemetry["speed_rpm"].last)
"""

from __future__ import annotations

import math
import numbers
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Self

import can
from cantools.database.can import Database

from salient.bench.client import Client, KnownAttributes
from salient.bench.drive import Drive, ParameterRow
from salient.bench.rig import Fault, Rig
from salient.bus.clock import RIG_CLOCK_ID, VirtualTimeReader, clock_of, open_bus
from salient.bus.identity import IDENTITY_WAIT_NS, Carrier, OtherDatabase, hash_of
from salient.bus.signals import SignalTable, drive_database, rig_database
from salient.errors import RunFailed, UsageError, shown

if TYPE_CHECKING:
    from salient.bench.sampler import Scope

RIG_RUN_UNTIL_ID = rig_database().get_message_by_name("RIG_RUN_UNTIL").frame_id
SILENCE_MAX_S = 5.0
"""For commands that read a drive: it sends at least every 0.1 s of its time; an emulated one may be slow."""
_ALIVE_CHECK_S = 1.0
"""Wall time between two checks that the emulator is alive; a debugger may stop it for any time."""

_POLL_STEP_NS = 500_000
_SOCKETCAN_STEP_NS = 10_000_000
"""Longest step on a SocketCAN interface: its socket loses frames that do not fit, and the end of the step with them."""

_NO_STEP_NS = 1 << 62

_TIME_MAX_S = 280_000.0
"""A time of RIG_RUN_UNTIL has 6 bytes: 281,474 s."""


def _nanoseconds(name: str, time_s: float, least_s: float = 0.0) -> int:
    """A time in ns; UsageError below least_s. A negative one would pass no time, and a step of 0 would never end."""
    is_number = isinstance(time_s, numbers.Real) and not isinstance(time_s, bool)
    if not is_number or not least_s <= time_s <= _TIME_MAX_S:
        raise UsageError(f"{name} {shown(time_s)}: must be a number of seconds from {least_s:g} to {_TIME_MAX_S:g}")
    return round(time_s * 1e9)


class SessionError(RunFailed):
    """The emulator has ended, or the bus is silent."""


class _DriveOfSeveral:
    """A session as the client of another drive than its first one."""

    def __init__(self, session: Session, machine: str | None, node: int) -> None:
        self._session = session
        self.drive_database, self.rig_database = drive_database(machine, node), rig_database(node)
        self.telemetry = SignalTable(self.drive_database, "DRIVE")
        self.truth = SignalTable(self.rig_database, "RIG")
        self.require_drive_database = session.require_drive_database  # all have the same machine
        self.send, self.receive_until = session.send, session.receive_until
        self.advance_to, self.advance_until_frame = session.advance_to, session.advance_until_frame

    @property
    def time_ns(self) -> int:
        """Virtual time."""
        return self._session.time_ns


class Session(KnownAttributes):
    """One client's view of a bus.

    lockstep: this session moves time (the pace of the emulator is lockstep). Otherwise time moves by itself, and the
    session follows it by the times of received frames. is_alive: the emulator has not ended; without it the end of the
    emulator is seen on a local bus only. A session waits for the emulator for any wall time, as at a breakpoint, unless
    silence_max_s bounds that without a frame of the drive or the emulator; then SessionError.

    machine: name or file of the drive's machine, whose DBC the session uses. Where time moves by itself, the session
    begins with the drive's report of its DBC, if there is one within 250 ms: without a machine it is then the drive's,
    and OtherDatabase when it is not known here, or is not the one that is given. In lock-step, where the report may
    come 100 ms later, a session without a machine has the DBC in SI units, and one of another drive warns. To a drive
    that reports another DBC no reference is sent (OtherDatabase). machine_option: how the user states the machine.

    node: the node number of the drive; drives: their number, with ascending node numbers from there: nodes. drive, rig,
    telemetry and truth are the first drive's; drives[1] and rigs[1] have their own telemetry and truth.

    time_ns: virtual time. log: every (time_ns, message) since the session began, in bus order. sent: likewise what the
    session has sent, but for RIG_RUN_UNTIL. scopes: what scope() has returned. telemetry, truth: signals of the drive
    and of the test bench by name, all frames or, with signals=LatestSignals, the latest: for a session of any length,
    whose owner clears log and sent.
    """

    address: str
    machine: str | None
    nodes: range
    time_ns: int
    log: list[tuple[int, can.Message]]
    sent: list[tuple[int, can.Message]]
    scopes: list[Scope]
    telemetry: SignalTable
    truth: SignalTable
    drive_database: Database
    rig_database: Database
    drives: list[Drive]
    rigs: list[Rig]
    drive: Drive
    rig: Rig

    def __init__(self, address: str, lockstep: bool = True,  # noqa: PLR0913, PLR0917 - each has a default
                 parameter_table: Callable[[], list[ParameterRow]] | None = None,
                 is_alive: Callable[[], bool] = lambda: True, machine: str | None = None,
                 node: int = 0, drives: int = 1, silence_max_s: float = math.inf,
                 signals: type[SignalTable] = SignalTable, machine_option: str = "machine=") -> None:
        self.address = address
        self.nodes = range(node, node + drives)
        self.time_ns = 0
        self.log = []
        self.sent = []
        self.scopes = []
        self._carrier = Carrier(address, machine, node, option=machine_option)
        self._tables: list[SignalTable] = []
        self.drives = []
        self._signals = signals
        self._lockstep = lockstep
        self._step_max_ns = _SOCKETCAN_STEP_NS // drives if address.startswith("socketcan:") else _NO_STEP_NS
        self._is_alive = is_alive
        self._silence_max_s = silence_max_s
        self._sequence = 0
        self._other_database = ""
        self._bus = open_bus(address)
        self._reader = VirtualTimeReader(self._bus)
        try:
            if not lockstep:
                self._await_identity()
            self._use(self._carrier.machine or machine, parameter_table)
            if lockstep:
                self._run_until(0)  # the answer has the present time
        except BaseException:
            self.close()
            raise

    def _await_identity(self) -> None:
        """Receives until the drive has reported its DBC, or has not for IDENTITY_WAIT_NS. OtherDatabase: see above."""
        begin_ns = None
        while not self._carrier.take(self._receive()):
            begin_ns = self.time_ns if begin_ns is None else begin_ns
            if self.time_ns - begin_ns > IDENTITY_WAIT_NS:
                return

    def _use(self, machine: str | None, parameter_table: Callable[[], list[ParameterRow]] | None) -> None:
        """Makes drives, benches and tables of the DBC of a machine; the tables have what was received before."""
        self.machine = machine
        node, *others = self.nodes
        self.drive_database, self.rig_database = drive_database(machine, node), rig_database(node)
        self.telemetry = self._signals(self.drive_database, "DRIVE")
        self.truth = self._signals(self.rig_database, "RIG")
        clients: list[Client] = [self, *(_DriveOfSeveral(self, machine, other) for other in others)]
        self.drives = [Drive(client, parameter_table) for client in clients]
        self.rigs = [Rig(client) for client in clients]
        self.drive, self.rig = self.drives[0], self.rigs[0]
        self._tables = [table for client in clients for table in (client.telemetry, client.truth)]
        for time_ns, message in self.log:
            for table in self._tables:
                table.add(time_ns, message)

    def close(self) -> None:
        """Leaves the bus."""
        self._bus.shutdown()

    def leave_running(self, duration_s: float) -> None:
        """Leaves the bus after a request to run on for duration_s of virtual time; lock-step only. UsageError when
        duration_s is negative or no number."""
        self._request_run(self.time_ns + _nanoseconds("leave_running: duration_s", duration_s))
        self.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def time_s(self) -> float:
        """Virtual time in seconds."""
        return self.time_ns / 1e9

    @property
    def load_torque_Nm(self) -> float:
        """Shorthand for rig.load_torque_Nm."""
        return self.rig.load_torque_Nm

    @load_torque_Nm.setter
    def load_torque_Nm(self, value: float) -> None:
        self.rig.load_torque_Nm = value

    @property
    def held_speed_rpm(self) -> float:
        """Shorthand for rig.held_speed_rpm."""
        return self.rig.held_speed_rpm

    @held_speed_rpm.setter
    def held_speed_rpm(self, value: float) -> None:
        self.rig.held_speed_rpm = value

    def at(self, time_s: float) -> Rig:
        """The bench variables at a virtual time: session.at(0.13).load_torque_Nm = 8."""
        return self.rig.at(time_s)

    def fault(self, kind: str, *, duration_s: float | None = None, **arguments: Any) -> Fault:
        """Begins a fault now: session.fault("winding_open", phase="b"). See Rig.fault."""
        return self.rig.fault(kind, duration_s=duration_s, **arguments)

    def clear_fault(self, kind: str, **places: str) -> None:
        """Ends a fault now. See Rig.clear_fault."""
        self.rig.clear_fault(kind, **places)

    def scope(self, signals: Sequence[str], trigger: str | None = None, *, before: float = 0.25, divider: int = 1
              ) -> Scope:
        """Arms the drive's triggered buffer for 1 to 8 signals at the control rate: scope = bench.scope(["current_a_A",
        "state"], trigger="state == fault"); its read() gives the arrays. See salient.bench.sampler.arm."""
        from salient.bench import sampler  # needs it in turn

        armed = sampler.arm(self, signals, trigger, before=before, divider=divider)
        for earlier in self.scopes:
            earlier.replaced = True
        self.scopes.append(armed)
        return armed

    def run_for(self, duration_s: float) -> None:
        """Lets virtual time pass; commands go out as they fall due.

        UsageError when duration_s is negative or no number.
        """
        self.advance_to(self.time_ns + _nanoseconds("run_for: duration_s", duration_s))

    def run_until(self, condition: Callable[[], bool], timeout: float, step_s: float = 1e-3) -> float:
        """Lets virtual time pass in steps until the condition holds; returns the time in seconds.

        AssertionError when it does not hold within `timeout` seconds of virtual time. UsageError when the condition is
        no function, and when timeout or step_s is negative or no number, or step_s 0.
        """
        __tracebackhide__ = True  # pytest shows the line of the test
        if not callable(condition):
            raise UsageError(f"run_until: condition {shown(condition)}: must be a function, called at every step,"
                             " as in run_until(lambda: ..., timeout=1.0); a value was computed once, before the call")
        deadline_ns = self.time_ns + _nanoseconds("run_until: timeout", timeout)
        step_ns = _nanoseconds("run_until: step_s", step_s, least_s=1e-9)
        while not condition():
            if self.time_ns >= deadline_ns:
                hindrance = self.drive.hindrance
                reason = f"; the drive is {hindrance}" if hindrance else ""
                raise AssertionError(f"condition not met within {timeout:g} s, at {self.time_s:g} s of virtual time"
                                     f"{reason}")
            self.advance_to(min(deadline_ns, self.time_ns + step_ns))
        return self.time_s

    def advance_to(self, time_ns: int) -> None:
        """Lets virtual time pass until `time_ns`; commands go out as they fall due, one due just then included."""
        while True:
            due_ns = min((drive.due_ns for drive in self.drives if drive.due_ns is not None), default=None)
            stop_ns = time_ns if due_ns is None else min(time_ns, due_ns)
            if stop_ns > self.time_ns:
                self._advance(stop_ns)
            if due_ns is not None and due_ns <= self.time_ns:
                for drive in self.drives:
                    drive.send_due()
            if self.time_ns >= time_ns:
                return

    def advance_until_frame(self, matches: Callable[[can.Message], bool], timeout_s: float) -> can.Message:
        """Lets virtual time pass until a frame matches; TimeoutError after timeout_s of virtual time."""
        deadline_ns = self.time_ns + round(timeout_s * 1e9)
        seen = len(self.log)
        while self.time_ns < deadline_ns:
            self.advance_to(min(deadline_ns, self.time_ns + _POLL_STEP_NS))
            for _, message in self.log[seen:]:
                if matches(message):
                    return message
            seen = len(self.log)
        raise TimeoutError(f"no matching frame within {timeout_s:g} s")

    def require_drive_database(self) -> None:
        """OtherDatabase when the drive has reported another DBC than the session's. Waits for its first report
        where time moves by itself; in lock-step time belongs to the caller, and the report may come up to 100 ms later.
        """
        deadline_ns = self.time_ns + IDENTITY_WAIT_NS
        while not (self._lockstep or self._carrier.machine or self._other_database) and self.time_ns < deadline_ns:
            self._receive()
        if self._other_database:
            raise OtherDatabase(f"{self._other_database}: a reference would be another one")

    def receive_until(self, matches: Callable[[can.Message], bool]) -> can.Message:
        """Receives until a frame matches; in lock-step virtual time does not pass."""
        while True:
            message = self._receive()
            if matches(message):
                return message

    def send(self, message: can.Message) -> None:
        """Sends a frame of any kind; waits while the emulator takes none."""
        if message.arbitration_id != RIG_RUN_UNTIL_ID:
            self.sent.append((self.time_ns, message))
        silent_s = 0.0
        while True:
            try:
                return self._bus.send(message, timeout=_ALIVE_CHECK_S)
            except can.CanTimeoutError:
                silent_s += _ALIVE_CHECK_S
                self._check_alive(silent_s)

    def _check_alive(self, silent_s: float) -> None:
        if not self._is_alive():
            raise SessionError(f"{self.address}: the emulator has ended")
        if silent_s >= self._silence_max_s:
            raise SessionError(f"{self.address}: no frame of a drive for {silent_s:g} s; is there one?")

    def _advance(self, time_ns: int) -> None:
        if self._lockstep:
            while self.time_ns < time_ns:
                self._run_until(min(time_ns, self.time_ns + self._step_max_ns))
        else:
            while self.time_ns < time_ns:
                self._receive()

    def _run_until(self, time_ns: int) -> None:
        self._request_run(time_ns)
        clock = self.receive_until(
            lambda m: m.arbitration_id == RIG_CLOCK_ID and m.is_extended_id and m.data[6] == self._sequence
        )
        self.time_ns = clock_of(clock)[0]

    def _request_run(self, time_ns: int) -> None:
        self._sequence = (self._sequence + 1) % 256
        data = time_ns.to_bytes(6, "little") + bytes([self._sequence])
        self.send(can.Message(arbitration_id=RIG_RUN_UNTIL_ID, is_extended_id=True, data=data))

    def _receive(self) -> can.Message:
        silent_s = 0.0
        while (timed := self._reader.receive(_ALIVE_CHECK_S)) is None:
            silent_s += _ALIVE_CHECK_S
            self._check_alive(silent_s)
        time_ns, message = timed
        if not self._lockstep:
            self.time_ns = max(self.time_ns, time_ns)
        self.log.append(timed)
        for table in self._tables:
            table.add(time_ns, message)
        if self._tables and self._carrier.concerns(message):
            self._check_identity(message)
        return message

    def _check_identity(self, message: can.Message) -> None:
        """One line on stderr, once, when the drive's DBC is not the session's."""
        if self._other_database:
            return
        known = self._carrier.machine
        try:
            if not self._carrier.take(message) or self._carrier.machine == known:
                return
            carried = self._carrier.machine
            if hash_of(carried) != hash_of(self.machine):
                self._other_database = (f"{self.address}: the drive carries {carried}, this session has begun without "
                                        "a machine: state it with machine=")
        except OtherDatabase as error:
            self._other_database = str(error)
        if self._other_database:
            print(f"salient: {self._other_database}: signals may be decoded wrongly", file=sys.stderr)
