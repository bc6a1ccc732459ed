"""Frames with their exact virtual time, from either transport.

The local bus carries the time in every record. SocketCAN carries none; there the emulator sends RIG_STAMP frames:
before each of its frames one with the subject "next", before a frame of another node of the
emulated bus one with the subject "next_of_any_node", and, when a client's frame (which is on the interface already)
completes on the emulated bus or is accepted without it, one with the subject "oldest_on_bus" or "oldest_at_once". The
reader joins frame and stamp and removes the stamps, so both transports yield the same list of (time, frame), in the
same order. On an interface without stamps (`sim --drive-only`) the time is that at which the interface had the frame.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from functools import lru_cache
from typing import cast

import can

from salient.bus.interface import VirtualMessage, is_on_bus
from salient.bus.signals import drive_database, rig_database, value_numbers
from salient.config import NODE_MAX
from salient.dbc import NODE_STEP, RIG_NODE_STEP, RIG_OF_ALL
from salient.errors import UsageError

RIG_CLOCK_ID = rig_database().get_message_by_name("RIG_CLOCK").frame_id
RIG_STAMP_ID = rig_database().get_message_by_name("RIG_STAMP").frame_id
_SUBJECTS = value_numbers(rig_database(), "RIG_STAMP", "subject")


@lru_cache
def nodes_of_drives() -> Mapping[int, int]:
    """The node number of a drive by the identifiers that it transmits."""
    return {message.frame_id + NODE_STEP * node: node for message in drive_database().messages
            if "DRIVE" in message.senders for node in range(NODE_MAX + 1)}


@lru_cache
def nodes_of_messages() -> Mapping[tuple[int, bool, int], frozenset[int]]:
    """The node numbers of the drives that send or take a message, or whose test bench does, by its identifier, whether
    that is extended, and its length."""
    found: dict[tuple[int, bool, int], set[int]] = {}
    for database, step in ((drive_database(), NODE_STEP), (rig_database(), RIG_NODE_STEP)):
        for message in database.messages:
            for node in range(NODE_MAX + 1):
                identifier = message.frame_id + (0 if message.name in RIG_OF_ALL else step * node)
                found.setdefault((identifier, message.is_extended_frame, message.length), set()).add(node)
    return {key: frozenset(nodes) for key, nodes in found.items()}


def has_plain_data(message: can.Message) -> bool:
    """Whether a frame is of the kind that drives and rigs transmit."""
    return not (message.is_fd or message.is_error_frame or message.is_remote_frame)


@lru_cache
def _sent_by_rigs() -> frozenset[int]:
    return frozenset(message.frame_id + RIG_NODE_STEP * node for message in rig_database().messages
                     if "RIG" in message.senders for node in range(1 if message.name in RIG_OF_ALL else NODE_MAX + 1))


def open_bus(address: str, receive_own_messages: bool = True) -> can.BusABC:
    """Opens "unix:PATH" or "socketcan:INTERFACE"; UsageError when it does not exist."""
    kind, _, name = address.partition(":")
    try:
        if kind == "unix" and name:
            return can.Bus(interface="salient", channel=address, receive_own_messages=receive_own_messages)
        if kind == "socketcan" and name:
            return can.Bus(interface="socketcan", channel=name, fd=True, receive_own_messages=receive_own_messages)
    except can.CanInitializationError as error:
        raise UsageError(str(error)) from None
    except OSError as error:
        raise UsageError(f"--can {address}: {error.strerror}") from None
    raise UsageError(f"--can {address}: must be unix:PATH or socketcan:INTERFACE")


class VirtualTimeReader:
    """Reads a bus that was opened with receive_own_messages=True."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        # On SocketCAN a client that sends one of these between a stamp and its frame would take the frame's time; a bus
        # with two senders of one identifier is broken anyway.
        self._drive_sends, self._rig_sends = nodes_of_drives(), _sent_by_rigs()
        self._on_interface = not hasattr(bus, "receive_own_messages")  # SocketCAN
        self._unstamped = 0  # frames of the emulator before the first stamp
        self._stamped = False
        self._next_ns: int | None = None
        self._next_of_any = False
        self._waiting_on_bus: deque[can.Message] = deque()
        self._waiting_at_once: deque[can.Message] = deque()

    @property
    def has_virtual_time(self) -> bool:
        """False while the times are the interface's."""
        return self._stamped or not self._on_interface

    def receive(self, timeout: float | None) -> tuple[int, can.Message] | None:
        """The next (virtual time in ns, message), or None after `timeout` seconds without one, also while frames come
        that have no time yet, as other nodes' where there is no drive. With a timeout of 0 all that have come
        are read."""
        end_s = math.inf
        while True:
            message = self._bus.recv(timeout)
            if message is None:
                return None
            if not self._on_interface:
                return cast(VirtualMessage, message).time_ns, message  # of the local bus
            timed = self._join(message)
            if timed is not None:
                return timed
            if timeout:
                now_s = time.monotonic()
                if now_s >= end_s:
                    return None
                end_s = min(end_s, now_s + timeout)

    def _join(self, message: can.Message) -> tuple[int, can.Message] | None:
        identifier = message.arbitration_id
        if message.is_extended_id and identifier == RIG_STAMP_ID and len(message.data) == 7:
            time_ns, subject = clock_of(message)
            self._stamped = True
            if subject in (_SUBJECTS["next"], _SUBJECTS["next_of_any_node"]):
                self._next_ns, self._next_of_any = time_ns, subject != _SUBJECTS["next"]
                return None
            waiting = self._waiting_on_bus if subject == _SUBJECTS["oldest_on_bus"] else self._waiting_at_once
            # Nothing waits when the frame preceded this reader on the interface.
            return _timed(time_ns, waiting.popleft()) if waiting else None
        if message.is_extended_id and identifier == RIG_CLOCK_ID and len(message.data) == 7:
            return _timed(clock_of(message)[0], message)
        emulators = self._is_emulators(message)
        if self._next_ns is not None and (self._next_of_any or emulators):
            time_ns, self._next_ns = self._next_ns, None
            return _timed(time_ns, message)
        if emulators:
            self._unstamped += 1
        if not self._stamped and self._unstamped > 1:  # one is between its stamp and the first frame of this reader
            return round(message.timestamp * 1e9), message
        (self._waiting_on_bus if is_on_bus(message) else self._waiting_at_once).append(message)
        return None

    def _is_emulators(self, message: can.Message) -> bool:
        if not has_plain_data(message):
            return False
        return message.arbitration_id in (self._rig_sends if message.is_extended_id else self._drive_sends)


def clock_of(message: can.Message) -> tuple[int, int]:
    """Time in ns and last byte (sequence or subject) of RIG_CLOCK and RIG_STAMP, which share their layout."""
    return int.from_bytes(message.data[:6], "little"), message.data[6]


def _timed(time_ns: int, message: can.Message) -> tuple[int, can.Message]:
    message.timestamp = time_ns / 1e9
    return time_ns, message
