"""The drive's memory by XCP: pyXCP as the client, in the time of a session.

    from salient.bench.xcp import connected
    with connected(session) as master:
        master.fetch(4)

pyXCP waits for responses in wall time, a session moves virtual time. Its interface to the bus is therefore one whose
`send` lets the session's time pass until all responses to the command have come.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import can

from salient.bench.client import LoggingClient
from salient.bus.signals import drive_database
from salient.errors import RunFailed

if TYPE_CHECKING:
    from pyxcp.master.master import Master

COMMAND_ID, RESPONSE_ID = (drive_database().get_message_by_name(name).frame_id
                           for name in ("XCP_COMMAND", "XCP_RESPONSE"))
AREA_PARAMETERS, AREA_SCOPE, AREA_TEXT, AREA_TABLES = 0x10000000, 0x20000000, 0x30000000, 0x40000000
"""Addresses of firmware/comms/xcp.h; the drive's memory begins at 0."""
RESPONSE_TIMEOUT_S = 2.0
"""Long enough for a session whose time moves by itself, which reads what came before the response first."""
_POLL_NS = 100_000
_WALL_S = 600.0
"""Wall time in which pyXCP takes a response that has come. Its own 2 s pass in a process that is stopped or starved;
then it repeats the command, and takes the answer to each one for the answer to the next."""
_UPLOAD, _DATA_BYTES = 0xF5, 7
_RESPONSE, _ERROR, _EVENT, _FIRST_OF_RESPONSES = 0xFF, 0xFE, 0xFD, 0xFC
"""Events and service requests answer no command."""
_INSTALL = "XCP needs the package pyxcp: pip install pyxcp"


class XcpError(RunFailed):
    """The drive has refused a command of XCP, or has not responded."""


class SessionInterface:
    """A session as pyXCP's interface to the bus. The drive's frames from the start on are received: `recv`."""

    filters: list[dict[str, Any]] | None = None
    state = can.BusState.ACTIVE

    def __init__(self, session: LoggingClient) -> None:
        self._session = session
        self._command_id = session.drive_database.get_message_by_name("XCP_COMMAND").frame_id
        self._response_id = session.drive_database.get_message_by_name("XCP_RESPONSE").frame_id
        self._received: queue.SimpleQueue[can.Message] = queue.SimpleQueue()
        self._seen = len(session.log)

    @property
    def identifiers(self) -> tuple[int, int]:
        """Identifiers of the commands and of the responses."""
        return self._command_id, self._response_id

    def set_filters(self, filters: list[dict[str, Any]] | None = None) -> None:
        """Takes pyXCP's filters, which select what is received anyway."""
        self.filters = filters

    def send(self, message: can.Message) -> None:
        """Sends a command and lets time pass until it is answered. XcpError: it is not within RESPONSE_TIMEOUT_S."""
        expected = -(-message.data[1] // _DATA_BYTES) if message.data[0] == _UPLOAD else 1
        for frame in self._new_frames():  # which came since the last command
            if frame.data[0] == _EVENT:
                self._received.put(frame)
        message.is_extended_id = False
        self._session.send(message)
        deadline_ns = self._session.time_ns + round(1e9 * RESPONSE_TIMEOUT_S)
        while expected > 0:
            if self._session.time_ns >= deadline_ns:
                raise XcpError(f"no response to the XCP command {message.data.hex(' ')}; does the firmware of the "
                               "drive have XCP?")
            self._session.advance_to(self._session.time_ns + _POLL_NS)
            for frame in self._new_frames():
                self._received.put(frame)
                if frame.data[0] in (_RESPONSE, _ERROR):
                    expected = expected - 1 if frame.data[0] == _RESPONSE else 0

    def _new_frames(self) -> list[can.Message]:
        """The drive's responses and events that the log has since the last call; a user of it may have emptied it."""
        log = self._session.log
        frames = [frame for _, frame in log[self._seen if self._seen <= len(log) else 0:] if self._is_response(frame)]
        self._seen = len(log)
        return frames

    def _is_response(self, message: can.Message) -> bool:
        return (message.arbitration_id == self._response_id and not message.is_extended_id
                and message.data[0] >= _FIRST_OF_RESPONSES)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next response, for pyXCP's thread, which waits in wall time."""
        try:
            return self._received.get(timeout=timeout)
        except queue.Empty:
            return None


def key_of(resource: int, seed: bytes) -> bytes:
    """The key to a seed of the drive: every bit inverted (firmware/comms/xcp.h)."""
    del resource
    return bytes(255 - byte for byte in seed)


def load_client() -> None:
    """Imports pyXCP, which takes a second: before a session with a drive whose time goes on meanwhile, since the bus
    drops what is not read. RunFailed: it is not installed."""
    try:
        import pyxcp.config
        import pyxcp.master.master
        import pyxcp.types  # noqa: F401
    except ImportError:
        raise RunFailed(_INSTALL) from None


@contextmanager
def connected(session: LoggingClient) -> Iterator[Master]:
    """A connected pyXCP master with both resources unlocked. XcpError: see SessionInterface; RunFailed: see
    load_client."""
    load_client()
    from pyxcp.config import create_application_from_config
    from pyxcp.master.master import Master
    from pyxcp.types import XcpResponseError, XcpTimeoutError

    interface = SessionInterface(session)
    command_id, response_id = interface.identifiers
    application = create_application_from_config(
        {"Transport": {"CAN": {"interface": "custom", "can_id_master": command_id, "can_id_slave": response_id,
                               "max_dlc_required": True}}}, log_level=logging.CRITICAL)
    application.transport.timeout = _WALL_S
    application.general.seed_n_key_function = key_of
    application.general.disable_error_handling = True  # it ends the process when the drive refuses a command
    application.transport.layer = "CAN"
    master = Master("can", config=application, transport_layer_interface=interface)
    try:
        with master:
            master.connect()
            master.cond_unlock()  # type: ignore[no-untyped-call]
            yield master
            master.disconnect()
    except (XcpResponseError, XcpTimeoutError) as error:
        raise XcpError(f"XCP: {error}") from None
