"""The server's connection to a bus: a thread that receives, keeps the drive's commands going and takes jobs."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

import can
from cantools.database.can import Database

from salient.bench.drive import Drive, DriveError
from salient.bench.rig import Rig, RigError
from salient.bus.clock import VirtualTimeReader, open_bus
from salient.bus.identity import OtherDatabase, hash_of, machines_of
from salient.bus.signals import LatestSignals, SignalTable, drive_database, rig_database
from salient.view.frames import Chunk, FrameStore
from salient.view.traffic_feed import TrafficFeed

_TICK_S = 0.004
"""Between two looks at the bus: less than half the period of the commands."""
_REPLY_TIMEOUT_S = 5.0
"""Wall time in which a test bench answers; a bus without one would be waited for until the end of time."""
SHOWN_WITHIN_NS = 1_000_000_000
"""A page commands only while what it has shown is not older than this, in time of the drive."""


class LinkClosed(Exception):
    """The bus has ended."""


class DriveTime:
    """Puts frames of a bus without virtual time on the drive's own time, by the stamps in DRIVE_STATUS. starts: the
    times that the drive has restarted, from where its time is an earlier one."""

    def __init__(self, database: Database) -> None:
        self._identifier = database.get_message_by_name("DRIVE_STATUS").frame_id
        self._offset_ns: int | None = None
        self._drive_us = 0
        self.starts = 0

    def time_ns(self, interface_ns: int, message: can.Message) -> int | None:
        """Time of a frame that the interface had at `interface_ns`; None before the first DRIVE_STATUS."""
        if message.arbitration_id == self._identifier and not message.is_extended_id and len(message.data) == 8:
            stamp_us = int.from_bytes(message.data[:4], "little")
            wraps, last_us = divmod(self._drive_us, 1 << 32)
            # Back by more than half the range is a wrap; by less, another start of the drive.
            self._drive_us = stamp_us + ((wraps + (last_us - stamp_us > 1 << 31)) << 32)
            self.starts += 0 < last_us - stamp_us <= 1 << 31
            self._offset_ns = self._drive_us * 1000 - interface_ns
        return None if self._offset_ns is None else interface_ns + self._offset_ns


class Link:
    """One drive on a bus. `call` runs a function in the thread of the bus, where drive and rig may be used."""

    def __init__(self, address: str, machine: str, node: int, store: FrameStore, traffic: TrafficFeed) -> None:
        self.address = address
        self.time_ns = 0
        self.ended = False
        self.shown_ns: int | None = None
        """State shown by the commanding page; None without one."""
        self.drive_database, self.rig_database = drive_database(machine, node), rig_database(node)
        self.machine: str | None = machine
        self.log: list[tuple[int, can.Message]] = []
        self._keeps_log = False
        self.telemetry: SignalTable = LatestSignals(self.drive_database, "DRIVE")
        self.truth: SignalTable = LatestSignals(self.rig_database, "RIG")
        self._machine = machine
        self._store, self._chunk = store, Chunk()
        self._traffic = traffic
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._stopping = False
        self._bus = open_bus(address)
        self._reader = VirtualTimeReader(self._bus)
        self._drive_time = DriveTime(self.drive_database)
        self.drive, self.rig = Drive(self), Rig(self)
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)

    def start(self) -> None:
        """Begins to receive."""
        self._thread.start()

    def close(self) -> None:
        """Leaves the bus; nothing is sent any more, so that a drive that runs stops by its command timeout."""
        self._stopping = True
        self._wake.set()
        self._thread.join()
        self._bus.shutdown()

    def call(self, job: Callable[[], Any]) -> Future[Any]:
        """Runs a function in the thread of the bus."""
        future: Future[Any] = Future()
        self._jobs.put((job, future))
        self._wake.set()
        return future

    # --- what Drive and Rig need -----------------------------------------------------------------------------------

    def require_drive_database(self) -> None:
        """OtherDatabase when the drive has reported another DBC than the one of the page."""
        reported = self.telemetry["DRIVE_IDENTITY.dbc_hash"]
        if len(reported) and int(reported.last) != hash_of(self._machine):
            carried = next(machines_of(int(reported.last)), "another machine")
            raise OtherDatabase(f"the drive carries {carried}, of database {int(reported.last):08x}, the page shows "
                                f"{self._machine}, of {hash_of(self._machine):08x}: a reference would be another one; "
                                "start the page again")

    def send(self, message: can.Message) -> None:
        """Sends a frame."""
        try:
            self._bus.send(message, timeout=_REPLY_TIMEOUT_S)
        except can.CanError as error:
            raise LinkClosed(f"{self.address}: {error}") from None

    def receive_until(self, matches: Callable[[can.Message], bool]) -> can.Message:
        """Receives until a frame meets the condition; RigError when none does for long."""
        deadline_s = time.monotonic() + _REPLY_TIMEOUT_S
        while time.monotonic() < deadline_s:
            message = self._receive(_TICK_S)
            if message is not None and matches(message):
                return message
        raise RigError("no test bench answers on this bus")

    def run_for(self, duration_s: float) -> None:
        """Receives for a time."""
        self.advance_to(self.time_ns + round(1e9 * duration_s))

    @contextmanager
    def kept_log(self) -> Iterator[None]:
        """The frames received meanwhile are in the log, which is empty otherwise."""
        self._keeps_log = True
        try:
            yield
        finally:
            self._keeps_log = False
            self.log.clear()

    def advance_to(self, time_ns: int) -> None:
        """Receives until that time; DriveError when the drive restarts before."""
        starts = self._drive_time.starts
        while self.time_ns < time_ns:
            self._receive(_TICK_S)
            self._check_same_start(starts)

    def advance_until_frame(self, matches: Callable[[can.Message], bool], timeout_s: float) -> can.Message:
        """Receives until a frame meets the condition; TimeoutError after timeout_s of the drive's time, DriveError when
        the drive restarts before."""
        deadline_ns, starts = self.time_ns + round(timeout_s * 1e9), self._drive_time.starts
        while self.time_ns < deadline_ns:
            message = self._receive(_TICK_S)
            self._check_same_start(starts)
            if message is not None and matches(message):
                return message
        raise TimeoutError(f"no matching frame within {timeout_s:g} s")

    def _check_same_start(self, starts: int) -> None:
        if self._drive_time.starts != starts:
            raise DriveError(f"{self.address}: the drive has restarted")

    # --- the thread of the bus -------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stopping:
                while self._receive(0.0) is not None:
                    pass
                self._put_chunk()
                self._run_jobs()
                self._wake.wait(_TICK_S)
                self._wake.clear()
        except LinkClosed as closed:
            self._put_chunk()
            self.ended = True
            self._refuse_jobs(closed)

    def _run_jobs(self) -> None:
        while not self._jobs.empty():
            job, future = self._jobs.get()
            try:
                future.set_result(job())
            except LinkClosed:
                future.set_exception(DriveError(f"{self.address}: the drive has ended"))
                raise
            except Exception as error:
                future.set_exception(error)

    def _refuse_jobs(self, closed: LinkClosed) -> None:
        while not self._stopping:
            self._wake.wait()
            self._wake.clear()
            while not self._jobs.empty():
                self._jobs.get()[1].set_exception(DriveError(str(closed)))

    def _receive(self, timeout_s: float) -> can.Message | None:
        """One frame, None when there is none in time. Commands that are due by its time are sent before the pages
        learn of it. A frame whose time is not known yet changes nothing."""
        try:
            timed = self._reader.receive(timeout_s)
        except can.CanError:
            raise LinkClosed(f"{self.address}: the drive has ended") from None
        if self._stopping:
            raise LinkClosed(f"{self.address}: closed")
        if timed is None:
            self._put_chunk()
            return None
        time_ns, message = timed
        if not self._reader.has_virtual_time:
            starts, known_ns = self._drive_time.starts, self._drive_time.time_ns(time_ns, message)
            if known_ns is None:
                return message
            time_ns = known_ns
            if self._drive_time.starts != starts:
                self._restart(time_ns)
        self.time_ns = max(self.time_ns, time_ns)
        self.telemetry.add(time_ns, message)
        self._chunk.add(time_ns, message)
        if self._keeps_log:
            self.log.append((time_ns, message))
        self._traffic.add(time_ns, message)
        if (due_ns := self.drive.due_ns) is not None and due_ns <= self.time_ns:
            self._send_due()
        return message

    def _restart(self, time_ns: int) -> None:
        """The drive has restarted: its time is an earlier one, and what was shown is not later than that."""
        self.time_ns = time_ns
        self.drive.time_restarts()
        if self.shown_ns is not None:
            self.shown_ns = min(self.shown_ns, time_ns)

    def take_shown(self, shown_ns: int) -> None:
        """State shown by the commanding page; it may be of the time before the drive restarted."""
        self.shown_ns = min(shown_ns, self.time_ns)

    def _send_due(self) -> None:
        if self.shown_ns is None or self.time_ns - self.shown_ns > SHOWN_WITHIN_NS:
            self.drive.silence()
        else:
            self.drive.send_due()

    def _put_chunk(self) -> None:
        if len(self._chunk):
            self._store.put(self._chunk)
            self._chunk = Chunk()
