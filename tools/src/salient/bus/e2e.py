"""End-to-end protection of frames as AUTOSAR E2E profile 5: the sender's side and a check.

Bytes 0 and 1 are the checksum (low byte first), byte 2 the counter, data from byte 3. The checksum is
CRC-16/CCITT-FALSE over bytes 2 to the end and then the data ID, low byte first, which is not transmitted.
"""

from __future__ import annotations

import binascii
from collections.abc import Mapping

import can
from cantools.database.can.message import Message

from salient.dbc import attributes

HEADER_BYTES = 3


def data_id(message: Message) -> int:
    """Data ID of a protected message: its attribute E2EDataId in the DBC."""
    return int(attributes(message)["E2EDataId"])


def checksum(data_id: int, frame: bytes) -> int:
    """CRC of a frame; its first two bytes are ignored."""
    return binascii.crc_hqx(frame[2:] + data_id.to_bytes(2, "little"), 0xFFFF)


def protect(data_id: int, counter: int, payload: bytes) -> bytes:
    """The frame that carries `payload` (the data without header); counter 0..255."""
    body = bytes([counter]) + payload
    return checksum(data_id, b"\0\0" + body).to_bytes(2, "little") + body


def protected_frame(message: Message, counter: int, signals: Mapping[str, float]) -> can.Message:
    """A frame of a protected message with its checksum; signals are those after the header, counter 0..255."""
    payload = message.encode({"checksum": 0, "counter": counter, **signals})[HEADER_BYTES:]
    data = protect(data_id(message), counter, payload)
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=data)


def check(data_id: int, frame: bytes) -> bool:
    """True when the checksum is correct; false for a frame shorter than the header."""
    return len(frame) >= HEADER_BYTES and int.from_bytes(frame[:2], "little") == checksum(data_id, frame)
