"""The drive's data of a machine."""

from __future__ import annotations

import math
from dataclasses import dataclass

from salient.machine.file import Machine
from salient.machine.parameter_table import read_table


@dataclass(frozen=True)
class DriveData:
    """SI units, r/min where the name has it."""

    supply_max_V: float
    current_peak_A: float
    torque_peak_Nm: float
    speed_max_rpm: float
    control_rate_hz: int
    adc_current_A: float
    adc_voltage_V: float
    parameters: dict[str, float]

    @property
    def over_speed_rpm(self) -> float:
        return self.parameters["over_speed_rpm"]


def derive(machine: Machine) -> DriveData:
    """The data of a machine."""
    supply_V = machine.supply_voltage_V
    parameters = {row.name: row.default / (1 << row.fraction_bits) for row in read_table()}
    parameters |= {"inertia_kg_m2": machine.inertia_kg_m2, "friction_Nm_s": machine.friction_Nm_s,
                   "resistance_ohm": machine.resistance_ohm}
    voltage = 2.0 ** math.ceil(math.log2(1.3 * supply_V / 512.0))
    return DriveData(supply_V, 52.0, 19.1, 3000.0, 40_000, 80.0, 512.0 * voltage, parameters)
