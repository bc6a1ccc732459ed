"""python-can interface "salient": a client of the emulator's local bus.

    can.Bus(interface="salient", channel="unix:PATH")

The bus is an AF_UNIX SOCK_SEQPACKET socket. One record is a frame: its virtual time in nanoseconds (8 bytes, little
endian; 0 in what clients send), then Linux's struct can_frame (16 bytes) or canfd_frame (72 bytes). The emulator sends
every frame to every client, its sender included, when it has completed on the emulated bus.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections import deque

import can
from can import CanProtocol

CAN_EFF_FLAG = 0x80000000
CAN_RTR_FLAG = 0x40000000
CAN_ERR_FLAG = 0x20000000
CANFD_BRS = 0x01
CANFD_ESI = 0x02
CANFD_FDF = 0x04

RIG_IDENTIFIERS = range(0x1F000000, 0x1F000100)
"""29-bit identifiers of the test bench (rig.dbc); such frames never are on the emulated bus."""

_TIME = struct.Struct("<Q")
# can_frame: identifier, length, 2 bytes unused, raw length code 9..15 of an 8-byte frame, data
_CLASSIC = struct.Struct("<IBxxB8s")
# canfd_frame: identifier, length, flags, 2 bytes unused, data
_FLEXIBLE = struct.Struct("<IBBxx64s")
_RECEIVE_BYTES = 128
_SOCKET_BUFFER_BYTES = 8 * 1024 * 1024
_ECHOES_MAX = 4096
_SO_RCVBUFFORCE = 33  # not in Python's socket module


class VirtualMessage(can.Message):
    """A message whose `time_ns` is the exact virtual time; `timestamp` is the same in seconds, as a float."""

    __slots__ = ("time_ns",)

    def __init__(self, *args, time_ns: int = 0, **kwargs) -> None:
        super().__init__(*args, timestamp=time_ns / 1e9, **kwargs)
        self.time_ns = time_ns


def frame_bytes(message: can.Message) -> bytes:
    """The message as struct can_frame or canfd_frame; everything without meaning is zero."""
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
    """The other way round; ValueError when `frame` has neither size."""
    if len(frame) == _CLASSIC.size:
        identifier, length, raw_length, data = _CLASSIC.unpack(frame)
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
    """Whether the frame takes its turn on the emulated bus: classic data and remote frames that are not the rig's."""
    if message.is_fd or message.is_error_frame:
        return False
    return not (message.is_extended_id and message.arbitration_id in RIG_IDENTIFIERS)


class SalientBus(can.BusABC):
    """Client of one emulated bus. recv gives VirtualMessage.

    channel: "unix:PATH" (or PATH). receive_own_messages: also give back what this client sent, once it has completed
    on the emulated bus. Flexible data rate, remote and error frames pass. When the emulator ends, send and recv raise
    can.CanOperationError that names the channel.
    """

    def __init__(self, channel: str, can_filters=None, receive_own_messages: bool = False, **kwargs) -> None:
        self.channel = str(channel)
        self._path = self.channel.removeprefix("unix:")
        self.channel_info = f"salient unix:{self._path}"
        self.receive_own_messages = receive_own_messages
        self._can_protocol = CanProtocol.CAN_FD
        # What this client sent and has not seen come back; the two kinds overtake each other.
        self._sent_on_bus: deque[bytes] = deque(maxlen=_ECHOES_MAX)
        self._sent_at_once: deque[bytes] = deque(maxlen=_ECHOES_MAX)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            _enlarge_receive_buffer(self._socket)
            self._socket.connect(self._path)
        except OSError as error:
            self._socket.close()
            self._is_shutdown = True
            raise can.CanInitializationError(f"unix:{self._path}: no drive answers there ({error.strerror})") from error
        self._socket.setblocking(False)
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame; waits up to `timeout` seconds (None: for ever) while the emulator does not take any."""
        frame = frame_bytes(msg)
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(_TIME.pack(0) + frame)
                break
            except BlockingIOError:
                left = None if deadline is None else max(0.0, deadline - time.monotonic())
                if not select.select([], [self._socket], [], left)[1]:
                    raise can.CanTimeoutError(f"{self.channel_info}: the emulator takes no frames") from None
            except OSError as error:
                raise self._gone() from error
        if not self.receive_own_messages:
            (self._sent_on_bus if is_on_bus(msg) else self._sent_at_once).append(frame)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while True:
            try:
                record = self._socket.recv(_RECEIVE_BYTES)
            except BlockingIOError:
                if not select.select([self._socket], [], [], timeout)[0]:
                    return None, False
                continue
            except OSError as error:
                raise self._gone() from error
            if not record:
                raise self._gone()
            frame = record[_TIME.size :]
            if self._is_own_echo(frame):
                continue
            message = message_of(frame, _TIME.unpack_from(record)[0], self.channel)
            # Filtered here: BusABC.recv would take a frame that it filters out for the end of a timeout of 0.
            if self._matches_filters(message):
                return message, True

    def _is_own_echo(self, frame: bytes) -> bool:
        for sent in (self._sent_on_bus, self._sent_at_once):
            if frame in sent:
                while sent.popleft() != frame:
                    pass  # its echo was lost: this client did not read in time
                return True
        return False

    def _gone(self) -> can.CanOperationError:
        return can.CanOperationError(f"unix:{self._path}: the drive has ended")

    def fileno(self) -> int:
        """For select, asyncio and can.Notifier."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()


def _enlarge_receive_buffer(client: socket.socket) -> None:
    """As large as the system lets us; the emulator holds the frames on its side when this is not enough."""
    try:
        client.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _SOCKET_BUFFER_BYTES)
    except OSError:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER_BYTES)
