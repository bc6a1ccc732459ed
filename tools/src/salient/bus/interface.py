"""python-can interface "salient": a client of the emulator's local bus.

    can.Bus(interface="salient", channel="unix:PATH")

The bus is an AF_UNIX SOCK_SEQPACKET socket. One record is a frame: its virtual time in nanoseconds (8 bytes, little
endian; 0 in what clients send), then Linux's struct can_frame (16 bytes) or canfd_frame (72 bytes). The emulator sends
every frame to every client, its sender included, when it has completed on the emulated bus.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections import deque
from typing import Any

import can
from can import CanProtocol
from can.typechecking import CanFilters

CAN_EFF_FLAG = 0x80000000
CAN_RTR_FLAG = 0x40000000
CAN_ERR_FLAG = 0x20000000
CANFD_BRS = 0x01
CANFD_ESI = 0x02
CANFD_FDF = 0x04

RIG_IDENTIFIERS = range(0x1F000000, 0x1F000800)
"""29-bit identifiers of the test benches (rig.dbc) of eight nodes; these frames bypass the emulated bus."""

_TIME = struct.Struct("<Q")
# can_frame: identifier, length, 2 bytes unused, raw length code 9..15 of an 8-byte frame, data
_CLASSIC = struct.Struct("<IBxxB8s")
# canfd_frame: identifier, length, flags, 2 bytes unused, data
_FLEXIBLE = struct.Struct("<IBBxx64s")
_RECEIVE_BYTES = 128
_SOCKET_BUFFER_BYTES = 8 * 1024 * 1024
_ECHOES_MAX = 4096
_SO_RCVBUFFORCE = 33  # missing in Python's socket module
_READY_POLL_S = 0.05
_CLOSE_TIMEOUT_S = 1.0
_REPEAT_S = 1.0
"""Between two reports of the end to one who receives without a timeout."""


class VirtualMessage(can.Message):
    """A message whose `time_ns` is the exact virtual time; `timestamp` is the same in seconds, as a float."""

    __slots__ = ("time_ns",)

    def __init__(self, *, time_ns: int = 0, **fields: Any) -> None:
        super().__init__(timestamp=time_ns / 1e9, **fields)
        self.time_ns = time_ns

    @classmethod
    def data_frame(cls, time_ns: int, identifier: int, is_extended: bool, data: bytes, channel: str) -> VirtualMessage:
        """A received classic data frame: almost every frame, in a third of the constructor's time."""
        message = cls.__new__(cls)
        message.time_ns, message.timestamp = time_ns, time_ns / 1e9
        message.arbitration_id, message.is_extended_id = identifier, is_extended
        message.data, message.dlc = bytearray(data), len(data)
        message.channel, message.is_rx = channel, True
        message.is_remote_frame = message.is_error_frame = message.is_fd = False
        message.bitrate_switch = message.error_state_indicator = False
        return message


def frame_bytes(message: can.Message) -> bytes:
    """The message as struct can_frame or canfd_frame; unused bytes are zero."""
    identifier = message.arbitration_id
    if message.is_extended_id:
        identifier |= CAN_EFF_FLAG
    if message.is_remote_frame:
        identifier |= CAN_RTR_FLAG
    if message.is_error_frame:
        identifier |= CAN_ERR_FLAG
    data = bytes(message.data)
    if message.is_fd:
        flags = CANFD_FDF
        flags |= CANFD_BRS if message.bitrate_switch else 0
        flags |= CANFD_ESI if message.error_state_indicator else 0
        return _FLEXIBLE.pack(identifier, len(data), flags, data)
    length = min(message.dlc, 8)
    return _CLASSIC.pack(identifier, length, message.dlc if message.dlc > 8 else 0, data)


