"""Parameters of a drive that contradict each other or its supply: no drive runs well with them."""

from __future__ import annotations

from collections.abc import Mapping

from salient.errors import UsageError


def check_consistency(values: Mapping[str, float], chosen: Mapping[str, float], supply_V: float) -> None:
    """UsageError, in one line that names both, for a contradiction.

    values: all parameters by name, in their units. chosen: the ones that the user has set. supply_V: voltage of
    the supply. A trip below the current limit is a contradiction only when the limit is chosen: lowering the trip alone
    is how a trip is tested.
    """
    low_V, high_V = values["under_voltage_V"], values["over_voltage_V"]
    limit_A, trip_A = values["current_limit_A"], values["current_trip_A"]
    if low_V >= high_V:
        raise UsageError(f"parameters.under_voltage_V: {low_V:g} V: must be below over_voltage_V, {high_V:g} V")
    if "current_limit_A" in chosen and limit_A > trip_A:
        raise UsageError(f"parameters.current_limit_A: {limit_A:g} A: must not be above current_trip_A, {trip_A:g} A")
    if supply_V < low_V:
        raise UsageError(f"supply_voltage_V: {supply_V:g} V: must not be below under_voltage_V, {low_V:g} V")
    if supply_V > high_V:
        raise UsageError(f"supply_voltage_V: {supply_V:g} V: must not be above over_voltage_V, {high_V:g} V")
