"""Ranges of the signals of a CAN database."""

import math
from fractions import Fraction

from cantools.database.can.signal import Signal

from salient.generate.error import CodecError

INT64_MAX = 2**63 - 1


def raw_range(signal: Signal) -> tuple[int, int]:
    """Smallest and largest raw value of an integer signal: the range of its bits, narrowed to the range in the DBC."""
    bits = signal.length
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signal.is_signed else (0, (1 << bits) - 1)
    scale, offset = Fraction(str(signal.scale)), Fraction(str(signal.offset))
    ends = [(Fraction(str(end)) - offset) / scale for end in (signal.minimum, signal.maximum) if end is not None]
    if len(ends) == 2:
        low, high = max(low, math.ceil(min(ends))), min(high, math.floor(max(ends)))
    if low > high:
        raise CodecError(f"signal {signal.name}: no value of its range fits {bits} bits")
    return low, min(high, INT64_MAX)
