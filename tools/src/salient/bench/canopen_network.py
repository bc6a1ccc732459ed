"""The network of the package `canopen` on a test bench, in its virtual time.

    node = canopen.RemoteNode(1, eds)
    with network_on(bench) as network:
        network.add_node(node)
        node.nmt.state = "OPERATIONAL"

Its frames leave in `send_message`, which lets time pass until they have had their response: a master in lock-step does
not wait for the wall clock. `run_for` lets time pass without frames of the master.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import can

if TYPE_CHECKING:
    from salient.bench.session import Session

SDO_RESPONSES = range(0x581, 0x600)
RESPONSE_S = 0.002
"""Longer than a request, its handling and its response take at 1 Mbit/s; the segments of a block go on beyond it."""


@contextmanager
def network_on(session: Session) -> Iterator[Any]:
    """A canopen.Network on the bus of a session that moves time."""
    import canopen  # not for those who have no such drive

    class Network(canopen.Network):
        """Sends by the session, and hears what the session has heard."""

        def __init__(self) -> None:
            super().__init__()
            self._heard, self._responds = len(session.log), False
            self._own: list[tuple[int, bytes]] = []  # sent, and not heard yet

        def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
            """As of the package; returns when a response can be there. The frame itself is not handed on: the package
            would take it for another master's, and overwrite what the PDO is to send next."""
            self._own.append((can_id, bytes(data)))
            session.send(can.Message(arbitration_id=can_id, is_extended_id=False, is_remote_frame=remote,
                                     data=b"" if remote else bytes(data), dlc=len(data)))
            self.run_for(RESPONSE_S)
            while self._responds:
                self.run_for(RESPONSE_S)

        def run_for(self, duration_s: float) -> None:
            """Lets virtual time pass, and hands on what comes meanwhile."""
            session.run_for(duration_s)
            self._responds = any(frame.arbitration_id in SDO_RESPONSES for _, frame in session.log[self._heard:])
            while self._heard < len(session.log):
                time_ns, message = session.log[self._heard]
                self._heard += 1
                frame = (message.arbitration_id, bytes(message.data))
                if frame in self._own:
                    self._own.remove(frame)
                elif not message.is_extended_id and not message.is_remote_frame:
                    self.notify(message.arbitration_id, bytearray(message.data), time_ns / 1e9)

    yield Network()