def message_of(frame: bytes, time_ns: int, channel: str, is_rx: bool = True) -> VirtualMessage:
    """Inverse of frame_bytes; ValueError when `frame` has neither size."""
    if len(frame) == _CLASSIC.size:
        identifier, length, raw_length, data = _CLASSIC.unpack(frame)
        if is_rx and not raw_length and not identifier & (CAN_RTR_FLAG | CAN_ERR_FLAG):
            extended = identifier >= CAN_EFF_FLAG
            mask = 0x1FFFFFFF if extended else 0x7FF
            return VirtualMessage.data_frame(time_ns, identifier & mask, extended, data[:length], channel)
        flexible, flags = False, 0
    elif len(frame) == _FLEXIBLE.size:
        identifier, length, flags, data = _FLEXIBLE.unpack(frame)
        flexible, raw_length = True, 0
    else:
        raise ValueError(f"a frame has {_CLASSIC.size} or {_FLEXIBLE.size} bytes, not {len(frame)}")
    extended = bool(identifier & CAN_EFF_FLAG)
    remote = bool(identifier & CAN_RTR_FLAG)
    return VirtualMessage(
        time_ns=time_ns,
        arbitration_id=identifier & (0x1FFFFFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=bool(identifier & CAN_ERR_FLAG),
        is_fd=flexible,
        bitrate_switch=bool(flags & CANFD_BRS),
        error_state_indicator=bool(flags & CANFD_ESI),
        dlc=raw_length if raw_length > 8 and length == 8 else length,
        data=b"" if remote else data[:length],
        channel=channel,
        is_rx=is_rx,
    )


def is_on_bus(message: can.Message) -> bool:
    """True for frames that arbitrate on the emulated bus: classic data and remote frames that are not the rig's."""
    if message.is_fd or message.is_error_frame:
        return False
    return not (message.is_extended_id and message.arbitration_id in RIG_IDENTIFIERS)


def wait_until_ready(channel: str, timeout_s: float = 10.0) -> None:
    """Waits until a drive serves "unix:PATH"; can.CanInitializationError when none does within `timeout_s` seconds of
    the wall clock."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            SalientBus(channel).shutdown()
            return
        except can.CanInitializationError:
            if time.monotonic() >= deadline_s:
                raise
        time.sleep(_READY_POLL_S)


def closed_in_order(channel: str) -> bool:
    """After the end of a connection to "unix:PATH": True when the emulator removed its socket, as it does in an orderly
    shutdown; False when it left the socket, because it was killed or crashed.

    The emulator disconnects its clients before it removes the socket. A connection that is still accepted in between
    ends when that is done.
    """
    path = channel.removeprefix("unix:")
    while True:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
            probe.settimeout(_CLOSE_TIMEOUT_S)
            try:
                probe.connect(path)
                if probe.recv(_RECEIVE_BYTES):
                    return True  # another emulator serves the path already
            except ConnectionRefusedError:
                return False
            except ConnectionResetError:
                continue
            except FileNotFoundError:
                return True
            except OSError:
                return False


class SalientBus(can.BusABC):
    """Client of one emulated bus. recv returns VirtualMessage.

    channel: "unix:PATH" (or PATH). receive_own_messages: also receive the frames that this client sent, once they have
    completed on the emulated bus. Flexible data rate, remote and error frames pass. When the emulator ends, send and
    recv raise can.CanOperationError that names the channel; a second recv only after its timeout (1 s without one), as
    can.Notifier calls recv for as long as a listener handles the error. fileno is then never ready again.
    """

    def __init__(self, channel: str, can_filters: CanFilters | None = None,
                 receive_own_messages: bool = False, **options: Any) -> None:
        self.channel = str(channel)
        self._path = self.channel.removeprefix("unix:")
        self.channel_info = f"salient unix:{self._path}"
        self.receive_own_messages = receive_own_messages
        self._can_protocol = CanProtocol.CAN_FD
        # Frames sent whose echo is outstanding. The order is kept within each queue, not between the two.
        self._sent_on_bus: deque[bytes] = deque(maxlen=_ECHOES_MAX)
        self._sent_immediate: deque[bytes] = deque(maxlen=_ECHOES_MAX)
        self._has_ended = False
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            _enlarge_receive_buffer(self._socket)
            self._socket.connect(self._path)
        except OSError as error:
            self._socket.close()
            self._is_shutdown = True
            reason = error.strerror or str(error)  # of a path that is too long Python has no errno
            raise can.CanInitializationError(f"unix:{self._path}: no drive answers there ({reason})") from error
        self._socket.setblocking(False)
        super().__init__(channel=channel, can_filters=can_filters, **options)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame; waits up to `timeout` seconds (None: indefinitely) while the emulator accepts none."""
        frame = frame_bytes(msg)
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(_TIME.pack(0) + frame)
                break
            except BlockingIOError:
                left = None if deadline is None else max(0.0, deadline - time.monotonic())
                if not self._is_ready([], [self._socket], left):
                    raise can.CanTimeoutError(f"{self.channel_info}: the emulator accepts no frames") from None
            except OSError as error:
                raise self._gone() from error
        if not self.receive_own_messages:
            (self._sent_on_bus if is_on_bus(msg) else self._sent_immediate).append(frame)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """As of BusABC, which writes a debug log and reads the clock for each frame."""
        return self._recv_internal(timeout)[0]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while True:
            try:
                record = self._socket.recv(_RECEIVE_BYTES)
            except BlockingIOError:
                if not self._is_ready([self._socket], [], timeout):
                    return None, False
                continue
            except ConnectionResetError:
                continue  # comes once, ahead of the frames that are left
            except OSError as error:
                raise self._end(timeout) from error
            if not record:
                raise self._end(timeout)
            frame = record[_TIME.size :]
            if (self._sent_on_bus or self._sent_immediate) and self._is_own_echo(frame):
                continue
            message = message_of(frame, _TIME.unpack_from(record)[0], self.channel)
            # Filtered here: with a timeout of 0, BusABC.recv would treat a frame that it filters out as the timeout.
            if self._filters is None or self._matches_filters(message):
                return message, True

    @staticmethod
    def _is_ready(to_receive: list[socket.socket], to_send: list[socket.socket], timeout: float | None) -> bool:
        """Waits for the socket. Also true when another thread has shut it down: its next call tells that."""
        try:
            return any(select.select(to_receive, to_send, [], timeout))
        except (OSError, ValueError):
            return True

    def _is_own_echo(self, frame: bytes) -> bool:
        for sent in (self._sent_on_bus, self._sent_immediate):
            if frame in sent:
                while sent.popleft() != frame:
                    pass  # the echo was lost: this client did not read in time
                return True
        return False

    def _end(self, timeout: float | None) -> can.CanOperationError:
        """Error of recv when nothing is left to receive."""
        if self._has_ended or self._is_shutdown:
            time.sleep(_REPEAT_S if timeout is None else max(0.0, timeout))
        else:
            self._has_ended = True
            # The end of a connection is always ready to be read: an event loop would call back without a pause.
            silent = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            os.dup2(silent, self._socket.fileno(), inheritable=False)
            os.close(silent)
        return self._gone()

    def _gone(self) -> can.CanOperationError:
        reason = "this client was shut down" if self._is_shutdown else "the drive has ended"
        return can.CanOperationError(f"unix:{self._path}: {reason}")

    def flush_tx_buffer(self) -> None:
        """Without effect: a client has no queue. A frame is with the emulator when send returns, and goes onto the bus.
        """

    def fileno(self) -> int:
        """For select, asyncio and can.Notifier."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()


def _enlarge_receive_buffer(client: socket.socket) -> None:
    """Requests the largest buffer that the system permits; frames beyond it queue in the emulator."""
    try:
        client.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _SOCKET_BUFFER_BYTES)
    except OSError:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER_BYTES)
