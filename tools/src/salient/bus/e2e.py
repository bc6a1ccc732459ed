"""End-to-end protection of frames as AUTOSAR E2E profile 5, the sender's side and a check.

Bytes 0 and 1 are the checksum (low byte first), byte 2 the counter, data from byte 3. The checksum is
CRC-16/CCITT-FALSE over bytes 2 to the end and then the data ID, low byte first, which is never sent.
"""

from __future__ import annotations

import binascii

HEADER_BYTES = 3
DRIVE_COMMAND_DATA_ID = 0x5A1E


def checksum(data_id: int, frame: bytes) -> int:
    """CRC of a frame whose first two bytes are not looked at."""
    return binascii.crc_hqx(frame[2:] + data_id.to_bytes(2, "little"), 0xFFFF)


def protect(data_id: int, counter: int, payload: bytes) -> bytes:
    """The frame that carries `payload` (the data without header); counter 0..255."""
    body = bytes([counter]) + payload
    return checksum(data_id, b"\0\0" + body).to_bytes(2, "little") + body


def check(data_id: int, frame: bytes) -> bool:
    """Whether the checksum is right; a frame shorter than the header is not."""
    return len(frame) >= HEADER_BYTES and int.from_bytes(frame[:2], "little") == checksum(data_id, frame)
