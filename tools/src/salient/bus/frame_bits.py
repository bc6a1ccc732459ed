"""Time of a frame on the wire (ISO 11898-1), with its stuff bits.

Classic frames are exact: their bits are counted as the emulated bus counts them (emulator/rig/can_length.c), from the
start of frame to the end of the intermission that follows. So are flexible data rate frames, whose CRC has stuff bits
at fixed places, but for the part of the bit in which the rate changes.
"""

from __future__ import annotations

from functools import lru_cache

import can
from can.util import len2dlc

_CRC_POLYNOMIAL = 0x4599
_END_BITS = 13
"""CRC delimiter, acknowledge slot and delimiter, seven bits of end of frame, three of intermission."""
_CRC_BITS = 15
_FD_LONG = 16
"""Bytes of data beyond which a flexible data rate frame has a CRC of 21 instead of 17 bits."""
_FD_CRC_BITS, _FD_LONG_CRC_BITS = 4 + 17 + 6, 4 + 21 + 7
"""Count of stuff bits with its parity, CRC, and stuff bits at fixed places."""
_EXTENDED_MAX = 0x1FFFFFFF
_DATA_PHASE_HEAD = 5  # error state indicator and length code


def _table() -> list[int]:
    """CRC of each byte."""
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = crc << 1 ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return table


def _stuffing() -> list[list[tuple[int, int]]]:
    """By state and byte: stuff bits, and the next state. State 5 * level + length - 1 is a run of 1 to 5 equal bits."""

    def step(state: int, byte: int) -> tuple[int, int]:
        count = 0
        for shift in range(7, -1, -1):
            count, state = _after(count, state, byte >> shift & 1)
        return count, state

    return [[step(state, byte) for byte in range(256)] for state in range(10)]


def _after(count: int, state: int, bit: int) -> tuple[int, int]:
    """Stuff bits and state after a bit."""
    level, length = divmod(state, 5)
    length = length + 1 if bit == level else 0
    return (count + 1, 5 * (1 - bit)) if length == 4 else (count, 5 * bit + length)


_CRC = _table()
_STUFFING = _stuffing()


@lru_cache(maxsize=4096)
def _head(identifier: int, is_extended: bool, is_remote: bool, length_code: int) -> tuple[int, int, int, int]:
    """Bits from start of frame to the length code, their stuff bits, and state of stuffing and CRC after them."""
    if is_extended:
        word = (identifier >> 18 & 0x7FF) << 27 | 3 << 25 | (identifier & 0x3FFFF) << 7 | is_remote << 6 | length_code
        bits = 39
    else:
        word, bits = (identifier & 0x7FF) << 7 | is_remote << 6 | length_code, 19
    count, state, crc = 0, 5, 0  # recessive before
    for shift in range(bits - 1, -1, -1):
        bit = word >> shift & 1
        count, state = _after(count, state, bit)
        crc = (crc << 1 ^ (_CRC_POLYNOMIAL if (crc >> 14 ^ bit) & 1 else 0)) & 0x7FFF
    return bits, count, state, crc


def classic_bits(message: can.Message) -> int:
    """Bits of a classic data or remote frame."""
    bits, stuff_bits, state, crc = _head(message.arbitration_id, message.is_extended_id, message.is_remote_frame,
                                         message.dlc)
    data = b"" if message.is_remote_frame else message.data
    for byte in data:
        crc = (crc << 8 & 0x7FFF) ^ _CRC[crc >> 7 ^ byte]
        count, state = _STUFFING[state][byte]
        stuff_bits += count
    tail = crc << 1 | ~crc & 1  # whole bytes; the last bit causes no stuffing
    count, state = _STUFFING[state][tail >> 8]
    stuff_bits += count + _STUFFING[state][tail & 0xFF][0]
    return bits + 8 * len(data) + _CRC_BITS + stuff_bits + _END_BITS


def flexible_bits(message: can.Message) -> tuple[int, int]:
    """Bits of a flexible data rate frame at the bit rate of arbitration, and at the data's; without a switch of the
    rate the latter are 0."""
    switches = bool(message.bitrate_switch)
    if message.is_extended_id:
        # SOF, base identifier, SRR, IDE, identifier extension, RRS, FDF, reserved bit, BRS
        word = ((message.arbitration_id >> 18 & 0x7FF) << 24 | 3 << 22 | (message.arbitration_id & 0x3FFFF) << 4
                | 1 << 2 | switches)
        arbitration = 36
    else:
        word, arbitration = (message.arbitration_id & 0x7FF) << 5 | 1 << 2 | switches, 17
    count, state = 0, 5
    for shift in range(arbitration - 1, -1, -1):
        count, state = _after(count, state, word >> shift & 1)
    arbitration += count
    count = 0
    head = bool(message.error_state_indicator) << 4 | len2dlc(len(message.data))
    for shift in range(_DATA_PHASE_HEAD - 1, -1, -1):
        count, state = _after(count, state, head >> shift & 1)
    for byte in message.data:
        stuffed, state = _STUFFING[state][byte]
        count += stuffed
    crc = _FD_LONG_CRC_BITS if len(message.data) > _FD_LONG else _FD_CRC_BITS
    data = _DATA_PHASE_HEAD + 8 * len(message.data) + count + crc + 1  # and the CRC delimiter
    rest = arbitration + _END_BITS - 1
    return (rest, data) if switches else (rest + data, 0)


class BitRates:
    """Bit rates of a bus in bit/s: of arbitration, and of the data of flexible data rate frames that switch it; without
    the latter they count as slow, which is the most that they can take."""

    def __init__(self, bit_rate: int, data_bit_rate: int | None = None) -> None:
        self.bit_rate, self.data_bit_rate = bit_rate, data_bit_rate or bit_rate
        self._bit_ns, self._data_bit_ns = 1e9 / self.bit_rate, 1e9 / self.data_bit_rate

    def duration_ns(self, message: can.Message) -> float:
        """Time of a frame on the bus. An error frame has none: what it ended is not known."""
        if message.is_error_frame:
            return 0.0
        if message.is_fd:
            arbitration, data = flexible_bits(message)
            return arbitration * self._bit_ns + data * self._data_bit_ns
        return classic_bits(message) * self._bit_ns
