"""Angles and torques of conduction above base speed in the units of a machine and the formats of
firmware/control/machine_tables.h."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from salient.machine.definition import Machine
from salient.machine.partial_pulse import PartialPulse, partial_pulse
from salient.machine.scaling import Exponents, Scaling
from salient.machine.sharing_window import SharingWindow
from salient.machine.single_pulse import SinglePulse, single_pulse

_UINT16_MAX, _HALF_TURN = (1 << 16) - 1, 1 << 15
_INDEX_BITS = 12 + 32 - 22 + 6
"""Fraction bits of the index at the last speed, less the bits of a speed and a voltage: the index is
((speed_q22 * scale) >> 32) / voltage_q6, 2^12 at the last one."""
_SCALE_BITS = 31
_RIPPLE_OFFSET = 0.25
"""As MACHINE_RIPPLE_OFFSET."""


@dataclass(frozen=True, eq=False)
class PulseTables:
    """In the units of a machine and the formats of firmware/control/machine_tables.h, rounded and saturated."""

    index_scale: int
    pulse: np.ndarray
    """(2, POINTS, 5): the members of machine_pulse_t."""
    braking_end: np.ndarray
    braking_flux: np.ndarray
    base_index: int
    partial: np.ndarray
    """(2, PARTS, POINTS, 3): the members of machine_partial_pulse_t."""

    def pulses(self) -> list[list[tuple[int, ...]]]:
        """The values of machine_pulse_t."""
        return [[tuple(row) for row in half] for half in self.pulse.tolist()]

    def partial_pulses(self) -> list[list[list[tuple[int, ...]]]]:
        """The values of machine_partial_pulse_t."""
        return [[[tuple(row) for row in part] for part in half] for half in self.partial.tolist()]


def pulse_tables(machine: Machine, scaling: Scaling, window: SharingWindow) -> PulseTables:
    """The tables of a machine with its windows of torque sharing."""
    exponents = scaling.exponents
    least = math.ldexp(1.0, _INDEX_BITS - _SCALE_BITS + exponents.speed - exponents.voltage)
    pulse = single_pulse(machine, scaling.data, least)
    return in_units(pulse, partial_pulse(machine, scaling.data, pulse, window), exponents)


def in_units(pulse: SinglePulse, partial: PartialPulse, exponents: Exponents) -> PulseTables:
    """The tables in units."""
    angles = [_rounded(angle_deg / 360.0, 16, limit) for angle_deg, limit in (
        (pulse.lead_deg, _UINT16_MAX), (pulse.end_deg, _HALF_TURN))]
    torques = [_rounded(torque_Nm, 8 - exponents.torque) for torque_Nm in (
        pulse.smooth_Nm, pulse.mean_Nm, pulse.peak_Nm)]
    last = math.ldexp(float(pulse.speed_per_voltage[-1]), exponents.voltage - exponents.speed)
    return PulseTables(
        index_scale=int(_rounded(1.0 / last, _INDEX_BITS, (1 << _SCALE_BITS) - 1)),
        pulse=np.stack([*angles, *torques], axis=-1),
        braking_end=_rounded(pulse.braking_end_deg / 360.0, 16, _HALF_TURN),
        braking_flux=_rounded(pulse.braking_flux_Wb, 13 - exponents.voltage),
        base_index=int(_rounded(pulse.base_speed_per_voltage / float(pulse.speed_per_voltage[-1]), 12)),
        partial=np.stack([_rounded(partial.on_deg / 360.0, 8, 127, -128), _rounded(partial.off_deg / 360.0, 8, 128),
                          _rounded(partial.ripple + _RIPPLE_OFFSET, 7, 255)], axis=-1),
    )


def _rounded(value: Any, fraction_bits: int, limit: int = _UINT16_MAX, least: int = 0) -> np.ndarray:
    result: np.ndarray = np.clip(np.floor(np.ldexp(value, fraction_bits) + 0.5), least, limit).astype(np.int64)
    return result
