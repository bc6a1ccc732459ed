"""Frames on their way from a bus or a log to the pages."""

from __future__ import annotations

import struct
import threading
import time
from array import array
from collections import deque

import can

from salient.view.description import EXTENDED

KEPT_FRAMES = 1_000_000
"""Frames that wait for a page that takes none: more than a minute of a busy bus. The oldest are dropped."""
_HEADER = struct.Struct("<IId")
_BATCH_FRAMES_MAX = 200_000


class Chunk:
    """Some frames in columns."""

    def __init__(self) -> None:
        self.time_ns, self.identifier = array("d"), array("I")
        self.data, self.length = bytearray(), bytearray()
        self.received_s = 0.0

    def __len__(self) -> int:
        return len(self.length)

    def add(self, time_ns: int, message: can.Message) -> bool:
        """Takes a classic data frame; False for any other, of which a page has no use."""
        if message.is_remote_frame or message.is_error_frame or message.is_fd:
            return False
        data = message.data
        self.time_ns.append(time_ns)
        self.identifier.append(message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id)
        self.length.append(len(data))
        self.data += data if len(data) == 8 else data.ljust(8, b"\0")
        return True


class FrameStore:
    """The latest frames, numbered from 0. `put` is called by the thread of the bus, the others by the server's."""

    def __init__(self, kept: int = KEPT_FRAMES) -> None:
        self._kept = kept
        self._chunks: deque[tuple[int, Chunk]] = deque()
        self._lock = threading.Lock()
        self._next = 0
        self._stored = 0

    @property
    def next_number(self) -> int:
        """Number of the frame that comes next."""
        return self._next

    def put(self, chunk: Chunk) -> None:
        """Adds frames; they are changed no more."""
        chunk.received_s = time.time()
        with self._lock:
            self._chunks.append((self._next, chunk))
            self._next += len(chunk)
            self._stored += len(chunk)
            while self._stored > self._kept and len(self._chunks) > 1:
                self._stored -= len(self._chunks.popleft()[1])

    def message_from(self, number: int) -> tuple[int, bytes] | None:
        """The frames from a number on as a binary message, and the number after them; None while there are none.

        Little endian: uint32 number of frames, uint32 frames lost before them, float64 Unix time in ms at which the
        newest was received; float64 times in ns, uint32 identifiers with the flag EXTENDED, 8 bytes of data each, bytes
        of lengths.
        """
        with self._lock:
            chunks: list[Chunk] = []
            count, lost = 0, 0
            for first, chunk in reversed(self._chunks):
                if first < number:
                    break
                chunks.append(chunk)
            chunks.reverse()
            if chunks:
                lost = self._next - sum(map(len, chunks)) - number
        for index, chunk in enumerate(chunks):
            count += len(chunk)
            if count >= _BATCH_FRAMES_MAX:
                del chunks[index + 1 :]
        if not chunks:
            return None
        columns = [_HEADER.pack(count, lost, chunks[-1].received_s * 1e3)]
        for name in ("time_ns", "identifier", "data", "length"):
            columns += [bytes(getattr(chunk, name)) for chunk in chunks]
        return number + lost + count, b"".join(columns)
