"""A session with a drive and its test bench on one bus: time, commands, signals, the log.

    from salient.bench.session import Session
    session = Session("unix:build/salient.sock", lockstep=False)
    session.drive.speed_reference_rpm = 600
    session.run_for(1.0)
    print(session.telemetry["speed_rpm"].last)
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Self

import can
from cantools.database.can import Database

from salient.bench.client import KnownAttributes
from salient.bench.drive import Drive, OtherDatabase, ParameterRow
from salient.bench.rig import Fault, Rig
from salient.bus.clock import RIG_CLOCK_ID, VirtualTimeReader, clock_of, open_bus
from salient.bus.signals import SignalTable, drive_database, rig_database
from salient.dbc import database_hash

_ALIVE_CHECK_S = 1.0
"""Wall time between two checks that the emulator is alive; a debugger may stop it for any time."""

_POLL_STEP_NS = 500_000
_IDENTITY_WAIT_NS = 250_000_000
"""More than two periods of DRIVE_IDENTITY."""
_IDENTITY = drive_database().get_message_by_name("DRIVE_IDENTITY")


class SessionError(Exception):
    """The emulator has ended."""


class Session(KnownAttributes):
    """One client's view of a bus.

    lockstep: this session moves time (the pace of the emulator is lockstep). Otherwise time moves by itself, and the
    session follows it by the times of received frames. is_alive: the emulator has not ended; without it the end of the
    emulator is seen on a local bus only. A session waits for the emulator for any wall time, as at a breakpoint.

    machine: name or file of the drive's machine, whose DBC the session then uses; without it that in SI units. To a
    drive that reports another DBC no reference is sent (OtherDatabase); its frames are decoded, after a warning.

    time_ns: virtual time. log: every (time_ns, message) since the session began, in bus order. telemetry, truth:
    signals of the drive and of the test bench by name.
    """

    address: str
    time_ns: int
    log: list[tuple[int, can.Message]]
    telemetry: SignalTable
    truth: SignalTable
    drive_database: Database
    drive: Drive
    rig: Rig

    def __init__(self, address: str, lockstep: bool = True,
                 parameter_table: Callable[[], list[ParameterRow]] | None = None,
                 is_alive: Callable[[], bool] = lambda: True, machine: str | None = None) -> None:
        self.address = address
        self.time_ns = 0
        self.log = []
        self.drive_database = drive_database(machine)
        self.telemetry = SignalTable(self.drive_database, "DRIVE")
        self.truth = SignalTable(rig_database(), "RIG")
        self.drive = Drive(self, parameter_table)
        self.rig = Rig(self)
        self._lockstep = lockstep
        self._is_alive = is_alive
        self._sequence = 0
        self._identity_checked = False
        self._other_database = ""
        self._bus = open_bus(address)
        self._reader = VirtualTimeReader(self._bus)
        try:
            if lockstep:
                self._run_until(0)  # the answer has the present time
            else:
                self._receive()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leaves the bus."""
        self._bus.shutdown()

    def leave_running(self, duration_s: float) -> None:
        """Leaves the bus after a request to run on for duration_s of virtual time; lock-step only."""
        self._request_run(self.time_ns + round(duration_s * 1e9))
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

    def run_for(self, duration_s: float) -> None:
        """Lets virtual time pass; commands go out as they fall due."""
        self.advance_to(self.time_ns + round(duration_s * 1e9))

    def run_until(self, condition: Callable[[], bool], timeout: float, step_s: float = 1e-3) -> float:
        """Lets virtual time pass in steps until the condition holds; returns the time in seconds.

        AssertionError when it does not hold within `timeout` seconds of virtual time.
        """
        deadline_ns = self.time_ns + round(timeout * 1e9)
        while not condition():
            if self.time_ns >= deadline_ns:
                held = self.drive.start_inhibited_by
                reason = "" if held in ("none", "unknown") else f"; the drive is not ready: its check {held} fails"
                raise AssertionError(f"condition not met within {timeout:g} s, at {self.time_s:g} s of virtual time"
                                     f"{reason}")
            self.advance_to(min(deadline_ns, self.time_ns + round(step_s * 1e9)))
        return self.time_s

    def advance_to(self, time_ns: int) -> None:
        """Lets virtual time pass until `time_ns`; commands go out as they fall due, one due just then included."""
        while True:
            due_ns = self.drive.due_ns
            stop_ns = time_ns if due_ns is None else min(time_ns, due_ns)
            if stop_ns > self.time_ns:
                self._advance(stop_ns)
            if due_ns is not None and due_ns <= self.time_ns:
                self.drive.send_due()
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
        """OtherDatabase when the drive has reported another DBC than that of the session. Waits for its first report
        where time moves by itself; in lock-step time belongs to the caller, and the report may come up to 100 ms later.
        """
        deadline_ns = self.time_ns + _IDENTITY_WAIT_NS
        while not (self._lockstep or self._identity_checked) and self.time_ns < deadline_ns:
            self._receive()
        if self._other_database:
            raise OtherDatabase(f"{self._other_database}: a reference would be another one; state the drive's machine")

    def receive_until(self, matches: Callable[[can.Message], bool]) -> can.Message:
        """Receives until a frame matches; in lock-step virtual time does not pass."""
        while True:
            message = self._receive()
            if matches(message):
                return message

    def send(self, message: can.Message) -> None:
        """Sends a frame of any kind; waits while the emulator takes none."""
        while True:
            try:
                return self._bus.send(message, timeout=_ALIVE_CHECK_S)
            except can.CanTimeoutError:
                self._check_alive()

    def _check_alive(self) -> None:
        if not self._is_alive():
            raise SessionError(f"{self.address}: the emulator has ended")

    def _advance(self, time_ns: int) -> None:
        if self._lockstep:
            self._run_until(time_ns)
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
        identifier = rig_database().get_message_by_name("RIG_RUN_UNTIL").frame_id
        self.send(can.Message(arbitration_id=identifier, is_extended_id=True, data=data))

    def _receive(self) -> can.Message:
        while (timed := self._reader.receive(_ALIVE_CHECK_S)) is None:
            self._check_alive()
        time_ns, message = timed
        if not self._lockstep:
            self.time_ns = max(self.time_ns, time_ns)
        self.log.append(timed)
        self.telemetry.add(time_ns, message)
        if not self._identity_checked and message.arbitration_id == _IDENTITY.frame_id and not message.is_extended_id:
            self._check_identity(message)
        self.truth.add(time_ns, message)
        return message

    def _check_identity(self, message: can.Message) -> None:
        """One line on stderr, once, when the drive was built from another DBC than that of the tools."""
        if message.is_remote_frame or message.is_error_frame or len(message.data) != _IDENTITY.length:
            return
        self._identity_checked = True
        identity = _IDENTITY.decode_simple(bytes(message.data))
        expected = database_hash(self.drive_database)
        if identity["dbc_hash"] != expected:
            version = ".".join(str(identity[f"firmware_{part}"]) for part in ("major", "minor", "patch"))
            self._other_database = (f"{self.address}: firmware {version} was built from another drive.dbc "
                                    f"(hash {identity['dbc_hash']:08x}, here {expected:08x})")
            print(f"salient: {self._other_database}: signals may be decoded wrongly", file=sys.stderr)
