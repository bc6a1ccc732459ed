"""Random machines of plausible proportions, reproducible by number: machine files without a table [drive].

The proportions are as in built machines: the flux linkage that the voltage builds up at base speed, the energy that
a stroke converts, saturation at a third of the peak current, inductance ratios of 6 to 14, inertias that grow with the
5/3rd power of the torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

SEED = 20261122
COUNT = 20

_POLES = ((6, 4, 3), (8, 6, 4), (12, 8, 3))
_PEAK_POWER_PER_VOLT_A = 120.0
"""Power over voltage up to which a supply is selected."""


@dataclass(frozen=True)
class Spread:
    """Ranges that machines are drawn from. resistance: smallest and largest part of the supply that the current for the
    torque takes, and the exponent of the torque below 1 N m by which it grows. imperfect: with device drops and current
    sensors of a real drive."""

    seed: int
    torque_Nm: tuple[float, float]
    supplies_V: tuple[float, ...]
    resistance: tuple[float, float, float]
    imperfect: bool


USUAL = Spread(SEED, (0.08, 600.0), (12.0, 24.0, 48.0, 72.0, 150.0, 300.0, 560.0, 800.0), (0.01, 0.05, -0.25), False)
WHOLE_RANGE = Spread(20261127, (0.05, 2000.0), (*USUAL.supplies_V, 36.0, 240.0, 400.0, 1000.0), (0.01, 0.2, -0.5), True)
"""Small machines lose up to half of the supply in the winding."""


def random_machine(number: int, spread: Spread = USUAL) -> str:
    """The text of a machine file, number 0 or more; numbers of `compare machines` are below COUNT."""
    draw = np.random.default_rng((spread.seed, number))

    def between(low: float, high: float) -> float:
        return float(draw.uniform(low, high))

    def logarithmic(low: float, high: float) -> float:
        return math.exp(between(math.log(low), math.log(high)))

    stator, rotor, phases = _POLES[int(draw.integers(len(_POLES)))]
    torque_Nm = logarithmic(*spread.torque_Nm)
    # Surface speed limits large machines, the samples of an electrical revolution small ones.
    base_rpm = min(logarithmic(600.0, 9000.0), 9000.0 / torque_Nm ** (1.0 / 3.0), 24_000.0 / rotor)
    base_rad_s = base_rpm * math.pi / 30.0
    power_W = torque_Nm * base_rad_s
    fitting_V = [volt for volt in spread.supplies_V if 0.5 < power_W / volt < _PEAK_POWER_PER_VOLT_A]
    fitting_V = fitting_V or [max(spread.supplies_V) if power_W > min(spread.supplies_V) else min(spread.supplies_V)]
    supply_V = fitting_V[int(draw.integers(len(fitting_V)))]

    overlap_rad = 2.0 * math.pi / rotor * (0.5 - 1.0 / phases)
    flux_Wb = between(0.75, 1.2) * supply_V * overlap_rad / base_rad_s
    stroke_J = 2.0 * math.pi * torque_Nm / (phases * rotor)
    current_A = stroke_J / (between(0.55, 0.7) * flux_Wb)
    saturation = between(2.2, 3.5)
    saturated_share = between(0.1, 0.25)  # of the flux linkage at the peak current
    saturated_H = saturated_share * flux_Wb / current_A
    knee_Wb = (1.0 - saturated_share) * flux_Wb / (1.0 - math.exp(-saturation))
    aligned_H = saturated_H + knee_Wb * saturation / current_A
    unaligned_H = max(aligned_H / between(6.0, 14.0), 1.05 * saturated_H)
    *part, exponent = spread.resistance
    resistance_ohm = min(0.5, logarithmic(*part) * max(1.0, torque_Nm ** exponent)) * supply_V / current_A
    inertia = logarithmic(2e-5, 2e-4) * torque_Nm ** (5.0 / 3.0)
    friction = logarithmic(0.001, 0.01) * torque_Nm / base_rad_s
    point_A = 4.0 * current_A
    point_Wb = saturated_H * point_A + knee_Wb
    drawn = f"drawn for {torque_Nm:.3g} N m at {base_rpm:.0f} r/min, {current_A:.3g} A"
    return f"""\
# Random machine {number} of seed {spread.seed}: {drawn}.
name = "random_{number:02}"
[poles]
stator = {stator}
rotor = {rotor}
[winding]
resistance_ohm = {resistance_ohm:.4g}
[mechanics]
inertia_kg_m2 = {inertia:.4g}
friction_Nm_s = {friction:.4g}
[magnetics]
form = "saturating"
unaligned_inductance_H = {unaligned_H:.4g}
aligned_inductance_H = {aligned_H:.4g}
saturated_inductance_H = {saturated_H:.4g}
flux_linkage_max_Wb = {point_Wb:.4g}
current_at_flux_linkage_max_A = {point_A:.4g}
[converter]
supply_voltage_V = {supply_V:g}
{_imperfections(between, supply_V, current_A) if spread.imperfect else ""}"""


def _imperfections(between: Callable[[float, float], float], supply_V: float, current_A: float) -> str:
    """Below 100 V MOSFETs and their diodes, above IGBTs; slopes that take up to 1/64 of the supply at the current for
    the torque. Current sensors with a gain of up to 2 % and an offset of up to 0.3 % of that current."""
    threshold_V = 0.0 if supply_V < 100.0 else between(0.6, 1.2)
    slope_ohm = min(1.0, supply_V / 128.0 / current_A)
    return f"""\
switch_drop_V = {threshold_V:.4g}
switch_resistance_ohm = {between(0.0, slope_ohm):.4g}
diode_drop_V = {between(0.3, 1.2):.4g}
diode_resistance_ohm = {between(0.0, slope_ohm):.4g}
[sensors]
current_gain = {between(0.98, 1.02):.4g}
current_offset_A = {between(-0.003, 0.003) * current_A:.4g}
"""
