"""The client of XCP by itself, with a drive that answers at once (of the drive: tests/hil/test_xcp.py)."""

from __future__ import annotations

import struct
import threading
from typing import Any

import can

from salient.bench import xcp
from salient.bus.signals import drive_database

STALL_S = 2.5
"""More than pyXCP waits for a response by itself."""
_ANSWERS = {0xFF: bytes([0xFF, 0x05, 0, 8, 8, 0, 1, 1]), 0xFC: bytes([0xFE, 0x00])}
_SHORT_UPLOAD = 0xF4


class AnsweringSession:
    """A session whose drive has the number of each byte at its address."""

    machine = None

    def __init__(self) -> None:
        self.log: list[tuple[int, can.Message]] = []
        self.time_ns = 0
        self.drive_database = drive_database()
        self._due: list[bytes] = []

    def send(self, message: can.Message) -> None:
        command = bytes(message.data)
        answer = _ANSWERS.get(command[0], bytes([0xFF]) + bytes(5))
        if command[0] == _SHORT_UPLOAD:
            answer = bytes([0xFF, struct.unpack("<I", command[4:8])[0]])
        self._due.append(answer)

    def advance_to(self, time_ns: int) -> None:
        self.time_ns = time_ns
        self.log += [(time_ns, can.Message(arbitration_id=xcp.RESPONSE_ID, is_extended_id=False, data=data))
                     for data in self._due]
        self._due = []


class StoppedClock:
    """pyXCP's clock, which is `stopped_ns` ahead; `read` by the thread that waits for a response."""

    def __init__(self, clock: Any) -> None:
        self._clock = clock
        self.stopped_ns = 0
        self.read = threading.Event()

    @property
    def value(self) -> int:
        now_ns = int(self._clock.value) + self.stopped_ns
        self.read.set()
        return now_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clock, name)


def test_a_client_that_was_stopped_takes_no_answer_for_another_one(monkeypatch):
    """pyXCP's thread does not run for longer than its own timeout, as of a process that is stopped."""
    stalls_s = [0.0]
    receive = xcp.SessionInterface.recv
    clocks: list[StoppedClock] = []

    def stalled(self, timeout=None):
        message = receive(self, timeout)
        if message is not None and stalls_s and (stall_s := stalls_s.pop()):
            [clock] = clocks
            clock.stopped_ns += round(stall_s * 1e9)
            clock.read.clear()
            assert clock.read.wait(60.0), "no thread waits for the response"
        return message

    monkeypatch.setattr(xcp.SessionInterface, "recv", stalled)
    with xcp.connected(AnsweringSession()) as master:
        assert [bytes(master.shortUpload(1, address)) for address in (1, 2)] == [b"\x01", b"\x02"]
        clocks.append(StoppedClock(master.transport.timestamp))
        master.transport.timestamp = clocks[0]
        stalls_s.append(STALL_S)
        assert [bytes(master.shortUpload(1, address)) for address in range(3, 8)] == [bytes([k]) for k in range(3, 8)]
