"""Heat path of windings and switches to the surroundings: constants of the emulator's thermal model (rig/heat.h).

What the table [thermal] of a machine file leaves out follows from the continuous currents of the drive's data."""

from __future__ import annotations

from collections.abc import Mapping

from salient.machine.definition import Machine

WINDING_RISE_K, INVERTER_RISE_K = 100.0, 50.0
"""Steady temperature rise at the continuous current."""
INVERTER_TIME_CONSTANT_S = 20.0
_LOSS_MIN = 0.001
"""Part of the switches' rating, voltage times current: ideal devices have no loss."""


def thermal_constants(machine: Machine, parameters: Mapping[str, float], supply_V: float) -> dict[str, float]:
    """The members of thermal_data_t. parameters: defaults of the drive's, in SI units."""
    winding_A, switch_A = parameters["winding_current_A"], parameters["switch_current_A"]
    winding_W = machine.resistance_ohm * winding_A**2
    devices = machine.converter
    inverter_W = max(2.0 * (devices["switch_drop_V"] * switch_A + devices["switch_resistance_ohm"] * switch_A**2),
                     _LOSS_MIN * supply_V * switch_A)
    winding_K_W = machine.thermal.get("winding_resistance_K_W", WINDING_RISE_K / winding_W)
    inverter_K_W = machine.thermal.get("inverter_resistance_K_W", INVERTER_RISE_K / inverter_W)
    time_constant_s = parameters["winding_time_constant_s"]
    return {
        "winding_capacity_J_K": machine.thermal.get("winding_capacity_J_K", time_constant_s / winding_K_W),
        "winding_resistance_K_W": winding_K_W,
        "inverter_capacity_J_K": machine.thermal.get("inverter_capacity_J_K", INVERTER_TIME_CONSTANT_S / inverter_K_W),
        "inverter_resistance_K_W": inverter_K_W,
    }
