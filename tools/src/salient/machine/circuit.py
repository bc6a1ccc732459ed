"""Tables [coupling], [eddy_current] and [spread] of a machine file: what the magnetics of one phase leave out.

Only the emulator's machine has them; the firmware's tables do not. Equations: emulator/plant/coupled.h.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from salient.errors import shown
from salient.toml_file import Table, TextFileError, number

SHARE_MAX = 0.25
"""Both neighbours' shares of a phase are then at most half of its own: the field of any currents stores energy. Built
machines have 0.01 to 0.05."""
FLUX_DEVIATION_MAX = 0.2
ANGLE_DEVIATION_MAX_DEG = 2.0


class Coupling(Table):
    neighbours: Any


class EddyCurrent(Table):
    conductance_S: Annotated[float, number(1e-9, 100.0)]


class Spread(Table):
    flux_linkage: Any = 0.0
    angle_deg: Any = 0.0


def circuit_of(coupling: Coupling | None, eddy: EddyCurrent | None, spread: Spread, phases: int) -> dict[str, Any]:
    """Values by the members of circuit_t (emulator/plant/machine.h), of every phase where it has one of each."""
    return {
        "coupling": _of_phases("coupling.neighbours", 0.0 if coupling is None else coupling.neighbours, phases,
                               SHARE_MAX),
        "eddy_conductance_S": 0.0 if eddy is None else eddy.conductance_S,
        "flux_deviation": _of_phases("spread.flux_linkage", spread.flux_linkage, phases, FLUX_DEVIATION_MAX),
        "angle_deviation_deg": _of_phases("spread.angle_deg", spread.angle_deg, phases, ANGLE_DEVIATION_MAX_DEG),
    }


def none_of(circuit: Mapping[str, Any]) -> bool:
    """The file has none of it."""
    return not any(any(value) if isinstance(value, tuple) else value for value in circuit.values())


def _of_phases(key: str, value: Any, phases: int, limit: float) -> tuple[float, ...]:
    """One number for all phases, or one for each."""
    values = value if isinstance(value, list) else [value] * phases
    if len(values) != phases or not all(type(each) in (int, float) and -limit <= each <= limit for each in values):
        raise TextFileError(f"{key}: {shown(value)}: must be a number from {-limit:g} to {limit:g}, or {phases} of"
                            " them, one for each phase")
    return tuple(float(each) for each in values)
