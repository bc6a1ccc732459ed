"""A machine as everything but its file sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from salient.machine.flux_map import FluxMap
from salient.machine.magnetics import Formula
from salient.machine.path import MachineError

__all__ = ["Machine", "MachineError"]


@dataclass(frozen=True)
class Machine:
    """A motor with its converter and sensors, in SI units."""

    name: str
    stator_poles: int
    rotor_poles: int
    phases: int
    resistance_ohm: float
    inertia_kg_m2: float
    friction_Nm_s: float
    supply_voltage_V: float
    magnetics: Formula | FluxMap
    circuit: dict[str, Any]
    """See salient.machine.circuit."""
    converter: dict[str, float]
    """Every key of Converter but supply_voltage_V."""
    dc_link: dict[str, float] | None
    """Keys of DcLink, the chopper's only when there is one; None: ideal."""
    sensors: dict[str, float]
    """Every key of Sensors."""
    iron_loss: dict[str, float] | None
    """Every key of IronLoss; None: no estimate."""
    thermal: dict[str, float]
    """The keys of the table [thermal] that the file has."""
    drive: dict[str, Any]
    """The keys of the table [drive] that the file has."""
    drive_parameters: dict[str, float]
    """The table [drive.parameters]: defaults of the drive's parameters, in their units."""

    @property
    def pitch_rad(self) -> float:
        """Rotor pole pitch."""
        return 2.0 * math.pi / self.rotor_poles

    @property
    def current_rise_A_s(self) -> float:
        """Current slope at the supply voltage with the rotor unaligned and at rest, A/s."""
        return self.supply_voltage_V / self.magnetics.unaligned_inductance_H
