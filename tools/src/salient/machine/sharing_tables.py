"""Windows of torque sharing in the units of a machine and the formats of firmware/control/machine_tables.h."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from salient.machine.scaling import Exponents
from salient.machine.sharing_window import SharingWindow

_INT16_MAX, _UINT16_MAX = (1 << 15) - 1, (1 << 16) - 1


@dataclass(frozen=True, eq=False)
class SharingTables:
    """In the units of a machine and the formats of firmware/control/machine_tables.h, rounded and saturated."""

    torque: int
    window: np.ndarray
    """(2, SPEEDS, PARTS, 2): the members of machine_sharing_window_t."""

    def windows(self) -> list[list[list[tuple[int, ...]]]]:
        """The values of machine_sharing_window_t."""
        return [[[tuple(row) for row in speed] for speed in half] for half in self.window.tolist()]


def sharing_tables(window: SharingWindow, exponents: Exponents) -> SharingTables:
    """The tables of a machine in units."""
    torque = math.floor(math.ldexp(window.torque_Nm, 8 - exponents.torque) + 0.5)
    angle = np.floor(np.ldexp(window.window_deg / 360.0, 16) + 0.5)
    return SharingTables(min(max(torque, 1), _UINT16_MAX),
                         np.clip(angle, -_INT16_MAX - 1, _INT16_MAX).astype(np.int64))
