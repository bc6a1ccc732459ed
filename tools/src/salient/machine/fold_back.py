"""Voltage ranges of the DC link in which braking torque decreases: the fields of the phases return to it as well.

A phase that carries the current limit in the aligned position holds the field W. From V on it raises the capacitor to
sqrt(V^2 + 2 W / C), near the over-voltage threshold V_max by about

    rise = W / (C V_max)

Torque and field of a phase decrease together, whether it is saturated or not. Without a chopper braking torque
decreases from 4 rise below V_max on, and there is none within the last 2: more than one phase carries current when the
torque is taken away, and they brake until it has ended. A chopper that takes half of the current limit or more at V_max
leaves 3/8 of both. A weaker one leaves more, but no more than leaves a torque at the voltage at which it begins. The
range is no more than the room above the supply: a link that is not fuller takes the whole torque. Where the field of a
phase exceeds that room, even a machine that only motors may raise the link to V_max.
"""

from __future__ import annotations

import math

from salient.machine.definition import Machine
from salient.machine.drive_data import DriveData

_RISES, _RISES_LEAST = 4.0, 1.5
_STRONG_CHOPPER = 0.5
"""Its current, of the current limit."""
_ROOM_ABOVE_CHOPPER = 1.75


def fold_back_V(machine: Machine, data: DriveData) -> float:
    """Range below over_voltage_V in which the voltage of each control period reduces the braking torque. There is
    none from its middle on, or from a quarter of the way from the chopper's voltage to over_voltage_V on if that is
    higher. 0 for a regenerative supply."""
    link = machine.dc_link
    if link is None:
        return 0.0
    rise_V = field_J(machine, data.parameters["current_limit_A"]) / (link["capacitance_F"] * data.over_voltage_V)
    taken_A = data.over_voltage_V / link.get("chopper_resistance_ohm", math.inf)
    strength = taken_A / (_STRONG_CHOPPER * data.parameters["current_limit_A"])
    rises = max(_RISES_LEAST, _RISES - (_RISES - _RISES_LEAST) * strength)
    above_chopper_V = _ROOM_ABOVE_CHOPPER * (data.over_voltage_V - link.get("chopper_on_V", 0.0))
    range_V = max(_RISES_LEAST * rise_V, min(rises * rise_V, above_chopper_V))
    return min(range_V, data.over_voltage_V - data.supply_max_V)


def mean_fold_back_V(machine: Machine, data: DriveData) -> float:
    """Range below over_voltage_V from whose begin on a lasting excess reduces the braking torque, too: above the
    voltage at which the chopper begins, which would otherwise take little."""
    chopper_on_V = (machine.dc_link or {}).get("chopper_on_V", 0.0)
    return min(fold_back_V(machine, data), data.over_voltage_V - chopper_on_V)


def field_J(machine: Machine, current_A: float) -> float:
    """Energy in the field of a phase in the aligned position."""
    magnetics = machine.magnetics
    flux_Wb = float(magnetics.flux_linkage_Wb(0.0, current_A))
    return current_A * flux_Wb - float(magnetics.coenergy_J(0.0, current_A))
